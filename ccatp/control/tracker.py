"""Turn-and-move waypoint tracking, thesis 3.3.1 and fig. 3.3."""

from collections import deque
from enum import StrEnum
from math import asin, atan2, cos, exp, hypot, pi, sin, sqrt
from typing import NamedTuple

from ccatp.config.models import ControlConfig, LimitsConfig
from ccatp.control.pid import BareAxis, Pid, ProfiledAxis, clamped
from ccatp.core import Predicted, Twist, wrap_pi

# Drift per metre beyond which an estimate is nonsense: a robot carried off that fast has lost its wheels' grip.
CREEP_LIMIT = 0.3


class LegView(NamedTuple):
    """The line as seen from the robot.

    ``beside_m``: how far the robot stands to the left of it; ``gain``: progress along it per metre that the wheels
    drive.
    """

    ahead_m: float
    beside_m: float
    off_rad: float
    gain: float


class LegLine:
    """The straight line through the stop along which a leg is driven, held by its course alone.

    So it passes through the stop wherever an update moves that. A stop whose coordinates change is one seen in another
    frame: from afar the line is laid again from the robot to the stop; nearer than ``lookahead_m`` it keeps its angle
    to the robot, because the bearing of a near stop is noise.
    """

    __slots__ = ("_cos", "_course_rad", "_lookahead_m", "_off_rad", "_reverse", "_sin", "_target")

    def __init__(self, lookahead_m: float) -> None:
        self._lookahead_m = lookahead_m
        self._target = (0.0, 0.0)
        self._off_rad = 0.0
        self._reverse = False
        self._lay(0.0)

    def begin(self, pose: tuple[float, float, float], target: tuple[float, float], reverse: bool) -> None:
        """Lay the line from the robot to the stop."""
        self._reverse, self._target = reverse, target
        self._lay(atan2(target[1] - pose[1], target[0] - pose[0]))
        self._off_rad = 0.0

    def look(
        self, pose: tuple[float, float, float], target: tuple[float, float], creep: tuple[float, float]
    ) -> LegView:
        """Where the robot at ``pose`` = (x, y, heading) stands.

        The body moves along its axis m and drifts by c per metre: (m + c) lies along the line when the part of m across
        it cancels that of c, ``sin(crab) = -c_across``; progress is ``cos(crab) + c_along``.
        """
        x, y, heading = pose
        motion = heading + pi if self._reverse else heading
        dx, dy = target[0] - x, target[1] - y
        if target != self._target:
            self._move_to(target, motion, dx, dy, crab(self._course_rad, creep))
        c, s = self._cos, self._sin
        creep_x, creep_y = creep
        angle = -asin(clamped(c * creep_y - s * creep_x, CREEP_LIMIT))
        self._off_rad = off = wrap_pi(motion - self._course_rad - angle)
        along = clamped(c * creep_x + s * creep_y, CREEP_LIMIT)
        return LegView(c * dx + s * dy, s * dx - c * dy, off, cos(angle) + along)

    def _move_to(self, target: tuple[float, float], motion: float, dx: float, dy: float, angle: float) -> None:
        self._target = target
        is_far = dx * dx + dy * dy > self._lookahead_m * self._lookahead_m
        self._lay(atan2(dy, dx) if is_far else wrap_pi(motion - angle - self._off_rad))

    def _lay(self, course_rad: float) -> None:
        self._course_rad, self._cos, self._sin = course_rad, cos(course_rad), sin(course_rad)


def crab(course_rad: float, creep: tuple[float, float]) -> float:
    """Angle by which the body has to point beside a course so that it is not carried off it, rad."""
    across = cos(course_rad) * creep[1] - sin(course_rad) * creep[0]
    return -asin(clamped(across, CREEP_LIMIT))


def line_rate(sight: LegView, v_m_s: float, cross_gain_rad_m2: float, heading_weight_1_s2: float) -> float:
    """Angular rate of the optimal regulator of ``e' = v theta, theta' = omega``, rad/s.

    Minimising the integral of ``(g v e)^2 + w theta^2 + omega^2`` the Riccati equation is solved by

        omega = -g v e - sqrt(w + 2 g v^2) theta.

    The weight of e grows with the speed: a robot that has all but stopped cannot remove it, and would only turn. With
    g = ``cross_gain_rad_m2`` the error decays over about 1/sqrt(g) of travel.
    """
    gain = cross_gain_rad_m2 * v_m_s
    return -gain * sight.beside_m - sqrt(heading_weight_1_s2 + 2.0 * gain * v_m_s) * sight.off_rad


