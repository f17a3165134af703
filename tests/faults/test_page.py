"""The page shows every row, with the worst case of all tests that measured it."""

from pathlib import Path

from tests.faults import record
from tests.faults.linking import Seen
from tests.faults.page import page
from tests.faults.table import load_table


def line_of(row_id: str, text: str) -> list[str]:
    (line,) = (line for line in text.splitlines() if line.startswith(f"| {row_id} |"))
    return [cell.strip() for cell in line.strip("|").split(" | ")]


def test_bound_and_worst_case(tmp_path: Path) -> None:
    table = {row_id: row.model_copy(update={"open": None}) for row_id, row in load_table().items()}
    kept = tmp_path / "record.json"
    first = Seen(("S1", "F6"), is_slow=False, passed=True, values={"S1:ms": 120.0, "F6:percent": 31.0})
    record.keep(kept, {"tests/a/test_a.py::test_one": first}, is_full=True)
    second = Seen(("S1", "F6"), is_slow=True, passed=True, values={"S1:ms": 250.0, "S1:mm": 9.25, "F6:percent": 22.0})
    record.keep(kept, {"tests/b/test_b.py::test_two": second}, is_full=False)
    text = page(table, record.load(kept))
    cells = line_of("S1", text)
    assert cells[6] == "250 ms, 9.25 mm"
    assert cells[7] == "test_a (1), test_b (1)"
    assert line_of("F6", text)[6] == "22 percent"  # of a lower limit the worst is the least
    assert line_of("S2", text)[6:] == ["", ""]
    assert "`lost-controller-fin`" in line_of("L1", text)[5]
    assert record.machine_line() in text
    assert [line_of(row_id, text)[1] for row_id in table] == [row.fault for row in table.values()]


def test_the_record_forgets_what_fails_and_what_is_gone(tmp_path: Path) -> None:
    kept = tmp_path / "record.json"
    seen = {name: Seen(("S1",), is_slow=False, passed=True) for name in ("one", "two", "three")}
    record.keep(kept, seen, is_full=True)
    record.keep(kept, {"one": Seen(("S1",), is_slow=False, passed=True, failed=True)}, is_full=False)
    assert sorted(record.load(kept)) == ["three", "two"]
    record.keep(kept, {"two": Seen(("S1",), is_slow=True)}, is_full=True)  # there, but did not run
    assert sorted(record.load(kept)) == ["two"]


def test_without_a_record_the_rows_are_there(tmp_path: Path) -> None:
    text = page(load_table(), record.load(tmp_path / "none.json"))
    assert "none of which has run here" in text
    assert "open: " in line_of("S1", text)[7] or not line_of("S1", text)[7]
