"""The state of the page, from messages in virtual time."""

import json
from math import hypot
from typing import Any

import msgspec
import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import DeckPose, EventCode, PanelId, PanelPose, PointId, Severity, Verdict
from ccatp.links.topics import (
    ArrivalMessage,
    DangerEvent,
    DisplayState,
    FixMessage,
    LogMessage,
    MissionStatus,
    RobotShape,
    Scene,
    TrackMessage,
    TruthMessage,
)
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.report.dashboard.survey_view import SurveyView, ground
from ccatp.report.dashboard.view import ARRIVED, MEASURED, SKIPPED

LINE = (
    b'{"type":"sensors","seq":5,"t":1.5,"imu":[],"enc":[],"edge":[[1.4,1,1,1,1],[1.5,1,0,1,1]],"gravity":null,'
    b'"fans":[0.8,0.7],"soc":0.93,"cmd":{"seq":4,"age":0.012,"permit_age":0.008,"held":false},"faults":["stall"]}'
)


@pytest.fixture(scope="module")
def cfg() -> Config:
    return load_config(None, {"run.panels": 2})


@pytest.fixture(scope="module")
def mirror(cfg: Config) -> Mirror:
    return build_mirror(cfg.mirror)


@pytest.fixture
def view(mirror: Mirror, cfg: Config) -> SurveyView:
    return SurveyView(mirror, cfg, is_sim=True)


def mission(**fields: Any) -> MissionStatus:
    known: dict[str, Any] = {
        "seq": 1, "t_s": 1.0, "state": "driving", "cause": "", "done": 0, "skipped": 0, "total": 18, "point": "1-2-1",
        "elapsed_s": 5.0, "eta_s": 90.0, "error_mm": 0.0, "code": 0, "outcome": "", "lower_bound_s": 95.0,
        "exit_status": -1,
    }  # fmt: skip
    return MissionStatus(**(known | fields))


def picture(t_s: float = 1.5, nis: float = 2.0, line: bytes = LINE) -> DisplayState:
    return DisplayState(
        seq=5, t_s=t_s, x_m=1.0, y_m=-2.0, heading_rad=0.5, covariance_m2=(1e-6, 0.0, 4e-6), heading_sigma_rad=0.01,
        nis=nis, size=2, line=msgspec.Raw(line),
    )  # fmt: skip


def fix_at(mirror: Mirror, point: PointId | None, ahead_m: float, t_s: float = 2.0) -> FixMessage:
    x_m, y_m = mirror.point_on_deck(point or PointId(1, 2, 1))
    world = mirror.puck_world(DeckPose(x_m + ahead_m, y_m, 0.0), 0.05)
    return FixMessage(
        seq=9, t_s=t_s, point=point, is_fused=True, position_m=world, covariance_m2=[0.0] * 9, dop=1.0,
        residual_rms_m=1e-6, channels=[1, 2, 3, 4], jump_mm=0.7,
    )  # fmt: skip


def encoded(state: dict[str, Any]) -> dict[str, Any]:
    told: dict[str, Any] = json.loads(msgspec.json.encode(state))
    return told


def test_levels_are_there_each_time(view: SurveyView) -> None:
    state = encoded(view.news(0.0))
    assert state["mission"] is state["pose"] is state["verdict"] is state["robot"] is None
    assert state["points"] == state["path"] == state["log"] == []
    assert state["is_sim"] is True
    view.receive(mission(), 1.0)
    view.receive(picture(), 1.0)
    for _ in range(2):
        state = encoded(view.news(1.1))
        assert (state["mission"]["state"], state["mission"]["is_stale"], state["pose"]["x_m"]) == (
            "driving",
            False,
            1.0,
        )
        assert state["robot"] == {
            "edges": [1, 0, 1, 1], "fans": [0.8, 0.7], "charge": 0.93, "drive_age_s": 0.012, "permit_age_s": 0.008,
            "is_held": False, "faults": ["stall"],
        }  # fmt: skip
    assert view.news(2.1)["mission"]["is_stale"]
    view.receive(picture(line=b"null"), 3.2)  # before the first frame
    assert (view.news(3.2)["robot"], view.news(3.2)["pose"] is None) == (None, False)
    view.discard_history()
    assert view.news(3.3)["pose"] is None
    view.receive(mission(exit_status=0), 4.0)
    assert (view.news(9.0)["is_over"], view.news(9.0)["mission"]["is_stale"]) == (True, False)


