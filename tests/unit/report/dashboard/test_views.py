"""The state of the pages of surveys and of missions among beacons, from messages in virtual time."""

import json
from collections.abc import Callable
from concurrent.futures import Executor, Future
from math import hypot
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from ccatp.beacons.config.load import load_radio_config
from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.links.topics import BeaconArrival, BeaconMapMessage, BeaconPlaces, BeaconTrack, BeaconTruth
from ccatp.beacons.mission import MODES
from ccatp.beacons.report.dashboard.view import BeaconView, beacon_ground
from ccatp.config.models import Config
from ccatp.core import Cause, DeckPose, EventCode, Fix, Measured, PanelId, PanelPose, PointId, Severity, Verdict
from ccatp.errors import ConfigError
from ccatp.links.topics import (
    Alarm,
    ArrivalMessage,
    DangerEvent,
    FixMessage,
    RobotShape,
    Scene,
    TrackMessage,
    TruthMessage,
)
from ccatp.records.recorder import Recorder
from ccatp.records.store import StoredPoint, StoredSurvey
from ccatp.report.dashboard import network_watch
from ccatp.report.dashboard.access import CommandRefusal, check_command, host_refusal, make_token, page_tokens
from ccatp.report.dashboard.app import STATIC
from ccatp.report.dashboard.history import replay
from ccatp.report.dashboard.survey_view import SurveyView
from ccatp.report.dashboard.survey_view import ground as survey_ground
from ccatp.report.dashboard.view import ARRIVED, MEASURED, PLANNED, SKIPPED, RunStateView
from tests.support.page_rig import mission, picture
from tests.support.scenario import config_of, mirror_of

LINE = (
    b'{"type":"sensors","seq":5,"t":1.5,"imu":[],"enc":[],"edge":[[1.4,1,1,1,1],[1.5,1,0,1,1]],"gravity":null,'
    b'"fans":[0.8,0.7],"soc":0.93,"cmd":{"seq":4,"age":0.012,"permit_age":0.008,"held":false},"faults":["stall"]}'
)
CFG, MIRROR = config_of(run__panels=2), mirror_of()


@pytest.fixture
def view() -> SurveyView:
    return SurveyView(MIRROR, CFG, is_sim=True)


BEGUN = mission(t_s=0.0)  # the mission's time is the robot's


def fix_at(point: PointId | None, ahead_m: float, t_s: float = 2.0) -> FixMessage:
    x_m, y_m = MIRROR.point_on_deck(point or PointId(1, 2, 1))
    world = MIRROR.puck_world(DeckPose(x_m + ahead_m, y_m, 0.0), 0.05)
    return FixMessage(
        seq=9, t_s=t_s, point=point, is_fused=True, position_m=world, covariance_m2=[0.0] * 9, dop=1.0,
        residual_rms_m=1e-6, channels=[1, 2, 3, 4], jump_mm=0.7,
    )  # fmt: skip


def reported(view: RunStateView, *messages: Any, now_s: float = 1.0) -> dict[str, Any]:
    """What is new after these messages, as a page gets it."""
    for message in messages:
        view.receive(message, now_s)
    state: dict[str, Any] = json.loads(msgspec.json.encode(view.news(now_s)))
    return state


def test_levels_are_there_each_time(view: SurveyView) -> None:
    state = reported(view)
    assert state["mission"] is state["pose"] is state["verdict"] is state["robot"] is None
    assert state["points"] == state["path"] == state["log"] == []
    assert state["is_sim"] is True
    assert reported(view, mission(), picture(15, LINE))["pose"] is None  # a sample for the history
    view.is_watched = True
    reported(view, picture(15, LINE))
    for now_s in (1.1, 1.9):
        state = reported(view, now_s=now_s)
        assert (state["mission"]["state"], state["pose"]["x_m"]) == ("driving", 1.0)
        assert state["mission"]["is_stale"] is False
        assert state["robot"] == {
            "edges": [1, 0, 1, 1], "fans": [0.8, 0.7], "charge": 0.93, "drive_age_s": 0.012, "permit_age_s": 0.008,
            "is_held": False, "faults": ["stall"],
        }  # fmt: skip
    assert reported(view, now_s=2.1)["mission"]["is_stale"]
    state = reported(view, picture(15))  # before the first frame
    assert (state["robot"], state["pose"] is None) == (None, False)
    view.discard_picture()
    assert reported(view)["pose"] is None
    assert view.everything(1.0)["series"]["nis"] == [(0.5, 2.0, 2)]  # of the same update
    reported(view, mission(exit_status=0))
    assert (reported(view, now_s=9.0)["is_over"], reported(view, now_s=9.0)["mission"]["is_stale"]) == (True, False)


