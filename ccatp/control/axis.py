"""Pure. One quantity brought to zero: along a profile with feed-forward, or by the thesis's bare PID."""

from typing import Protocol

from ccatp.config.models import ControlConfig, PidConfig
from ccatp.control.pid import Pid
from ccatp.control.profile import Profile, clamped, lag_feed_forward

# What feedback may add to the planned speed, as part of the limit: more would outrun the gate's headroom.
FEEDBACK_SHARE = 0.25


class Axis(Protocol):
    """Brings one remaining quantity (a distance in m or an angle in rad) to zero."""

    def begin(self, remaining: float) -> None:
        """Start a motion over ``remaining`` from rest to rest."""

    def is_over(self, remaining: float, tolerance: float, speed: float | None) -> bool:
        """Whether the motion has come to its end within ``tolerance``."""

    @property
    def duration_s(self) -> float:
        """Bang-bang time of the motion begun last."""

    @property
    def overtime_s(self) -> float:
        """Time spent after the plan's end."""

    def step(self, remaining: float, dt_s: float, speed: float | None) -> float:
        """Speed wanted for the next ``dt_s``, given what remains and, where it is known, the speed now."""


class BareAxis:
    """The PID of the remaining quantity itself, thesis eqs 3.1 to 3.4.

    Args:
        gains: PID gains.
        v_max, a_max: limits, in the quantity's unit per s and per s^2; the second only for the bang-bang time.
    """

    def __init__(self, gains: PidConfig, v_max: float, a_max: float) -> None:
        """Nothing to do."""
        self._pid = Pid(gains, v_max)
        self._v_max, self._a_max = v_max, a_max
        self.duration_s = self.overtime_s = 0.0

    def begin(self, remaining: float) -> None:
        """Start anew."""
        self._pid.reset()
        self.duration_s = Profile.rest_to_rest(remaining, self._v_max, self._a_max).duration_s

    def is_over(self, remaining: float, tolerance: float, _speed: float | None) -> bool:
        """Whether it is within tolerance, however fast."""
        return abs(remaining) <= tolerance

    def step(self, remaining: float, dt_s: float, _speed: float | None) -> float:
        """The PID's output."""
        return self._pid.step(remaining, dt_s)


class ProfiledAxis:
    """Follows a rest-to-rest profile x*(t) over what remained at its beginning.

    With the tracking error e = remaining - (distance - x*) the set point is

        u = (1 + s) ff(v*) + Kp e + Kd (v* - v),    ds/dt = Kp e v* / (v_max^2 tau).

    ff takes the servo's lag T out, so that the error obeys T e'' + (1 + Kd) e' + Kp e = 0. s is the share by which the
    wheels travel further than the body: it acts in proportion to the planned speed and is gone at the end, where an
    ordinary integral would still have to unwind. Kp e is bounded; where a plan ends further off than that brings home
    in time, a second motion follows.

    Args:
        gains: Kp and Kd of the shaped set; the derivative is the speed's own estimate, never a difference of poses.
        cfg: slip and end of the motion.
        v_max, a_max: limits of the profile, in the quantity's unit per s and per s^2.
        lag_s: time constant of the servo.
    """

    def __init__(self, gains: PidConfig, cfg: ControlConfig, v_max: float, a_max: float, lag_s: float) -> None:
        """Nothing to do."""
        self._kp, self._kd = gains.kp, gains.kd
        self._v_max, self._a_max, self._lag_s = v_max, a_max, lag_s
        self._slip_gain = 1.0 / (v_max * v_max * cfg.slip_time_s)
        self._slip_limit = cfg.slip_limit
        self._feedback_limit = FEEDBACK_SHARE * v_max
        self._stop_time_s = cfg.stop_time_s
        self.begin(0.0)

    def begin(self, remaining: float) -> None:
        """Plan the motion over ``remaining``."""
        self._profile = Profile.rest_to_rest(remaining, self._v_max, self._a_max)
        self._duration_s = self._profile.duration_s
        self._t_s = self._slip = 0.0
        self._planned = self._profile.at(0.0)

    @property
    def duration_s(self) -> float:
        """Bang-bang time of the motion begun last."""
        return self._duration_s

    @property
    def planned_speed(self) -> float:
        """Speed that the plan has now."""
        return self._planned[1]

    @property
    def overtime_s(self) -> float:
        """Time spent after the plan's end, s; negative before."""
        return self._t_s - self._duration_s

    def is_over(self, remaining: float, tolerance: float, speed: float | None) -> bool:
        """Whether the plan is out and what is left when the wheels have run down is within ``tolerance``."""
        if self._t_s < self._duration_s:
            return False
        coast = 0.0 if speed is None else speed * self._lag_s
        return abs(remaining - coast) <= tolerance

    def renew_if_far(self, remaining: float) -> None:
        """Plan another motion where the last one ended further off than feedback can bring it in time."""
        if self.overtime_s >= 0.0 and abs(remaining) > 0.5 * self._feedback_limit * self._stop_time_s:
            self.begin(remaining)

    def step(self, remaining: float, dt_s: float, speed: float | None) -> float:
        """Set point for the next ``dt_s``, in the unit of the quantity per s."""
        profile = self._profile
        position, now = self._planned
        self._t_s += dt_s
        self._planned = profile.at(self._t_s)
        error = remaining - (profile.distance - position)
        feedback = clamped(self._kp * error, self._feedback_limit)
        self._slip = slip = clamped(self._slip + self._slip_gain * feedback * now * dt_s, self._slip_limit)
        if speed is not None:
            feedback += self._kd * (now - speed)
        return (1.0 + slip) * lag_feed_forward(now, self._planned[1], dt_s, self._lag_s) + feedback
