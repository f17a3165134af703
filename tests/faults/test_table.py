"""Fault table and tests are held against each other, and the page shows every row with its worst case."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from tests.faults.linking import judge
from tests.faults.table import PATH, ROWS, Row, Seen, keep_record, load_record, load_table, machine_line, page

ROOT = PATH.parents[2]
TABLE = """
[A1]
fault = "what breaks"
detection = "how it shows"
reaction = "what then"
bound = "by when"
severity = "hold"
at_most = { ms = 100, mm = 30 }
at_least = { percent = 20 }

[A2]
fault = "another"
detection = "how it shows"
reaction = "what then"
bound = "by when"
severity = "hold"
"""
SHOWN = """
import pytest

@pytest.mark.fault("A1")
def test_one(measured):
    measured("A1", 80)
    measured("A1", 90.5)
    measured("A1", 20)
    measured("A1", 20, "percent")

@pytest.mark.fault("A2")
@pytest.mark.parametrize("case", ["a@b", "c"])
@pytest.mark.xdist_group("together")
def test_two(case):
    pass
"""


class Project:
    """A project of one test file and a table; ``run`` gives exit status and output, ``record`` is what it keeps."""

    def __init__(self, pytester: pytest.Pytester, tests: str = SHOWN, table: str = TABLE) -> None:
        self._pytester, self.record = pytester, pytester.path / "record.json"
        pytester.makepyfile(test_it=tests)
        pytester.makeini(
            "[pytest]\ntestpaths = .\naddopts = -m 'not slow'\nmarkers = slow: takes minutes\n"
            "asyncio_default_fixture_loop_scope = function"
        )
        (pytester.path / "table.toml").write_text(table)

    def run(self, *args: str, in_process: bool = True) -> tuple[int, str]:
        options = ["-p", "tests.faults.linking", "-p", "no:cacheprovider", "--fault-table=table.toml"]
        run = self._pytester.runpytest_inprocess if in_process else self._pytester.runpytest_subprocess
        result = run(*options, f"--fault-record={self.record}", *args)
        return int(result.ret), result.stdout.str()


def test_the_table_holds_every_row() -> None:
    table = load_table()
    assert list(table) == [f"{kind}{number}" for kind, count in ROWS.items() for number in range(1, count + 1)]
    assert len({row.fault for row in table.values()}) == len(table)
    assert Counter(row.severity for row in table.values())["fault"] >= 5


def test_all_shown(pytester: pytest.Pytester) -> None:
    it = Project(pytester)
    status, said = it.run()
    assert (status, "fault table" in said) == (0, False), said
    kept = json.loads(it.record.read_text())["test_it.py::test_one"]
    assert kept["values"] == {"A1:ms": 90.5, "A1:percent": 20.0}
    assert (kept["rows"], kept["slow"]) == (["A1"], False)


def test_all_shown_by_workers(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    slow = TABLE + '\n[A3]\nfault = "slow one"\ndetection = "how"\nreaction = "what"\nbound = "when"\n'
    slow += 'severity = "hold"\nslow = true\n'
    it = Project(pytester, SHOWN + '\n@pytest.mark.slow\n@pytest.mark.fault("A3", "A7")\ndef test_slow(): pass\n', slow)
    status, said = it.run("-n1", "--dist=loadgroup", in_process=False)
    # The workers have told of the test that they did not run: its row is shown elsewhere, its mistake found.
    assert status == 1
    assert "test_it.py::test_slow is marked for A7, which is no row of the table" in said
    assert "slow one" not in said
    assert sorted(json.loads(it.record.read_text())) == [
        "test_it.py::test_one", "test_it.py::test_two[a@b]", "test_it.py::test_two[c]",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (('@pytest.mark.fault("A2")\n', ""), "A2 (another): no test is marked for it"),
        (('fault("A2")', 'fault("A2", "B9")'), "test_it.py::test_two[c] is marked for B9, which is no row"),
        (('fault("A2")', "fault()"), "test_it.py::test_two[c] is marked, but for no row"),
        (("    pass", "    assert case == 'c'"), "A2 (another): test_it.py::test_two[a@b] failed"),
        (("    pass", "    pytest.skip('no')"), "A2 (another): test_it.py::test_two[a@b] did not pass"),
        (("    pass", "    pytest.xfail('no')"), "A2 (another): test_it.py::test_two[a@b] did not pass"),
        (('fault("A2")', 'fault("A2")\n@pytest.mark.slow'), "A2 (another): no test is marked for it"),
        (("90.5", "100.1"), "A1: measured 100.1 ms, at most 100 allowed"),
        (("90.5", 'float("nan")'), "A1: measured nan ms, at most 100 allowed"),
        (('20, "percent"', '19, "percent"'), "A1: measured 19 percent, at least 20 allowed"),
        (('20, "percent"', '20, "km"'), "measured('A1'): the row has no limit in km"),
        (('measured("A1", 20)', 'measured("A2", 20)'), "measured('A2'): the test is not marked for that row"),
    ],
)  # fmt: skip
def test_what_differs_fails(pytester: pytest.Pytester, change: tuple[str, str], problem: str) -> None:
    assert change[0] in SHOWN
    status, said = Project(pytester, SHOWN.replace(*change)).run()
    assert status == 1
    assert problem in said
    # A broken measurement fails its test, and with it its row.
    assert ("A1 (what breaks): test_it.py::test_one failed" in said) == problem.startswith(("A1:", "measured"))


def test_a_teardown_that_fails_shows_nothing(pytester: pytest.Pytester) -> None:
    broken = "\n@pytest.fixture\ndef breaks():\n    yield\n    raise OSError\n"
    it = Project(
        pytester, SHOWN.replace("import pytest\n", "import pytest\n" + broken).replace("(case)", "(case, breaks)")
    )
    status, said = it.run()
    assert status == 1
    assert "A2 (another): test_it.py::test_two[a@b] failed" in said
    assert list(json.loads(it.record.read_text())) == ["test_it.py::test_one"]


def test_a_selection_stands_aside_but_for_wrong_marks(pytester: pytest.Pytester) -> None:
    it = Project(pytester)
    for args in (("-k", "one"), ("test_it.py::test_one",), ("--deselect", "test_it.py::test_two")):
        status, said = it.run(*args)
        assert (status, "fault table" in said) == (0, False), said
    it = Project(pytester, SHOWN.replace('fault("A2")', 'fault("B9")'))
    status, said = it.run("-k", "one")
    assert status == 1
    assert "B9, which is no row" in said


def test_slow_rows_are_shown_by_slow_runs(pytester: pytest.Pytester) -> None:
    slow_row = TABLE.replace("[A2]", "[A2]\nslow = true")
    slow_test = SHOWN.replace('fault("A2")', 'fault("A2")\n@pytest.mark.slow')
    it = Project(pytester, slow_test, slow_row)
    assert it.run()[0] == 0  # the test is there
    assert it.run("-m", "slow")[0] == 0
    # Both runs are in the record.
    assert len(json.loads(it.record.read_text())) == 3
    status, said = Project(pytester, SHOWN, slow_row).run()
    assert status == 1
    assert "A2 (another): no slow test is marked for it" in said
    it = Project(pytester, slow_test.replace("    pass", "    raise OSError"), slow_row)
    assert it.run()[0] == 0
    status, said = it.run("-m", "slow")
    assert status == 1
    assert "A2 (another): test_it.py::test_two[a@b] failed" in said


def test_a_run_that_was_stopped_is_not_judged(pytester: pytest.Pytester) -> None:
    status, said = Project(pytester, SHOWN.replace("measured(", "assert 0, (", 1)).run("-x")
    assert status == 1
    assert "no test is marked" not in said
    assert "A2" not in said


def test_without_real_time_other_limits_hold() -> None:
    row = load_table()["P1"]
    assert row.allows("ms", 100.0, is_realtime=True)
    assert not row.allows("ms", 100.1, is_realtime=True)
    assert row.allows("ms", 250.0, is_realtime=False)
    assert not row.allows("ms", 250.1, is_realtime=False)
    assert row.limit("s", is_realtime=False) == ("at most", 3.0)


def seen(row: str, state: str = "passed", **more: Any) -> Seen:
    return Seen((row,), more.pop("is_slow", False), passed=state == "passed", failed=state == "failed", **more)


UNSHOWN = seen("L1", "", of_robot=("L1",))


@pytest.mark.parametrize(
    ("row", "kind", "tests", "problem"),
    [
        # One test of several is enough, and a failing one spoils it.
        ("S1", "default", {"one": seen("S1"), "two": seen("S1", "", is_slow=True)}, ""),
        ("S1", "default", {"one": seen("S1"), "two": seen("S1", "failed", is_slow=True)}, "two failed"),
        # What the robot keeps by itself needs a test of its own.
        ("L1", "default", {"ours": seen("L1"), "robots": seen("L1", of_robot=("L1",))}, ""),
        ("L1", "default", {"ours": seen("L1")}, "of the robot's part no test is marked for it"),
        ("L1", "default", {"robots": seen("L1", of_robot=("L1",))}, "no test is marked for it"),
        ("L1", "default", {"o": seen("L1"), "r": UNSHOWN}, "of the robot's part r did not pass"),
        ("L1", "slow", {"o": seen("L1"), "r": UNSHOWN}, ""),
    ],
)
def test_what_shows_a_row(row: str, kind: str, tests: dict[str, Seen], problem: str) -> None:
    table = {row: load_table()[row]}
    assert judge(table, tests, kind) == ([f"{row} ({table[row].fault}): {problem}"] if problem else [])


# -- the page ----------------------------------------------------------------------------------------------------------


def line_of(row_id: str, text: str) -> list[str]:
    (line,) = (line for line in text.splitlines() if line.startswith(f"| {row_id} |"))
    return [cell.strip() for cell in line.strip("|").split(" | ")]


def test_bound_and_worst_case(tmp_path: Path) -> None:
    table = load_table()
    kept = tmp_path / "record.json"
    first = Seen(("S1", "F6"), is_slow=False, passed=True, values={"S1:ms": 120.0, "F6:percent": 31.0})
    keep_record(kept, {"tests/a/test_a.py::test_one": first}, is_full=True)
    second = Seen(("S1", "F6"), is_slow=True, passed=True, values={"S1:ms": 250.0, "S1:mm": 9.25, "F6:percent": 22.0})
    keep_record(kept, {"tests/b/test_b.py::test_two": second}, is_full=False)
    text = page(table, load_record(kept))
    cells = line_of("S1", text)
    assert cells[6] == "250 ms, 9.25 mm"
    assert cells[7] == "test_a (1), test_b (1)"
    assert line_of("F6", text)[6] == "22 percent"  # of a lower limit the worst is the least
    assert line_of("S2", text)[6:] == ["", ""]
    earlier = text.replace(line_of("S2", text)[5] + " |  |  |", line_of("S2", text)[5] + " | 60 ms | test_c (5) |")
    assert line_of("S2", page(table, load_record(kept), earlier))[6:] == ["60 ms", "test_c (5)"]
    assert line_of("S1", page(table, {}, text))[6:] == cells[6:]
    assert "`lost-controller-fin`" in line_of("L1", text)[5]
    assert machine_line() in text
    assert [line_of(row_id, text)[1] for row_id in table] == [row.fault for row in table.values()]


def test_the_record_forgets_what_fails_and_what_is_gone(tmp_path: Path) -> None:
    kept = tmp_path / "record.json"
    seen = {name: Seen(("S1",), is_slow=False, passed=True) for name in ("one", "two", "three")}
    keep_record(kept, seen, is_full=True)
    keep_record(kept, {"one": Seen(("S1",), is_slow=False, passed=True, failed=True)}, is_full=False)
    assert sorted(load_record(kept)) == ["three", "two"]
    keep_record(kept, {"two": Seen(("S1",), is_slow=True)}, is_full=True)  # there, but did not run
    assert sorted(load_record(kept)) == ["two"]


def test_without_a_record_the_rows_are_there(tmp_path: Path) -> None:
    text = page(load_table(), load_record(tmp_path / "none.json"))
    assert "none of which has run here" in text
    assert not line_of("S1", text)[7]


def test_the_severity_of_a_row_is_one_that_its_alarms_have() -> None:
    row = {"fault": "abc", "detection": "abc", "reaction": "abc", "bound": "abc"}
    for severity in ("hold", "fault"):  # found as a hold, which becomes a fault
        assert Row.model_validate({**row, "severity": severity, "alarms": ["wheel_blocked"]}).severity == severity
    with pytest.raises(ValueError, match=r"severity is return, its alarms have \['fault', 'hold'\]"):
        Row.model_validate({**row, "severity": "return", "alarms": ["wheel_blocked"]})
    with pytest.raises(ValueError, match=r"there is no condition \['wheel_bloked'\]"):
        Row.model_validate({**row, "severity": "hold", "alarms": ["wheel_bloked"]})
