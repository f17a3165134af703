"""Reads what golden cases left behind, as streams of rows, and compares two trees, given what has been renamed."""

import json
import re
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

from mcap.reader import NonSeekingReader

Key = tuple[int | str, ...]
Row = tuple[Key, dict[str, Any]]
Observation = dict[str, list[Row]]

# Levels that are repeated on the machine's clock: where they ended is a function of the seed, when they were sent not.
LAST_ONLY = frozenset(("mission", "beacon_map"))
_LOG_FRAME = "seq"
# Messages of the robot link that begin a session: who comes first is a matter of time.
_SESSION = frozenset(("hello", "join", "joined"))
# Keys of a log line that say who wrote it and when.
_LOG_HEAD = frozenset(("event", "level", "logger", "process", "seq", "timestamp", "wall"))


def observe(folder: Path, *, only_results: bool) -> Observation:
    """Everything that may be compared of a case, in names of the tree that ran it."""
    found: defaultdict[str, list[Row]] = defaultdict(list)
    for path in sorted(folder.glob("exit.*")):
        found["exit"].append(((path.suffix[1:],), {"status": int(path.read_text())}))
    for path in sorted(folder.glob("out.*")):
        if (data := _json_of(path.read_text())) is not None:
            found["json"].append(((path.suffix[1:],), dict(flatten(data, path.suffix[1:]))))
    summary = folder / "run" / "summary.json"
    if summary.exists():
        found["summary"].append(((0,), dict(flatten(_json_of(summary.read_text())))))
    if not only_results:
        _observe_course(folder, found)
    return dict(found)


def _observe_course(folder: Path, found: defaultdict[str, list[Row]]) -> None:
    """What happened frame by frame."""
    replies = folder / "replies"
    if replies.exists():
        for k, line in enumerate(replies.read_text().splitlines()):
            found["replies"].append(((k,), dict(flatten(_json_of(line), "reply"))))
    for part, path in enumerate(sorted(folder.glob("wire.*"))):
        found["frames"] += _frames(path, part)
    for path in sorted(folder.glob("bus.*")):
        for topic, row in _published(path):
            found[f"bus:{topic}"].append(row)
    for part, path in enumerate(sorted((folder / "run").glob("*.mcap"))):
        for topic, key, fields in _recorded(path):
            found[topic].append(((part, *key), fields))
    log = folder / "run" / "log.jsonl"
    if log.exists():
        for name, row in _events(log):
            found[f"event:{name}"].append(row)
    for topic in LAST_ONLY & found.keys():
        found[topic] = [((0,), found[topic][-1][1])]


