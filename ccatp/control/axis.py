"""Motion along one axis, a distance or an angle: the profile with feed-forward, or the thesis's PID."""

from math import exp

import msgspec
from msgspec.structs import replace

from ccatp.config.models import ControlConfig, PidConfig
from ccatp.control.pid import Pid, PidState
from ccatp.control.profile import Profile


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
        self._v_max = v_max
        self._a_max = a_max

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
        self._kp = gains.kp
        self._kd = gains.kd
        self._v_max = v_max
        self._a_max = a_max
        self._lag_s = lag_s
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
