"""Parts, database and checkpoint of a main loop: new, resumed, taken over."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from ccatp.config.load import dump_config, load_config
from ccatp.config.models import Config
from ccatp.core import DeckPose, EventCode, Fix, StopKind
from ccatp.daemon.checkpoints import StoreUnusable, build_parts, in_force_of
from ccatp.daemon.process import Endpoints, ProcessArgs
from ccatp.errors import ConfigError
from ccatp.links.robot_messages import Hello, RobotData
from ccatp.mirror.mirror import build_mirror
from ccatp.records.store import MissionStore
from ccatp.survey.composition import SurveyParts
from ccatp.survey.state import Abort, MissionState, Pause, StopHere
from tests.support.mission_story import ABORT, FREE, Story, from_first_leg


def args(config: Config, folder: Path) -> ProcessArgs:
    (folder / "config.toml").write_text(dump_config(config))
    return ProcessArgs(config, folder, Endpoints(folder), None, False, False)


def build(of: ProcessArgs) -> tuple[SurveyParts, MissionStore]:
    assert isinstance(of.config, Config)
    return build_parts(of.config, of)


@pytest.fixture
def parts(tmp_path: Path) -> SurveyParts:
    built, store = build(args(load_config(None, {"run.panels": 1}), tmp_path))
    store.close()
    return built


def hello(config: Config, **changes: Any) -> Hello:
    robot = config.robot
    names = ("wheel_radius_m", "wheel_base_m", "edge_sensors_m", "max_wheel_rad_s")
    same = {name: getattr(robot, name) for name in names}
    fields: dict[str, Any] = {**same, "puck_m": (0.0, 0.0, robot.puck_height_m), "fan_floor": 0.0, **changes}
    return Hello("ccatp-robot/1", 1, "0" * 32, "none", True, 100.0, 0.25, RobotData(**fields))


def test_a_plan_measures_every_point_once(parts: SurveyParts) -> None:
    points = [stop.point for stop in parts.route.stops if stop.kind is StopKind.MEASURE]
    assert len(points) == len(set(points)) == parts.total_points == 9
    assert parts.already_done == 0
    assert 0.0 < parts.lower_bound_s < 100.0  # 40 s of it are the calibration drive


@pytest.mark.parametrize(
    ("mirror", "changes", "why"),
    [
        ("fyst-m1", {}, ""),
        ("fyst-m1", {"wheel_radius_m": 0.0303}, ""),  # calibrated here
        ("fyst-m1", {"wheel_radius_m": 0.04}, r"wheel_radius_m is 0\.03 here and 0\.04 there"),
        ("fyst-m1", {"wheel_base_m": 0.2}, r"wheel_base_m is 0\.15 here and 0\.2 there"),
        ("fyst-m1", {"edge_sensors_m": ((0.09, 0.09), (0.09, -0.09), (-0.09, 0.09), (-0.1, -0.09))}, "edge sensor is"),
        ("fyst-m1", {"puck_m": (0.0, 0.02, 0.05)}, "the puck is at"),
        ("fyst-m2", {"fan_floor": 0.6}, ""),
        ("fyst-m2", {}, "the mirror overhangs and the robot has no fan floor"),
    ],
)
def test_another_robot_is_refused(
    parts: SurveyParts, config: Config, mirror: str, changes: dict[str, Any], why: str
) -> None:
    under_test = replace(parts, mirror=build_mirror(load_config(None, {"run.mirror": mirror}).mirror))
    refusal = pytest.raises(ConfigError, match=why) if why else nullcontext()
    with refusal:
        under_test.check_robot(hello(config, **changes))


def test_a_store_is_not_overwritten_and_a_resumed_plan_leaves_out_what_is_measured(tmp_path: Path) -> None:
    where = args(load_config(None, {"run.panels": 1}), tmp_path)
    built, store = build(where)
    first = next(stop.point for stop in built.route.stops if stop.point is not None)
    fix = Fix(1.0, (0.0, 0.0, 0.0), tuple(np.eye(3).ravel().tolist()), 1.0, (1, 2, 3, 4), 0.0)
    store.record_fix(first, fix, DeckPose(0.0, 0.0, 0.0)).result(5.0)
    store.close()
    with pytest.raises(StoreUnusable, match=r"mission\.sqlite"):
        build(where)
    again, store = build(replace(where, is_resuming=True))
    store.close()
    assert (again.already_done, again.total_points) == (1, 9)
    assert first not in {stop.point for stop in again.route.stops}


QUAKE = structs.replace(
    FREE, code=EventCode.ABORTED, cause="emergency: earthquake", forward=False, reverse=False, turn=False, raised=1,
    is_shaking=True,
)  # fmt: skip


@pytest.fixture
def driving(config: Config) -> Story:
    cfg = from_first_leg(config)
    story = Story(cfg, build_mirror(cfg.mirror))
    story.until_state(MissionState.DRIVING)
    return story


def test_a_pause_and_an_abort(driving: Story) -> None:
    mission = driving.mission
    assert in_force_of(mission.state) == ("", "")
    driving.frame(ABORT)
    assert in_force_of(mission.state) == ("fire", "")
    assert mission.handle(Pause("operator")) is None
    assert in_force_of(mission.state) == ("fire", "operator")


@pytest.mark.fault("O1")
def test_an_earthquake_is_kept_by_the_danger_loop(driving: Story) -> None:
    """Who takes over is held by the next verdict, and goes home when it is over; nobody has to resume."""
    driving.frame(QUAKE)
    assert driving.mission.state.is_paused
    assert in_force_of(driving.mission.state) == ("emergency: earthquake", "")


def test_what_was_stopped_on_its_way_home_goes_home_when_it_goes_on(driving: Story) -> None:
    assert driving.mission.handle(Abort("operator")) is None
    assert driving.mission.handle(StopHere()) is None
    assert in_force_of(driving.mission.state) == ("operator", "")


def test_what_is_at_base_has_nothing_in_force(driving: Story) -> None:
    driving.until_state(MissionState.DONE, ABORT)
    assert in_force_of(driving.mission.state) == ("", "")
