"""The last gate before the wheels, and that before the fans."""

from itertools import product
from math import inf, nan
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from ccatp.config.models import LimitsConfig
from ccatp.control.gate import Denial, DriveGate, FanGate, Purpose
from ccatp.core import EventCode, Twist, Verdict
from ccatp.daemon.loops.gate_log import GateLog
from ccatp.kinematics import twist_of, wheel_rates
from ccatp.survey.events import PURPOSES, Mode
from tests.support.scenario import config_of

LIMITS = LimitsConfig(v_max_m_s=0.1, a_max_m_s2=0.2, omega_max_rad_s=0.8, alpha_max_rad_s2=2.0)
FREE = Verdict.normal(0, 0.0)
R, L, DT = 0.03, 0.15, 0.01
VERDICT_S, FRAME_S = 0.15, 0.12
ZERO = 0.0, 0.0
# What one frame allows: twice the feed-forward of the lag and a frame of acceleration, with the headroom of a quarter.
STEP_M_S = 1.25 * LIMITS.a_max_m_s2 * (2.0 * 0.08 + DT)
STEP_RAD_S = 1.25 * LIMITS.alpha_max_rad_s2 * (2.0 * 0.08 + DT)
SLOW, BACK, ARC = Twist(0.01, 0.0), Twist(-0.01, 0.0), Twist(0.01, 0.1)
LEFT, RIGHT = Twist(0.0, 0.1), Twist(0.0, -0.1)


def gate(max_wheel_rad_s: float = 8.0) -> DriveGate:
    wheels = {"wheel_radius_m": R, "wheel_base_m": L, "max_wheel_rad_s": max_wheel_rad_s, "wheel_lag_s": 0.08}
    return DriveGate(LIMITS, config_of().robot.model_copy(update={**wheels, "sensors_timeout_s": FRAME_S}), VERDICT_S)


def drive(
    under_test: DriveGate,
    wanted: Twist,
    verdict: Verdict | None = FREE,
    *,
    dt_s: float = DT,
    t_s: float = 0.0,
    age_s: float = 0.0,
    purpose: Purpose = Purpose.SURVEY,
) -> Twist:
    right, left = under_test.pass_through(wanted, verdict, dt_s, t_s, age_s, purpose)
    return twist_of(right, left, R, L)


def denial(wanted: Twist, verdict: Verdict | None = FREE, **rest: object) -> Denial | None:
    """The reason; the drive is zero if and only if there is one, and it is counted once."""
    under_test = gate()
    passed = drive(under_test, wanted, verdict, **rest)  # type: ignore[arg-type]
    reason = under_test.denial
    assert (passed == Twist(0.0, 0.0)) is (reason is not None)
    assert under_test.denied == {each: int(each is reason) for each in Denial}
    return reason


def test_kinematics_round_trip() -> None:
    right, left = wheel_rates(Twist(0.05, 0.3), R, L)
    assert (right, left) == pytest.approx(((0.05 + 0.0225) / R, (0.05 - 0.0225) / R))
    back = twist_of(right, left, R, L)
    assert (back.v_m_s, back.omega_rad_s) == pytest.approx((0.05, 0.3))


