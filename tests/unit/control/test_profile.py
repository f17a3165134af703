"""Rest-to-rest profiles and the lag feed-forward."""

from math import exp

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ccatp.control.pid import Profile, lag_feed_forward


def test_trapezoid_takes_the_bang_bang_time() -> None:
    profile = Profile.rest_to_rest(0.22, 0.1, 0.2)
    # d/v + v/a
    assert profile.duration_s == pytest.approx(0.22 / 0.1 + 0.1 / 0.2, abs=1e-12)
    assert profile.at(profile.duration_s) == (0.22, 0.0)


def test_triangle_where_there_is_no_room_to_cruise() -> None:
    profile = Profile.rest_to_rest(-0.01, 0.1, 0.2)
    assert profile.cruise_s == pytest.approx(0.0, abs=1e-12)
    assert profile.duration_s == pytest.approx(2.0 * (0.01 / 0.2) ** 0.5, abs=1e-12)
    assert profile.at(0.5 * profile.duration_s)[0] == pytest.approx(-0.005, abs=1e-12)


def test_nothing_to_do_takes_no_time() -> None:
    assert Profile.rest_to_rest(0.0, 0.1, 0.2).duration_s == 0.0


@pytest.mark.parametrize(("v", "a"), [(0.0, 1.0), (1.0, 0.0), (-1.0, 1.0)])
def test_limits_must_be_positive(v: float, a: float) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        Profile.rest_to_rest(1.0, v, a)


@given(st.floats(-5.0, 5.0), st.floats(0.01, 1.0), st.floats(0.05, 4.0), st.floats(0.0, 1.0), st.floats(1e-4, 0.02))
def test_limits_hold_and_velocity_is_the_derivative(d: float, v: float, a: float, part: float, h: float) -> None:
    profile = Profile.rest_to_rest(d, v, a)
    t = part * profile.duration_s
    position, speed = profile.at(t)
    assert abs(speed) <= v * (1.0 + 1e-12)
    assert abs(position) <= abs(d) + 1e-12
    later = profile.at(t + h)
    # The speed changes by at most a h within h, so the mean speed lies within a h of the speed.
    assert abs(later[1] - speed) <= a * h + 1e-12
    assert abs((later[0] - position) / h - speed) <= a * h + 1e-9


def test_feed_forward_inverts_the_servo_lag() -> None:
    lag, dt, now, after = 0.08, 0.01, 0.04, 0.042
    set_point = lag_feed_forward(now, after, dt, lag)
    reached = set_point + (now - set_point) * exp(-dt / lag)
    assert reached == pytest.approx(after, abs=1e-15)
    assert lag_feed_forward(now, after, dt, 0.0) == after
