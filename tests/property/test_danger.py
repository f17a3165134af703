"""Properties of the edge rule on the real mirrors, with the plant and the drives of ``tools.edge_sweep``."""

from functools import lru_cache
from math import atan2, copysign, cos, hypot, pi, radians, sin

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from ccatp.core import DeckPose, PointId
from tools.edge_sweep import BLIND, MIRRORS, OVERRUN_M, Drive, Error, Tally, places, run_off, world

names = st.sampled_from(MIRRORS)
spots = st.integers(0, 100_000)  # on the rim
speeds = st.floats(0.02, 0.15)
angles = st.floats(radians(-60.0), radians(60.0))
# Within three sigma of the start errors of the worlds: 2 mm and 0.01 rad.
errors = st.tuples(st.floats(-0.004, 0.004), st.floats(-0.004, 0.004), st.floats(-0.02, 0.02))
few = settings(max_examples=12, deadline=None)  # which ones is the profile's choice

# -- over the rim -----------------------------------------------------------------------------------------------------


def drive_off(name: str, spot: int, angle: float, speed: float, error: Error) -> tuple[Tally, bool]:
    """Drive straight off the rim from 0.22 m inside it, at ``angle`` to its normal; speed < 0 = backwards.

    Also whether no inner corner is within reach: there the tip of a notch passes between the sensors, and only the map
    can tell (``ccatp.safety.edge_rule``).
    """
    place = places(name)[spot % len(places(name))]
    course, run_up = place.normal_rad + angle, 0.22 / cos(angle)
    x, y = place.x_m - run_up * cos(course), place.y_m - run_up * sin(course)
    # At a step of the rim the run-up may lie beyond it, or so close that the robot begins with a sensor off.
    assume(world(name)[1].rim.signed_distance_m(x, y) > 0.15)
    start = DeckPose(x, y, course if speed > 0.0 else course + pi)
    is_straight = all(hypot(place.x_m - vx, place.y_m - vy) > 0.25 for vx, vy in inner_corners(name))
    return run_off(name, start, speed, 0.0, np.random.default_rng(spot), error), is_straight


@lru_cache
def inner_corners(name: str) -> list[tuple[float, float]]:
    v = world(name)[1].rim.vertices.tolist()
    turns = [
        (b, (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0]))
        for a, b, c in zip(v[-1:] + v[:-1], v, v[1:] + v[:1], strict=True)
    ]
    return [(b[0], b[1]) for b, turn in turns if turn < 0.0]


def check_stopped(tally: Tally, centre_m: float) -> None:
    """An edge was declared, and the centre stayed so far inside the rim."""
    assert not tally.unseen
    assert tally.after_m <= OVERRUN_M  # invariant I5
    assert -tally.centre_m > centre_m


def far_off(name: str, spot: int) -> list[Error]:
    """A metre off; moved in by one panel and a gap and a half, so that the rim lies in a seam's middle; and none."""
    _, mirror = world(name)
    normal, panel = places(name)[spot % len(places(name))].normal_rad, next(iter(mirror.panels.values()))
    shift_x, shift_y = (2.0 * half + 1.5 * mirror.gap_m for half in (panel.half_x_m, panel.half_y_m))
    turned = [(cos(a), sin(a), b) for a, b in ((0.3 * spot, 0.0), (0.3 * spot, pi / 2), (0.3 * spot, 3.0))]
    return [*turned, (-cos(normal) * shift_x, -sin(normal) * shift_y, 0.0), BLIND]


@settings(max_examples=36, deadline=None)
@given(names, spots, angles, speeds, st.integers(0, 4))
def test_no_fall_with_an_estimate_that_is_far_off_or_none(
    name: str, spot: int, angle: float, speed: float, which: int
) -> None:
    tally, is_straight = drive_off(name, spot, angle, speed, far_off(name, spot)[which])
    check_stopped(tally, 0.0 if is_straight else -10.0)


@pytest.mark.parametrize("name", MIRRORS)
def test_no_fall_into_an_inner_corner_with_a_right_estimate(name: str) -> None:
    for x, y in inner_corners(name):
        # Along the bisector, outwards from the middle: the tip comes exactly under the centre.
        course = atan2(copysign(1.0, y), copysign(1.0, x))
        start = DeckPose(x - 0.15 * cos(course), y - 0.15 * sin(course), course)
        tally = run_off(name, start, 0.15, 0.0, np.random.default_rng(1), (0.002, -0.002, 0.005))
        check_stopped(tally, 0.02)  # 45 mm less 15 mm of stopping and 3 mm of error


# -- turns in place ---------------------------------------------------------------------------------------------------

turns = st.lists(st.tuples(st.integers(-16, 16), st.sampled_from([0.3, 1.0])), min_size=1, max_size=3)


def sees_an_edge_turning(
    name: str, place: tuple[float, float], heading: float, error: Error, steps: list[tuple[int, float]]
) -> bool:
    """Turn in place by multiples of 22.5 degrees, with a stop after each."""
    cfg, mirror = world(name)
    assume(mirror.rim.signed_distance_m(*place) > 0.128)  # a corner sensor's radius
    drive = Drive(name, DeckPose(*place, heading), np.random.default_rng(len(steps)), error)
    for sixteenths, rate in steps:
        set_points = drive.rig.at_speed(0.0, copysign(rate, sixteenths), cfg)
        for set_point, duration_s in ((set_points, abs(sixteenths) * pi / 8 / rate), ((0.0, 0.0), 0.4)):
            for _ in range(round(duration_s * drive.hz)):
                drive.frame(*set_point)
    return drive.has_edge


@few
@given(names, st.integers(0, 200), st.integers(1, 9), st.integers(0, 15), errors, turns)
def test_no_false_edge_in_turns_at_the_measurement_points(
    name: str, number: int, point: int, sixteenths: int, error: Error, steps: list[tuple[int, float]]
) -> None:
    _, mirror = world(name)
    panel = list(mirror.panels)[number % len(mirror.panels)]
    place = mirror.point_on_deck(PointId(*panel, point))
    assert not sees_an_edge_turning(name, place, sixteenths * pi / 8, error, steps)


@few
@example("thesis-m1", 40, (0.9, 1.0), 0.1, (0.0, 0.0, 0.0), [(16, 1.0)])
@given(names, st.integers(0, 200), st.tuples(st.floats(-1, 1), st.floats(-1, 1)), st.floats(-pi, pi), errors, turns)
def test_no_false_edge_in_turns_anywhere(
    name: str, number: int, share: tuple[float, float], heading: float, error: Error, steps: list[tuple[int, float]]
) -> None:
    _, mirror = world(name)
    panel = list(mirror.panels.values())[number % len(mirror.panels)]
    # The cube root crowds the places towards the seams, where the corner sensors sweep over them.
    x, y = (copysign(abs(s) ** (1 / 3), s) for s in share)
    place = panel.x_m + x * panel.half_x_m, panel.y_m + y * panel.half_y_m
    assert not sees_an_edge_turning(name, place, heading, error, steps)
