"""Factor graphs as text (pyfg): a recorded run from one, and one from a recorded run."""

import re
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np

from ccatp.beacons.config.models import RecordingConfig
from ccatp.beacons.datasets.events import Recording, name_of
from ccatp.beacons.datasets.tables import RadioDataError, content_lines, number, plural, read_text, tables_of
from ccatp.beacons.estimation.recording import RecordedRun, dead_reckoned
from ccatp.core import FloatArray
from ccatp.kinematics import wrap_pi

# Numbers of values after the names, by kind of line.
VALUES = {
    "VERTEX_SE2": 3, "VERTEX_XY": 2, "EDGE_SE2": 9, "EDGE_RANGE": 2, "EDGE_SE2_XY": 5, "VERTEX_SE2:PRIOR": 9,
    "VERTEX_XY:PRIOR": 5,
}  # fmt: skip
NAMES = {"EDGE_SE2": 2, "EDGE_RANGE": 2, "EDGE_SE2_XY": 2}
UNTIMED = ("VERTEX_XY",)
POSE = re.compile(r"([A-KM-Z])(\d+)$")  # L is for landmarks


def is_pyfg(text: str) -> bool:
    """Whether the first line of a text is of a factor graph."""
    lines = content_lines(text[:4096])
    return bool(lines) and lines[0][1].split()[0].startswith(("VERTEX_SE", "VERTEX_XY", "EDGE_SE", "EDGE_RANGE"))


def read_pyfg(file: Path) -> Recording:
    """Read one vehicle's run: its odometry edges and its ranges to landmarks; vertices with values are the truth.

    Raises RadioDataError: a line is not of a graph in the plane, or the graph has no odometry.
    """
    lines = [(line, *_parsed(file, line, content.split())) for line, content in content_lines(read_text(file))]
    warnings: list[str] = []
    vehicles = [match[1] for _, kind, _, names, _ in lines if kind == "EDGE_SE2" and (match := POSE.match(names[0]))]
    if not vehicles:
        raise RadioDataError(file, "has no odometry: no EDGE_SE2 between poses")
    vehicle = max(set(vehicles), key=vehicles.count)
    if len(set(vehicles)) > 1:
        warnings.append(f"of the vehicles {', '.join(sorted(set(vehicles)))} only {vehicle} is read")
    times_s = _times(lines, vehicle, warnings)
    numbers: dict[str, float] = {}
    rows = list(_events(lines, vehicle, times_s, numbers, warnings))
    rows.append(("odom", 1, [times_s[min(times_s)], 0.0, 0.0, 0.0]))
    rows.sort(key=lambda row: row[2][0] if row[0] != "beacon" else -np.inf)
    return Recording(file, name_of(file), "csv", tables_of(file, rows), tuple(numbers), tuple(warnings))


Line = tuple[int, str, float, list[str], list[float]]


def _parsed(file: Path, line: int, words: list[str]) -> tuple[str, float, list[str], list[float]]:
    kind = words[0]
    if kind not in VALUES:
        raise RadioDataError(file, f"{kind!r} is none of {', '.join(VALUES)}: only graphs in the plane are read", line)
    timed, names = kind not in UNTIMED, NAMES.get(kind, 1)
    # Some writers give landmarks a time, too.
    if not timed and len(words) == 1 + 1 + names + VALUES[kind]:
        timed = True
    first = 1 + timed
    if len(words) != first + names + VALUES[kind]:
        what = f"{len(words) - 1} words after {kind}, wanted {names + VALUES[kind] + timed}"
        raise RadioDataError(file, what, line)
    time_s = number(file, line, words[1], "time") if timed else np.nan
    values = [number(file, line, word, "value") for word in words[first + names :]]
    return kind, time_s, words[first : first + names], values


def _times(lines: list[Line], vehicle: str, warnings: list[str]) -> dict[int, float]:
    """Time of each pose by its number: those of the vertices, or of the edges, or else one second each."""
    of_vertices: dict[int, float] = {}
    of_edges: dict[int, float] = {}
    for _, kind, time_s, names, _ in lines:
        match = POSE.match(names[-1] if kind == "EDGE_SE2" else names[0])
        if match is None or match[1] != vehicle:
            continue
        if kind == "VERTEX_SE2":
            of_vertices[int(match[2])] = time_s
        elif kind == "EDGE_SE2":
            of_edges.setdefault(int(match[2]), time_s)
    poses = sorted({*of_vertices, *of_edges, *(k - 1 for k in of_edges)})
    if all(k in of_vertices for k in poses) and _ascend([of_vertices[k] for k in poses]):
        return {k: of_vertices[k] for k in poses}
    later = [of_edges[k] for k in poses[1:] if k in of_edges]
    if len(later) == len(poses) - 1 and len(later) > 1 and _ascend(later):
        return {poses[0]: 2.0 * later[0] - later[1], **dict(zip(poses[1:], later, strict=True))}
    warnings.append("the times of the poses do not ascend: each step is taken as one second")
    return {k: float(k) for k in poses}


def _ascend(times_s: list[float]) -> bool:
    return all(b > a for a, b in pairwise(times_s))


