"""Estimates against a reference: the truth of a simulation, or what the run itself estimated.

The recordings of one run put through a localizer, judged together.

The figures of a replay as text.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccatp.core import FloatArray, IntArray
from ccatp.mirror.mirror import Mirror
from ccatp.records.run_reader import Trace
from ccatp.studies.replay import Replayed

REPRODUCED = 1e-9
"""Largest difference, m and rad, with which a replay counts as the run again: rounding and nothing else."""


class ReplayErrors(NamedTuple):
    """Differences of an estimate from its reference in the frames that both have.

    Attributes:
        distance_m: along a straight line, shape (k,).
        turn_rad: of the heading, in (-pi, pi], shape (k,).
        is_moving: the wheels turn, shape (k,).
        is_arrival: the robot has just come to rest at a point for the first time, shape (k,).
        nees: normalised estimation error squared of x, y and heading; 3 in the mean where the covariance is right;
            NaN where there is none; shape (k,).
    """

    distance_m: FloatArray
    turn_rad: FloatArray
    is_moving: NDArray[np.bool_]
    is_arrival: NDArray[np.bool_]
    nees: FloatArray


def errors_of(estimate: Trace, reference: Trace, moving: IntArray, arrivals: IntArray) -> ReplayErrors:
    """Compare in the frames that both have.

    Args:
        arrivals: frames at whose end the robot stood at a point for the first time.
    """
    seqs, i, j = np.intersect1d(estimate.seq, reference.seq, return_indices=True)
    offset = estimate.place[i] - reference.place[j]
    turn = _wrapped(estimate.pose[i, 2] - reference.pose[j, 2])
    nees = np.full(len(seqs), np.nan)
    if estimate.covariance is not None:
        error = np.column_stack([offset[:, :2], turn])
        covariance = estimate.covariance[i]
        is_usable = np.linalg.det(covariance) > 0.0
        solved = np.linalg.solve(covariance[is_usable], error[is_usable][:, :, None])[:, :, 0]
        nees[is_usable] = (error[is_usable] * solved).sum(axis=1)
    distance = np.linalg.norm(offset, axis=1)
    return ReplayErrors(distance, turn, np.isin(seqs, moving), np.isin(seqs, arrivals), nees)


def joined(parts: Sequence[ReplayErrors]) -> ReplayErrors:
    """The errors of all parts of a run."""
    return ReplayErrors(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def fix_distances_m(estimate: Trace, feet: FloatArray, mirror: Mirror) -> FloatArray:
    """How far each fix was from the estimate before it, m, shape (f,).

    Args:
        estimate: before each fix.
        feet: frame before the fix, deck x, y of the robot's origin as the fix shows it, shape (f, 3).
    """
    at = np.searchsorted(estimate.seq, feet[:, 0])
    x, y = feet[:, 1], feet[:, 2]
    distances: FloatArray = np.linalg.norm(
        estimate.place[at] - np.column_stack([x, y, mirror.surface.heights_m(x, y)]), axis=1
    )
    return distances


def figures(errors: ReplayErrors) -> dict[str, Any]:
    """The figures of a table: lengths in mm, angles in mrad; None where there is nothing to take them from."""
    distance_mm = 1e3 * errors.distance_m
    known = errors.nees[np.isfinite(errors.nees)]
    return {
        "position_error_mm": distribution(distance_mm),
        "moving_error_mm": {"rms": rms(distance_mm[errors.is_moving])},
        "arrival_error_mm": {
            "rms": rms(distance_mm[errors.is_arrival]),
            "max": largest(distance_mm[errors.is_arrival]),
        },
        "heading_error_mrad": {"rms": rms(1e3 * errors.turn_rad)},
        "nees_mean": float(known.mean()) if known.size else None,
    }


def difference(errors: ReplayErrors) -> dict[str, Any]:
    """How far replayed estimates are from the recorded ones, and whether that is only rounding."""
    distance, turn = errors.distance_m, np.abs(errors.turn_rad)
    is_same = bool(distance.size and max(distance.max(), turn.max()) <= REPRODUCED)
    return {
        "frames": int(distance.size),
        "position_mm": {"rms": rms(1e3 * distance), "max": largest(1e3 * distance)},
        "heading_mrad": {"rms": rms(1e3 * turn), "max": largest(1e3 * turn)},
        "reproduced": is_same,
    }


def distribution(values: FloatArray) -> dict[str, float | None]:
    """Mean, median, 99th percentile and largest."""
    if not values.size:
        return dict.fromkeys(("mean", "p50", "p99", "max"))
    p50, p99 = np.percentile(values, (50, 99)).tolist()
    return {"mean": float(values.mean()), "p50": p50, "p99": p99, "max": float(values.max())}


def rms(values: FloatArray) -> float | None:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else None


def largest(values: FloatArray) -> float | None:
    """The largest."""
    return float(values.max()) if values.size else None


def _wrapped(turn: FloatArray) -> FloatArray:
    # Exactly nothing for equal angles.
    wrapped: FloatArray = turn - 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
    return wrapped


class ReplayEvaluation(NamedTuple):
    """One recording and its replay.

    Attributes:
        arrivals: frames at which the robot stood at a point for the first time.
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