def test_the_next_point_is_known_on_the_way_to_other_stops_too(view: SurveyView) -> None:
    for message, point in (
        (mission(point="1-2-9"), "1-2-9"),
        (mission(), "1-2-7"),
        (fix_at(view.points[0], 0.0), "1-2-8"),
        (mission(outcome="stopped"), ""),
    ):
        assert reported(view, message)["mission"]["next_point"] == point


def fixes_with_lengths(view: SurveyView, slipped_m: float) -> list[FixMessage]:
    """Of all points of the view; the lengths of the first channel are too long by ``slipped_m``."""
    rng, found = np.random.default_rng(3), []
    for k, point in enumerate(view.points):
        fix = fix_at(point, 0.0, 60.0 * k)
        lengths = np.linalg.norm(np.array(fix.position_m) - MIRROR.collimators_m, axis=1)
        lengths += 2e-6 * rng.normal(size=len(lengths))
        lengths[0] += slipped_m
        found.append(
            msgspec.structs.replace(fix, channels=[*MIRROR.channels], lengths_m=lengths.tolist(), metrology="good")
        )
    return found


class AtOnce(Executor):
    """Computes where it is asked, in place of a thread."""

    def __init__(self, *_: Any) -> None: ...

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done = Future[Any]()
        done.set_result(fn(*args, **kwargs))
        return done


