"""Pure. Turn-and-move waypoint tracking, thesis 3.3.1 and fig. 3.3."""

from enum import StrEnum
from math import atan2, cos, hypot, pi, sin

from ccatp.angles import wrap_pi
from ccatp.config.models import ControlConfig, LimitsConfig, PidConfig
from ccatp.control.pid import Pid
from ccatp.control.profile import Profile, lag_feed_forward
from ccatp.samples import Twist

# Further off the bearing than this an unshaped drive stops and aligns again: the thesis aligns first, then heads on.
REALIGN_RAD = 0.5


class Axis:
    """Brings one remaining quantity (a distance in m or an angle in rad) to zero.

    Shaped: follows a rest-to-rest profile; the output is the lag-compensated planned speed plus the PID of
    (planned position - reached position). Unshaped: the PID of the remaining quantity itself, as in the thesis.

    Args:
        gains: PID gains.
        v_max, a_max: limits of the profile, in the quantity's unit per s and per s^2.
        lag_s: time constant of the servo behind it.
        shaped: follow a profile.
    """

    def __init__(self, gains: PidConfig, v_max: float, a_max: float, lag_s: float, shaped: bool) -> None:
        """Start with nothing to do."""
        self._pid = Pid(gains, v_max)
        self._v_max, self._a_max, self._lag_s, self._shaped = v_max, a_max, lag_s, shaped
        self._profile = Profile.rest_to_rest(0.0, v_max, a_max)
        self._t_s = 0.0

    def begin(self, remaining: float) -> None:
        """Plan the motion over ``remaining`` from rest to rest."""
        self._pid.reset()
        self._profile = Profile.rest_to_rest(remaining, self._v_max, self._a_max)
        self._t_s = 0.0

    @property
    def is_planned_out(self) -> bool:
        """Whether the profile has come to its end (always, where there is none)."""
        return not self._shaped or self._t_s >= self._profile.duration_s

    @property
    def duration_s(self) -> float:
        """Bang-bang time of the motion begun last."""
        return self._profile.duration_s

    def step(self, remaining: float, dt_s: float) -> float:
        """Speed command for the next ``dt_s``, given what remains now."""
        if not self._shaped:
            return self._pid.step(remaining, dt_s)
        position, now = self._profile.at(self._t_s)
        self._t_s += dt_s
        after = self._profile.at(self._t_s)[1]
        feedback = self._pid.step(remaining - (self._profile.distance - position), dt_s)
        return lag_feed_forward(now, after, dt_s, self._lag_s) + feedback


class Phase(StrEnum):
    """What a leg is at."""

    TURN = "turn"
    DRIVE = "drive"
    DONE = "done"


