"""A body that slides over its wheels: found within 50 ms, and nothing else is taken for it."""

from typing import NamedTuple

import numpy as np
import pytest

from ccatp.conditions import (
    Clear,
    Condition,
    MonitorFinding,
    Motion,
)
from ccatp.conditions.danger import (
    ACCELEROMETER_DIFFERENCES,
    GRIP_LITTLE,
    GRIP_LOST,
    GRIP_TOO_LITTLE,
)
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import GravitySample, ImuSample, Severity, WheelSample
from ccatp.danger import DangerMonitor
from ccatp.dataloop import motor_robot
from ccatp.mirror.mirror import Mirror
from ccatp.safety.escalation import SeverityEscalation
from ccatp.safety.grip_monitor import GripMonitor
from ccatp.sensing.wheel_means import WheelMeans
from ccatp.slide_rule import SlideRule

DT_S = 0.01
CFG = load_config()
REST = 150  # frames


def found_after_s(
    slide_m_s2: float, ahead: float, *, braking_m_s2: float = 0.0, turn_rad_s: float = 0.0, noise_m_s2: float = 0.0
) -> float | None:
    """Rest, 0.1 m/s, then a body that accelerates by ``slide_m_s2`` over its wheels, which brake; when it is found.

    ``ahead``: gravity along the robot. The accelerometer is off by 0.3 m/s^2.
    """
    monitor, means, rng = GripMonitor(CFG.health, CFG.robot), WheelMeans(CFG.robot), np.random.default_rng(2)
    speed_m_s = 0.0
    for k in range(REST + 100):
        t_s, sliding = DT_S * (k + 1), k >= REST + 60
        wheels_m_s2 = 0.2 if REST <= k < REST + 50 else -braking_m_s2 if sliding and speed_m_s > 0.0 else 0.0
        speed_m_s += wheels_m_s2 * DT_S
        rate = speed_m_s / CFG.robot.wheel_radius_m if k >= REST else 0.02 * (-1) ** k  # a load turns what is held
        means.take([WheelSample(t_s, rate, rate)], DT_S)
        ax = 0.3 + wheels_m_s2 + (slide_m_s2 if sliding else 0.0) + noise_m_s2 * float(rng.normal())
        imu = [ImuSample(t_s, ax, turn_rad_s if sliding else 0.0)]
        gravity = GravitySample(t_s, ahead, 0.0, 0.3) if k % 5 == 0 else None
        if monitor.step(t_s, DT_S, imu, means, gravity, 0.0):
            return t_s - DT_S * (REST + 60)
    return None


@pytest.mark.parametrize("ahead", [0.9, -0.9])
@pytest.mark.parametrize("slide_m_s2", [2.0, 2.5, 5.0, 9.0])
def test_a_slide_downhill_is_found_within_50_ms(slide_m_s2: float, ahead: float) -> None:
    after_s = found_after_s(slide_m_s2 * np.sign(ahead), ahead, noise_m_s2=0.3)
    assert after_s is not None
    assert after_s <= 0.05 + 1e-9


def test_a_turn_that_the_wheels_do_not_make_counts_with_it() -> None:
    alone, with_turn = found_after_s(1.2, 0.9), found_after_s(1.2, 0.9, turn_rad_s=0.5)
    assert with_turn is not None
    assert alone is None or with_turn < alone


@pytest.mark.parametrize(
    ("slide_m_s2", "ahead", "braking_m_s2"),
    [(0.0, 0.9, 1.2), (-5.0, 0.9, 0.0), (5.0, 0.0, 0.0), (20.0, 0.9, 0.0)],
    ids=["wheels that brake", "uphill", "on a level", "more than gravity: the sensor"],
)
def test_motion_that_is_no_slide(slide_m_s2: float, ahead: float, braking_m_s2: float) -> None:
    assert found_after_s(slide_m_s2, ahead, braking_m_s2=braking_m_s2, noise_m_s2=0.3) is None


def test_a_slide_that_the_robot_reports_counts(config: Config, mirror: Mirror) -> None:
    monitor = DangerMonitor(mirror, config.robot, config.danger, config.health)
    robot = motor_robot(config)
    frame = robot.delivered
    assert frame is not None
    assert monitor.step(frame, None).signal != "grip"
    robot.advance()
    frame = robot.delivered
    assert frame is not None
    frame.sliding = True
    verdict = monitor.step(frame, None)
    assert (verdict.signal, verdict.full_fans, verdict.forward, verdict.turn) == ("grip", True, False, False)


def test_its_row_holds_the_wheels_with_full_fans_until_a_fix_and_another_slide_is_a_fault() -> None:
    assert (GRIP_LOST.motion, GRIP_LOST.clear, GRIP_LOST.full_fans) == (Motion.NONE, Clear.AFTER_FIX, True)
    escalation, slide = SeverityEscalation(CFG.health), GRIP_LOST.found("grip", 0.06, 0.055)
    found = [escalation.escalate(t_s, [slide] if is_sliding else []) for t_s, is_sliding in enumerate((1, 0, 1))]
    assert [[one.severity for one in findings] for findings in found] == [[Severity.HOLD], [], [Severity.FAULT]]


