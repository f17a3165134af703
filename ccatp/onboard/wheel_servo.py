"""The speed controller of one wheel: computes a motor voltage from a set point and encoder counts.

The set point passes a first-order filter (time constant ``response_s``), so that the response of the wheel is the one
that the off-board computer expects, independent of the motor. The wheel follows the filtered speed by feed-forward of
the motor's steady state, V = static sign(w) + slope w, and PI. The integral of the speed error is the difference of two
angles, which counts give without noise. The voltage and its rate of change are limited; while a limit is active, the
reference angle does not move further ahead (anti-windup by conditional integration).

With a set point of zero the filtered speed decays to zero; then the servo holds the reference angle.
"""

from collections import deque
from math import copysign, exp, pi

from ccatp.config.onboard_models import WheelServoConfig
from ccatp.rest import WHEEL_STANDS_RAD_S


class WheelServo:
    """One wheel.

    Attributes:
        rate_rad_s: measured speed over ``speed_window_s``.
        voltage_v: the last voltage.
    """

    def __init__(self, cfg: WheelServoConfig) -> None:
        self._cfg = cfg
        self._rad_per_count = 2.0 * pi / cfg.counts_per_rev
        self._window: deque[tuple[float, int]] = deque()
        self.rate_rad_s = self.voltage_v = 0.0
        self._reference_rad_s = 0.0
        self._ahead_rad = 0.0  # reference angle minus the wheel's
        self._last_count: int | None = None
        self._stalled_s = 0.0

    def count(self, t_s: float, count: int) -> None:
        """Take a reading of the encoder."""
        window = self._window
        if window and t_s <= window[-1][0]:
            return
        if self._last_count is not None:
            self._ahead_rad -= (count - self._last_count) * self._rad_per_count
        self._last_count = count
        window.append((t_s, count))
        oldest_s = t_s - self._cfg.speed_window_s
        while len(window) > 2 and window[1][0] <= oldest_s:
            window.popleft()
        (first_s, first), (last_s, last) = window[0], window[-1]
        if last_s > first_s:
            self.rate_rad_s = (last - first) * self._rad_per_count / (last_s - first_s)

    def step(self, dt_s: float, set_point_rad_s: float) -> float:
        """Voltage, V, for the next ``dt_s``."""
        cfg = self._cfg
        decay = exp(-dt_s / cfg.response_s)
        before = self._reference_rad_s
        self._reference_rad_s = reference = set_point_rad_s + (before - set_point_rad_s) * decay
        if set_point_rad_s == 0.0 and abs(reference) < WHEEL_STANDS_RAD_S:
            self._reference_rad_s = reference = 0.0
        way_rad = set_point_rad_s * dt_s + (before - set_point_rad_s) * cfg.response_s * (1.0 - decay)
        ahead_rad = self._ahead_rad + way_rad
        wanted_v = cfg.volt_per_rad_s * reference + cfg.proportional_v_per_rad_s * (reference - self.rate_rad_s)
        wanted_v += cfg.integral_v_per_rad * ahead_rad
        if reference:  # at rest, friction helps to hold the wheel
            wanted_v += copysign(cfg.static_v, reference)
        most_v = cfg.slew_v_s * dt_s
        voltage_v = min(max(wanted_v, self.voltage_v - most_v), self.voltage_v + most_v)
        voltage_v = min(max(voltage_v, -cfg.max_v), cfg.max_v)
        if voltage_v == wanted_v or way_rad * (wanted_v - voltage_v) < 0.0:
            self._ahead_rad = ahead_rad
        self.voltage_v = voltage_v
        is_pushing = abs(voltage_v) >= cfg.max_v and abs(self.rate_rad_s) < WHEEL_STANDS_RAD_S
        self._stalled_s = self._stalled_s + dt_s if is_pushing else 0.0
        return voltage_v

    @property
    def is_stalled(self) -> bool:
        """Full voltage and no motion, for ``stall_s``."""
        return self._stalled_s >= self._cfg.stall_s

    def release(self) -> None:
        """Reset voltage, reference, integral and stall time; the motor is braked by other means."""
        self.voltage_v = self._reference_rad_s = self._ahead_rad = 0.0
        self._stalled_s = 0.0
