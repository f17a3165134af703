"""Pure. What a reading of a beacon should be, with its derivatives: ranges, bearings, signal strengths."""

from math import atan2, log, log10, sqrt
from typing import NamedTuple

from ccatp.radio.slam_settings import RangeModel, RssiModel

LEAST_RANGE_M = 1e-3
"""Nearer than that a range has no direction: derivatives are taken there."""
_DB = 10.0 / log(10.0)


class Row(NamedTuple):
    """One scalar of a reading.

    Attributes:
        expected: h(x), in the reading's unit.
        pose: dh by x_m, y_m and heading_rad of the vehicle.
        calibration: dh by the calibration states.
        beacon: dh by the states of the beacon.
        variance: of the noise.
    """

    expected: float
    pose: tuple[float, float, float]
    calibration: tuple[float, ...]
    beacon: tuple[float, ...]
    variance: float


def range_row(pose: list[float], calibration: list[float], beacon: list[float], model: RangeModel) -> Row:
    """Z = (1 + e) r + o; ``calibration`` begins with e and o, each where its prior is not zero; beacon (x_m, y_m)."""
    dx, dy = beacon[0] - pose[0], beacon[1] - pose[1]
    r = max(sqrt(dx * dx + dy * dy), LEAST_RANGE_M)
    scale, offset, by, i = 1.0, 0.0, [0.0] * len(calibration), 0
    if model.scale_sigma > 0.0:
        scale, by[0], i = 1.0 + calibration[0], r, 1
    if model.offset_sigma_m > 0.0:
        offset, by[i] = calibration[i], 1.0
    ux, uy = scale * dx / r, scale * dy / r
    variance = model.sigma_m**2 + (model.sigma_per_m * r) ** 2
    return Row(scale * r + offset, (-ux, -uy, 0.0), tuple(by), (ux, uy), variance)


def bearing_row(pose: list[float], calibration: list[float], beacon: list[float], sigma_rad: float) -> Row:
    """Beta = atan2(dy, dx) - heading."""
    dx, dy = beacon[0] - pose[0], beacon[1] - pose[1]
    q = max(dx * dx + dy * dy, LEAST_RANGE_M**2)
    tail = (0.0,) * (len(beacon) - 2)
    return Row(
        atan2(dy, dx) - pose[2],
        (dy / q, -dx / q, -1.0),
        (0.0,) * len(calibration),
        (-dy / q, dx / q, *tail),
        sigma_rad**2,
    )


def rssi_row(pose: list[float], calibration: list[float], beacon: list[float], model: RssiModel) -> Row:
    """Z = P_ref - 10 eta log10 r; P_ref and eta stand behind x and y in the beacon, each where it is estimated."""
    dx, dy = beacon[0] - pose[0], beacon[1] - pose[1]
    q = max(dx * dx + dy * dy, LEAST_RANGE_M**2)
    reference, exponent = model.reference_dbm, model.exponent
    decades, tail, i = 0.5 * log10(q), [], 2
    if model.reference_sigma_db > 0.0:
        reference, i = beacon[2], 3
        tail.append(1.0)
    if model.exponent_sigma > 0.0:
        exponent = beacon[i]
        tail.append(-10.0 * decades)
    gx, gy = -_DB * exponent * dx / q, -_DB * exponent * dy / q
    none = (0.0,) * len(calibration)
    return Row(reference - 10.0 * exponent * decades, (-gx, -gy, 0.0), none, (gx, gy, *tail), model.sigma_db**2)
