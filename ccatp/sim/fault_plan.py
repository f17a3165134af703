"""A fault plan out of TOML: strict, and each mistake is one line with file, line, key and a hint."""

import json
import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from pydantic import BaseModel, ValidationError

from ccatp.config.messages import choice_hint, faults_of, format_key, format_value, nearest
from ccatp.errors import ConfigError
from ccatp.sim.fault_models import LINK_TYPES, LOCKSTEP_TYPES, TYPES, InjectedFault, LinkFault, Saturated, Wrong

_SECTIONS = ("fault", "link")
_Model = TypeVar("_Model", bound=BaseModel)


class FaultPlan(NamedTuple):
    """What shall go wrong in a run.

    Attributes:
        faults: of the simulated robot, in the order of the file, which is that of their application.
    """

    faults: tuple[InjectedFault, ...] = ()
    link: tuple[LinkFault, ...] = ()


def parse_plan(text: str, name: str) -> FaultPlan:
    """The plan in a text.

    Raises:
        ConfigError: one line per problem with file, line, key, what is wrong and what to do.
    """
    try:
        tree = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, deep nesting
        raise ConfigError(f"{name}: is not TOML: {error}") from error
    problems = [
        f"{_place(name, text, section, 0, '')}: {section} is unknown; {choice_hint(section, _SECTIONS)}"
        for section in tree
        if section not in _SECTIONS
    ]
    faults = [_Entry(name, text, "fault", k, row) for k, row in enumerate(_rows(tree, "fault", problems, name))]
    link = [_Entry(name, text, "link", k, row) for k, row in enumerate(_rows(tree, "link", problems, name))]
    found = [one.fault() for one in faults]
    found_link = [one.link() for one in link]
    for one in (*faults, *link):
        problems += one.problems
    if problems:
        raise ConfigError(*problems, shows_all=True)
    return FaultPlan(tuple(f for f in found if f is not None), tuple(f for f in found_link if f is not None))


def check_pacing(plan: FaultPlan, name: str, *, lockstep: bool) -> None:
    """Refuse faults of the link that make no sense in lockstep.

    Raises:
        ConfigError: there is one.
    """
    if not lockstep:
        return
    problems = [
        f"{name}: link[{k}].type = {format_value(one.type)} makes no sense in lockstep, where simulated time waits for "
        f"every line; add --realtime, or take one of {', '.join(LOCKSTEP_TYPES)}"
        for k, one in enumerate(plan.link)
        if one.type not in LOCKSTEP_TYPES
    ]
    if problems:
        raise ConfigError(*problems, shows_all=True)


class _Entry:
    """One table of the file on its way to a model."""

    def __init__(self, name: str, text: str, section: str, index: int, row: Mapping[str, Any]) -> None:
        self._name, self._text, self._section, self._index, self._row = name, text, section, index, row
        self.problems: list[str] = []

    def fault(self) -> InjectedFault | None:
        types = self._choice("signal", TYPES)
        model = self._choice("type", types) if types is not None else None
        fault = self._validated(model) if model is not None else None
        if isinstance(fault, Wrong) and (fault.offset, fault.factor, fault.sign) == (None, None, None):
            self._complain("type", '= "wrong" needs an offset, a factor or a sign')
        if isinstance(fault, Saturated) and not self._is_range(fault):
            self._complain("type", '= "saturated" needs low or high, and low below high')
        return fault

    def link(self) -> LinkFault | None:
        model = self._choice("type", LINK_TYPES)
        fault = self._validated(model) if model is not None else None
        if fault is not None and [fault.at_s, fault.after_lines, fault.after_bytes].count(None) != 2:
            self._complain("type", f"= {format_value(fault.type)} needs one of at_s, after_lines, after_bytes")
        return fault

    @staticmethod
    def _is_range(fault: Saturated) -> bool:
        low = -math.inf if fault.low is None else fault.low
        high = math.inf if fault.high is None else fault.high
        return low < high and (low, high) != (-math.inf, math.inf)

    def _choice(self, key: str, choices: Mapping[str, Any]) -> Any:
        value = self._row.get(key)
        if value is None:
            self._complain(key, f"is missing; {choice_hint('', choices)}")
        elif not isinstance(value, str):
            self._complain(key, f"= {format_value(value)} must be text in quotes")
        elif value not in choices:
            of = f" of {self._row['signal']}" if key == "type" and self._section == "fault" else ""
            self._complain(key, f"= {format_value(value)} is no {key}{of}; {choice_hint(value, choices)}")
        else:
            return choices[value]
        return None

    def _validated(self, model: type[_Model]) -> _Model | None:
        try:
            # by way of JSON, where strict means what it should for TOML: an array is a tuple, "1" is no number
            return model.model_validate_json(json.dumps(self._row, default=str), strict=True)
        except ValidationError as error:
            for one in sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden"):
                key = format_key(tuple(one["loc"]))
                if one["type"] == "extra_forbidden":
                    self._complain(key, _unknown(key, model.model_fields))
                else:
                    self._complain(key, faults_of([one])[0].what)
        return None

    def _complain(self, key: str, what: str) -> None:
        place = _place(self._name, self._text, self._section, self._index, key.split("[", maxsplit=1)[0])
        self.problems.append(f"{place}: {self._section}[{self._index}].{key} {what}")


def _rows(tree: Mapping[str, Any], section: str, problems: list[str], name: str) -> Sequence[Mapping[str, Any]]:
    rows = tree.get(section, [])
    if isinstance(rows, list) and all(isinstance(row, dict) for row in rows):
        return rows
    problems.append(f"{name}: {section} must be a list of tables; begin each with [[{section}]]")
    return []


def _unknown(key: str, fields: Iterable[str]) -> str:
    fields = list(fields)
    near = nearest(key, fields)
    return f"is unknown; did you mean {near}?" if near else f"is unknown; known here: {', '.join(fields)}"


def _place(name: str, text: str, section: str, index: int, key: str) -> str:
    """``file:line`` of a key in the table of that number, or of the table; the bare name where neither is found."""
    header = re.compile(rf"\s*\[\[?\s*{re.escape(section)}\s*\]")
    seen, found = -1, 0
    for number, line in enumerate(text.splitlines(), start=1):
        if header.match(line):
            seen += 1
            if seen > index:
                break
            found = number
        elif seen == index and key and re.match(rf"\s*{re.escape(key)}\s*=", line):
            return f"{name}:{number}"
    return f"{name}:{found}" if seen >= index and found else name
