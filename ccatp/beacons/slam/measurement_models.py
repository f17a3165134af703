"""What a reading of a beacon should be, with its derivatives: ranges, bearings, signal strengths."""

from math import atan2, isnan, log, log10, sqrt
from typing import NamedTuple

from ccatp.beacons.slam.beacon_map import GaussMarkovBias, RangeModel, RssiModel, SlamSettings
from ccatp.beacons.slam.motion import estimated
from ccatp.beacons.slam.recording import RangeReading, Reading, RssiReading

LEAST_RANGE_M = 1e-3  # nearer than that a range has no direction: derivatives are taken there
_DB = 10.0 / log(10.0)


class MeasurementError(ValueError):
    """A reading of a sensor that the settings do not describe."""


class MeasurementRow(NamedTuple):
    """One scalar of a reading.

    Attributes:
        expected: h(x), in the reading's unit.
        pose: dh by x_m, y_m and heading_rad of the vehicle.
        calibration: dh by range_scale and range_offset_m, as far as they are estimated.
    """

    expected: float
    pose: tuple[float, float, float]
    calibration: tuple[float, ...]
    beacon: tuple[float, ...]
    variance: float


def range_row(pose: list[float], calibration: list[float], beacon: list[float], model: RangeModel) -> MeasurementRow:
    """Z = (1 + e) r + o; ``calibration`` begins with e and o, each where its prior is not zero; beacon (x_m, y_m)."""
    dx, dy = beacon[0] - pose[0], beacon[1] - pose[1]
    r = max(sqrt(dx * dx + dy * dy), LEAST_RANGE_M)
    scale, offset = 1.0, 0.0
    by: tuple[float, ...] = ()
    if model.scale_sigma > 0.0:
        scale += calibration[0]
        by = (r,)
    if model.offset_sigma_m > 0.0:
        offset = calibration[len(by)]
        by = (*by, 1.0)
    ux, uy = scale * dx / r, scale * dy / r
    variance = model.sigma_m**2 + (model.sigma_per_m * r) ** 2
    return MeasurementRow(scale * r + offset, (-ux, -uy, 0.0), by, (ux, uy), variance)


def rssi_row(pose: list[float], shared: int, beacon: list[float], model: RssiModel) -> MeasurementRow:
    """Z = P_ref - 10 eta log10 r; P_ref and eta stand behind x and y in the beacon, each where it is estimated."""
    dx, dy = beacon[0] - pose[0], beacon[1] - pose[1]
    q = max(dx * dx + dy * dy, LEAST_RANGE_M**2)
    reference, exponent = model.reference_dbm, model.exponent
    decades, tail = 0.5 * log10(q), []
    if model.reference_sigma_db > 0.0:
        reference = beacon[2]
        tail.append(1.0)
    if model.exponent_sigma > 0.0:
        exponent = beacon[2 + len(tail)]
        tail.append(-10.0 * decades)
    gx, gy = -_DB * exponent * dx / q, -_DB * exponent * dy / q
    expected = reference - 10.0 * exponent * decades
    return MeasurementRow(expected, (-gx, -gy, 0.0), (0.0,) * shared, (gx, gy, *tail), model.sigma_db**2)


class MeasurementModels:
    """The radios of a run, as rows of measurement."""

    def __init__(self, settings: SlamSettings) -> None:
        self._range, self._bearing_sigma_rad, self._rssi = settings.range, settings.bearing_sigma_rad, settings.rssi
        r = settings.range
        priors = {} if r is None else {"range_scale": r.scale_sigma, "range_offset_m": r.offset_sigma_m}
        self.names, self.prior_sigmas = estimated(priors)

    def row(self, reading: Reading, pose: list[float], calibration: list[float], beacon: list[float]) -> MeasurementRow:
        """The range or the signal strength.

        Raises:
            MeasurementError: the settings have no model of it.
        """
        if isinstance(reading, RssiReading):
            return rssi_row(pose, len(self.names), beacon, self._rssi_model())
        return range_row(pose, calibration, beacon, self._range_model())

    def bearing(self, pose: list[float], beacon: list[float]) -> MeasurementRow:
        """The bearing, beta = atan2(dy, dx) - heading.

        Raises:
            MeasurementError: the settings have no model of it.
        """
        if self._bearing_sigma_rad is None:
            raise MeasurementError(
                "a reading has a bearing, the settings have no bearing model: give SlamSettings.bearing_sigma_rad"
            )
        dx, dy = beacon[0] - pose[0], beacon[1] - pose[1]
        q = max(dx * dx + dy * dy, LEAST_RANGE_M**2)
        across, tail = (-dy / q, dx / q), (0.0,) * (len(beacon) - 2)
        expected, shared = atan2(dy, dx) - pose[2], (0.0,) * len(self.names)
        return MeasurementRow(expected, (dy / q, -dx / q, -1.0), shared, across + tail, self._bearing_sigma_rad**2)

    def wander(self, reading: Reading) -> GaussMarkovBias | None:
        """The model of the error that stays while the vehicle does."""
        return (self._rssi_model() if isinstance(reading, RssiReading) else self._range_model()).wander

    def distance_m(self, reading: Reading) -> float:
        """What a reading says of the distance alone."""
        if not isinstance(reading, RssiReading):
            return max(reading.range_m, LEAST_RANGE_M)
        model = self._rssi_model()
        return float(10.0 ** ((model.reference_dbm - reading.rssi_dbm) / (10.0 * model.exponent)))

    def extra_prior(self, reading: Reading) -> tuple[tuple[float, float], ...]:
        """Mean and standard deviation of the states of a beacon behind x and y."""
        if not isinstance(reading, RssiReading):
            return ()
        m = self._rssi_model()
        priors = ((m.reference_dbm, m.reference_sigma_db), (m.exponent, m.exponent_sigma))
        return tuple((mean, sigma) for mean, sigma in priors if sigma > 0.0)

    def _range_model(self) -> RangeModel:
        if self._range is None:
            raise MeasurementError("a reading has a range, the settings have no range model: give SlamSettings.range")
        return self._range

    def _rssi_model(self) -> RssiModel:
        if self._rssi is None:
            raise MeasurementError("a reading has an RSSI, the settings have no RSSI model: give SlamSettings.rssi")
        return self._rssi


def is_direction(reading: Reading) -> bool:
    """Whether it has a bearing and nothing else."""
    return isinstance(reading, RangeReading) and isnan(reading.range_m)


def strength_of(reading: Reading) -> float:
    """The range, m, or the signal strength, dBm."""
    return reading.rssi_dbm if isinstance(reading, RssiReading) else reading.range_m


def kind_of(reading: Reading) -> str:
    """Which noise its range or strength has."""
    return "rssi" if isinstance(reading, RssiReading) else "range"