def test_the_next_point_is_known_on_the_way_to_other_stops_too(view: SurveyView, mirror: Mirror) -> None:
    for status, point in ((mission(point="1-2-9"), "1-2-9"), (mission(point=""), "1-2-7")):
        view.receive(status, 1.0)
        assert view.news(1.0)["mission"]["next_point"] == point
    view.receive(fix_at(mirror, view.points[0], 0.0), 1.2)
    assert view.news(1.2)["mission"]["next_point"] == "1-2-8"
    view.receive(mission(point="", outcome="stopped"), 1.3)
    assert view.news(1.3)["mission"]["next_point"] == ""


def test_a_point_is_arrived_at_then_measured(view: SurveyView, mirror: Mirror) -> None:
    point = view.points[0]
    arrival = ArrivalMessage(seq=9, t_s=1.0, point=(point.row, point.col, point.point), error_mm=0.3)
    view.receive(arrival, 1.0)
    assert view.news(1.0)["points"] == [[0, ARRIVED, None]]
    view.receive(fix_at(mirror, point, 0.004), 2.0)
    state = view.news(2.0)
    # The foot lies 4 mm ahead on the deck, and a little more along the slope.
    assert state["points"] == [[0, MEASURED, pytest.approx(4.0, abs=0.3)]]
    assert state["series"]["arrival"] == [(2.0, state["points"][0][2])]
    assert state["series"]["jump"] == [(2.0, 0.7)]
    view.receive(arrival, 2.2)
    assert view.news(2.2)["points"] == []  # measured stays measured


@pytest.mark.parametrize(
    ("is_point", "changes", "points", "series"),
    [
        pytest.param(True, {"is_fused": False}, [], set(), id="refused"),
        pytest.param(False, {}, [], {"jump"}, id="finds the robot only"),
        pytest.param(True, {"position_m": (1e3, 1e3, 1e3)}, [[0, MEASURED, None]], {"jump"}, id="far from the mirror"),
    ],
)
def test_fixes_that_are_no_measurements(
    view: SurveyView, mirror: Mirror, is_point: bool, changes: dict[str, Any], points: list[Any], series: set[str]
) -> None:
    fix = fix_at(mirror, view.points[0] if is_point else None, 0.0)
    view.receive(msgspec.structs.replace(fix, **changes), 2.0)
    state = view.news(2.0)
    assert (state["points"], set(state["series"])) == (points, series)


def test_points_left_out(view: SurveyView, mirror: Mirror) -> None:
    view.receive(fix_at(mirror, view.points[1], 0.0), 2.0)
    names = [f"{p.row}-{p.col}-{p.point}" for p in view.points[:2]]
    view.receive(mission(left_out={"no fix": names, "other": ["99-9-9"]}), 2.0)
    news = view.news(2.0)
    assert [row[:2] for row in news["points"]] == [[0, SKIPPED], [1, MEASURED]]
    assert news["mission"]["not_to_be_measured"] == 3


def test_the_path_as_it_is_driven_and_in_simulation_against_the_truth(
    view: SurveyView, mirror: Mirror, cfg: Config
) -> None:
    view.is_tracking = True
    rows, truths = [], []
    for k in range(300):
        rows.append((k, 0.01 * k, 1, 2, -0.1 + 0.001 * k, 0.05, 0.0, 0.001))
        deck = mirror.deck_pose(PanelPose(PanelId(1, 2), rows[-1][4], 0.05, 0.0))
        truths.append((k, 0.01 * k, deck.x_m + 0.002, deck.y_m, 0.0, 0.0, 0.0, 0.0, 1.0, 0, 0))
    track = TrackMessage(seq=299, t_s=3.0, rows=rows)
    view.receive(track, 3.0)
    view.receive(TruthMessage(seq=299, t_s=3.0, rows=truths), 3.0)
    state = encoded(view.news(3.0))
    path = np.array(state["path"])
    assert hypot(*(path[-1] - path[0])) == pytest.approx(0.28, abs=0.01)
    assert [[round(value, 3) for value in row[1:]] for row in state["series"]["error"]] == [[2.0, 3.0], [2.0, 3.0]]
    blind = SurveyView(mirror, cfg, is_sim=False)  # without a truth sigma alone is shown
    blind.receive(track, 3.0)
    assert blind.news(3.0)["series"]["error"] == [(0.0, None, 3.0), (1.0, None, 3.0), (2.0, None, 3.0)]


def test_innovations_are_told_when_they_change(view: SurveyView) -> None:
    for t_s, nis in ((1.0, 2.0), (1.1, 2.0), (1.2, 3.5)):
        view.receive(picture(t_s, nis=nis), t_s)
    assert view.news(1.2)["series"]["nis"] == [(1.0, 2.0, 2), (1.2, 3.5, 2)]


