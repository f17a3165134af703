"""The fault table as data, one row per fault, the record of what its tests showed and measured, and its page."""

import functools
import json
import os
import sys
import tomllib
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ccatp.commissioning.conformance.runner import check_ids
from ccatp.conditions import find_condition
from ccatp.core import Severity as Level
from ccatp.studies.machine import machine

PATH = Path(__file__).with_name("table.toml")
# Rows of each kind in the list that the project works from; a row may be added, none may be lost.
ROWS = {"S": 34, "L": 18, "P": 26, "E": 12, "O": 11, "F": 11, "D": 44, "B": 41}

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
    alarms: tuple[str, ...] = Field(default=(), strict=False)
    at_most: dict[str, float] = {}
    at_least: dict[str, float] = {}
    without_realtime: dict[str, float] = {}
    slow: bool = False
    hardware: Text | None = None
    conformance: tuple[str, ...] = Field(default=(), strict=False)

    @model_validator(mode="after")
    def _fits(self) -> "Row":
        if (self.hardware is None) != (not self.conformance):
            raise ValueError("hardware and conformance belong together")
        if unknown := set(self.conformance) - set(check_ids()):
            raise ValueError(f"ccatp conformance has no check {sorted(unknown)}")
        if unnamed := [name for name in self.alarms if find_condition(name) is None]:
            raise ValueError(f"there is no condition {unnamed}")
        if self.alarms and self.severity not in (found := severities(self.alarms)):
            raise ValueError(f"severity is {self.severity}, its alarms have {sorted(found)}")
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


def severities(alarms: Iterable[str]) -> set[str]:
    """Severities of conditions when they are found, and those to which they rise."""
    rows = [row for name in alarms if (row := find_condition(name)) is not None]
    found = {row.alarm_severity for row in rows} | {row.raised_severity for row in rows}
    return {one.name.lower() for one in found if one is not Level.NONE}


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


# -- the page, with what the tests of this machine measured: ``make faults`` -------------------------------------------

ROOT = PATH.parents[2]
PAGE = ROOT / "docs" / "fault_table.md"

KINDS = {
    "S": "Sensors and estimate",
    "L": "Link to the robot",
    "P": "Processes, host, storage",
    "E": "Laser system",
    "O": "Operator and observatory",
    "F": "Fans, power, body",
    "D": "Devices of the robot's computer",
    "B": "Devices of a robot among beacons",
}
HEAD = """# The fault table

This table lists possible faults, how each is detected, the reaction, and the bound of the reaction. Its source is
`tests/faults/table.toml`. Each row has tests that are marked for it; a run of all tests fails if a row has none.
*Measured* is the worst case of those tests{where}. `make test`, `make test-slow` and then `make faults` write this
page. `ccatp conformance HOST:PORT` checks on any robot the rows about the robot itself.
"""
COLUMNS = (
    "| | fault | shows by | reaction | severity: [alarms](alarms.md) | bound | measured | shown by |\n"
    "|---|---|---|---|---|---|---|---|"
)


def page(table: Table, kept: Record, before: str = "") -> str:
    """The page as Markdown.

    Args:
        table: the rows.
        kept: the record of the tests that passed.
        before: the page as it was; a row of which no test is in the record keeps what was measured for it.
    """
    earlier = {cells[0]: cells[6:8] for line in before.splitlines() if len(cells := line.strip("| ").split(" | ")) == 8}
    parts = [HEAD.format(where=_where(kept))]
    for kind, title in KINDS.items():
        rows = {row_id: row for row_id, row in table.items() if row_id.startswith(kind)}
        lines = [_line(row_id, row, kept, earlier.get(row_id, ["", ""])) for row_id, row in rows.items()]
        parts.append("\n".join([f"## {title}\n", COLUMNS, *lines]) + "\n")
    return "\n".join(parts)


def _where(kept: Record) -> str:
    machines = sorted({entry["machine"] for entry in kept.values()})
    dates = sorted({entry["date"] for entry in kept.values()})
    if not machines:
        return ", none of which has run here"
    when = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
    return f" on {' and '.join(machines)}, {when}"


def _line(row_id: str, row: Row, kept: Record, earlier: list[str]) -> str:
    shown = {name: entry for name, entry in kept.items() if row_id in entry["rows"]}
    bound = row.bound if row.hardware is None else f"{row.bound}. Robot: {row.hardware} ({_listed(row.conformance)})"
    measured, by = (_measured(row_id, row, shown), _files(shown)) if shown else earlier
    severity = f"{row.severity}: {_listed(row.alarms)}" if row.alarms else row.severity
    cells = [row_id, row.fault, row.detection, row.reaction, severity, bound, measured, by]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _measured(row_id: str, row: Row, shown: Record) -> str:
    """The worst of all tests in each unit."""
    reported = []
    for unit in row.units:
        key = f"{row_id}:{unit}"
        values = [entry["values"][key] for entry in shown.values() if key in entry["values"]]
        if values:
            worst = min(values) if unit in row.at_least else max(values)
            reported.append(f"{worst:.3g} {unit.replace('_', ' ')}")
    return ", ".join(reported) or ("kept" if shown else "")


def _files(shown: Record) -> str:
    """The files of the tests, with how many tests there are in each."""
    files = sorted({name.partition("::")[0] for name in shown})
    return ", ".join(f"{Path(file).stem} ({sum(name.startswith(file + '::') for name in shown)})" for file in files)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def main() -> int:
    """Write the page; what is missing in it goes to standard error."""
    table, kept = load_table(), load_record(ROOT / RECORD)
    PAGE.write_text(page(table, kept, PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    shown = {row_id for entry in kept.values() for row_id in entry["rows"]}
    print(f"{PAGE.relative_to(ROOT)}: {len(table)} rows")
    if missing := [row_id for row_id in table if row_id not in shown]:
        print(f"no test of these has passed on this machine: {', '.join(missing)}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
