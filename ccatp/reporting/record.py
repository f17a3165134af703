"""Pure. What a run left behind, as a report needs it. Whatever a run does not hold is empty or None."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from ccatp.aligning.deviations import Measured
from ccatp.config.models import Config
from ccatp.mirror.mirror import Mirror
from ccatp.run_files.state_log import LogLine, StateChange
from ccatp.samples import FloatArray, IntArray, PanelId, PointId, Vector3
from ccatp.wire.topics import DangerEvent, FixMessage, MissionStatus

COMPLETE = "complete"
WITHIN_MM = 10.0  # the thesis's requirement on arrivals


class Track(NamedTuple):
    """Estimated poses after k frames, deck frame.

    Attributes:
        seq: numbers of the frames, shape (k,).
        t_s: robot time, shape (k,).
        place_m: points on the surface, shape (k, 3).
        heading_rad: shape (k,).
        sigma_m: standard deviation of the place along any one direction, shape (k,).
    """

    seq: IntArray
    t_s: FloatArray
    place_m: FloatArray
    heading_rad: FloatArray
    sigma_m: FloatArray


class Truth(NamedTuple):
    """True poses after k frames, deck frame: as in ``Track``; ``clearance_m`` of the worst edge sensor to the rim."""

    seq: IntArray
    t_s: FloatArray
    place_m: FloatArray
    heading_rad: FloatArray
    clearance_m: FloatArray


class Arrived(NamedTuple):
    """The robot came to rest at a point for the first time, as it took it."""

    point: PointId
    seq: int
    t_s: float
    estimated_error_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """One recording; a run that was resumed has several.

    Attributes:
        name: of the file.
        version: of the ccatp that recorded it.
        track, truth: poses; truth is None on a real robot.
        arrivals, fixes, statuses, verdicts: messages in the order of recording.
        changes: of the mission's state, from the log; empty where the log does not tell them in order.
    """

    name: str
    version: str
    track: Track
    truth: Truth | None
    arrivals: tuple[Arrived, ...]
    fixes: tuple[FixMessage, ...]
    statuses: tuple[MissionStatus, ...]
    verdicts: tuple[DangerEvent, ...]
    changes: tuple[StateChange, ...]

    @property
    def span_s(self) -> float:
        """Robot time from the first frame to the last one."""
        return float(self.track.t_s[-1] - self.track.t_s[0]) if len(self.track.t_s) else 0.0


class PlannedRow(NamedTuple):
    """A point of the mission: planned, measured or skipped; robot time of the latter two."""

    point: PointId
    status: str
    t_s: float | None


class Outcome(NamedTuple):
    """How a run ended, in a few words; why, where somebody said so; and whether that is as it should be."""

    text: str
    cause: str
    is_good: bool


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RunFiles:
    """What every run leaves behind, whatever its mission.

    Attributes:
        name: how the reader called it: its directory.
        config_text: its configuration file.
        changed: keys with another value than the shipped one: value of the run, and shipped value.
        is_simulation: None where there is no recording to tell.
        summary: ``summary.json``; None where the run did not come to write one.
        log: what the processes said, without what they said for debugging.
        files: names and sizes in bytes.
        missing: what a complete run would hold and this one does not, one line each.
        warnings: what is damaged, one line each.
    """

    name: str
    config_text: str
    changed: Mapping[str, tuple[object, object]]
    is_simulation: bool | None
    summary: Mapping[str, Any] | None
    log: tuple[LogLine, ...]
    files: Mapping[str, int]
    missing: tuple[str, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RunRecord(RunFiles):
    """A survey.

    Attributes:
        cfg: configuration.
        mirror: the mirror.
        sessions: recordings, oldest first.
        points: of the mission database, by row, column and number; None where there is none.
        measured: points with a sound fix.
        injected: piston (m), tip and tilt (rad) of the simulated panels.
    """

    cfg: Config
    mirror: Mirror
    sessions: tuple[Session, ...]
    points: tuple[PlannedRow, ...] | None
    measured: tuple[Measured, ...]
    injected: Mapping[PanelId, Vector3] | None

    @property
    def last_status(self) -> MissionStatus | None:
        """What main said last of the mission."""
        said = [status for session in self.sessions for status in session.statuses]
        return said[-1] if said else None

    @property
    def has_truth(self) -> bool:
        """Every recording with frames holds the simulated truth."""
        driven = [session for session in self.sessions if len(session.track.seq)]
        return bool(driven) and all(session.truth is not None for session in driven)


def changed_keys(
    ours: Mapping[str, Any], shipped: Mapping[str, Any], prefix: str = ""
) -> dict[str, tuple[object, object]]:
    """Keys of a configuration whose values differ: ours and the shipped ones; None where there is none."""
    found: dict[str, tuple[object, object]] = {}
    for key in dict.fromkeys((*ours, *shipped)):
        one, other = ours.get(key), shipped.get(key)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            found |= changed_keys(one, other, f"{prefix}{key}.")
        elif one != other:
            found[prefix + key] = (one, other)
    return found
