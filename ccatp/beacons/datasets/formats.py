"""Published sets of recorded runs: Plaza (CMU), MRCLAM (UTIAS), Labyrinth (TU Chemnitz)."""

import math
import re
from pathlib import Path

import numpy as np

from ccatp.beacons.datasets.events import Recording, name_of, numbered, surveyed
from ccatp.beacons.datasets.tables import (
    MOST_DATA_BYTES,
    RadioDataError,
    Table,
    content_lines,
    plural,
    read_table,
    read_text,
    tables_of,
    tagged_row,
)
from ccatp.config.files import read_input
from ccatp.core import FloatArray
from ccatp.errors import listed


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


def is_plaza(path: Path) -> bool:
    """Whether a file has the name of one of a Plaza set, or a folder has the files of one."""
    if not path.is_dir():
        return path.suffix == ".mat" or any(f"_{kind}.txt" in path.name for kind in PLAZA)
    if any(_has_tables(file) for file in path.glob("*.mat")):
        return True
    names = {file.name.removesuffix(".gz") for file in path.glob("*.txt*")}
    return any(name.replace("_DR.txt", "_TD.txt") in names for name in names if name.endswith("_DR.txt"))


def _has_tables(file: Path) -> bool:
    from scipy.io import whosmat  # noqa: PLC0415 -- slow to import, and not needed for texts

    try:
        return {name for name, *_ in whosmat(file)} >= {*PLAZA_NEEDED}
    except _mat_errors():
        return False


def _mat_errors() -> tuple[type[Exception], ...]:
    """What scipy raises for a file of another kind."""
    from scipy.io.matlab import MatReadError  # noqa: PLC0415

    return MatReadError, NotImplementedError, ValueError, TypeError, OSError, EOFError, IndexError


