"""The record of what tests of the fault table showed and measured: on this machine, kept from run to run."""

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from ccatp.studies.bench import CPU_INFO, cpu_model, machine
from tests.faults.realtime import is_realtime_permitted

NAME = ".faults.json"

Record = dict[str, dict[str, Any]]


class Shown(Protocol):
    """What the record wants to know of a test."""

    rows: tuple[str, ...]
    is_slow: bool
    values: dict[str, float]
    passed: bool
    failed: bool


def load(path: Path) -> Record:
    """Tests by name; empty where there is no record yet."""
    if not path.exists():
        return {}
    loaded: Record = json.loads(path.read_text(encoding="utf-8"))
    return loaded


def keep(path: Path, tests: Mapping[str, Shown], *, is_full: bool) -> None:
    """Merge a run into the record.

    A test that passed replaces its entry, one that failed loses it, one that did not run keeps it. A full run has seen
    every test there is, so that entries of others are dropped.
    """
    entries = {name: entry for name, entry in load(path).items() if not is_full or name in tests}
    now = datetime.now(UTC).date().isoformat()
    for name, test in tests.items():
        if test.failed:
            entries.pop(name, None)
        elif test.passed:
            entries[name] = {
                "rows": list(test.rows),
                "slow": test.is_slow,
                "values": test.values,
                "date": now,
                "machine": machine_line(),
                "realtime": is_realtime_permitted(),
            }
    path.write_text(json.dumps(entries, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def machine_line() -> str:
    """Processor, cores, Python, and whether real-time scheduling was permitted."""
    facts = machine()
    scheduling = "with" if is_realtime_permitted() else "without"
    return f"{cpu_model(CPU_INFO)}, {facts['cores']} cores, Python {facts['python']}, {scheduling} real-time scheduling"
