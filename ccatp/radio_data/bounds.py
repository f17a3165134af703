"""Pure. Numbers that no vehicle and no radio gives: refused, or left out and told, before anything uses them."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ccatp.radio.recording import Readings, RecordedRun
from ccatp.radio_data.cleaning import plural
from ccatp.radio_data.errors import RadioDataError
from ccatp.samples import FloatArray

LONGEST_RUN_S = 1e8  # three years
LONGEST_STEP_M = 1e3  # between two rows of odometry
LARGEST_TURN_RAD = 1e4  # likewise; degrees for radians stay far below it, and are told elsewhere
LONGEST_RANGE_M = 1e6
LARGEST_BEARING_RAD = 1e4
LARGEST_LEVEL_DBM = 1e3
FARTHEST_M = 1e8  # of coordinates; those of maps reach 1e7


def bounded(run: RecordedRun, where: Path) -> RecordedRun:
    """The run without readings and surveyed places that cannot be; each kind that was left out makes a warning.

    Odometry and truth are refused as a whole: without one of its steps a path leads elsewhere.

    Args:
        run: as read.
        where: file or folder, for the message.

    Raises:
        RadioDataError: odometry or truth cannot be, or no reading is left.
    """
    steps, truth = run.steps, run.truth
    _refuse(where, "time of odometry", steps.times_s - steps.times_s[0], LONGEST_RUN_S, "s after its first row")
    for what, column in (("forward", steps.distance_m), ("to the left", steps.lateral_m)):
        _refuse(where, f"odometry: a step {what}", column, LONGEST_STEP_M, "m", steps.times_s[1:])
    _refuse(where, "odometry: a turn", steps.turn_rad, LARGEST_TURN_RAD, "rad", steps.times_s[1:])
    if truth is not None:
        for name, column in (("x", truth.x_m), ("y", truth.y_m)):
            _refuse(where, f"truth: {name}", column, FARTHEST_M, "m", truth.times_s)
    warnings = list(run.warnings)
    readings = _sensible(run.readings, warnings)
    if not len(readings.times_s):
        raise RadioDataError(where, f"none of its readings can be ({'; '.join(warnings[len(run.warnings) :])})")
    placed = {
        name: place_m
        for name, place_m in run.beacon_truth_m.items()
        if all(abs(axis_m) <= FARTHEST_M for axis_m in place_m)
    }
    if lost := [name for name in run.beacon_truth_m if name not in placed]:
        warnings.append(f"surveyed place of {', '.join(lost)}: is no place within {FARTHEST_M:g} m, left out")
    return replace(run, readings=readings, beacon_truth_m=placed, warnings=tuple(warnings))


def _refuse(
    where: Path, what: str, values: FloatArray, most: float, unit: str, times_s: FloatArray | None = None
) -> None:
    beyond = np.flatnonzero(~(np.abs(values) <= most))
    if beyond.size:
        first = int(beyond[0])
        at = "" if times_s is None else f" at {times_s[first]:.6g} s"
        raise RadioDataError(where, f"{what} of {values[first]:.3g} {unit}{at} cannot be; at most {most:g} is taken")


def _sensible(readings: Readings, warnings: list[str]) -> Readings:
    """Readings without the values that cannot be, and without rows that had no other."""
    columns = {}
    for field, what, most, unit in (
        ("range_m", "range", LONGEST_RANGE_M, "m"),
        ("bearing_rad", "bearing", LARGEST_BEARING_RAD, "rad"),
        ("rssi_dbm", "signal strength", LARGEST_LEVEL_DBM, "dBm"),
    ):
        column: FloatArray = getattr(readings, field)
        beyond = ~(np.abs(column) <= most) & ~np.isnan(column)
        if beyond.any():
            first = int(np.flatnonzero(beyond)[0])
            warnings.append(
                f"{plural(int(beyond.sum()), what)} beyond {most:g} {unit}, the first {column[first]:.3g} {unit} at "
                f"{readings.times_s[first]:.6g} s, left out"
            )
            columns[field] = np.where(beyond, np.nan, column)
    if not columns:
        return readings
    cleaned = readings._replace(**columns)
    known = np.asarray(
        np.isfinite(np.column_stack([cleaned.range_m, cleaned.bearing_rad, cleaned.rssi_dbm])).any(axis=1)
    )
    return cleaned.where(known)
