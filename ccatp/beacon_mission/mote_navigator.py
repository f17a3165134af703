"""Pure. Navigation by ultrasonic motes: they map themselves, then ranges to them carry the robot; one joint state."""

from collections.abc import Mapping
from math import hypot

import numpy as np
from scipy.special import chdtri

from ccatp.beacon_mission.navigator import Belief, Ellipse, Score, ellipse_of
from ccatp.beacon_mission.self_map import SelfMap
from ccatp.beacon_mission.senses import Senses
from ccatp.config.radio_models import RadioConfig
from ccatp.control.following import TargetSight
from ccatp.filters.base import FloatArray
from ccatp.filters.ekf_slam import EkfSlam, columns_of
from ccatp.motes.mote_ranges import pair_range
from ccatp.radio.motion import POSE, Pose
from ccatp.radio.signal_settings import odometry_of, vehicle_of
from ccatp.wire.beacon_frame import MoteBurst

_PLACE = 2
_NEAREST_M = 0.02  # nearer than that a range has no direction


class MoteNavigator:
    """An EKF over the robot and all motes of the map.

    State: pose and its calibration, then the motes. The map joins with the joint covariance that its self-mapping left,
    so that its errors, which hang together, count as such: ranges correct the robot as far as the map is known, and
    the map as far as the robot is. A range is z = |p - m| + noise.

    Args:
        cfg: the configuration; nothing of ``sim`` is used.
    """

    def __init__(self, cfg: RadioConfig) -> None:
        """At the believed start, without a map."""
        start = cfg.start
        self._cfg, self._motion = cfg, vehicle_of(cfg)
        self._self_map = SelfMap(cfg.cricket)
        self._gate = float(chdtri(1, 1.0 - cfg.listener.gate_probability))
        v = self._motion.size
        mean, sigmas = np.zeros(v), np.zeros(v)
        mean[:POSE] = Pose(start.x_m, start.y_m, start.heading_rad)
        sigmas[:POSE] = start.position_sigma_m, start.position_sigma_m, start.heading_sigma_rad
        sigmas[POSE:] = self._motion.prior_sigmas
        self._filter = EkfSlam(mean, np.diag(sigmas**2))
        self._reckoned = mean.copy()
        self._place_of: dict[str, int] = {}
        self._score = Score(0.0, 0, 0)

    @property
    def is_mapping(self) -> bool:
        """The motes have no map of themselves yet."""
        return not self._place_of

    @property
    def belief(self) -> Belief:
        """Of the robot."""
        x_m, y_m, heading_rad = self._filter.mean[:POSE].tolist()
        return Belief((x_m, y_m, heading_rad), self._filter.covariance[:POSE, :POSE].copy())

    @property
    def reckoned_m(self) -> tuple[float, float]:
        """Where dead reckoning alone would see it."""
        return float(self._reckoned[0]), float(self._reckoned[1])

    @property
    def beacons(self) -> Mapping[str, Ellipse]:
        """The map; before the robot has one, what the motes have of it."""
        if self._place_of:
            mean, P, at = self._filter.mean, self._filter.covariance, self._place_of
        else:
            places = self._self_map.places
            if places is None:
                return {}
            mean, P = places[0].ravel(), places[1]
            at = {name: _PLACE * row for row, name in enumerate(self._self_map.names)}
        return {name: ellipse_of(mean[i : i + _PLACE], P[i : i + _PLACE, i : i + _PLACE]) for name, i in at.items()}

    @property
    def score(self) -> Score:
        """Consistency of the robot's ranges so far."""
        return self._score

    @property
    def notes(self) -> Mapping[str, float]:
        """How well the map is known."""
        return self._self_map.notes

    def target(self, _t_s: float) -> TargetSight | None:
        """Nothing is followed."""
        return None

    def take(self, senses: Senses) -> None:
        """Predict over the wheels' intervals, then take what was heard.

        Raises:
            MappingError: the motes cannot be mapped.
            TdoaError: a delay or a temperature that none can be.
        """
        motion, state = self._motion, self._filter
        for wheels in senses.wheels:
            odometry = odometry_of(self._cfg, wheels.end_s, wheels)
            step = motion.step(state.mean[: state.vehicle_size], odometry)
            state.predict(step.mean, step.F, step.Q)
            self._reckoned = motion.step(self._reckoned, odometry).mean
        for burst in senses.motes:
            if burst.listener == self._cfg.listener.name:
                self._range(burst)
            elif self.is_mapping:
                self._self_map.take(burst)
        if self.is_mapping and self._self_map.is_done and self._self_map.places is not None:
            self._join(*self._self_map.places)
            self._self_map.notes["map_time_s"] = senses.t_s

    def _join(self, positions_m: FloatArray, covariance_m2: FloatArray) -> None:
        """The map becomes part of the state, as one block; nothing ties it to the robot yet."""
        none = np.empty(0, dtype=np.intp)
        size = positions_m.size
        self._filter.augment("map", positions_m.ravel(), none, np.zeros((size, 0)), np.eye(size), covariance_m2)
        start = self._filter.block("map").start
        self._place_of = {name: start + _PLACE * row for row, name in enumerate(self._self_map.names)}

    def _range(self, burst: MoteBurst) -> None:
        at = self._place_of.get(burst.sender)
        if at is None or not burst.delays_s:
            return
        reading = pair_range(self._cfg.cricket, (burst.sender, burst.listener), burst.delays_s, burst.temperature_c)
        columns = columns_of(range(_PLACE), range(at, at + _PLACE))
        x, y, mx, my = self._filter.mean.take(columns).tolist()
        r = max(hypot(x - mx, y - my), _NEAREST_M)
        ux, uy = (x - mx) / r, (y - my) / r
        found = self._filter.update_row(
            columns, np.array((ux, uy, -ux, -uy)), reading.range_m - r, reading.sigma_m**2, self._gate
        )
        nis_sum, nis_size, refused = self._score
        if found.accepted:
            self._score = Score(nis_sum + found.nis, nis_size + 1, refused)
        else:
            self._score = Score(nis_sum, nis_size, refused + 1)
