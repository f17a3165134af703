"""Pure but for reading the shipped configuration. What must hold for both localizers whatever the link delivers."""

from collections.abc import Callable
from contextlib import suppress
from functools import cache
from math import hypot, inf, isfinite, nan, pi
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ccatp.core import EdgeSample, GravitySample, ImuSample, PanelPose, WheelSample
from ccatp.estimation.fixes import FixRefused
from ccatp.estimation.odometry import arc_step
from ccatp.estimation.thesis_localizer import FourStateLocalizer
from ccatp.kinematics import difference
from tests.faults.linking import Measured
from tests.unit.estimation.drive import STEEP, Errors, Frame, Robot, build, changed, fix_at, mirror, run, trapeze

FRAMES = 40
WRONG = Errors(right_slip=0.02, left_slip=0.01, creep=0.02, gyro_bias=0.01, noise=1.0)
measuring = settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
again_frames = st.lists(st.tuples(st.integers(0, FRAMES - 1), st.integers(0, 4)), max_size=12)


def four_states() -> FourStateLocalizer:
    return FourStateLocalizer(changed("kf"), mirror(), STEEP)


MAKE: dict[str, Callable[[], Any]] = {"four states": four_states, "full state": build}
kinds = st.sampled_from(sorted(MAKE))


@cache
def drive() -> tuple[Frame, ...]:
    """0.4 s, with a rest at first."""
    robot = Robot(v=trapeze(0.1, 9.0, 0.1, 0.4), omega=lambda t: 0.3 * (t > 0.1), errors=WRONG)
    return tuple(robot.frames(0.01 * FRAMES))


@cache
def clean(kind: str) -> Any:
    found = MAKE[kind]()
    run(found, list(drive()))
    return found


def is_alike(kind: str, found: Any) -> bool:
    """Whether it is where the clean one is: to the last bit, or to that of sums in another order."""
    pose, expected = found.pose, clean(kind).pose
    if kind == "full state":
        return pose == expected and np.array_equal(found.state[0], clean(kind).state[0])
    away_m = hypot(pose.x_m - expected.x_m, pose.y_m - expected.y_m)
    return away_m < 1e-14 and abs(difference(pose.heading_rad, expected.heading_rad)) < 1e-13


@pytest.mark.fault("S14")
@settings(max_examples=60, deadline=None)
@given(kinds, again_frames)
def test_repeated_and_late_frames_leave_the_pose_identical(kind: str, again: list[tuple[int, int]]) -> None:
    # After frame k comes once more what was sent up to four frames before.
    found = MAKE[kind]()
    for k, frame in enumerate(drive()):
        found.step(*frame)
        for after, back in again:
            if after == k:
                found.step(*drive()[max(0, k - back)])
    assert found.pose == clean(kind).pose
    assert is_alike(kind, found)
    assert found.counts["stale_frames"] == len(again)


@settings(max_examples=60, deadline=None)
@given(kinds, again_frames, st.randoms(use_true_random=False))
def test_samples_that_come_again_or_late_change_nothing(
    kind: str, again: list[tuple[int, int]], random: Random
) -> None:
    """Samples of frames before, put in front of or behind those of a frame."""
    found = MAKE[kind]()
    for k, frame in enumerate(drive()):
        imu, encoders = list(frame.imu), list(frame.encoders)
        for after, back in again:
            if after == k > 0:
                old = drive()[max(0, k - 1 - back)]
                encoders.insert(random.choice((0, len(encoders))), random.choice(old.encoders))
                imu.insert(0, old.imu[0])
        found.step(frame.t_s, imu, encoders, frame.edges, None)
    assert is_alike(kind, found)
    assert found.counts["backward"] == 0


@pytest.mark.fault("S11")
@measuring
@given(kind=kinds, random=st.randoms(use_true_random=False))
def test_any_permutation_of_samples_never_runs_backward(measured: Measured, kind: str, random: Random) -> None:
    # Out of order within and across frames; whatever is used, the filter stays finite and near the truth.
    found = MAKE[kind]()
    samples = [sample for frame in drive() for sample in frame.encoders]
    for i in range(0, len(samples), 15):
        part = samples[i : i + 15]
        random.shuffle(part)
        samples[i : i + 15] = part
    for k, frame in enumerate(drive()):
        before_s = found.t_s
        found.step(frame.t_s, frame.imu, samples[10 * k : 10 * k + 10], frame.edges, None)
        assert found.t_s == frame.t_s
        measured("S11", found.t_s < before_s)
    expected = clean(kind).pose
    # At worst the last frames hold no sample.
    assert hypot(found.pose.x_m - expected.x_m, found.pose.y_m - expected.y_m) < 1e-3
    assert found.heading_sigma_rad > 0.0


