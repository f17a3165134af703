"""Recorded runs: Plaza (CMU), MRCLAM (UTIAS), Labyrinth (TU Chemnitz), and our own CSV with one event per line."""

import math
import re
from pathlib import Path

import numpy as np

from ccatp.beacons.datasets.tables import (
    MOST_DATA_BYTES,
    RadioDataError,
    Table,
    content_lines,
    is_number,
    listed,
    needed_of,
    plural,
    read_table,
    read_text,
    split_cells,
    tables_of,
    tagged_row,
    within,
)
from ccatp.beacons.datasets.trajectory import (
    at_antenna,
    bridged,
    checked_heading,
    pose_of_truth,
    steps_of_speeds,
    turning_factor,
)
from ccatp.beacons.estimation.recording import Readings, RecordedRun, ReferencePath, Steps
from ccatp.config.files import read_input
from ccatp.core import FloatArray

NO_RANGE = "no range within the time of the odometry"


def _truth(reference: Table | None, steps: Steps, warnings: list[str]) -> ReferencePath | None:
    """The trajectory from rows of time, x, y and heading; without headings if one is missing."""
    if reference is None:
        return None
    t, x, y, *more = reference.values.T
    heading = more[0] if more else np.full(len(t), np.nan)
    known = np.isfinite(heading)
    if known.any() and not known.all():
        warnings.append(reference.note(~known, "of truth without heading (the first here): no heading is used"))
    heading = np.unwrap(heading) if known.all() else np.full(len(t), np.nan)
    return checked_heading(ReferencePath(t, x, y, heading), steps, warnings)


def _run(
    name: str, kind: str, steps: Steps, received: FloatArray, places_m: dict[str, tuple[float, float]],
    truth: ReferencePath | None, warnings: list[str],
) -> RecordedRun:  # fmt: skip
    """``received``: time, number of the beacon, range and, optionally, bearing, shape (m, 3 or 4)."""
    ids, index = np.unique(received[:, 1].astype(np.int64), return_inverse=True)
    unknown = np.full(len(received), np.nan)
    bearing_rad = received[:, 3] if received.shape[1] > 3 else unknown
    readings = Readings(received[:, 0], index.astype(np.int64), received[:, 2], bearing_rad, unknown)
    first_pose, names = pose_of_truth(truth, steps, warnings), tuple(map(str, ids.tolist()))
    return RecordedRun(name, kind, steps, readings, names, places_m, truth, first_pose, tuple(warnings))


def _inside(file: Path, rows: FloatArray, steps: Steps, what: str, warnings: list[str]) -> FloatArray:
    """Rows within the time of the odometry. Raises RadioDataError: there are none."""
    rows = rows[within(rows[:, 0], steps.times_s, what, warnings)]
    if not len(rows):
        raise RadioDataError(file, NO_RANGE)
    return rows


def _plain_or_gzipped(folder: Path, name: str) -> Path | None:
    return next((file for file in (folder / name, folder / f"{name}.gz") if file.is_file()), None)


def _needed(folder: Path, name: str, what: str) -> Path:
    file = _plain_or_gzipped(folder, name)
    if file is None:
        raise RadioDataError(folder / name, f"no such file (nor gzipped): {what}")
    return file


PLAZA = {
    "DR": ("time [s]", "distance [m]", "turn [rad]"),
    "TD": ("time [s]", "sender", "beacon", "range [m]"),
    "GT": ("time [s]", "x [m]", "y [m]", "heading [rad]"),
    "TL": ("beacon", "x [m]", "y [m]"),
}
PLAZA_NEEDED = ("DR", "TD")
NESTED = ("cell", "struct", "object")  # MATLAB classes that can contain others without limit


def is_plaza(file: Path) -> bool:
    """Whether the name of the file is that of a Plaza set."""
    return file.suffix == ".mat" or any(f"_{kind}.txt" in file.name for kind in PLAZA)


