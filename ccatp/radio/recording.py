"""Pure. A recorded run in the units and the order that estimators want: odometry, readings, truth if there is one."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ccatp.samples import FloatArray, IntArray


class Steps(NamedTuple):
    """Dead reckoning, one step a row: step k carries the vehicle from times_s[k] to times_s[k + 1].

    Args:
        times_s: where steps begin and end, s, shape (n + 1,), rising.
        distance_m: forward travel within a step, m, shape (n,).
        turn_rad: turn within a step, counter-clockwise, rad, shape (n,).
        lateral_m: travel to the left within a step, m, shape (n,); zeros for wheels that do not slip.
        guess_m2: variance of the end of a step, along and across, where the odometry was silent and the way is guessed,
            m^2, shape (n,); 0.0: none is.
        guess_rad2: the same of its turn, rad^2.
    """

    times_s: FloatArray
    distance_m: FloatArray
    turn_rad: FloatArray
    lateral_m: FloatArray
    guess_m2: FloatArray | float = 0.0
    guess_rad2: FloatArray | float = 0.0


class Readings(NamedTuple):
    """What was heard of beacons, one reading a row, in order of time.

    Args:
        times_s: shape (m,), s, rising.
        beacon: index into ``RecordedRun.beacon_ids``, shape (m,).
        range_m: shape (m,), m; NaN where none was measured.
        bearing_rad: from the heading, counter-clockwise, rad, shape (m,); NaN where none was measured.
        rssi_dbm: signal strength, dBm, shape (m,); NaN where none was measured.
    """

    times_s: FloatArray
    beacon: IntArray
    range_m: FloatArray
    bearing_rad: FloatArray
    rssi_dbm: FloatArray

    def where(self, rows: npt.NDArray[np.bool_] | IntArray) -> "Readings":
        """Some of the readings."""
        return Readings(
            self.times_s[rows], self.beacon[rows], self.range_m[rows], self.bearing_rad[rows], self.rssi_dbm[rows]
        )


class Truth(NamedTuple):
    """Where the vehicle was, world frame.

    Args:
        times_s: shape (k,), s, rising.
        x_m: shape (k,), m.
        y_m: shape (k,), m.
        heading_rad: shape (k,), rad, continuous; NaN where the reference saw positions alone.
    """

    times_s: FloatArray
    x_m: FloatArray
    y_m: FloatArray
    heading_rad: FloatArray


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """One vehicle's run among beacons.

    Attributes:
        name: of the data set, as in ``Plaza2``.
        kind: format that it was read from: plaza, mrclam, labyrinth or csv.
        steps: of dead reckoning.
        readings: what was heard of beacons.
        beacon_ids: name of each beacon as the data set gives it.
        beacon_truth_m: surveyed x, y by name, world frame, m; beacons that were not surveyed are missing.
        truth: reference trajectory, or none.
        first_pose: x_m, y_m, heading_rad at the first odometry time, world frame: the one thing that an estimator may
            take from the truth; the origin if there is no truth.
        warnings: what looks wrong in the set, a line each.
    """

    name: str
    kind: str
    steps: Steps
    readings: Readings
    beacon_ids: tuple[str, ...]
    beacon_truth_m: Mapping[str, tuple[float, float]]
    truth: Truth | None
    first_pose: tuple[float, float, float]
    warnings: tuple[str, ...]


def dead_reckoned(steps: Steps, first_pose: tuple[float, float, float]) -> FloatArray:
    """Poses x_m, y_m, heading_rad at ``steps.times_s`` by odometry alone, shape (n + 1, 3).

    Each step is a chord at the mean heading: x <- x + d cos(heading + turn / 2), thesis eq. 2.14 as it is meant.
    """
    x_m, y_m, heading_rad = first_pose
    headings = heading_rad + np.concatenate([[0.0], np.cumsum(steps.turn_rad)])
    middle = headings[:-1] + 0.5 * steps.turn_rad
    c, s = np.cos(middle), np.sin(middle)
    dx, dy = steps.distance_m * c - steps.lateral_m * s, steps.distance_m * s + steps.lateral_m * c
    x, y = x_m + np.concatenate([[0.0], np.cumsum(dx)]), y_m + np.concatenate([[0.0], np.cumsum(dy)])
    return np.column_stack([x, y, headings])
