"""Points of a tracker before and after an adjustment: what was not made, and what is no change of a panel."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.core import FloatArray
from ccatp.mirror.move_checks import Made
from ccatp.mirror.panel_modes import adjustable, adjuster_places, quadratic, rigid
from ccatp.report.compare import SurveyPair, read_survey
from ccatp.report.findings import findings_of
from ccatp.report.record import read_record
from ccatp.report.saved_alignment import read_alignment
from tests.support.command import answered, printed, refused
from tests.support.trackers import Instrument, Places, measured, places_of

PLACES = places_of("fyst-m1", 16)
MODES = np.array([adjustable(one) for one in PLACES.places_m])
SMALL = 9  # a panel that lies right
LIES = np.array([150e-6, 400e-6, 400e-6, 0.0, 0.0]) * np.random.default_rng(8).normal(size=(16, 5))
LIES[SMALL] = 0.0
LATER = Instrument(offset_m=0.0127)
EXACT = Instrument(turn_rad=0.0, shift_m=0.0, scale=0.0)
Deeds = Mapping[int, Callable[[FloatArray], FloatArray]]


def surface(lies: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("nki,ni->nk", MODES, lies))


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """In the frame of the mirror: the panel that lies right has no work."""
    file = tmp_path_factory.mktemp("before") / "before.csv"
    return measured(file, PLACES, surface(LIES), EXACT._replace(lost=0.0), np.random.default_rng(8))


def adjusted(before: Path, deeds: Deeds, *, does_bend: bool = False) -> FloatArray:
    """How the panels lie after the moves; those of some panels are what the deed makes of the planned ones."""
    planned, later = read_survey(before), LIES.copy()
    shape = adjustable if does_bend else rigid
    for at, panel in enumerate(PLACES.panels):
        moves = planned.panels[panel].rigid.moves.values_m
        made = deeds[at](moves) if at in deeds else moves
        own = adjuster_places(PLACES.mirror, panel)[1]
        change = np.linalg.lstsq(shape(own), made, rcond=None)[0]
        later[at, : len(change)] += change * (at != SMALL)
    return later


def after(
    folder: Path, lies: FloatArray, instrument: Instrument = LATER, places: Places = PLACES, rough: float = 0.0
) -> Path:
    rng = np.random.default_rng(7)
    return measured(folder / "after.csv", places, surface(lies)[: len(places.panels)] + rough, instrument, rng)


def compared(one: Path, other: Path) -> SurveyPair:
    return SurveyPair(read_survey(one), read_survey(other))


def wrong(pair: SurveyPair) -> set[int]:
    return {PLACES.panels.index(check.panel) for check in pair.checks if not check.is_as_planned}


def nothing(moves: FloatArray) -> FloatArray:
    return 0.0 * moves


def wrong_way(moves: FloatArray) -> FloatArray:
    return -moves


def fourth_not(moves: FloatArray) -> FloatArray:
    return moves * [1.0, 1.0, 1.0, 0.0, 1.0]


DEEDS: Deeds = {2: nothing, 4: fourth_not, 6: wrong_way}


def test_the_command_names_what_was_not_made_in_another_frame(
    before: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    later = after(tmp_path, adjusted(before, DEEDS))
    found = answered(capsys, "compare", before, later)
    made = {(one["row"], one["col"], one["adjuster"]): one["made"] for one in found["moves"]}
    assert len(made) == 5 * 15
    names = [PLACES.panels[at] for at in DEEDS]
    expected = {(*names[0], f"V{k}"): Made.NOT for k in range(1, 6)} | {(*names[1], "V4"): Made.NOT}
    expected |= {(*names[2], f"V{k}"): Made.WRONG_WAY for k in range(1, 6)}
    assert {key: one for key, one in made.items() if one != Made.AS_PLANNED} == expected
    # The other panels tell the motion of the mirror.
    assert found["common_motion_um"]["panels"] >= 13
    assert found["repeatability_um"] == pytest.approx(15.0, rel=0.25)
    assert found["report"] is None
    assert found["a"] == {"alignment": "before.json", "mirror": "fyst-m1"}
    small = PLACES.panels[SMALL]
    assert f"not in the work list of A, so without a planned change: panel {small.row}/{small.col}" in found["remarks"]


def test_the_page_and_the_lines_have_planned_and_measured_moves(
    before: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    later = after(tmp_path, adjusted(before, DEEDS))
    lines = printed(capsys, "compare", before, later, "--out", tmp_path / "page.html").splitlines()
    assert "12 of 15 panels have changed as planned" in lines
    panel = PLACES.panels[2]
    assert f"panel {panel.row}/{panel.col} not as planned: no adjuster moved" in lines
    (head,) = (at for at, line in enumerate(lines) if line.startswith("panel       "))
    rows = lines[head + 1 : head + 16]
    assert all(row.count(" -> ") == 5 for row in rows)
    assert sum(row.endswith(", as planned") for row in rows) == 12
    page = (tmp_path / "page.html").read_text()
    assert "Planned → measured moves of 15 panels, µm" in page
    assert "points of an instrument" in page


@pytest.mark.parametrize("does_bend", [False, True])
def test_adjusters_of_another_order_are_the_same_by_their_places(
    before: Path, tmp_path: Path, *, does_bend: bool
) -> None:
    settings = (("mirror.adjusters.order", "observatory"),)
    later = after(tmp_path, adjusted(before, DEEDS, does_bend=does_bend), LATER._replace(settings=settings))
    pair = compared(before, later)
    assert wrong(pair) == DEEDS.keys()
    (check,) = (check for check in pair.checks if check.panel == PLACES.panels[4])
    assert {move.adjuster: move.made for move in check.moves if move.made is not Made.AS_PLANNED} == {"V4": Made.NOT}
    assert check.is_plane is not does_bend


@pytest.mark.parametrize("count", [8, 16])
def test_a_work_list_of_which_a_part_was_made(before: Path, tmp_path: Path, count: int) -> None:
    pair = compared(before, after(tmp_path, adjusted(before, dict.fromkeys(range(count), nothing))))
    expected = {*range(count)} - {SMALL}
    if count < 16:
        assert wrong(pair) == expected
    else:
        assert pair.checks == ()
        assert "no panel has moved; A plans moves of 15 panels" in pair.remarks


@pytest.mark.parametrize("factor", [-1.0, 2.0, 0.5])
def test_a_multiple_of_all_moves_is_no_motion_of_the_mirror(before: Path, tmp_path: Path, factor: float) -> None:
    pair = compared(before, after(tmp_path, adjusted(before, dict.fromkeys(range(16), lambda moves: factor * moves))))
    assert pair.changes is not None
    assert pair.changes.motion is not None
    assert len(wrong(pair)) >= 12  # half of small moves may be noise
    factors = [one.factor for check in pair.checks for one in check.explanations if one.factor is not None]
    assert np.median(factors) == pytest.approx(factor, abs=0.05)


def test_a_panel_of_which_the_surface_is_another_is_named(before: Path, tmp_path: Path) -> None:
    rough = np.zeros((16, 9))
    rough[3] = quadratic(PLACES.places_m[3])[:, 3:] @ [2e-3, 0.0, -2e-3]
    later = measured(
        tmp_path / "after.csv", PLACES, surface(adjusted(before, {})) + rough, LATER, np.random.default_rng(7)
    )
    pair = compared(before, later)
    assert pair.changes is not None
    assert pair.changes.repeat.other_surface == (PLACES.panels[3],)
    assert pair.repeatability_m == pytest.approx(15e-6, rel=0.25)
    assert any("another panel, or other targets?" in line for line in pair.remarks)


def test_panels_of_one_survey_and_work_that_was_not_measured_are_named(before: Path, tmp_path: Path) -> None:
    fewer = places_of("fyst-m1", 12)
    pair = compared(before, after(tmp_path, adjusted(before, {}), places=fewer))
    names = ", ".join(f"{panel.row}/{panel.col}" for panel in PLACES.panels[12:])
    assert f"only in A: panels {names}; 4 of them were to be moved" in pair.remarks
    assert wrong(pair) == set()


def test_a_few_panels_do_not_show_a_motion_of_the_mirror(before: Path, tmp_path: Path) -> None:
    pair = compared(before, after(tmp_path, adjusted(before, {}), EXACT, places=places_of("fyst-m1", 5)))
    assert any(line.startswith("the panels do not show how the frames of A and B differ") for line in pair.remarks)
    assert wrong(pair) == set()


def test_surveys_that_are_exchanged_are_noticed(before: Path, tmp_path: Path) -> None:
    later = after(tmp_path, adjusted(before, {}))
    line = "B plans what leads to A: if the adjusters were turned, A and B are exchanged"
    assert line in compared(later, before).remarks
    assert line not in compared(before, later).remarks


def test_one_survey_twice_is_refused_also_with_another_offset(
    before: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "have the same points: they are one survey" in refused(capsys, "compare", before, before)
    points = before.with_suffix(".csv")
    options = ["--mirror", "fyst-m1", "--sigma-um", "15", "--offset-mm", "18.5"]
    again = tmp_path / "again.json"
    again.write_text(printed(capsys, "align", "--points", points, *options, "--json"), encoding="utf-8")
    assert "have the same points: they are one survey" in refused(capsys, "compare", before, again)


def test_another_mirror_is_refused(before: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = places_of("fyst-m2", 2)
    later = measured(tmp_path / "m2.csv", other, np.zeros((2, 9)), EXACT, np.random.default_rng(1))
    assert "different mirrors, fyst-m1 and fyst-m2" in refused(capsys, "compare", before, later)
    one = read_survey(before)
    reshaped = one._replace(cfg=one.cfg.model_copy(update={"surface": read_survey(later).cfg.surface}))
    pair = SurveyPair(one, reshaped)
    assert pair.warning == "The mirrors have other values in surface: points and panels are not compared."
    assert (pair.changes, pair.checks) == (None, ())


def edited(before: Path, file: Path, change: Callable[[Any], object]) -> Path:
    data = json.loads(before.read_text())
    change(data)
    file.write_text(json.dumps(data), encoding="utf-8")
    return file


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data["panels"][2]["deviations"][0].update(deviation_um=900.0), "points do not give its moves"),
        (lambda data: data["panels"][2]["deviations"][0].update(sigma_um=0.0), "points do not give its moves"),
        (lambda data: data["panels"][2].update(adjusters_um=[0.0]), "points do not give its moves"),
        (lambda data: data["panels"][2].update(row=44), "panel 44/4 is none of fyst-m1"),
        (lambda data: data.pop("config"), "an alignment of an older version"),
        (lambda data: data["config"]["mirror"].pop("panels"), "not as ccatp align writes it"),
        (lambda data: data.pop("panels"), "neither a run directory nor an alignment"),
    ],
)
def test_a_file_that_is_no_alignment_or_was_changed_is_refused(
    before: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Callable[[Any], object], message: str
) -> None:
    assert message in refused(capsys, "compare", before, edited(before, tmp_path / "x.json", change))


def test_a_file_of_points_is_told_how_to_become_an_alignment(before: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, "compare", before.with_suffix(".csv"), before)
    assert "ccatp align --points" in line
    assert "--json > before.json" in line


def test_an_alignment_in_utf_16_is_read(before: Path, tmp_path: Path) -> None:
    file = tmp_path / "before.json"
    file.write_text(before.read_text(), encoding="utf-16")
    assert read_alignment(file).panels[0].panel == PLACES.panels[0]


def test_an_alignment_of_a_run_is_the_run(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "run.json"
    file.write_text(printed(capsys, "align", recorded, "--json"), encoding="utf-8")
    (saved,) = read_alignment(file).panels
    alignment = findings_of(read_record(recorded)).alignment
    assert alignment is not None
    (panel,) = alignment.panels
    assert saved.fit.values == pytest.approx(panel.fit.values, abs=1e-9)
    assert saved.fit.covariance == pytest.approx(panel.fit.covariance, rel=1e-2)
    assert "they are one survey" in refused(capsys, "compare", recorded, file)


def test_a_run_before_and_a_tracker_after(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = read_survey(recorded)
    (panel,) = run.panels.values()
    places = places_of("fyst-m1", 1)
    assert places.panels == (panel.panel,)
    later = measured(tmp_path / "after.csv", places, np.zeros((1, 9)), EXACT, np.random.default_rng(3))
    pair = SurveyPair(run, read_survey(later))
    assert [check.is_as_planned for check in pair.checks] == [True]
    found = answered(capsys, "compare", recorded, later)
    assert (found["report"], found["one_mirror"]) == (None, True)
    found = answered(capsys, "compare", later, recorded, "--out", tmp_path / "page.html")
    assert found["b"]["points"]["total"] == 9