def read_plaza(path: Path) -> RecordedRun:
    """Read a Plaza set (Djugash, Hamner, Roth, JFR 2009): odometry (DR), ranges (TD), beacons (TL) and truth (GT).

    ``path``: the ``.mat``; or one of the texts ``NAME_DR.txt``, ``NAME_TD.txt``, ``NAME_GT.txt``, ``NAME_TL.txt``
    (plain or gzipped; the last two are optional); or a folder with one set, of which a ``.mat`` is preferred. Raises
    RadioDataError: a file is missing or invalid.
    """
    file = _plaza_file(path) if path.is_dir() else path
    tables = _mat_tables(file) if file.suffix == ".mat" else _text_tables(file)
    warnings: list[str] = []
    odometry = tables["DR"].with_unknown_ways(warnings).in_order(warnings, 1)
    ranges = tables["TD"].in_order(warnings).values
    reference = tables["GT"].in_order(warnings) if "GT" in tables else None
    steps = _plaza_steps(file, odometry, None if reference is None else float(reference.values[0, 0]))
    ranges = _inside(file, ranges, steps, "range", warnings)
    truth = _truth(reference, steps, warnings)
    surveyed = tables["TL"].finite(warnings).values.tolist() if "TL" in tables else []
    places_m = {str(int(i)): (x, y) for i, x, y in surveyed}
    name = file.name.split(".")[0]
    for kind in PLAZA:
        name = name.removesuffix(f"_{kind}")
    return _run(name.rstrip("_"), "plaza", steps, ranges[:, [0, 2, 3]], places_m, truth, warnings)


def _plaza_file(folder: Path) -> Path:
    for pattern in ("*.mat", "*_DR.txt*"):
        files = sorted(folder.glob(pattern))
        if len(files) > 1:
            raise RadioDataError(folder, f"holds {len(files)} sets: name one, as in {folder / files[0].name}")
        if files:
            return files[0]
    raise RadioDataError(folder, "holds no Plaza set: neither NAME.mat nor NAME_DR.txt")


