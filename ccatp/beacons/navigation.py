"""Localization of a robot: by radios, mapped while it drives, or by ultrasonic motes, which map themselves first."""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from math import hypot
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ccatp.beacons.config.models import CricketConfig, RadioConfig
from ccatp.beacons.cricket.mote_plan import network_plan
from ccatp.beacons.cricket.range_network import build_network, pair_range
from ccatp.beacons.cricket.self_mapping import MoteMapper, begin_phase_two
from ccatp.beacons.cricket.trilateration import map_by_plan
from ccatp.beacons.estimation.motion import POSE, DeadReckoning, Increment, Odometry, SlippingVehicle, Steering
from ccatp.beacons.estimation.recording import Reading
from ccatp.beacons.estimation.signal_slam import ReflectorScan, SignalSlam
from ccatp.beacons.filters.ekf_slam import EkfSlam, columns_of
from ccatp.beacons.links.messages import BeaconFrame, Ellipse, MoteBurst, RadioScan, worst_sigma_m
from ccatp.beacons.pilot import TargetSight
from ccatp.core import FloatArray, WheelSample
from ccatp.links.robot_messages import Sensors
from ccatp.sensing.sample_times import LATEST_S, possible_samples


class SelfMap:
    """Collects ranges between motes until their map is good enough.

    Phase 1 runs when every pair of its plan has the configured number of readings. Phase 2 then processes each later
    reading (Patil et al., figure 8). ``notes``: expected error after each phase, m; number of updates of phase 2.
    ``readings``: number of those that were of use.
    """

    def __init__(self, cfg: CricketConfig) -> None:
        self._cfg, self._plan = cfg, network_plan(cfg)
        names, heads = self._plan.names, self._plan.heads
        self._index = {name: mote for mote, name in enumerate(names)}
        self.names = tuple(names[mote] for mote in heads)
        self._row_of = {mote: row for row, mote in enumerate(heads)}
        self._wanted = {frozenset(pair) for pair in self._plan.phase1_pairs}
        self._second = {frozenset(pair) for pair in self._plan.phase2_pairs}
        self._delays: dict[frozenset[int], list[float]] = {}
        self._temperatures: dict[frozenset[int], list[float]] = {}
        self._mapper: MoteMapper | None = None
        self.notes: dict[str, float] = {}
        self.readings = 0

    @property
    def lacking(self) -> str:
        """What the map needs most, for messages."""
        if self._mapper is not None:
            expected_m, target_m = self._mapper.expected_rms_m, self._cfg.phase2.target_rms_m
            return f"phase 2 expects an error of {expected_m:.3f} m, not yet {target_m:g} m"
        counts = {pair: len(self._delays.get(pair, ())) for pair in self._wanted}
        pair = min(counts, key=lambda pair: (counts[pair], sorted(pair)))
        first, second = (self._plan.names[mote] for mote in sorted(pair))
        return f"{first} and {second} have {counts[pair]} of {self._cfg.ranging.repeats} readings of each other"

    @property
    def is_done(self) -> bool:
        """Whether the expected error is small enough, or the largest number of updates is reached."""
        phase2, mapper = self._cfg.phase2, self._mapper
        if mapper is None:
            return False
        return mapper.expected_rms_m <= phase2.target_rms_m or self.notes["map_updates"] >= phase2.max_updates

    @property
    def places(self) -> tuple[FloatArray, FloatArray] | None:
        """Positions (n, 2) and their joint covariance (2 n, 2 n); ``None`` before phase 1."""
        return None if self._mapper is None else (self._mapper.positions_m, self._mapper.covariance_m2)

    def take(self, burst: MoteBurst) -> None:
        """Process readings between two motes of the plan; others are ignored.

        Raises MappingError: phase 1 fails with these ranges. Raises TdoaError: an impossible delay or temperature.
        """
        first, second = self._index.get(burst.sender), self._index.get(burst.listener)
        if first is None or second is None or self.is_done:
            return
        pair = frozenset((first, second))
        if self._mapper is not None:
            self._refine(self._mapper, pair, burst)
        elif pair in self._wanted:
            self.readings += len(burst.delays_s)
            self._delays.setdefault(pair, []).extend(burst.delays_s)
            self._temperatures.setdefault(pair, []).extend([burst.temperature_c] * len(burst.delays_s))
            repeats = self._cfg.ranging.repeats
            if all(len(self._delays.get(wanted, ())) >= repeats for wanted in self._wanted):
                self._mapper = self._lay_out()

    def _lay_out(self) -> MoteMapper:
        cfg, plan = self._cfg, self._plan
        rows = []
        for i, j in plan.phase1_pairs:
            pair = frozenset((i, j))
            temperature_c = float(np.mean(self._temperatures[pair]))
            rows.append(pair_range(cfg, (plan.names[i], plan.names[j]), self._delays[pair], temperature_c))
        network = build_network(rows, plan.dimension, plan.names)
        mapper = begin_phase_two(cfg, plan, map_by_plan(plan, network, cfg.phase1.max_dop, cfg.phase1.draws))
        self.notes = {"map_phase1_expected_m": mapper.expected_rms_m, "map_updates": 0.0}
        self.notes["map_expected_m"] = mapper.expected_rms_m
        return mapper

    def _refine(self, mapper: MoteMapper, pair: frozenset[int], burst: MoteBurst) -> None:
        if pair not in self._second:
            return
        i, j = sorted(pair)
        for delay_s in burst.delays_s:
            reading = pair_range(self._cfg, (burst.sender, burst.listener), [delay_s], burst.temperature_c)
            mapper.observe(self._row_of[i], self._row_of[j], reading.range_m, reading.sigma_m)
            self.notes["map_updates"] += 1.0
            self.readings += 1
        self.notes["map_expected_m"] = mapper.expected_rms_m


