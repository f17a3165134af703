"""Tests of the views of a run: what they say agrees with the messages that they are of."""

import json
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ccatp.config.load import load_config
from ccatp.core import PanelId, PanelPose, PointId
from ccatp.links.topics import FixMessage, LogMessage, Message, SensorLines, TrackMessage, TruthMessage
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.report.foxglove import POINTS_AGAIN_S, ViewMessage, Views

PUCK_M = 0.05


@pytest.fixture(scope="module")
def mirror() -> Mirror:
    return build_mirror(load_config().mirror)


@pytest.fixture
def views(mirror: Mirror) -> Views:
    made = Views(mirror, PUCK_M)
    assert [shown.topic for shown in made.begin()] == ["view/frames", "view/panels"]
    return made


def shown(views: Views, message: Message) -> dict[str, list[dict[str, Any]]]:
    found: dict[str, list[dict[str, Any]]] = {}
    for one in views.of(message):
        assert isinstance(one, ViewMessage)
        found.setdefault(one.topic, []).append(json.loads(one.payload))
    return found


def track(*rows: tuple[int, float, int, int, float, float, float, float]) -> TrackMessage:
    return TrackMessage(seq=rows[-1][0], t_s=rows[-1][1], rows=list(rows))


def test_every_tenth_pose_is_shown_on_the_deck(views: Views, mirror: Mirror) -> None:
    found = shown(views, track(*((seq, seq / 100, 3, 4, 0.1, -0.2, 0.5, 0.001) for seq in range(95, 115))))
    robots = found["view/robot"]
    assert [r["seq"] for r in robots] == [100, 110]
    pose = mirror.deck_pose(PanelPose(PanelId(3, 4), 0.1, -0.2, 0.5))
    assert [robots[0][k] for k in ("x_m", "y_m", "heading_rad")] == pytest.approx(
        [pose.x_m, pose.y_m, pose.heading_rad]
    )
    assert robots[0]["sigma_m"] == 0.001
    shown_pose = found["view/pose"][0]["pose"]
    where = [shown_pose["position"][k] for k in "xyz"]
    assert where == pytest.approx(mirror.surface_point(pose.x_m, pose.y_m))
    turn = Rotation.from_quat([shown_pose["orientation"][k] for k in "xyzw"])
    assert pytest.approx(np.array(mirror.robot_axes(pose))) == turn.as_matrix().T
    frame = found["view/robot_frame"][0]
    assert (frame["parent_frame_id"], frame["child_frame_id"]) == ("deck", "robot")
    assert frame["translation"] == shown_pose["position"]


def test_the_deck_stands_in_the_world(mirror: Mirror) -> None:
    frame = json.loads(next(iter(Views(mirror, PUCK_M).begin())).payload)
    turn = Rotation.from_quat([frame["rotation"][k] for k in "xyzw"])
    shift = np.array([frame["translation"][k] for k in "xyz"])
    assert turn.apply([0.3, -0.4, 0.5]) + shift == pytest.approx(mirror.world_from_deck((0.3, -0.4, 0.5)))


@pytest.mark.parametrize("truth_first", [True, False])
def test_the_error_is_that_of_the_same_frame(views: Views, mirror: Mirror, truth_first: bool) -> None:
    pose = mirror.deck_pose(PanelPose(PanelId(3, 4), 0.0, 0.0, 0.0))
    row = (100, 1.0, pose.x_m, pose.y_m, pose.heading_rad, 0.0, 0.0, 0.0, 0.1, 0, 0)
    truth = TruthMessage(seq=100, t_s=1.0, rows=[row])
    estimate = track((100, 1.0, 3, 4, 0.003, 0.004, 0.01, 0.001))
    first, second = (truth, estimate) if truth_first else (estimate, truth)
    assert "view/error" not in shown(views, first)
    (error,) = shown(views, second)["view/error"]
    assert error["position_mm"] == pytest.approx(5.0, rel=1e-3)  # the deck's plane is inclined to the panel's
    assert error["heading_mrad"] == pytest.approx(10.0, abs=1e-3)
    assert "view/error" not in shown(views, second)  # told once


