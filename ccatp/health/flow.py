"""Pure. The flow of frames and samples: gaps, sensors that got slow, latency of the link."""

from collections import deque

from ccatp.config.models import HealthConfig
from ccatp.health.findings import Alarm, Finding
from ccatp.samples import Severity

_SOURCES = ("imu", "enc", "edge")
# Sensors are taken to be sound while the robot stands for its first fix; that time shows their usual rates.
_LEARN_S = 0.5


class RateMonitor:
    """Samples per time of each sensor against what was usual at the start.

    Args:
        cfg: limits.

    Attributes:
        finding: the sensor that lacks most, or ``None``.
        are_encoders_sparse: since the last step they gave less than they usually do.
    """

    def __init__(self, cfg: HealthConfig) -> None:
        """Rates are not known yet."""
        self._cfg = cfg
        self.reset()

    def reset(self) -> None:
        """Learn anew."""
        self.finding: Finding | None = None
        self.are_encoders_sparse = False
        self._begin_s: float | None = None
        self._last_s = 0.0
        self._counts = [0, 0, 0]
        self._usual_hz: list[float] | None = None
        self._short = [False, False, False]

    def step(self, t_s: float, imu: int, encoders: int, edges: int) -> None:
        """Take a frame's numbers of samples; judged once per ``rate_time_s``."""
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
            self._begin_s, self._counts = t_s, [0, 0, 0]

    def _judge(self, span_s: float) -> None:
        rates = [count / span_s for count in self._counts]
        if self._usual_hz is None:
            self._usual_hz = rates
            return
        shares = [rate / usual if usual else 1.0 for rate, usual in zip(rates, self._usual_hz, strict=True)]
        least, limit = min(shares), self._cfg.rate_share
        if least >= limit:
            self.finding = None
            return
        name = _SOURCES[shares.index(least)]
        self.finding = Finding(Severity.SLOW, "a sensor gives too few samples", name, least, limit)


class LatencyMonitor:
    """How long a drive takes until its echo comes back: slower, so that the way to a stop stays what it was.

    Args:
        cfg: limits.

    Attributes:
        alarm: what was found.
    """

    def __init__(self, cfg: HealthConfig) -> None:
        """Nothing found."""
        self._cfg = cfg
        self.alarm = Alarm(cfg.rate_time_s)
        self.reset()

    def reset(self) -> None:
        """Another session: drives are numbered anew."""
        self.alarm.reset()
        self._sent: deque[tuple[int, float]] = deque(maxlen=64)

    def sent(self, number: int, t_s: float) -> None:
        """The drive ``number`` had been sent by ``t_s``."""
        self._sent.append((number, t_s))

    def step(self, t_s: float, echoed: int) -> None:
        """Take the number of the drive in force."""
        sent = self._sent
        while len(sent) > 1 and sent[1][0] <= echoed:
            sent.popleft()
        if len(sent) > 1 and echoed >= 0:
            # The second one is not in force yet.
            latency_s, cfg = t_s - sent[1][1], self._cfg
            if latency_s > cfg.latency_pause_s:
                cause = "drives reach the wheels too late"
                self.alarm.see(t_s, Finding(Severity.PAUSE, cause, "latency", latency_s, cfg.latency_pause_s))
            elif latency_s > cfg.latency_slow_s:
                cause = "drives reach the wheels late"
                self.alarm.see(t_s, Finding(Severity.SLOW, cause, "latency", latency_s, cfg.latency_slow_s))
        self.alarm.settle(t_s)
