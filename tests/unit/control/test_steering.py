"""The line of a leg and its regulator."""

from math import asin, cos, sin, sqrt

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from ccatp.control.tracker import LegLine, LegView, line_rate

NONE = (0.0, 0.0)


def test_the_rate_is_that_of_the_riccati_equation() -> None:
    g, w, v = 600.0, 9.0, 0.07
    a, b = np.array([[0.0, v], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    p = solve_continuous_are(a, b, np.diag([(g * v) ** 2, w]), np.eye(1))
    gain = (b.T @ p)[0]
    assert line_rate(LegView(0.1, 1.0, 0.0, 1.0), v, g, w) == pytest.approx(-gain[0], rel=1e-9)
    assert line_rate(LegView(0.1, 0.0, 1.0, 1.0), v, g, w) == pytest.approx(-gain[1], rel=1e-9)


def test_driving_the_other_way_turns_the_sign_of_the_error_beside_but_not_of_the_heading() -> None:
    forth, back = (line_rate(LegView(0.1, 0.001, 0.0, 1.0), v, 600.0, 9.0) for v in (0.1, -0.1))
    assert forth == -back < 0.0
    assert line_rate(LegView(0.1, 0.0, 0.1, 1.0), 0.1, 600.0, 9.0) == line_rate(
        LegView(0.1, 0.0, 0.1, 1.0), -0.1, 600.0, 9.0
    )


def test_an_error_beside_the_line_turns_nobody_who_stands() -> None:
    assert line_rate(LegView(0.0, 0.005, 0.0, 1.0), 0.0, 600.0, 9.0) == 0.0


@pytest.mark.parametrize("reverse", [False, True])
def test_left_of_the_line_is_left_of_its_direction(reverse: bool) -> None:
    line = LegLine(0.12)
    heading = 3.141592653589793 if reverse else 0.0
    line.begin((0.0, 0.0, heading), (1.0, 0.0), reverse)
    sight = line.look((0.4, 0.01, heading + 0.1), (1.0, 0.0), NONE)
    assert sight == pytest.approx((0.6, 0.01, 0.1, 1.0))


def test_against_a_drift_the_body_points_beside_the_line_and_progress_counts_it() -> None:
    line = LegLine(0.12)
    line.begin((0.0, 0.0, 0.0), (0.0, 1.0), False)
    angle = asin(0.04)  # the drift is towards -x, which is left of +y: the body points to the right
    sight = line.look((0.0, 0.0, np.pi / 2 - angle), (0.0, 1.0), (-0.04, 0.03))
    assert sight.off_rad == pytest.approx(0.0, abs=1e-12)
    assert sight.gain == pytest.approx(sqrt(1.0 - 0.04**2) + 0.03)


def test_a_new_frame_from_afar_lays_the_line_anew_through_the_stop() -> None:
    line = LegLine(0.12)
    line.begin((0.0, 0.0, 0.0), (1.0, 0.0), False)
    line.look((0.2, 0.002, 0.01), (1.0, 0.0), NONE)
    sight = line.look((5.0, 5.0, 0.71), (5.0 + 0.8 * cos(0.7), 5.0 + 0.8 * sin(0.7)), NONE)
    assert sight == pytest.approx((0.8, 0.0, 0.01, 1.0), abs=1e-12)


def test_a_new_frame_near_by_keeps_the_angle_to_the_robot() -> None:
    line = LegLine(0.12)
    line.begin((0.0, 0.0, 0.0), (1.0, 0.0), False)
    before = line.look((0.95, 0.002, 0.03), (1.0, 0.0), NONE)
    turned = 0.7
    c, s = cos(turned), sin(turned)
    ahead, left = 0.05, -0.002
    target = (5.0 + c * ahead - s * left, 5.0 + s * ahead + c * left)
    assert line.look((5.0, 5.0, 0.03 + turned), target, NONE) == pytest.approx(before, abs=1e-12)