def test_sensors_hold_what_the_frame_holds(views: Views) -> None:
    line = {
        "type": "sensors", "seq": 7, "t": 0.07, "imu": [], "enc": [[0.06, 1.0, 2.0], [0.07, 3.0, 4.0]],
        "edge": [[0.07, 1, 0, 1, 1]], "gravity": None, "fans": [0.8, 0.7], "soc": 0.5,
        "cmd": {"seq": 6, "age": 0.01, "permit_age": None, "held": True}, "faults": [],
    }  # fmt: skip
    lines = [msgspec.Raw(json.dumps(line).encode()), msgspec.Raw(b'{"type":"sensors"}')]
    (view,) = shown(views, SensorLines(seq=7, t_s=0.07, lines=lines))["view/sensors"]
    assert view == {
        "t_s": 0.07, "seq": 7, "wheel_right_rad_s": 3.0, "wheel_left_rad_s": 4.0, "edge_front_left": 1,
        "edge_front_right": 0, "edge_rear_left": 1, "edge_rear_right": 1, "fan_left": 0.8, "fan_right": 0.7,
        "battery": 0.5, "drive_age_s": 0.01, "held": True,
    }  # fmt: skip
    broken = SensorLines(seq=8, t_s=0.08, lines=[msgspec.Raw(b'{"type":"sensors"}')])
    assert shown(views, broken) == {}


def fix(mirror: Mirror, point: PointId, t_s: float, lift_m: float) -> FixMessage:
    x, y = mirror.point_on_deck(point)
    normal = mirror.surface.normal(x, y)
    on_deck = [a + (PUCK_M + lift_m) * n for a, n in zip(mirror.surface_point(x, y), normal, strict=True)]
    return FixMessage(
        seq=1, t_s=t_s, point=(point.row, point.col, point.point), is_fused=True,
        position_m=mirror.world_from_deck((on_deck[0], on_deck[1], on_deck[2])),
        covariance_m2=[0.0] * 9, dop=1.0, residual_rms_m=0.0, channels=[1], jump_mm=0.0,
    )  # fmt: skip


def test_a_fix_colours_its_point_and_all_points_come_again(views: Views, mirror: Mirror) -> None:
    (first,) = shown(views, fix(mirror, PointId(2, 3, 5), 1.0, 1e-4))["view/points"]
    (entity,) = first["entities"]
    assert entity["id"] == "points 2-3"
    assert entity["metadata"] == [{"key": "point 5", "value": "100.0 um"}]
    (second,) = shown(views, fix(mirror, PointId(2, 4, 5), 2.0, 0.0))["view/points"]
    assert [e["id"] for e in second["entities"]] == ["points 2-4"]
    (third,) = shown(views, fix(mirror, PointId(2, 5, 5), POINTS_AGAIN_S + 1.0, 0.0))["view/points"]
    assert [e["id"] for e in third["entities"]] == ["points 2-3", "points 2-4", "points 2-5"]


def test_a_fix_that_is_no_measurement_colours_nothing(views: Views, mirror: Mirror) -> None:
    message = fix(mirror, PointId(2, 3, 5), 1.0, 0.0)
    message.is_fused = False
    assert shown(views, message) == {}


def test_a_line_for_the_operator_becomes_a_log(views: Views) -> None:
    message = LogMessage(seq=1, t_s=2.25, level="warning", process="main", text="held")
    (log,) = shown(views, message)["view/log"]
    assert log["timestamp"] == {"sec": 2, "nsec": 250_000_000}
    assert (log["level"], log["name"], log["message"]) == (3, "main", "held")


def test_a_run_that_was_not_begun_begins_with_its_first_message(mirror: Mirror) -> None:
    message = LogMessage(seq=1, t_s=2.0, level="info", process="main", text="x")
    assert list(shown(Views(mirror, PUCK_M), message)) == ["view/frames", "view/panels", "view/log"]
