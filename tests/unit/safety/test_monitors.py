"""Wheels that turn though they were told to stand, and those that run down after a stall of the link."""

import pytest

from ccatp.config.load import load_config
from ccatp.control.motion_checks import MotionSum
from ccatp.core import EmergencyKind
from ccatp.safety.emergency_latch import AT_BASE_OR_HELD, MAX_ACTIVE, MAX_CLEARED, EmergencyLatch, is_at_base_or_held
from ccatp.safety.sensor_monitors import SeamMonitor
from ccatp.safety.wheel_monitors import WheelMonitor
from ccatp.survey.state import MissionState
from tests.support.scenario import mirror_of

FRAME_S = 0.01
ROLLS_M_S = 0.0054  # just above what a standing wheel may show


def first_found_s(late_until_s: float) -> float | None:
    """When a wheel that rolls, told to stand from the beginning, is found; the link stalls until then."""
    cfg = load_config()
    monitor = WheelMonitor(cfg.health, cfg.robot)
    over_s = cfg.health.stall_time_s
    for k in range(1, 200):
        t_s = k * FRAME_S
        monitor.commands.push(t_s, (0.0, 0.0, 0.0, 0.0))
        monitor.learn(t_s)
        now = MotionSum(t_s, ROLLS_M_S * t_s, 0.0, 0.0)
        lately = MotionSum(over_s, ROLLS_M_S * over_s, 0.0, 0.0)
        monitor.step(
            now, None, lately, is_free=True, is_held=False, is_late=t_s <= late_until_s, is_sparse=False, samples=()
        )
        if monitor.alarm.finding is not None:
            return t_s
    return None


def test_a_wheel_that_rolls_on_is_found() -> None:
    found_s = first_found_s(0.0)
    assert found_s is not None
    assert found_s < 0.5


@pytest.mark.parametrize("stalled_s", [0.4, 0.9])
def test_after_a_stall_of_the_link_a_wheel_has_time_to_run_down(stalled_s: float) -> None:
    found_s = first_found_s(stalled_s)
    assert found_s is not None
    assert stalled_s + 0.55 < found_s < stalled_s + 0.7


@pytest.mark.parametrize(("is_held", "expected_s"), [(True, 1.4), (False, None)])
def test_where_main_is_silent_only_a_robot_that_holds_its_wheels_shall_stand(
    is_held: bool, expected_s: float | None
) -> None:
    """A robot that is permitted one direction of motion, as after an edge, may well be told to go there."""
    cfg = load_config()
    monitor = WheelMonitor(cfg.health, cfg.robot)
    over_s = cfg.health.stall_time_s
    stands, rolls = MotionSum(over_s, 0.0, 0.0, 0.0), MotionSum(over_s, ROLLS_M_S * over_s, 0.0, 0.0)
    rolled_m = 0.0
    for k in range(1, 300):
        t_s = k * FRAME_S
        is_silent = t_s > 1.0
        if not is_silent:
            monitor.commands.push(t_s, (0.0, 0.0, 0.0, 0.0))
            monitor.learn(t_s)
        is_rolling = t_s > 1.11
        rolled_m += ROLLS_M_S * FRAME_S * is_rolling
        monitor.step(
            MotionSum(t_s, rolled_m, 0.0, 0.0),
            None,
            rolls if is_rolling else stands,
            is_free=not is_silent,
            is_held=is_held and is_silent,
            is_late=False,
            is_sparse=False,
            samples=(),
        )
        if monitor.alarm.finding is not None:
            break
    found_s = t_s if monitor.alarm.finding is not None else None
    assert found_s == (None if expected_s is None else pytest.approx(expected_s, abs=0.05))


@pytest.mark.parametrize("step_m", [0.0005, 0.004])
def test_each_seam_that_a_sensor_has_crossed_is_counted(step_m: float) -> None:
    """Along a row of panels and back to the middle, then half a turn: no sensor leaves its panel in a turn there."""
    cfg, mirror = load_config(), mirror_of()
    monitor = SeamMonitor(cfg.health, mirror, cfg.robot, cfg.danger.map_sigmas)
    panel = mirror.panels[mirror.nearest_panel(0.3, 0.3)]
    length_m = 2.0 * (2.0 * panel.half_x_m + mirror.gap_m)
    steps = round(length_m / step_m)
    way = [k * length_m / steps for k in range(steps + 1)]
    for k, x_m in enumerate(way + way[::-1]):
        sigma_m = 0.05 if k % 100 < 10 else 1e-3  # so uncertain now and then that no sensor is on a panel for certain
        monitor.step(0.05 * k, (panel.x_m + x_m, panel.y_m, 0.0), sigma_m)
    assert monitor.crossed == 4 * 4  # sensors, seams
    for turned in range(60):
        monitor.step(0.05 * (2 * steps + turned), (panel.x_m, panel.y_m, 0.05 * turned), 1e-3)
    assert monitor.crossed == 4 * 4


