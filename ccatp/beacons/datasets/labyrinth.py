"""The Labyrinth set of TU Chemnitz: UWB ranges, wheel speeds and positions, a line each in one text."""

from pathlib import Path

import numpy as np

from ccatp.beacons.datasets.tables import (
    RadioDataError,
    Table,
    bridged,
    content_lines,
    in_order,
    names_of,
    number,
    read_text,
    within,
)
from ccatp.beacons.datasets.truth import checked_heading, pose_of_truth, turning_factor
from ccatp.beacons.slam.recording import Readings, RecordedRun, ReferencePath, Steps

TRACK_WARNING = 0.2
# The readme calls the wheel columns right, left and the fourth the distance between the wheels; the numbers say left,
# right, and half that distance (see wheel_columns in checks).
LINES = {
    "range2": ("time [s]", "range [m]", "sigma [m]", "anchor x [m]", "anchor y [m]", "anchor"),
    "odom2diff": (
        "time [s]", "speed of the left wheel [m/s]", "speed of the right wheel [m/s]", "speed sideways [m/s]",
        "half the track [m]", "sigma left [m/s]", "sigma right [m/s]", "sigma sideways [m/s]",
    ),
    "gt2": ("time [s]", "x [m]", "y [m]"),
}  # fmt: skip


def is_labyrinth(text: str) -> bool:
    """Whether the text's first line is one of the set's."""
    lines = content_lines(text[:4096])
    return bool(lines) and lines[0][1].split()[0] in LINES


def read_labyrinth(path: Path) -> RecordedRun:
    """Read a Labyrinth text, plain or gzipped.

    Raises:
        RadioDataError: a line is not one of the set's, or there is no odometry or no range.
    """
    file = _chosen(path) if path.is_dir() else path
    warnings: list[str] = []
    tables = {kind: in_order(table, warnings) for kind, table in _tables(file).items()}
    for kind in ("odom2diff", "range2"):
        if kind not in tables:
            raise RadioDataError(file, f"no line {kind} ({', '.join(LINES[kind])})")
    steps = _steps(tables["odom2diff"])
    span_s = (float(steps.times_s[0]), float(steps.times_s[-1]))
    ranges = tables["range2"].values
    ranges = ranges[within(ranges[:, 0], span_s, "range", warnings)]
    if not len(ranges):
        raise RadioDataError(file, "no range within the time of the odometry")
    beacon_ids, beacon = names_of(ranges[:, 5])
    truth = None
    if "gt2" in tables:
        t, x, y = tables["gt2"].values.T
        truth = checked_heading(ReferencePath(t, x, y, np.full(len(t), np.nan)), steps, warnings)
        warnings += wheel_columns(truth, steps, float(np.median(tables["odom2diff"].values[:, 4])))
    nothing = np.full(len(ranges), np.nan)
    return RecordedRun(
        name=file.name.split(".")[0],
        kind="labyrinth",
        steps=steps,
        readings=Readings(ranges[:, 0], beacon, ranges[:, 1], nothing, nothing.copy()),
        beacon_ids=beacon_ids,
        beacon_truth_m={
            name: (float(x), float(y))
            for k, name in enumerate(beacon_ids)
            for x, y in [np.median(ranges[beacon == k, 3:5], axis=0)]
        },
        truth=truth,
        first_pose=pose_of_truth(truth, steps, warnings),
        warnings=tuple(warnings),
    )


def wheel_columns(truth: ReferencePath, steps: Steps, half_track_m: float) -> list[str]:
    """What the truth says of the wheel columns, a line; nothing where it tells too little.

    Args:
        steps: odometry with the columns read as left, right, half the track.
    """
    factor = turning_factor(truth, steps)
    if factor is None:
        return []
    order, read_m = "left, right" if factor > 0.0 else "right, left", 2.0 * half_track_m
    track_m = read_m / abs(factor)
    found = f"wheel columns by the shape of the true path: {order}, track {track_m:.3f} m"
    if factor > 0.0 and abs(factor - 1.0) < TRACK_WARNING:
        return [f"{found} (the readme says right, left and {half_track_m:.4f} m); read as left, right, {read_m:.4f} m"]
    return [f"{found}; they were read as left, right and {read_m:.4f} m, so that the odometry is wrong"]


def _chosen(folder: Path) -> Path:
    files = [file for file in sorted(folder.glob("*.txt*")) if is_labyrinth(read_text(file))]
    if len(files) != 1:
        what = f"holds {len(files)} Labyrinth texts: name one" if files else "holds no Labyrinth text"
        raise RadioDataError(folder, what)
    return files[0]


def _tables(file: Path) -> dict[str, Table]:
    rows: dict[str, list[list[float]]] = {}
    lines: dict[str, list[int]] = {}
    for line, content in content_lines(read_text(file)):
        kind, *words = content.split()
        if kind not in LINES:
            raise RadioDataError(file, f"{kind!r} is none of {', '.join(LINES)}", line)
        names = LINES[kind]
        if len(words) != len(names):
            wanted = ", ".join(names)
            raise RadioDataError(file, f"{len(words)} values after {kind}, wanted {len(names)}: {wanted}", line)
        rows.setdefault(kind, []).append([number(file, line, w, n) for w, n in zip(words, names, strict=True)])
        lines.setdefault(kind, []).append(line)
    return {kind: Table(file, np.array(rows[kind]), np.array(lines[kind])) for kind in rows}


def _steps(odometry: Table) -> Steps:
    t, left, right, side, half_track = odometry.values[:, :5].T
    if len(t) < 3:
        raise RadioDataError(odometry.file, f"{len(t)} lines odom2diff: too few for a run")
    if (half_track <= 0.0).any():
        line = int(odometry.lines[np.flatnonzero(half_track <= 0.0)[0]])
        raise RadioDataError(odometry.file, "the distance between the wheels is not positive", line)
    interval_s = np.diff(t)
    later = interval_s > 0.0
    distance = (0.5 * (left + right)[:-1] * interval_s)[later]
    turn = (((right - left) / (2.0 * half_track))[:-1] * interval_s)[later]
    times = np.concatenate([t[:-1][later], t[-1:]])
    return bridged(Steps(times, distance, turn, (side[:-1] * interval_s)[later]))
