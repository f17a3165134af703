"""Simulated runs among beacons, and the files that each format would have of them."""

import gzip
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy.io

from ccatp.beacons.estimation.recording import Readings, RecordedRun, ReferencePath, Steps, dead_reckoned

FloatArray = npt.NDArray[np.float64]
BEACONS = {"6": (0.5, 4.0), "7": (7.5, 5.5), "8": (6.0, -1.0), "9": (-1.0, -0.5)}


@dataclass(frozen=True)
class World:
    """A true run and what was measured on it."""

    times_s: FloatArray
    poses: FloatArray
    distance_m: FloatArray
    turn_rad: FloatArray
    read_s: FloatArray
    read_beacon: npt.NDArray[np.int64]
    range_m: FloatArray
    bearing_rad: FloatArray


def world(
    seed: int = 1,
    seconds: float = 60.0,
    rate_hz: float = 10.0,
    range_sigma_m: float = 0.05,
    bearing_sigma_rad: float = 0.02,
    beacons: Mapping[str, tuple[float, float]] = BEACONS,
) -> World:
    """A vehicle that wanders through a room of 8 m by 5 m; odometry is exact, readings come at 5 Hz."""
    rng = np.random.default_rng(seed)
    n = int(seconds * rate_hz)
    t = np.arange(n + 1) / rate_hz
    turn = (0.35 + 0.3 * np.sin(0.11 * t[:-1]) - 0.25 * np.cos(0.31 * t[:-1])) / rate_hz
    distance = np.full(n, 0.5 / rate_hz) * (1.0 + 0.3 * np.sin(0.07 * t[:-1]))
    poses = dead_reckoned(Steps(t, distance, turn, np.zeros(n)), (3.0, 1.0, 0.4))
    read_s = np.arange(1, int(seconds * 5.0)) / 5.0 - 0.03
    x, y, heading = (np.interp(read_s, t, poses[:, k]) for k in range(3))
    beacon = np.arange(read_s.size) % len(beacons)
    places = np.array(list(beacons.values()))[beacon]
    dx, dy = places[:, 0] - x, places[:, 1] - y
    ranges = np.hypot(dx, dy) + range_sigma_m * rng.standard_normal(read_s.size)
    bearings = np.arctan2(dy, dx) - heading + bearing_sigma_rad * rng.standard_normal(read_s.size)
    bearings = (bearings + np.pi) % (2.0 * np.pi) - np.pi
    return World(t, poses, distance, turn, read_s, beacon, ranges, bearings)


def recorded(w: World, *, bearings: bool = True) -> RecordedRun:
    """The run as a loader would give it."""
    nothing = np.full(w.read_s.size, np.nan)
    x, y, heading = w.poses[0].tolist()
    return RecordedRun(
        name="simulated",
        kind="csv",
        steps=Steps(w.times_s, w.distance_m, w.turn_rad, np.zeros(w.distance_m.size)),
        readings=Readings(w.read_s, w.read_beacon, w.range_m, w.bearing_rad if bearings else nothing, nothing.copy()),
        beacon_ids=tuple(BEACONS),
        beacon_truth_m=dict(BEACONS),
        truth=ReferencePath(w.times_s, *w.poses.T),
        first_pose=(x, y, heading),
        warnings=(),
    )


def write_plaza(folder: Path, w: World, name: str = "Field1", *, mat: bool = True) -> Path:
    """``NAME.mat``, or the four texts (the last two only of what they are given)."""
    tables = plaza_tables(w)
    if mat:
        file = folder / f"{name}.mat"
        scipy.io.savemat(file, tables)
        return file
    for kind, table in tables.items():
        np.savetxt(folder / f"{name}_{kind}.txt", table, fmt="%.15e", delimiter="\t")
    return folder / f"{name}_DR.txt"


def plaza_tables(w: World) -> dict[str, FloatArray]:
    """The variables of a Plaza set."""
    ids = np.array([float(name) for name in BEACONS])
    return {
        "GT": np.column_stack([w.times_s, w.poses]),
        "DR": np.column_stack([w.times_s[1:], w.distance_m, w.turn_rad]),
        "TD": np.column_stack([w.read_s, np.full(w.read_s.size, 2.0), ids[w.read_beacon], w.range_m]),
        "TL": np.column_stack([ids, np.array(list(BEACONS.values()))]),
    }


