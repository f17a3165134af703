"""The log of a run, ``log.jsonl``: lines for a reader, and when the mission changed its state."""

import json
import re
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from ccatp.conditions import danger_text

# Fields of every line.
_OWN = frozenset(("logger", "process", "event", "level", "timestamp", "wall", "seq", "t_s"))
# Names of events and keys in logs of older versions.
_OLD_EVENTS = {"run": "run_started", "end": "run_finished", "state": "state_changed", "verdict": "verdict_changed"}
_OLD_TIME, _OLD_LOGGER = "wall", "process"
_EVENT_NAME = re.compile(r"[a-z0-9_]+")
_DEBUG = "debug"
# At the end of a field's name.
_UNITS = frozenset(("s", "ms", "us", "m", "mm", "um", "rad", "mrad"))


class StateChange(NamedTuple):
    """At frame ``seq`` the mission went from one state to another."""

    seq: int
    before: str
    after: str


class LogLine(NamedTuple):
    """A line of the log; wall time in ISO format, robot time where it is known."""

    wall: str
    t_s: float | None
    level: str
    process: str
    text: str


class ReadLine(NamedTuple):
    """A parsed line: text for a reader (None for debugging), change of state, whether a session begins or ends."""

    shown: LogLine | None
    change: StateChange | None
    begins: bool
    ends: bool = False


def is_in_progress(lines: Iterable[ReadLine]) -> bool:
    """Whether a session began and has not ended: the run is in progress, or was killed."""
    marks = [line.begins for line in lines if line.begins or line.ends]
    return bool(marks) and marks[-1]


def read_log(path: Path, warnings: list[str]) -> Iterator[ReadLine]:
    """The lines of a log, oldest first; a missing log has none. Damage adds a line to ``warnings``."""
    bad = 0
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            for text in file:
                line = _parsed(text)
                if line is None:
                    bad += 1
                else:
                    yield line
    except FileNotFoundError:
        return
    except OSError as error:
        warnings.append(f"{path.name}: cannot be read: {error.strerror or error}")
    if bad:
        warnings.append(f"{path.name}: {bad} lines cannot be read and are not used")


def _parsed(text: str) -> ReadLine | None:
    try:
        fields = json.loads(text)
    except ValueError:
        return None
    if not isinstance(fields, dict) or not isinstance(fields.get("event"), str):
        return None
    process = str(fields.get("logger", fields.get(_OLD_LOGGER, "")))
    event = fields["event"] = _OLD_EVENTS.get(fields["event"], fields["event"])
    begins, ends = (event == name and process == "supervisor" for name in ("run_started", "run_finished"))
    if fields.get("level") == _DEBUG:
        change = None
        if event == "state_changed" and isinstance(fields.get("seq"), int):
            change = StateChange(fields["seq"], str(fields.get("before")), str(fields.get("after")))
        return ReadLine(None, change, begins, ends)
    t_s = fields.get("t_s")
    line = LogLine(
        wall=str(fields.get("timestamp", fields.get(_OLD_TIME, ""))),
        t_s=float(t_s) if isinstance(t_s, int | float) else None,
        level=str(fields.get("level", "")),
        process=process,
        text=_text(fields),
    )
    return ReadLine(line, None, begins, ends)


def _text(fields: dict[str, Any]) -> str:
    event = str(fields["event"])
    if event == "verdict_changed":
        return _verdict(fields)
    if event == "operator_message":
        return str(fields.get("text", ""))
    if _EVENT_NAME.fullmatch(event):  # older logs have sentences
        event = event.replace("_", " ")
    more = [_shown(key, value) for key, value in fields.items() if key not in _OWN and value not in ("", {}, [], None)]
    return f"{event}: {', '.join(more)}" if more else event


def _verdict(fields: dict[str, Any]) -> str:
    cause, signal, name = (str(fields.get(key, "")) for key in ("cause", "signal", "condition"))
    if not cause:
        return "danger: all is well again"
    value, limit = (found if isinstance(found := fields.get(key), int | float) else 0.0 for key in ("value", "limit"))
    return f"danger: {danger_text(name, cause, signal, value, limit)}, event code {fields.get('code')}"


def _shown(key: str, value: object) -> str:
    """``fan_time_ms``, 3.5 as "fan time 3.5 ms"."""
    stem, _, unit = key.rpartition("_")
    has_unit = bool(stem) and unit in _UNITS
    name = (stem if has_unit else key).replace("_", " ")
    return f"{name} {_value(value)} {unit}" if has_unit else f"{name} {_value(value)}"


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, dict):
        return ", ".join(_shown(str(key), inner).strip() for key, inner in value.items())
    if isinstance(value, list):
        return ", ".join(map(_value, value))
    return str(value)


def changes_of(lines: Iterable[ReadLine], sessions: int) -> list[tuple[StateChange, ...]]:
    """The changes of state in each session.

    They are numbered by the robot's frames. There are none where these restart within a session, because the robot
    booted, or where the log does not hold as many sessions as there are recordings: their times are then not known.
    """
    parts: list[list[StateChange]] = []
    for line in lines:
        if line.begins:
            parts.append([])
        elif line.change is not None and parts:
            parts[-1].append(line.change)
    if len(parts) != sessions:
        return [()] * sessions
    return [tuple(part) if all(a.seq <= b.seq for a, b in pairwise(part)) else () for part in parts]
