"""The base of the health monitors: what is registered, reset, and asked for findings."""

from ccatp.conditions import MonitorFinding
from ccatp.safety.escalation import FindingLatch


class Monitor:
    """A monitor of the danger loop. ``HealthMonitor`` registers it, resets it, and asks it for its findings.

    Its findings are those of the latches that it makes with ``latch``, and ``finding``, which lasts until the monitor
    changes it. A monitor with others extends ``findings``.
    """

    finding: MonitorFinding | None = None

    def __init__(self) -> None:
        self._latches: list[FindingLatch] = []

    def latch(self, clear_s: float) -> FindingLatch:
        """A new latch of this monitor, which keeps a finding until there has been no evidence of it for ``clear_s``."""
        latch = FindingLatch(clear_s)
        self._latches.append(latch)
        return latch

    def reset(self) -> None:
        """Begin again after a boot of the robot: its clock has restarted."""
        for latch in self._latches:
            latch.reset()

    def findings(self, t_s: float) -> list[MonitorFinding]:
        """The findings at ``t_s``."""
        found = []
        for latch in self._latches:
            if latch.finding is not None and (finding := latch.settle(t_s)) is not None:
                found.append(finding)
        if self.finding is not None:
            found.append(self.finding)
        return found
