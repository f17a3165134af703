"""Pure. What a frame of the link tells a robot among beacons: intervals of the wheels, scans, distances, pulses."""

from math import hypot
from typing import NamedTuple

from ccatp.config.radio_models import RadioConfig
from ccatp.samples import WheelSample
from ccatp.wire.beacon_frame import BeaconFrame, MoteBurst, RadioScan
from ccatp.wire.robot import Sensors

_EPSILON_S = 1e-9  # an interval shorter than this is none


class WheelInterval(NamedTuple):
    """Odometry of an interval.

    Attributes:
        end_s: its end, robot time.
        interval_s: its length.
        speed_m_s: mean speed.
        steer_rad: steering angle to the left; of a steered vehicle.
        turn_rate_rad_s: turn rate to the left; of a differential drive.
    """

    end_s: float
    interval_s: float
    speed_m_s: float
    steer_rad: float
    turn_rate_rad_s: float


class ScanReading(NamedTuple):
    """One answer of a radio while the reflector pointed somewhere."""

    beacon: str
    direction_rad: float
    rssi_dbm: float


class Sighting(NamedTuple):
    """A radio heard from somewhere."""

    beacon: str
    rssi_dbm: float
    bearing_rad: float | None


class Senses(NamedTuple):
    """A frame as a mission takes it.

    Attributes:
        t_s: its time.
        wheels: since the last frame, without gaps; empty where nothing is known of them.
        packets: of a scan that is to be read.
        sightings: scans that were read already.
        distances_m: of the distance sensors; empty without a reading.
        motes: pulses heard.
    """

    t_s: float
    wheels: tuple[WheelInterval, ...]
    packets: tuple[ScanReading, ...]
    sightings: tuple[Sighting, ...]
    distances_m: tuple[float, ...]
    motes: tuple[MoteBurst, ...]

    @property
    def heard(self) -> frozenset[str]:
        """Radios of which anything was heard."""
        return frozenset([*(one.beacon for one in self.packets), *(one.beacon for one in self.sightings)])


class SenseReader:
    """Reads one frame after the other.

    Args:
        cfg: wheels and vehicle.
    """

    def __init__(self, cfg: RadioConfig) -> None:
        """Before the first frame."""
        self._radius_m, self._track_m = cfg.robot.wheel_radius_m, cfg.vehicle.track_m
        self._read_to_s: float | None = None
        self._steer_rad = 0.0

    def forget(self) -> None:
        """The robot's clock counts anew."""
        self._read_to_s = None

    def read(self, sensors: Sensors, extras: BeaconFrame) -> Senses:
        """The senses of a frame; each wheel sample stands for the time since the one before."""
        if self._read_to_s is None:
            self._read_to_s = sensors.t
        steering = {sample.t_s: sample.steer_rad for sample in extras.steer}
        wheels = [self._interval(sample, steering) for sample in sensors.enc]
        return Senses(
            sensors.t,
            tuple(one for one in wheels if one is not None),
            _packets(extras.scan),
            tuple(Sighting(one.beacon, one.rssi_dbm, one.bearing_rad) for one in extras.radio),
            tuple(extras.distances),
            tuple(extras.motes),
        )

    def _interval(self, sample: WheelSample, steering: dict[float, float]) -> WheelInterval | None:
        self._steer_rad = steering.get(sample.t_s, self._steer_rad)
        right, left = sample.right_rad_s, sample.left_rad_s
        before_s = sample.t_s if self._read_to_s is None else self._read_to_s
        interval_s = sample.t_s - before_s
        if right is None or left is None or interval_s < _EPSILON_S:
            return None  # the next sample stands for this time, too
        self._read_to_s = sample.t_s
        speed_m_s = 0.5 * self._radius_m * (right + left)
        rate_rad_s = self._radius_m * (right - left) / self._track_m
        return WheelInterval(sample.t_s, interval_s, speed_m_s, self._steer_rad, rate_rad_s)


def _packets(scan: RadioScan | None) -> tuple[ScanReading, ...]:
    if scan is None:
        return ()
    return tuple(
        ScanReading(beacon, index * scan.step, level)
        for beacon, levels in scan.levels.items()
        for index, level in enumerate(levels)
        if level is not None
    )


def distance_m(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Between two places (x, y, ...)."""
    return hypot(a[0] - b[0], a[1] - b[1])
