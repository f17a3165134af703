"""Keys, values and problems of a configuration as text: one line for each finding, TOML that reads back equal."""

import difflib
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import takewhile
from typing import Any, NamedTuple, get_args

from pydantic import BaseModel

from ccatp.config.models import Config

Key = tuple[str | int, ...]

_HEADER = re.compile(r"\s*\[\[?\s*(?P<key>[^\[\]]+?)\s*\]\]?\s*(#.*)?$")
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_PART = re.compile(rf"{_BARE.pattern}|\"[^\"]*\"|'[^']*'")
_ASSIGNMENT = re.compile(rf"\s*(?P<key>(?:{_PART.pattern})(?:\s*\.\s*(?:{_PART.pattern}))*)\s*=")
_WIDTH = 100


def find_line(text: str, key: Key) -> int | None:
    """Number (from 1) of the line that holds a key, or the nearest thing that encloses it.

    A key inside an inline table or an array is found at the line of its table or array.
    """
    path = tuple(takewhile(lambda part: isinstance(part, str), key))
    best, best_line = 0, None
    section: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            full = section = _parts(header["key"])
        elif assignment := _ASSIGNMENT.match(line):
            full = section + _parts(assignment["key"])
        else:
            continue
        if len(full) > best and full == path[: len(full)]:
            best, best_line = len(full), number
        elif path and full[: len(path)] == path and best < len(path):
            return number  # the section itself has no header of its own: its first key stands for it
    return best_line


def _parts(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip("\"'") for part in _PART.findall(dotted))


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
        text = format_value(value)
        if len(text) > _WIDTH and isinstance(value, Sequence) and not isinstance(value, str):
            text = "[\n" + "".join(f"  {format_value(item)},\n" for item in value) + "]"
        yield f"{_quoted(name)} = {text}"
    for name, value in data.items():
        if isinstance(value, Mapping):
            yield from _section(value, (*path, name))


def _quoted(name: str) -> str:
    return name if _BARE.fullmatch(name) else format_value(name)


_DEGREE = math.pi / 180.0

# Suffix of a key, factor from the unit that people write by mistake, that unit, the right one. Longest suffix first.
UNIT_SLIPS = (
    ("_rad_s2", _DEGREE, "deg/s2", "rad/s2"),
    ("_m_s2", 1e-3, "mm/s2", "m/s2"),
    ("_rad_s", _DEGREE, "deg/s", "rad/s"),
    ("_m_s", 1e-3, "mm/s", "m/s"),
    ("_rad", _DEGREE, "degrees", "rad"),
    ("_m", 1e-3, "millimetres", "m"),
    ("_duty", 1e-2, "per cent", ""),
    ("_floor", 1e-2, "per cent", ""),
    ("_fraction", 1e-2, "per cent", ""),
    ("_s", 1e-3, "milliseconds", "s"),
)
_BOUNDS = {
    "greater_than": ("gt", "must be greater than"),
    "greater_than_equal": ("ge", "must be at least"),
    "less_than": ("lt", "must be less than"),
    "less_than_equal": ("le", "must be at most"),
}
_TYPES = {
    **dict.fromkeys(("float_type", "float_parsing"), "must be a number"),
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "must be a whole number"),
    "string_type": "must be text in quotes",
    **dict.fromkeys(("bool_type", "bool_parsing"), "must be true or false"),
    "finite_number": "must be a finite number",
    "tuple_type": "must be an array",
    **dict.fromkeys(("model_type", "model_attributes_type", "dict_type"), "must be a section, not a value"),
}
_SHOWN = 60


class ConfigProblem(NamedTuple):
    """One thing wrong with a configuration; the user may have meant to change one of the ``related`` keys."""

    key: Key
    what: str
    related: tuple[Key, ...] = ()


def nearest(name: str, names: Iterable[str]) -> str | None:
    """The most similar of ``names``, or ``None`` when none is similar."""
    found = difflib.get_close_matches(name, list(names), n=1, cutoff=0.6)
    return found[0] if found else None


def choice_hint(name: str, names: Iterable[str]) -> str:
    """``did you mean X? available: X, Y``."""
    names = sorted(names)
    near = nearest(name, names)
    meant = f"did you mean {near}? " if near else ""
    return f"{meant}available: {', '.join(names) or 'none'}"


def slip_hint(key: Key, value: float, limit: float = math.inf) -> str:
    """``; looks like millimetres: write 0.03`` when the value in the usual wrong unit lies within ``limit``."""
    name = next((part for part in reversed(key) if isinstance(part, str)), "")
    for suffix, factor, wrong, right in UNIT_SLIPS:
        if name.endswith(suffix):
            fits = abs(value) * factor <= limit
            return f"; looks like {wrong}: {value:g} {wrong} are {value * factor:.6g} {right}".rstrip() if fits else ""
    return ""


def faults_of(errors: Iterable[Mapping[str, Any]], root: type[BaseModel] = Config) -> list[ConfigProblem]:
    """The findings of ``ValidationError.errors()`` as faults, misspelt keys first: they also cause missing ones."""
    ordered = sorted(errors, key=lambda error: error["type"] != "extra_forbidden")
    return [ConfigProblem(tuple(error["loc"]), _what(error, root)) for error in ordered]


def _what(error: Mapping[str, Any], root: type[BaseModel]) -> str:
    kind, key, value = error["type"], tuple(error["loc"]), error["input"]
    if kind == "extra_forbidden":
        return _unknown(key, root)
    if kind == "missing":
        return "is missing"
    if kind == "too_long":
        return f"has too many values: {error['ctx']['actual_length']}, not {error['ctx']['max_length']}"
    shown = format_value(value)
    shown = shown if len(shown) <= _SHOWN else shown[:_SHOWN] + "..."
    if kind in _BOUNDS:
        bound, phrase = _BOUNDS[kind]
        limit = error["ctx"][bound]
        slip = slip_hint(key, value, limit) if bound in {"lt", "le"} else ""
        return f"= {shown} {phrase} {limit:g}{slip}"
    if kind == "literal_error":
        return f"= {shown} must be {error['ctx']['expected']}"
    return f"= {shown} {_TYPES.get(kind, error['msg'])}"


def _unknown(key: Key, root: type[BaseModel]) -> str:
    """A key that no model has: the nearest one beside it, else one of the same name in another section."""
    name = str(key[-1])
    siblings = list(_fields(key[:-1], root))
    if near := nearest(name, siblings):
        return f"is unknown; did you mean {format_key((*key[:-1], near))}?"
    everywhere = {path[-1]: format_key(path) for path in _paths(root, ())}
    if near := nearest(name, everywhere):
        return f"is unknown; did you mean {everywhere[near]}?"
    return f"is unknown; known here: {', '.join(siblings)}"


def _fields(path: Key, root: type[BaseModel]) -> Mapping[str, Any]:
    """The fields of the model at a path of the configuration; empty where there is no model."""
    model: Any = root
    for part in path:
        fields = getattr(model, "model_fields", None)
        if fields is not None:
            model = fields[part].annotation if part in fields else None
        else:  # dict[str, Model]: any name leads to the model
            model = (None, *get_args(model))[-1]
    fields = getattr(model, "model_fields", {})
    return fields if isinstance(fields, Mapping) else {}


def _paths(model: type[BaseModel], prefix: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """All keys of a model and of the models in it."""
    for name, field in model.model_fields.items():
        yield (*prefix, name)
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _paths(field.annotation, (*prefix, name))
