"""Configuration files as text; keys, values and problems in messages: one line for each finding."""

import difflib
import json
import math
import re
import tomllib
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping
from functools import cache, lru_cache
from typing import Any, NamedTuple, get_args

from pydantic import BaseModel

from ccatp.config.models import PATTERNS, Config
from ccatp.errors import ConfigError, one_line

Key = tuple[str | int, ...]

_DEGREE = math.pi / 180.0
# Suffix of a key, factor from the unit that people write by mistake, that unit, the right one. Longest suffix first.
UNIT_MISTAKES = (
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
_SHOWN = 60
MOST_PARTS = 32  # of a key: the parser needs time and memory by the square of their number
_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.){0,99}+"|'[^'\n]{0,99}+')"""
_MANY_PARTS = re.compile(rf"(?<![\w-])(?:{_PART}[ \t]*\.[ \t]*){{{MOST_PARTS}}}")
# Characters that are parsed to find the line of a key; where that is not enough, a message has none.
_SEARCHED = 1_000_000


class ConfigProblem(NamedTuple):
    """One thing wrong with a configuration; the user may have meant to change one of the ``related`` keys."""

    key: Key
    what: str
    related: tuple[Key, ...] = ()


def parse_toml(text: str, name: str) -> dict[str, Any]:
    """The content of the TOML file of that name; raises ConfigError, with the line, where it is not TOML."""
    tree: dict[str, Any] = _copied(_parsed(text, name))
    return tree


def _copied(node: Any) -> Any:
    """A tree of tables and arrays of its own."""
    if isinstance(node, dict):
        return {key: _copied(value) for key, value in node.items()}
    return [_copied(value) for value in node] if isinstance(node, list) else node


@lru_cache(maxsize=32)  # every configuration begins with the same shipped files, whose parsing is most of its loading
def _parsed(text: str, name: str) -> dict[str, Any]:
    if deep := _MANY_PARTS.search(text):
        line = text.count("\n", 0, deep.start()) + 1
        raise ConfigError(f"{name}:{line}: a key has more than {MOST_PARTS} parts; no key of ccatp has half as many")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, deep nesting
        at = re.search(r" \(at line (\d+), column (\d+)\)", str(error))
        line = int(at[1]) if at else max(1, len(text.splitlines()))
        what = re.sub(r" \(at .*\)$", "", str(error))
        raise ConfigError(f"{name}:{line}: is not TOML: {what[:1].lower()}{what[1:]}") from error


def depth_in(tree: Any, key: Key) -> int:
    """Number of parts of a key that a tree contains; all of them if it has a value in place of a section."""
    for depth, part in enumerate(key):
        is_list_of_tables = isinstance(tree, list) and all(isinstance(one, Mapping) for one in tree)
        known = range(len(tree)) if is_list_of_tables else tree
        if not isinstance(known, Mapping | range):
            break
        if part not in known:
            return depth
        tree = tree[part]
    return len(key)


def find_line(text: str, key: Key) -> int | None:
    """Number (from 1) of the line of a TOML text that holds a key, or the nearest section that encloses it.

    ``None`` where there is neither, or where the search would take long.
    """
    depth, lines, searched = depth_in(tomllib.loads(text), key), text.split("\n"), len(text)

    def is_there(count: int) -> bool:
        nonlocal searched
        # A text that ends within a value is not TOML, so the last line of the value belongs to it, too.
        for end in range(count, len(lines)):
            beginning = "\n".join(lines[:end])
            searched += len(beginning)
            if searched > _SEARCHED:
                break
            try:
                return depth_in(tomllib.loads(beginning), key) >= depth
            except ValueError:
                pass
        return True

    line = bisect_left(range(1, len(lines)), True, key=is_there) + 1
    return line if depth and searched <= _SEARCHED else None


def format_key(key: Key) -> str:
    """``("robot", "edge_sensors_m", 0)`` as ``robot.edge_sensors_m[0]``."""
    name = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in key).removeprefix(".")
    return one_line(name, _SHOWN)


def format_value(value: object) -> str:
    """A value for a message, shortened."""
    text = repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False, default=str)
    return one_line(text, _SHOWN)


def nearest(name: str, names: Iterable[str]) -> str | None:
    """The most similar of ``names``, or ``None`` when none is similar."""
    found = difflib.get_close_matches(name, list(names), n=1)
    return found[0] if found else None