def flatten(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Numbers, texts and so on of a JSON value by their paths, as ``panels.0.tip``."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from flatten(inner, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list) and value:
        for k, inner in enumerate(value):
            yield from flatten(inner, f"{path}.{k}" if path else str(k))
    else:
        yield path, value


def _json_of(text: str | bytes) -> Any:
    """The value, ``None`` where the text is no JSON; 0 and 0.0 are the same number."""
    try:
        return json.loads(text, parse_int=float)
    except ValueError:
        return None


def _fields(message: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Fields of a message that comes in every frame; lists as text, which takes a tenth of the memory."""
    return {
        f"{prefix}{key}": json.dumps(value) if isinstance(value, list | dict) else value
        for key, value in message.items()
    }


def _frames(path: Path, part: int) -> Iterator[Row]:
    """A row per sensors frame of the robot link: what the robot sent, and what it received in answer."""
    rows: dict[tuple[int, int], dict[str, Any]] = {}
    boots: list[int] = []
    newest = -1
    for line in path.read_bytes().splitlines():
        text = line[1:].decode("utf-8", "replace")
        message = _json_of(text)
        if not isinstance(message, dict):
            message = {"type": "malformed", "line": text}
        kind, seq = str(message.pop("type", "")), int(message.pop("seq", -1))
        if kind == "hello" and message["boot"] not in boots:
            boots.append(message["boot"])
        if kind in _SESSION:
            continue
        if kind == "sensors":
            newest = frame = seq
        else:
            frame = int(message.pop("ack", newest))  # what has no number of a frame belongs to the newest one
        row = rows.setdefault((len(boots), frame), {})
        row.update(_fields(message, f"{kind}."))
    for (boot, seq), row in sorted(rows.items()):
        yield (part, boot, seq), row


def _recorded(path: Path) -> Iterator[tuple[str, Key, dict[str, Any]]]:
    """Topic, frame and fields of each message, and of each row of a batch: where batches end is a matter of time."""
    with path.open("rb") as file:
        for _, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            data = _json_of(message.data)
            batch = data.get("rows", data.get("lines"))
            if batch is None:
                yield channel.topic, (int(data.get("seq", -1)),), data
                continue
            for row in batch:
                is_list = isinstance(row, list)
                fields = {str(k): value for k, value in enumerate(row)} if is_list else _fields(row)
                yield channel.topic, (int(row[0] if is_list else row.get("seq", -1)),), fields


def _published(path: Path) -> Iterator[tuple[str, Row]]:
    for line in path.read_bytes().splitlines():
        topic, _, text = line.decode("utf-8", "replace").partition(" ")
        fields = _json_of(text)
        if isinstance(fields, dict):
            yield topic, ((int(fields.get("seq", -1)),), fields)


def _events(path: Path) -> Iterator[tuple[str, Row]]:
    for line in path.read_text(encoding="utf-8").splitlines():
        event = _json_of(line)
        if isinstance(event, dict) and isinstance(event.get(_LOG_FRAME), float):
            fields = {key: value for key, value in event.items() if key not in _LOG_HEAD}
            yield str(event["event"]), ((int(event[_LOG_FRAME]),), fields)


# In names of the base. Other topics and events are sent on the machine's clock, or follow from these.
COMPARED = (
    "exit", "summary", "json", "replies", "frames", "event:state", "bus:verdict", "bus:estimate",
    "track", "fix", "rest", "arrival", "treatment", "danger_event", "log", "mission", "sensors", "truth",
    "misalignment", "beacon_track", "beacon_map", "beacon_arrival", "beacon_truth", "beacon_places",
)  # fmt: skip
_MISSING = "(missing)"
_TEXT = "(text)"


@dataclass(frozen=True)
class Renames:
    """The tables of ``renames.toml``; see there."""

    base: str = ""
    streams: Mapping[str, str] = field(default_factory=dict)
    fields: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, str] = field(default_factory=dict)
    texts: Mapping[str, str] = field(default_factory=dict)
    wording: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()

    @classmethod
    def read(cls, path: Path) -> "Renames":
        """The tables of a file."""
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
        lenient = tables.pop("lenient", {})
        return cls(**tables, wording=tuple(lenient.get("wording", ())), ignored=tuple(lenient.get("ignored", ())))

    def arguments(self, arguments: Sequence[str]) -> list[str]:
        """A command line of the base in words of the new tree."""
        renamed: list[str] = []
        for argument in arguments:
            if renamed[-1:] == [self.options.get("--set", "--set")]:
                key, sign, value = argument.partition("=")
                renamed.append(f"{self.settings.get(key, key)}{sign}{value}")
            else:
                renamed += self.options.get(argument, argument).split(" ") if argument in self.options else [argument]
        return renamed

    def of_base(self, observation: Observation) -> Observation:
        """What the base left, in names of the new tree, without what is not compared."""
        return {
            self.streams.get(stream, stream): [
                (key, {self._field(stream, name): self._value(value) for name, value in row.items()})
                for key, row in observation[stream]
            ]
            for stream in COMPARED
            if stream in observation and self.streams.get(stream, stream)
        }

    def of_new(self, observation: Observation) -> Observation:
        """What the new tree left, without what is not compared."""
        names = {self.streams.get(stream, stream) for stream in COMPARED}
        return {stream: rows for stream, rows in observation.items() if stream in names}

    def lenient(self, stream: str, row: Mapping[str, Any]) -> dict[str, Any]:
        """A row without ignored fields and wordings."""
        return {
            name: _TEXT if isinstance(value, str) and value and _matches(f"{stream}.{name}", self.wording) else value
            for name, value in row.items()
            if not _matches(f"{stream}.{name}", self.ignored)
        }

    def _field(self, stream: str, name: str) -> str:
        renamed = self.fields.get(f"{stream}.{name}")
        return str(self._value(name)) if renamed is None else renamed

    def _value(self, value: Any) -> Any:
        if isinstance(value, str):
            for pattern, replacement in self.texts.items():
                value = re.sub(pattern, replacement, value)
        elif isinstance(value, list):
            return [self._value(inner) for inner in value]
        elif isinstance(value, dict):
            return {str(self._value(key)): self._value(inner) for key, inner in value.items()}
        return value


class Difference(NamedTuple):
    """The first row of a stream that is not the same; ``fields``: name, value of the base, value of the new tree."""

    stream: str
    key: str
    fields: tuple[tuple[str, Any, Any], ...]
    rows: int
    base_rows: int
    new_rows: int

    def __str__(self) -> str:
        counts = f"{self.rows} of {max(self.base_rows, self.new_rows)} rows differ"
        if self.base_rows != self.new_rows:
            counts += f", base {self.base_rows} rows, new {self.new_rows}"
        lines = [f"{self.stream}: {counts}; first at {self.key}"]
        lines += [f"    {name}: base {_short(base)}, new {_short(new)}" for name, base, new in self.fields[:_SHOWN]]
        if len(self.fields) > _SHOWN:
            lines.append(f"    and {len(self.fields) - _SHOWN} other fields")
        return "\n".join(lines)


_SHOWN = 5
_SHOWN_CHARACTERS = 120


def compare(base: Observation, new: Observation, renames: Renames) -> list[Difference]:
    """The first difference of each stream, streams in the order of their importance; none where all is equal."""
    left, right = renames.of_base(base), renames.of_new(new)
    streams = dict.fromkeys([renames.streams.get(stream, stream) for stream in COMPARED])
    found = [_compare_stream(name, left.get(name, []), right.get(name, []), renames) for name in streams]
    return [difference for difference in found if difference is not None]


def _compare_stream(name: str, left: list[Row], right: list[Row], renames: Renames) -> Difference | None:
    first: tuple[str, tuple[tuple[str, Any, Any], ...]] | None = None
    count = 0
    for base, new in zip_longest(left, right):
        if base == new and repr(base) == repr(new):
            continue
        fields = tuple(_compare_rows(name, base, new, renames))
        count += bool(fields)
        if fields and first is None:
            first = _shown_key(name, (base or new or ((), {}))[0]), fields
    return None if first is None else Difference(name, *first, count, len(left), len(right))


def _compare_rows(name: str, base: Row | None, new: Row | None, renames: Renames) -> Iterable[tuple[str, Any, Any]]:
    if base is None or new is None:
        yield "row", _MISSING if base is None else "present", _MISSING if new is None else "present"
        return
    if base[0] != new[0]:
        yield "frame", base[0], new[0]
        return
    left, right = renames.lenient(name, base[1]), renames.lenient(name, new[1])
    for key in dict.fromkeys((*left, *right)):
        one, other = left.get(key, _MISSING), right.get(key, _MISSING)
        if not _is_same(one, other):
            yield key, one, other


def _is_same(one: Any, other: Any) -> bool:
    """Bit for bit: 0.0 is not -0.0, and a number that is not finite equals itself."""
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_is_same, one, other))
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_is_same(one[key], other[key]) for key in one)
    return repr(one) == repr(other)


def _shown_key(stream: str, key: tuple[int | str, ...]) -> str:
    kind = {"exit": "step", "json": "step", "replies": "reply"}.get(stream, "frame")
    return f"{kind} {key[-1]}" if key else "the beginning"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]}..."


def _matches(name: str, patterns: Iterable[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)