def _events(
    lines: list[Line], vehicle: str, times_s: Mapping[int, float], numbers: dict[str, float], warnings: list[str]
) -> Iterator[tuple[str, int, list[float]]]:
    left_out: dict[str, int] = {}
    for line, kind, _, names, values in lines:
        match, other = POSE.match(names[0]), POSE.match(names[-1])
        if kind == "VERTEX_XY":
            yield "beacon", line, [numbers.setdefault(names[0], float(len(numbers))), *values, np.nan]
        elif kind.endswith("PRIOR") or match is None or match[1] != vehicle or int(match[2]) not in times_s:
            continue
        elif kind == "VERTEX_SE2":
            if not np.isnan(values).all():
                yield "truth", line, [times_s[int(match[2])], *values]
        elif kind == "EDGE_SE2":
            if other is None or other[1] != vehicle or int(other[2]) != int(match[2]) + 1:
                left_out["loop closure"] = left_out.get("loop closure", 0) + 1
                continue
            dx, dy, turn = values[:3]
            turn = wrap_pi(turn)
            c, s = np.cos(0.5 * turn), np.sin(0.5 * turn)
            yield "odom", line, [times_s[int(other[2])], c * dx + s * dy, turn, c * dy - s * dx]
        elif other is not None:
            left_out["range between vehicles"] = left_out.get("range between vehicles", 0) + 1
        else:
            beacon, at_s = numbers.setdefault(names[1], float(len(numbers))), times_s[int(match[2])]
            if kind == "EDGE_RANGE":
                yield "range", line, [at_s, beacon, values[0]]
            else:
                yield "range", line, [at_s, beacon, float(np.hypot(values[0], values[1]))]
                yield "bearing", line, [at_s, beacon, float(np.arctan2(values[1], values[0]))]
    warnings += [f"{plural(count, what)} not used" for what, count in left_out.items()]


def pyfg_lines(run: RecordedRun, assumed: RecordingConfig, poses: FloatArray) -> list[str]:
    """The run as a graph: a pose at each time of a reading, odometry between them, ranges, surveyed landmarks.

    ``poses``: true x_m, y_m, heading_rad at each odometry time, NaN where not known, shape (n + 1, 3). The format knows
    no other values of vertices: an estimate in them would be the truth for every reader.
    """
    steps, seen = run.steps, run.readings.where(np.isfinite(run.readings.range_m))
    t = np.unique(np.concatenate([steps.times_s[:1], seen.times_s]))
    path = dead_reckoned(steps, (0.0, 0.0, 0.0))
    moved, vertices = (np.column_stack([np.interp(t, steps.times_s, c) for c in each.T]) for each in (path, poses))
    lines = [f"VERTEX_SE2 {t[k]:.9f} A{k} {x:.9f} {y:.9f} {h:.9f}" for k, (x, y, h) in enumerate(vertices.tolist())]
    places = {name: f"L{k}" for k, name in enumerate(run.beacon_ids)}
    for name, (x, y) in run.beacon_truth_m.items():
        if name in places:
            lines.append(f"VERTEX_XY {places[name]} {x:.9f} {y:.9f}")
    noise, prior = assumed.odometry, assumed.priors
    x, y, h = run.first_pose
    prior_m2, prior_rad2 = max(prior.pose_m, 1e-3) ** 2, max(prior.heading_rad, 1e-3) ** 2
    lines.append(
        f"VERTEX_SE2:PRIOR {t[0]:.9f} A0 {x:.9f} {y:.9f} {h:.9f} {prior_m2:.9g} 0 0 {prior_m2:.9g} 0 {prior_rad2:.9g}"
    )
    for k in range(len(t) - 1):
        d, turn = moved[k + 1, :2] - moved[k, :2], wrap_pi(moved[k + 1, 2] - moved[k, 2])
        c, s = np.cos(moved[k, 2]), np.sin(moved[k, 2])
        way_m, turned = float(np.hypot(*d)), abs(turn)
        along = noise.distance_per_sqrt_m**2 * way_m + noise.distance_per_sqrt_rad**2 * turned + 1e-8
        across = noise.lateral_per_sqrt_m**2 * way_m + 1e-8
        turning = noise.turn_per_sqrt_m**2 * way_m + noise.turn_per_sqrt_rad**2 * turned
        turning += noise.turn_per_sqrt_s**2 * (t[k + 1] - t[k]) + 1e-10
        lines.append(
            f"EDGE_SE2 {t[k + 1]:.9f} A{k} A{k + 1} {c * d[0] + s * d[1]:.9f} {c * d[1] - s * d[0]:.9f} {turn:.9f} "
            f"{along:.9g} 0 0 {across:.9g} 0 {turning:.9g}"
        )
    at = np.searchsorted(t, seen.times_s).tolist()
    for k, beacon, range_m in zip(at, seen.beacon.tolist(), seen.range_m.tolist(), strict=True):
        variance = assumed.radio.range_sigma_m**2 + (assumed.radio.range_sigma_per_m * range_m) ** 2
        lines.append(f"EDGE_RANGE {t[k]:.9f} A{k} {places[run.beacon_ids[beacon]]} {range_m:.9f} {variance:.9g}")
    return lines
