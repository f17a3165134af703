"""Pure. What is wrong with a configuration, in words: from pydantic's findings to one line with a hint."""

import difflib
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple, get_args

from pydantic import BaseModel

from ccatp.config.models import Config
from ccatp.config.toml_text import Key, format_key, format_value

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
    "float_type": "must be a number",
    "float_parsing": "must be a number",
    "int_type": "must be a whole number",
    "int_parsing": "must be a whole number",
    "int_from_float": "must be a whole number",
    "string_type": "must be text in quotes",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
    "finite_number": "must be a finite number",
    "tuple_type": "must be an array",
    "model_type": "must be a section, not a value",
    "model_attributes_type": "must be a section, not a value",
    "dict_type": "must be a section, not a value",
}
_SHOWN = 60


class Fault(NamedTuple):
    """One thing wrong with a configuration.

    Attributes:
        key: the key.
        what: a phrase that follows it.
        related: keys that contradict ``key``, any of which the user may have meant to change.
    """

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


def faults_of(errors: Iterable[Mapping[str, Any]], root: type[BaseModel] = Config) -> list[Fault]:
    """The findings of ``ValidationError.errors()`` as faults, misspelt keys first: they also cause missing ones.

    Args:
        errors: the findings.
        root: the model that was validated.
    """
    ordered = sorted(errors, key=lambda error: error["type"] != "extra_forbidden")
    return [Fault(tuple(error["loc"]), _what(error, root)) for error in ordered]


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