# Further off the bearing than this an unshaped drive stops and aligns again: the thesis aligns first, then heads on.
REALIGN_RAD = 0.5
# A stop so near whose bearing moves by more than REALIGN_RAD in a turn is as good as reached: the turn itself shifts
# the robot by millimetres, and would chase a bearing that runs away from it.
ALL_BUT_THERE_M = 0.01
NO_CREEP = (0.0, 0.0)
STILL = Twist(0.0, 0.0)


class LegPhase(StrEnum):
    """What a leg is at."""

    TURN = "turn"
    DRIVE = "drive"
    DONE = "done"


TURN, DRIVE, DONE = LegPhase


class LegTracker:
    """Drives one leg: turn in place to the bearing of the target, then move to it, forward or in reverse.

    Pose, target and creep (drift per metre of travel) are in one plane, usually the panel frame, which may change from
    step to step. A shaped set of gains drives along the line from where the drive begins; the thesis's heads for the
    stop.
    """

    def __init__(self, control: ControlConfig, limits: LimitsConfig, wheel_lag_s: float) -> None:
        gains = control.gain_sets[control.gains]
        self._control, self._shaped = control, gains.shaped
        self._position_tolerance_m = gains.position_tolerance_m
        self._heading_tolerance_rad = gains.heading_tolerance_rad
        self._straight_rad = max(control.straight_tolerance_rad, gains.heading_tolerance_rad)
        self._forward: BareAxis | ProfiledAxis
        self._angular: BareAxis | ProfiledAxis
        v, a, omega, alpha = limits.v_max_m_s, limits.a_max_m_s2, limits.omega_max_rad_s, limits.alpha_max_rad_s2
        self._along = ProfiledAxis(gains.forward, control, v, a, wheel_lag_s)
        if gains.shaped:
            self._forward = self._along
            self._angular = ProfiledAxis(gains.angular, control, omega, alpha, wheel_lag_s)
        else:
            self._forward, self._angular = BareAxis(gains.forward, v, a), BareAxis(gains.angular, omega, alpha)
        self._steering = Pid(gains.angular, omega)
        self._line = LegLine(control.lookahead_m)
        self._steering_damping = gains.angular.kd
        self._omega_max = omega
        self._reverse = False
        self._aim = (0.0, 0.0), 0.0  # stop and heading of the turn under way
        self.phase = DONE

    def begin(
        self,
        pose: tuple[float, float, float],
        target: tuple[float, float],
        reverse: bool,
        creep: tuple[float, float] = NO_CREEP,
    ) -> None:
        """Start a leg from ``pose`` = (x, y, heading)."""
        self._reverse = reverse
        if hypot(target[0] - pose[0], target[1] - pose[1]) <= self._position_tolerance_m:
            self.phase = DONE  # it is there, and the bearing of a stop so near is noise
            return
        angle = self._bearing_error(pose, target, creep)
        if abs(angle) > self._straight_rad:
            self._begin_alignment(pose, target, angle)
        else:
            self._begin_drive(pose, target)

    def begin_turn(self, angle_rad: float) -> None:
        """Start a turn in place by ``angle_rad`` (use with ``step_turn``)."""
        self.phase = TURN
        self._angular.begin(angle_rad)

    @property
    def planned_s(self) -> float:
        """Bang-bang time of the motion begun last."""
        return self._angular.duration_s if self.phase is TURN else self._forward.duration_s

    def step_turn(self, remaining_rad: float, dt_s: float, rate_rad_s: float | None = None) -> Twist:
        """One step of a turn in place; ``phase`` becomes DONE when it is over."""
        if self._angular.is_over(remaining_rad, self._heading_tolerance_rad, rate_rad_s):
            self.phase = DONE
            return STILL
        return Twist(0.0, self._angular.step(remaining_rad, dt_s, rate_rad_s))

    def step(
        self,
        pose: tuple[float, float, float],
        target: tuple[float, float],
        dt_s: float,
        speeds: Twist | Predicted | None = None,
        creep: tuple[float, float] = NO_CREEP,
    ) -> Twist:
        """Twist for the next ``dt_s``; ``pose`` is that at which it will take effect."""
        if self.phase is TURN:
            angle = self._bearing_error(pose, target, creep)
            rate = None if speeds is None else speeds.omega_rad_s
            if self._angular.overtime_s >= 0.0 and self._has_run_away(pose, target, angle):
                self.phase = DONE
                return STILL
            if not self._angular.is_over(angle, self._heading_tolerance_rad, rate):
                return Twist(0.0, self._angular.step(angle, dt_s, rate))
            self._begin_drive(pose, target)
        if self.phase is DONE:
            return STILL
        return self._drive(pose, target, dt_s, speeds, creep) if self._shaped else self._head_on(pose, target, dt_s)

    def _begin_alignment(self, pose: tuple[float, float, float], target: tuple[float, float], angle_rad: float) -> None:
        self.phase = TURN
        self._aim = target, pose[2] + angle_rad
        self._angular.begin(angle_rad)

    def _has_run_away(self, pose: tuple[float, float, float], target: tuple[float, float], angle_rad: float) -> bool:
        """Whether a stop that is all but reached lies on another bearing than the turn began for (same frame)."""
        if hypot(target[0] - pose[0], target[1] - pose[1]) > ALL_BUT_THERE_M:
            return False
        aimed_at, heading_rad = self._aim
        if target != aimed_at:
            self._aim = target, pose[2] + angle_rad
            return False
        return abs(wrap_pi(pose[2] + angle_rad - heading_rad)) > REALIGN_RAD

    def _begin_drive(self, pose: tuple[float, float, float], target: tuple[float, float]) -> None:
        self.phase = DRIVE
        self._line.begin(pose, target, self._reverse)
        self._forward.begin(hypot(target[0] - pose[0], target[1] - pose[1]))
        self._steering.reset()

    def _bearing_error(
        self, pose: tuple[float, float, float], target: tuple[float, float], creep: tuple[float, float]
    ) -> float:
        """Thesis eq. 3.2, e = beta - theta with beta = atan2(dy, dx); printed there with the arguments exchanged.

        In reverse the tail has to point at the target; against a drift the robot points beside it.
        """
        beta = atan2(target[1] - pose[1], target[0] - pose[0])
        beta += crab(beta, creep) if self._shaped else 0.0
        return wrap_pi(beta - pose[2] - (pi if self._reverse else 0.0))

    def _drive(
        self,
        pose: tuple[float, float, float],
        target: tuple[float, float],
        dt_s: float,
        speeds: Twist | Predicted | None,
        creep: tuple[float, float],
    ) -> Twist:
        control, axis = self._control, self._along
        sight = self._line.look(pose, target, creep)
        sign = -1.0 if self._reverse else 1.0
        ahead_m, gain = sight.ahead_m, sight.gain
        speed = None if speeds is None else sign * speeds.v_m_s * gain
        if axis.overtime_s >= 0.0:
            axis.renew_if_far(ahead_m)
            if axis.is_over(ahead_m, control.stop_tolerance_m, speed) or axis.overtime_s >= control.stop_time_s:
                self.phase = DONE
                return STILL
        planned = axis.planned_speed
        wanted = axis.step(ahead_m, dt_s, speed) / gain
        rate = line_rate(sight, planned, control.cross_track_gain_rad_m2, control.heading_weight_1_s2)
        if speeds is not None:
            rate += self._steering_damping * (rate - speeds.omega_rad_s)
        return Twist(sign * wanted, clamped(rate, self._omega_max))

    def _head_on(self, pose: tuple[float, float, float], target: tuple[float, float], dt_s: float) -> Twist:
        """The thesis's drive: one PID on the distance, one on the bearing, eqs 3.1 to 3.4."""
        x, y, heading = pose
        dx, dy = target[0] - x, target[1] - y
        c, s = cos(heading), sin(heading)
        ahead, left = c * dx + s * dy, c * dy - s * dx
        if self._reverse:
            ahead, left = -ahead, -left
        remaining = hypot(ahead, left)
        if self._forward.is_over(remaining, self._position_tolerance_m, None):
            self.phase = DONE
            return STILL
        error = atan2(left, ahead)
        if abs(error) > REALIGN_RAD:
            self._begin_alignment(pose, target, error)
            return STILL
        speed = self._forward.step(remaining, dt_s, None)
        return Twist(-speed if self._reverse else speed, self._steering.step(error, dt_s))


