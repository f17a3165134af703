"""Pure but for reading the shipped configuration. What must hold for the localizer whatever the link delivers."""

from functools import cache
from math import hypot, isfinite
from random import Random

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import EdgeSample, ImuSample, PanelId, PanelPose, WheelSample, difference
from ccatp.estimation.odometry import arc_step
from ccatp.estimation.thesis_localizer import FourStateLocalizer as Localizer
from ccatp.filters import FILTERS
from ccatp.mirror.mirror import Mirror, build_mirror
from tests.faults.linking import Measured

Frame = tuple[float, list[ImuSample], list[WheelSample], list[EdgeSample]]

START = PanelPose(PanelId(3, 4), 0.02, -0.03, 0.4)
FRAMES = 30


@cache
def config() -> Config:
    return load_config()


@cache
def mirror() -> Mirror:
    return build_mirror(config().mirror)


def make() -> Localizer:
    cfg = config()
    return Localizer(FILTERS["kf"](np.zeros(4), np.eye(4)), mirror(), cfg.robot, cfg.localizer, START)


@cache
def drive() -> tuple[Frame, ...]:
    """0.3 s at about 0.1 m/s and 0.2 rad/s with the noise of the thesis; encoders and edges at 1 kHz, IMU at 100 Hz."""
    rng = np.random.default_rng(5)
    frames: list[Frame] = []
    for k in range(1, FRAMES + 1):
        t = 0.01 * k
        times = [t - 0.001 * i for i in range(9, -1, -1)]
        wheels = [
            WheelSample(s, *(3.33 + 0.5 * np.array([1, -1]) + 0.001 * rng.normal(size=2)).tolist()) for s in times
        ]
        imu = [ImuSample(t, 0.0059 * rng.normal(), 0.2 + 0.0087 * rng.normal())]
        frames.append((t, imu, wheels, [EdgeSample(s, 1, 1, 1, 1) for s in times]))
    return tuple(frames)


@cache
def clean_pose() -> PanelPose:
    localizer = make()
    for frame in drive():
        localizer.step(*frame)
    return localizer.pose


@pytest.mark.fault("S14")
@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(0, FRAMES - 1), st.integers(0, 4)), max_size=12))
def test_repeated_and_late_frames_leave_the_pose_identical(again: list[tuple[int, int]]) -> None:
    # S14: after frame k comes once more what was sent up to four frames before.
    localizer = make()
    frames = drive()
    for k, frame in enumerate(frames):
        localizer.step(*frame)
        for after, back in again:
            if after == k:
                localizer.step(*frames[max(0, k - back)])
    assert localizer.pose == clean_pose()
    assert localizer.counts["stale_frames"] == len(again)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(0, FRAMES - 1), st.integers(0, 9)), max_size=10), st.booleans())
def test_repeated_samples_leave_the_pose_identical(again: list[tuple[int, int]], append: bool) -> None:
    # S14 and S11: samples that were used before come again, at the end of their own list or of the next frame's head.
    localizer = make()
    frames = drive()
    for k, (t, imu, wheels, edges) in enumerate(frames):
        before = frames[k - 1][2] if k else []
        repeated = [(wheels if append else before)[i] for at, i in again if at == k and (append or before)]
        localizer.step(t, imu + imu, wheels + repeated if append else repeated + wheels, edges)
    found, clean = localizer.pose, clean_pose()
    # One frame sorted sample by sample rounds its back transition in another order than one taken whole.
    assert hypot(found.x_m - clean.x_m, found.y_m - clean.y_m) < 1e-14
    assert abs(difference(found.heading_rad, clean.heading_rad)) < 1e-13
    assert localizer.counts["backward"] == 0


@pytest.mark.fault("S11")
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(random=st.randoms(use_true_random=False))
def test_any_permutation_of_samples_never_runs_backward(measured: Measured, random: Random) -> None:
    # S11: out of order within and across frames; whatever is used, the filter stays finite and near the truth.
    localizer = make()
    frames = drive()
    samples = [s for _, _, wheels, _ in frames for s in wheels]
    for i in range(0, len(samples), 15):
        part = samples[i : i + 15]
        random.shuffle(part)
        samples[i : i + 15] = part
    for k, (t, imu, _, edges) in enumerate(frames):
        before_s = localizer.t_s
        localizer.step(t, imu, samples[10 * k : 10 * k + 10], edges)
        assert localizer.t_s == t
        measured("S11", localizer.t_s < before_s)
    found, clean = localizer.pose, clean_pose()
    assert hypot(found.x_m - clean.x_m, found.y_m - clean.y_m) < 1e-3  # at worst the last frames hold no sample
    assert localizer.heading_sigma_rad > 0.0


numbers = st.floats(allow_nan=True, allow_infinity=True, width=64)
wheel_numbers = st.none() | numbers
hostile_frames = st.tuples(
    st.lists(st.builds(ImuSample, numbers, numbers, numbers), max_size=3),
    st.lists(st.builds(WheelSample, numbers, wheel_numbers, wheel_numbers), max_size=3),
    st.lists(st.builds(EdgeSample, numbers, *[st.integers(0, 1)] * 4), max_size=3),
)
near_times = st.floats(-0.02, 0.03)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(numbers | near_times, hostile_frames), max_size=6))
def test_nothing_that_arrives_makes_the_pose_not_finite(
    hostile: list[tuple[float, tuple[list[ImuSample], list[WheelSample], list[EdgeSample]]]],
) -> None:
    # S4, S27: any floats as values and as times.
    localizer = make()
    localizer.step(*drive()[0])
    for t, (imu, wheels, edges) in hostile:
        localizer.step(t, imu, wheels, edges)
        # The same values at times that are believed.
        at = localizer.t_s + 0.01
        localizer.step(
            at,
            [s._replace(t_s=at) for s in imu],
            [s._replace(t_s=at) for s in wheels],
            [s._replace(t_s=at) for s in edges],
        )
        pose = localizer.pose
        assert isfinite(pose.x_m)
        assert isfinite(pose.y_m)
        assert -3.2 < pose.heading_rad < 3.2
        assert isfinite(localizer.position_sigma_m)
        assert isfinite(localizer.heading_sigma_rad)


@pytest.mark.fault("S29")
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    v=st.floats(-0.3, 0.3),
    theta=st.floats(-6.3, 6.3),
    turn=st.floats(-0.5, 0.5),
    dt=st.floats(1e-4, 0.1),
    parts=st.integers(2, 5),
)
def test_a_step_is_the_sum_of_its_parts(
    measured: Measured, v: float, theta: float, turn: float, dt: float, parts: int
) -> None:
    # Constant speed and rate: however the time is cut, the arc ends at the same point.
    x = y = 0.0
    for k in range(parts):
        dx, dy = arc_step(v, theta + turn * k / parts, turn / parts, dt / parts)
        x, y = x + dx, y + dy
    whole = arc_step(v, theta, turn, dt)
    measured("S29", hypot(x - whole[0], y - whole[1]))  # rounding is far below the bound
