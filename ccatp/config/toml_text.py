"""Pure. TOML as text: where a key stands in a file, and a writer whose output reads back equal."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence

Key = tuple[str | int, ...]

_HEADER = re.compile(r"\s*\[\[?\s*(?P<key>[^\[\]]+?)\s*\]\]?\s*(#.*)?$")
_ASSIGNMENT = re.compile(
    r"\s*(?P<key>(?:[A-Za-z0-9_-]+|\"[^\"]*\"|'[^']*')(?:\s*\.\s*(?:[A-Za-z0-9_-]+|\"[^\"]*\"|'[^']*'))*)\s*="
)
_PART = re.compile(r"[A-Za-z0-9_-]+|\"[^\"]*\"|'[^']*'")
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_WIDTH = 100


def find_line(text: str, key: Key) -> int | None:
    """Number (from 1) of the line that holds a key, or the nearest thing that encloses it.

    A key inside an inline table or an array is found at the line of its table or array.

    Args:
        text: TOML that parses.
        key: path of the key.
    """
    path = _names(key)
    best, best_line = 0, None
    for number, full in _keys(text):
        if len(full) > best and full == path[: len(full)]:
            best, best_line = len(full), number
        elif path and full[: len(path)] == path and best < len(path):
            return number  # the section itself has no header of its own: its first key stands for it
    return best_line


def _keys(text: str) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Every header and assignment of a text: line number and full path."""
    section: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            section = _parts(header["key"])
            yield number, section
        elif assignment := _ASSIGNMENT.match(line):
            yield number, section + _parts(assignment["key"])


def _parts(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip("\"'") for part in _PART.findall(dotted))


def _names(key: Key) -> tuple[str, ...]:
    """The part of a key before the first index into an array."""
    names: list[str] = []
    for part in key:
        if isinstance(part, int):
            break
        names.append(part)
    return tuple(names)


def format_key(key: Key) -> str:
    """``("robot", "edge_sensors_m", 0)`` as ``robot.edge_sensors_m[0]``."""
    text = ""
    for part in key:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def format_toml(data: Mapping[str, object]) -> str:
    """A mapping of values, arrays and mappings as TOML; ``tomllib.loads`` gives it back, floats to the last bit."""
    return "\n".join(_section(data, ())).strip() + "\n"


def format_value(value: object) -> str:
    """One value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON's escapes are TOML's, but for DEL, which TOML wants escaped and JSON leaves as it is
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        return "{" + ", ".join(f" {_quoted(name)} = {format_value(item)}" for name, item in value.items()) + " }"
    if isinstance(value, Sequence):
        return "[" + ", ".join(format_value(item) for item in value) + "]"
    return repr(value)


def _section(data: Mapping[str, object], path: tuple[str, ...]) -> Iterator[str]:
    """Lines of one section: header, plain keys, then its sub-sections."""
    plain = {name: value for name, value in data.items() if not isinstance(value, Mapping)}
    if path and (plain or not data):
        yield ""
        yield f"[{'.'.join(_quoted(name) for name in path)}]"
    for name, value in plain.items():
        yield f"{_quoted(name)} = {_folded(value)}"
    for name, value in data.items():
        if isinstance(value, Mapping):
            yield from _section(value, (*path, name))


def _folded(value: object) -> str:
    """A long array with one element a line."""
    text = format_value(value)
    if len(text) <= _WIDTH or isinstance(value, str) or not isinstance(value, Sequence):
        return text
    return "[\n" + "".join(f"  {format_value(item)},\n" for item in value) + "]"


def _quoted(name: str) -> str:
    return name if _BARE.fullmatch(name) else format_value(name)
