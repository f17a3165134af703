"""Holds the fault table and the tests against each other, as a plugin of pytest.

A test names its rows with ``@pytest.mark.fault("S1")`` and notes with the fixture ``measured`` what it measured. Rows
of which the robot keeps a part by itself need a test of that part, too: ``@pytest.mark.fault("L1", part="robot")``. At
the end of a full run every row has to be shown by a test that passed, and every mark has to name a row of the table.
With a selection of tests (paths, ``-k``, ``--lf`` and the like) only the marks are checked. What passed and what was
measured goes to ``.faults.json``, from which ``make faults`` makes the page.

With pytest-xdist the workers know the marks and the controller hears the reports: marks travel in the properties of
the reports and, for tests that a run deselects, in the workers' last message.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.faults.table import PATH, RECORD, Row, Seen, Table, is_realtime_permitted, keep_record, load_table

ROWS, MEASURED = "fault_rows", "fault"
COLLECTED = "fault_marks"
KINDS = {"not slow": "default", "slow": "slow"}
# Options with which a run is not a full one.
SELECTIONS = ("keyword", "lf", "deselect", "ignore", "ignore_glob", "collectonly", "stepwise")

Measured = Callable[..., None]


def judge(table: Table, tests: dict[str, Seen], kind: str | None) -> list[str]:
    """What is wrong between table and tests.

    Args:
        table: the rows.
        tests: every test that is marked, by its name, whether it ran or not.
        kind: "default" or "slow" for a full run of that kind, ``None`` for a selection of tests.
    """
    problems = [
        f"{name} is marked for {row}, which is no row of the table"
        for name, test in tests.items()
        for row in test.rows
        if row not in table
    ]
    problems += [f"{name} is marked, but for no row" for name, test in tests.items() if not test.rows]
    for row_id, row in table.items() if kind is not None else ():
        if problem := _missing(row_id, row, tests, kind or ""):
            problems.append(f"{row_id} ({row.fault}): {problem}")
    return problems


def _missing(row_id: str, row: Row, tests: dict[str, Seen], kind: str) -> str:
    """What is missing for a row, on our side or on the robot's; empty if nothing is."""
    marked = {name: test for name, test in tests.items() if row_id in test.rows}
    problem = _unshown(row.slow, {n: test for n, test in marked.items() if row_id not in test.of_robot}, kind)
    if problem or not row.conformance:
        return problem
    problem = _unshown(False, {n: test for n, test in marked.items() if row_id in test.of_robot}, kind)
    return f"of the robot's part {problem}" if problem else ""


def _unshown(needs_slow: bool, marked: dict[str, Seen], kind: str) -> str:
    """Why a row does not count as shown; empty if it does."""
    of_kind = {name: test for name, test in marked.items() if test.is_slow == needs_slow}
    if not of_kind:
        return f"no {'slow ' if needs_slow else ''}test is marked for it"
    if needs_slow != (kind == "slow"):
        return ""  # shown by the runs of the other kind
    if failed := sorted(name for name, test in marked.items() if test.failed):
        return f"{failed[0]} failed"
    return "" if any(test.passed for test in of_kind.values()) else f"{min(of_kind)} did not pass"