def judge(parts: Sequence[ReplayEvaluation]) -> dict[str, Any]:
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


def _against(parts: Sequence[ReplayEvaluation], estimates: Sequence[Trace], has_truth: bool) -> dict[str, Any]:
    return figures(_errors(parts, estimates, has_truth=has_truth))


def _errors(parts: Sequence[ReplayEvaluation], estimates: Sequence[Trace], *, has_truth: bool) -> ReplayErrors:
    return joined(
        [
            errors_of(estimate, part.reference if has_truth else part.recorded, part.replayed.moving, part.arrivals)
            for part, estimate in zip(parts, estimates, strict=True)
        ]
    )


def _fix_distances(parts: Sequence[ReplayEvaluation], estimates: Sequence[Trace]) -> FloatArray:
    return np.concatenate(
        [
            fix_distances_m(estimate, part.replayed.feet, part.mirror)
            for part, estimate in zip(parts, estimates, strict=True)
        ]
    )


COLUMNS = ("recorded", "replayed", "smoothed")
# Section and key of a figure, and how a reader would call it.
ROWS = (
    ("position_error_mm", "mean", "position mean"),
    ("position_error_mm", "p50", "position p50"),
    ("position_error_mm", "p99", "position p99"),
    ("position_error_mm", "max", "position max"),
    ("moving_error_mm", "rms", "in motion rms"),
    ("arrival_error_mm", "rms", "at arrivals rms"),
    ("arrival_error_mm", "max", "at arrivals max"),
)
HEADER = ("part", "seq", "t_s", "x_m", "y_m", "heading_rad")


def table_lines(result: Mapping[str, Any]) -> Iterator[str]:
    """The result of ``judge`` as a table: a column for each estimate, a dash for what is not known."""
    columns = [name for name in COLUMNS if result[name] is not None]
    against = "the truth" if result["reference"] == "truth" else "the recorded estimate"
    yield _line(f"error against {against}", columns)
    for section, key, name in ROWS:
        cells = [_cell((result[column].get(section) or {}).get(key)) for column in columns]
        yield _line(f"  {name} (mm)", cells)
    cells = [_cell((result[column].get("heading_error_mrad") or {}).get("rms")) for column in columns]
    yield _line("  heading rms (mrad)", cells)
    yield _line("  NEES mean (3 is right)", [_cell(result[column].get("nees_mean")) for column in columns])
    yield _line("distance of the fixes", columns)
    for key in ("mean", "max"):
        cells = [_cell((result[column].get("fix_distance_mm") or {}).get(key)) for column in columns]
        yield _line(f"  {key} (mm)", cells)
    yield from _difference(result["difference"])


def _difference(found: Mapping[str, Any]) -> Iterator[str]:
    yield _line("replayed less recorded", ["rms", "max"])
    for section, name in (("position_mm", "position (mm)"), ("heading_mrad", "heading (mrad)")):
        yield _line(f"  {name}", [_cell(found[section]["rms"]), _cell(found[section]["max"])])


def _line(name: str, cells: Sequence[str]) -> str:
    return f"{name:<34}" + "".join(f"{cell:>12}" for cell in cells)


def _cell(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.4f}" if value == 0.0 or abs(value) >= 1e-3 else f"{value:.1e}"


def csv_lines(parts: Sequence[ReplayEvaluation]) -> Iterator[str]:
    """Poses of each frame, deck frame: replayed, smoothed, recorded and true; empty where there is none."""
    names = ("smoothed", "recorded", "true")
    yield ",".join((*HEADER, *(f"{name}_{key}" for name in names for key in HEADER[3:])))
    for number, part in enumerate(parts, 1):
        trace = part.replayed.trace
        others = [_by_frame(other) for other in (part.replayed.smoothed, part.recorded, part.truth)]
        for seq, t_s, pose in zip(trace.seq.tolist(), trace.t_s.tolist(), trace.pose.tolist(), strict=True):
            found = [rows.get(seq, ("", "", "")) for rows in others]
            yield ",".join(str(cell) for cell in (number, seq, t_s, *pose, *(cell for row in found for cell in row)))


def _by_frame(trace: Any) -> dict[int, Sequence[float]]:
    if trace is None:
        return {}
    poses: FloatArray = trace.pose
    return dict(zip(trace.seq.tolist(), poses.tolist(), strict=True))
