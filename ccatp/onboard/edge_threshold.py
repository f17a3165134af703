"""From the voltage of an analogue edge sensor to one bit: threshold, hysteresis, debouncing."""

from math import inf

from ccatp.config.onboard_models import EdgeThresholdConfig


class EdgeThreshold:
    """One sensor.

    A sensor that changes to *no panel* counts from the first sample: a late report of the rim costs way. The change
    back must last for ``debounce_s``. Before the first sample, which decides at once, there is no panel.
    """

    def __init__(self, cfg: EdgeThresholdConfig) -> None:
        sign = 1.0 if cfg.is_panel_above else -1.0
        self._sign, self._debounce_s = sign, cfg.debounce_s
        half_v = 0.5 * cfg.hysteresis_v
        self._on_v, self._off_v = sign * cfg.threshold_v + half_v, sign * cfg.threshold_v - half_v
        self._is_on = False
        # A sensor that is first read above has been there for ever.
        self._above_since_s: float | None = -inf

    def read(self, t_s: float, voltage_v: float) -> int:
        """1 = panel under the sensor, 0 = none; what is not a number is no panel."""
        level_v = self._sign * voltage_v
        if self._is_on:
            self._is_on = level_v >= self._off_v
            self._above_since_s = None
        elif level_v >= self._on_v:
            if self._above_since_s is None:
                self._above_since_s = t_s
            self._is_on = t_s - self._above_since_s >= self._debounce_s
        else:
            self._above_since_s = None
        return int(self._is_on)
