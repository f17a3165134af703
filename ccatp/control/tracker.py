"""Turn-and-move waypoint tracking, thesis 3.3.1 and fig. 3.3: a leg is a turn in place and a straight drive.

The remaining angle or distance follows a profile with feed-forward, or the thesis's PID (eq. 3.4, in seconds).
"""

from enum import StrEnum
from math import atan2, cos, hypot, pi, sin

import msgspec
from msgspec.structs import replace

from ccatp.config.models import ControlConfig, GainsConfig, LimitsConfig
from ccatp.control.axis import AxisState, BareAxis, ProfiledAxis
from ccatp.control.line import LegLine, crab, line_rate
from ccatp.control.pid import Pid, PidState
from ccatp.control.wheel_motion import Pose
from ccatp.core import Predicted, Twist, Vector2
from ccatp.kinematics import wrap_pi

Speeds = Twist | Predicted | None


# Bearing error at which an unshaped drive stops and aligns again, as in the thesis.
REALIGN_RAD = 0.5
# A stop nearer than this whose bearing changes by more than REALIGN_RAD in a turn counts as reached: the turn itself
# moves the robot by millimetres, so it would never reach the bearing.
ALL_BUT_THERE_M = 0.01
NO_CREEP = (0.0, 0.0)
STILL = Twist(0.0, 0.0)


class LegPhase(StrEnum):
    """Phase of a leg."""

    TURN = "turn"
    DRIVE = "drive"
    DONE = "done"


TURN, DRIVE, DONE = LegPhase


class LegMotion(msgspec.Struct, frozen=True):
    """Progress of a leg or of a turn in place, made by ``LegTracker``.

    ``axis``: the turn or the drive along the line, by ``phase``; ``aim``: stop and heading at the start of a turn.
    """

    phase: LegPhase
    is_slow: bool
    reverse: bool
    axis: AxisState
    line: LegLine | None = None
    aim: tuple[Vector2, float] = ((0.0, 0.0), 0.0)
    steering: PidState = PidState()

    @property
    def planned_s(self) -> float:
        """Bang-bang time of the motion."""
        return self.axis.duration_s


class _Pace:
    """Controllers for one set of speed limits."""

    def __init__(self, gains: GainsConfig, control: ControlConfig, limits: LimitsConfig, wheel_lag_s: float) -> None:
        v, a, omega, alpha = limits.v_max_m_s, limits.a_max_m_s2, limits.omega_max_rad_s, limits.alpha_max_rad_s2
        self.along = ProfiledAxis(gains.forward, control, v, a, wheel_lag_s)
        self.forward: BareAxis | ProfiledAxis = self.along
        self.angular: BareAxis | ProfiledAxis = ProfiledAxis(gains.angular, control, omega, alpha, wheel_lag_s)
        if not gains.shaped:
            self.forward = BareAxis(gains.forward, v, a)
            self.angular = BareAxis(gains.angular, omega, alpha)
        self.steering = Pid(gains.angular, omega)
        self.omega_max = omega


