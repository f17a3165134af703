"""The danger rules of a robot among beacons: verdict and permits for each frame, from the frame and an estimate.

The rules use the robot's own sensors. Of main's estimate they use only the uncertainty and the age. The table of the
rules is in ``docs/beacon_missions.md``.
"""

from collections import Counter, deque
from collections.abc import Sequence
from math import atan2, cos, hypot, inf, isfinite, log, pi, sin, sqrt
from typing import NamedTuple

from msgspec.structs import replace

from ccatp.beacons.conditions import (
    NO_FRESH_ESTIMATE,
    OBSTACLE_AHEAD,
    OBSTACLE_BEHIND,
    POSITION_UNCERTAIN,
    RADIO_SILENT,
    TARGET_NEAR,
)
from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.links.messages import BeaconFrame, decode_beacon_frame
from ccatp.conditions import MonitorFinding
from ccatp.conditions.danger import ENCODERS_STALE, NO_FRAME
from ccatp.core import EventCode, Permits, Verdict
from ccatp.kinematics import wrap_pi
from ccatp.links.robot_codec import BadLine
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.safety.escalation import limit_s
from ccatp.safety.rules import SafetyRules
from ccatp.sensing.sample_times import LATEST_S, possible_samples


class _Obstacle(NamedTuple):
    time_s: float
    x_m: float  # in the robot frame at the last reset
    y_m: float


class ObstacleBuffer:
    """Recent echoes of the distance sensors, in the frame of dead reckoning.

    Within ``memory_s`` dead reckoning drifts by less than a sensor's noise. Echoes beyond ``reach_m`` are not kept.
    """

    def __init__(self, sensors_rad: Sequence[float], reach_m: float, memory_s: float) -> None:
        self._sensors_rad, self._reach_m, self._memory_s = tuple(sensors_rad), reach_m, memory_s
        self._echoes: deque[_Obstacle] = deque()
        self._x_m = self._y_m = self._heading_rad = self._steer_rad = 0.0

    def roll(self, way_m: float, course_rad: float, turn_rad: float) -> None:
        """Move the robot by ``way_m``, then turn it by ``turn_rad``.

        ``course_rad``: direction of the motion, left of the heading before it; the steering angle of a steered wheel.
        """
        along_rad = self._heading_rad + course_rad
        self._x_m += way_m * cos(along_rad)
        self._y_m += way_m * sin(along_rad)
        self._heading_rad += turn_rad

    def see(self, time_s: float, distances_m: Sequence[float]) -> None:
        """Add the readings of a frame, in the order of the sensors, and drop those older than the memory."""
        while self._echoes and time_s - self._echoes[0].time_s > self._memory_s:
            self._echoes.popleft()
        for angle_rad, distance_m in zip(self._sensors_rad, distances_m, strict=False):
            if distance_m < self._reach_m:
                at_rad = self._heading_rad + angle_rad
                x_m, y_m = self._x_m + distance_m * cos(at_rad), self._y_m + distance_m * sin(at_rad)
                self._echoes.append(_Obstacle(time_s, x_m, y_m))

    def nearest_m(self, course_rad: float, within_rad: float) -> float:
        """Distance to the nearest echo within ``within_rad`` of a course, left of the heading; infinite without one."""
        found = inf
        for echo in self._echoes:
            dx_m, dy_m = echo.x_m - self._x_m, echo.y_m - self._y_m
            distance_m = hypot(dx_m, dy_m)
            if distance_m < found:
                off_rad = wrap_pi(atan2(dy_m, dx_m) - self._heading_rad - course_rad)
                if abs(off_rad) <= within_rad:
                    found = distance_m
        return found


_NORMAL, _NEAR, _ABORTED = EventCode


