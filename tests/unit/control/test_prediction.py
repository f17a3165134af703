"""The predictor against the exact motion of a first-order servo."""

from math import cos, exp, sin

import pytest

from ccatp.control.prediction import CommandPredictor
from ccatp.core import Predicted

DT, LAG = 0.01, 0.08
POSE = (0.1, -0.2, 0.7)


def rolled(commands: list[tuple[float, float]], v: float, omega: float, steps: int = 1000) -> Predicted:
    """Fine Euler steps of the same servo and body."""
    x, y, heading = POSE
    for v_set, omega_set in commands:
        h = DT / steps
        for _ in range(steps):
            x, y, heading = x + h * v * cos(heading), y + h * v * sin(heading), heading + h * omega
            v, omega = v + h * (v_set - v) / LAG, omega + h * (omega_set - omega) / LAG
    return Predicted((x, y, heading), v, omega)


@pytest.fixture
def predictor() -> CommandPredictor:
    predictor = CommandPredictor(LAG, DT)
    for seq in range(1, 7):
        predictor.sent(seq, 0.01 * seq, 0.1 * seq)
    return predictor


def test_without_delay_the_estimate_is_returned_unchanged(predictor: CommandPredictor) -> None:
    assert predictor.ahead(POSE, 0.05, 0.3, 6, DT, False, (0.05, 0.05)) == Predicted(POSE, 0.05, 0.3)


def test_commands_on_the_way_act_for_a_frame_each(predictor: CommandPredictor) -> None:
    ahead = predictor.ahead(POSE, 0.05, 0.3, 3, DT, False)
    expected = rolled([(0.04, 0.4), (0.05, 0.5), (0.06, 0.6)], 0.05, 0.3)
    # Steps of 10 us are good to 1e-6 of the 1.5 mm and 9 mrad travelled; the midpoint rule to less.
    assert ahead.pose == pytest.approx(expected.pose, abs=1e-6)
    assert (ahead.v_m_s, ahead.omega_rad_s) == pytest.approx((expected.v_m_s, expected.omega_rad_s), abs=1e-4)


def test_an_echo_younger_than_a_frame_acts_for_the_rest_of_it(predictor: CommandPredictor) -> None:
    fresh = predictor.ahead(POSE, 0.05, 0.3, 6, 0.0, False)
    keep = exp(-DT / LAG)
    assert fresh.v_m_s == pytest.approx(0.06 - 0.01 * keep)
    assert predictor.ahead(POSE, 0.05, 0.3, 6, 0.4 * DT, False).v_m_s < fresh.v_m_s


def test_a_repeated_echo_leaves_more_on_the_way(predictor: CommandPredictor) -> None:
    first = predictor.ahead(POSE, 0.0, 0.0, 5, DT, False)
    predictor.sent(7, 0.07, 0.0)
    again = predictor.ahead(POSE, 0.0, 0.0, 5, 2 * DT, False)
    assert again.v_m_s > first.v_m_s > 0.0


def test_a_lost_echo_or_command_is_passed_over(predictor: CommandPredictor) -> None:
    predictor.ahead(POSE, 0.0, 0.0, 2, DT, False)
    # 3 and 4 never came: what counts is that 5 is in force.
    assert predictor.ahead(POSE, 0.05, 0.0, 5, DT, False).v_m_s == pytest.approx(0.06 - 0.01 * exp(-DT / LAG))


def test_nothing_in_force_means_that_all_is_on_the_way() -> None:
    predictor = CommandPredictor(LAG, DT)
    predictor.sent(1, 0.1, 0.0)
    assert predictor.ahead(POSE, 0.0, 0.0, -1, 0.5, False).v_m_s == pytest.approx(0.1 * (1.0 - exp(-DT / LAG)))


def test_held_wheels_run_down_whatever_was_sent(predictor: CommandPredictor) -> None:
    assert predictor.ahead(POSE, 0.0, 0.0, 2, DT, True) == Predicted(POSE, 0.0, 0.0)
    assert predictor.ahead(POSE, 0.05, 0.0, 2, DT, True).v_m_s == pytest.approx(0.05 * exp(-4 * DT / LAG))


def test_a_restart_forgets_what_was_sent(predictor: CommandPredictor) -> None:
    predictor.sent(1, 0.0, 0.0)
    assert predictor.ahead(POSE, 0.0, 0.0, -1, DT, False) == Predicted(POSE, 0.0, 0.0)
    predictor.sent(2, 0.1, 0.0)
    predictor.reset()
    assert predictor.ahead(POSE, 0.0, 0.0, -1, DT, False) == Predicted(POSE, 0.0, 0.0)


def test_the_reach_is_bounded() -> None:
    predictor = CommandPredictor(LAG, DT)
    for seq in range(1000):
        predictor.sent(seq, 0.1, 0.0)
    ahead = predictor.ahead((0.0, 0.0, 0.0), 0.1, 0.0, -1, 9.0, False)
    assert ahead.pose[0] == pytest.approx(0.1 * 0.25)  # a quarter of a second: the time-to-live of a drive


def test_drift_carries_the_body_along(predictor: CommandPredictor) -> None:
    still = predictor.ahead(POSE, 0.05, 0.0, 4, DT, False).pose
    carried = predictor.ahead(POSE, 0.05, 0.0, 4, DT, False, (0.1, -0.2)).pose
    travel = ((still[0] - POSE[0]) ** 2 + (still[1] - POSE[1]) ** 2) ** 0.5
    assert carried[0] - still[0] == pytest.approx(0.1 * travel, rel=1e-3)  # the path is an arc of 10 mrad
    assert carried[1] - still[1] == pytest.approx(-0.2 * travel, rel=1e-3)


def test_a_servo_without_lag_follows_at_once() -> None:
    predictor = CommandPredictor(0.0, DT)
    predictor.sent(1, 0.1, 0.0)
    assert predictor.ahead((0.0, 0.0, 0.0), 0.0, 0.0, 0, DT, False) == Predicted((0.1 * DT, 0.0, 0.0), 0.1, 0.0)


def test_a_frame_takes_time() -> None:
    with pytest.raises(ValueError, match=r"frame_s = 0\.0: the period of the frames must be positive"):
        CommandPredictor(LAG, 0.0)
