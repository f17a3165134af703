"""Turn-and-move waypoint tracking, thesis 3.3.1 and fig. 3.3: a leg is a turn in place and a straight drive.

The remaining angle or distance follows a profile with feed-forward, or the thesis's PID (eq. 3.4, in seconds).
"""

from enum import StrEnum
from math import asin, atan2, copysign, cos, exp, hypot, pi, sin, sqrt
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from ccatp.config.models import ControlConfig, GainsConfig, LimitsConfig, PidConfig
from ccatp.control.wheel_motion import Pose
from ccatp.core import Predicted, Twist
from ccatp.kinematics import wrap_pi


class PidState(msgspec.Struct, frozen=True):
    """State of a PID between two steps."""

    integral: float = 0.0
    derivative: float = 0.0
    last_error: float | None = None


class Pid:
    """C(s) = Kp + Ki/s + Kd s/(Tf s + 1), thesis eq. 3.4 in SI units with a filtered derivative.

    The integral neither grows past its own limit nor while the output is saturated in its direction.
    """

    def __init__(self, gains: PidConfig, output_limit: float) -> None:
        self._kp, self._ki, self._kd = gains.kp, gains.ki, gains.kd
        self._filter_s = gains.derivative_filter_s
        self._integral_limit = gains.integral_limit
        self._output_limit = output_limit

    def step(self, memory: PidState, error: float, dt_s: float) -> tuple[PidState, float]:
        """The next state, and the limited output, ``dt_s`` > 0 after the last step; ``ValueError`` otherwise."""
        if dt_s <= 0.0:
            raise ValueError(f"dt of a control step must be positive, got {dt_s} s")
        integral, derivative, last_error = memory.integral, memory.derivative, memory.last_error
        if self._kd and last_error is not None:
            slope = (error - last_error) / dt_s
            keep = exp(-dt_s / self._filter_s) if self._filter_s > 0.0 else 0.0
            derivative = keep * derivative + (1.0 - keep) * slope
        grown = integral + self._ki * error * dt_s
        grown = max(-self._integral_limit, min(self._integral_limit, grown))
        free = self._kp * error + self._kd * derivative
        output = free + grown
        limit = self._output_limit
        # Anti-windup: no further integration into a saturated output.
        if abs(output) <= limit or abs(free + grown) < abs(free + integral):
            integral = grown
        return PidState(integral, derivative, error), max(-limit, min(limit, free + integral))


class Profile(NamedTuple):
    """Trapezoidal profile from rest to rest over a signed distance (m or rad), time-optimal under both limits.

    ``peak`` is the largest speed, signed as the distance; ``cruise_s`` the duration at it.
    """

    distance: float
    peak: float
    acceleration: float
    ramp_s: float
    cruise_s: float
    duration_s: float

    @classmethod
    def rest_to_rest(cls, distance: float, v_max: float, a_max: float) -> "Profile":
        """Build the profile for ``distance`` under ``v_max`` and ``a_max`` (both > 0)."""
        if v_max <= 0.0 or a_max <= 0.0:
            raise ValueError(f"limits of a profile must be positive, got v_max={v_max}, a_max={a_max}")
        length = abs(distance)
        peak = min(v_max, sqrt(length * a_max))
        ramp_s = peak / a_max
        cruise_s = max((length - peak * ramp_s) / peak, 0.0) if peak > 0.0 else 0.0
        duration_s = 2.0 * ramp_s + cruise_s
        return cls(distance, copysign(peak, distance), copysign(a_max, distance), ramp_s, cruise_s, duration_s)

    def at(self, t_s: float) -> tuple[float, float]:
        """Position and velocity ``t_s`` seconds after the start, clamped to the start and the end."""
        distance, peak, acceleration, ramp_s, cruise_s, duration_s = self
        if t_s <= 0.0:
            return 0.0, 0.0
        if t_s < ramp_s:
            return 0.5 * acceleration * t_s * t_s, acceleration * t_s
        if t_s < ramp_s + cruise_s:
            return peak * (t_s - 0.5 * ramp_s), peak
        left = duration_s - t_s
        if left <= 0.0:
            return distance, 0.0
        return distance - 0.5 * acceleration * left * left, acceleration * left


def lag_feed_forward(now: float, after: float, dt_s: float, lag_s: float) -> float:
    """Set point that takes a first-order servo of time constant ``lag_s`` from ``now`` to ``after`` within ``dt_s``."""
    if lag_s <= 0.0:
        return after
    return now + (after - now) / (1.0 - exp(-dt_s / lag_s))


