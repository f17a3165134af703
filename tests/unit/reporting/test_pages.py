"""The pages: sections by what a run holds, nothing from outside, text that stays text."""

import json
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

from ccatp.cli import main
from ccatp.report_writer import ReportError, compare_runs, report_run
from ccatp.reporting.compare_page import compare_page, pair_of
from ccatp.reporting.findings import findings_of, outcome_of
from ccatp.reporting.html import clock, shown, text
from ccatp.reporting.page import POLICY
from ccatp.reporting.record import LogLine
from ccatp.reporting.run_page import run_page
from ccatp.reporting.sections import SECTIONS
from ccatp.run_files.report_reader import read_record
from tests.unit.reporting.recorded import record

FETCHED = {"src", "href", "srcset", "action", "data", "poster"}
VOID = {"meta", "link", "rect", "br"}


class Markup(HTMLParser):
    """Checks that elements nest, and collects what a browser would fetch."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.outside: list[str] = []
        self.anchors: list[str] = []
        self.headings: list[str] = []
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name in FETCHED and not (value or "").startswith(("#", "data:")):
                self.outside.append(f"{tag} {name}={value}")
            if name == "id":
                self.anchors.append(value or "")
            assert not name.startswith("on"), f"a script: {name}"
        assert tag not in {"script", "iframe", "object", "embed", "img"}

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass  # of an SVG

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


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
    assert "url(" not in page
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
    assert page.count(text(evil)) >= 6
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
    cells = [shown(value) for value in (None, -0.001, 1.005, -2.5, 3, "<")]
    assert cells == ["\u2013", "0.00", "1.00", "\u22122.50", "3", "&lt;"]
    assert [clock(value) for value in (3.4, 59.6, 3091.4)] == ["3 s", "1 min 00 s", "51 min 31 s"]


def test_each_section_takes_any_run(recorded: Path, without: Callable[..., Path]) -> None:
    found = findings_of(read_record(without("telemetry.mcap", "mission.sqlite", "log.jsonl", "summary.json")))
    assert [make(found) is None for make in SECTIONS] == [True] * (len(SECTIONS) - 1) + [False]


# -- the commands -----------------------------------------------------------------------------------------------------


def test_the_command(run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(run_dir)]) == 0
    assert capsys.readouterr().out == f"{run_dir / 'report.html'}\n"
    assert not list(run_dir.glob("*.new"))
    pytest.importorskip("matplotlib")
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


# -- two runs ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same panels, surveyed again by another filter."""
    return record(tmp_path_factory.mktemp("recorded") / "again", run__filter="ukf")


def test_two_surveys_of_one_mirror_agree(
    recorded: Path, other: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "cmp.html"
    assert main(["compare", str(recorded), str(other), "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["one_mirror"], told["agree"], told["dof"], told["report"]) == (True, True, 3, str(out))
    assert (told["a"]["run"], told["b"]["run"]) == ("tonight", "again")
    (panel,) = told["panels"]
    assert abs(panel["piston_um"]) < 4.0 * panel["sigma"][0]
    page = out.read_text()
    markup = Markup(page)
    assert (markup.outside, markup.anchors) == (
        [],
        ["figures", "configuration", "time", "errors", "points", "panels"],
    )
    assert '<tr><th scope="row">run.filter</th><td>ekf</td><td>ukf</td></tr>' in page
    assert "The surveys agree" in page


def test_panels_that_moved_are_found(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    elsewhere = record(tmp_path / "moved", run__seed=2)  # its panels lie otherwise
    assert main(["compare", str(recorded), str(elsewhere), "--out", str(tmp_path / "c.html")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-3].startswith("the surveys differ: chi2 of no change ")
    assert lines[-2].startswith("panel 1/2 has moved: piston ")
    assert lines[-1] == str(tmp_path / "c.html")
    assert "1 of 1 panels have moved" in (tmp_path / "c.html").read_text()


def test_figures_of_two_runs(recorded: Path, other: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    compare_runs(recorded, other, tmp_path / "c.html", tmp_path / "figures")
    names = ("time", "localization", "arrivals", "change")
    expected = {f"{name}.{suffix}" for name in names for suffix in ("svg", "png", "pdf")}
    assert {path.name for path in (tmp_path / "figures").iterdir()} == expected


def test_different_mirrors_are_not_compared_point_by_point(recorded: Path, tmp_path: Path) -> None:
    thesis = record(tmp_path / "thesis", run__mirror="thesis-m1", only=2)
    page = compare_page(pair_of(findings_of(read_record(recorded)), findings_of(read_record(thesis))))
    assert Markup(page).anchors == ["figures", "configuration", "time", "errors"]
    assert "The runs are of different mirrors" in page


def test_runs_without_anything_are_compared(recorded: Path, without: Callable[..., Path]) -> None:
    bare = findings_of(read_record(without("telemetry.mcap", "mission.sqlite", "log.jsonl", "summary.json")))
    page = compare_page(pair_of(bare, bare))
    assert Markup(page).anchors == ["figures", "configuration"]
    both = compare_page(pair_of(bare, findings_of(read_record(recorded))))
    assert Markup(both).anchors == ["figures", "configuration", "time", "errors"]
