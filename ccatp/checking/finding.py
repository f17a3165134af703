"""Pure. One line of the check before a mission, and all of them as a table."""

from collections.abc import Iterable, Sequence
from enum import StrEnum
from typing import Any, NamedTuple


class Outcome(StrEnum):
    """How a check went."""

    PASS = "pass"  # noqa: S105 - no password
    WARN = "warn"  # a mission is possible; somebody should know
    FAIL = "fail"
    SKIP = "skip"  # what it would look at is not there


class Finding(NamedTuple):
    """One check.

    Attributes:
        name: what was looked at.
        outcome: how it went.
        found: what was seen.
        todo: what to do; empty where all is well.
    """

    name: str
    outcome: Outcome
    found: str
    todo: str = ""


def passed(name: str, found: str) -> Finding:
    """All is well."""
    return Finding(name, Outcome.PASS, found)


def warned(name: str, found: str, todo: str) -> Finding:
    """A mission is possible."""
    return Finding(name, Outcome.WARN, found, todo)


def failed(name: str, found: str, todo: str) -> Finding:
    """No mission like that."""
    return Finding(name, Outcome.FAIL, found, todo)


def skipped(names: Iterable[str], why: str) -> list[Finding]:
    """What could not be looked at."""
    return [Finding(name, Outcome.SKIP, why) for name in names]


def has_failed(findings: Iterable[Finding]) -> bool:
    """Whether one failed."""
    return any(finding.outcome is Outcome.FAIL for finding in findings)


def lines(findings: Sequence[Finding]) -> list[str]:
    """The table as plain text, and what it comes to."""
    width = max(len(finding.name) for finding in findings)
    text = []
    for finding in findings:
        text.append(f"{finding.outcome:<4}  {finding.name:<{width}}  {finding.found}")
        if finding.todo:
            text.append(f"{'':4}  {'':{width}}  -> {finding.todo}")
    counts = {outcome: sum(f.outcome is outcome for f in findings) for outcome in Outcome}
    told = ", ".join(f"{count} {outcome}" for outcome, count in counts.items() if count)
    return [*text, f"{'not ready' if has_failed(findings) else 'ready'}: {told}"]


def as_json(findings: Sequence[Finding]) -> dict[str, Any]:
    """For ``--json``."""
    return {"ready": not has_failed(findings), "checks": [finding._asdict() for finding in findings]}
