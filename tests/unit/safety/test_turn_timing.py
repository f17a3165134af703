"""Times of gyroscope and encoders against each other: near 0 for sound sensors, found within two turns for others."""

from collections import deque
from math import inf, pi
from random import Random

import pytest

from ccatp.conditions import text_of
from ccatp.conditions.danger import TURN_TIMES_DIFFER
from ccatp.core import ImuSample, WheelSample
from ccatp.safety.turn_timing import TurnTimingMonitor
from tests.support.scenario import config_of

FRAME_S = 0.01
HEALTH = config_of().health
TURN = (0.3, 0.5, 0.3, 1.0)  # s of speeding up, of turning, of slowing down, of rest
TURN_RAD_S = 1.0


def rate_at(t_s: float) -> float:
    """The yaw rate of a body that turns to one side, then to the other, for ever."""
    up_s, on_s, down_s, _ = TURN
    turn, at_s = divmod(t_s, sum(TURN))
    share = min(at_s / up_s, 1.0, max((up_s + on_s + down_s - at_s) / down_s, 0.0))
    return TURN_RAD_S * share * (1.0 if turn % 2 == 0 else -1.0)


def turned(
    seconds: float = 12.0, *, delay_s: float = 0.0, slip: float = 1.0, arrives_late: int = 0, imu_every: int = 1,
    bias_rad_s: float = 0.0, noise: float = 0.03, gap: range = range(0),
) -> tuple[TurnTimingMonitor, list[float], float]:  # fmt: skip
    """The monitor after some turns, all delays that it found, and the time of its first finding (infinite: none).

    The gyroscope shows the turn of ``delay_s`` ago and ``slip`` times that of the wheels. ``arrives_late``: frames
    until its samples arrive; ``imu_every``: frames between two of them; ``gap``: frames without encoder samples.
    """
    monitor, rng = TurnTimingMonitor(HEALTH), Random(1)
    on_their_way: deque[list[ImuSample]] = deque([[]] * arrives_late)
    delays, found_s = [], inf
    for k in range(1, round(seconds / FRAME_S)):
        t_s = k * FRAME_S
        by_gyroscope = slip * rate_at(max(t_s - delay_s, 0.0)) + bias_rad_s + rng.gauss(0.0, noise)
        on_their_way.append([ImuSample(t_s, 0.0, by_gyroscope)] if k % imu_every == 0 else [])
        by_wheels = rate_at(t_s - 0.5 * FRAME_S) + rng.gauss(0.0, noise)
        wheels = [] if k in gap else [WheelSample(t_s, 0.0, 0.0)]
        monitor.step(t_s, on_their_way.popleft(), wheels, by_wheels if wheels else None)
        if monitor.delay_s is not None:
            delays.append(monitor.delay_s)
        if found_s == inf and monitor.findings(t_s):
            found_s = t_s
    return monitor, delays, found_s


@pytest.mark.parametrize("delay_s", [-0.1, -0.05, -0.035, 0.035, 0.05, 0.1])
@pytest.mark.parametrize("slip", [0.8, 1.0, 1.1])
def test_a_delay_is_found_by_the_end_of_the_second_turn(delay_s: float, slip: float) -> None:
    monitor, delays, found_s = turned(delay_s=delay_s, slip=slip)
    assert found_s < 2.0 * sum(TURN)
    assert delays[-1] == pytest.approx(delay_s, rel=0.25)  # the derivative is a chord
    (finding,) = monitor.findings(found_s)
    assert (finding.condition, finding.signal, finding.limit) == (TURN_TIMES_DIFFER, "imu_wz", HEALTH.turn_delay_s)


def test_the_text_says_which_is_later() -> None:
    for delay_s, side in ((0.06, "later"), (-0.06, "earlier")):
        monitor, _, found_s = turned(6.0, delay_s=delay_s)
        (finding,) = monitor.findings(found_s)
        assert f" {side} than" in text_of(finding.cause)


SOUND: dict[str, dict[str, float | int]] = {
    "sound": {},
    "slip": {"slip": 0.75},
    "bias": {"bias_rad_s": 0.05},
    "noise": {"noise": 0.06},
    "samples of 20 Hz": {"imu_every": 5},
    "samples that arrive 60 ms late with right time stamps": {"arrives_late": 6},
}


@pytest.mark.parametrize("case", SOUND.values(), ids=SOUND)
def test_sound_sensors_raise_nothing(case: dict[str, float]) -> None:
    _, delays, found_s = turned(30.0, **case)  # type: ignore[arg-type]
    assert found_s == inf
    assert delays
    assert max(map(abs, delays)) < 0.5 * HEALTH.turn_delay_s


def test_a_gap_of_the_encoders_begins_again() -> None:
    """The turn in the gap is not known, so nothing before it counts."""
    first = round(0.5 * sum(TURN) / FRAME_S)
    _, delays, found_s = turned(3.0 * sum(TURN), gap=range(first, first + 30))
    assert delays
    assert found_s == inf


@pytest.mark.parametrize("last", [0, 1, 300])
def test_a_sensor_that_is_silent_is_not_waited_for(last: int) -> None:
    """What the other one sends must not be kept for ever."""
    monitor = TurnTimingMonitor(HEALTH)
    for k in range(1, 1000):
        t_s = k * FRAME_S
        imu = [ImuSample(t_s, 0.0, 0.0)] if k <= last else []
        monitor.step(t_s, imu, [WheelSample(t_s, 0.0, 0.0)], 0.0)
        assert monitor.waits_s < 1.1
    assert monitor.delay_s is None


def test_nothing_is_known_before_a_turn() -> None:
    monitor = TurnTimingMonitor(HEALTH)
    for k in range(1, 500):
        t_s = k * FRAME_S
        monitor.step(t_s, [ImuSample(t_s, 0.0, 0.02 * (-1) ** k)], [WheelSample(t_s, 0.0, 0.0)], 0.0)
    assert monitor.delay_s is None


def test_a_reset_forgets_the_alarm() -> None:
    monitor, _, found_s = turned(6.0, delay_s=pi / 50.0)
    monitor.reset()
    assert monitor.findings(found_s) == []
    assert monitor.delay_s is None
