"""The fault table as a page, with what the tests of this machine measured: ``make faults``."""

import sys
from collections.abc import Iterable
from pathlib import Path

from tests.faults.table import PATH, RECORD, Record, Row, Table, load_record, load_table

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
}
HEAD = """# The fault table

What can break, how it shows, what then happens and by when. `tests/faults/table.toml` is the table; each row is shown
by the tests that are marked for it, and a run of all tests fails if one is not. *Measured* is the worst case of those
tests{where}. `make test`, `make test-slow` and then `make faults` write this page. What a row says of the robot
itself, `ccatp conformance HOST:PORT` asks of any robot.
"""
COLUMNS = (
    "| | fault | shows by | reaction | severity | bound | measured | shown by |\n|---|---|---|---|---|---|---|---|"
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
    by = by if row.open is None else f"open: {row.open}"
    cells = [row_id, row.fault, row.detection, row.reaction, row.severity, bound, measured, by]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _measured(row_id: str, row: Row, shown: Record) -> str:
    """The worst of all tests in each unit."""
    told = []
    for unit in row.units:
        key = f"{row_id}:{unit}"
        values = [entry["values"][key] for entry in shown.values() if key in entry["values"]]
        if values:
            worst = min(values) if unit in row.at_least else max(values)
            told.append(f"{worst:.3g} {unit.replace('_', ' ')}")
    return ", ".join(told) or ("kept" if shown else "")


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
