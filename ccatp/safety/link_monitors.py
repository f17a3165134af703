"""Monitors of the link to the robot: latency of the drives."""

from collections import deque

from ccatp import conditions
from ccatp.config.models import HealthConfig
from ccatp.safety.escalation import FindingLatch


class LatencyMonitor:
    """Latency from a drive to its echo. Above a limit the robot slows down, so that its stopping distance stays."""

    def __init__(self, cfg: HealthConfig) -> None:
        self._cfg = cfg
        self.alarm = FindingLatch(cfg.rate_time_s)
        self._sent: deque[tuple[int, float]] = deque(maxlen=64)

    def sent(self, number: int, t_s: float) -> None:
        """Drive ``number`` was sent by ``t_s``."""
        self._sent.append((number, t_s))

    def step(self, t_s: float, echoed: int) -> None:
        """Take the number of the drive in force."""
        sent = self._sent
        while len(sent) > 1 and sent[1][0] <= echoed:
            sent.popleft()
        if len(sent) > 1 and echoed > 0:
            # The second drive is not in force yet.
            latency_s, cfg = t_s - sent[1][1], self._cfg
            if latency_s > cfg.latency_pause_s:
                self.alarm.see(t_s, conditions.DRIVES_TOO_LATE.found("latency", latency_s, cfg.latency_pause_s))
            elif latency_s > cfg.latency_slow_s:
                self.alarm.see(t_s, conditions.DRIVES_LATE.found("latency", latency_s, cfg.latency_slow_s))
