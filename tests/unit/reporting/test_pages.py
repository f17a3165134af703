"""Pages of surveys and comparisons: sections by what a run holds, nothing from outside, text that stays text."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from markupsafe import escape

from ccatp.cli import main
from ccatp.records.state_log import LogLine
from ccatp.report.compare import compare_lines, compare_page, compared_figures, pair_of
from ccatp.report.findings import findings_of, outcome_of
from ccatp.report.html import POLICY, ReportError, clock_text, environment, events_of, gathered, number_text
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


# -- two runs ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same panels, surveyed again by another filter."""
    return record(tmp_path_factory.mktemp("recorded") / "again", run__filter="ukf")


def test_two_surveys_of_one_mirror_agree(
    recorded: Path, other: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, figures = tmp_path / "cmp.html", tmp_path / "figures"
    assert main(["compare", str(recorded), str(other), "--out", str(out), "--figures", str(figures), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert (data["one_mirror"], data["agree"], data["dof"], data["report"]) == (True, True, 3, str(out))
    assert (data["a"]["run"], data["b"]["run"]) == ("tonight", "again")
    (panel,) = data["panels"]
    assert abs(panel["piston_um"]) < 4.0 * panel["sigma"][0]
    names = ("time", "localization", "arrivals", "change", "paths")
    assert {path.name for path in figures.iterdir()} == {f"{n}.{s}" for n in names for s in ("svg", "png", "pdf")}
    page = out.read_text()
    markup = Markup(page)
    assert markup.outside == []
    assert markup.anchors == [
        "figures", "configuration", "map", "time", "errors", "points", "surface", "panels", "adjusters", "events",
    ]  # fmt: skip
    assert '<tr><th scope="row">run.filter</th><td>ekf</td><td>ukf</td></tr>' in page
    assert '<tr><th scope="row">points</th><td>9</td><td>9</td><td>0</td></tr>' in page
    assert "The surveys agree" in page
    adjusters = page[page.index('<section id="adjusters">') :]
    row = adjusters[adjusters.index("<tbody>") : adjusters.index("</tbody>")]
    assert row.count("\u2192 <strong>") == 5
    pair = pair_of(findings_of(read_record(recorded)), findings_of(read_record(other)))
    assert all("_" not in one.name for one in compared_figures(pair))
    (line,) = (line for line in compare_lines(pair) if line.startswith("half-wavefront error, um"))
    assert all(len(cell.partition(".")[2]) == 2 for cell in line.split()[-3:])


def test_panels_that_moved_are_found(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    elsewhere = record(tmp_path / "moved", run__seed=2)  # its panels lie otherwise
    assert main(["compare", str(recorded), str(elsewhere), "--out", str(tmp_path / "c.html")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-3].startswith("the surveys differ: chi2 of no change ")
    assert lines[-2].startswith("panel 1/2 has moved: piston ")
    assert lines[-1] == str(tmp_path / "c.html")
    assert "1 of 1 panels have moved" in (tmp_path / "c.html").read_text()


def test_different_mirrors_are_not_compared_point_by_point(recorded: Path, tmp_path: Path) -> None:
    thesis = record(tmp_path / "thesis", run__mirror="thesis-m1", only=2)
    pair = pair_of(findings_of(read_record(recorded)), findings_of(read_record(thesis)))
    page = compare_page(pair)
    assert Markup(page).anchors == ["figures", "configuration", "time", "errors", "events"]
    warning = "The runs are of different mirrors, fyst-m1 and thesis-m1: points and panels are not compared."
    assert warning in page
    assert next(compare_lines(pair)) == f"warning: {warning}"
    assert not [one.name for one in compared_figures(pair) if "wavefront" in one.name and one.change is not None]


def test_runs_without_anything_are_compared(recorded: Path, without: Callable[..., Path]) -> None:
    bare = findings_of(read_record(without("telemetry.mcap", "mission.sqlite", "log.jsonl", "summary.json")))
    page = compare_page(pair_of(bare, bare))
    assert Markup(page).anchors == ["figures", "configuration"]
    both = compare_page(pair_of(bare, findings_of(read_record(recorded))))
    assert Markup(both).anchors == [
        "figures", "configuration", "map", "time", "errors", "surface", "adjusters", "events",
    ]  # fmt: skip


def test_wavefronts_are_of_the_panels_that_both_have(recorded: Path) -> None:
    whole = findings_of(read_record(recorded))
    assert whole.alignment is not None
    (panel,) = whole.alignment.panels
    more = replace(panel, panel=panel.panel._replace(col=panel.panel.col + 1))
    wider = replace(whole, alignment=replace(whole.alignment, panels=(panel, more)))
    found = {one.name: one for one in compared_figures(pair_of(whole, wider))}
    error = found["half-wavefront error, \u00b5m, common panels (1)"]
    assert error.change == 0.0
    assert error.a == pytest.approx(1e6 * whole.alignment.wavefront.before_m, abs=1e-3)  # type: ignore[union-attr]


# -- lines of the log -------------------------------------------------------------------------------------------------


def events_body(lines: list[LogLine]) -> str:
    macros = environment().get_template("macros.html").module
    return str(macros.log_events(events_of(lines)))  # type: ignore[attr-defined]


def line(text: str, level: str = "warning", t_s: float | None = 1.0, process: str = "main") -> LogLine:
    return LogLine("2026-01-01T12:00:00.5Z", t_s, level, process, text)


LATE = [line(f"late frame: lag {0.05 + 0.001 * k:.3f} s, limit 0.05 s", t_s=1.0 * k) for k in range(300)]
GRAVE = (
    line("process main was killed by SIGKILL: restarting it, wheels held meanwhile", t_s=None, process="supervisor"),
    line("operator: abort", level="info", t_s=350.0),
    line("held for 30 s, waiting for an operator: stuck", level="error", t_s=360.0),
)


def test_a_flood_hides_nothing() -> None:
    before, folded = events_body([*LATE, *GRAVE]).split("<details>")
    rows = before.split("<tr>")[2:]
    assert len(rows) == 4
    for row, found in zip(rows, ("held for 30 s", "was killed", "operator: abort", "late frame"), strict=True):
        assert found in row
    assert "<td>300</td>" in rows[3]
    assert '<th scope="row">0.00 s</th><td>299.00 s</td>' in rows[3]
    assert "lag 0.050 to 0.349 s, limit 0.05 s" in rows[3]
    assert "12:00:00" in rows[1]  # the supervisor knows no robot time
    assert folded.count("<tr>") == 1 + 303


def test_kinds_beyond_the_limit_are_counted_and_errors_are_always_there() -> None:
    words = [f"{chr(97 + k // 26)}{chr(97 + k % 26)}" for k in range(60)]
    calm = [line(f"calm {word}", level="info") for word in words]
    before, _ = events_body([*calm, *(line(f"careful {word}") for word in words)]).split("<details>")
    assert before.count("careful") == 40
    assert "and 20 more kinds of warnings" in before
    assert "calm" not in before
    before, _ = events_body([line(f"broken {word}", level="error") for word in words]).split("<details>")
    assert before.count("broken") == 60
    assert "more kinds" not in before


def test_names_of_points_are_no_numbers() -> None:
    texts = [f"measurement of 1-{k}-7 failed: no fix" for k in range(3)]
    (kind,) = gathered([line(text) for text in texts])
    assert kind.text == "measurement of 1-0-7 and 2 others failed: no fix"


def test_few_lines_are_all_there_as_they_are() -> None:
    body = events_body(LATE[:3])
    assert "<details>" not in body
    assert body.count("late frame") == 3


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
