"""Two runs beside each other: page, terminal, data."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from ccatp.cli import main
from ccatp.report.compare import compare_lines, compare_page, compare_runs, compared_figures, pair_of
from ccatp.report.findings import findings_of
from ccatp.report.record import read_record
from tests.unit.reporting.markup import Markup
from tests.unit.reporting.recorded import record


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
        ["figures", "configuration", "map", "time", "errors", "points", "surface", "panels", "adjusters", "events"],
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
    compare_runs(recorded, other, tmp_path / "c.html", tmp_path / "figures")
    names = ("time", "localization", "arrivals", "change", "paths")
    expected = {f"{name}.{suffix}" for name in names for suffix in ("svg", "png", "pdf")}
    assert {path.name for path in (tmp_path / "figures").iterdir()} == expected


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
        "figures",
        "configuration",
        "map",
        "time",
        "errors",
        "surface",
        "adjusters",
        "events",
    ]


def test_figures_have_names_units_and_decimals(recorded: Path, other: Path) -> None:
    pair = pair_of(findings_of(read_record(recorded)), findings_of(read_record(other)))
    page, lines = compare_page(pair), list(compare_lines(pair))
    assert '<tr><th scope="row">points</th><td>9</td><td>9</td><td>0</td></tr>' in page
    assert "first arrival, mean, mm" in page
    assert all("_" not in one.name for one in compared_figures(pair))
    (line,) = (line for line in lines if line.startswith("half-wavefront error, um"))
    assert all(len(cell.partition(".")[2]) == 2 for cell in line.split()[-3:])


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


def test_adjusters_of_both_and_what_is_still_to_be_made(recorded: Path, other: Path) -> None:
    page = compare_page(pair_of(findings_of(read_record(recorded)), findings_of(read_record(other))))
    section = page[page.index('<section id="adjusters">') :]
    row = section[section.index("<tbody>") : section.index("</tbody>")]
    assert row.count("\u2192 <strong>") == 5
    assert "still to be made" in section
