"""Pure. The ladder: the gravest finding wins, and what does not pass in time, or comes again and again, gets graver."""

from collections import deque
from collections.abc import Iterable
from math import inf

from ccatp.config.models import HealthConfig
from ccatp.health.findings import Finding
from ccatp.samples import Severity

_DENYING = (Severity.PAUSE, Severity.HOLD, Severity.FAULT)


def gravest(findings: Iterable[Finding]) -> Finding | None:
    """The finding that wins: the gravest, of equal ones the first."""
    return max(findings, key=lambda finding: finding.severity, default=None)


def denies(findings: Iterable[Finding]) -> bool:
    """Whether any of the findings holds the wheels. Going home does not, but what else is found may."""
    return any(finding.severity in _DENYING for finding in findings)


class Ladder:
    """Raises the severity of what lasts or comes back.

    A pause that lasts for longer than ``pause_limit_s`` is a hold, so that a fix is had before going on; a hold that
    lasts for longer than its patience is a fault, because it does not pass by itself; a hold for the same signal that
    comes more than ``retries`` times again within ``retry_window_s`` is one, too.

    Args:
        cfg: these times.
    """

    def __init__(self, cfg: HealthConfig) -> None:
        """Nothing found."""
        self._cfg = cfg
        self._since_s: dict[str, float] = {}
        self._held: dict[str, deque[float]] = {}

    def reset(self) -> None:
        """The robot's clock began anew; what came back before does not count."""
        self._since_s.clear()
        self._held.clear()

    def climb(self, t_s: float, findings: list[Finding]) -> list[Finding]:
        """The findings of a frame, raised where their time is up.

        Args:
            t_s: time of the frame.
            findings: all there are; an empty list ends every count of duration.
        """
        since = self._since_s
        now: dict[str, float] = {}
        for finding in findings:
            now[finding.signal] = min(since.get(finding.signal, t_s), now.get(finding.signal, inf))
        self._since_s = now
        return [self._raised(t_s, finding) for finding in findings]

    def _raised(self, t_s: float, finding: Finding) -> Finding:
        cfg, lasted_s = self._cfg, t_s - self._since_s[finding.signal]
        if finding.severity is Severity.PAUSE:
            if lasted_s < cfg.pause_limit_s:
                return finding
            finding = finding._replace(severity=Severity.HOLD)
        if finding.severity is not Severity.HOLD:
            return finding
        patience_s = cfg.hold_limit_s if finding.patience_s is None else finding.patience_s
        if lasted_s >= patience_s:
            return finding._replace(
                severity=Severity.FAULT, cause=f"{finding.cause}, for {patience_s:g} s", retries=None
            )
        return self._count(t_s, finding, is_new=lasted_s == 0.0)

    def _count(self, t_s: float, finding: Finding, *, is_new: bool) -> Finding:
        cfg, held = self._cfg, self._held.setdefault(finding.signal, deque())
        while held and t_s - held[0] > cfg.retry_window_s:
            held.popleft()
        if is_new:
            held.append(t_s)
        retries = cfg.retries if finding.retries is None else finding.retries
        if len(held) <= retries + 1:
            return finding
        return finding._replace(severity=Severity.FAULT, cause=f"{finding.cause}, again after {retries} retries")
