"""Compares what two trees left behind, given what has been renamed between them."""

import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

from tests.golden.observation import Observation, Row

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
