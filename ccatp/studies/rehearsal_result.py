"""Pure. What comes of a rehearsal."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(slots=True)
class StopRow:
    """One measurement of a point, before its fix is fused.

    Attributes:
        t_s: robot time.
        point: row, column, number.
        approach: 1 at the first arrival.
        error: true minus estimated pose: x, y (deck, m), heading (rad).
        covariance: of the estimate of the three, shape (3, 3).
        distance_m: true distance of the puck's foot from the point.
        nis: normalised innovation squared of the fix (two degrees of freedom), NaN where it is not known.
        fix_distance_m: the same distance as the fix shows it, after fusing.
    """

    t_s: float
    point: tuple[int, int, int]
    approach: int
    error: tuple[float, float, float]
    covariance: np.ndarray[Any, np.dtype[np.float64]]
    distance_m: float
    nis: float = float("nan")
    fix_distance_m: float = float("nan")


@dataclass(slots=True)
class Rehearsal:
    """What came of it.

    Attributes:
        summary: as in ``summary.json``.
        stops: measurements in the order they were taken.
        corrections: moves after a fix that showed the robot too far from its point.
        counts: the localizer's.
        outcome, cause: how the mission ended.
        states_s: time spent in each state of the mission.
        track: rows of t, true x, y, heading, estimated x, y, heading (deck), shape (k, 7), where it was asked for.
        notices: what the localizer had to say to an operator.
    """

    summary: dict[str, Any]
    stops: list[StopRow]
    corrections: int
    counts: dict[str, int]
    outcome: str
    cause: str
    states_s: dict[str, float]
    track: np.ndarray[Any, np.dtype[np.float64]] | None = None
    notices: list[str] = field(default_factory=list)

    @property
    def mission_time_s(self) -> float:
        """Robot time from start to end."""
        return float(self.summary["mission_time_s"])

    @property
    def wall_s(self) -> float:
        """Wall time, where the caller measured it; 0 otherwise."""
        return float(self.summary["wall"]["time_s"] or 0.0)
