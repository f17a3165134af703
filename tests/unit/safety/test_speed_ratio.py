"""The ratio between a wheel's speed and its set point: near 1 for sound wheels, found within a second for others."""

from collections.abc import Iterator
from math import exp, floor, pi

import pytest

from ccatp.conditions.danger import WHEEL_SPEED_WRONG
from ccatp.safety.speed_ratio import SpeedRatioMonitor
from tests.support.scenario import config_of

FRAME_S = 0.01
CFG = config_of()
RADIUS_M, LAG_S = CFG.robot.wheel_radius_m, CFG.robot.wheel_lag_s
COUNT_RAD = 2.0 * pi / 1200


def legs(speed_m_s: float, acceleration_m_s2: float, cruise_s: float) -> Iterator[float]:
    """Set points (m/s) of legs forth and back for ever: trapezoids with a rest of half a second between them."""
    ramp = round(speed_m_s / acceleration_m_s2 / FRAME_S)
    up = [speed_m_s * k / ramp for k in range(1, ramp + 1)]
    leg = [*up, *[speed_m_s] * round(cruise_s / FRAME_S), *up[::-1], *[0.0] * 50]
    while True:
        yield from leg
        yield from (-v for v in leg)


def drive(
    ratio: float, frames: int, *, speed_m_s: float = 0.1, lag: float = 1.0, delay: int = 0, clock: float = 1.0,
    counts: bool = False, cruise_s: float = 1.5, wrong_from: int = 0,
) -> tuple[SpeedRatioMonitor, list[float], float]:  # fmt: skip
    """The monitor after some frames, all ratios that it found, and the time until its finding (infinite: none).

    The right wheel turns ``ratio`` times as fast as commanded from a frame on. ``lag``: the servo's time constant over
    the configured one; ``delay``: frames until a set point acts; ``clock``: rate of the robot's clock.
    """
    monitor, source = SpeedRatioMonitor(CFG.health, CFG.robot), legs(speed_m_s, 0.2, cruise_s)
    keep = exp(-FRAME_S * clock / (LAG_S * lag))
    sent, wheels, angles, counted = [0.0] * (delay + 1), [0.0, 0.0], [0.0, 0.0], [0, 0]
    span: list[float] = []
    ratios, found_s = [], float("inf")
    for k in range(1, frames + 1):
        u = next(source) / RADIUS_M
        span.append(u)
        sent.append(u)
        now = sent[-2 - delay]
        rates = []
        for side in range(2):
            target = now * (ratio if side == 0 and k >= wrong_from else 1.0)
            before = wheels[side]
            wheels[side] = target + (before - target) * keep
            angles[side] += 0.5 * (before + wheels[side]) * FRAME_S * clock
            if counts:
                new = floor(angles[side] / COUNT_RAD)
                rates.append((new - counted[side]) * COUNT_RAD / FRAME_S)
                counted[side] = new
            else:
                rates.append(0.5 * (before + wheels[side]) * clock)
        monitor.add(FRAME_S, rates[0], rates[1])
        if k % 5 == 0:
            monitor.take(FRAME_S * k, (min(span), max(span), min(span), max(span)))
            span = [span[-1]]
            ratios += [r for r in monitor.ratios if r is not None]
            if monitor.alarm.finding is not None and found_s == float("inf"):
                found_s = FRAME_S * (k - wrong_from)
    return monitor, ratios, found_s