def read_plaza(path: Path) -> Recording:
    """Read a Plaza set (Djugash, Hamner, Roth, JFR 2009): odometry (DR), ranges (TD), beacons (TL) and truth (GT).

    ``path``: the ``.mat``; or one of the texts ``NAME_DR.txt``, ``NAME_TD.txt``, ``NAME_GT.txt``, ``NAME_TL.txt``
    (plain or gzipped; the last two are optional); or a folder with one set, of which a ``.mat`` is preferred. Raises
    RadioDataError: a file is missing or invalid.
    """
    file = _plaza_file(path) if path.is_dir() else path
    tables = _mat_tables(file) if file.suffix == ".mat" else _text_tables(file)
    names, readings = numbered(tables["TD"], 2, (3,))
    events = {"odom": _plaza_odometry(tables["DR"], tables.get("GT")), "range": readings[3]}
    if "GT" in tables:
        events["truth"] = tables["GT"]
    if "TL" in tables:
        names, events["beacon"] = surveyed(tables["TL"], names)
    name = name_of(file)
    for kind in PLAZA:
        name = name.removesuffix(f"_{kind}")
    return Recording(file, name.rstrip("_"), "plaza", events, names)


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

    try:
        read_input(file, MOST_DATA_BYTES)  # only to refuse a path that is not a file, or is too long
        for name, shape, form in whosmat(file):
            if name in PLAZA and (form in NESTED or math.prod(shape) > MOST_DATA_BYTES // 8):
                raise RadioDataError(file, f"variable {name} is no table of at most {MOST_DATA_BYTES} bytes")
        found = loadmat(file, variable_names=[*PLAZA])
    except FileNotFoundError as error:
        raise RadioDataError(file, "no such file") from error
    except _mat_errors() as error:
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


def _plaza_odometry(odometry: Table, truth: Table | None) -> Table:
    # Each row is the motion since the previous row; the first row that since the first pose of the truth.
    file, values, lines = odometry
    t = values[np.isfinite(values[:, 0]), 0]
    if t.size < 2:
        return Table(file, np.column_stack([values, np.zeros(len(values))]), lines)
    usual_s = float(np.median(np.diff(t)))
    start_s = t[0] - usual_s
    if truth is not None and t[0] - 2.0 * usual_s < truth.values[0, 0] < t[0]:
        start_s = truth.values[0, 0]
    rows = np.vstack([[start_s, 0.0, 0.0], values])
    return Table(file, np.column_stack([rows, np.zeros(len(rows))]), np.concatenate([lines[:1], lines]))


ROBOT_FILE = re.compile(r"Robot(\d+)_(Odometry|Measurement|Groundtruth)\.dat(\.gz)?$")
LAST_ROBOT_SUBJECT = 5  # subjects 1 to 5 are robots, those above it are landmarks (Leung et al., IJRR 2011)
ODOMETRY = ("time [s]", "forward velocity [m/s]", "angular velocity [rad/s]")
MEASUREMENT = ("time [s]", "barcode", "range [m]", "bearing [rad]")
REFERENCE = ("time [s]", "x [m]", "y [m]", "heading [rad]")


def robots_in(folder: Path) -> list[int]:
    """Numbers of the robots whose MRCLAM odometry is in the folder."""
    matches = (ROBOT_FILE.search(file.name) for file in folder.iterdir() if file.is_file())
    return sorted({int(match[1]) for match in matches if match and match[2] == "Odometry"})


def read_mrclam(path: Path, robot: int | None) -> Recording:
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
    odometry = read_table(_needed(folder, f"Robot{robot}_Odometry.dat", "the robot's odometry"), ODOMETRY)
    seen_file = _needed(folder, f"Robot{robot}_Measurement.dat", "what the robot saw")
    seen = read_table(seen_file, MEASUREMENT).finite(warnings)
    subjects = _subjects(folder, seen.values[:, 1], warnings)
    kept = subjects > LAST_ROBOT_SUBJECT
    if not kept.any():
        raise RadioDataError(seen_file, "no reading of a landmark")
    seen.values[:, 1] = subjects
    names, readings = numbered(seen.where(kept), 1, (2, 3))
    nothing_sideways = np.column_stack([odometry.values, np.zeros(len(odometry.values))])
    events = {"speed": odometry._replace(values=nothing_sideways), "range": readings[2], "bearing": readings[3]}
    if reference := _plain_or_gzipped(folder, f"Robot{robot}_Groundtruth.dat"):
        events["truth"] = read_table(reference, REFERENCE)
    if landmarks := _landmarks(folder, warnings):
        names, events["beacon"] = surveyed(landmarks, names)
    name = f"{folder.resolve().name} robot {robot}"
    return Recording(seen_file, name, "mrclam", events, names, tuple(warnings))


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


def _landmarks(folder: Path, warnings: list[str]) -> Table | None:
    file = _plain_or_gzipped(folder, "Landmark_Groundtruth.dat")
    if file is None:
        warnings.append("no Landmark_Groundtruth.dat: errors of the landmarks stay unknown")
        return None
    table = read_table(file, ("subject", "x [m]", "y [m]"), more=True).finite(warnings)
    return table._replace(values=table.values[:, :3])


# The readme of the set calls the columns right wheel, left wheel and distance between the wheels. The data show that
# they are left wheel, right wheel and half that distance.
LABYRINTH = {
    "range2": ("time [s]", "range [m]", "sigma [m]", "anchor x [m]", "anchor y [m]", "anchor", "(signal)"),
    "odom2diff": (
        "time [s]", "speed of the left wheel [m/s]", "speed of the right wheel [m/s]", "speed sideways [m/s]",
        "half the track [m]", "sigma left [m/s]", "sigma right [m/s]", "sigma sideways [m/s]",
    ),
    "gt2": ("time [s]", "x [m]", "y [m]"),
    "point2": ("time [s]", "x [m]", "y [m]", "(xx)", "(xy)", "(yx)", "(yy)"),  # the truth, in the present edition
}  # fmt: skip
INPUT, TRUTH = "_Input", "_GT"  # in the names of the two files of the present edition


def is_labyrinth(text: str) -> bool:
    """Whether the first line of a text is of the Labyrinth set."""
    lines = content_lines(text[:4096])
    return bool(lines) and lines[0][1].split()[0] in LABYRINTH


def read_labyrinth(path: Path) -> Recording:
    """Read a Labyrinth set, plain or gzipped: a line is a UWB range, wheel speeds, or a true position.

    ``path``: the text; or ``NAME_Input.txt`` of the present edition, which has the truth in ``NAME_GT.txt``; or the
    folder. Raises RadioDataError: a line has another form, or there is no odometry or no range.
    """
    file = _labyrinth_file(path) if path.is_dir() else path
    reference = file.with_name(file.name.replace(INPUT, TRUTH))
    tables = _labyrinth_tables(file)
    if not {"odom2diff", "range2"} & tables.keys():
        raise RadioDataError(
            file, "has only the truth of a Labyrinth set: name the file with the ranges, or the folder"
        )
    if reference != file and reference.is_file():
        tables = _labyrinth_tables(reference) | tables
    for kind in ("odom2diff", "range2"):
        if kind not in tables:
            raise RadioDataError(file, f"no line {kind} ({', '.join(LABYRINTH[kind])})")
    odometry, ranges = tables["odom2diff"], tables["range2"]
    t, left, right, side, half_track = odometry.values[:, :5].T
    if (half_track <= 0.0).any():
        line = int(odometry.lines[half_track <= 0.0][0])
        raise RadioDataError(file, "the distance between the wheels is not positive", line)
    speeds = np.column_stack([t, 0.5 * (left + right), (right - left) / (2.0 * half_track), side])
    track_m = 2.0 * float(np.median(half_track))
    warnings = [
        f"wheel columns are read as left, right and half the track of {track_m:.4g} m; the readme says otherwise"
    ]
    ranges = ranges._replace(values=ranges.values[:, :6]).finite(warnings)
    names, readings = numbered(ranges, 5, (1,))
    events = {"speed": odometry._replace(values=speeds), "range": readings[1]}
    if truth := tables.get("gt2", tables.get("point2")):
        unknown = np.full(len(truth.values), np.nan)
        events["truth"] = truth._replace(values=np.column_stack([truth.values[:, :3], unknown]))
    places = np.array([np.median(ranges.values[ranges.values[:, 5] == float(one), 3:5], axis=0) for one in names])
    rows = np.column_stack([np.arange(len(names)), places, np.full(len(names), np.nan)])
    events["beacon"] = Table(file, rows, np.zeros(len(rows), dtype=np.int64))
    name = name_of(file).removesuffix(INPUT)
    return Recording(file, name, "labyrinth", events, names, tuple(warnings))


def _labyrinth_tables(file: Path) -> dict[str, Table]:
    lines = content_lines(read_text(file))
    return tables_of(file, (tagged_row(file, line, content.split(), LABYRINTH, {}) for line, content in lines))


def _labyrinth_file(folder: Path) -> Path:
    files = [file for file in sorted(folder.glob("*.txt*")) if is_labyrinth(read_text(file))]
    files = [file for file in files if TRUTH not in file.name or len(files) == 1]
    if len(files) != 1:
        what = f"holds {len(files)} Labyrinth texts: name one" if files else "holds no Labyrinth text"
        raise RadioDataError(folder, what)
    return files[0]
