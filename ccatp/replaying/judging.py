"""Pure. The recordings of one run put through a localizer, judged together."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ccatp.mirror.batches import FloatArray
from ccatp.mirror.mirror import Mirror
from ccatp.replaying.comparison import (
    Errors,
    difference,
    distribution,
    errors_of,
    figures,
    fix_distances_m,
    joined,
)
from ccatp.replaying.player import Replayed
from ccatp.replaying.trace import IntArray, Trace


class Judged(NamedTuple):
    """One recording and its replay.

    Attributes:
        replayed: what came of it.
        recorded: what the run itself estimated.
        truth: of the simulation, or None.
        arrivals: frames at which the robot stood at a point for the first time.
        mirror: the mirror.
    """

    replayed: Replayed
    recorded: Trace
    truth: Trace | None
    arrivals: IntArray
    mirror: Mirror

    @property
    def reference(self) -> Trace:
        """What errors are measured against."""
        return self.recorded if self.truth is None else self.truth


def judge(parts: Sequence[Judged]) -> dict[str, Any]:
    """Errors of recorded, replayed and smoothed estimates, and how far the replay is from the record.

    Errors are those against the truth where every recording has one, else against the run's own estimates: then there
    are none of the recorded ones. How far each fix was from the estimate before it is known without any truth.
    """
    has_truth = all(part.truth is not None for part in parts)
    is_smoothed = all(part.replayed.smoothed is not None for part in parts)
    recorded = [part.recorded for part in parts]
    replayed = [part.replayed.trace for part in parts]
    smoothed = [part.replayed.smoothed for part in parts if part.replayed.smoothed is not None]
    return {
        "reference": "truth" if has_truth else "recorded",
        "recorded": {
            **(_against(parts, recorded, has_truth) if has_truth else {}),
            "fix_distance_mm": distribution(1e3 * _fix_distances(parts, recorded)),
        },
        "replayed": {
            **_against(parts, replayed, has_truth),
            "fix_distance_mm": distribution(1e3 * _fix_distances(parts, replayed)),
        },
        "smoothed": _against(parts, smoothed, has_truth) if is_smoothed else None,
        "difference": difference(_errors(parts, replayed, has_truth=False)),
    }


def _against(parts: Sequence[Judged], estimates: Sequence[Trace], has_truth: bool) -> dict[str, Any]:
    return figures(_errors(parts, estimates, has_truth=has_truth))


def _errors(parts: Sequence[Judged], estimates: Sequence[Trace], *, has_truth: bool) -> Errors:
    return joined(
        [
            errors_of(estimate, part.reference if has_truth else part.recorded, part.replayed.moving, part.arrivals)
            for part, estimate in zip(parts, estimates, strict=True)
        ]
    )


def _fix_distances(parts: Sequence[Judged], estimates: Sequence[Trace]) -> FloatArray:
    return np.concatenate(
        [
            fix_distances_m(estimate, part.replayed.feet, part.mirror)
            for part, estimate in zip(parts, estimates, strict=True)
        ]
    )
