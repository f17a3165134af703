"""Findings of the monitors: how long they last, which one takes precedence, and when their severity is raised."""

from collections import deque
from collections.abc import Iterable, Sequence
from math import inf
from typing import Any

from msgspec.structs import replace

from ccatp.conditions import Condition, MonitorFinding, Motion
from ccatp.config.models import HealthConfig
from ccatp.core import EventCode, Severity, Verdict


class FindingLatch:
    """Keeps a finding until there has been no evidence of it for ``clear_s``."""

    __slots__ = ("_clear_s", "_seen_s", "finding")

    def __init__(self, clear_s: float) -> None:
        self._clear_s = clear_s
        self.reset()

    def reset(self) -> None:
        """Drop the finding."""
        self._seen_s = -inf
        self.finding: MonitorFinding | None = None

    def see(self, t_s: float, finding: MonitorFinding) -> None:
        """Take evidence at ``t_s``. The first finding stays unless this is more severe; full fans for either."""
        kept = self.finding
        if kept is None:
            self.finding = finding
        elif finding.severity > kept.severity:
            self.finding = finding._replace(full_fans=finding.full_fans or kept.full_fans)
        elif finding.full_fans and not kept.full_fans:
            self.finding = kept._replace(full_fans=True)
        self._seen_s = t_s

    def settle(self, t_s: float) -> MonitorFinding | None:
        """The finding, or ``None`` when its last evidence is ``clear_s`` old at ``t_s``."""
        if self.finding is not None and t_s - self._seen_s >= self._clear_s:
            self.finding = None
        return self.finding


class Since:
    """Measures how long a condition has been true without interruption. ``t_s``: when it became true, or ``None``."""

    __slots__ = ("t_s",)

    def __init__(self) -> None:
        self.t_s: float | None = None

    def lasts(self, t_s: float, is_so: bool) -> float:
        """How long the condition has been true at ``t_s``, s; -1 while it is false."""
        if not is_so:
            self.t_s = None
            return -1.0
        if self.t_s is None:
            self.t_s = t_s
        return t_s - self.t_s


def limit_s(row: Condition, section: object) -> float:
    """The time after which a condition becomes more severe, from the section of the configuration that has it."""
    return float(getattr(section, row.limit.partition(".")[2]))


def find_limit_s(row: Condition, cfg: object) -> float:
    """The same from a whole configuration; infinite for a configuration without that key."""
    value: Any = cfg
    for name in row.limit.split("."):
        value = getattr(value, name, inf)
    return float(value)


def most_severe(findings: Iterable[MonitorFinding]) -> MonitorFinding | None:
    """The finding with the highest severity; of equal ones that of the lowest precedence number."""
    return max(findings, key=lambda finding: (finding.severity, -finding.condition.precedence), default=None)


def denies(findings: Iterable[MonitorFinding]) -> bool:
    """Whether any finding holds the wheels. A return, although more severe than a hold, does not."""
    return any(finding.condition.motion is Motion.NONE for finding in findings)


def with_findings(verdict: Verdict, findings: Sequence[MonitorFinding]) -> Verdict:
    """The verdict with all findings of its frame: the highest severity, and the denials and fans of each.

    The event code stays. The cause becomes that of the most severe finding, except that a declared edge keeps its cause
    until something holds the wheels, and an emergency until a return or a fault is found.
    """
    top = most_severe(findings)
    if top is None:
        return verdict
    holds = denies(findings)
    changes: dict[str, Any] = {"full_fans": any(finding.full_fans for finding in findings)}
    if holds:
        changes |= {"forward": False, "reverse": False, "turn": False}
    is_kept = verdict.code is EventCode.NEAR_EDGE or (
        verdict.code is EventCode.ABORTED and top.severity < Severity.RETURN
    )
    if not verdict.cause or not is_kept or (holds and top.severity > Severity.PAUSE):
        value, limit = float(top.value), float(top.limit)
        changes |= {"cause": top.cause, "signal": top.signal, "value": value, "limit": limit}
    return replace(verdict, severity=top.severity, **changes)


class SeverityEscalation:
    """Raises the severity of findings that last or repeat.

    A finding that lasts longer than the limit of its row gets the severity that the row states: a pause becomes a hold,
    so that a fix is taken before the mission continues. A hold becomes a fault, because it does not end by itself; one
    that was a pause does so after ``hold_limit_s``. A hold for the same signal that repeats
    more than ``retries`` times within ``retry_window_s`` becomes a fault, too.
    """

    def __init__(self, cfg: HealthConfig) -> None:
        self._cfg = cfg
        self._since_s: dict[str, float] = {}
        self._held: dict[str, deque[float]] = {}

    @property
    def is_counting(self) -> bool:
        """Whether the last frame had findings."""
        return bool(self._since_s)

    def escalate(self, t_s: float, findings: list[MonitorFinding]) -> list[MonitorFinding]:
        """The findings of a frame with raised severities. An empty list ends all durations."""
        since = self._since_s
        now: dict[str, float] = {}
        for finding in findings:
            now[finding.signal] = min(since.get(finding.signal, t_s), now.get(finding.signal, inf))
        self._since_s = now
        return [self._raised(t_s, finding) for finding in findings]

    def _raised(self, t_s: float, finding: MonitorFinding) -> MonitorFinding:
        row, lasted_s = finding.condition, t_s - self._since_s[finding.signal]
        if row.escalates_to is None:
            return finding
        patience_s = limit_s(row, self._cfg)
        if lasted_s >= patience_s:
            finding = finding._replace(severity=row.raised_severity)
            if finding.severity is Severity.HOLD and lasted_s >= self._cfg.hold_limit_s:
                patience_s, finding = self._cfg.hold_limit_s, finding._replace(severity=Severity.FAULT)
        if finding.severity is Severity.FAULT:
            return finding._replace(cause=replace(finding.cause, lasted_s=patience_s))
        return self._count(t_s, finding, is_new=lasted_s == 0.0) if finding.severity is Severity.HOLD else finding

    def _count(self, t_s: float, finding: MonitorFinding, *, is_new: bool) -> MonitorFinding:
        cfg, held = self._cfg, self._held.setdefault(finding.signal, deque())
        while held and t_s - held[0] > cfg.retry_window_s:
            held.popleft()
        if is_new:
            held.append(t_s)
        retries = cfg.retries if finding.condition.retries is None else finding.condition.retries
        if len(held) <= retries + 1:
            return finding
        return finding._replace(severity=Severity.FAULT, cause=replace(finding.cause, repetition=len(held) - 1))
