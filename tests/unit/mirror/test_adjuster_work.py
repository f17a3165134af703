"""Work at the adjusters: steps within the limits, names in both orders, and what a later survey shows of the moves."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

from ccatp.config.models import AdjustersConfig
from ccatp.core import DeckPose, Fix, Measured, PanelId
from ccatp.mirror.adjuster_work import work_list
from ccatp.mirror.mirror import build_mirror
from ccatp.mirror.mirror_alignment import survey_result
from ccatp.mirror.misalignment import PanelMisalignment
from ccatp.mirror.move_checks import Made, PanelCheck, check_moves, made_of
from ccatp.mirror.panel_alignment import PanelResult
from ccatp.mirror.panel_changes import panel_changes, point_repeat
from ccatp.mirror.panel_modes import adjustable, adjuster_places, rigid
from tests.support.scenario import world_of

HEIGHT_M = 0.05
CFG, M1 = world_of()
PANEL = PanelId(4, 5)
LIES = PanelMisalignment(120e-6, -180e-6, 90e-6)
SIGMA_M = 2e-6


def surveyed(displacement: np.ndarray, seed: int) -> PanelResult:
    """A panel whose surface is displaced by five modes: rigid, twist, bowl."""
    rng, body = np.random.default_rng(seed), M1.panel(PANEL)
    measured = []
    for point in M1.point_ids(PANEL):
        x, y = M1.point_on_deck(point)
        place = np.array([body.from_deck(M1.surface.point(x, y))[:2]])
        away = float((adjustable(place) @ displacement)[0]) + SIGMA_M * float(rng.normal())
        puck = np.array(M1.puck_world(DeckPose(x, y, 0.0), HEIGHT_M))
        normal = np.array(M1.rotate_world_from_deck(body.axes[2]))
        px, py, pz = (puck + away * normal).tolist()
        measured.append(Measured(point, Fix(1.0, (px, py, pz), tuple((np.eye(3) * SIGMA_M**2).ravel()), 1.0, (), 0.0)))
    (panel,) = survey_result(M1, CFG.align, HEIGHT_M, measured, [PANEL]).panels
    return panel


START = np.array([LIES.piston_m, LIES.tip_rad, LIES.tilt_rad, 0.0, 0.0])
BEFORE = surveyed(START, 1)


def after(turned: dict[str, float], seed: int = 2) -> PanelResult:
    """The panel after each adjuster was moved by a share of its planned move; 1 if it is not named."""
    places = adjuster_places(M1, PANEL)[1]
    shares = np.array([turned.get(name, 1.0) for name in BEFORE.adjusters])
    made = np.linalg.solve(adjustable(places), shares * BEFORE.rigid.moves.values_m)
    return surveyed(START + made, seed)


def checked(later: PanelResult) -> PanelCheck:
    changes = panel_changes(M1, [(BEFORE, later)], planned=-BEFORE.fit.values[None, :])
    assert changes is not None
    (found,) = check_moves((M1, M1), [(BEFORE, later)], changes, [PANEL])
    return found


def test_the_steps_add_up_to_the_moves_and_exceed_no_limit() -> None:
    steps, warnings = work_list(M1, AdjustersConfig(pitch_mm=0.5, step_mm=0.03), [BEFORE])
    assert warnings == ()
    total, by_round = defaultdict[str, float](float), defaultdict[int, list[float]](list)
    for step in steps:
        total[step.adjuster] += step.move_m
        by_round[step.round].append(step.move_m)
        assert step.turns == pytest.approx(step.move_m / 0.5e-3)
        # While it is turned, no other one of the panel is further behind.
        assert abs(step.move_m) <= 0.03e-3 + 1e-12
    assert [*by_round] == sorted(by_round)
    assert [total[name] for name in BEFORE.adjusters] == pytest.approx(BEFORE.rigid.moves.values_m)
    places = {step.adjuster: (step.x_m, step.y_m) for step in steps}
    assert places["V1"] == pytest.approx((0.22, -0.25), abs=1e-6)


def with_sigma(panel: PanelResult, sigma_m: float) -> PanelResult:
    moves = panel.rigid.moves
    wide = moves._replace(covariance_m2=np.eye(5) * sigma_m**2)
    return replace(panel, rigid=panel.rigid._replace(moves=wide))


def test_a_panel_without_a_move_above_the_noise_has_no_steps() -> None:
    largest_m = float(np.abs(BEFORE.rigid.moves.values_m).max())
    steps, (line,) = work_list(M1, AdjustersConfig(), [with_sigma(BEFORE, largest_m / 2.9)])
    assert steps == ()
    assert line.startswith("not in the work list, as no move is 3 times the largest standard deviation")
    assert line.endswith("panels 4/5")
    steps, lines = work_list(M1, AdjustersConfig(), [with_sigma(BEFORE, largest_m / 3.1)])
    assert [step.is_significant for step in steps].count(True) == 1
    assert "4 moves of the work list are less than 3 times their standard deviation" in lines[0]


def test_a_panel_whose_points_do_not_decide_has_no_steps() -> None:
    undecided = replace(BEFORE, deciding=M1.point_ids(PANEL)[0])
    steps, (line,) = work_list(M1, AdjustersConfig(), [undecided])
    assert steps == ()
    assert line == "not in the work list, as their points do not decide: panels 4/5"


def test_a_move_beyond_the_travel_is_named_and_not_in_the_list() -> None:
    steps, (line,) = work_list(M1, AdjustersConfig(travel_mm=0.1), [BEFORE])
    assert steps == ()
    assert "panel 4/5: V" in line
    assert "its travel is 0.1 mm: it is not in the work list" in line


def test_without_limits_each_adjuster_is_turned_once() -> None:
    steps, _ = work_list(M1, AdjustersConfig(), [BEFORE])
    assert [(step.round, step.rounds, step.turns) for step in steps] == [(1, 1, None)] * 5


def test_the_observatory_names_the_adjusters_by_their_quadrant() -> None:
    mirror = CFG.mirror.model_copy(update={"adjusters": AdjustersConfig(order="observatory")})
    ours, theirs = M1.adjusters_on_deck(PANEL), build_mirror(mirror).adjusters_on_deck(PANEL)
    assert [*theirs] == ["v1", "v2", "v3", "v4", "v5"]
    same = {"V1": "v2", "V2": "v4", "V3": "v1", "V4": "v3", "V5": "v5"}
    for name, other in same.items():
        assert ours[name] == theirs[other]


@pytest.mark.parametrize(
    ("planned", "measured", "made"),
    [
        (50.0, 49.0, Made.AS_PLANNED),
        (50.0, 0.5, Made.NOT),
        (50.0, -50.0, Made.WRONG_WAY),
        (50.0, 25.0, Made.PARTLY),
        (50.0, 80.0, Made.TOO_FAR),
        (0.5, 0.1, Made.AS_PLANNED),
        (0.5, 30.0, Made.TOO_FAR),
    ],
)
def test_a_move_is_judged_by_its_sigma(planned: float, measured: float, made: Made) -> None:
    assert made_of(planned, measured, 1.0) is made


@pytest.mark.parametrize(
    ("turned", "wrong"),
    [
        ({}, {}),
        ({"V4": 0.0}, {"V4": Made.NOT}),
        ({"V3": -1.0}, {"V3": Made.WRONG_WAY}),
        ({"V3": 0.3, "V4": 1.8}, {"V3": Made.PARTLY, "V4": Made.TOO_FAR}),
    ],
)
def test_the_next_survey_shows_which_adjuster_was_not_moved_as_planned(
    turned: dict[str, float], wrong: dict[str, Made]
) -> None:
    found = checked(after(turned))
    assert {one.adjuster: one.made for one in found.moves if one.made is not Made.AS_PLANNED} == wrong


def rigid_after(moved_m: np.ndarray, seed: int = 2) -> PanelResult:
    """A panel that does not bend after its adjusters were moved: its plane follows them by least squares."""
    plane = np.linalg.lstsq(rigid(adjuster_places(M1, PANEL)[1]), moved_m, rcond=None)[0]
    return surveyed(START + np.array([*plane, 0.0, 0.0]), seed)


PLANNED_M = BEFORE.rigid.moves.values_m


@pytest.mark.parametrize(
    ("moved_m", "explanations", "made"),
    [
        (PLANNED_M, set(), {}),
        (0.0 * PLANNED_M, {(Made.NOT, "V1 V2 V3 V4 V5")}, dict.fromkeys(BEFORE.adjusters, Made.NOT)),
        (-PLANNED_M, {(Made.WRONG_WAY, "V1 V2 V3 V4 V5")}, dict.fromkeys(BEFORE.adjusters, Made.WRONG_WAY)),
        (2.0 * PLANNED_M, {(Made.OPEN, "V1 V2 V3 V4 V5")}, dict.fromkeys(BEFORE.adjusters, Made.TOO_FAR)),
        (PLANNED_M * [1, 1, 1, 0, 1], {(Made.OPEN, "V4")}, {"V4": Made.NOT}),
        (PLANNED_M[[3, 1, 2, 0, 4]], {(Made.EXCHANGED, "V1 V4")}, {"V1": Made.EXCHANGED, "V4": Made.EXCHANGED}),
        # The same plane: it does not tell which of the two pairs.
        (
            PLANNED_M[[1, 0, 2, 3, 4]],
            {(Made.EXCHANGED, "V1 V2"), (Made.EXCHANGED, "V3 V4")},
            dict.fromkeys(("V1", "V2", "V3", "V4"), Made.OPEN),
        ),
    ],
)
def test_a_plane_names_the_fewest_adjusters_that_explain_it(
    moved_m: np.ndarray, explanations: set[tuple[Made, str]], made: dict[str, Made]
) -> None:
    found = checked(rigid_after(moved_m))
    assert found.is_plane
    assert {(one.made, " ".join(one.adjusters)) for one in found.explanations} == explanations
    assert {one.adjuster: one.made for one in found.moves if one.made is not Made.AS_PLANNED} == made


def test_a_plane_that_many_adjusters_explain_names_none() -> None:
    found = checked(rigid_after(PLANNED_M + 1e-6 * np.array([60.0, -35.0, 95.0, 0.0, -80.0])))
    assert (found.is_plane, found.explanations, found.is_as_planned) == (True, (), False)
    assert {one.made for one in found.moves} == {Made.OPEN}


def test_the_repeatability_of_a_point_is_its_noise() -> None:
    pairs = [(surveyed(START, 2 * k), surveyed(START, 2 * k + 1)) for k in range(30)]
    values = [point_repeat([pair]).sigma_m or 0.0 for pair in pairs]
    # 120 degrees of freedom: known to 6 %; four sigmas.
    assert np.sqrt(np.mean(np.square(values))) == pytest.approx(SIGMA_M, rel=0.26)
