"""What a reading of a beacon should be, with its derivatives: ranges, bearings, signal strengths."""

from math import atan2, isnan, log, log10, sqrt
from typing import NamedTuple

from ccatp.beacons.slam.motion import estimated
from ccatp.beacons.slam.recording import RangeReading, Reading, RssiReading
from ccatp.config.beacon_models import PriorsConfig, RadioNoiseConfig

LEAST_RANGE_M = 1e-3  # nearer than that a range has no direction: derivatives are taken there
_DB = 10.0 / log(10.0)


class MeasurementRow(NamedTuple):
    """One scalar of a reading."""

    expected: float  # h(x), in the reading's unit
    pose: tuple[float, float, float]  # dh by x_m, y_m and heading_rad of the vehicle
    calibration: tuple[float, ...]  # dh by range_scale and range_offset_m, as far as they are estimated
    beacon: tuple[float, ...]
    variance: float


class MeasurementModels:
    """The radios of a run, as rows of measurement.

    * range: z = (1 + e) r + o, scale e and offset o shared by all, each estimated where its prior is not zero;
      var = sigma^2 + (sigma_per_m r)^2;
    * bearing: beta = atan2(dy, dx) - heading;
    * signal strength: z = P_ref - 10 eta log10(r / 1 m) (Hevrdejs and Knoll, eq. 4); P_ref and eta are states of each
      beacon behind x and y, each where its prior is not zero.
    """

    def __init__(self, radio: RadioNoiseConfig, priors: PriorsConfig) -> None:
        self._radio = radio
        self._has_scale, self._has_offset = priors.range_scale > 0.0, priors.range_offset_m > 0.0
        self.names, self.prior_sigmas = estimated(
            {"range_scale": priors.range_scale, "range_offset_m": priors.range_offset_m}
        )
        self._reference_sigma_db = (priors.rssi_reference_db**2 + priors.beacon_reference_db**2) ** 0.5
        self._exponent_sigma = priors.rssi_exponent

    def row(self, reading: Reading, pose: list[float], calibration: list[float], beacon: list[float]) -> MeasurementRow:
        """The range or the signal strength."""
        if isinstance(reading, RssiReading):
            return self._rssi(pose, beacon)
        dx, dy = beacon[0] - pose[0], beacon[1] - pose[1]
        r = max(sqrt(dx * dx + dy * dy), LEAST_RANGE_M)
        scale, offset = 1.0, 0.0
        by: tuple[float, ...] = ()
        if self._has_scale:
            scale += calibration[0]
            by = (r,)
        if self._has_offset:
            offset = calibration[len(by)]
            by = (*by, 1.0)
        ux, uy = scale * dx / r, scale * dy / r
        variance = self._radio.range_sigma_m**2 + (self._radio.range_sigma_per_m * r) ** 2
        return MeasurementRow(scale * r + offset, (-ux, -uy, 0.0), by, (ux, uy), variance)

    def bearing(self, pose: list[float], beacon: list[float]) -> MeasurementRow:
        """The bearing."""
        dx, dy = beacon[0] - pose[0], beacon[1] - pose[1]
        q = max(dx * dx + dy * dy, LEAST_RANGE_M**2)
        across, tail = (-dy / q, dx / q), (0.0,) * (len(beacon) - 2)
        expected, shared = atan2(dy, dx) - pose[2], (0.0,) * len(self.names)
        variance = self._radio.bearing_sigma_rad**2
        return MeasurementRow(expected, (dy / q, -dx / q, -1.0), shared, across + tail, variance)

    def _rssi(self, pose: list[float], beacon: list[float]) -> MeasurementRow:
        dx, dy = beacon[0] - pose[0], beacon[1] - pose[1]
        q = max(dx * dx + dy * dy, LEAST_RANGE_M**2)
        reference, exponent = self._radio.rssi_reference_dbm, self._radio.rssi_exponent
        decades, tail = 0.5 * log10(q), []
        if self._reference_sigma_db > 0.0:
            reference = beacon[2]
            tail.append(1.0)
        if self._exponent_sigma > 0.0:
            exponent = beacon[2 + len(tail)]
            tail.append(-10.0 * decades)
        gx, gy = -_DB * exponent * dx / q, -_DB * exponent * dy / q
        expected, shared = reference - 10.0 * exponent * decades, (0.0,) * len(self.names)
        return MeasurementRow(expected, (-gx, -gy, 0.0), shared, (gx, gy, *tail), self._radio.rssi_sigma_db**2)

    def distance_m(self, reading: Reading) -> float:
        """What a reading says of the distance alone."""
        if not isinstance(reading, RssiReading):
            return max(reading.range_m, LEAST_RANGE_M)
        radio = self._radio
        return float(10.0 ** ((radio.rssi_reference_dbm - reading.rssi_dbm) / (10.0 * radio.rssi_exponent)))

    def extra_prior(self, reading: Reading) -> tuple[tuple[float, float], ...]:
        """Mean and standard deviation of the states of a beacon behind x and y."""
        if not isinstance(reading, RssiReading):
            return ()
        radio = self._radio
        priors = ((radio.rssi_reference_dbm, self._reference_sigma_db), (radio.rssi_exponent, self._exponent_sigma))
        return tuple((mean, sigma) for mean, sigma in priors if sigma > 0.0)


def is_direction(reading: Reading) -> bool:
    """Whether it has a bearing and nothing else."""
    return isinstance(reading, RangeReading) and isnan(reading.range_m)


def strength_of(reading: Reading) -> float:
    """The range, m, or the signal strength, dBm."""
    return reading.rssi_dbm if isinstance(reading, RssiReading) else reading.range_m


def kind_of(reading: Reading) -> str:
    """Which noise its range or strength has."""
    return "rssi" if isinstance(reading, RssiReading) else "range"
