"""How a run ended: what happened, by whom, why, and which alarms were active then. Pure.

The block ``ended`` of ``summary.json`` holds names; ``ending_text`` makes the sentence for people.
"""

from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import Any

import msgspec

from ccatp.conditions import Group, find_condition
from ccatp.conditions.mission import OPERATOR
from ccatp.errors import ExitStatus
from ccatp.links.topics import MissionStatus, SeverityName
from ccatp.survey.events import SurveyOutcome


class End(StrEnum):
    """What happened at the end of a run."""

    COMPLETE = "complete"
    AT_BASE = "at_base"  # the robot was called, or went, to its base
    STOPPED = "stopped"  # by an operator, where the robot was
    FAULTED = "faulted"  # a fault that nobody can attend to in lockstep
    INTERRUPTED = "interrupted"  # by a signal to the program
    FAILED = "failed"  # a process or a peer failed, or the robot was refused


class By(StrEnum):
    """Who ended a run."""

    MISSION = "mission"
    OPERATOR = "operator"
    OBSERVATORY = "observatory"
    SIGNAL = "signal"
    PROGRAM = "program"


class AlarmAtEnd(msgspec.Struct, frozen=True):
    """An alarm that was active at the end."""

    name: str
    severity: SeverityName
    cause: str
    acknowledged_by: str = ""


class Ending(msgspec.Struct, frozen=True):
    """The end of a run.

    ``who``: name of the operator, if known. ``condition``, ``cause``: name and text of why it went home, was at fault,
    or was held when it was stopped.
    """

    what: End
    by: By
    who: str = ""
    condition: str = ""
    cause: str = ""
    alarms: tuple[AlarmAtEnd, ...] = ()


# An outcome of another kind of mission is none of these.
_OUTCOMES: Mapping[str, End] = {
    SurveyOutcome.COMPLETE: End.COMPLETE,
    SurveyOutcome.AT_BASE: End.AT_BASE,
    SurveyOutcome.STOPPED: End.STOPPED,
}
_TEXTS = {
    End.COMPLETE: "complete",
    End.AT_BASE: "returned to base",
    End.STOPPED: "stopped where it was",
    End.FAULTED: "ended with a fault",
    End.INTERRUPTED: "interrupted",
    End.FAILED: "failed",
}


def ending_of(status: MissionStatus | None, exit_status: ExitStatus, *, failure: str = "") -> Ending:
    """The end of a run with its last status; ``failure``: of a process that ended the run by its death."""
    alarms = tuple(
        AlarmAtEnd(one.name, one.severity, one.cause, one.acknowledged_by)
        for one in (() if status is None else status.alarms)
        if not one.ended
    )
    if failure or status is None:
        if exit_status is ExitStatus.INTERRUPTED:
            return Ending(End.INTERRUPTED, By.SIGNAL, alarms=alarms)
        return Ending(End.FAILED, By.PROGRAM, cause=failure, alarms=alarms)
    what = _OUTCOMES.get(status.outcome)
    if what is None:
        what = {ExitStatus.HELD: End.FAULTED, ExitStatus.INTERRUPTED: End.INTERRUPTED}.get(exit_status, End.FAILED)
    by = _by(what, status.condition)
    caller = str(status.turn.why.values.get("by", ""))
    who = (status.stopped_by if what is End.STOPPED else caller) if by is By.OPERATOR else ""
    return Ending(what, by, who, status.condition, "" if status.condition == OPERATOR.name else status.cause, alarms)


def _by(what: End, condition: str) -> By:
    match what:
        case End.COMPLETE:
            return By.MISSION
        case End.STOPPED:
            return By.OPERATOR
        case End.INTERRUPTED:
            return By.SIGNAL
        case End.FAILED:
            return By.PROGRAM
    if condition == OPERATOR.name:
        return By.OPERATOR
    row = find_condition(condition)
    return By.OBSERVATORY if row is not None and row.group == Group.OBSERVATORY else By.MISSION


def why_text(ending: Ending) -> str:
    """By whom and why a run ended; empty for a complete mission."""
    by = {
        By.OPERATOR: f"by {ending.who or 'an operator'}",
        By.OBSERVATORY: "by the observatory",
        By.SIGNAL: "by a signal",
    }.get(ending.by, "")
    is_before = ending.what in (End.STOPPED, End.INTERRUPTED)
    cause = f"held before: {ending.cause}" if ending.cause and is_before else ending.cause
    return ", ".join(part for part in (by, cause) if part)


def end_text(ending: Ending) -> str:
    """What happened, by whom and why."""
    return "; ".join(part for part in (_TEXTS[ending.what], why_text(ending)) if part)


def ending_text(ending: Ending) -> str:
    """The end in one line, with the alarms."""
    return "; ".join(part for part in (end_text(ending), alarms_text(ending.alarms)) if part)


def alarms_text(alarms: Iterable[AlarmAtEnd]) -> str:
    """The alarms at the end in one line; empty without any."""
    named = ", ".join(f"{one.name} ({one.severity})" for one in alarms)
    return f"alarms active at the end: {named}" if named else ""


def read_ending(summary: Mapping[str, Any] | None) -> Ending | None:
    """The end in a summary; ``None`` for one of an older version, or without a summary."""
    try:
        return msgspec.convert((summary or {})["ended"], Ending)
    except (KeyError, msgspec.ValidationError):
        return None