HEAD = "# UTIAS Multi-Robot Cooperative Localization and Mapping Dataset\n# columns\n"


def write_mrclam(folder: Path, w: World, robot: int = 1, *, packed: bool = False) -> Path:
    """A folder with one robot; barcodes are ten times the subjects."""
    rate = np.diff(w.times_s)
    odometry = np.column_stack([w.times_s, np.append(w.distance_m / rate, 0.0), np.append(w.turn_rad / rate, 0.0)])
    codes = np.array([10.0 * float(name) for name in BEACONS])[w.read_beacon]
    seen = np.column_stack([w.read_s, codes, w.range_m, w.bearing_rad])
    truth = np.column_stack([w.times_s, w.poses[:, :2], (w.poses[:, 2] + np.pi) % (2.0 * np.pi) - np.pi])
    subjects = [*range(1, 6), *(int(name) for name in BEACONS)]
    texts = {
        f"Robot{robot}_Odometry.dat": _text(odometry),
        f"Robot{robot}_Measurement.dat": _text(seen),
        f"Robot{robot}_Groundtruth.dat": _text(truth),
        "Barcodes.dat": HEAD + "".join(f"{s:3d}\t{10 * s:4d}\n" for s in subjects),
        "Landmark_Groundtruth.dat": HEAD
        + "".join(f"{name} {x} {y} 0.0001 0.0002\n" for name, (x, y) in BEACONS.items()),
    }
    for name, text in texts.items():
        if packed and name.startswith("Robot"):
            (folder / f"{name}.gz").write_bytes(gzip.compress(text.encode()))
        else:
            (folder / name).write_text(text, encoding="utf-8")
    return folder


def _text(rows: FloatArray) -> str:
    return HEAD + "".join(" \t ".join(f"{value:.9f}" for value in row) + "\n" for row in rows.tolist())


def labyrinth_lines(w: World, *, exchanged: bool = False) -> list[str]:
    """The lines of a Labyrinth text: left and right wheel, half of a track of 0.3 m."""
    rate = np.diff(w.times_s)
    speed, turn = w.distance_m / rate, w.turn_rad / rate
    left, right = speed - 0.15 * turn, speed + 0.15 * turn
    if exchanged:
        left, right = right, left
    lines = []
    for k, t in enumerate(w.times_s.tolist()):
        j = min(k, len(left) - 1)
        lines.append((t, f"odom2diff {t} {left[j]:.9f} {right[j]:.9f} 0 0.15 0.01 0.01 0.01"))
        lines.append((t, f"gt2 {t} {w.poses[k, 0]:.9f} {w.poses[k, 1]:.9f}     "))
    names = list(BEACONS)
    for t, b, r in zip(w.read_s.tolist(), w.read_beacon.tolist(), w.range_m.tolist(), strict=True):
        x, y = BEACONS[names[b]]
        lines.append((t, f"range2 {t} {r:.9f} 0.1 {x} {y} {names[b]}  "))
    return [line for _, line in sorted(lines, key=lambda pair: pair[0])]


def csv_lines(w: World) -> list[str]:
    """The events of our own CSV."""
    names = list(BEACONS)
    lines = ["# a simulated run", "event,time_s,..."]
    lines += [f"beacon,{name},{x},{y}" for name, (x, y) in BEACONS.items()]
    lines.append(f"odom,{w.times_s[0]},0,0")
    lines += [f"odom,{t},{d},{a}" for t, d, a in zip(w.times_s[1:], w.distance_m, w.turn_rad, strict=True)]
    lines += [f"truth,{t},{x},{y},{h}" for t, (x, y, h) in zip(w.times_s, w.poses.tolist(), strict=True)]
    for t, b, r, a in zip(w.read_s, w.read_beacon.tolist(), w.range_m, w.bearing_rad, strict=True):
        lines += [f"range,{t},{names[b]},{r}", f"bearing,{t},{names[b]},{a}"]
    return lines


def write_lines(file: Path, lines: list[str]) -> Path:
    """A text of lines."""
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def changed(w: World, **values: FloatArray) -> World:
    """The same run, some of it measured otherwise."""
    return replace(w, **values)  # type: ignore[arg-type]  # none of them is read_beacon