@pytest.mark.parametrize(
    ("margin", "row"), [(0.0, None), (1.3, None), (1.2, GRIP_LITTLE), (1.04, GRIP_TOO_LITTLE), (0.5, GRIP_TOO_LITTLE)]
)
def test_the_measured_margin_gives_its_finding(margin: float, row: Condition | None) -> None:
    monitor = GripMonitor(CFG.health, CFG.robot)
    monitor.take_margin(margin)
    assert (monitor.finding and monitor.finding.condition) is row
    monitor.take_margin(1.4)
    assert monitor.finding is None


# -- contact noise of flat tyres ---------------------------------------------------------------------------------------

CONTACT_M_S = 0.002  # speed of the vibration
STEP_S = 0.002  # of the firmware's loop


class Ride(NamedTuple):
    """Times at which a slide was found, and the finding about the accelerometer at the end."""

    found_s: list[float]
    finding: MonitorFinding | None


def ride(
    seed: int, *, over_s: float, vibration_m_s: float = CONTACT_M_S, slide_m_s2: float = 0.0, end_s: float = 40.0
) -> Ride:
    """A drive on tyres that vibrate, with a slide in the last second; after a finding the wheels are held for 3 s.

    The accelerometer gives the change of the speed over the last ``over_s``.
    """
    monitor, means, rng = GripMonitor(CFG.health, CFG.robot), WheelMeans(CFG.robot), np.random.default_rng(seed)
    found_s: list[float] = []
    begin, speed_m_s, before_m_s = REST, 0.0, 0.0
    for k in range(round(end_s / DT_S)):
        t_s, is_driving = DT_S * (k + 1), k >= begin
        wheels_m_s2 = 0.2 if begin <= k < begin + 50 else 0.0
        speed_m_s = speed_m_s + wheels_m_s2 * DT_S if is_driving else 0.0
        rate = speed_m_s / CFG.robot.wheel_radius_m if is_driving else 0.02 * (-1) ** k
        means.take([WheelSample(t_s, rate, rate)], DT_S)
        between_m_s, now_m_s = vibration_m_s * rng.standard_normal(2) if is_driving else (0.0, 0.0)
        noise_m_s2 = (now_m_s - (before_m_s if over_s == DT_S else between_m_s)) / over_s
        before_m_s = now_m_s
        slide = slide_m_s2 if t_s > end_s - 1.0 else 0.0
        imu = [ImuSample(t_s, 0.3 + wheels_m_s2 + slide + noise_m_s2 + 0.05 * float(rng.normal()), 0.0)]
        gravity = GravitySample(t_s, 0.9, 0.0, 0.3) if k % 5 == 0 else None
        if monitor.step(t_s, DT_S, imu, means, gravity, 0.0):
            found_s.append(t_s)
            if slide:
                break
            begin = k + 300
    return Ride(found_s, monitor.noise)


def test_single_differences_are_named_and_do_not_hold_every_mission() -> None:
    rides = [ride(seed, over_s=STEP_S) for seed in range(8)]
    # Only before the contacts are counted, in the first seconds of motion. If none are, there are 57.
    assert [t_s for one in rides for t_s in one.found_s if t_s > 4.0] == []
    assert sum(len(one.found_s) for one in rides) <= 3
    assert {one.finding and one.finding.condition for one in rides} == {ACCELEROMETER_DIFFERENCES}
    assert ACCELEROMETER_DIFFERENCES.severity is Severity.INFORM


@pytest.mark.parametrize("seed", range(4))
def test_among_single_differences_a_slide_is_found_later(seed: int) -> None:
    found = ride(seed, over_s=STEP_S, slide_m_s2=9.0)
    assert found.found_s
    assert found.found_s[-1] - 39.0 <= 0.2 + 1e-9  # against a noise that reaches the limit by itself


@pytest.mark.parametrize("seed", range(4))
def test_means_are_not_taken_for_single_differences(seed: int) -> None:
    quiet = ride(seed, over_s=DT_S, vibration_m_s=CONTACT_M_S)
    assert quiet == Ride([], None)
    found = ride(seed, over_s=DT_S, vibration_m_s=CONTACT_M_S, slide_m_s2=2.5)
    assert 0.0 < found.found_s[-1] - 39.0 <= 0.05 + 1e-9


def test_contacts_expire_and_a_slide_is_no_contact() -> None:
    rule = SlideRule(0.055, 0.04)
    for k in range(100):
        rule.step(DT_S, (0.0, 0.03, 0.0, -0.09)[k % 4], 0.0, 0.0, (1.0, 0.0))
    assert rule.shows_contacts
    assert rule.limit_m_s > 0.055
    for _ in range(6000):
        rule.step(DT_S, 0.0, 0.0, 0.0, (1.0, 0.0))
    assert not rule.shows_contacts
    assert rule.limit_m_s == 0.055
    # A slide consists of samples of similar size, so its acceleration is no contact.
    for _ in range(100):
        rule.step(DT_S, 0.09, 0.0, 0.0, (1.0, 0.0))
    assert not rule.shows_contacts
