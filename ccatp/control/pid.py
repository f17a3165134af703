"""PID controller, thesis eq. 3.4."""

from math import exp

import msgspec

from ccatp.config.models import PidConfig


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
        self._kp = gains.kp
        self._ki = gains.ki
        self._kd = gains.kd
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
