"""THE table of conditions: everything that slows, pauses, holds, returns or stops the robot, one row per condition.

Here is what a row is, and how it is found by its name. ``danger.py`` and ``mission.py`` have the rows.

The danger loop may find several conditions at once. The one with the highest severity counts, then the one with the
lowest number in ``precedence``. Two exceptions for the verdict's cause: that of a declared edge stays unless a hold or
a fault is found; that of an emergency stays unless a return or a fault is found. Each other owner reports one condition
at a time. ``docs/alarms.md`` is generated from these rows. A mission may register rows of its own from another file.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum, StrEnum
from functools import cache, partial
from importlib import import_module
from math import inf, isfinite
from typing import NamedTuple, ParamSpec

from ccatp.core import ALL_MOTION, NO_MOTION, Cause, EventCode, Permits, Severity, Verdict
from ccatp.missions import SEARCHED, MissionKind, all_kinds


class Motion(Enum):
    """Motion that is still permitted."""

    ANY = "anything"
    RETREAT = "away from it"
    RETURN = "home"
    ABORT = "home, because it is called"
    NONE = "nothing"

    def permits(self, away: Permits = ALL_MOTION) -> Permits:
        """The permits of a verdict; ``away``: those of a retreat."""
        if self is Motion.NONE:
            return NO_MOTION
        return away if self is Motion.RETREAT else ALL_MOTION


class Clear(Enum):
    """What ends the reaction after the condition itself has ended."""

    AUTO = "by itself"
    AFTER_FIX = "after a fix"
    OPERATOR = "by an operator"


class Action(Enum):
    """Reactions to a condition."""

    EARTHQUAKE = "wheels held, then home"
    FAULT = "fault: held until an operator resumes"
    LOCATE = "hold: wheels held, one fix at rest, then held until it is over"
    HOLD = "hold: wheels held, a fix, then it continues by itself"
    SLOW = "half the speed"
    RETURN = "home"
    ABORT = "home, because it is called"
    WAIT = "hold: wheels held until no sensor hangs over"
    RETREAT = "back off"
    PAUSE = "pause: wheels held, continues by itself"
    KEEP_AWAY = "no motion towards it"
    INFORM = "reported"


# Severity of the verdict; that of the other actions is NONE, because event code and permits express them.
_SEVERITY = {
    Action.FAULT: Severity.FAULT,
    Action.RETURN: Severity.RETURN,
    Action.LOCATE: Severity.HOLD,
    Action.HOLD: Severity.HOLD,
    Action.PAUSE: Severity.PAUSE,
    Action.SLOW: Severity.SLOW,
    Action.INFORM: Severity.INFORM,
}
_CODE = dict.fromkeys((Action.RETREAT, Action.WAIT, Action.KEEP_AWAY), EventCode.NEAR_EDGE) | dict.fromkeys(
    (Action.EARTHQUAKE, Action.ABORT), EventCode.ABORTED
)
# Severity in the list of alarms of an action without one in the verdict.
_ALARM_SEVERITY = {
    Action.EARTHQUAKE: Severity.FAULT,
    Action.ABORT: Severity.RETURN,
    Action.WAIT: Severity.HOLD,
    Action.RETREAT: Severity.PAUSE,
    Action.KEEP_AWAY: Severity.INFORM,
}


class Owner(StrEnum):
    """The component that finds a condition."""

    DANGER = "danger loop"
    LOCALIZER = "localizer"
    MISSION = "mission"
    FIXES = "fix service"
    MAIN = "main loop"
    LINK = "robot link"
    OPERATOR = "operator"


class Actor(StrEnum):
    """Who acts next while a condition holds the robot, sends it home or is reported."""

    ROBOT = "robot"  # it continues by itself when the condition has ended
    OPERATOR = "operator"
    OBSERVATORY = "observatory"
    NOBODY = "nobody"  # the mission is over, and nothing is left to do


ALONE = 0  # precedence of a condition that its owner never reports together with another one


class Group(StrEnum):
    """The chapters of the list of alarms."""

    EDGES = "Edges"
    DATA = "Data that are missing or old"
    SENSORS = "Edge sensors and inertial unit"
    WHEELS = "Wheels and encoders"
    FANS = "Fans and battery"
    LINK = "Link and clock"
    SURVEY = "The survey"
    STORAGE = "Storage"
    OBSERVATORY = "The observatory"


@dataclass(frozen=True, slots=True, eq=False)
class Condition:
    """One row.

    ``name``: the public name, of alarms and events. ``precedence``: of findings with equal severity the lowest number
    counts. ``message``: text of the cause, with "{...}" for variable parts;
    ``meaning``: when it applies; ``advice``: what an operator can do. ``clear``: what ends a pause, a hold or a fault
    that the danger loop finds. ``limit``: key of the configuration with the time after which the action is
    ``escalates_to``. ``full_fans``: full fans meanwhile.
    ``retries``: how often it may repeat before it is a fault; ``None``: as configured.
    ``unit``: of the value against its limit. ``trusts_wheels``: what the wheels show in the hold is right.
    ``actor``: who acts next. ``then``: the one next action of people, in the imperative; also where the robot acts
    first, because the condition may last until it is a fault (``ccatp.survey.turn``).
    """

    name: str
    owner: Owner
    precedence: int
    group: str  # one of ``Group``, or a chapter of a mission's own
    message: str
    meaning: str
    advice: str
    action: Action
    motion: Motion
    clear: Clear | None = None
    limit: str = ""
    escalates_to: Action | None = None
    full_fans: bool = False
    retries: int | None = None
    unit: str = ""
    trusts_wheels: bool = False
    actor: Actor = Actor.ROBOT
    then: str = ""

    @property
    def severity(self) -> Severity:
        """Severity of the verdict."""
        return _SEVERITY.get(self.action, Severity.NONE)

    @property
    def code(self) -> EventCode:
        """Event code of a verdict about it alone."""
        return _CODE.get(self.action, EventCode.NORMAL)

    @property
    def raised_severity(self) -> Severity:
        """Severity after ``limit``; NONE if it does not rise."""
        return Severity.NONE if self.escalates_to is None else _SEVERITY[self.escalates_to]

    @property
    def alarm_severity(self) -> Severity:
        """Severity in the list of alarms; for an edge or an emergency it follows from the action."""
        return self.severity or _ALARM_SEVERITY[self.action]

    def cause(self, **values: object) -> Cause:
        """The condition as a cause; ``values``: of the variable parts of the message."""
        return Cause(self.name, {name: _plain(value) for name, value in values.items()})

    def found(self, signal: str, value: float, limit: float, **values: str) -> "MonitorFinding":
        """The finding that the condition applies: ``value`` against ``limit``; ``values``: parts of the message."""
        return MonitorFinding(self, self.severity, self.cause(**values), signal, value, limit, self.full_fans)


def _plain(value: object) -> int | float | str:
    """A value as it travels; a number that JSON has no form for, and any other object, as text."""
    if isinstance(value, str | int):
        return value
    return float(value) if isinstance(value, float) and isfinite(value) else str(value)


class MonitorFinding(NamedTuple):
    """A condition that applies, at present; ``value`` in the unit of ``limit``."""

    condition: Condition
    severity: Severity
    cause: Cause
    signal: str
    value: float
    limit: float
    full_fans: bool = False

    def verdict(self, seq: int, t_s: float, code: EventCode) -> Verdict:
        """The verdict on frame ``seq`` if nothing else is found."""
        permits = self.condition.motion.permits()
        return Verdict(
            seq, t_s, code, self.cause, self.signal, self.value, self.limit, *permits, severity=self.severity
        )


TABLE: dict[str, Condition] = {}  # the rows by name that this process has registered
P = ParamSpec("P")


# Rows of every mission; a kind of mission names the module of its own.
_ROWS = "ccatp.conditions.danger", "ccatp.conditions.mission"


@cache
def _register(kinds: Callable[[], Iterable[MissionKind]]) -> None:
    for module in (*_ROWS, *(kind.conditions for kind in kinds() if kind.conditions)):
        import_module(module)


def find_condition(name: str) -> Condition | None:
    """The row of a name; ``None``: no kind of mission has it, or there is no cause."""
    for kinds in SEARCHED:
        if not name or name in TABLE:
            break
        _register(kinds)
    return TABLE.get(name)


def all_conditions() -> tuple[Condition, ...]:
    """The rows of every kind of mission: by their precedence, then those that are found alone."""
    _register(all_kinds)
    return tuple(sorted(TABLE.values(), key=lambda row: row.precedence or inf))


def registered(make: Callable[P, Condition]) -> Callable[P, Condition]:
    """A function that makes a row and registers it. Raises ValueError: the name is taken."""

    def row(*args: P.args, **kwargs: P.kwargs) -> Condition:
        made = make(*args, **kwargs)
        if made.name in TABLE:
            raise ValueError(f"conditions: {made.name} is registered twice")
        TABLE[made.name] = made
        return made

    return row


# Usual fields of a row by its action; a row may override them.
_wait = partial(Condition, action=Action.PAUSE, motion=Motion.NONE, clear=Clear.AUTO)
inform = registered(partial(Condition, action=Action.INFORM, motion=Motion.ANY))
slow = registered(partial(Condition, action=Action.SLOW, motion=Motion.ANY))
wait = registered(_wait)
pause = registered(partial(_wait, limit="health.pause_limit_s", escalates_to=Action.HOLD))
hold = registered(
    partial(
        Condition,
        action=Action.HOLD,
        motion=Motion.NONE,
        clear=Clear.AFTER_FIX,
        limit="health.hold_limit_s",
        escalates_to=Action.FAULT,
    )
)
# More than ``health.retries`` of them within ``health.retry_window_s`` are a fault.
diverged = registered(partial(Condition, action=Action.HOLD, motion=Motion.NONE, clear=Clear.AFTER_FIX))
go_home = registered(partial(Condition, action=Action.RETURN, motion=Motion.RETURN))
fault = registered(
    partial(Condition, action=Action.FAULT, motion=Motion.NONE, clear=Clear.OPERATOR, actor=Actor.OPERATOR)
)
shaken = registered(partial(Condition, action=Action.EARTHQUAKE, motion=Motion.NONE, actor=Actor.OBSERVATORY))
edge = registered(partial(Condition, action=Action.RETREAT, motion=Motion.RETREAT))
near = registered(partial(Condition, action=Action.KEEP_AWAY, motion=Motion.RETREAT))


def text_of(cause: Cause) -> str:
    """The text of a cause for people; a cause without a row here, of a newer version, is shown by its name."""
    if not cause:
        return ""
    row = find_condition(cause.condition)
    try:
        text = cause.condition if row is None else row.message.format(**cause.values)
    except (KeyError, ValueError, IndexError):  # the values are of another version
        row, text = None, cause.condition
    if row is None and cause.values:
        text += f" ({', '.join(f'{name} {value}' for name, value in cause.values.items())})"
    text += f", for more than {cause.lasted_s:g} s" if cause.lasted_s else ""
    text += f", on repetition {cause.repetition}" if cause.repetition else ""
    return text if cause.besides is None else f"{text}; {text_of(cause.besides)}"


def danger_text(condition: str, cause: str, signal: str, value: float, limit: float) -> str:
    """Like ``estimate stale: 0.31 s (limit 0.15 s)``; without a limit of 0 or a signal that ``cause`` names."""
    named, row = signal.replace("_", " "), find_condition(condition)
    is_named = not named or named in cause or (row is not None and row.group == Group.OBSERVATORY)
    where = "" if is_named else f" ({named})"
    if not limit:
        return cause + where
    shown, bound = (f"{number:.4g} {row.unit if row else ''}".rstrip() for number in (value, limit))
    # A signal that was never received has its age set to the limit.
    return f"{cause}{where}: " + (f"limit {bound}" if shown == bound else f"{shown} (limit {bound})")