# Largest speed that feedback may add, as a part of the limit, so that the sum stays within the gate's headroom.
FEEDBACK_SHARE = 0.25


class AxisState(msgspec.Struct, frozen=True):
    """Progress of a motion: planned (position, speed) at ``t_s``, and the bang-bang time ``duration_s``.

    ``profile`` ends at ``duration_s``; a motion may be planned again.
    ``slip``: part by which the wheels travel further than the body.
    """

    duration_s: float
    profile: Profile
    t_s: float = 0.0
    planned: tuple[float, float] = (0.0, 0.0)
    slip: float = 0.0
    pid: PidState = PidState()


class BareAxis:
    """PID of the remaining quantity, thesis eqs 3.1 to 3.4; ``a_max`` is used only for the bang-bang time."""

    def __init__(self, gains: PidConfig, v_max: float, a_max: float) -> None:
        self._pid = Pid(gains, v_max)
        self._v_max, self._a_max = v_max, a_max

    def begin(self, remaining: float) -> AxisState:
        """Start a motion, which has no plan: its planned time is over at once."""
        profile = Profile.rest_to_rest(remaining, self._v_max, self._a_max)
        return AxisState(profile.duration_s, profile, t_s=profile.duration_s)

    def is_over(self, _motion: AxisState, remaining: float, tolerance: float, _speed: float | None) -> bool:
        """Whether the rest is within tolerance, at any speed."""
        return abs(remaining) <= tolerance

    def step(self, motion: AxisState, remaining: float, dt_s: float, _speed: float | None) -> tuple[AxisState, float]:
        """The PID's output."""
        pid, output = self._pid.step(motion.pid, remaining, dt_s)
        return replace(motion, pid=pid), output


class ProfiledAxis:
    """Follows a rest-to-rest profile x*(t) over the distance that remained at its start.

    With the tracking error e = remaining - (distance - x*) the set point is

        u = (1 + s) ff(v*) + Kp e + Kd (v* - v),    ds/dt = Kp e v* / (v_max^2 tau).

    ff compensates the servo's lag T: T e'' + (1 + Kd) e' + Kp e = 0. The slip s acts in proportion to the planned
    speed, and so ends with it. Kp e is bounded; if a plan ends far off, a second motion follows.
    """

    def __init__(self, gains: PidConfig, cfg: ControlConfig, v_max: float, a_max: float, lag_s: float) -> None:
        self._kp, self._kd = gains.kp, gains.kd
        self._v_max, self._a_max, self._lag_s = v_max, a_max, lag_s
        self._slip_gain = 1.0 / (v_max * v_max * cfg.slip_time_s)
        self._slip_limit = cfg.slip_limit
        self._feedback_limit = FEEDBACK_SHARE * v_max
        self._stop_time_s = cfg.stop_time_s

    def begin(self, remaining: float) -> AxisState:
        """Plan the motion over ``remaining``."""
        profile = Profile.rest_to_rest(remaining, self._v_max, self._a_max)
        return AxisState(profile.duration_s, profile)

    def is_over(self, motion: AxisState, remaining: float, tolerance: float, speed: float | None) -> bool:
        """Whether the plan is over, and the rest after the wheels have run down is within ``tolerance``."""
        if motion.t_s < motion.duration_s:
            return False
        coast = 0.0 if speed is None else speed * self._lag_s
        return abs(remaining - coast) <= tolerance

    def _renewed_if_far(self, motion: AxisState, remaining: float) -> AxisState:
        """Plan again if the plan ended further off than feedback can correct in time."""
        if motion.t_s < motion.duration_s or abs(remaining) <= 0.5 * self._feedback_limit * self._stop_time_s:
            return motion
        profile = Profile.rest_to_rest(remaining, self._v_max, self._a_max)
        return AxisState(motion.t_s + profile.duration_s, profile, motion.t_s)

    def step(self, motion: AxisState, remaining: float, dt_s: float, speed: float | None) -> tuple[AxisState, float]:
        """The motion ``dt_s`` later, and the set point until then, m/s or rad/s."""
        motion = self._renewed_if_far(motion, remaining)
        profile, (position, now), t_s = motion.profile, motion.planned, motion.t_s + dt_s
        planned = profile.at(t_s - (motion.duration_s - profile.duration_s))
        error = remaining - (profile.distance - position)
        bound, slip_bound = self._feedback_limit, self._slip_limit
        feedback = min(max(self._kp * error, -bound), bound)
        slip = min(max(motion.slip + self._slip_gain * feedback * now * dt_s, -slip_bound), slip_bound)
        if speed is not None:
            feedback += self._kd * (now - speed)
        set_point = (1.0 + slip) * lag_feed_forward(now, planned[1], dt_s, self._lag_s) + feedback
        return AxisState(motion.duration_s, profile, t_s, planned, slip), set_point