@pytest.mark.parametrize("kind", list(EmergencyKind))
def test_each_kind_latches_until_cleared(kind: EmergencyKind) -> None:
    latch = EmergencyLatch()
    assert not latch.is_latched
    assert latch.newest is None
    assert latch.raise_emergency(kind.value, "a", "smoke") is None
    assert latch.is_latched
    assert latch.newest is not None
    assert (latch.newest.kind, latch.newest.id, latch.newest.note) == (kind, "a", "smoke")
    assert latch.clear("a", at_base_or_held=True) is None
    assert not latch.is_latched


def test_the_same_id_again_is_harmless_also_after_its_clear() -> None:
    latch = EmergencyLatch()
    latch.raise_emergency("fire", "a")
    assert latch.raise_emergency("power", "a", "retransmitted") is None
    assert latch.newest is not None
    assert latch.newest.kind is EmergencyKind.FIRE
    assert latch.clear("a", at_base_or_held=True) is None
    assert latch.clear("a", at_base_or_held=False) is None
    # a late retransmission must not abort the next survey
    assert latch.raise_emergency("fire", "a") is None
    assert not latch.is_latched


def test_unknown_kind_and_unknown_id_change_nothing() -> None:
    latch = EmergencyLatch()
    assert latch.raise_emergency("flood", "a") == "unknown kind 'flood'"
    assert latch.clear("a", at_base_or_held=True) == "no emergency with that id"
    assert not latch.is_latched


def test_clear_is_refused_while_the_robot_is_out_on_the_mirror() -> None:
    latch = EmergencyLatch()
    latch.raise_emergency("fire", "a")
    assert latch.clear("a", at_base_or_held=False) == "the robot is neither at base nor held"
    assert latch.is_latched


def test_clear_is_refused_while_the_cause_persists() -> None:
    latch = EmergencyLatch()
    latch.raise_emergency("fire", "a")
    latch.set_level(EmergencyKind.FIRE, True)
    latch.set_level(EmergencyKind.POWER, True)
    assert latch.clear("a", at_base_or_held=True) == "the cause persists: fire"
    assert latch.is_latched
    latch.set_level(EmergencyKind.FIRE, False)
    assert latch.clear("a", at_base_or_held=True) is None


def test_the_latch_opens_with_the_last_emergency() -> None:
    latch = EmergencyLatch()
    latch.raise_emergency("fire", "a")
    latch.raise_emergency("power", "b")
    assert latch.newest is not None
    assert latch.newest.id == "b"
    assert latch.clear("b", at_base_or_held=True) is None
    assert latch.is_latched
    assert latch.newest.id == "a"
    assert latch.clear("a", at_base_or_held=True) is None
    assert not latch.is_latched


def test_a_flood_of_emergencies_is_bounded_and_stays_latched() -> None:
    latch = EmergencyLatch()
    for number in range(MAX_ACTIVE):
        assert latch.raise_emergency("weather", str(number)) is None
    assert latch.raise_emergency("weather", "one more") == (
        f"{MAX_ACTIVE} emergencies are active already (the operation is aborted)"
    )
    assert latch.is_latched
    assert not latch.is_shaking
    assert latch.raise_emergency("earthquake", "and this") is None  # of another kind: more than what there is
    assert latch.is_shaking


def test_an_id_is_that_of_one_emergency() -> None:
    latch = EmergencyLatch()
    assert latch.raise_emergency("weather", "a") is None
    assert latch.raise_emergency("weather", "a") is None
    assert latch.raise_emergency("fire", "a") is None
    assert (latch.raised, latch.holds("a")) == (1, True)
    assert latch.raise_emergency("earthquake", "a") is None
    assert latch.raise_emergency("fire", "a") is None
    assert (latch.raised, latch.is_shaking) == (2, True)
    assert latch.clear("a", at_base_or_held=True) is None
    assert latch.raise_emergency("weather", "a") is None
    assert (latch.raised, latch.holds("a"), latch.is_latched) == (2, False, False)
    assert latch.raise_emergency("weather", "b") is None
    assert latch.raised == 3


def test_memory_of_cleared_ids_is_bounded() -> None:
    latch = EmergencyLatch()
    for number in range(MAX_CLEARED + 1):
        latch.raise_emergency("weather", str(number))
        assert latch.clear(str(number), at_base_or_held=True) is None
    # the oldest is forgotten: raised again it is a new one
    latch.raise_emergency("weather", "0")
    assert latch.is_latched


def test_the_states_are_those_of_the_mission() -> None:
    assert {state.value for state in (MissionState.IDLE, MissionState.HELD, MissionState.DONE)} == AT_BASE_OR_HELD
    assert is_at_base_or_held("held")
    assert not is_at_base_or_held("driving")
    assert not is_at_base_or_held("")
