"""Monitor of the sample rates of the sensors."""

from ccatp.conditions import MonitorFinding
from ccatp.conditions import danger as conditions
from ccatp.conditions.danger import SAMPLE_RATES
from ccatp.config.models import HealthConfig
from ccatp.safety.monitor import Monitor

_SOURCES = ("imu", "enc", "edge")


class RateMonitor(Monitor):
    """Compares the sample rate of each sensor with the required rate and with the rate of the first period.

    ``finding``: about the worst sensor. A sensor without any samples is left out, because other rules report it.
    """

    def __init__(self, cfg: HealthConfig) -> None:
        super().__init__()
        self._cfg = cfg
        self.reset()

    def reset(self) -> None:
        """See ``Monitor``."""
        super().reset()
        self.finding = None
        self.are_encoders_sparse = False
        self._begin_s: float | None = None
        self._last_s = 0.0
        self._counts = [0, 0, 0]
        self._usual_hz: list[float] | None = None
        self._before_hz: list[float] = []

    def step(self, t_s: float, imu: int, encoders: int, edges: int) -> None:
        """Take the numbers of samples of a frame; judged once per ``rate_time_s``."""
        elapsed_s, self._last_s = t_s - self._last_s, t_s
        if self._begin_s is None:
            self._begin_s = t_s
            return
        if self._usual_hz is not None:
            self.are_encoders_sparse = encoders < self._cfg.rate_share * self._usual_hz[1] * elapsed_s
        counts = self._counts
        counts[0] += imu
        counts[1] += encoders
        counts[2] += edges
        span_s = t_s - self._begin_s
        if span_s >= self._cfg.rate_time_s - 1e-6:
            self._judge(span_s)
            self._begin_s = t_s
            self._counts = [0, 0, 0]

    def _judge(self, span_s: float) -> None:
        rates = [count / span_s for count in self._counts]
        if self._usual_hz is None:
            self._usual_hz = self._before_hz = rates
            return
        before, self._before_hz = self._before_hz, rates
        self.finding = self._too_slow(span_s, before, rates) or self._fewer_than_usual(self._usual_hz, rates)

    def _too_slow(self, span_s: float, before: list[float], rates: list[float]) -> MonitorFinding | None:
        """Judge the better of two periods, so that a sensor that was silent for a while does not count as slow."""
        slowest, found = 1.0, None
        for name, one_hz, other_hz in zip(_SOURCES, before, rates, strict=True):
            sensor, least_hz, hold_hz = SAMPLE_RATES[name]
            rate_hz = max(one_hz, other_hz)
            if min(one_hz, other_hz) > 0.0 and rate_hz + 1.0 / span_s < slowest * least_hz:
                slowest = rate_hz / least_hz
                row = conditions.SENSOR_MUCH_TOO_SLOW if rate_hz < hold_hz else conditions.SENSOR_TOO_SLOW
                varies = {"rate": f"{rate_hz:.0f}", "least": f"{least_hz:.0f}"}
                found = row.found(name, rate_hz, least_hz, sensor=sensor, **varies)
        return found

    def _fewer_than_usual(self, usual_hz: list[float], rates: list[float]) -> MonitorFinding | None:
        shares = [rate / usual if usual else 1.0 for rate, usual in zip(rates, usual_hz, strict=True)]
        least, limit = min(shares), self._cfg.rate_share
        if least >= limit:
            return None
        return conditions.SAMPLES_TOO_FEW.found(_SOURCES[shares.index(least)], least, limit)