@pytest.mark.parametrize(
    ("slipped_m", "text"),
    [(0.0, "The laser network is consistent: "), (1e-3, f"channel {MIRROR.channels[0]} reads ")],
)
def test_the_page_says_whether_the_laser_network_is_consistent(
    slipped_m: float, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(network_watch, "ThreadPoolExecutor", AtOnce)
    view = SurveyView(MIRROR, CFG, is_sim=True)
    fixes = fixes_with_lengths(view, slipped_m)
    reported(view, BEGUN, *fixes[:1])
    assert [reported(view)["facts"] for _ in range(2)] == [[], []]  # nobody looks
    view.is_watched = True
    assert reported(view)["facts"] == []  # it begins
    ((name, sentence),) = reported(view)["facts"]
    assert (name, "1 points with 8 lengths are too few" in sentence) == ("laser network", True)
    reported(view, *fixes[1:])
    ((_, sentence),) = reported(view)["facts"]
    assert text in sentence


def test_a_point_from_arrival_to_measured(view: SurveyView) -> None:
    point = view.points[0]
    arrived = ArrivalMessage(seq=8, t_s=2.0, point=(point.row, point.col, point.point), error_mm=0.3)
    assert reported(view, arrived)["points"] == [[0, ARRIVED, None]]
    state = reported(view, BEGUN, fix_at(point, 0.004))
    # The foot lies 4 mm ahead on the deck, and a little more along the slope.
    assert state["points"] == [[0, MEASURED, pytest.approx(4.0, abs=0.3)]]
    assert state["series"] == {"arrival": [[2.0, state["points"][0][2]]], "jump": [[2.0, 0.7]]}
    assert reported(view, arrived)["points"] == []  # measured stays measured


@pytest.mark.parametrize(
    ("is_point", "changes", "points", "series"),
    [
        pytest.param(True, {"is_fused": False}, [], set(), id="refused"),
        pytest.param(False, {}, [], {"jump"}, id="finds the robot only"),
        pytest.param(True, {"position_m": (1e3, 1e3, 1e3)}, [[0, MEASURED, None]], {"jump"}, id="far from the mirror"),
    ],
)
def test_fixes_that_are_no_measurements(
    view: SurveyView, is_point: bool, changes: dict[str, Any], points: list[Any], series: set[str]
) -> None:
    fix = fix_at(view.points[0] if is_point else None, 0.0)
    state = reported(view, BEGUN, msgspec.structs.replace(fix, **changes))
    assert (state["points"], set(state["series"])) == (points, series)


def test_points_left_out(view: SurveyView) -> None:
    names = [f"{p.row}-{p.col}-{p.point}" for p in view.points[:2]]
    news = reported(view, fix_at(view.points[1], 0.0), mission(left_out={"no fix": names, "other": ["99-9-9"]}))
    assert [row[:2] for row in news["points"]] == [[0, SKIPPED], [1, MEASURED]]
    assert news["mission"]["not_to_be_measured"] == 3


def test_the_path_as_it_is_driven_and_in_simulation_against_the_truth(view: SurveyView) -> None:
    rows, truths = [], []
    for k in range(300):
        rows.append((k, 0.01 * k, 1, 2, -0.1 + 0.001 * k, 0.05, 0.0, 0.001))
        deck = MIRROR.deck_pose(PanelPose(PanelId(1, 2), rows[-1][4], 0.05, 0.0))
        truths.append((k, 0.01 * k, deck.x_m + 0.002, deck.y_m, 0.0, 0.0, 0.0, 0.0, 1.0, 0, 0))
    track = TrackMessage(seq=299, t_s=3.0, rows=rows)
    assert reported(view, track)["path"] == []  # when in the mission is not known
    state = reported(view, BEGUN, track, TruthMessage(seq=299, t_s=3.0, rows=truths))
    path = np.array(state["path"])
    assert hypot(*(path[-1] - path[0])[1:]) == pytest.approx(0.28, abs=0.01)
    assert path[-1][0] == pytest.approx(2.8, abs=0.2)
    assert [[round(value, 3) for value in row[1:]] for row in state["series"]["error"]] == [[2.0, 3.0], [2.0, 3.0]]
    blind = SurveyView(MIRROR, CFG, is_sim=False)  # without a truth sigma alone is shown
    assert reported(blind, BEGUN, track)["series"]["error"] == [[0.0, None, 3.0], [1.0, None, 3.0], [2.0, None, 3.0]]


def test_the_verdict_and_its_cause(view: SurveyView) -> None:
    verdict = Verdict(
        seq=4, t_s=1.0, code=EventCode.NEAR_EDGE, cause=Cause("no_seam"), signal="front_left", value=0.006, limit=0.005,
        forward=False, reverse=True, turn=False, off=(True, False, False, False), severity=Severity.NONE,
    )  # fmt: skip
    text = "off the panel where the map has no seam"
    more = {"cause": text, "condition": "no_seam", "is_stale": False}
    more["text"] = f"{text} (front left): 0.006 m (limit 0.005 m)"
    assert reported(view, verdict)["verdict"] == json.loads(msgspec.json.encode(verdict)) | more
    assert reported(view, now_s=2.5)["verdict"]["is_stale"]
    event = DangerEvent(
        seq=4, t_s=1.25, code=2, cause="fire", signal="emergency:fire", value=1.0, limit=0.0, off=(False,) * 4,
        severity=5,
    )  # fmt: skip
    state = reported(view, event)
    assert (state["verdict"]["code"], "forward" in state["verdict"]) == (2, False)


def test_the_alarms_are_those_of_the_status_also_after_the_end(view: SurveyView) -> None:
    assert reported(view)["alarms"] == []
    alarm = Alarm(
        name="no_way_on", severity="fault", cause="no way on: rim", advice="carry it", since="now", since_s=1.0
    )
    state = reported(view, mission(state="held", alarms=[alarm]))
    assert state["alarms"] == [msgspec.to_builtins(alarm)]
    assert "alarms" not in state["mission"]
    ended = reported(view, mission(alarms=[alarm], exit_status=4))
    assert (ended["is_over"], ended["alarms"]) == (True, [msgspec.to_builtins(alarm)])


def test_other_things_on_the_map(view: SurveyView) -> None:
    assert "shapes" not in reported(view)
    beacon = RobotShape(id="b1", kind="landmark", x_m=1.0, y_m=2.0, covariance_m2=(0.1, 0.0, 0.1), label="b1")
    wall = RobotShape(id="w", kind="obstacle", x_m=0.0, y_m=0.0, outline_m=[(0.0, 0.0), (1.0, 0.0), (0.0, 0.0)])
    shapes = reported(view, Scene(seq=1, t_s=1.0, shapes=[beacon, wall]))["shapes"]
    place = {"x_m": 1.0, "y_m": 2.0, "covariance_m2": [0.1, 0.0, 0.1]}
    assert shapes[0] == {"id": "b1", "kind": "landmark", "label": "b1"} | place
    assert shapes[1]["outline_m"] == [[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]
    assert "shapes" not in reported(view)  # nothing new
    assert len(view.everything(1.1)["shapes"]) == 2


def track_row(seq: int, t_s: float, x_m: float) -> Any:
    return seq, t_s, 1, 2, x_m, 0.05, 0.0, 0.001


def test_everything_is_the_sum_of_the_news_and_no_path_is_drawn_where_nothing_is_known(view: SurveyView) -> None:
    points, path, arrivals = dict[int, Any](), list[Any](), list[Any]()
    for k in range(6):
        t_s = float(k) if k < 4 else 60.0 + k  # a minute without a word
        track = TrackMessage(seq=10 * k, t_s=t_s, rows=[track_row(10 * k, t_s, 0.05 * k)])
        news = reported(view, BEGUN, fix_at(view.points[k], 0.001 * k, t_s=t_s), track)
        points |= {row[0]: row for row in news["points"]}
        path += news["path"]
        arrivals += news["series"]["arrival"]
    everything = json.loads(msgspec.json.encode(view.everything(6.0)))
    assert (everything["points"], everything["path"]) == (list(points.values()), path)
    assert [row[0] for row in path if row[1] is None] == [64.0]
    assert len(path) == 7
    assert everything["series"]["arrival"] == arrivals


def test_the_time_of_the_mission_continues_when_the_clock_of_the_robot_begins_again(view: SurveyView) -> None:
    reported(view, mission(t_s=100.0, elapsed_s=90.0), fix_at(view.points[0], 0.001, t_s=101.0))
    reported(view, mission(t_s=1.0, elapsed_s=95.0), fix_at(view.points[1], 0.001, t_s=2.0))
    assert [row[0] for row in view.everything(0.0)["series"]["arrival"]] == [91.0, 96.0]


def test_when_the_mission_ends_at_its_pace(view: SurveyView) -> None:
    def finish_in_s(now_s: float, **fields: Any) -> float | None:
        found: float | None = reported(view, mission(**fields), now_s=now_s)["mission"]["finish_in_s"]
        return found

    assert finish_in_s(0.0, elapsed_s=0.0, eta_s=100.0) is None  # it has not begun
    assert finish_in_s(1.0, elapsed_s=20.0, eta_s=100.0) == 100.0
    assert finish_in_s(21.0, elapsed_s=60.0, eta_s=100.0) == 50.0  # simulated twice as fast as the wall clock
    assert finish_in_s(22.0, elapsed_s=60.0, eta_s=100.0, outcome="stopped") is None


def test_a_hold_by_an_operator_is_distinguished_from_one_by_a_fault(view: SurveyView) -> None:
    for condition, is_by_operator in (("operator", True), ("no_way_on", False), ("", False)):
        status = mission(state="held", cause="operator", condition=condition)
        assert reported(view, status)["mission"]["is_by_operator"] is is_by_operator


def test_messages_and_emergencies_are_those_of_the_run_directory(tmp_path: Path) -> None:
    view = SurveyView(MIRROR, CFG, is_sim=True, run_dir=tmp_path)
    view.read_files()  # nothing is there yet
    begun = {"logger": "supervisor", "event": "run_started", "timestamp": "2026-11-26T03:31:20.311243Z"}
    said = {"event": "operator_message", "level": "error", "timestamp": "2026-11-26T03:32:00.5Z", "text": "a line"}
    edge = {"event": "verdict_changed", "level": "info", "timestamp": "2026-11-26T03:33:00Z", "cause": "edge",
            "signal": "front_left", "value": 0.006, "limit": 0.005}  # fmt: skip
    text = "".join(f"{json.dumps(line)}\n" for line in (begun, said, edge, edge | {"cause": ""}))
    (tmp_path / "log.jsonl").write_text(text[:-20])
    (tmp_path / "emergencies.json").write_text('{"active": [{"kind": "fire", "id": "7", "note": ""}], "cleared": []}')
    view.read_files()
    state = reported(view)
    fire = {"kind": "fire", "id": "7", "note": "", "alarm": "emergency"}
    assert (state["started"], state["emergencies"]) == (begun["timestamp"], [fire])
    assert state["log"] == [
        ["2026-11-26T03:32:00.5Z", "error", "a line", 1, 1],
        ["2026-11-26T03:33:00Z", "warning", "danger: edge (front left): 0.006 (limit 0.005)", 1, 2],
    ]
    with (tmp_path / "log.jsonl").open("a") as log:  # the rest of the line, and damage
        log.write(text[-20:] + 'x"operator_message"\n' + json.dumps(said | {"text": "another"}) + "\n")
    view.read_files()
    assert [row[2] for row in reported(view)["log"]] == ["another"]
    view.close()


async def test_plots_and_path_of_a_dashboard_that_came_late_are_read_from_the_recording(
    view: SurveyView, tmp_path: Path
) -> None:
    names = ("mission", "track", "fix", "log")
    recorder = Recorder(tmp_path / "telemetry.mcap", [(name, {}) for name in names], is_simulation=True)
    for k in range(8):
        track = TrackMessage(seq=10 * k, t_s=float(k), rows=[track_row(10 * k, float(k), 0.05 * k)])
        for name, message in (("mission", BEGUN), ("track", track), ("fix", fix_at(view.points[k], 0.001, float(k)))):
            recorder.write(name, float(k), msgspec.json.encode(message))
    recorder.close()
    reported(view, BEGUN, fix_at(view.points[8], 0.001, 6.5))  # and from here on it listens
    past = SurveyView(MIRROR, CFG, is_sim=True)
    paths = [tmp_path / "missing.mcap", tmp_path / "telemetry.mcap"]
    await replay(paths, ("mission", "track", "fix"), lambda message: past.receive(message, 0.0))
    view.prepend(past)
    state = view.everything(0.0)
    assert [row[0] for row in state["series"]["arrival"]] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 6.5]
    assert [row[0] for row in state["path"]] == [float(k) for k in range(8)]


def test_the_last_fix_and_the_limits_that_go_with_what_is_shown(view: SurveyView) -> None:
    state = reported(view, fix_at(view.points[0], 0.001))
    assert state["laser"] == {"dop": 1.0, "residual_um": 1.0, "channels": [1, 2, 3, 4], "is_used": True, "age_s": 0.0}
    cfg = config_of(health__battery_reserve=0.31, etalon__max_dop=17.0, mission__arrival_tolerance_m=0.012)
    ground = survey_ground(MIRROR, cfg, is_sim=True)
    assert (ground["limits"]["charge"], ground["limits"]["dop"]) == (0.31, 17.0)
    assert ground["plots"]["arrival"] == [[12.0, "limit"]]
    assert ground["limits"]["fan_share"] is None  # nothing depends on them on a mirror that lies flat
    hanging = survey_ground(mirror_of("fyst-m2"), config_of("fyst-m2", health__fan_share=0.7), is_sim=True)
    assert hanging["limits"]["fan_share"] == 0.7


def test_what_was_measured_before_is_there(view: SurveyView) -> None:
    fixes = [fix_at(view.points[k], 0.001, t_s=10.0 - k) for k in range(3)]
    points = [*view.points[:3], PointId(5, 5, 5)]
    measured = [
        Measured(point, Fix(fix.t_s, fix.position_m, (0.0,) * 9, 1.0, (), 0.0))
        for point, fix in zip(points, [*fixes, fixes[0]], strict=True)
    ]
    skipped = [StoredPoint(point, 0.0, 0.0, "skipped") for point in (view.points[4], PointId(5, 5, 6))]
    view.begin_with(StoredSurvey(tuple(skipped), tuple(measured), ()))
    everything = view.everything(0.0)
    assert [row[:2] for row in everything["points"]] == [[0, MEASURED], [1, MEASURED], [2, MEASURED], [4, SKIPPED]]
    assert everything["series"]["arrival"] == []  # when, only the recording says


# -- missions among beacons -------------------------------------------------------------------------------------------

ELLIPSE = (0.8, 0.8, 4e-4, 0.0, 4e-4)


def radio(system: str = "zigbee", **keys: object) -> RadioConfig:
    return load_radio_config(None, {"system": system, **keys})


@pytest.fixture
def room() -> BeaconView:
    view = BeaconView(radio(), is_sim=True)
    view.receive(BEGUN, 0.0)
    return view


def told_map(t_s: float = 1.0, **fields: Any) -> BeaconMapMessage:
    known: dict[str, Any] = {
        "seq": 10, "t_s": t_s, "system": "zigbee", "pose": (0.8, 0.8, 0.0), "pose_ellipse": ELLIPSE,
        "beacons": {"a": (0.3, 0.0, 0.03, 0.0, 0.01), "b": (3.0, 0.4, 0.02, 0.0, 0.02)}, "target": None,
        "obstacles": [], "waypoints": [(0.8, 0.8), (2.2, 0.8)], "next_waypoint": 1, "distances": [1.5, 0.7],
        "nis_sum": 0.0, "nis_size": 0, "refused": 0, "notes": {},
    }  # fmt: skip
    return BeaconMapMessage(**(known | fields))


def test_waypoints_are_done_one_after_the_other_and_anew_in_the_next_lap(room: BeaconView) -> None:
    first, second, again = (
        BeaconArrival(seq=1, t_s=1.0, waypoint=waypoint, lap=lap, place=(0.8, 0.8), estimate=ELLIPSE)
        for waypoint, lap in ((0, 0), (1, 0), (0, 1))
    )
    assert reported(room, first, second)["points"] == [[0, MEASURED, None], [1, MEASURED, None]]
    assert reported(room)["points"] == []
    assert reported(room, again)["points"] == [[0, MEASURED, None], *([k, PLANNED, None] for k in (1, 2, 3))]
    assert room.everything(0.0)["points"] == [[0, MEASURED, None]]


def test_the_map_against_what_is_expected_and_what_is_true(room: BeaconView) -> None:
    places = BeaconPlaces(seq=0, t_s=0.0, places={"a": (0.0, 0.0), "b": (3.0, 0.0)})
    series = reported(room, places, told_map(), told_map(1.5, nis_sum=6.0, nis_size=4, refused=2))["series"]
    # Root mean squares of 0.3 and 0.4 m, and of variances of 0.04 for each place, in mm.
    assert series["map"] == [[1.5, pytest.approx(353.55), pytest.approx(200.0)]]
    assert (series["nis"], series["clearance"]) == ([[1.5, 6.0, 4]], [[1.5, 0.7]])
    assert reported(room, told_map(2.0, nis_sum=7.0, nis_size=6, refused=2))["series"]["nis"] == [[2.0, 1.0, 2]]
    assert "nis" not in reported(room, told_map(2.5))["series"]  # of another main loop: it begins anew


def test_facts(room: BeaconView) -> None:
    assert reported(room)["facts"] == []
    assert dict(reported(room, told_map(nis_sum=6.0, nis_size=4, used=3, refused=2))["facts"]) == {
        "beacons on the map": "2", "error of the map, expected": "200.0 mm", "readings used, refused": "3, 2",
        "mean NIS": "1.50", "to the waypoint": "1.40 m", "lap": "1 of 2",
    }  # fmt: skip


def test_a_target_is_followed() -> None:
    target = (1.8, 0.8, 0.01, 0.0, 0.01)
    known: dict[str, Any] = {"target": target, "beacons": {"target": target}, "waypoints": [], "next_waypoint": -1}
    state = reported(BeaconView(radio("follow"), is_sim=True), BEGUN, *(told_map(t_s, **known) for t_s in (1.0, 1.5)))
    assert state["series"]["target"] == [[1.5, 1.0, 0.6]]
    assert "map" not in state["series"]  # the one that moves is none of the map
    assert dict(state["facts"])["distance to the target"] == "1.00 m"


def test_the_error_against_the_truth_is_the_worst_of_each_second(room: BeaconView) -> None:
    rows: Any = [(k, 0.1 * k, 1.0, 2.0, 0.0, 4e-4, 0.0, 1e-4, 0.0, 0.0, 1e-4, 1.0, 2.0) for k in (10, 15, 20)]
    true: Any = [(k, 0.1 * k, 1.0, 2.01, 0.0, None, None, None) for k in (10, 15, 20)]
    state = reported(room, BeaconTrack(seq=20, t_s=2.0, rows=rows), BeaconTruth(seq=20, t_s=2.0, rows=true))
    assert state["series"]["error"] == [[1.0, pytest.approx(10.0), pytest.approx(60.0)]]


def test_the_scene_without_what_the_page_draws_itself(room: BeaconView) -> None:
    kinds = ("robot", "trail", "waypoint", "landmark", "obstacle")
    scene = Scene(seq=1, t_s=1.0, shapes=[RobotShape(kind, kind, 1.0, 1.0) for kind in kinds])
    state = reported(room, BeaconPlaces(seq=0, t_s=0.0, places={"a": (0.0, 1.0)}), scene)
    assert [shape["kind"] for shape in state["shapes"]] == ["true", "landmark", "obstacle"]
    assert state["shapes"][0]["y_m"] == 1.0
    assert [link["name"] for link in state["links"]] == ["main loop", "danger loop", "robot"]  # no laser


@pytest.mark.parametrize("system", ["zigbee", "follow", "cricket"])
def test_the_ground_of_a_room(system: str) -> None:
    cfg, is_following = radio(system), system == "follow"
    found = json.loads(msgspec.json.encode(beacon_ground(cfg, is_sim=True)))
    assert found["rim"][2] == list(cfg.workspace.size_m)
    assert found["states"] == [str(state) for state in MODES]
    names = [] if is_following else [f"waypoint {k + 1}" for k in range(len(cfg.workspace.waypoints_m))]
    assert [point[0] for point in found["points"]] == names
    assert ("target" in found["plots"]) is is_following
    assert found["words"]["unit"] == ("seconds" if is_following else "waypoints")
    page = (STATIC / "index.html").read_text()
    parts = [*found["hides"], *(f"plot-{name}" for name in found["plots"])]
    assert [part for part in parts if f'id="{part}"' not in page] == []


def test_a_page_beyond_this_machine_needs_a_token() -> None:
    with pytest.raises(ConfigError, match=r"dashboard\.host = \"0\.0\.0\.0\" is beyond this machine"):
        radio(**{"dashboard.host": "0.0.0.0"})


# -- who may read and command ------------------------------------------------------------------------------------------


TOKEN = "0123456789abcdef0123456789abcdef"
OURS = ("localhost", "localhost:7080", "LOCALHOST:1", "127.0.0.1:7080", "192.168.1.20", "[::1]:80", "m1.local:80")
# Names that may be bent to our address.
OTHERS = ("evil.example:7080", "localhost.evil.example", "127.0.0.1.evil.example", "m1.local.evil.org")
NONE = (None, "", "a b", "user@localhost", "localhost:x", "localhost/", "[::1", "::1")


@pytest.mark.parametrize("host", [*OURS, *OTHERS, *NONE])
def test_hosts(host: str | None) -> None:
    refusal = host_refusal(host, ["M1.local"])
    if host in OURS:
        assert refusal is None
    elif host in NONE:
        assert refusal == "the Host header is missing or no host"
    else:
        assert str(refusal).endswith("ask by address, or add the name to dashboard.host_names")


HOST = {"host": "127.0.0.1:7080"}
SITE = "sec-fetch-site"


@pytest.mark.parametrize(
    ("headers", "why"),
    [
        ({}, None),
        ({"origin": "http://127.0.0.1:7080", SITE: "same-origin"}, None),
        ({"origin": "https://127.0.0.1:7080"}, None),
        ({SITE: "none"}, None),
        ({"origin": "http://evil.example"}, "commands from pages of http://evil.example are not taken"),
        ({"origin": "null"}, "commands from pages of null are not taken"),
        ({"origin": "http://127.0.0.1:9999"}, "commands from pages of http://127.0.0.1:9999 are not taken"),
        ({"origin": "http://127.0.0.1:7080.evil.org"}, "pages of http://127.0.0.1:7080.evil.org are not taken"),
        ({SITE: "cross-site"}, "commands from pages of other sites (cross-site) are not taken"),
        ({"origin": "http://127.0.0.1:7080", SITE: "same-site"}, "other sites (same-site) are not taken"),
    ],
)
def test_the_own_page_and_programs_command_and_pages_of_others_do_not(headers: dict[str, str], why: str | None) -> None:
    found = check_command(HOST | {"authorization": f"Bearer {TOKEN}"} | headers, {"alice": TOKEN})
    if why is None:
        assert found == "alice"
    else:
        assert isinstance(found, CommandRefusal)
        assert (found.http_status, found.message.endswith(why)) == (403, True)


@pytest.mark.parametrize(
    ("authorization", "why"),
    [
        *((right, None) for right in (f"Bearer {TOKEN}", f"bearer  {TOKEN} ")),
        *((none, "commands need a token") for none in ("", TOKEN, "bearer", f"Basic {TOKEN}")),
        *((f"Bearer {wrong}", "the token is not accepted") for wrong in ("", f"{TOKEN}x", TOKEN[:-1], "é")),
    ],
)
def test_tokens(authorization: str, why: str | None) -> None:
    found = check_command(HOST | {"authorization": authorization}, {"bob": TOKEN[::-1], "alice": TOKEN})
    if why is None:
        assert found == "alice"
    else:
        assert isinstance(found, CommandRefusal)
        assert (found.http_status, found.message.startswith(why)) == (401, True)


@pytest.mark.parametrize(
    ("content", "mode", "why"),
    [
        (f"{TOKEN}\n".encode(), 0o600, {"operator": TOKEN}),
        (f"# who\n\nalice {TOKEN}\nbob\t{TOKEN[::-1]}\r\n".encode(), 0o600, {"alice": TOKEN, "bob": TOKEN[::-1]}),
        (None, 0, r"dashboard\.token_file: cannot read .*token: No such file or directory; make one with"),
        (TOKEN.encode(), 0o644, r"open to others \(mode 0644\); chmod go= "),
        (b"", 0o600, "holds no token; make one with"),
        (TOKEN[1:].encode(), 0o600, "line 1 of .* at least 32 ASCII characters; make one with"),
        (b"more than two words of more than thirty characters", 0o600, "is not NAME TOKEN, or TOKEN alone"),
        (b"\xff" * 40, 0o600, "at least 32 ASCII characters"),
        (f"alice {TOKEN}\nbob {TOKEN}".encode(), 0o600, "line 2 of .*: name or token stands twice"),
        (f"{TOKEN}\n{TOKEN[::-1]}".encode(), 0o600, "line 2 of .*: name or token stands twice"),
    ],
)
def test_the_file_of_the_tokens(
    config: Config, tmp_path: Path, content: bytes | None, mode: int, why: str | dict[str, str]
) -> None:
    path = tmp_path / "token"
    if content is not None:
        path.write_bytes(content)
        path.chmod(mode)
    cfg = config.dashboard.model_copy(update={"token_file": str(path)})
    if isinstance(why, dict):
        assert page_tokens(cfg, tmp_path) == why
        return
    with pytest.raises(ConfigError, match=why) as refused:
        page_tokens(cfg, tmp_path)
    assert TOKEN[:-1] not in str(refused.value)


def test_a_token_is_made_at_each_start_for_the_own_user_alone(config: Config, tmp_path: Path) -> None:
    path = tmp_path / "dashboard.token"
    path.write_text("of a former start, and open to others")
    path.chmod(0o644)
    first, second = make_token(tmp_path), make_token(tmp_path)
    assert first != second
    assert len(second) == 32
    assert path.stat().st_mode & 0o777 == 0o600
    assert page_tokens(config.dashboard, tmp_path) == {"operator": second}
