"""Pure. PID controller, thesis eq. 3.4, in seconds."""

from math import exp

from ccatp.config.models import PidConfig


class Pid:
    """C(s) = Kp + Ki/s + Kd s/(Tf s + 1), thesis eq. 3.4 with a filtered derivative.

    Departures from the thesis: the gains act on SI units and seconds (the thesis does not give its unit of time), the
    derivative is low-pass filtered (``derivative_filter_s``), and the integral neither grows past its own limit nor
    while the output is saturated in its direction (anti-windup by conditional integration).

    Args:
        gains: Kp (1/s for a distance), Ki, Kd and the limits.
        output_limit: largest magnitude of the output, in its unit.
    """

    def __init__(self, gains: PidConfig, output_limit: float) -> None:
        """Start at rest: no integral, no past error."""
        self._kp, self._ki, self._kd = gains.kp, gains.ki, gains.kd
        self._filter_s = gains.derivative_filter_s
        self._integral_limit = gains.integral_limit
        self._output_limit = output_limit
        self.reset()

    def reset(self) -> None:
        """Forget the integral and the past error."""
        self._integral = 0.0
        self._derivative = 0.0
        self._last_error: float | None = None

    def step(self, error: float, dt_s: float) -> float:
        """One control step.

        Args:
            error: set point minus measurement.
            dt_s: time since the last step, > 0.

        Returns:
            The output, within the output limit.
        """
        if dt_s <= 0.0:
            raise ValueError(f"dt of a control step must be positive, got {dt_s} s")
        if self._kd and self._last_error is not None:
            slope = (error - self._last_error) / dt_s
            keep = exp(-dt_s / self._filter_s) if self._filter_s > 0.0 else 0.0
            self._derivative = keep * self._derivative + (1.0 - keep) * slope
        self._last_error = error
        grown = self._integral + self._ki * error * dt_s
        grown = max(-self._integral_limit, min(self._integral_limit, grown))
        free = self._kp * error + self._kd * self._derivative
        output = free + grown
        limit = self._output_limit
        # Integrating further into a saturated output would only have to be undone later.
        if abs(output) <= limit or abs(free + grown) < abs(free + self._integral):
            self._integral = grown
        return max(-limit, min(limit, free + self._integral))
