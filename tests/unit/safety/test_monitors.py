"""Wheels that turn though they were told to stand, and those that run down after a stall of the link."""

import pytest

from ccatp.config.load import load_config
from ccatp.control.motion_checks import MotionSum
from ccatp.core import EmergencyKind
from ccatp.safety.emergency_latch import AT_BASE_OR_HELD, MAX_ACTIVE, MAX_CLEARED, EmergencyLatch
from ccatp.safety.sensor_monitors import SeamMonitor
from ccatp.safety.wheel_monitors import WheelMonitor
from ccatp.survey.state import MissionState
from tests.support.scenario import mirror_of

FRAME_S = 0.01
ROLLS_M_S = 0.0054  # just above what a standing wheel may show


@pytest.mark.parametrize(
    ("late_until_s", "rolls_from_s", "silent_from_s", "is_held", "expected_s"),
    [
        pytest.param(0.0, 0.0, 9.0, False, (0.0, 0.5), id="it rolls on"),
        pytest.param(0.4, 0.0, 9.0, False, (0.95, 1.1), id="it has time to run down after a stall of the link"),
        pytest.param(0.9, 0.0, 9.0, False, (1.45, 1.6), id="and after a longer one"),
        pytest.param(0.0, 1.11, 1.0, True, (1.35, 1.45), id="main is silent and the robot holds its wheels"),
        # A robot that is permitted one direction of motion, as after an edge, may well be told to go there.
        pytest.param(0.0, 1.11, 1.0, False, None, id="main is silent and the robot may move"),
    ],
)
def test_a_wheel_that_rolls_though_it_shall_stand_is_found(
    late_until_s: float,
    rolls_from_s: float,
    silent_from_s: float,
    is_held: bool,
    expected_s: tuple[float, float] | None,
) -> None:
    cfg = load_config()
    monitor = WheelMonitor(cfg.health, cfg.robot)
    rolled_m = t_s = 0.0
    while t_s < 3.0 and monitor.alarm.finding is None:
        t_s += FRAME_S
        is_silent = t_s > silent_from_s
        if not is_silent:
            monitor.take_commands(t_s, (0.0, 0.0, 0.0, 0.0))
            monitor.learn(t_s)
        rolled_m += ROLLS_M_S * FRAME_S * (t_s > rolls_from_s)
        flags = {"is_free": not is_silent, "is_held": is_held and is_silent, "is_late": t_s <= late_until_s}
        monitor.step(MotionSum(t_s, rolled_m, 0.0, 0.0), (), **flags, is_sparse=False)
    assert (monitor.alarm.finding is None) is (expected_s is None)
    assert expected_s is None or expected_s[0] < t_s < expected_s[1]


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
    assert monitor.missed == [4] * 4  # seams, by sensors that are never off
    for turned in range(60):
        monitor.step(0.05 * (2 * steps + turned), (panel.x_m, panel.y_m, 0.05 * turned), 1e-3)
    assert monitor.missed == [4] * 4


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
