"""Reads a recorded run of any format: detects the format, rejects impossible values, and warns of suspicious ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ccatp.beacons.datasets.checks import suspicions
from ccatp.beacons.datasets.formats import (
    ROBOT_FILE,
    is_events_csv,
    is_labyrinth,
    is_plaza,
    read_events_csv,
    read_labyrinth,
    read_mrclam,
    read_plaza,
    robots_in,
)
from ccatp.beacons.datasets.ros_bags import SUFFIXES as BAGS
from ccatp.beacons.datasets.ros_bags import read_bag
from ccatp.beacons.datasets.tables import RadioDataError, content_lines, plural, read_text
from ccatp.beacons.estimation.recording import RecordedRun
from ccatp.core import FloatArray

LEAST_TRUTH = 2  # rows; a single position fits any path
READERS = {"plaza": read_plaza, "labyrinth": read_labyrinth, "csv": read_events_csv}
FORMATS = ("plaza", "mrclam", "labyrinth", "csv", "bag")


def read_run(path: Path, data_format: str | None, robot: int | None, topics_file: Path | None = None) -> RecordedRun:
    """Read and check a recorded run.

    ``data_format``: one of ``FORMATS``; detected from the files if ``None``. ``topics_file``: only for a bag. Raises
    RadioDataError: it cannot be read, or does not have the format.
    """
    data_format = found_format(path, data_format)
    if robot is not None and data_format != "mrclam":
        raise RadioDataError(path, f"a {data_format} set has one vehicle: leave out --robot")
    with np.errstate(all="ignore"):  # numbers that overflow are refused below
        if data_format == "mrclam":
            return checked_run(read_mrclam(path, robot), path)
        return checked_run(read_bag(path, topics_file) if data_format == "bag" else READERS[data_format](path), path)


def checked_run(run: RecordedRun, path: Path) -> RecordedRun:
    """The run without impossible values, with warnings of suspicious ones. Raises RadioDataError: nothing is left."""
    run = _bounded(run, path)
    if run.truth is not None and len(run.truth.times_s) < LEAST_TRUTH:
        warning = (
            f"no reference trajectory: the truth has {plural(len(run.truth.times_s), 'row')}, good for the first pose "
            "alone; errors of the path stay unknown"
        )
        run = replace(run, truth=None, warnings=(*run.warnings, warning))
    return replace(run, warnings=(*run.warnings, *suspicions(run)))


def found_format(path: Path, given: str | None = None) -> str:
    """The format of a file or folder: the given one, or else by file names and the first line.

    Raises RadioDataError: it does not exist, is empty, or has none of the formats.
    """
    if not path.exists():
        raise RadioDataError(path, "no such file or folder")
    if given is not None:
        return given
    is_folder = path.is_dir()
    files = [file for file in sorted(path.iterdir()) if file.is_file()] if is_folder else [path]
    if path.suffix in BAGS or any(file.name == "metadata.yaml" for file in files):
        return "bag"
    if robots_in(path) if is_folder else ROBOT_FILE.search(path.name):
        return "mrclam"
    if any(is_plaza(file) for file in files):
        return "plaza"
    for file in files:
        if is_folder and ".txt" not in file.suffixes:
            continue
        text = read_text(file)
        if is_labyrinth(text):
            return "labyrinth"
        if not is_folder and not content_lines(text):
            raise RadioDataError(path, "is empty: no line but comments; give a recording")
        if not is_folder and is_events_csv(text):
            return "csv"
    raise RadioDataError(path, f"none of the formats {', '.join(FORMATS)}; if it is one, name it with --format")


LONGEST_RUN_S = 1e8  # three years
LONGEST_PAUSE_S = 3600.0  # of the odometry; a longer one means that the clock was set
LONGEST_STEP_M = 1e3  # between two rows of odometry
LARGEST_TURN_RAD = 1e4  # between two rows; degrees instead of radians stay far below, and are reported elsewhere
FARTHEST_M = 1e8  # of coordinates; those of maps reach 1e7
# Column of the readings, its name, the largest value and its unit.
LIMITS = (
    ("range_m", "range", 1e6, "m"),
    ("bearing_rad", "bearing", 1e4, "rad"),
    ("rssi_dbm", "signal strength", 1e3, "dBm"),
)


def _bounded(run: RecordedRun, where: Path) -> RecordedRun:
    """The run without impossible readings and surveyed positions; each kind that is dropped gives a warning.

    Odometry and truth are refused as a whole, because without one of its steps a path is wrong.
    """
    steps, truth = run.steps, run.truth
    _refuse(where, "time of odometry", steps.times_s - steps.times_s[0], LONGEST_RUN_S, "s after its first row")
    _refuse(
        where, "odometry: a pause", np.diff(steps.times_s), LONGEST_PAUSE_S, "s", steps.times_s,
        "; was the clock set? give the part before or behind it",
    )  # fmt: skip
    for what, column in (("forward", steps.distance_m), ("to the left", steps.lateral_m)):
        _refuse(where, f"odometry: a step {what}", column, LONGEST_STEP_M, "m", steps.times_s[1:])
    _refuse(where, "odometry: a turn", steps.turn_rad, LARGEST_TURN_RAD, "rad", steps.times_s[1:])
    if truth is not None:
        for name, column in (("x", truth.x_m), ("y", truth.y_m)):
            _refuse(where, f"truth: {name}", column, FARTHEST_M, "m", truth.times_s)
    left_out: list[str] = []
    readings = run.readings
    if (nothing := readings.range_m == 0.0).any():  # some units write 0 if they received no reply
        first_s = readings.times_s[np.argmax(nothing)]
        left_out.append(f"{plural(int(nothing.sum()), 'range')} of 0 m, the first at {first_s:.6g} s, not used")
        readings = readings._replace(range_m=np.where(nothing, np.nan, readings.range_m))
    for field, what, most, unit in LIMITS:
        column = getattr(readings, field)
        beyond = ~(np.abs(column) <= most) & ~np.isnan(column)
        if beyond.any():
            first = int(np.flatnonzero(beyond)[0])
            left_out.append(
                f"{plural(int(beyond.sum()), what)} beyond {most:g} {unit}, the first {column[first]:.3g} {unit} at "
                f"{readings.times_s[first]:.6g} s, not used"
            )
            readings = readings._replace(**{field: np.where(beyond, np.nan, column)})
    if left_out:
        readings = readings.where(np.asarray(np.isfinite(np.column_stack(readings[2:])).any(axis=1)))
    if not len(readings.times_s):
        raise RadioDataError(where, f"none of its readings can be ({'; '.join(left_out)})")
    placed = {
        name: place_m
        for name, place_m in run.beacon_truth_m.items()
        if all(abs(axis_m) <= FARTHEST_M for axis_m in place_m)
    }
    if lost := [name for name in run.beacon_truth_m if name not in placed]:
        left_out.append(f"surveyed place of {', '.join(lost)}: is no place within {FARTHEST_M:g} m, not used")
    return replace(run, readings=readings, beacon_truth_m=placed, warnings=(*run.warnings, *left_out))


def _refuse(
    where: Path, what: str, values: FloatArray, most: float, unit: str, times_s: FloatArray | None = None,
    hint: str = "",
) -> None:  # fmt: skip
    beyond = np.flatnonzero(~(np.abs(values) <= most))
    if beyond.size:
        first = int(beyond[0])
        at = "" if times_s is None else f" at {times_s[first]:.6g} s"
        raise RadioDataError(
            where, f"{what} of {values[first]:.3g} {unit}{at} cannot be; at most {most:g} is taken{hint}"
        )