@pytest.mark.parametrize("counts", [False, True])
@pytest.mark.parametrize("clock", [0.99, 1.01])
@pytest.mark.parametrize("delay", [0, 2, 4])
@pytest.mark.parametrize("lag", [0.5, 0.8, 1.2, 1.5])  # the worlds vary it by 20 %
@pytest.mark.parametrize(("speed_m_s", "cruise_s"), [(0.1, 1.5), (0.1, 0.0), (0.05, 0.3), (0.2, 0.5)])
def test_sound_wheels_are_far_within_the_limit(
    speed_m_s: float, cruise_s: float, lag: float, delay: int, clock: float, counts: bool
) -> None:
    monitor, ratios, _ = drive(
        1.0, 1500, speed_m_s=speed_m_s, cruise_s=cruise_s, lag=lag, delay=delay, clock=clock, counts=counts
    )
    assert monitor.alarm.finding is None
    assert ratios
    share = 0.5 if 0.8 <= lag <= 1.2 else 0.8
    assert max(abs(r - 1.0) for r in ratios) < share * CFG.health.ratio_share


@pytest.mark.parametrize("begin", [10, 60, 130])  # accelerating, at full speed, slowing down
@pytest.mark.parametrize("delay", [0, 4])
@pytest.mark.parametrize("ratio", [0.5, 0.75, 1.25, 1.5, 2.0, -1.0])
def test_a_wrong_ratio_is_found_within_a_second_of_motion(ratio: float, delay: int, begin: int) -> None:
    monitor, _, found_s = drive(ratio, 600, delay=delay, wrong_from=begin, cruise_s=3.0)
    assert found_s <= 1.0
    finding = monitor.alarm.finding
    assert finding is not None
    assert (finding.condition, finding.signal, finding.limit) == (WHEEL_SPEED_WRONG, "right_wheel", 1.0)
    assert abs(finding.value - 1.0) > CFG.health.ratio_share


def test_a_wheel_that_stands_is_left_to_the_rule_for_stalls() -> None:
    monitor, _, found_s = drive(0.0, 600, lag=0.1, wrong_from=100, cruise_s=3.0)
    assert (monitor.alarm.finding, found_s) == (None, float("inf"))


def test_a_ratio_just_within_the_limit_is_no_finding() -> None:
    for ratio in (0.87, 1.13):
        assert drive(ratio, 1000)[0].alarm.finding is None


def test_nothing_is_fitted_across_a_time_in_which_the_set_points_are_not_known() -> None:
    monitor = SpeedRatioMonitor(CFG.health, CFG.robot)
    u = 0.1 / RADIUS_M
    for k in range(1, 200):
        monitor.add(FRAME_S, u, u)
        if k % 5 == 0 and not 60 < k < 80:  # then no estimate for 0.2 s
            monitor.take(FRAME_S * k, (u, u, u, u))
            assert (monitor.ratios[0] is None) is (k < 60 or 80 <= k < 135), k


def test_set_points_that_the_robot_clamps_are_no_wrong_ratio() -> None:
    monitor = SpeedRatioMonitor(CFG.health, CFG.robot)
    monitor.largest_rad_s = 4.0
    for k in range(1, 200):
        monitor.add(FRAME_S, 4.0, 2.0)
        if k % 5 == 0:
            monitor.take(FRAME_S * k, (6.0, 6.0, 3.0, 3.0))
    assert list(monitor.ratios) == pytest.approx([1.0, 1.0])


def test_frames_without_samples_do_not_make_a_wheel_slow() -> None:
    monitor = SpeedRatioMonitor(CFG.health, CFG.robot)
    u = 0.1 / RADIUS_M
    for k in range(1, 200):
        monitor.add(FRAME_S, *((u, u) if k % 2 else (None, u)))
        if k % 5 == 0:
            monitor.take(FRAME_S * k, (u, u, u, u))
    assert list(monitor.ratios) == pytest.approx([1.0, 1.0])


def test_an_interval_without_samples_ends_the_window() -> None:
    monitor = SpeedRatioMonitor(CFG.health, CFG.robot)
    u = 0.1 / RADIUS_M
    for k in range(1, 200):
        monitor.add(FRAME_S, *((None, None) if 100 < k <= 110 else (u, u)))
        if k % 5 == 0:
            monitor.take(FRAME_S * k, (u, u, u, u))
            if k == 110:
                assert monitor.ratios == (None, None)
    assert monitor.alarm.finding is None