Pose = tuple[float, float, float]

# A delay below a thousandth of a frame is rounding of the robot's clock.
ROUNDING = 1e-3
# A robot whose echo is older than its own time-to-live holds its wheels: beyond that nothing is on the way any more.
REACH_S = 0.25


class CommandPredictor:
    """Carries a frame's estimate forward over the commands that are on their way to the wheels.

    The echo tells which drive was in force last and for how long; those sent after it follow one per frame. Each wheel
    is a first-order servo, so with a set point u over t

        v(t) = u + (v - u) exp(-t/T),    mean = u + (v - u) (T/t) (1 - exp(-t/T)),

    and the body goes on along the mean heading, carried off by the drift per metre of travel.
    """

    __slots__ = ("_frame", "_frame_s", "_lag_s", "_sent")

    def __init__(self, wheel_lag_s: float, frame_s: float) -> None:
        if frame_s <= 0.0:
            raise ValueError(f"frame_s = {frame_s}: the period of the frames must be positive")
        self._lag_s, self._frame_s = wheel_lag_s, frame_s
        self._frame = frame_s, *_servo(wheel_lag_s, frame_s)
        self._sent: deque[tuple[int, float, float]] = deque(maxlen=max(1, round(REACH_S / frame_s)))

    def reset(self) -> None:
        """Forget what was sent: a new session begins."""
        self._sent.clear()

    def sent(self, seq: int, v_m_s: float, omega_rad_s: float) -> None:
        """A drive has been sent: its number and the twist that its wheel rates mean."""
        if self._sent and seq <= self._sent[-1][0]:
            self._sent.clear()
        self._sent.append((seq, v_m_s, omega_rad_s))

    def ahead(
        self,
        pose: Pose,
        v_m_s: float,
        omega_rad_s: float,
        echo_seq: int,
        echo_age_s: float,
        is_held: bool,
        creep: tuple[float, float] = (0.0, 0.0),
    ) -> Predicted:
        """The state in which the next command will find the robot.

        ``pose`` is (x, y, heading) in any plane, ``creep`` the drift per metre in it. ``echo_seq`` is the drive in
        force (-1: none) and ``echo_age_s`` its age; ``is_held``: the robot holds its wheels whatever was sent, and they
        run down.
        """
        sent, frame_s = self._sent, self._frame_s
        while len(sent) > 1 and sent[1][0] <= echo_seq:
            sent.popleft()
        (x, y, heading), v, omega = pose, v_m_s, omega_rad_s
        creep_x, creep_y = creep
        for seq, v_sent, omega_sent in sent:
            if seq > echo_seq:
                dt_s, keep, mean = self._frame
            else:  # the one in force
                dt_s = frame_s - echo_age_s
                if dt_s <= ROUNDING * frame_s:
                    continue
                keep, mean = _servo(self._lag_s, dt_s)
            v_set, omega_set = (0.0, 0.0) if is_held else (v_sent, omega_sent)
            travel = (v_set + (v - v_set) * mean) * dt_s
            turn = (omega_set + (omega - omega_set) * mean) * dt_s
            middle, length = heading + 0.5 * turn, abs(travel)
            x, y = x + travel * cos(middle) + length * creep_x, y + travel * sin(middle) + length * creep_y
            heading, v, omega = heading + turn, v_set + (v - v_set) * keep, omega_set + (omega - omega_set) * keep
        return Predicted((x, y, heading), v, omega)


def _servo(lag_s: float, dt_s: float) -> tuple[float, float]:
    """Shares of the difference to the set point: what is left after ``dt_s``, and its mean on the way."""
    if lag_s <= 0.0:
        return 0.0, 0.0
    keep = exp(-dt_s / lag_s)
    return keep, lag_s * (1.0 - keep) / dt_s
