"""Pure but for reading the shipped configuration. What holds for the full-state localizer whatever the link brings."""

from contextlib import suppress
from functools import cache
from math import hypot, inf, isfinite, nan, pi
from random import Random

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ccatp.core import EdgeSample, GravitySample, ImuSample, PanelPose, WheelSample, difference
from ccatp.estimation.fixes import FixRefused
from ccatp.estimation.full_state import FullStateLocalizer
from tests.unit.estimation.drive import STEEP, Errors, Frame, Robot, build, fix_at, run, trapeze

FRAMES = 60
WRONG = Errors(right_slip=0.02, left_slip=0.01, creep=0.02, gyro_bias=0.01, noise=1.0)


@cache
def drive() -> tuple[Frame, ...]:
    """0.6 s, with a rest at first."""
    robot = Robot(v=trapeze(0.3, 9.0, 0.1, 0.4), omega=lambda t: 0.3 * (t > 0.3), errors=WRONG)
    return tuple(robot.frames(0.01 * FRAMES))


@cache
def clean() -> FullStateLocalizer:
    found = build()
    run(found, list(drive()))
    return found


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(0, FRAMES - 1), st.integers(0, 4)), max_size=12))
def test_frames_that_come_again_change_nothing(again: list[tuple[int, int]]) -> None:
    found = build()
    for k, frame in enumerate(drive()):
        found.step(*frame)
        for after, back in again:
            if after == k:
                found.step(*drive()[max(0, k - back)])
    assert found.pose == clean().pose
    assert np.array_equal(found.state[0], clean().state[0])
    assert found.counts["stale_frames"] == len(again)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(st.integers(1, FRAMES - 1), st.integers(0, 3)), max_size=12), st.randoms(use_true_random=False)
)
def test_samples_that_come_again_or_late_change_nothing(again: list[tuple[int, int]], random: Random) -> None:
    """Samples of frames before, put in front of, behind or between those of a frame."""
    found = build()
    for k, frame in enumerate(drive()):
        imu, encoders = list(frame.imu), list(frame.encoders)
        for after, back in again:
            if after == k:
                old = drive()[max(0, k - 1 - back)]
                encoders.insert(random.choice((0, len(encoders))), random.choice(old.encoders))
                imu.insert(0, old.imu[0])
        found.step(frame.t_s, imu, encoders, frame.edges, None)
    assert found.pose == clean().pose
    assert np.array_equal(found.state[0], clean().state[0])


number = st.one_of(st.sampled_from([nan, inf, -inf, 0.0, 1e300, -1e300, 5e-324]), st.floats(-1e3, 1e3))
times = st.one_of(st.sampled_from([nan, inf, -inf, 0.0, 1e300, -5.0]), st.floats(0.5, 1.0))
imu_samples = st.builds(ImuSample, times, number, number)
wheel_samples = st.builds(WheelSample, times, st.one_of(st.none(), number), st.one_of(st.none(), number))
edge_samples = st.builds(EdgeSample, times, *[st.integers(0, 1)] * 4)
gravity_samples = st.one_of(st.none(), st.builds(GravitySample, times, number, number, number))
rubbish = st.tuples(
    times,
    st.lists(imu_samples, max_size=3),
    st.lists(wheel_samples, max_size=3),
    st.lists(edge_samples, max_size=3),
    gravity_samples,
)


@settings(max_examples=60, deadline=None)
@given(st.lists(rubbish, max_size=8), st.booleans())
def test_whatever_comes_the_pose_is_a_pose(frames: list[tuple[object, ...]], with_fixes: bool) -> None:
    found = build()
    run(found, list(drive())[:50])
    for frame in frames:
        found.step(*frame)  # type: ignore[arg-type]
        if with_fixes and not found.is_frozen:
            with suppress(FixRefused):
                found.fuse_fix(fix_at(found.t_s, (found.deck_pose.x_m, found.deck_pose.y_m)))
        pose = found.pose
        assert isfinite(pose.x_m + pose.y_m + pose.heading_rad)
        assert -pi <= found.deck_pose.heading_rad <= pi
        assert isfinite(found.speed_m_s + found.rate_rad_s + found.position_sigma_m + found.heading_sigma_rad)
        P = found.state[1]
        assert np.array_equal(P, P.T)
        assert np.linalg.eigvalsh(P)[0] > -1e-9 * float(P.max())  # rounding against the largest variance


@settings(max_examples=30, deadline=None)
@given(st.integers(-2, 2), st.floats(-3.0, 3.0))
def test_whole_turns_of_the_start_do_not_matter(turns: int, heading: float) -> None:
    one, other = (build(start=PanelPose(STEEP.panel, 0.0, 0.0, heading + 2.0 * pi * n)) for n in (0, turns))
    for found in (one, other):
        run(found, list(drive()))
        found.fuse_fix(fix_at(found.t_s, (found.deck_pose.x_m + 1e-3, found.deck_pose.y_m)))
    assert hypot(one.deck_pose.x_m - other.deck_pose.x_m, one.deck_pose.y_m - other.deck_pose.y_m) < 1e-9  # rounding
    assert abs(difference(one.deck_pose.heading_rad, other.deck_pose.heading_rad)) < 1e-9


@settings(max_examples=30, deadline=None)
@given(st.floats(-4e-3, 4e-3), st.floats(-4e-3, 4e-3), st.floats(1e-5, 1e-2))
def test_a_fix_pulls_towards_itself_and_makes_surer(dx: float, dy: float, sigma_m: float) -> None:
    found = build()
    run(found, list(drive()))
    found.fuse_fix(fix_at(found.t_s, (found.deck_pose.x_m, found.deck_pose.y_m), 1e3))  # nothing but the last frames
    before, P = found.deck_pose, found.state[1]
    found.fuse_fix(fix_at(found.t_s, (before.x_m + dx, before.y_m + dy), sigma_m))
    after = found.deck_pose
    assert (after.x_m - before.x_m) * dx + (after.y_m - before.y_m) * dy >= -1e-12
    assert np.linalg.eigvalsh(P - found.state[1])[0] > -1e-9  # rounding of the largest variance, 0.1
