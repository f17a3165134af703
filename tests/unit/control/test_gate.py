"""The last gate before the wheels."""

from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from ccatp.config.models import LimitsConfig
from ccatp.control.gate import DriveGate
from ccatp.control.kinematics import twist_of, wheel_rates
from ccatp.samples import EventCode, Twist, Verdict

LIMITS = LimitsConfig(v_max_m_s=0.1, a_max_m_s2=0.2, omega_max_rad_s=1.0, alpha_max_rad_s2=2.0)
FREE = Verdict(0, 0.0, EventCode.NORMAL, "", "", 0.0, 0.0, True, True, True)
R, L, DT = 0.03, 0.15, 0.01


def gate() -> DriveGate:
    return DriveGate(LIMITS, R, L, 8.0, 0.08)


def test_kinematics_round_trip() -> None:
    right, left = wheel_rates(Twist(0.05, 0.3), R, L)
    assert (right, left) == pytest.approx(((0.05 + 0.0225) / R, (0.05 - 0.0225) / R))
    back = twist_of(right, left, R, L)
    assert (back.v_m_s, back.omega_rad_s) == pytest.approx((0.05, 0.3))


@pytest.mark.parametrize(
    ("wanted", "without"),
    [
        (Twist(0.01, 0.0), replace(FREE, forward=False)),
        (Twist(-0.01, 0.0), replace(FREE, reverse=False)),
        (Twist(0.0, 0.1), replace(FREE, turn=False)),
    ],
)
def test_denies_what_is_not_permitted(wanted: Twist, without: Verdict) -> None:
    assert gate().pass_through(wanted, FREE, DT) != (0.0, 0.0)
    assert gate().pass_through(wanted, without, DT) == (0.0, 0.0)
    assert gate().pass_through(wanted, None, DT) == (0.0, 0.0)


@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_denies_what_is_not_finite(bad: float) -> None:
    under_test = gate()
    assert under_test.pass_through(Twist(bad, 0.0), FREE, DT) == (0.0, 0.0)
    assert under_test.pass_through(Twist(0.0, bad), FREE, DT) == (0.0, 0.0)
    assert under_test.denials == 2


def test_stops_at_once() -> None:
    under_test = gate()
    for _ in range(100):
        under_test.pass_through(Twist(0.1, 0.0), FREE, DT)
    assert under_test.pass_through(Twist(0.0, 0.0), FREE, DT) == (0.0, 0.0)


@given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=1, max_size=30))
def test_value_and_rate_are_limited(wanted: list[tuple[float, float]]) -> None:
    under_test = gate()
    last = Twist(0.0, 0.0)
    for v, omega in wanted:
        right, left = under_test.pass_through(Twist(v, omega), FREE, DT)
        assert abs(right) <= 8.0 + 1e-12
        assert abs(left) <= 8.0 + 1e-12
        now = twist_of(right, left, R, L)
        assert abs(now.v_m_s) <= 1.25 * LIMITS.v_max_m_s + 1e-12
        # Twice the feed-forward of the lag plus one frame of acceleration, each with the headroom of a quarter.
        step = 1.25 * LIMITS.a_max_m_s2 * (2.0 * 0.08 + DT) + 1e-9
        assert abs(now.v_m_s) <= abs(last.v_m_s) + step
        last = now
