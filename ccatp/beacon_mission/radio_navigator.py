"""Pure. Navigation by radios that are mapped on the way: EKF-SLAM on levels and bearings."""

from collections.abc import Mapping

import numpy as np

from ccatp.beacon_mission.navigator import Belief, Ellipse, Score, ellipse_of
from ccatp.beacon_mission.senses import Senses
from ccatp.config.radio_models import RadioConfig
from ccatp.control.following import TargetSight
from ccatp.radio.motion import POSE, Pose
from ccatp.radio.signal_settings import new_slam, odometry_of, readings_of, scan_of, vehicle_of


class RadioNavigator:
    """Hosts ``SignalSlam``.

    Args:
        cfg: the configuration; nothing of ``sim`` is used.
    """

    is_mapping = False  # the map grows while the robot drives

    def __init__(self, cfg: RadioConfig) -> None:
        """At the believed start."""
        self._cfg, self._scan = cfg, scan_of(cfg)
        self._target = cfg.follow.target
        self.slam = new_slam(cfg)
        self._motion = vehicle_of(cfg)
        self._reckoned = np.zeros(self._motion.size)
        self._reckoned[:POSE] = Pose(cfg.start.x_m, cfg.start.y_m, cfg.start.heading_rad)
        self._heard_s: float | None = None
        self._score = Score(0.0, 0, 0)

    @property
    def belief(self) -> Belief:
        """Of the robot."""
        x_m, y_m, heading_rad = self.slam.pose
        return Belief((x_m, y_m, heading_rad), self.slam.pose_covariance)

    @property
    def reckoned_m(self) -> tuple[float, float]:
        """Where dead reckoning alone would see it."""
        return float(self._reckoned[0]), float(self._reckoned[1])

    @property
    def beacons(self) -> Mapping[str, Ellipse]:
        """The map, the target among the radios."""
        return {str(name): ellipse_of(found.mean, found.covariance) for name, found in self.slam.beacons.items()}

    @property
    def score(self) -> Score:
        """Consistency so far."""
        return self._score

    @property
    def notes(self) -> Mapping[str, float]:
        """What the vehicle's calibration is believed to be."""
        return {name: mean for name, (mean, _) in self.slam.calibration.items()}

    def target(self, t_s: float) -> TargetSight | None:
        """What is believed of the radio that is followed."""
        estimate = self.slam.beacons.get(self._target)
        if estimate is None or self._heard_s is None:
            return None
        x_m, y_m = estimate.mean[:2].tolist()
        sigma_m = self.slam.distance(self._target)[1]
        return TargetSight((x_m, y_m), sigma_m, t_s - self._heard_s, self.slam.moving_velocity_m_s)

    def take(self, senses: Senses) -> None:
        """Predict over the wheels' intervals, then take what was heard."""
        for wheels in senses.wheels:
            odometry = odometry_of(self._cfg, wheels.end_s, wheels)
            self.slam.predict(odometry)
            self._reckoned[:POSE] = self._motion.step(self._reckoned, odometry).mean[:POSE]
        readings = readings_of(senses.t_s, [*self._scan.results(senses.packets), *senses.sightings])
        learned = self.slam.observe(readings)
        used = [one for one in learned if one.accepted]
        self._score = Score(
            self._score.nis_sum + sum(one.nis for one in used),
            self._score.nis_size + sum(one.size for one in used),
            self._score.refused + len(learned) - len(used),
        )
        if any(reading.beacon == self._target for reading in readings):
            self._heard_s = senses.t_s