def test_the_verdict_and_its_cause(view: SurveyView) -> None:
    verdict = Verdict(
        seq=4, t_s=1.0, code=EventCode.NEAR_EDGE, cause="edge", signal="front_left", value=0.006, limit=0.005,
        forward=False, reverse=True, turn=False, off=(True, False, False, False), severity=Severity.NONE,
    )  # fmt: skip
    view.receive(verdict, 1.0)
    shown = encoded(view.news(1.5))["verdict"]
    assert shown == json.loads(msgspec.json.encode(verdict)) | {
        "text": "edge (front left): 0.006 (limit 0.005)", "is_stale": False,
    }  # fmt: skip
    assert view.news(2.5)["verdict"]["is_stale"]
    event = DangerEvent(
        seq=4, t_s=1.25, code=2, cause="fire", signal="emergency:fire", value=1.0, limit=0.0, off=(False,) * 4,
        severity=5,
    )  # fmt: skip
    view.receive(event, 1.0)
    state = view.news(1.0)
    assert state["verdict"]["code"] == 2
    assert "forward" not in state["verdict"]
    assert state["log"] == [(1.25, "warning", "danger: fire", 1, 1)]
    view.receive(LogMessage(seq=5, t_s=2.0, level="info", process="main", text="joined"), 2.0)
    assert view.news(2.0)["log"] == [(2.0, "info", "joined", 1, 2)]


def test_other_things_on_the_map(view: SurveyView) -> None:
    assert "shapes" not in view.news(1.0)
    beacon = RobotShape(id="b1", kind="beacon", x_m=1.0, y_m=2.0, covariance_m2=(0.1, 0.0, 0.1), label="b1")
    wall = RobotShape(id="w", kind="obstacle", x_m=0.0, y_m=0.0, outline_m=[(0.0, 0.0), (1.0, 0.0), (0.0, 0.0)])
    view.receive(Scene(seq=1, t_s=1.0, shapes=[beacon, wall]), 1.0)
    shapes = encoded(view.news(1.0))["shapes"]
    place = {"x_m": 1.0, "y_m": 2.0, "covariance_m2": [0.1, 0.0, 0.1]}
    assert shapes[0] == {"id": "b1", "kind": "beacon", "label": "b1"} | place
    assert shapes[1]["outline_m"] == [[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]
    assert "shapes" not in view.news(1.1)  # nothing new
    assert len(view.everything(1.1)["shapes"]) == 2


def test_everything_is_the_sum_of_the_news_and_stops_are_the_path_where_nobody_looked(
    view: SurveyView, mirror: Mirror
) -> None:
    points: dict[int, list[Any]] = {}
    path: list[Any] = []
    arrivals: list[Any] = []
    for k in range(6):
        view.is_tracking = k == 5
        view.receive(fix_at(mirror, view.points[k], 0.001 * k, t_s=float(k)), float(k))
        news = view.news(float(k))
        points |= {row[0]: row for row in news["points"]}
        path += news["path"]
        arrivals += news["series"]["arrival"]
    everything = view.everything(6.0)
    assert everything["points"] == list(points.values())
    assert everything["path"] == path
    assert len(path) == 5
    assert everything["series"]["arrival"] == arrivals


def test_what_was_measured_before_is_there(view: SurveyView, mirror: Mirror) -> None:
    fixes = [fix_at(mirror, view.points[k], 0.001, t_s=10.0 - k) for k in range(3)]
    measured = [(view.points[k], fix.t_s, fix.position_m) for k, fix in enumerate(fixes)]
    elsewhere = (PointId(5, 5, 5), 1.0, fixes[0].position_m)
    view.begin_with([*measured, elsewhere], [view.points[4], PointId(5, 5, 6)])
    everything = view.everything(0.0)
    assert [row[:2] for row in everything["points"]] == [[0, MEASURED], [1, MEASURED], [2, MEASURED], [4, SKIPPED]]
    assert [row[0] for row in everything["series"]["arrival"]] == [8.0, 9.0, 10.0]


def test_the_ground(mirror: Mirror, cfg: Config) -> None:
    told = encoded(ground(mirror, cfg, is_sim=True, needs_token=False))
    assert (told["title"], told["is_sim"]) == ("fyst-m1", True)
    assert (len(told["panels"]), len(told["points"]), told["points"][0][0]) == (77, 18, "1-2-7")
    assert len(told["rim"]) > 4