def name_of(nodeid: str) -> str:
    """The test's name without the group that pytest-xdist appends."""
    return nodeid.partition("@")[0] if "[" not in nodeid else nodeid.rpartition("]")[0] + "]"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Called by pytest."""
    group = parser.getgroup("faults", "the fault table")
    group.addoption("--fault-table", type=Path, default=PATH, help="the table; its own tests use others")
    group.addoption("--fault-record", type=Path, default=None, help="where the record of what was shown is kept")


def pytest_configure(config: pytest.Config) -> None:
    """Called by pytest."""
    config.addinivalue_line("markers", "fault(*rows): rows of the fault table that the test shows")
    config.pluginmanager.register(Linking(config), "fault-linking")


class Linking:
    """The plugin of one process: a worker, the controller, or both in one."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        path = config.getoption("--fault-table")
        self.table, self._is_ours = load_table(path), path == PATH
        self._tests: dict[str, Seen] = {}
        self._problems = list[str]()
        self._is_worker = hasattr(config, "workeroutput")

    # -- where tests are collected and run ------------------------------------------------------------------------

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Note the marks of all tests, those included that are deselected next."""
        for item in items:
            marks = list(item.iter_markers("fault"))
            if not marks:
                continue
            rows = tuple(dict.fromkeys(str(row) for mark in marks for row in mark.args))
            of_robot = tuple(str(row) for mark in marks for row in mark.args if mark.kwargs.get("part") == "robot")
            item.user_properties.append((ROWS, [list(rows), list(of_robot)]))
            is_slow = item.get_closest_marker("slow") is not None
            self._tests[name_of(item.nodeid)] = Seen(rows, is_slow, of_robot=of_robot)
        if self._is_worker:
            marked = {n: [list(test.rows), list(test.of_robot), test.is_slow] for n, test in self._tests.items()}
            self._config.workeroutput[COLLECTED] = marked  # type: ignore[attr-defined]

    # -- where reports arrive -------------------------------------------------------------------------------------

    def pytest_testnodedown(self, node: Any) -> None:
        """Take a worker's marks."""
        for name, (rows, of_robot, is_slow) in getattr(node, "workeroutput", {}).get(COLLECTED, {}).items():
            self._tests.setdefault(name, Seen(tuple(rows), is_slow, of_robot=tuple(of_robot))).is_slow = is_slow

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Take what became of a part of a test."""
        properties: dict[str, Any] = dict(report.user_properties)
        if self._is_worker or ROWS not in properties:
            return
        rows, of_robot = map(tuple, properties[ROWS])
        test = self._tests.setdefault(name_of(report.nodeid), Seen(rows, False, of_robot=of_robot))
        test.failed |= report.failed
        if report.when == "call":
            test.passed = report.passed
            test.values = {k.partition(":")[2]: v for k, v in properties.items() if k.startswith(f"{MEASURED}:")}

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        """Judge, keep the record, and fail the run where something is wrong."""
        if self._is_worker or exitstatus not in {pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED}:
            return
        kind = None if session.shouldstop or session.shouldfail else self._kind()
        self._problems = judge(self.table, self._tests, kind)
        path = self._config.getoption("--fault-record")
        if path is not None or self._is_ours:
            keep_record(path or self._config.rootpath / RECORD, self._tests, is_full=kind is not None)
        if self._problems:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def _kind(self) -> str | None:
        option = self._config.option
        is_selected = any(getattr(option, name, None) for name in SELECTIONS)
        if is_selected or self._config.args_source is pytest.Config.ArgsSource.ARGS:
            return None
        return KINDS.get(option.markexpr)

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Say what is missing."""
        if self._problems:
            terminalreporter.write_sep("=", "fault table", red=True)
            for problem in self._problems:
                terminalreporter.write_line(problem)


@pytest.fixture
def measured(request: pytest.FixtureRequest, record_property: Callable[[str, object], None]) -> Measured:
    """Notes the worst case that a test measured for a row, in a unit of the row's limits; beyond the limit it fails.

    ``measured("S1", 120.0)`` is in the row's first unit, ``measured("S1", 12.0, "mm")`` in the one named.
    """
    linking = request.config.pluginmanager.get_plugin("fault-linking")
    assert isinstance(linking, Linking)
    marked = {str(row) for mark in request.node.iter_markers("fault") for row in mark.args}

    worst: dict[str, float] = {}

    def note(row_id: str, value: float, unit: str | None = None) -> None:
        if row_id not in linking.table or row_id not in marked:
            pytest.fail(f"measured({row_id!r}): the test is not marked for that row of the table")
        row = linking.table[row_id]
        unit = unit or next(iter(row.units), "")
        if unit not in row.units:
            pytest.fail(f"measured({row_id!r}): the row has no limit in {unit or 'any unit'}")
        key, value = f"{row_id}:{unit}", float(value)
        pick = min if unit in row.at_least else max
        worst[key] = pick(worst.get(key, value), value)
        record_property(f"{MEASURED}:{key}", worst[key])
        is_realtime = is_realtime_permitted()
        if not row.allows(unit, value, is_realtime=is_realtime):
            how, limit = row.limit(unit, is_realtime=is_realtime)
            pytest.fail(f"{row_id}: measured {value:g} {unit}, {how} {limit:g} allowed")

    return note
