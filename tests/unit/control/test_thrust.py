"""Thrust that holds the robot on its slope: against moments by hand, and the duty that follows it."""

from itertools import pairwise
from math import cos, pi, radians, sin

import pytest

from ccatp.config.load import load_config
from ccatp.config.models import RobotConfig
from ccatp.control.grip_model import GripModel
from ccatp.control.thrust import ThrustControl, TurnCreep
from ccatp.core import DeckPose, Vector3
from ccatp.errors import ConfigError
from ccatp.mirror.mirror import build_mirror
from ccatp.survey.composition import assemble

WEIGHT_N = 9.771  # of 1 kg
OVERHANG_RAD = radians(18.435)  # of fyst-m2: 3.09 N away from the surface and 9.27 N along it


def robot(**changed: object) -> RobotConfig:
    return load_config(overrides={f"robot.{key}": value for key, value in changed.items()}).robot


def gravity(to_rear: float, overhang_rad: float = OVERHANG_RAD) -> Vector3:
    """``to_rear``: angle of downhill from straight behind, rad."""
    along = cos(overhang_rad)
    return -along * cos(to_rear), along * sin(to_rear), sin(overhang_rad)


@pytest.mark.parametrize(("friction", "least_n"), [(0.5, 21.6), (0.8, 14.7), (1.0, 12.4)])
def test_wheels_that_carry_everything(friction: float, least_n: float) -> None:
    """Weight away from the surface and along it over the friction."""
    on_axle = robot(friction=friction, centre_of_mass_m=[0.0, 0.0])
    assert GripModel(on_axle).least_thrust_n(gravity(1.0), turns=True) == pytest.approx(least_n, abs=0.05)


def test_the_caster_takes_load_and_downhill_behind_takes_most() -> None:
    cfg = robot(friction=0.6)
    outward, along = WEIGHT_N * sin(OVERHANG_RAD), WEIGHT_N * cos(OVERHANG_RAD)
    behind = outward + (along / 0.6 + along * 0.035 / 0.075) / 0.8
    assert GripModel(cfg).least_thrust_n(gravity(0.0), turns=False) == pytest.approx(behind)
    for to_rear in (0.0, 1.0, pi):
        assert GripModel(cfg).least_thrust_n(gravity(to_rear), turns=True) == pytest.approx(behind)
        assert GripModel(cfg).least_thrust_n(gravity(to_rear), turns=False) <= behind
    # Downhill ahead the nose goes down before the wheels slide.
    assert GripModel(cfg).least_thrust_n(gravity(pi), turns=False) == pytest.approx(outward + along * 0.035 / 0.015)


def test_on_a_floor_no_thrust_is_needed() -> None:
    assert GripModel(robot()).least_thrust_n((0.0, 0.0, -1.0), turns=True) == 0.0


def test_a_turn_leaves_a_fifth_of_its_friction_to_the_lighter_wheel() -> None:
    """Loads of each wheel by moments about the axle and along it, at every heading."""
    cfg, used = robot(thrust_margin=1.0), []
    thrust_n = GripModel(cfg).turn_thrust_n(gravity(0.0))
    for degrees in range(360):
        ahead, left, away = (WEIGHT_N * part for part in gravity(radians(degrees)))
        both_n = (thrust_n - away) * 0.8 + ahead * 0.035 / 0.075
        for side in (1.0, -1.0):
            load_n, pull_n = 0.5 * both_n + side * left * 0.035 / 0.15, 0.5 * ahead + side * left * 0.015 / 0.15
            used.append(abs(pull_n) / load_n / cfg.friction)
    assert max(used) == pytest.approx(0.8, abs=1e-3)


def test_speed_from_which_the_spare_grip_stops_it() -> None:
    cfg = robot(friction=0.6)
    least_n = GripModel(cfg).least_thrust_n(gravity(0.0), turns=True)
    assert GripModel(cfg).safe_speed_m_s(gravity(0.0), 0.99 * least_n) == 0.0
    # 1 N more on the fans presses the wheels with 0.8 N, of which friction takes 0.6: 0.48 m/s^2 over 30 mm.
    assert GripModel(cfg).safe_speed_m_s(gravity(0.0), least_n + 1.0) == pytest.approx((2.0 * 0.48 * 0.03) ** 0.5)


@pytest.mark.parametrize(
    ("mirror", "thrust_n", "turn_duty"), [("fyst-m1", 40.0, 0.8), ("fyst-m1", 6.5, 0.94), ("fyst-m2", 40.0, 0.92)]
)
def test_duty_goes_to_what_a_turn_needs_with_a_ramp(mirror: str, thrust_n: float, turn_duty: float) -> None:
    cfg = robot(thrust_n=thrust_n)
    control = ThrustControl(cfg, build_mirror(load_config(overrides={"run.mirror": mirror}).mirror))
    pose = DeckPose(0.0, 0.0, 0.5)
    duties = [control.duty]
    for k in range(10):
        if control.step(0.05 * k, pose, turns=True):
            duties.append(control.duty)
    assert duties[0] == cfg.fan_duty
    assert duties[-1] == (turn_duty, turn_duty)
    assert all(after[0] - before[0] <= 0.05 + 1e-9 for before, after in pairwise(duties))
    assert not control.step(0.6, pose, turns=True)  # it is there