@pytest.mark.parametrize(
    ("wanted", "verdict", "frame", "reason"),
    [
        *((wanted, {}, {}, None) for wanted in (SLOW, BACK, LEFT, RIGHT, ARC)),
        *((wanted, None, {}, Denial.NO_VERDICT) for wanted in (SLOW, BACK, LEFT, RIGHT, ARC)),
        (SLOW, {"forward": False}, {}, Denial.NOT_PERMITTED),
        (BACK, {"reverse": False}, {}, Denial.NOT_PERMITTED),
        *((wanted, {"turn": False}, {}, Denial.NOT_PERMITTED) for wanted in (LEFT, RIGHT, ARC)),
        (ARC, {"forward": False}, {}, Denial.NOT_PERMITTED),
        # A permit is for its own direction.
        (SLOW, {"reverse": False, "turn": False}, {}, None),
        (BACK, {"forward": False, "turn": False}, {}, None),
        (LEFT, {"forward": False, "reverse": False}, {}, None),
        *(
            (wanted, {}, {}, Denial.NOT_FINITE)
            for bad in (nan, inf, -inf)
            for wanted in (Twist(bad, 0.0), Twist(0.0, bad), Twist(0.05, bad))
        ),
        *((SLOW, {}, {"t_s": t_s}, None) for t_s in (VERDICT_S, -VERDICT_S)),
        *((SLOW, {}, {"t_s": 1.001 * t_s}, Denial.OLD_VERDICT) for t_s in (VERDICT_S, -VERDICT_S, nan)),
        *((SLOW, {"t_s": 1.0 - 0.9 * t_s}, {"t_s": 1.0}, None) for t_s in (VERDICT_S, -VERDICT_S)),
        (SLOW, {"t_s": nan}, {}, Denial.OLD_VERDICT),
        (SLOW, {}, {"age_s": FRAME_S}, None),
        *((SLOW, {}, {"age_s": age_s}, Denial.OLD_FRAME) for age_s in (1.001 * FRAME_S, nan)),
        *((SLOW, {}, {"dt_s": dt_s}, Denial.NO_TIME) for dt_s in (0.0, -0.01, nan)),
        (SLOW, {"code": EventCode.NEAR_EDGE}, {}, Denial.AT_EDGE),
        (SLOW, {"code": EventCode.NEAR_EDGE}, {"purpose": Purpose.RETREAT}, None),
        (SLOW, {"code": EventCode.NEAR_EDGE}, {"purpose": Purpose.HOMEWARD}, Denial.AT_EDGE),
        (SLOW, {"code": EventCode.ABORTED}, {}, Denial.ABORTED),
        *((SLOW, {"code": EventCode.ABORTED}, {"purpose": p}, None) for p in (Purpose.RETREAT, Purpose.HOMEWARD)),
        *((SLOW, {}, {"purpose": p}, None) for p in (Purpose.RETREAT, Purpose.HOMEWARD)),
    ],
)
def test_what_is_denied_and_why(
    wanted: Twist, verdict: dict[str, Any] | None, frame: dict[str, Any], reason: Denial | None
) -> None:
    assert denial(wanted, None if verdict is None else replace(FREE, **verdict), **frame) is reason


def test_every_state_has_a_purpose_and_those_that_stand_deny() -> None:
    assert set(PURPOSES) == set(Mode)
    moving = {state for state, purpose in PURPOSES.items() if denial(SLOW, purpose=purpose) is None}
    assert moving == {Mode.TURNING, Mode.DRIVING, Mode.BACKING_OFF, Mode.RETURNING}
    assert denial(SLOW, purpose=Purpose.STAND) is Denial.STATE


OFF = list(product((False, True), repeat=4))
RETREAT = Purpose.RETREAT


@pytest.mark.parametrize("off", OFF)
def test_invariant_i4_whatever_is_permitted(off: tuple[bool, bool, bool, bool]) -> None:
    at_edge = replace(FREE, code=EventCode.NEAR_EDGE, off=off)
    front, rear = off[0] or off[1], off[2] or off[3]
    assert denial(Twist(0.01, 0.0), at_edge, purpose=RETREAT) is (Denial.EDGE if front else None)
    assert denial(Twist(-0.01, 0.0), at_edge, purpose=RETREAT) is (Denial.EDGE if rear else None)
    assert denial(Twist(0.0, 0.1), at_edge, purpose=RETREAT) is None
    assert denial(Twist(0.01, 0.0), replace(FREE, off=off)) is (Denial.EDGE if front else None)


def test_stops_at_once_and_that_is_no_denial() -> None:
    under_test = gate()
    for _ in range(100):
        drive(under_test, Twist(0.1, 0.0))
    assert under_test.pass_through(Twist(0.0, 0.0), None, nan, nan, inf, Purpose.STAND) == ZERO
    assert under_test.denial is None
    assert not any(under_test.denied.values())
    # It begins anew from rest.
    assert drive(under_test, Twist(0.1, 0.0)).v_m_s == pytest.approx(STEP_M_S)


def test_a_denial_stops_and_the_next_drive_begins_at_rest() -> None:
    under_test = gate()
    for _ in range(100):
        drive(under_test, Twist(0.1, 0.0))
    assert drive(under_test, Twist(0.1, 0.0), None) == Twist(0.0, 0.0)
    assert under_test.denial is Denial.NO_VERDICT
    assert drive(under_test, Twist(0.1, 0.0)).v_m_s == pytest.approx(STEP_M_S)
    assert under_test.denial is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("axis", "step", "limit"), [(0, STEP_M_S, 0.1), (1, STEP_RAD_S, 0.8)])
