"""Wheels that turn though they were commanded to stand, and those that run down after a stall of the link."""

import pytest

from ccatp.config.load import load_config
from ccatp.core import DeckPose, EmergencyKind
from ccatp.safety.edge_monitors import SeamMonitor
from ccatp.safety.emergency_latch import AT_BASE_OR_HELD, MAX_ACTIVE, MAX_CLEARED, EmergencyLatch
from ccatp.safety.motion_sums import MotionSum
from ccatp.safety.wheel_monitor import FrameSpan, WheelMonitor
from ccatp.survey.events import Mode
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
def test_a_wheel_that_rolls_although_it_is_commanded_to_stand_is_found(
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
        frames = FrameSpan(is_free=not is_silent, is_held=is_held and is_silent, is_late=t_s <= late_until_s)
        monitor.step(MotionSum(t_s, rolled_m, 0.0, 0.0), (), frames)
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
        monitor.step(0.05 * k, DeckPose(panel.x_m + x_m, panel.y_m, 0.0), sigma_m)
    assert monitor.missed == [4] * 4  # seams, by sensors that are never off
    for turned in range(60):
        monitor.step(0.05 * (2 * steps + turned), DeckPose(panel.x_m, panel.y_m, 0.05 * turned), 1e-3)
    assert monitor.missed == [4] * 4


FULL = f"{MAX_ACTIVE} emergencies are active already (the operation is aborted)"
OUT, UNKNOWN = "the robot is neither at base nor held", "no emergency with that id"


@pytest.mark.parametrize(
    ("steps", "newest", "raised"),
    [  # (kind or "clear" or "out", id, why it is refused): "out" clears while the robot is out on the mirror
        *([[(kind.value, "a", None)], kind.value, 1] for kind in EmergencyKind),
        ([("fire", "a", None), ("clear", "a", None)], None, 1),
        ([("flood", "a", "unknown kind 'flood'"), ("clear", "a", UNKNOWN)], None, 0),
        ([("fire", "a", None), ("out", "a", OUT)], "fire", 1),
        # The same id again is the same emergency, also after its clear; but an earthquake holds the robot.
        ([("fire", "a", None), ("power", "a", None)], "fire", 1),
        ([("fire", "a", None), ("clear", "a", None), ("out", "a", None), ("fire", "a", None)], None, 1),
        ([("weather", "a", None), ("earthquake", "a", None), ("fire", "a", None)], "earthquake", 2),
        # The latch opens with the last emergency.
        ([("fire", "a", None), ("power", "b", None), ("clear", "b", None)], "fire", 2),
        ([("fire", "a", None), ("power", "b", None), ("clear", "b", None), ("clear", "a", None)], None, 2),
        # A flood is bounded and stays latched; there is room for another kind.
        ([*(("weather", str(k), None) for k in range(MAX_ACTIVE)), ("weather", "x", FULL)], "weather", MAX_ACTIVE),
        ([*(("fire", str(k), None) for k in range(MAX_ACTIVE)), ("earthquake", "x", None)], "earthquake", 257),
        # The memory of cleared ids is bounded, too: raised again the oldest is a new one.
        ([(kind, str(k), None) for k in range(MAX_CLEARED + 1) for kind in ("fire", "clear")] + [("fire", "0", None)],
         "fire", MAX_CLEARED + 2),
    ],
)  # fmt: skip
def test_an_emergency_is_latched_until_it_is_cleared(
    steps: list[tuple[str, str, str | None]], newest: str | None, raised: int
) -> None:
    latch = EmergencyLatch()
    for what, name, refusal in steps:
        if what in ("clear", "out"):
            assert latch.clear(name, at_base_or_held=what == "clear") == refusal
        else:
            assert latch.raise_emergency(what, name, f"note {name}") == refusal
    assert (latch.raised, latch.is_latched, latch.is_shaking) == (raised, newest is not None, newest == "earthquake")
    found = latch.newest
    assert (found and found.kind) == newest
    assert found is None or (latch.holds(found.id) and found.note == f"note {found.id}")


def test_the_states_are_those_of_the_mission() -> None:
    assert {state.value for state in (Mode.IDLE, Mode.HELD, Mode.DONE)} == AT_BASE_OR_HELD