class LegTracker:
    """Drives one leg: turn in place to the bearing of the target, then move to it, forward or in reverse.

    Pose, target and creep (drift per metre of travel) are in one plane, which may change from step to step. With a
    shaped set of gains the robot follows the line from the start of the drive; with the thesis's gains it heads for the
    stop. ``slow_limits``: for motions that begin with ``is_slow``.
    """

    def __init__(
        self, control: ControlConfig, limits: LimitsConfig, wheel_lag_s: float, slow_limits: LimitsConfig | None = None
    ) -> None:
        gains = control.gain_sets[control.gains]
        self._control = control
        self._shaped = gains.shaped
        self._position_tolerance_m = gains.position_tolerance_m
        self._heading_tolerance_rad = gains.heading_tolerance_rad
        self._straight_rad = max(control.straight_tolerance_rad, gains.heading_tolerance_rad)
        self._steering_damping = gains.angular.kd
        self._paces = tuple(_Pace(gains, control, one, wheel_lag_s) for one in (limits, slow_limits or limits))

    def begin(
        self, pose: Pose, target: Vector2, reverse: bool, creep: Vector2 = NO_CREEP, *, is_slow: bool = False
    ) -> LegMotion:
        """Start a leg from ``pose``."""
        if hypot(target[0] - pose[0], target[1] - pose[1]) <= self._position_tolerance_m:
            # The stop is reached, and the bearing of such a near stop is noise.
            return LegMotion(DONE, is_slow, reverse, self._paces[is_slow].forward.begin(0.0))
        angle = self._bearing_error(pose, target, creep, reverse)
        if abs(angle) > self._straight_rad:
            return self._begin_alignment(pose, target, angle, reverse, is_slow)
        return self._begin_drive(pose, target, reverse, is_slow)

    def begin_turn(self, angle_rad: float, *, is_slow: bool = False) -> LegMotion:
        """Start a turn in place by ``angle_rad`` (use with ``step_turn``)."""
        return LegMotion(TURN, is_slow, False, self._paces[is_slow].angular.begin(angle_rad))

    def step_turn(
        self, motion: LegMotion, remaining_rad: float, dt_s: float, rate_rad_s: float | None = None
    ) -> tuple[LegMotion, Twist]:
        """One step of a turn in place; ``phase`` becomes DONE when it is over."""
        angular = self._paces[motion.is_slow].angular
        if angular.is_over(motion.axis, remaining_rad, self._heading_tolerance_rad, rate_rad_s):
            return replace(motion, phase=DONE), STILL
        axis, rate = angular.step(motion.axis, remaining_rad, dt_s, rate_rad_s)
        return replace(motion, axis=axis), Twist(0.0, rate)

    def step(
        self,
        motion: LegMotion,
        pose: Pose,
        target: Vector2,
        dt_s: float,
        speeds: Speeds = None,
        creep: Vector2 = NO_CREEP,
    ) -> tuple[LegMotion, Twist]:
        """The next motion, and the twist for ``dt_s``; ``pose``: where the twist will take effect."""
        if motion.phase is TURN:
            angle = self._bearing_error(pose, target, creep, motion.reverse)
            rate_rad_s = None if speeds is None else speeds.omega_rad_s
            if motion.axis.t_s >= motion.axis.duration_s:
                motion, has_run_away = self._look_at_bearing(motion, pose, target, angle)
                if has_run_away:
                    return replace(motion, phase=DONE), STILL
            angular = self._paces[motion.is_slow].angular
            if not angular.is_over(motion.axis, angle, self._heading_tolerance_rad, rate_rad_s):
                axis, rate = angular.step(motion.axis, angle, dt_s, rate_rad_s)
                return replace(motion, axis=axis), Twist(0.0, rate)
            motion = self._begin_drive(pose, target, motion.reverse, motion.is_slow)
        if motion.phase is DONE:
            return motion, STILL
        if self._shaped:
            return self._drive(motion, pose, target, dt_s, speeds, creep)
        return self._head_on(motion, pose, target, dt_s)

    def _begin_alignment(
        self, pose: Pose, target: Vector2, angle_rad: float, reverse: bool, is_slow: bool
    ) -> LegMotion:
        axis = self._paces[is_slow].angular.begin(angle_rad)
        return LegMotion(TURN, is_slow, reverse, axis, aim=(target, pose[2] + angle_rad))

    def _look_at_bearing(
        self, motion: LegMotion, pose: Pose, target: Vector2, angle_rad: float
    ) -> tuple[LegMotion, bool]:
        """Whether the bearing of a very near stop has run away since the turn began (in the same frame)."""
        if hypot(target[0] - pose[0], target[1] - pose[1]) > ALL_BUT_THERE_M:
            return motion, False
        aimed_at, heading_rad = motion.aim
        if target != aimed_at:
            return replace(motion, aim=(target, pose[2] + angle_rad)), False
        return motion, abs(wrap_pi(pose[2] + angle_rad - heading_rad)) > REALIGN_RAD

    def _begin_drive(self, pose: Pose, target: Vector2, reverse: bool, is_slow: bool) -> LegMotion:
        axis = self._paces[is_slow].forward.begin(hypot(target[0] - pose[0], target[1] - pose[1]))
        return LegMotion(DRIVE, is_slow, reverse, axis, LegLine.through(pose, target))

    def _bearing_error(self, pose: Pose, target: Vector2, creep: Vector2, reverse: bool) -> float:
        """Thesis eq. 3.2, e = beta - theta with beta = atan2(dy, dx); printed there with the arguments exchanged.

        In reverse the tail points at the target. A shaped drive adds the angle that compensates the drift.
        """
        beta = atan2(target[1] - pose[1], target[0] - pose[0])
        beta += crab(beta, creep) if self._shaped else 0.0
        return wrap_pi(beta - pose[2] - (pi if reverse else 0.0))

    def _drive(
        self, motion: LegMotion, pose: Pose, target: Vector2, dt_s: float, speeds: Speeds, creep: Vector2
    ) -> tuple[LegMotion, Twist]:
        control, pace = self._control, self._paces[motion.is_slow]
        reverse, axis = motion.reverse, motion.axis
        line, view = (motion.line or LegLine.through(pose, target)).look(
            pose, target, creep, reverse, control.lookahead_m
        )
        sign = -1.0 if reverse else 1.0
        ahead_m, gain = view.ahead_m, view.gain
        speed = None if speeds is None else sign * speeds.v_m_s * gain
        if axis.t_s >= axis.duration_s:
            is_late = axis.t_s - axis.duration_s >= control.stop_time_s
            if pace.along.is_over(axis, ahead_m, control.stop_tolerance_m, speed) or is_late:
                return replace(motion, phase=DONE), STILL
        planned = axis.planned[1]
        axis, wanted = pace.along.step(axis, ahead_m, dt_s, speed)
        wanted /= gain
        rate = line_rate(view, planned, control.cross_track_gain_rad_m2, control.heading_weight_1_s2)
        if speeds is not None:
            rate += self._steering_damping * (rate - speeds.omega_rad_s)
        next_motion = LegMotion(DRIVE, motion.is_slow, reverse, axis, line)
        return next_motion, Twist(sign * wanted, min(max(rate, -pace.omega_max), pace.omega_max))

    def _head_on(self, motion: LegMotion, pose: Pose, target: Vector2, dt_s: float) -> tuple[LegMotion, Twist]:
        """The thesis's drive: one PID on the distance, one on the bearing, eqs 3.1 to 3.4."""
        x, y, heading = pose
        dx, dy = target[0] - x, target[1] - y
        c, s = cos(heading), sin(heading)
        ahead, left = c * dx + s * dy, c * dy - s * dx
        if motion.reverse:
            ahead, left = -ahead, -left
        remaining = hypot(ahead, left)
        pace = self._paces[motion.is_slow]
        if pace.forward.is_over(motion.axis, remaining, self._position_tolerance_m, None):
            return replace(motion, phase=DONE), STILL
        error = atan2(left, ahead)
        if abs(error) > REALIGN_RAD:
            return self._begin_alignment(pose, target, error, motion.reverse, motion.is_slow), STILL
        axis, speed = pace.forward.step(motion.axis, remaining, dt_s, None)
        steering, rate = pace.steering.step(motion.steering, error, dt_s)
        speed = -speed if motion.reverse else speed
        return replace(motion, axis=axis, steering=steering), Twist(speed, rate)
