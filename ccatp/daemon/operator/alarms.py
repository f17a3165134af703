"""The list of alarms of a run: what is wrong, since when, what to do, and who has acknowledged it.

An alarm is an active condition of ``ccatp.conditions``, with its name; a condition that repeats remains one alarm. An
alarm that held the robot or sent it home stays in the list after its end until it is acknowledged. Each event of the
list is a line of ``alarms.jsonl`` in the run directory, so that a main loop that takes over has the same list.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from os import SEEK_END
from pathlib import Path
from typing import Literal, NamedTuple, cast

import msgspec
import structlog

from ccatp.conditions import find_condition, text_of
from ccatp.conditions.mission import OPERATOR
from ccatp.config.files import read_text
from ccatp.core import Cause, Severity
from ccatp.links.topics import Alarm, SeverityName

ALARMS_FILE = "alarms.jsonl"
# Bounds of the file, for an alarm that is raised and ended for hours; the list itself stays complete.
MAX_LINES, MOST_BYTES = 10_000, 1 << 23
# From this severity on a cause is an alarm at once, and stays in the list until it is acknowledged.
LASTING = Severity.HOLD
# A less severe cause must last, by the robot's or the host's clock: the first frames of a run always miss something.
LEAST_S = 1.0


def utc_now() -> str:
    """The present time in the format of the list, UTC."""
    return datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


class _Activity(NamedTuple):
    """When an alarm became active, by the robot's and the host's clock, and how many texts it had at most since."""

    robot_s: float
    host_s: float
    texts: int


class ActiveCause(NamedTuple):
    """An active cause: name of its condition, the text for operators, and its severity."""

    name: str
    cause: str
    severity: Severity


def active_cause(cause: Cause) -> ActiveCause:
    """A cause with the severity of its row; that of a condition that is not known here is the highest."""
    row = find_condition(cause.condition)
    return ActiveCause(cause.condition, text_of(cause), Severity.FAULT if row is None else row.alarm_severity)


EventName = Literal["raised", "ended", "acknowledged"]


class AlarmEvent(msgspec.Struct, frozen=True):
    """An event of an alarm, UTC and robot time: ``raised``, ``ended``, ``acknowledged``.

    ``raised`` also to a higher severity, or once more beside what is active, as a second emergency.
    """

    utc: str
    t_s: float
    event: EventName
    name: str
    severity: SeverityName
    cause: str
    by: str = ""


_decoder = msgspec.json.Decoder(AlarmEvent)


def read_history(run_dir: Path) -> Iterator[AlarmEvent]:
    """The events of the alarms of a run, oldest first; a line that was cut off by a kill is left out."""
    try:
        text = read_text(run_dir / ALARMS_FILE, MOST_BYTES)
    except (OSError, UnicodeDecodeError):  # there is none yet, or it cannot be read
        return
    for line in text.splitlines():
        with suppress(msgspec.MsgspecError):
            yield _decoder.decode(line)


class AlarmList:
    """Raises, ends and acknowledges alarms; ``now`` returns the time for the list."""

    def __init__(
        self, run_dir: Path, log: structlog.typing.FilteringBoundLogger, now: Callable[[], str] = utc_now
    ) -> None:
        self._path = run_dir / ALARMS_FILE
        self._log = log
        self._now = now
        self._alarms: dict[str, Alarm] = {}
        self._active: dict[str, _Activity] = {}
        self._lines = 0
        for event in read_history(run_dir):
            self._lines += 1
            self._apply(event)

    @property
    def alarms(self) -> list[Alarm]:
        """The active alarms, the most severe first, then those that ended and are not acknowledged."""
        return sorted(self._alarms.values(), key=lambda one: (bool(one.ended), -Severity[one.severity.upper()]))

    def update(self, causes: Iterable[ActiveCause], t_s: float) -> None:
        """Set the active causes at robot time ``t_s``; a command of an operator is no alarm."""
        active: dict[str, tuple[Severity, list[str]]] = {}
        for name, cause, severity in causes:
            if name != OPERATOR.name:
                known, texts = active.get(name, (Severity.INFORM, []))
                active[name] = max(known, severity), texts if cause in texts else [*texts, cause]
        now_s = time.monotonic()
        before, self._active = self._active, {}
        for name, (severity, texts) in active.items():
            cause = "; ".join(texts)
            since = before.get(name, _Activity(t_s, now_s, len(texts)))
            self._active[name] = since._replace(texts=max(since.texts, len(texts)))
            if severity < LASTING and max(t_s - since.robot_s, now_s - since.host_s) < LEAST_S:
                continue
            alarm, word = self._alarms.get(name), cast(SeverityName, severity.name.lower())
            is_more = alarm is None or alarm.ended or Severity[alarm.severity.upper()] < severity
            if is_more or len(texts) > since.texts:
                self._happened("raised", name, t_s, word, cause=cause)
            elif (
                alarm is not None and alarm.severity == word
            ):  # the newest text, without an event: a number in it has changed
                self._alarms[name] = msgspec.structs.replace(alarm, cause=cause)
        for alarm in list(self._alarms.values()):
            if not alarm.ended and alarm.name not in active:
                self._happened("ended", alarm.name, t_s, alarm.severity, cause=alarm.cause)

    def acknowledge(self, name: str, by: str, t_s: float) -> str | None:
        """Acknowledge an alarm; returns why it was refused, or None. A second time has no effect."""
        alarm = self._alarms.get(name)
        if alarm is None:
            known = ", ".join(one.name for one in self.alarms)
            return f"no alarm {name!a}; " + (f"the list has {known}" if known else "the list is empty")
        if not alarm.acknowledged_by:
            self._happened("acknowledged", name, t_s, alarm.severity, cause=alarm.cause, by=by)
        return None

    def _happened(
        self, what: EventName, name: str, t_s: float, severity: SeverityName, cause: str, by: str = ""
    ) -> None:
        event = AlarmEvent(self._now(), round(t_s, 3), what, name, severity=severity, cause=cause, by=by)
        self._apply(event)
        self._log.info(f"alarm_{what}", name=name, severity=severity, cause=cause, by=by, t_s=t_s)
        if self._lines >= MAX_LINES:
            return
        self._lines += 1
        try:
            with self._path.open("ab+") as file:
                # After a line that a kill cut off, the next event begins on its own line.
                at = file.seek(0, SEEK_END)
                file.seek(max(at - 1, 0))
                is_torn = file.read(1) not in (b"\n", b"")
                file.write(b"\n" * is_torn + msgspec.json.encode(event) + b"\n")
        except OSError as error:  # the list in memory and the log still have it
            self._log.warning("alarm_not_stored", error=str(error))

    def _apply(self, event: AlarmEvent) -> None:
        name, known = event.name, self._alarms.get(event.name)
        if event.event == "raised":
            row = find_condition(name)
            alarm = Alarm(
                name=name,
                severity=event.severity,
                cause=event.cause,
                advice=row.advice if row is not None else "",
                since=event.utc,
                since_s=event.t_s,
            )
            if known is not None:
                is_graver = not known.ended and known.severity != event.severity
                alarm.count = known.count if is_graver else known.count + 1
                if not known.ended:
                    alarm.since, alarm.since_s = known.since, known.since_s
        elif known is None:
            return
        elif event.event == "acknowledged":
            alarm = msgspec.structs.replace(known, acknowledged_by=event.by, acknowledged=event.utc)
        else:
            alarm = msgspec.structs.replace(known, ended=event.utc)
        is_lasting = Severity[alarm.severity.upper()] >= LASTING
        if alarm.ended and (alarm.acknowledged_by or not is_lasting):
            self._alarms.pop(name, None)
        else:
            self._alarms[name] = alarm