_EPSILON_S = 1e-9  # a shorter interval counts as zero


class BeaconMeasurements(NamedTuple):
    """The measurements of one frame."""

    t_s: float
    wheels: tuple[Odometry, ...]  # odometry since the last frame, without gaps; empty if unknown
    extras: BeaconFrame


def packets_of(scan: RadioScan) -> Iterator[tuple[str, float, float]]:
    """Replies of radios: name, direction of the reflector left of the heading (rad), level (dBm)."""
    for beacon, levels in scan.levels.items():
        yield from ((beacon, k * scan.step, level) for k, level in enumerate(levels) if level is not None)


def odometry_of(
    cfg: RadioConfig, end_s: float, interval_s: float, speed_m_s: float, steer_rad: float, turn_rate_rad_s: float
) -> Odometry:
    """Odometry of an interval for the motion model of the vehicle; angle and rate are positive to the left."""
    if cfg.vehicle.kind == "ackermann":
        return Steering(end_s, interval_s, speed_m_s, steer_rad)
    return Increment(end_s, interval_s, speed_m_s * interval_s, turn_rate_rad_s * interval_s)


class MeasurementReader:
    """Converts successive frames to measurements."""

    def __init__(self, cfg: RadioConfig) -> None:
        self._cfg = cfg
        self._read_to_s: float | None = None
        self._steer_rad = 0.0

    def forget(self) -> None:
        """Reset, because the clock of the robot was restarted."""
        self._read_to_s = None

    def read(self, sensors: Sensors, extras: BeaconFrame) -> BeaconMeasurements:
        """The readings of a frame; each wheel sample covers the time since the previous one."""
        if self._read_to_s is None or self._read_to_s > sensors.t + LATEST_S:  # the first, or the clock was set back
            self._read_to_s = sensors.t
        steering = {sample.t_s: sample.steer_rad for sample in extras.steer}
        wheels = [self._interval(sample, steering) for sample in possible_samples(sensors.t, sensors.enc)]
        return BeaconMeasurements(sensors.t, tuple(one for one in wheels if one is not None), extras)

    def _interval(self, sample: WheelSample, steering: dict[float, float]) -> Odometry | None:
        self._steer_rad = steering.get(sample.t_s, self._steer_rad)
        right, left = sample.right_rad_s, sample.left_rad_s
        before_s = sample.t_s if self._read_to_s is None else self._read_to_s
        interval_s = sample.t_s - before_s
        if right is None or left is None or interval_s < _EPSILON_S:
            return None  # the next sample also covers this time
        self._read_to_s = sample.t_s
        radius_m = self._cfg.robot.wheel_radius_m
        speed_m_s = 0.5 * radius_m * (right + left)
        rate_rad_s = radius_m * (right - left) / self._cfg.vehicle.track_m
        return odometry_of(self._cfg, sample.t_s, interval_s, speed_m_s, self._steer_rad, rate_rad_s)