def test_the_exact_steps_of_value_and_rate(axis: int, step: float, limit: float, sign: float) -> None:
    under_test = gate()

    def passed(wanted: float) -> float:
        twist = drive(under_test, Twist(*(sign * wanted if each == axis else 0.0 for each in range(2))))
        return sign * (twist.v_m_s, twist.omega_rad_s)[axis]

    assert passed(0.9 * limit) == pytest.approx(step)  # within the limit, too fast for the first step
    assert passed(0.0) == 0.0
    assert [passed(9.0), passed(9.0)] == pytest.approx([step, 2.0 * step])
    assert [passed(9.0) for _ in range(10)][-1] == pytest.approx(1.25 * limit)
    # Slower at once, and through zero one step only.
    assert passed(0.01) == pytest.approx(0.01)
    assert passed(-9.0) == pytest.approx(-step)


def test_a_long_silence_allows_no_larger_step() -> None:
    allowed = 1.25 * LIMITS.a_max_m_s2 * (2.0 * 0.08 + 0.1)
    assert drive(gate(), Twist(0.1, 0.0), dt_s=0.1).v_m_s == pytest.approx(allowed)
    assert drive(gate(), Twist(0.1, 0.0), dt_s=60.0).v_m_s == pytest.approx(allowed)


def test_wheels_over_their_limit_are_slowed_down_as_a_whole() -> None:
    for twist in (Twist(0.04, 0.4), Twist(-0.04, 0.4), Twist(0.04, -0.4), Twist(0.01, 0.4)):
        right, left = wheel_rates(twist, R, L)
        limit = 0.5 * max(abs(right), abs(left))
        got = gate(limit).pass_through(twist, FREE, DT, 0.0, 0.0, Purpose.SURVEY)
        assert got == pytest.approx((0.5 * right, 0.5 * left))
        assert max(map(abs, got)) == pytest.approx(limit)


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=1, max_size=30))
def test_value_and_rate_are_limited(wanted: list[tuple[float, float]]) -> None:
    under_test = gate()
    last = Twist(0.0, 0.0)
    for v, omega in wanted:
        right, left = under_test.pass_through(Twist(v, omega), FREE, DT, 0.0, 0.0, Purpose.SURVEY)
        assert abs(right) <= 8.0 + 1e-12
        assert abs(left) <= 8.0 + 1e-12
        now = twist_of(right, left, R, L)
        assert abs(now.v_m_s) <= 1.25 * LIMITS.v_max_m_s + 1e-12
        assert abs(now.v_m_s) <= abs(last.v_m_s) + STEP_M_S + 1e-9
        last = now


def test_denials_are_reported_once_a_second_and_counted() -> None:
    under_test, reported = gate(), []
    watch = GateLog(under_test, lambda level, text: reported.append((level, text)))
    for k in range(250):
        drive(under_test, SLOW, None)
        watch.update(0.01 * k)
    assert [level for level, _ in reported] == ["warning"] * 3
    assert reported[1][1] == "drive denied: there is no verdict (101 so far)"
    drive(under_test, SLOW, purpose=Purpose.STAND)
    watch.update(2.5)
    assert "state allows no motion" in reported[3][1]
    drive(under_test, SLOW, None)
    watch.update(0.0)  # the robot's clock began anew
    assert len(reported) == 5
    drive(under_test, SLOW)
    watch.update(9.0)
    assert len(reported) == 5
    assert watch.counts == {"no_verdict": 251, "state": 1}


@pytest.mark.parametrize("bad", [0.59, 0.0, -0.1, 1.01, nan, inf])
def test_fans_below_their_floor_are_refused(bad: float) -> None:
    fans = FanGate(0.6)
    assert fans.refusal(0.6, 1.0) is None
    assert "left fan" in str(fans.refusal(bad, 0.8))
    assert "right fan" in str(fans.refusal(0.8, bad))
    assert fans.refused == 2


def test_without_an_overhang_there_is_no_floor() -> None:
    assert FanGate(0.0).refusal(0.0, 0.0) is None