@pytest.mark.parametrize(
    ("thrust_n", "is_held", "is_short", "text"),
    [(40.0, True, False, "give 40.0 N"), (31.0, True, True, "half the speed"), (20.0, False, True, "WOULD SLIDE")],
)
def test_the_forecast_describes_the_grip_on_a_slope(thrust_n: float, is_held: bool, is_short: bool, text: str) -> None:
    cfg = load_config(overrides={"run.mirror": "fyst-m2", "robot.thrust_n": thrust_n})
    grip = GripModel(cfg.robot).forecast(build_mirror(cfg.mirror))
    assert (grip.is_held, grip.is_short) == (is_held, is_short)
    assert text in grip.text


def test_where_grip_is_short_a_run_is_slow_and_where_there_is_none_it_is_refused() -> None:
    slow = assemble(load_config(overrides={"run.mirror": "fyst-m2", "run.panels": 1, "robot.thrust_n": 31.0}))
    assert slow.cfg.limits.v_max_m_s == slow.cfg.health.slow_speed_m_s
    assert slow.cfg.limits.omega_max_rad_s == slow.cfg.health.slow_rate_rad_s
    with pytest.raises(ConfigError, match=r"^robot.thrust_n: the fans give 20.0 N; .* WOULD SLIDE"):
        assemble(load_config(overrides={"run.mirror": "fyst-m2", "run.panels": 1, "robot.thrust_n": 20.0}))


@pytest.mark.parametrize("friction", [0.45, 0.6, 0.8])
def test_creep_of_turns_shows_the_friction(friction: float) -> None:
    """Mean over a whole turn of the creep of a tyre with that friction, downhill all round; 36 N on 18 degrees."""
    cfg, found = robot(), []
    for to_rear in (k * pi / 180.0 for k in range(360)):
        along = WEIGHT_N * cos(OVERHANG_RAD)
        load_n = (36.0 - WEIGHT_N * sin(OVERHANG_RAD)) * 0.8 - along * cos(to_rear) * 0.035 / 0.075
        use = along / load_n / friction
        found.append(0.002 * use / (1.0 - use * use) ** 0.5)
    creep_m_rad = sum(found) / len(found)
    assert GripModel(cfg).friction_by_creep(gravity(0.0), 36.0, creep_m_rad) == pytest.approx(friction, rel=0.03)
    # No creep is no bound, and no slope or no known tyre says nothing.
    assert GripModel(cfg).friction_by_creep(gravity(0.0), 36.0, 0.0) == pytest.approx(2.0)
    assert GripModel(cfg).friction_by_creep(gravity(0.0, radians(89.0)), 36.0, creep_m_rad) is None
    assert GripModel(robot(tyre_m=0.0)).friction_by_creep(gravity(0.0), 36.0, creep_m_rad) is None


def test_a_turn_creeps_most_with_downhill_behind() -> None:
    """On 18 degrees with 36 N: the shares of all headings have the mean 1; on a floor a turn creeps by none more."""
    cfg = robot()
    creep = TurnCreep(cfg)
    shares = [creep.share(gravity(radians(degrees))) for degrees in range(0, 360, 45)]
    assert shares == pytest.approx([1.54, 1.25, 0.91, 0.73, 0.68, 0.73, 0.91, 1.25], abs=0.05)
    assert sum(shares) / len(shares) == pytest.approx(1.0)
    assert creep.share((0.0, 0.0, -1.0)) == 1.0
    assert TurnCreep(robot(thrust_n=2.0)).share(gravity(0.0)) == 1.0  # it is lifted off


@pytest.mark.parametrize(
    ("creep_m_rad", "margin", "duty"), [(0.0014, 1.44, 0.9), (0.004, 1.14, 1.0), (0.03, 1.01, 1.0)]
)
def test_little_grip_in_the_first_turns_raises_the_thrust(creep_m_rad: float, margin: float, duty: float) -> None:
    cfg, mirror = robot(), build_mirror(load_config(overrides={"run.mirror": "fyst-m2"}).mirror)
    control = ThrustControl(cfg, mirror)
    base = mirror.base_pose

    def turn(fixes: int, turn_rad: float) -> bool:
        for k in range(40):
            control.step(0.05 * k, DeckPose(base.x_m, base.y_m, base.heading_rad + turn_rad * k / 39.0), turns=True)
        return control.measure_grip(fixes, base, creep_m_rad)

    assert not control.measure_grip(1, base, 0.0)  # where it starts
    assert not turn(2, 0.5)  # too short a turn
    assert control.margin == 0.0
    assert turn(3, pi)
    assert not turn(3, pi)  # no fix since
    assert turn(4, pi)  # with more thrust, where there is little grip
    assert control.margin == pytest.approx(margin, abs=0.05)
    turn(4, pi)
    assert control.duty == (duty, duty)
