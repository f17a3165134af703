"""One step of a robot among beacons: readings in, filter, pilot, set points out; and when to listen to whom."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from ccatp.beacons.pilot import BeaconPilot, TargetSight
from ccatp.beacons.slam.range_slam import BeaconInnovation
from ccatp.beacons.slam.reflector import ScanPacket
from ccatp.beacons.slam.settings import SignalMeasurements, WheelAngles, new_slam, odometry_of, readings_of, scan_of
from ccatp.beacons.steering import HALT, SteeringCommand
from ccatp.config.beacon_models import RadioConfig


class Listening(NamedTuple):
    """Whom to listen to at the end of a step."""

    static: bool
    target: bool


class BeaconLoop:
    """Filter and pilot of a robot among beacons.

    Args:
        cfg: the configuration; nothing of ``sim`` is used.

    Raises:
        FuzzyGapError: the rules of the speed leave a gap.
    """

    def __init__(self, cfg: RadioConfig) -> None:
        self._cfg = cfg
        self._scan = scan_of(cfg)
        self._heard_s: float | None = None
        self.slam = new_slam(cfg)
        self.pilot = BeaconPilot(cfg)
        self.learned: list[BeaconInnovation] = []

    def listens(self, step: int) -> Listening:
        """Whom to listen to at the end of a step, counted from 1."""
        observation = self._cfg.observation
        return Listening(step % observation.every_steps == 0, step % observation.target_every_steps == 0)

    def step(
        self,
        time_s: float,
        wheels: WheelAngles,
        packets: Iterable[ScanPacket],
        sightings: Iterable[SignalMeasurements],
        distances_m: Sequence[float],
    ) -> SteeringCommand:
        """Take the readings of a step; set points for the next."""
        self.slam.predict(odometry_of(self._cfg, time_s, wheels))
        readings = readings_of(time_s, [*self._scan.results(packets), *sightings])
        self.learned = self.slam.observe(readings)
        if any(reading.beacon == self._cfg.follow.target for reading in readings):
            self._heard_s = time_s
        return self.pilot.drive(time_s, wheels.interval_s, self.slam.pose, self.target(time_s), distances_m)

    def target(self, time_s: float) -> TargetSight | None:
        """What is believed of the target; None before it was first heard."""
        estimate = self.slam.beacons.get(self._cfg.follow.target)
        if estimate is None or self._heard_s is None:
            return None
        x_m, y_m = estimate.mean.tolist()
        sigma_m, velocity_m_s = self.slam.distance(self._cfg.follow.target)[1], self.slam.moving_velocity_m_s
        return TargetSight((x_m, y_m), sigma_m, time_s - self._heard_s, velocity_m_s)

    @staticmethod
    def first() -> SteeringCommand:
        """Set points before the first reading."""
        return HALT
