"""The pages: sections by what a run holds, nothing from outside, text that stays text."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from markupsafe import escape

from ccatp.cli import main
from ccatp.records.state_log import LogLine
from ccatp.report.compare import compare_page, pair_of
from ccatp.report.findings import findings_of, outcome_of
from ccatp.report.html import POLICY, ReportError, clock_text, number_text
from ccatp.report.record import read_record
from ccatp.report.run_page import report_run, run_page
from tests.unit.reporting.markup import Markup
from tests.unit.reporting.recorded import record

ALL = ["map", "points", "surface", "panels", "time", "localization", "events", "configuration"]


@pytest.fixture(scope="module")
def page(recorded: Path) -> str:
    return run_page(findings_of(read_record(recorded)))


def test_the_page_of_a_whole_run(page: str) -> None:
    markup = Markup(page)
    assert markup.outside == []
    assert markup.anchors == ALL
    assert f'content="{POLICY}"' in page
    assert POLICY.startswith("default-src 'none';")
    assert "script-src" not in POLICY
    assert not re.search(r"url\((?!#)", page)
    assert "@import" not in page
    assert "SIMULATION, world hard, seed 1" in page
    assert "Not in this run" not in page
    assert len(page) < 1_000_000


def test_the_same_run_gives_the_same_page(page: str, recorded: Path) -> None:
    assert run_page(findings_of(read_record(recorded))) == page


def test_a_real_robot_is_called_one(tmp_path: Path) -> None:
    found = run_page(findings_of(read_record(record(tmp_path / "real", is_simulation=False, only=4))))
    assert Markup(found).anchors == ALL
    assert "SIMULATION" not in found
    assert "real robot" in found
    assert "The true pose is not known" in found
    assert "aborted, at base" in found
    assert "the observatory wants the robot home" in found
    assert "the planned way to the last measured point" in found


@pytest.mark.parametrize(
    ("gone", "left"),
    [
        (("telemetry.mcap",), ["map", "points", "surface", "panels", "events", "configuration"]),
        (("mission.sqlite",), ["map", "time", "localization", "events", "configuration"]),
        (("log.jsonl", "summary.json"), [name for name in ALL if name != "events"]),
        (("telemetry.mcap", "mission.sqlite", "log.jsonl", "summary.json"), ["configuration"]),
    ],
)
def test_sections_by_what_a_run_holds(gone: tuple[str, ...], left: list[str], without: Callable[..., Path]) -> None:
    found = run_page(findings_of(read_record(without(*gone))))
    assert Markup(found).anchors == left
    for name in gone:
        assert f"<li>{name}: " in found


def test_text_stays_text(recorded: Path) -> None:
    whole = read_record(recorded)
    evil = '<script>alert("1")</script>&'
    line = LogLine("2026-01-01T00:00:00", None, "error", evil, evil)
    spoilt = replace(whole, name=evil, log=(line,), config_text=evil, files={evil: 1})
    spoilt = replace(spoilt, warnings=(evil,), missing=(evil,))
    page = run_page(findings_of(spoilt))
    Markup(page)
    assert evil not in page
    assert page.count(str(escape(evil))) >= 6
    other = compare_page(pair_of(findings_of(spoilt), findings_of(whole)))
    Markup(other)
    assert evil not in other


def test_a_run_given_up_before_its_first_point_says_why(recorded: Path) -> None:
    whole = read_record(recorded)
    names = [f"{row.point.row}-{row.point.col}-{row.point.point}" for row in whole.points or ()]
    rows = tuple(row._replace(status="planned", t_s=None) for row in whole.points or ())
    summary = {**(whole.summary or {}), "points": {"left_out": {"operator": names}}}
    found = run_page(findings_of(replace(whole, points=rows, measured=(), summary=summary)))
    assert "<p>9 not measured: operator.</p>" in found
    assert "<p>No point measured: no surface, no adjuster moves.</p>" in found


def test_outcomes(recorded: Path) -> None:
    whole = read_record(recorded)
    assert outcome_of(whole) == ("complete", "", True)
    (session,) = whole.sessions
    last = session.statuses[-1]

    def ended(**changes: object) -> tuple[str, str, bool]:
        fields = {name: getattr(last, name) for name in last.__struct_fields__}
        status = type(last)(**{**fields, **changes})
        summary = None if changes.get("summary", True) is None else whole.summary
        return outcome_of(replace(whole, sessions=(replace(session, statuses=(status,)),), summary=summary))

    held = ended(outcome="", exit_status=4, state="held", cause="stuck")
    assert held == ("ended with status 4, held", "stuck", False)
    assert ended(outcome="", exit_status=-1, state="driving", cause="") == ("interrupted", "while driving", False)


def test_numbers_of_a_page() -> None:
    cells = [number_text(value) for value in (None, -0.001, 1.005, -2.5, 3, "<")]
    assert cells == ["\u2013", "0.00", "1.00", "\u22122.50", "3", "<"]
    assert [clock_text(value) for value in (3.4, 59.6, 3091.4)] == ["3 s", "1 min 00 s", "51 min 31 s"]


# -- the commands -----------------------------------------------------------------------------------------------------


def test_the_command(run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(run_dir)]) == 0
    assert capsys.readouterr().out == f"{run_dir / 'report.html'}\n"
    assert not list(run_dir.glob("*.new"))
    out, figures = tmp_path / "a.html", tmp_path / "figures" / "deep"
    assert main(["report", str(run_dir), "--out", str(out), "--figures", str(figures), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["report"] == str(out)
    assert out.read_text() == (run_dir / "report.html").read_text()
    names = ("path", "surface", "time", "localization")
    assert {path.name for path in figures.iterdir()} == {f"{n}.{s}" for n in names for s in ("svg", "png", "pdf")}
    summary = json.loads((run_dir / "summary.json").read_text())
    assert told["points"] == {"total": 9, "pass": 9, "corrected": 0, "fail": 0, "skipped": 0, "not_measured": 0}
    assert told["arrival_error_mm"]["max"] == pytest.approx(summary["arrival_error_mm"]["max"], abs=1e-3)
    assert told["time_budget_s"]["total"] == pytest.approx(summary["mission_time_s"], abs=0.02)


def test_refusals(run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path / "nothing")]) == 2
    assert "nothing: no such directory; name the directory of a run" in capsys.readouterr().err
    assert main(["compare", str(run_dir), str(tmp_path)]) == 2
    assert "no config.toml there" in capsys.readouterr().err
    with pytest.raises(ReportError, match=r"no/a\.html: cannot be written: No such file or directory"):
        report_run(run_dir, tmp_path / "no" / "a.html")
    (tmp_path / "file").write_text("")
    assert main(["report", str(run_dir), "--figures", str(tmp_path / "file" / "figures")]) == 2
    assert "cannot be made: Not a directory" in capsys.readouterr().err


def test_a_damaged_run_is_told_on_standard_error(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run_dir / "summary.json").write_text("{")
    assert main(["report", str(run_dir), "--json"]) == 0
    told = capsys.readouterr()
    assert told.err.startswith("ccatp: warning: summary.json: cannot be read: ")
    assert json.loads(told.out)["warnings"][0].startswith("summary.json: ")
