"""The MRCLAM sets of UTIAS: five robots with odometry and a camera that sees barcodes on landmarks and robots."""

import re
from pathlib import Path

import numpy as np

from ccatp.beacons.datasets.tables import (
    RadioDataError,
    Table,
    bridged,
    in_order,
    listed,
    names_of,
    plural,
    read_table,
    within,
    without_gaps_in_numbers,
)
from ccatp.beacons.datasets.truth import checked_heading, pose_of_truth
from ccatp.beacons.slam.recording import Readings, RecordedRun, ReferencePath, Steps

ROBOT_FILE = re.compile(r"Robot(\d+)_(Odometry|Measurement|Groundtruth)\.dat(\.gz)?$")
LAST_ROBOT_SUBJECT = 5  # subjects 1 to 5 are robots, those above it are landmarks (Leung et al., IJRR 2011)
ODOMETRY = ("time [s]", "forward velocity [m/s]", "angular velocity [rad/s]")
MEASUREMENT = ("time [s]", "barcode", "range [m]", "bearing [rad]")
REFERENCE = ("time [s]", "x [m]", "y [m]", "heading [rad]")


def read_mrclam(path: Path, robot: int | None) -> RecordedRun:
    """Read one robot's run.

    Args:
        path: the folder, or one of its ``RobotN_...`` files (which then names the robot); plain or gzipped.
        robot: number of the robot; the first that is there if ``None``.

    Raises:
        RadioDataError: there is no such robot, a file is missing or is not what it should be.
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
    return _run(folder, robot)


def robots_in(folder: Path) -> list[int]:
    """Numbers of the robots whose odometry is in the folder."""
    matches = (ROBOT_FILE.search(file.name) for file in folder.iterdir() if file.is_file())
    return sorted({int(match[1]) for match in matches if match and match[2] == "Odometry"})


def _file(folder: Path, name: str) -> Path | None:
    return next((file for file in (folder / name, folder / f"{name}.gz") if file.is_file()), None)


def _needed(folder: Path, name: str, what: str) -> Path:
    file = _file(folder, name)
    if file is None:
        raise RadioDataError(folder / name, f"no such file (nor gzipped): {what}")
    return file


def _run(folder: Path, robot: int) -> RecordedRun:
    warnings: list[str] = []
    odometry_file = _needed(folder, f"Robot{robot}_Odometry.dat", "the robot's odometry")
    steps = _steps(in_order(read_table(odometry_file, ODOMETRY), warnings))
    seen_file = _needed(folder, f"Robot{robot}_Measurement.dat", "what the robot saw")
    seen = in_order(read_table(seen_file, MEASUREMENT), warnings)
    span_s = (float(steps.times_s[0]), float(steps.times_s[-1]))
    rows = seen.values[within(seen.values[:, 0], span_s, "reading", warnings)]
    subjects = _subjects(folder, rows[:, 1], warnings)
    kept = subjects > LAST_ROBOT_SUBJECT
    if not kept.any():
        raise RadioDataError(seen_file, "no reading of a landmark within the time of the odometry")
    beacon_ids, beacon = names_of(subjects[kept])
    truth = _truth(folder, robot, steps, warnings)
    return RecordedRun(
        name=f"{folder.resolve().name} robot {robot}",
        kind="mrclam",
        steps=steps,
        readings=Readings(rows[kept, 0], beacon, rows[kept, 2], rows[kept, 3], np.full(int(kept.sum()), np.nan)),
        beacon_ids=beacon_ids,
        beacon_truth_m=_landmarks(folder, warnings),
        truth=truth,
        first_pose=pose_of_truth(truth, steps, warnings),
        warnings=tuple(warnings),
    )


def _steps(odometry: Table) -> Steps:
    t, speed, rate = odometry.values.T
    if len(t) < 3:
        raise RadioDataError(odometry.file, f"{len(t)} rows: too few for a run")
    interval_s = np.diff(t)
    later = interval_s > 0.0  # of rows with the same time the last one holds
    times = np.concatenate([t[:-1][later], t[-1:]])
    distance, turn = (speed[:-1] * interval_s)[later], (rate[:-1] * interval_s)[later]
    return bridged(Steps(times, distance, turn, np.zeros(len(distance))))


def _subjects(folder: Path, barcodes: np.ndarray, warnings: list[str]) -> np.ndarray:
    file = _needed(folder, "Barcodes.dat", "readings name barcodes, and it tells whose they are")
    table = read_table(file, ("subject", "barcode"))
    subject_of = {int(barcode): int(subject) for subject, barcode in table.values.tolist()}
    subjects = np.array([subject_of.get(int(code), 0) for code in barcodes.tolist()], dtype=np.float64)
    unknown = subjects == 0
    if unknown.any():
        codes = listed([str(int(code)) for code in np.unique(barcodes[unknown])])
        count = plural(int(unknown.sum()), "reading")
        warnings.append(f"{count} of barcodes that {file.name} does not list ({codes}), left out")
    return subjects


def _landmarks(folder: Path, warnings: list[str]) -> dict[str, tuple[float, float]]:
    file = _file(folder, "Landmark_Groundtruth.dat")
    if file is None:
        warnings.append("no Landmark_Groundtruth.dat: errors of the landmarks stay unknown")
        return {}
    table = without_gaps_in_numbers(read_table(file, ("subject", "x [m]", "y [m]"), more=True), warnings)
    return {str(int(row[0])): (row[1], row[2]) for row in table.values.tolist()}


def _truth(folder: Path, robot: int, steps: Steps, warnings: list[str]) -> ReferencePath | None:
    file = _file(folder, f"Robot{robot}_Groundtruth.dat")
    if file is None:
        return None
    t, x, y, heading = in_order(read_table(file, REFERENCE), warnings).values.T
    return checked_heading(ReferencePath(t, x, y, np.unwrap(heading)), steps, warnings)