class PoseBelief(NamedTuple):
    """The estimated pose."""

    pose: tuple[float, float, float]  # x m, y m, heading rad (continuous)
    covariance: FloatArray  # of the pose, shape (3, 3)

    @property
    def ellipse(self) -> Ellipse:
        """Position x, y (m) and its covariance xx, xy, yy (m^2)."""
        return ellipse_of(self.pose, self.covariance)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position in its worst direction."""
        return worst_sigma_m(*self.ellipse[2:])


class Score(NamedTuple):
    """Consistency of all readings so far with their predictions."""

    nis_sum: float  # of the readings that were used
    nis_size: int  # their degrees of freedom: two of a level with a bearing
    used: int  # readings
    refused: int  # readings


def ellipse_of(mean: FloatArray | Sequence[float], covariance: FloatArray) -> Ellipse:
    """Position and covariance as xx, xy, yy; shapes (2+,) and (2+, 2+)."""
    return (float(mean[0]), float(mean[1]), float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1]))


class _VehicleNavigator:
    """The position by odometry alone, the pose at the time of the frame, and the consistency of the readings.

    Wheels and receivers have sample times of their own: a base sends its counts ten times a second, and they are up to
    0.1 s older than the frame. Between the newest sample and the time of a reading, or of the frame, the vehicle is
    assumed to keep its speed, for one interval of its odometry at most.
    """

    def __init__(self, cfg: RadioConfig) -> None:
        self._cfg, self._motion = cfg, SlippingVehicle(cfg.vehicle, cfg.odometry)
        self._clock, self._t_s = DeadReckoning(is_delayed=False), 0.0
        self._reckoned = np.zeros(self._motion.size)
        self._reckoned[:POSE] = cfg.start.x_m, cfg.start.y_m, cfg.start.heading_rad
        self.score = Score(0.0, 0, 0, 0)

    def _count(self, nis: float, size: int, *, accepted: bool) -> None:
        nis_sum, nis_size, used, refused = self.score
        if accepted:
            self.score = Score(nis_sum + nis, nis_size + size, used + 1, refused)
        else:
            self.score = Score(nis_sum, nis_size, used, refused + 1)

    def _belief(self, pose: Sequence[float], covariance: FloatArray) -> PoseBelief:
        """At the time of the frame, from that of the newest odometry."""
        x_m, y_m, heading_rad = self._clock.at(list(pose), self._t_s, 0.0).pose
        return PoseBelief((x_m, y_m, heading_rad), covariance)

    @property
    def reckoned_m(self) -> tuple[float, float]:
        """Position by odometry alone."""
        return float(self._reckoned[0]), float(self._reckoned[1])


class RadioNavigator(_VehicleNavigator):
    """EKF-SLAM with levels and bearings of radios, which are mapped while the robot drives."""

    is_mapping, map_readings, map_lacks = False, 0, ""  # the map grows while the robot drives

    def __init__(self, cfg: RadioConfig) -> None:
        super().__init__(cfg)
        self._scan, self._target = ReflectorScan(cfg.scan), cfg.follow.target
        self.slam = SignalSlam(cfg)
        self._received_s: float | None = None

    @property
    def belief(self) -> PoseBelief:
        """Of the robot."""
        return self._belief(self.slam.pose, self.slam.pose_covariance)

    @property
    def beacons(self) -> Mapping[str, Ellipse]:
        """The map of the radios, including the target."""
        return {str(name): ellipse_of(found.mean, found.covariance) for name, found in self.slam.beacons.items()}

    @property
    def notes(self) -> Mapping[str, float]:
        """Calibration of the vehicle."""
        return {name: mean for name, (mean, _) in self.slam.calibration.items()}

    def target(self, t_s: float) -> TargetSight | None:
        """The followed radio at time ``t_s``; ``None`` before its first reading."""
        estimate = self.slam.beacons.get(self._target)
        if estimate is None or self._received_s is None:
            return None
        x_m, y_m = estimate.mean[:2].tolist()
        sigma_m = self.slam.distance(self._target)[1]
        return TargetSight((x_m, y_m), sigma_m, t_s - self._received_s, self.slam.moving_velocity_m_s)

    def take(self, measurements: BeaconMeasurements) -> None:
        """Predict over the odometry intervals, then update with the readings of the frame."""
        for odometry in measurements.wheels:
            before = np.array(self.slam.pose)
            self.slam.predict(odometry)
            self._clock.took(odometry, before, np.array(self.slam.pose))
            self._reckoned = self._motion.step(self._reckoned, odometry).mean
        t_s, extras = measurements.t_s, measurements.extras
        self._t_s = t_s
        readings = [] if extras.scan is None else self._scan.results(t_s, packets_of(extras.scan))
        readings += [
            Reading(t_s, one.beacon, bearing_rad=one.bearing_rad, rssi_dbm=one.rssi_dbm) for one in extras.radio
        ]
        for one in self.slam.observe(readings):
            self._count(one.nis, one.size, accepted=one.accepted)
        if any(reading.beacon == self._target for reading in readings):
            self._received_s = t_s


_PLACE = 2
_NEAREST_M = 0.02  # lower limit of a distance, below which a range has no direction


class MoteNavigator(_VehicleNavigator):
    """An EKF over the robot and all motes of the map.

    State: pose and calibration of the vehicle, then the motes. The map is added with the joint covariance of its
    self-mapping, so that correlated errors are treated as such: a range corrects both the robot and the map, according
    to their covariances. A range is z = |p - m| + noise.
    """

    def __init__(self, cfg: RadioConfig) -> None:
        super().__init__(cfg)
        start = cfg.start
        self._self_map = SelfMap(cfg.cricket)
        self._gate = float(chdtri(1, 1.0 - cfg.listener.gate_probability))
        sigmas = np.zeros(self._motion.size)
        sigmas[:POSE] = start.position_sigma_m, start.position_sigma_m, start.heading_sigma_rad
        sigmas[POSE:] = self._motion.prior_sigmas
        self._filter = EkfSlam(self._reckoned.copy(), np.diag(sigmas**2))
        self._place_of: dict[str, int] = {}

    @property
    def is_mapping(self) -> bool:
        """Whether the motes have no map yet; the robot must not move until then."""
        return not self._place_of

    @property
    def map_readings(self) -> int:
        """Readings between motes that the map could use so far."""
        return self._self_map.readings

    @property
    def map_lacks(self) -> str:
        """What the map needs most, for messages."""
        return self._self_map.lacking

    @property
    def belief(self) -> PoseBelief:
        """Of the robot."""
        return self._belief(self._filter.mean[:POSE].tolist(), self._filter.covariance[:POSE, :POSE].copy())

    @property
    def beacons(self) -> Mapping[str, Ellipse]:
        """The map of the robot; before that, the current map of the self-mapping."""
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
    def notes(self) -> Mapping[str, float]:
        """Expected errors of the map, its updates and its time."""
        return self._self_map.notes

    def target(self, _t_s: float) -> TargetSight | None:
        """None: there is no target to follow."""
        return None

    def take(self, measurements: BeaconMeasurements) -> None:
        """Predict over the odometry intervals, and update with each reading of the frame at its own time.

        Raises MappingError: the motes cannot be mapped. Raises TdoaError: an impossible delay or temperature.
        """
        state, bursts = self._filter, deque(measurements.extras.motes)
        for odometry in measurements.wheels:
            before = state.mean[: state.vehicle_size].copy()
            step = self._motion.step(before, odometry)
            state.predict(step.mean, step.F, step.Q)
            self._clock.took(odometry, before, step.mean)
            self._reckoned = self._motion.step(self._reckoned, odometry).mean
            while bursts and bursts[0].t_s <= odometry.time_s:
                self._take_burst(bursts.popleft())
        for burst in bursts:
            self._take_burst(burst)
        self._t_s = measurements.t_s
        if self.is_mapping and self._self_map.is_done and self._self_map.places is not None:
            positions_m, covariance_m2 = self._self_map.places
            none, size = np.empty(0, dtype=np.intp), positions_m.size  # no correlation with the robot yet
            state.augment("map", positions_m.ravel(), none, np.zeros((size, 0)), np.eye(size), covariance_m2)
            start = state.block("map").start
            self._place_of = {name: start + _PLACE * row for row, name in enumerate(self._self_map.names)}
            self._self_map.notes["map_time_s"] = measurements.t_s

    def _take_burst(self, burst: MoteBurst) -> None:
        if burst.listener == self._cfg.listener.name:
            self._range(burst)
        elif self.is_mapping:
            self._self_map.take(burst)

    def _range(self, burst: MoteBurst) -> None:
        at = self._place_of.get(burst.sender)
        if at is None or not burst.delays_s:
            return
        reading = pair_range(self._cfg.cricket, (burst.sender, burst.listener), burst.delays_s, burst.temperature_c)
        columns = columns_of(range(POSE), range(at, at + _PLACE))
        *pose, mx, my = self._filter.mean.take(columns).tolist()
        then = self._clock.at(pose, burst.t_s, 0.0)
        x, y, _ = then.pose
        r = max(hypot(x - mx, y - my), _NEAREST_M)
        ux, uy = (x - mx) / r, (y - my) / r
        h = np.array((*then.derivatives(ux, uy, 0.0, delayed=False), -ux, -uy))
        found = self._filter.update_row(columns, h, reading.range_m - r, reading.sigma_m**2, self._gate)
        self._count(found.nis, 1, accepted=found.accepted)


Navigator = RadioNavigator | MoteNavigator