class LegTracker:
    """Drives one leg: turn in place to the bearing of the target, then move to it, forward or in reverse.

    All poses are in one plane (the panel frame); the frame may change from step to step as long as pose and target
    change together.

    Args:
        control: tolerances and gains.
        limits: motion limits.
        wheel_lag_s: time constant of the wheel servo.
    """

    def __init__(self, control: ControlConfig, limits: LimitsConfig, wheel_lag_s: float) -> None:
        """Pick the named set of gains."""
        gains = control.gain_sets[control.gains]
        self._shaped = gains.shaped
        self._position_tolerance_m = gains.position_tolerance_m
        self._heading_tolerance_rad = gains.heading_tolerance_rad
        self._straight_rad = max(control.straight_tolerance_rad, gains.heading_tolerance_rad)
        self._lookahead_m = control.lookahead_m if gains.shaped else 0.0
        self._forward = Axis(gains.forward, limits.v_max_m_s, limits.a_max_m_s2, wheel_lag_s, gains.shaped)
        self._angular = Axis(gains.angular, limits.omega_max_rad_s, limits.alpha_max_rad_s2, wheel_lag_s, gains.shaped)
        self._steering = Pid(gains.angular, limits.omega_max_rad_s)
        self._reverse = False
        self.phase = Phase.DONE

    def begin(self, pose: tuple[float, float, float], target: tuple[float, float], reverse: bool) -> None:
        """Start a leg.

        Args:
            pose: (x, y, heading), m and rad.
            target: (x, y), m.
            reverse: drive it backwards.
        """
        self._reverse = reverse
        if hypot(target[0] - pose[0], target[1] - pose[1]) <= self._position_tolerance_m:
            self.phase = Phase.DONE  # it is there, and the bearing of a stop so near is noise
            return
        angle = self._bearing_error(pose, target)
        if abs(angle) > self._straight_rad:
            self.phase = Phase.TURN
            self._angular.begin(angle)
        else:
            self._begin_drive(pose, target)

    def begin_turn(self, angle_rad: float) -> None:
        """Start a turn in place by ``angle_rad`` (use with ``step_turn``)."""
        self.phase = Phase.TURN
        self._angular.begin(angle_rad)

    @property
    def planned_s(self) -> float:
        """Bang-bang time of the motion begun last."""
        return self._angular.duration_s if self.phase is Phase.TURN else self._forward.duration_s

    def step_turn(self, remaining_rad: float, dt_s: float) -> Twist:
        """One step of a turn in place; ``phase`` becomes DONE when it is over."""
        if self._is_turned(remaining_rad):
            self.phase = Phase.DONE
            return Twist(0.0, 0.0)
        return Twist(0.0, self._angular.step(remaining_rad, dt_s))

    def step(self, pose: tuple[float, float, float], target: tuple[float, float], dt_s: float) -> Twist:
        """One step of the leg: the twist for the next ``dt_s``; ``phase`` tells what it is at."""
        if self.phase is Phase.TURN:
            angle = self._bearing_error(pose, target)
            if not self._is_turned(angle):
                return Twist(0.0, self._angular.step(angle, dt_s))
            self._begin_drive(pose, target)
        if self.phase is Phase.DRIVE:
            return self._drive(pose, target, dt_s)
        return Twist(0.0, 0.0)

    def _is_turned(self, remaining_rad: float) -> bool:
        return self._angular.is_planned_out and abs(remaining_rad) <= self._heading_tolerance_rad

    def _begin_drive(self, pose: tuple[float, float, float], target: tuple[float, float]) -> None:
        self.phase = Phase.DRIVE
        self._forward.begin(self._ahead(pose, target)[0])
        self._steering.reset()

    def _ahead(self, pose: tuple[float, float, float], target: tuple[float, float]) -> tuple[float, float]:
        """The target as seen from the robot: (along, to the left of) its direction of motion."""
        x, y, heading = pose
        dx, dy = target[0] - x, target[1] - y
        c, s = cos(heading), sin(heading)
        ahead, left = c * dx + s * dy, c * dy - s * dx
        return (-ahead, -left) if self._reverse else (ahead, left)

    def _bearing_error(self, pose: tuple[float, float, float], target: tuple[float, float]) -> float:
        """Thesis eq. 3.2, e = beta - theta with beta = atan2(dy, dx); printed there with the arguments exchanged.

        In reverse the tail has to point at the target.
        """
        beta = atan2(target[1] - pose[1], target[0] - pose[0])
        return wrap_pi(beta - pose[2] - (pi if self._reverse else 0.0))

    def _drive(self, pose: tuple[float, float, float], target: tuple[float, float], dt_s: float) -> Twist:
        ahead, left = self._ahead(pose, target)
        # Thesis eq. 3.1 takes the distance, which cannot tell before from behind; the profile needs the sign.
        remaining = ahead if self._shaped else hypot(ahead, left)
        if self._forward.is_planned_out and abs(remaining) <= self._position_tolerance_m:
            self.phase = Phase.DONE
            return Twist(0.0, 0.0)
        steering_error = atan2(left, max(ahead, self._lookahead_m)) if self._shaped else atan2(left, ahead)
        if not self._shaped and abs(steering_error) > REALIGN_RAD:
            self.phase = Phase.TURN
            self._angular.begin(steering_error)
            return Twist(0.0, 0.0)
        speed = self._forward.step(remaining, dt_s)
        return Twist(-speed if self._reverse else speed, self._steering.step(steering_error, dt_s))