def choice_hint(name: str, names: Iterable[str]) -> str:
    """``did you mean X? available: X, Y``."""
    names = sorted(names)
    near = nearest(name, names)
    meant = f"did you mean {near}? " if near else ""
    return f"{meant}available: {', '.join(names) or 'none'}"


def unit_hint(key: Key, value: float, limit: float = math.inf) -> str:
    """``; looks like millimetres: write 0.03`` when the value in the usual wrong unit lies within ``limit``."""
    name = next((part for part in reversed(key) if isinstance(part, str)), "")
    for suffix, factor, wrong, right in UNIT_MISTAKES:
        if name.endswith(suffix):
            fits = abs(value) * factor <= limit
            return f"; looks like {wrong}: {value:g} {wrong} are {value * factor:.6g} {right}".rstrip() if fits else ""
    return ""


def faults_of(errors: Iterable[Mapping[str, Any]], root: type[BaseModel] = Config) -> Iterator[ConfigProblem]:
    """The findings of ``ValidationError.errors()`` as problems, each once, unknown keys first.

    A key that is missing because it is misspelt is one problem, that of the unknown key.
    """
    ordered = sorted(errors, key=lambda error: error["type"] != "extra_forbidden")
    unknown = [tuple(error["loc"]) for error in ordered if error["type"] == "extra_forbidden"]
    meant = {_meant(key, root) for key in unknown} if any(error["type"] == "missing" for error in ordered) else set()
    for error in ordered:
        if error["type"] != "missing" or tuple(error["loc"]) not in meant:
            yield ConfigProblem(tuple(error["loc"]), _what(error, root))


def _what(error: Mapping[str, Any], root: type[BaseModel]) -> str:
    kind, key, value, limits = error["type"], tuple(error["loc"]), error["input"], error.get("ctx", {})
    if kind == "extra_forbidden":
        return _unknown(key, root)
    if kind == "missing":
        return "is missing"
    hint = ""
    if kind == "literal_error" and isinstance(value, str):
        near = nearest(value, re.findall("'([^']*)'", limits["expected"]))
        hint = f"; did you mean {near}?" if near else ""
    elif kind in {"less_than", "less_than_equal"}:
        hint = unit_hint(key, value, limits.get("lt", limits.get("le")))
    # pydantic's words: Input should be a valid number; Tuple should have at least 4 items after validation, not 3
    must = re.sub(r"^\w+ should", "must", error["msg"]).replace(" after validation", "")
    must = "must be a section" if kind in {"model_type", "dict_type"} else must
    must = PATTERNS.get(limits.get("pattern", ""), must)
    return f"= {format_value(value)} {must}{hint}"


def _meant(key: Key, root: type[BaseModel]) -> Key | None:
    """The key that an unknown one means: the nearest one beside it, else one of the same name in another section."""
    siblings = _siblings(key, root)
    everywhere = {path[-1]: path for path in _known_paths(root)}
    for known in siblings, everywhere:
        if near := nearest(str(key[-1]), known):
            return known[near]
    return None


def _siblings(key: Key, root: type[BaseModel]) -> dict[str, Key]:
    """The known keys beside a key, by their last part."""
    *section, _ = key
    beside = [path for path in _known_paths(root) if len(path) == len(key) and all(map(_fits, path, section))]
    return {path[-1]: (*section, path[-1]) for path in beside}


def _unknown(key: Key, root: type[BaseModel]) -> str:
    meant = _meant(key, root)
    if meant is not None:
        return f"is unknown; did you mean {format_key(meant)}?"
    return f"is unknown; known here: {', '.join(_siblings(key, root))}"


def _fits(part: str, given: str | int) -> bool:
    return part in ("*", given)


@cache
def _known_paths(root: type[BaseModel]) -> tuple[tuple[str, ...], ...]:
    return tuple(_paths(root))


def _paths(model: type[BaseModel], prefix: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """All keys of a model and of the models in it; ``*`` stands for any name or number."""
    for name, field in model.model_fields.items():
        path = (*prefix, name)
        yield path
        for kind in (field.annotation, *get_args(field.annotation)):
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                yield from _paths(kind, path if kind is field.annotation else (*path, "*"))
