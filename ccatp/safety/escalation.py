"""Findings of the monitors: how long they stay, which one wins, and when they become graver."""

from collections import deque
from collections.abc import Iterable
from math import inf

from ccatp.conditions import PRECEDENCE, MonitorFinding
from ccatp.config.models import HealthConfig
from ccatp.core import Severity


class FindingLatch:
    """A finding that stays until there has been no evidence of it for a while."""

    __slots__ = ("_clear_s", "_seen_s", "finding")

    def __init__(self, clear_s: float) -> None:
        self._clear_s, self._seen_s = clear_s, -inf
        self.finding: MonitorFinding | None = None

    def see(self, t_s: float, finding: MonitorFinding) -> None:
        """There is evidence at ``t_s``. The first values are kept, unless it has become graver."""
        if self.finding is None or finding.severity > self.finding.severity:
            self.finding = finding
        self._seen_s = t_s

    def settle(self, t_s: float) -> MonitorFinding | None:
        """The finding, which is let go if its last evidence is long ago at ``t_s``."""
        if self.finding is not None and t_s - self._seen_s >= self._clear_s:
            self.finding = None
        return self.finding


class Since:
    """Since when something has been so without interruption (``None`` while it is not so)."""

    __slots__ = ("t_s",)

    def __init__(self) -> None:
        self.t_s: float | None = None

    def lasts(self, t_s: float, is_so: bool) -> float:
        """For how long it has been so at ``t_s``, s; < 0 while it is not."""
        if not is_so:
            self.t_s = None
            return -1.0
        if self.t_s is None:
            self.t_s = t_s
        return t_s - self.t_s


_DENYING = (Severity.PAUSE, Severity.HOLD, Severity.FAULT)


def gravest(findings: Iterable[MonitorFinding]) -> MonitorFinding | None:
    """The finding that wins: the gravest, of equal ones that of the first row."""
    return max(findings, key=lambda finding: (finding.severity, PRECEDENCE[finding.condition]), default=None)


def denies(findings: Iterable[MonitorFinding]) -> bool:
    """Whether any of the findings holds the wheels. Going home does not, but what else is found may."""
    return any(finding.severity in _DENYING for finding in findings)


class SeverityEscalation:
    """Raises the severity of what lasts or comes back.

    A pause that lasts for longer than ``pause_limit_s`` is a hold, so that a fix is taken before going on; a hold that
    lasts for longer than its limit is a fault, because it does not pass by itself; a hold for the same signal that
    comes more than ``retries`` times again within ``retry_window_s`` is one, too.
    """

    def __init__(self, cfg: HealthConfig) -> None:
        self._cfg = cfg
        self._since_s: dict[str, float] = {}
        self._held: dict[str, deque[float]] = {}

    @property
    def is_counting(self) -> bool:
        """Something was found in the last frame."""
        return bool(self._since_s)

    def climb(self, t_s: float, findings: list[MonitorFinding]) -> list[MonitorFinding]:
        """All findings of a frame, raised where their time is up; an empty list ends every count of duration."""
        since = self._since_s
        now: dict[str, float] = {}
        for finding in findings:
            now[finding.signal] = min(since.get(finding.signal, t_s), now.get(finding.signal, inf))
        self._since_s = now
        return [self._raised(t_s, finding) for finding in findings]

    def _raised(self, t_s: float, finding: MonitorFinding) -> MonitorFinding:
        cfg, lasted_s = self._cfg, t_s - self._since_s[finding.signal]
        if finding.severity is Severity.PAUSE:
            if lasted_s < cfg.pause_limit_s:
                return finding
            finding = finding._replace(severity=Severity.HOLD)
        if finding.severity is not Severity.HOLD:
            return finding
        patience_s = cfg.lifted_limit_s if finding.condition.limit == "health.lifted_limit_s" else cfg.hold_limit_s
        if lasted_s >= patience_s:
            return finding._replace(severity=Severity.FAULT, cause=f"{finding.cause}, for {patience_s:g} s")
        return self._count(t_s, finding, is_new=lasted_s == 0.0)

    def _count(self, t_s: float, finding: MonitorFinding, *, is_new: bool) -> MonitorFinding:
        cfg, held = self._cfg, self._held.setdefault(finding.signal, deque())
        while held and t_s - held[0] > cfg.retry_window_s:
            held.popleft()
        if is_new:
            held.append(t_s)
        retries = cfg.retries if finding.condition.retries is None else finding.condition.retries
        if len(held) <= retries + 1:
            return finding
        return finding._replace(severity=Severity.FAULT, cause=f"{finding.cause}, again after {retries} retries")