class BeaconSafetyRules(SafetyRules):
    """Gives one verdict per frame. Call ``step`` for each frame, ``stale`` when no frame arrived in time."""

    code: EventCode = _NORMAL

    def __init__(self, cfg: RadioConfig) -> None:
        self._danger, self._follow, self._loss = cfg.danger, cfg.follow, cfg.path_loss
        self._avoidance, self._vehicle, self._radius_m = cfg.avoidance, cfg.vehicle, cfg.robot.wheel_radius_m
        self._denials: Counter[str] = Counter()
        super().__init__()

    def reset(self) -> None:
        """Begin again after a boot of the robot, whose clock has restarted. Emergencies stay latched."""
        super().reset()
        self._radio_s: float | None = None
        self._wheels_s: float | None = None  # newest encoder sample
        self._levels: deque[tuple[float, float]] = deque()
        avoidance = self._avoidance
        self._echoes = ObstacleBuffer(avoidance.sensors_rad, avoidance.influence_m, self._danger.memory_s)
        self._rolled_to_s: float | None = None
        self._steer_rad = 0.0
        self._held_since_s: float | None = None
        self._is_vague = False
        self._state, self._state_seq = "idle", 0
        self._frame_seq = -1
        self.code = _NORMAL

    def limit_wheels(self, _max_wheel_rad_s: float) -> None:
        """No rule compares wheels with their set points."""

    # -- frames ---------------------------------------------------------------------------------------------------

    def judge(self, sensors: Sensors, raw: bytes, estimate: EstimateMessage | None) -> Verdict:
        """See ``SafetyRules``. Without the distances in a line, obstacles are not known: no motion."""
        try:
            extras = decode_beacon_frame(raw)
        except BadLine:
            return self.stale(sensors.seq, sensors.t)
        return self.step(sensors, extras, estimate)

    def step(self, sensors: Sensors, extras: BeaconFrame, estimate: EstimateMessage | None) -> Verdict:
        """The verdict on one frame. A frame that is not new is not judged: no motion is permitted."""
        if sensors.seq <= self._frame_seq:
            return self.stale(sensors.seq, sensors.t)
        self._frame_seq = sensors.seq
        self._take_readings(sensors.t, extras)
        self._roll(sensors, extras)
        self._echoes.see(sensors.t, extras.distances)
        if estimate is not None:
            self._state, self._state_seq = estimate.state, estimate.seq
        hold = self._hold(sensors.t, estimate)
        verdict = self._near(sensors)
        if hold is not None:
            verdict = self._held(sensors, hold, verdict.code)
        else:
            self._held_since_s = None
        self.code = verdict.code
        if verdict.signal:
            self._denials[verdict.signal] += 1
        return self.latch.with_emergencies(verdict)

    def stale(self, seq: int, t_s: float) -> Verdict:
        """The verdict when no frame arrived for ``stale_after_s``: no motion is permitted."""
        limit_s = self._danger.stale_after_s
        found = NO_FRAME.found("sensors", limit_s, limit_s)
        return self.latch.with_emergencies(found.verdict(seq, t_s, self._unmoved_code))

    def garbled(self, seq: int, t_s: float, _at_s: float) -> Verdict | None:
        """The verdict after a line that is not a frame: no motion is permitted until the next frame."""
        return self.stale(seq, t_s)

    @property
    def counts(self) -> dict[str, object]:
        """Number of frames on which motion was denied, by signal."""
        return {"denied": dict(self._denials)}

    def _take_readings(self, t_s: float, extras: BeaconFrame) -> None:
        names = {sample.beacon for sample in extras.radio}
        if extras.scan is not None:
            names |= {name for name, levels in extras.scan.levels.items() if any(z is not None for z in levels)}
        has_reading = bool(names - {self._follow.target}) or bool(extras.motes)
        if self._radio_s is None or has_reading:
            self._radio_s = t_s
        self._levels.extend((t_s, sample.rssi_dbm) for sample in extras.radio if sample.beacon == self._follow.target)
        if extras.scan is not None:
            levels = [z for z in extras.scan.levels.get(self._follow.target, ()) if z is not None]
            self._levels.extend([(t_s, max(levels))] if levels else [])
        while self._levels and t_s - self._levels[0][0] > self._danger.target_window_s:
            self._levels.popleft()

    def _roll(self, sensors: Sensors, extras: BeaconFrame) -> None:
        steering, vehicle = {sample.t_s: sample.steer_rad for sample in extras.steer}, self._vehicle
        if self._rolled_to_s is not None and self._rolled_to_s > sensors.t + LATEST_S:
            self._rolled_to_s = None  # the robot's clock was set back
        for t_s, right, left in possible_samples(sensors.t, sensors.enc):
            if right is not None and left is not None:
                self._wheels_s = t_s
            before_s = sensors.t if self._rolled_to_s is None else self._rolled_to_s
            if right is None or left is None or t_s <= before_s:
                continue
            interval_s, self._rolled_to_s = t_s - before_s, t_s
            way_m = 0.5 * self._radius_m * (right + left) * interval_s
            if vehicle.kind == "ackermann":
                self._steer_rad = steering.get(t_s, self._steer_rad)
                turn_rad = way_m * sin(self._steer_rad) / vehicle.wheelbase_m
                self._echoes.roll(way_m, self._steer_rad, turn_rad)
            else:
                turn_rad = self._radius_m * (right - left) / vehicle.track_m * interval_s
                self._echoes.roll(way_m, 0.5 * turn_rad, turn_rad)
        if self._rolled_to_s is None:
            self._rolled_to_s = sensors.t

    def _hold(self, t_s: float, estimate: EstimateMessage | None) -> MonitorFinding | None:
        danger = self._danger
        newest_s = t_s if self._radio_s is None else self._radio_s
        if t_s - newest_s > danger.radio_timeout_s:
            return RADIO_SILENT.found("radio", t_s - newest_s, danger.radio_timeout_s)
        silent_s = t_s if self._wheels_s is None else t_s - self._wheels_s
        if not silent_s <= danger.stale_after_s:
            return ENCODERS_STALE.found("enc", silent_s, danger.stale_after_s)
        age_s = inf if estimate is None else t_s - estimate.t_s
        if estimate is None or not age_s <= danger.estimate_timeout_s:
            limit_s = danger.estimate_timeout_s
            is_beginning = estimate is None and t_s <= limit_s
            return None if is_beginning else NO_FRESH_ESTIMATE.found("estimate", min(age_s, 1e9), limit_s)
        limit_m = danger.position_clear_m if self._is_vague else danger.position_sigma_m
        self._is_vague = not (isfinite(estimate.sigma_m) and estimate.sigma_m <= limit_m)
        if self._is_vague:
            return POSITION_UNCERTAIN.found("position", min(estimate.sigma_m, 1e9), limit_m)
        return None

    def _held(self, sensors: Sensors, hold: MonitorFinding, code: EventCode) -> Verdict:
        if self._held_since_s is None:
            self._held_since_s = sensors.t
        patience_s = limit_s(hold.condition, self._danger)
        if sensors.t - self._held_since_s > patience_s:
            cause = replace(hold.cause, lasted_s=patience_s)
            hold = hold._replace(severity=hold.condition.raised_severity, cause=cause)
        return hold.verdict(sensors.seq, sensors.t, code)

    @property
    def _unmoved_code(self) -> EventCode:
        return _ABORTED if self.latch.is_latched else _NORMAL

    def _near(self, sensors: Sensors) -> Verdict:
        seq, t_s, danger = sensors.seq, sensors.t, self._danger
        emergency = self.latch.verdict(seq, t_s)
        if emergency is not None and not emergency.forward:
            return emergency
        ahead_m = self._echoes.nearest_m(self._steer_rad, danger.ahead_rad)
        behind_m = self._echoes.nearest_m(self._steer_rad + pi, danger.ahead_rad)
        target_m = self._nearest_target_m()
        forward, reverse = ahead_m >= danger.obstacle_m and target_m >= danger.target_m, behind_m >= danger.obstacle_m
        if ahead_m < danger.obstacle_m:
            row, found = OBSTACLE_AHEAD, ("obstacle", ahead_m, danger.obstacle_m)
        elif target_m < danger.target_m:
            row, found = TARGET_NEAR, ("target", target_m, danger.target_m)
        elif behind_m < danger.obstacle_m:
            row, found = OBSTACLE_BEHIND, ("obstacle", behind_m, danger.obstacle_m)
        else:
            return emergency or Verdict.normal(seq, t_s)
        permits = row.motion.permits(Permits(forward, reverse, turn=True))
        return Verdict(seq, t_s, row.code, row.cause(), *found, *permits)

    def _nearest_target_m(self) -> float:
        """Lower bound of the target's distance: mean level minus one standard deviation; infinite without a level."""
        if not self._follow.is_active or not self._levels:
            return inf
        loss = self._loss
        mean_dbm = sum(level for _, level in self._levels) / len(self._levels)
        reference_dbm = loss.reference_dbm_of.get(self._follow.target, loss.reference_dbm)
        decades = (reference_dbm - mean_dbm) / (10.0 * loss.exponent)
        sigma = self._danger.target_level_sigma_db * log(10.0) / (10.0 * loss.exponent) / sqrt(len(self._levels))
        return float(10.0**decades) * (1.0 - min(sigma, 1.0))
