"""The fault table as data, one row per fault, and the record of what its tests showed and measured on this machine."""

import functools
import json
import os
import tomllib
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ccatp.commissioning.conformance.runner import check_ids
from ccatp.studies.bench import machine

PATH = Path(__file__).with_name("table.toml")
# Rows of each kind in the list that the project works from; a row may be added, none may be lost.
ROWS = {"S": 29, "L": 14, "P": 24, "E": 10, "O": 11, "F": 10, "D": 44}

Text = Annotated[str, Field(min_length=3)]
Severity = Literal["inform", "slow", "pause", "hold", "return", "fault", "refuse"]


class Row(BaseModel):
    """One fault: how it shows, what happens then, and what a test may measure. Keys as the head of the table tells."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    fault: Text
    detection: Text
    reaction: Text
    bound: Text
    severity: Severity
    at_most: dict[str, float] = {}
    at_least: dict[str, float] = {}
    without_realtime: dict[str, float] = {}
    slow: bool = False
    hardware: Text | None = None
    conformance: tuple[str, ...] = Field(default=(), strict=False)
    open: Text | None = None

    @model_validator(mode="after")
    def _fits(self) -> "Row":
        if (self.hardware is None) != (not self.conformance):
            raise ValueError("hardware and conformance belong together")
        if unknown := set(self.conformance) - set(check_ids()):
            raise ValueError(f"ccatp conformance has no check {sorted(unknown)}")
        if set(self.at_most) & set(self.at_least):
            raise ValueError("a unit is in at_most and in at_least")
        if unknown := set(self.without_realtime) - set(self.at_most):
            raise ValueError(f"without_realtime has {sorted(unknown)}, at_most has not")
        return self

    @property
    def units(self) -> tuple[str, ...]:
        """What can be measured for the row; the first is meant where none is named."""
        return (*self.at_most, *self.at_least)

    def limit(self, unit: str, *, is_realtime: bool) -> tuple[str, float]:
        """How and by what a measurement is limited."""
        if unit in self.at_least:
            return "at least", self.at_least[unit]
        relaxed = {} if is_realtime else self.without_realtime
        return "at most", relaxed.get(unit, self.at_most[unit])

    def allows(self, unit: str, value: float, *, is_realtime: bool) -> bool:
        """Whether a measurement keeps its limit; what is no number does not."""
        how, limit = self.limit(unit, is_realtime=is_realtime)
        return value >= limit if how == "at least" else value <= limit


Table = Mapping[str, Row]


def load_table(path: Path = PATH) -> Table:
    """The rows by id, in the order of the file."""
    return {row_id: Row.model_validate(row) for row_id, row in tomllib.loads(path.read_text(encoding="utf-8")).items()}


def conformance_rows(table: Table) -> tuple[str, ...]:
    """Rows of which the robot itself keeps a part that ``ccatp conformance`` asks for."""
    return tuple(row_id for row_id, row in table.items() if row.conformance)


@functools.cache
def is_realtime_permitted() -> bool:
    """Try it on a thread of its own, which ends with what it was given."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(os.sched_setscheduler, 0, os.SCHED_FIFO, os.sched_param(1)).exception() is None


# -- the record, kept from run to run ----------------------------------------------------------------------------------

RECORD = ".faults.json"

Record = dict[str, dict[str, Any]]


@dataclass(slots=True)
class Seen:
    """What is known of one test.

    Attributes:
        rows: that it is marked for.
        is_slow: whether ``make test`` leaves it out.
        passed, failed: whether it ran to its end and passed; whether any part of it failed.
        values: what it measured, by row and unit.
        of_robot: those of its rows of which it shows the robot's own part.
    """

    rows: tuple[str, ...]
    is_slow: bool
    passed: bool = False
    failed: bool = False
    values: dict[str, float] = field(default_factory=dict)
    of_robot: tuple[str, ...] = ()


def load_record(path: Path) -> Record:
    """Tests by name; empty where there is no record yet."""
    if not path.exists():
        return {}
    loaded: Record = json.loads(path.read_text(encoding="utf-8"))
    return loaded


def keep_record(path: Path, tests: Mapping[str, Seen], *, is_full: bool) -> None:
    """Merge a run into the record.

    A test that passed replaces its entry, one that failed loses it, one that did not run keeps it. A full run has seen
    every test there is, so that entries of others are dropped.
    """
    entries = {name: entry for name, entry in load_record(path).items() if not is_full or name in tests}
    now = datetime.now(UTC).date().isoformat()
    for name, test in tests.items():
        if test.failed:
            entries.pop(name, None)
        elif test.passed:
            about = {"date": now, "machine": machine_line(), "realtime": is_realtime_permitted()}
            entries[name] = {"rows": list(test.rows), "slow": test.is_slow, "values": test.values, **about}
    path.write_text(json.dumps(entries, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def machine_line() -> str:
    """Processor, cores, Python, and whether real-time scheduling was permitted."""
    facts = machine()
    scheduling = "with" if is_realtime_permitted() else "without"
    return f"{facts['cpu']}, {facts['cores']} cores, Python {facts['python']}, {scheduling} real-time scheduling"