number = st.one_of(st.sampled_from([nan, inf, -inf, 0.0, 1e300, -1e300, 5e-324]), st.floats(-1e3, 1e3), st.floats())
times = st.one_of(st.sampled_from([nan, inf, -inf, 0.0, 1e300, -5.0]), st.floats(0.3, 0.8), st.floats())
rubbish = st.tuples(
    times,
    st.lists(st.builds(ImuSample, times, number, number), max_size=3),
    st.lists(st.builds(WheelSample, times, st.none() | number, st.none() | number), max_size=3),
    st.lists(st.builds(EdgeSample, times, *[st.integers(0, 1)] * 4), max_size=3),
    st.none() | st.builds(GravitySample, times, number, number, number),
)


def check_pose(found: Any) -> None:
    pose = found.pose
    assert isfinite(pose.x_m + pose.y_m)
    assert -3.2 < pose.heading_rad < 3.2
    assert isfinite(found.speed_m_s + found.rate_rad_s + found.position_sigma_m + found.heading_sigma_rad)


@settings(max_examples=120, deadline=None)
@given(kinds, st.lists(rubbish, max_size=6), st.booleans())
def test_whatever_comes_the_pose_is_a_pose(kind: str, frames: list[tuple[Any, ...]], with_fixes: bool) -> None:
    found = MAKE[kind]()
    run(found, list(drive())[:30])
    for frame in frames:
        found.step(*frame)
        # The same values at times that are believed.
        at_s, imu, encoders, edges = found.t_s + 0.01, *frame[1:4]
        found.step(at_s, *([one._replace(t_s=at_s) for one in part] for part in (imu, encoders, edges)), None)
        check_pose(found)
        if kind == "four states":
            continue
        if with_fixes and not found.is_frozen:
            with suppress(FixRefused):
                found.fuse_fix(fix_at(found.t_s, (found.deck_pose.x_m, found.deck_pose.y_m)))
            check_pose(found)
        assert -pi <= found.deck_pose.heading_rad <= pi
        P = found.state[1]
        assert np.array_equal(P, P.T)
        assert np.linalg.eigvalsh(P)[0] > -1e-9 * float(P.max())  # rounding against the largest variance


@settings(max_examples=20, deadline=None)
@given(st.integers(-2, 2), st.floats(-3.0, 3.0))
def test_whole_turns_of_the_start_do_not_matter(turns: int, heading: float) -> None:
    one, other = (build(start=PanelPose(STEEP.panel, 0.0, 0.0, heading + 2.0 * pi * n)) for n in (0, turns))
    for found in (one, other):
        run(found, list(drive()))
        found.fuse_fix(fix_at(found.t_s, (found.deck_pose.x_m + 1e-3, found.deck_pose.y_m)))
    assert hypot(one.deck_pose.x_m - other.deck_pose.x_m, one.deck_pose.y_m - other.deck_pose.y_m) < 1e-9  # rounding
    assert abs(difference(one.deck_pose.heading_rad, other.deck_pose.heading_rad)) < 1e-9


@settings(max_examples=20, deadline=None)
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


@pytest.mark.fault("S29")
@measuring
@given(
    v=st.floats(-0.3, 0.3), theta=st.floats(-6.3, 6.3), turn=st.floats(-0.5, 0.5), dt=st.floats(1e-4, 0.1),
    parts=st.integers(2, 5),
)  # fmt: skip
def test_a_step_is_the_sum_of_its_parts(
    measured: Measured, v: float, theta: float, turn: float, dt: float, parts: int
) -> None:
    # Constant speed and rate: however the time is cut, the arc ends at the same point.
    steps = [arc_step(v, theta + turn * k / parts, turn / parts, dt / parts) for k in range(parts)]
    whole = arc_step(v, theta, turn, dt)
    # Rounding is far below the bound.
    measured("S29", hypot(sum(x for x, _ in steps) - whole[0], sum(y for _, y in steps) - whole[1]))
