"""The wall clock is for labels: what decides goes by the robot's time and the monotonic clock."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import ccatp

PACKAGE = Path(ccatp.__file__).parent
CALLS = {("time", "time"), ("time", "time_ns"), ("time", "localtime"), ("time", "gmtime"), ("datetime", "now"),
         ("datetime", "today"), ("datetime", "utcnow"), ("date", "today")}  # fmt: skip
# Labels: rows of the store, names of run directories and the observatory's feed say when they were made. The check
# before a mission shows the clock itself.
LABELS = {
    "records/store.py",
    "daemon/supervisor.py",
    "daemon/run_dir.py",
    "cli/prepare.py",
    "daemon/ocs_agent.py",
    "commissioning/probes.py",
}


def wall_clocks(tree: ast.AST) -> Iterator[int]:
    """Lines that read the wall clock."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name | ast.Attribute):
            owner = node.value.id if isinstance(node.value, ast.Name) else node.value.attr
            if (owner, node.attr) in CALLS:
                yield node.lineno
        elif isinstance(node, ast.ImportFrom) and any((node.module, alias.name) in CALLS for alias in node.names):
            yield node.lineno


def test_the_search_finds_them() -> None:
    text = "import time\ntime.time()\nfrom time import time_ns\ndatetime.datetime.now()\ntime.monotonic()\n"
    assert sorted(wall_clocks(ast.parse(text))) == [2, 3, 4]


@pytest.mark.fault("S13")
def test_nothing_that_decides_reads_the_wall_clock() -> None:
    found = {
        str(path.relative_to(PACKAGE))
        for path in sorted(PACKAGE.rglob("*.py"))
        if list(wall_clocks(ast.parse(path.read_text(encoding="utf-8"))))
    }
    assert found == LABELS
