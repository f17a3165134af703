"""Plans: the one that is shipped, and what is said of mistakes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.config.models import Config
from ccatp.config.package import configs_dir
from ccatp.errors import ConfigError
from ccatp.mirror.mirror import Mirror
from ccatp.sim.fault_plan import LINK_TYPES, TYPES, FaultPlan, Injected, check_pacing, parse_plan, read_plan
from ccatp.sim.robot import Robot
from tests.support.command import refused
from tests.support.scenario import config_of, fault_plan, mirror_of

FAULT = '[[fault]]\nsignal = "imu_wz"\nat_s = 1.0\n'
LINK = "[[link]]\nat_s = 1.0\n"


def test_the_example_loads() -> None:
    plan = read_plan(configs_dir() / "faults" / "example.toml", lockstep=False)
    assert [fault.type for fault in plan.faults] == ["stuck", "intermittent", "drop", "slip"]
    assert [fault.type for fault in plan.link] == ["fragment", "delay"]
    edge: Any = plan.faults[1]
    assert (edge.signal, edge.at_s, edge.end_s, edge.duty) == ("edge_front_left", 60.0, 60.3, 0.8)


def test_the_page_names_every_signal_and_type() -> None:
    page = (Path(__file__).parents[3] / "docs" / "faults.md").read_text(encoding="utf-8")
    for signal, types in TYPES.items():
        assert f"`{signal}`" in page
        for name, model in types.items():
            assert f"`{name}`" in page
            for key in set(model.model_fields) - {"signal", "type", "at_s", "for_s"}:
                assert f"`{key}`" in page
    for name, link in LINK_TYPES.items():
        assert f"`{name}`" in page
        for key in link.model_fields:
            assert f"`{key}`" in page


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[fault]", "plan:1: is not TOML: "),
        ("[[faults]]\nat_s = 1.0", "plan:1: faults is unknown; did you mean fault? available: fault, link"),
        ("fault = 3", "plan: fault must be a list of tables; begin each with [[fault]]"),
        ("[link]\nat_s = 1.0", "plan: link must be a list of tables; begin each with [[link]]"),
        (
            '[[fault]]\ntype = "off"',
            "plan:1: fault[0].signal is missing; available: body, clock, edge_clock, edge_front_left",
        ),
        ('[[fault]]\nsignal = 3\ntype = "off"', "plan:2: fault[0].signal = 3 must be text in quotes"),
        (
            '[[fault]]\nsignal = "imu_wx"\ntype = "off"',
            'plan:2: fault[0].signal = "imu_wx" is no signal; did you mean imu_wz? available: ',
        ),
        (FAULT, "plan:1: fault[0].type is missing; available: delayed, garbage, intermittent, non_finite, off"),
        (
            FAULT + 'type = "stcuk"\n',
            'plan:4: fault[0].type = "stcuk" is no type of imu_wz; did you mean stuck? available: ',
        ),
        (
            '[[fault]]\nsignal = "body"\ntype = "stuck"',
            'plan:3: fault[0].type = "stuck" is no type of body; available: drift, kidnap, slip',
        ),
        (FAULT + 'type = "stuck"\nvaleu = 1.0', "plan:5: fault[0].valeu is unknown; did you mean value?"),
        (FAULT + 'type = "off"\nxyz = 1', "plan:5: fault[0].xyz is unknown; known here: signal, type, at_s, for_s"),
        ('[[fault]]\nsignal = "soc"\ntype = "off"', "plan:1: fault[0].at_s is missing"),
        (FAULT + 'type = "slow"\nevery = 1', "plan:5: fault[0].every = 1 must be greater than or equal to 2"),
        (FAULT + 'type = "wrong"', 'plan:4: fault[0].type = "wrong" needs an offset, a factor or a sign'),
        (FAULT + 'type = "wrong"\nsign = 2', "plan:5: fault[0].sign = 2 must be 1 or -1"),
        (FAULT + 'type = "saturated"', 'plan:4: fault[0].type = "saturated" needs low or high, and low below high'),
        (FAULT + 'type = "saturated"\nlow = 2.0\nhigh = 1.0', "needs low or high, and low below high"),
        (
            '[[fault]]\nsignal = "faults"\ntype = "raise"\nat_s = 1.0\nnames = ["imu", "wheel"]',
            "plan:5: fault[0].names[1] = \"wheel\" must be 'imu', 'encoder_left'",
        ),
        (
            FAULT + 'type = "off"\n\n' + FAULT + 'type = "of"',
            'plan:9: fault[1].type = "of" is no type of imu_wz; did you mean off?',
        ),
        (LINK, "plan:1: link[0].type is missing; available: black_hole, close, corrupt"),
        (LINK + 'type = "rest"', 'plan:3: link[0].type = "rest" is no type; did you mean reset?'),
        ('[[link]]\ntype = "reset"', 'plan:2: link[0].type = "reset" needs one of at_s, after_lines, after_bytes'),
        (LINK + 'type = "reset"\nafter_lines = 3', "needs one of at_s, after_lines, after_bytes"),
        (
            LINK + 'type = "stall"\ndirection = "up"',
            "plan:4: link[0].direction = \"up\" must be 'to_client', 'to_robot'",
        ),
    ],
)
def test_a_mistake_is_one_line_with_its_place(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_plan(text, "plan")
    assert message in caught.value.problems[0]
    assert all("\n" not in problem for problem in caught.value.problems)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[fault]]\nsignal = "soc"\ntype = "off"\nat = 1.0', "plan:4: fault[0].at is unknown; did you mean at_s?"),
        ('[[fault]]\nsignl = "soc"\ntype = "off"', "plan:2: fault[0].signl is unknown; did you mean signal?"),
    ],
)
def test_a_misspelt_key_is_one_problem_and_not_also_a_missing_one(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_plan(text, "plan")
    assert list(caught.value.problems) == [message]


def test_every_mistake_is_reported() -> None:
    with pytest.raises(ConfigError, match=r"\(and 2 more") as caught:
        parse_plan(FAULT + 'type = "off"\na = 1\nb = 2\n' + LINK + 'type = "x"', "plan")
    assert len(caught.value.problems) == 3


def test_lockstep_refuses_what_would_only_stall_it() -> None:
    plan = parse_plan(LINK + 'type = "reset"\n' + LINK + 'type = "stall"\ndirection = "both"', "plan")
    check_pacing(plan, "plan", lockstep=False)
    message = (
        r'plan: link\[1\].type = "stall" makes no sense in lockstep, .* add --realtime, or take one of reset, close'
    )
    with pytest.raises(ConfigError, match=message):
        check_pacing(plan, "plan", lockstep=True)


@pytest.mark.parametrize("command", [["run", "--sim"], ["sim", "robot", "--lockstep"]])
def test_the_commands_refuse_it_before_anything_starts(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "plan.toml"
    file.write_text(LINK + 'type = "stall"\ndirection = "both"')
    error = refused(capsys, *command, "--faults", file)
    assert 'link[0].type = "stall" makes no sense in lockstep' in error
    assert error.count("\n") == 1


def plan_of(**values: object) -> FaultPlan:
    return fault_plan({"at_s": 0.5, **values})


def boot(config: Config, mirror: Mirror, **values: object) -> Robot:
    robot = Robot(config, mirror, np.random.default_rng(1), plan_of(**values) if values else None)
    robot.join("controller")
    return robot


def drive(robot: Robot, right: float, left: float, until_s: float) -> list[dict[str, Any]]:
    """Drive to a time; the frames in the raw lines."""
    lines = b""
    while robot.t_s < until_s - 1e-9:
        robot.drive(robot.seq + 1, right, left)
        robot.advance()
        lines += robot.delivered_line
    return [json.loads(line) for line in lines.splitlines()]


def record(robot: Robot) -> Injected:
    assert robot.injector is not None
    (found,) = robot.injector.injected
    return found


def acted(robot: Robot) -> tuple[float | None, float | None, int, int]:
    found = record(robot)
    return found.from_s, found.until_s, found.samples, found.changed


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_blocked_wheel_stands_and_its_encoder_reports_it(config: Config, mirror: Mirror, side: str) -> None:
    robot = boot(config, mirror, signal=f"{side}_wheel", type="blocked", for_s=0.5)
    frames = drive(robot, 3.0, 3.0, 0.9)
    column, other = (1, 2) if side == "right" else (2, 1)
    assert all(abs(row[column]) < 0.01 for row in frames[-1]["enc"])
    assert all(row[other] == pytest.approx(3.0, abs=0.05) for row in frames[-1]["enc"])
    turned = robot.world.plant.turn_rate_at(0.0)
    assert turned == pytest.approx(0.6 if side == "left" else -0.6, abs=0.01)  # r w / b
    drive(robot, 3.0, 3.0, 2.0)
    assert robot.world.plant.right_rad_s == pytest.approx(3.0, abs=1e-3)
    assert robot.world.plant.left_rad_s == pytest.approx(3.0, abs=1e-3)
    assert acted(robot) == (0.5, 0.99, 50, 50)


def test_a_wheel_of_another_gain_turns_at_a_multiple_of_its_set_point(config: Config, mirror: Mirror) -> None:
    robot = boot(config, mirror, signal="left_wheel", type="gain", factor=1.5)
    rates = [frame["enc"][-1][1:] for frame in drive(robot, 1.0, 1.0, 1.5)]
    assert rates[45] == pytest.approx([1.0, 1.0], abs=0.01)
    assert rates[-1] == pytest.approx([1.0, 1.5], abs=0.01)


def test_a_runaway_wheel_turns_while_the_robot_holds(config: Config, mirror: Mirror) -> None:
    robot = boot(config, mirror, signal="left_wheel", type="runaway", rate_rad_s=-2.0, for_s=0.5)
    frames = drive(robot, 0.0, 0.0, 0.99)
    assert frames[40]["enc"][-1][2] == pytest.approx(0.0, abs=0.01)
    assert frames[-1]["enc"][-1][2] == pytest.approx(-2.0, abs=0.02)
    assert robot.world.plant.right_rad_s == 0.0
    assert record(robot).changed == 49


@pytest.mark.parametrize("world", ["thesis", "hard"])
@pytest.mark.parametrize("signal", ["body", "right_wheel", "left_wheel"])
def test_slip_takes_way_from_the_body_and_not_from_the_wheels(world: str, signal: str) -> None:
    cfg = config_of(run__world=world)
    ways, angles, rates = [], [], []
    for faults in ({}, {"signal": signal, "type": "slip", "factor": 0.5, "for_s": 0.5}):
        robot = boot(cfg, mirror_of(), **faults)
        frames = drive(robot, 3.0, 3.0, 0.98)
        ways.append(robot.world.plant.forward_m)
        rates.append(frames[-1]["imu"][-1][2])
        angles.append((robot.world.plant.right_angle_rad, robot.world.plant.left_angle_rad))
        scales = []
        drive(robot, 0.0, 0.0, 1.4)
        drive(robot, 3.0, 3.0, 2.0)
        scales.append((robot.world.plant.right_scale, robot.world.plant.left_scale))
    assert angles[0] == angles[1]
    half = 0.5 if signal == "body" else 0.75
    assert ways[1] == pytest.approx(half * ways[0], rel=0.02)
    # One wheel with half its way turns the body by r w / (2 b), and the gyroscope feels it.
    turning = {"body": 0.0, "right_wheel": -0.3, "left_wheel": 0.3}[signal]
    assert rates[1] - rates[0] == pytest.approx(turning, abs=0.02)
    assert robot.world.plant.right_scale == scales[0][0]
    assert 0.9 < robot.world.plant.right_scale < 1.1  # full grip again
    assert record(robot).changed == 50


def test_drift_is_downhill_while_the_wheels_stand_and_no_sensor_of_the_wheels_sees_it(
    config: Config, mirror: Mirror
) -> None:
    robot = boot(config, mirror, signal="body", type="drift", speed_m_s=0.02, for_s=1.0)
    before, z_0 = robot.world.plant.pose, robot.world.puck_world()[2]
    frames = drive(robot, 0.0, 0.0, 2.0)
    after = robot.world.plant.pose
    fx, fy = mirror.surface.gradient(before.x_m, before.y_m)
    dx, dy = after.x_m - before.x_m, after.y_m - before.y_m
    assert np.hypot(np.hypot(dx, dy), fx * dx + fy * dy) == pytest.approx(0.02, rel=1e-3)
    up = mirror.rotate_deck_from_world((0.0, 0.0, -1.0))
    assert dx * up[0] + dy * up[1] + (fx * dx + fy * dy) * up[2] < 0.0
    assert robot.world.puck_world()[2] != z_0
    assert max(abs(row[1]) for frame in frames for row in frame["enc"]) < 0.01
    assert record(robot).changed == 100
    driven = boot(config, mirror, signal="body", type="drift", speed_m_s=0.02, at_s=0.5, for_s=1.0)
    drive(driven, 1.0, 1.0, 1.0)
    assert record(driven).samples == 0  # it is a fault of holding
    drive(driven, 0.0, 0.0, 2.0)
    assert acted(driven)[:2] == (1.0, 1.49)  # from the command on, not from the wheels' last turn


@pytest.mark.parametrize("is_driving", [False, True])
def test_a_kidnap_moves_the_body_and_its_edge_sensors(config: Config, mirror: Mirror, is_driving: bool) -> None:
    rate = 1.0 if is_driving else 0.0
    there = boot(config, mirror, signal="body", type="kidnap", dx_m=0.25, dy_m=-0.1, dheading_rad=0.3)
    here = boot(config, mirror)
    drive(there, rate, rate, 0.5)
    drive(here, rate, rate, 0.5)
    assert there.world.plant.pose == here.world.plant.pose
    there.advance()
    here.advance()
    a, b = there.world.plant.pose, here.world.plant.pose
    assert (a.x_m - b.x_m, a.y_m - b.y_m) == pytest.approx((0.25, -0.1), abs=1e-3)
    assert a.heading_rad - b.heading_rad == pytest.approx(0.3, abs=1e-3)
    row = there.world.truth_row(there.seq, there.t_s)
    assert row[2] == a.x_m
    assert there.world.plant.z_m == pytest.approx(mirror.surface.jet(a.x_m, a.y_m)[0], abs=1e-9)
    drive(there, rate, rate, 1.0)
    assert acted(there) == (0.5, 0.5, 1, 1)  # once


def test_edge_sensors_read_the_panels_of_the_new_place(config: Config, mirror: Mirror) -> None:
    here = boot(config, mirror).world.plant.pose
    panel = mirror.panels[mirror.nearest_panel(here.x_m, here.y_m)]
    seam_x_m = panel.x_m + panel.half_x_m + 0.0006  # the middle of a gap of 1.2 mm
    values = {"dx_m": seam_x_m - 0.09 - here.x_m, "dy_m": panel.y_m - here.y_m, "dheading_rad": -here.heading_rad}
    robot = boot(config, mirror, signal="body", type="kidnap", **values)
    assert drive(robot, 0.0, 0.0, 0.5)[-1]["edge"][-1][1:] == [1, 1, 1, 1]
    assert drive(robot, 0.0, 0.0, 0.52)[-1]["edge"][-1][1:] == [0, 0, 1, 1]


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_weak_fan_echoes_its_duty_and_lets_the_robot_fall_from_an_overhang(side: str) -> None:
    cfg = config_of("fyst-m2")
    robot = boot(cfg, mirror_of("fyst-m2"), signal=f"{side}_fan", type="weak", share=0.25, for_s=0.1)
    frames = drive(robot, 0.0, 0.0, 0.55)
    assert robot.fans.health == ((0.25, 1.0) if side == "left" else (1.0, 0.25))
    assert frames[-1]["fans"] == frames[0]["fans"]
    drive(robot, 0.0, 0.0, 0.7)
    assert robot.fans.health == (1.0, 1.0)
    assert not robot.world.is_fallen  # too short to fall
    longer = boot(cfg, mirror_of("fyst-m2"), signal=f"{side}_fan", type="weak", share=0.25)
    frames = drive(longer, 0.0, 0.0, 1.0)
    assert longer.world.is_fallen
    # A robot that has fallen has no panel under its sensors.
    assert [frames[k]["edge"][-1][1:] for k in (0, -1)] == [[1, 1, 1, 1], [0, 0, 0, 0]]
    assert record(longer).changed >= 20


@pytest.mark.parametrize("by_s", [3.0, -0.2])
def test_a_jump_of_the_clock_shifts_every_time(config: Config, mirror: Mirror, by_s: float) -> None:
    robot = boot(config, mirror, signal="clock", type="jump", by_s=by_s, for_s=0.3)
    frames = drive(robot, 1.0, 1.0, 1.0)
    for frame in frames:
        offset = by_s if 50 <= frame["seq"] < 80 else 0.0
        assert frame["t"] == pytest.approx(frame["seq"] / 100.0 + offset)
        for name in ("imu", "enc", "edge"):
            assert frame[name][-1][0] == pytest.approx(frame["t"])
    assert acted(robot) == (0.5, 0.79, 30, 30)


@pytest.mark.parametrize(("signal", "name"), [("imu_clock", "imu"), ("encoder_clock", "enc"), ("edge_clock", "edge")])
def test_the_times_of_one_sensor_alone_can_be_wrong(config: Config, mirror: Mirror, signal: str, name: str) -> None:
    robot = boot(config, mirror, signal=signal, type="jump", by_s=0.4, for_s=0.3)
    for frame in drive(robot, 1.0, 1.0, 1.0):
        assert frame["t"] == pytest.approx(frame["seq"] / 100.0)
        for kind in ("imu", "enc", "edge"):
            offset = 0.4 if kind == name and 50 <= frame["seq"] < 80 else 0.0
            assert frame[kind][-1][0] == pytest.approx(frame["t"] + offset)
    assert acted(robot) == (0.5, 0.79, 30, 30)


def test_names_that_the_robot_raises(config: Config, mirror: Mirror) -> None:
    robot = boot(config, mirror, signal="faults", type="raise", names=["stall", "edge", "stall"], for_s=0.2)
    found = [frame["faults"] for frame in drive(robot, 1.0, 1.0, 1.0)]
    assert found == [["stall", "edge"] if 50 <= k < 70 else [] for k in range(1, 101)]


def test_a_reboot_counts_anew_forgets_and_leaves_the_body_where_it_is(config: Config, mirror: Mirror) -> None:
    robot = boot(config, mirror, signal="robot", type="reboot")
    robot.join("monitor")
    robot.permit(1, True, True, True)
    robot.command_fans(1, 0.5, 0.5)
    drive(robot, 1.0, 1.0, 0.5)
    place, frames = robot.world.plant.pose, []
    robot.advance()
    frames.append(json.loads(robot.delivered_line))
    assert (frames[0]["seq"], frames[0]["fans"]) == (1, [0.0, 0.0])
    assert frames[0]["t"] == pytest.approx(0.01)
    assert frames[0]["enc"][0][0] == pytest.approx(0.001)
    assert frames[0]["cmd"] == {"seq": 0, "age": 0.0, "permit_age": 0.0, "held": True}
    assert not robot.rules.has_monitor_joined
    assert (robot.reboots, robot.seq, robot.t_s) == (1, 51, 0.51)  # the truth goes on
    assert robot.world.plant.pose.x_m == pytest.approx(place.x_m, abs=1e-3)
    robot.advance()
    assert robot.reboots == 1
    assert acted(robot) == (0.5, 0.5, 1, 1)


def test_a_reboot_with_late_sensors_delivers_nothing_of_the_boot_before() -> None:
    cfg = config_of(run__world="hard")
    robot = boot(cfg, mirror_of(), signal="robot", type="reboot")
    assert robot.sensors_delay_frames > 0
    drive(robot, 1.0, 1.0, 0.5)
    first = drive(robot, 1.0, 1.0, 0.6)[0]
    assert first["seq"] == 1


def test_news_tell_each_beginning_and_end_once(config: Config, mirror: Mirror) -> None:
    robot = boot(config, mirror, signal="imu_wz", type="off", for_s=0.2)
    assert robot.injector is not None
    received = []
    for _ in range(100):
        robot.advance()
        received += [(what, robot.seq, injected.samples) for what, injected in robot.injector.changes(robot.t_s)]
    assert received == [("begins", 50, 1), ("ended", 70, 20)]