# Largest plausible drift per metre: beyond it the wheels have lost their grip.
CREEP_LIMIT = 0.3
Vector2 = tuple[float, float]
Speeds = Twist | Predicted | None


class LegView(msgspec.Struct, frozen=True):
    """The robot relative to its line: rest of the way, offset to the left, heading error, progress per driven metre."""

    ahead_m: float
    beside_m: float
    off_rad: float
    gain: float


class LegLine(msgspec.Struct, frozen=True):
    """The straight line through the stop along which a leg is driven, defined by its course.

    It always passes through the stop. When the stop's coordinates change, the frame has changed. Then a line to a far
    stop starts again at the robot; nearer than the look-ahead it keeps its angle to the robot, because the bearing of a
    near stop is mostly noise.
    """

    target: Vector2
    course_rad: float
    cos: float
    sin: float
    off_rad: float = 0.0

    @classmethod
    def lay(cls, target: Vector2, course_rad: float) -> "LegLine":
        """The line through a stop with a given course."""
        return cls(target, course_rad, cos(course_rad), sin(course_rad))

    @classmethod
    def through(cls, pose: Pose, target: Vector2) -> "LegLine":
        """The line from the robot at (x, y, heading) to the stop."""
        return cls.lay(target, atan2(target[1] - pose[1], target[0] - pose[0]))

    def look(
        self, pose: Pose, target: Vector2, creep: Vector2, reverse: bool, lookahead_m: float
    ) -> "tuple[LegLine, LegView]":
        """The line for the next steps, and the robot at ``pose`` = (x, y, heading) relative to it.

        The body moves along its axis m and drifts by c per metre: (m + c) lies along the line when the part of m across
        it cancels that of c, ``sin(crab) = -c_across``; progress is ``cos(crab) + c_along``.
        """
        x, y, heading = pose
        motion = heading + pi if reverse else heading
        dx, dy = target[0] - x, target[1] - y
        line = self
        if target != self.target:
            is_far = dx * dx + dy * dy > lookahead_m * lookahead_m
            kept_rad = motion - crab(self.course_rad, creep) - self.off_rad
            line = LegLine.lay(target, atan2(dy, dx) if is_far else wrap_pi(kept_rad))
        course_rad, c, s = line.course_rad, line.cos, line.sin
        creep_x, creep_y = creep
        angle = -asin(min(max(c * creep_y - s * creep_x, -CREEP_LIMIT), CREEP_LIMIT))
        off = wrap_pi(motion - course_rad - angle)
        along = min(max(c * creep_x + s * creep_y, -CREEP_LIMIT), CREEP_LIMIT)
        view = LegView(c * dx + s * dy, s * dx - c * dy, off, cos(angle) + along)
        return LegLine(target, course_rad, c, s, off), view


def crab(course_rad: float, creep: Vector2) -> float:
    """Angle between body and course that compensates the drift, rad."""
    across = cos(course_rad) * creep[1] - sin(course_rad) * creep[0]
    return -asin(min(max(across, -CREEP_LIMIT), CREEP_LIMIT))


def line_rate(sight: LegView, v_m_s: float, cross_gain_rad_m2: float, heading_weight_1_s2: float) -> float:
    """Angular rate of the optimal regulator of ``e' = v theta, theta' = omega``, rad/s; see docs/mathematics.md.

        omega = -g v e - sqrt(w + 2 g v^2) theta

    With g = ``cross_gain_rad_m2`` the error decays over about 1/sqrt(g) of travel.
    """
    gain = cross_gain_rad_m2 * v_m_s
    return -gain * sight.beside_m - sqrt(heading_weight_1_s2 + 2.0 * gain * v_m_s) * sight.off_rad


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
            self.forward, self.angular = BareAxis(gains.forward, v, a), BareAxis(gains.angular, omega, alpha)
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
        self._control, self._shaped = control, gains.shaped
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