def _mat_tables(file: Path) -> dict[str, Table]:
    from scipy.io import loadmat, whosmat  # noqa: PLC0415 -- slow to import, and not needed for texts
    from scipy.io.matlab import MatReadError  # noqa: PLC0415

    try:
        read_input(file, MOST_DATA_BYTES)  # only to refuse a path that is not a file, or is too long
        for name, shape, form in whosmat(file):
            if name in PLAZA and (form in NESTED or math.prod(shape) > MOST_DATA_BYTES // 8):
                raise RadioDataError(file, f"variable {name} is no table of at most {MOST_DATA_BYTES} bytes")
        found = loadmat(file, variable_names=[*PLAZA])
    except FileNotFoundError as error:
        raise RadioDataError(file, "no such file") from error
    except (MatReadError, NotImplementedError, ValueError, TypeError, OSError, EOFError, IndexError) as error:
        raise RadioDataError(file, f"is no MATLAB file that can be read: {error}") from error
    tables: dict[str, Table] = {}
    for kind, columns in PLAZA.items():
        if kind not in found:
            if kind in PLAZA_NEEDED:
                raise RadioDataError(file, f"has no variable {kind} ({', '.join(columns)})")
            continue
        try:
            values = np.asarray(found[kind], dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise RadioDataError(file, f"variable {kind} does not hold numbers") from error
        if values.ndim != 2 or values.shape[1] != len(columns) or not len(values):
            wanted = f"(n, {len(columns)}): {', '.join(columns)}"
            raise RadioDataError(file, f"variable {kind} has shape {values.shape}, wanted {wanted}")
        tables[kind] = Table(Path(f"{file.name} {kind}"), values, np.arange(1, len(values) + 1))
    return tables


def _text_tables(file: Path) -> dict[str, Table]:
    kind = next((kind for kind in PLAZA if f"_{kind}.txt" in file.name), None)
    if kind is None:
        raise RadioDataError(file, "is no file of a Plaza set: those are NAME.mat, NAME_DR.txt, NAME_TD.txt")
    tables: dict[str, Table] = {}
    for other, columns in PLAZA.items():
        name = file.name.replace(f"_{kind}.txt", f"_{other}.txt").removesuffix(".gz")
        if other in PLAZA_NEEDED:
            _needed(file.parent, name, f"it goes with {file.name}")
        if there := _plain_or_gzipped(file.parent, name):
            tables[other] = read_table(there, columns)
    return tables


def _plaza_steps(file: Path, odometry: Table, truth_start_s: float | None) -> Steps:
    # Each row is the motion since the previous row; the first row that since the first pose of the truth.
    t, distance, turn = odometry.values.T
    odometry._replace(file=file).check_steps("odometry rows")
    usual_s = float(np.median(np.diff(t)))
    start_s = t[0] - usual_s
    if truth_start_s is not None and t[0] - 2.0 * usual_s < truth_start_s < t[0]:
        start_s = truth_start_s
    return bridged(Steps(np.concatenate([[start_s], t]), distance, turn, np.zeros(len(t))))


ROBOT_FILE = re.compile(r"Robot(\d+)_(Odometry|Measurement|Groundtruth)\.dat(\.gz)?$")
LAST_ROBOT_SUBJECT = 5  # subjects 1 to 5 are robots, those above it are landmarks (Leung et al., IJRR 2011)
ODOMETRY = ("time [s]", "forward velocity [m/s]", "angular velocity [rad/s]")
MEASUREMENT = ("time [s]", "barcode", "range [m]", "bearing [rad]")
REFERENCE = ("time [s]", "x [m]", "y [m]", "heading [rad]")


def robots_in(folder: Path) -> list[int]:
    """Numbers of the robots whose MRCLAM odometry is in the folder."""
    matches = (ROBOT_FILE.search(file.name) for file in folder.iterdir() if file.is_file())
    return sorted({int(match[1]) for match in matches if match and match[2] == "Odometry"})


def read_mrclam(path: Path, robot: int | None) -> RecordedRun:
    """Read the run of one robot: odometry, and ranges and bearings of a camera to barcodes on landmarks.

    ``path``: the folder, or one of its ``RobotN_...`` files (which then selects the robot); plain or gzipped.
    ``robot``: number of the robot; the lowest if ``None``. Raises RadioDataError: there is no such robot, or a file is
    missing or invalid.
    """
    folder = path
    if path.is_file():
        folder = path.parent
        if robot is None and (match := ROBOT_FILE.search(path.name)):
            robot = int(match[1])
    there = robots_in(folder)
    if not there:
        raise RadioDataError(folder, "holds no MRCLAM set: no file RobotN_Odometry.dat")
    robot = there[0] if robot is None else robot
    if robot not in there:
        raise RadioDataError(folder, f"has no odometry of robot {robot}; there are {listed([str(r) for r in there])}")
    warnings: list[str] = []
    odometry_file = _needed(folder, f"Robot{robot}_Odometry.dat", "the robot's odometry")
    odometry = read_table(odometry_file, ODOMETRY).in_order(warnings)
    odometry.check_steps("rows")
    t, speed, rate = odometry.values.T
    steps = steps_of_speeds(t, speed, rate, np.zeros(len(t)))
    seen_file = _needed(folder, f"Robot{robot}_Measurement.dat", "what the robot saw")
    seen = read_table(seen_file, MEASUREMENT).in_order(warnings).values
    seen = seen[within(seen[:, 0], steps.times_s, "reading", warnings)]
    subjects = _subjects(folder, seen[:, 1], warnings)
    kept = subjects > LAST_ROBOT_SUBJECT
    if not kept.any():
        raise RadioDataError(seen_file, "no reading of a landmark within the time of the odometry")
    reference = _plain_or_gzipped(folder, f"Robot{robot}_Groundtruth.dat")
    rows = None if reference is None else read_table(reference, REFERENCE).in_order(warnings)
    truth = _truth(rows, steps, warnings)
    places_m = _landmarks(folder, warnings)
    received = np.column_stack([seen[:, 0], subjects, seen[:, 2:]])[kept]
    return _run(f"{folder.resolve().name} robot {robot}", "mrclam", steps, received, places_m, truth, warnings)


def _subjects(folder: Path, barcodes: FloatArray, warnings: list[str]) -> FloatArray:
    """Subject of each reading, 0 if the barcode is not listed; shape (m,)."""
    file = _needed(folder, "Barcodes.dat", "readings name barcodes, and it says whose they are")
    table = read_table(file, ("subject", "barcode"))
    subject_of = {int(barcode): int(subject) for subject, barcode in table.values.tolist()}
    subjects = np.array([subject_of.get(int(code), 0) for code in barcodes.tolist()], dtype=np.float64)
    unknown = subjects == 0
    if unknown.any():
        codes = listed([str(int(code)) for code in np.unique(barcodes[unknown])])
        count = plural(int(unknown.sum()), "reading")
        warnings.append(f"{count} of barcodes that {file.name} does not list ({codes}), not used")
    return subjects


def _landmarks(folder: Path, warnings: list[str]) -> dict[str, tuple[float, float]]:
    file = _plain_or_gzipped(folder, "Landmark_Groundtruth.dat")
    if file is None:
        warnings.append("no Landmark_Groundtruth.dat: errors of the landmarks stay unknown")
        return {}
    table = read_table(file, ("subject", "x [m]", "y [m]"), more=True).finite(warnings)
    return {str(int(row[0])): (row[1], row[2]) for row in table.values.tolist()}


TRACK_WARNING = 0.2
# The readme of the set calls the columns right wheel, left wheel and distance between the wheels. The data show that
# they are left wheel, right wheel and half that distance (see ``_wheel_columns``).
LABYRINTH = {
    "range2": ("time [s]", "range [m]", "sigma [m]", "anchor x [m]", "anchor y [m]", "anchor"),
    "odom2diff": (
        "time [s]", "speed of the left wheel [m/s]", "speed of the right wheel [m/s]", "speed sideways [m/s]",
        "half the track [m]", "sigma left [m/s]", "sigma right [m/s]", "sigma sideways [m/s]",
    ),
    "gt2": ("time [s]", "x [m]", "y [m]"),
}  # fmt: skip


def is_labyrinth(text: str) -> bool:
    """Whether the first line of a text is of the Labyrinth set."""
    lines = content_lines(text[:4096])
    return bool(lines) and lines[0][1].split()[0] in LABYRINTH


def read_labyrinth(path: Path) -> RecordedRun:
    """Read a Labyrinth text, plain or gzipped: a line is a UWB range, wheel speeds, or a true position.

    Raises RadioDataError: a line has another form, or there is no odometry or no range.
    """
    file = _labyrinth_file(path) if path.is_dir() else path
    warnings: list[str] = []
    lines = content_lines(read_text(file))
    rows = (tagged_row(file, line, content.split(), LABYRINTH, {}) for line, content in lines)
    tables = {kind: table.in_order(warnings) for kind, table in tables_of(file, rows).items()}
    for kind in ("odom2diff", "range2"):
        if kind not in tables:
            raise RadioDataError(file, f"no line {kind} ({', '.join(LABYRINTH[kind])})")
    odometry = tables["odom2diff"]
    odometry.check_steps("lines odom2diff")
    t, left, right, side, half_track = odometry.values[:, :5].T
    if (half_track <= 0.0).any():
        line = int(odometry.lines[half_track <= 0.0][0])
        raise RadioDataError(file, "the distance between the wheels is not positive", line)
    steps = steps_of_speeds(t, 0.5 * (left + right), (right - left) / (2.0 * half_track), side)
    ranges = _inside(file, tables["range2"].values, steps, "range", warnings)
    truth = _truth(tables.get("gt2"), steps, warnings)
    if truth is not None:
        warnings += _wheel_columns(truth, steps, float(np.median(half_track)))
    places_m = {}
    for anchor in np.unique(ranges[:, 5]):
        x_m, y_m = np.median(ranges[ranges[:, 5] == anchor, 3:5], axis=0).tolist()
        places_m[str(int(anchor))] = (x_m, y_m)
    return _run(file.name.split(".")[0], "labyrinth", steps, ranges[:, [0, 5, 1]], places_m, truth, warnings)


def _wheel_columns(truth: ReferencePath, steps: Steps, half_track_m: float) -> list[str]:
    """Check, by the truth, that the wheel columns are left, right, half the track; empty if the truth cannot decide."""
    factor = turning_factor(truth, steps)
    if factor is None:
        return []
    order, read_m = "left, right" if factor > 0.0 else "right, left", 2.0 * half_track_m
    track_m = read_m / abs(factor)
    found = f"wheel columns by the shape of the true path: {order}, track {track_m:.3f} m"
    if factor > 0.0 and abs(factor - 1.0) < TRACK_WARNING:
        return [f"{found} (the readme says right, left and {half_track_m:.4f} m); read as left, right, {read_m:.4f} m"]
    return [f"{found}; they were read as left, right and {read_m:.4f} m, so that the odometry is wrong"]


def _labyrinth_file(folder: Path) -> Path:
    files = [file for file in sorted(folder.glob("*.txt*")) if is_labyrinth(read_text(file))]
    if len(files) != 1:
        what = f"holds {len(files)} Labyrinth texts: name one" if files else "holds no Labyrinth text"
        raise RadioDataError(folder, what)
    return files[0]


# Columns after the name of the event; see docs/radio_data.md.
EVENTS = {
    "odom": ("time_s", "distance_m", "turn_rad", "(lateral_m)"),
    "range": ("time_s", "beacon", "range_m"),
    "bearing": ("time_s", "beacon", "bearing_rad"),
    "rssi": ("time_s", "beacon", "rssi_dbm"),
    "truth": ("time_s", "x_m", "y_m", "(heading_rad)"),
    "beacon": ("beacon", "x_m", "y_m", "(z_m)"),
    "antenna": ("forward_m", "left_m", "(up_m)"),
}
READING_KINDS = ("range", "bearing", "rssi")
HEADER = "event"


def is_events_csv(text: str) -> bool:
    """Whether the first line of a text is an event or the header, or the second line, if the first has only words."""
    lines = [split_cells(content) for _, content in content_lines(text[:4096])[:2]]
    if lines and not any(is_number(cell) for cell in lines[0]):
        return any(cells[0] in (*EVENTS, HEADER) for cells in lines)
    return bool(lines) and lines[0][0] in EVENTS


def read_events_csv(file: Path) -> RecordedRun:
    """Read a run from a CSV of events (docs/radio_data.md), plain or gzipped.

    Raises RadioDataError: a line is not an event, or there is no odometry or no reading of a beacon.
    """
    if file.is_dir():
        raise RadioDataError(file, "is a folder: name the CSV file in it")
    numbers: dict[str, float] = {}
    rows: list[tuple[str, int, list[float]]] = []
    for line, content in content_lines(read_text(file)):
        cells = split_cells(content)
        is_head = not rows and cells[0] not in EVENTS and not any(is_number(cell) for cell in cells[1:])
        if cells[0] != HEADER and not is_head:
            rows.append(tagged_row(file, line, cells, EVENTS, numbers))
    return run_of_events(file, tables_of(file, rows), tuple(numbers))


def run_of_events(file: Path, tables: dict[str, Table], names: tuple[str, ...]) -> RecordedRun:
    """A run from a table for each kind of event; ``names``: of the beacons, which the tables give as indices.

    The path is that of the antenna. Raises RadioDataError: there is no odometry or no reading of a beacon.
    """
    warnings: list[str] = []
    surveyed, mounted = tables.pop("beacon", None), tables.pop("antenna", None)
    if "odom" in tables:
        tables["odom"] = tables["odom"].with_unknown_ways(warnings)
    needed = {kind: 1 if kind == "odom" else needed_of(columns) for kind, columns in EVENTS.items()}
    tables = {kind: table.in_order(warnings, needed[kind]) for kind, table in tables.items()}
    if "odom" not in tables:
        raise RadioDataError(file, f"no event odom ({', '.join(EVENTS['odom'])})")
    if not any(kind in tables for kind in READING_KINDS):
        raise RadioDataError(file, f"no readings of beacons: no event {', '.join(READING_KINDS)}")
    steps = _event_steps(tables["odom"])
    readings, beacon_ids = _merged(tables, steps, names, warnings)
    if not beacon_ids:
        raise RadioDataError(file, "no readings of beacons within the time of the odometry")
    truth = _truth(tables.get("truth"), steps, warnings)
    places_m: dict[str, tuple[float, float]] = {}
    heights_m: dict[str, float] = {}
    if surveyed is not None:
        for line, (index, x_m, y_m, z_m) in zip(surveyed.lines.tolist(), surveyed.values.tolist(), strict=True):
            name = names[int(index)]
            if places_m.setdefault(name, (x_m, y_m)) != (x_m, y_m):
                raise RadioDataError(file, f"beacon {name} was surveyed at another place before", line)
            heights_m[name] = z_m
    first_pose, name = pose_of_truth(truth, steps, warnings), file.name.split(".")[0]
    ahead_m, left_m, up_m = _antenna(mounted)
    above_m = np.array([heights_m.get(beacon, np.nan) - up_m for beacon in beacon_ids])
    readings = _in_the_plane(readings, np.nan_to_num(above_m), warnings)
    if ahead_m or left_m:
        steps, truth, first_pose = at_antenna(steps, truth, first_pose, (ahead_m, left_m), warnings)
    return RecordedRun(
        name, "csv", steps, readings, beacon_ids, places_m, truth, first_pose, tuple(warnings), (ahead_m, left_m)
    )


def _antenna(mounted: Table | None) -> tuple[float, float, float]:
    if mounted is None:
        return 0.0, 0.0, 0.0
    if len(mounted.values) > 1 or not np.isfinite(mounted.values[0, :2]).all():
        raise RadioDataError(mounted.file, "more than one antenna, or one at no place", int(mounted.lines[-1]))
    ahead_m, left_m, up_m = np.nan_to_num(mounted.values[0]).tolist()
    return ahead_m, left_m, up_m


def _in_the_plane(readings: Readings, above_m: FloatArray, warnings: list[str]) -> Readings:
    """Ranges projected to the plane. ``above_m``: height of each beacon above the antenna, shape (b,)."""
    squares = readings.range_m**2 - above_m[readings.beacon] ** 2
    if (short := (squares < 0.0) & (readings.range_m > 0.0)).any():
        warnings.append(f"{plural(int(short.sum()), 'range')} shorter than the beacon is above the antenna, not used")
        readings = readings.where(~short)
        squares = squares[~short]
    level_m = np.where(above_m[readings.beacon] == 0.0, readings.range_m, np.sqrt(np.maximum(squares, 0.0)))
    return readings._replace(range_m=level_m)


def _event_steps(odometry: Table) -> Steps:
    # Each row is the motion since the previous row; only the time of the first row is used.
    t, distance, turn, lateral = odometry.values.T
    odometry.check_steps("events odom")
    if (np.diff(t) <= 0.0).any():
        line = int(odometry.lines[1:][np.diff(t) <= 0.0][0])
        raise RadioDataError(odometry.file, "two events odom at the same time say different things", line)
    return bridged(Steps(t, distance[1:], turn[1:], lateral[1:]))


def _merged(
    tables: dict[str, Table], steps: Steps, names: tuple[str, ...], warnings: list[str]
) -> tuple[Readings, tuple[str, ...]]:
    """Readings with range, bearing and strength of one beacon at one time in one row, and the names of the beacons."""
    merged: dict[tuple[float, float], list[float]] = {}
    extra: list[tuple[float, float, list[float]]] = []
    for place, kind in enumerate(READING_KINDS):
        if kind not in tables:
            continue
        values = tables[kind].values
        for t, who, value in values[within(values[:, 0], steps.times_s, kind, warnings)].tolist():
            row = merged.setdefault((t, who), [np.nan] * len(READING_KINDS))
            if np.isnan(row[place]):
                row[place] = value
            else:  # a second value of this kind at the same time
                extra.append((t, who, [value if k == place else np.nan for k in range(len(READING_KINDS))]))
    rows = sorted([(t, who, row) for (t, who), row in merged.items()] + extra, key=lambda item: item[:2])
    beacons, index = np.unique([int(who) for _, who, _ in rows], return_inverse=True)
    data = np.array([row for _, _, row in rows]).reshape(-1, len(READING_KINDS))
    readings = Readings(np.array([t for t, _, _ in rows]), index.astype(np.int64), *data.T.copy())
    return readings, tuple(names[int(who)] for who in beacons)
