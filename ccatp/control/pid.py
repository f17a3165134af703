"""One quantity brought to zero: along a profile with feed-forward, or by the thesis's PID (eq. 3.4, in seconds)."""

from math import copysign, exp, sqrt
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from ccatp.config.models import ControlConfig, PidConfig


class PidState(msgspec.Struct, frozen=True):
    """Memory of a PID between two steps."""

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
        """The next memory, and the output within its limit, ``dt_s`` > 0 after the last step."""
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
        # Integrating further into a saturated output would only have to be undone later.
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


# What feedback may add to the planned speed, as part of the limit: more would outrun the gate's headroom.
FEEDBACK_SHARE = 0.25


class AxisState(msgspec.Struct, frozen=True):
    """Progress of a motion: position and speed ``planned`` for now, its bang-bang time ``duration_s``.

    ``slip``: the share by which the wheels travel further than the body.
    """

    duration_s: float
    profile: Profile
    t_s: float = 0.0
    planned: tuple[float, float] = (0.0, 0.0)
    slip: float = 0.0
    pid: PidState = PidState()


class BareAxis:
    """PID of the remaining quantity, thesis eqs 3.1 to 3.4; ``a_max`` only serves the bang-bang time."""

    def __init__(self, gains: PidConfig, v_max: float, a_max: float) -> None:
        self._pid = Pid(gains, v_max)
        self._v_max, self._a_max = v_max, a_max

    def begin(self, remaining: float) -> AxisState:
        """Start; such a motion has no plan, and is overtime at once."""
        profile = Profile.rest_to_rest(remaining, self._v_max, self._a_max)
        return AxisState(profile.duration_s, profile, t_s=profile.duration_s)

    def is_over(self, _motion: AxisState, remaining: float, tolerance: float, _speed: float | None) -> bool:
        """Whether it is within tolerance, however fast."""
        return abs(remaining) <= tolerance

    def step(self, motion: AxisState, remaining: float, dt_s: float, _speed: float | None) -> tuple[AxisState, float]:
        """The PID's output."""
        pid, output = self._pid.step(motion.pid, remaining, dt_s)
        return replace(motion, pid=pid), output


class ProfiledAxis:
    """Follows a rest-to-rest profile x*(t) over what remained at its beginning.

    With the tracking error e = remaining - (distance - x*) the set point is

        u = (1 + s) ff(v*) + Kp e + Kd (v* - v),    ds/dt = Kp e v* / (v_max^2 tau).

    ff takes the servo's lag T out: T e'' + (1 + Kd) e' + Kp e = 0. s, the share of slip, acts in proportion to the
    planned speed and is gone at the end. Kp e is bounded; a plan that ends far off is followed by a second motion.
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
        """Whether the plan is out and what is left when the wheels have run down is within ``tolerance``."""
        if motion.t_s < motion.duration_s:
            return False
        coast = 0.0 if speed is None else speed * self._lag_s
        return abs(remaining - coast) <= tolerance

    def renewed_if_far(self, motion: AxisState, remaining: float) -> AxisState:
        """Another motion where the last one ended further off than feedback can bring it in time."""
        if motion.t_s >= motion.duration_s and abs(remaining) > 0.5 * self._feedback_limit * self._stop_time_s:
            return self.begin(remaining)
        return motion

    def step(self, motion: AxisState, remaining: float, dt_s: float, speed: float | None) -> tuple[AxisState, float]:
        """The motion ``dt_s`` later, and its set point until then, in the unit of the quantity per s."""
        profile, (position, now), t_s = motion.profile, motion.planned, motion.t_s + dt_s
        planned = profile.at(t_s)
        error = remaining - (profile.distance - position)
        bound, slip_bound = self._feedback_limit, self._slip_limit
        feedback = min(max(self._kp * error, -bound), bound)
        slip = min(max(motion.slip + self._slip_gain * feedback * now * dt_s, -slip_bound), slip_bound)
        if speed is not None:
            feedback += self._kd * (now - speed)
        set_point = (1.0 + slip) * lag_feed_forward(now, planned[1], dt_s, self._lag_s) + feedback
        return AxisState(motion.duration_s, profile, t_s, planned, slip), set_point
