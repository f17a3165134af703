"""Pure. From one step of the filter to the next: frames gathered for it, and the pose carried on in between."""

from itertools import pairwise
from math import floor, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ccatp.core import FloatArray, ImuSample
from ccatp.estimation.odometry import PreintegratedMotion, Preintegrator, Slope, WheelAngle
from ccatp.estimation.pose_predictor import PosePredictor
from ccatp.estimation.state_model import BG, KG, PL, PR, PSI, STATES, SurveyMotion, W, X, Y
from tests.unit.estimation.drive import config
from tests.unit.estimation.test_state_model import LEVEL, shares, slopes, states

R_M, BASE_M = config().robot.wheel_radius_m, config().robot.wheel_base_m


def running() -> PosePredictor:
    return PosePredictor(R_M, BASE_M, 0.3)


@settings(max_examples=60, deadline=None)
@given(states(), slopes(), st.floats(1e-3, 0.1), shares, st.integers(1, 5))
def test_it_drives_the_filters_arc(x: FloatArray, slope: Slope, dt_s: float, share: float, steps: int) -> None:
    """Given the wheel angles that the filter's motion predicts, the pose is the filter's."""
    motion, pose = SurveyMotion(R_M, BASE_M).over(dt_s, slope, share), running()
    pose.begin(x, slope, 0.0, share)
    for _ in range(steps):
        after = motion.at(x)[0].copy()
        motion.over(dt_s, slope, share)
        pose.advance(dt_s, float(after[PR] - x[PR]), float(after[PL] - x[PL]), None)
        x = after
        expected = x[[X, Y, PSI]].tolist()
        # The wheel angles are differences of numbers up to 10.
        assert [pose.x_m, pose.y_m, pose.heading_rad] == pytest.approx(expected, abs=1e-13)
    assert pose.omega_rad_s == pytest.approx(float(x[W]), abs=1e-11)


def trusted(angle_variance: float, rate_variance: float = 1e-4, dt_s: float = 0.01) -> PosePredictor:
    pose = running()
    pose.begin(np.zeros(STATES), LEVEL, 0.0)
    pose.trust(angle_variance, rate_variance, dt_s)
    return pose


@pytest.mark.parametrize("angle_variance", [1e-12, 1e-7, 1e-4])
def test_the_observers_gain_is_that_of_a_kalman_filter_long_since_begun(angle_variance: float) -> None:
    dt_s, prior = 0.01, 1.0
    noise = 0.5 * (R_M / dt_s) ** 2 * angle_variance  # of the mean of two wheels
    for _ in range(2000):
        gain = prior / (prior + noise)
        prior = (1.0 - gain) * prior + 0.3 * dt_s**3
    pose = trusted(angle_variance)
    pose.advance(dt_s, 1.0, 1.0, None)
    assert pose.v_m_s == pytest.approx(gain * R_M / dt_s, rel=1e-9)  # a geometric series long since at rounding


@pytest.mark.parametrize("rate_variance", [1e-6, 1e-4, 1.0])
def test_wheels_and_gyroscope_are_weighted_by_their_noise(rate_variance: float) -> None:
    dt_s, angle_variance = 0.01, 1e-5
    pose = trusted(angle_variance, rate_variance)
    of_wheels = 2.0 * (R_M / (BASE_M * dt_s)) ** 2 * angle_variance
    pose.advance(dt_s, 0.0, 0.0, 1.0)
    assert pose.omega_rad_s == pytest.approx(of_wheels / (of_wheels + rate_variance), rel=1e-12)


def test_the_gyroscope_is_freed_of_its_errors() -> None:
    x, pose = np.zeros(STATES), running()
    x[[BG, KG]] = 0.05, 0.02
    pose.begin(x, LEVEL, 0.0)
    pose.trust(1.0, 1e-12, 0.01)  # nothing but the gyroscope counts
    pose.advance(0.01, 0.0, 0.0, 0.05 + 1.02 * 0.4)
    assert pose.omega_rad_s == pytest.approx(0.4, rel=1e-9)


# -- blocks -----------------------------------------------------------------------------------------------------------


def fill(builder: Preintegrator, times: list[float], rate: float = 1.0, jerk: float = 1.0) -> PreintegratedMotion:
    """Frames of 10 ms that end at ``times``; the angular rate is ``rate t^1``, the acceleration ``jerk t``."""
    for t in times:
        builder.add(0.01, [ImuSample(t - 0.005, 9.0, 9.0), ImuSample(t, jerk * t, rate * t)], is_turning=True)
    return builder.take()


def test_means_over_a_block() -> None:
    builder = Preintegrator()
    builder.stand([ImuSample(0.0, 0.0, 0.0)])
    first = fill(builder, [0.01, 0.02, 0.03, 0.04])
    assert (first.dt_s, first.turning_s) == pytest.approx((0.04, 0.04))
    assert first.samples == 4
    assert first.rate_rad_s == pytest.approx(0.02, abs=1e-15)  # exact for a straight line
    second = fill(builder, [0.05, 0.06, 0.07, 0.08])
    assert second.rate_rad_s == pytest.approx(0.06, abs=1e-15)
    # From the middle of the first block, 0.02 s, to that of the second.
    assert second.acceleration_m_s2 == pytest.approx(0.04, abs=1e-15)


@pytest.mark.parametrize(("every", "samples"), [(1, 4), (2, 2), (4, 1), (5, 0), (8, 0)])
def test_an_inertial_unit_slower_than_the_frames(every: int, samples: int) -> None:
    builder = Preintegrator()
    builder.stand([ImuSample(0.0, 0.0, 0.0)])
    for frame in range(1, 5):
        t = 0.01 * frame
        builder.add(0.01, [] if frame % every else [ImuSample(t, t, t)], is_turning=True)
    block = builder.take()
    assert block.samples == samples
    assert block.rate_rad_s == (pytest.approx(0.02, abs=1e-15) if samples else None)


def test_a_unit_that_is_silent_for_longer_begins_a_new_sum() -> None:
    for silent, samples in ((4, 1), (5, 0)):  # a rate of 20 Hz, and less
        builder = Preintegrator()
        builder.stand([ImuSample(0.0, 0.0, 0.0)])
        for _ in range(silent):
            builder.add(0.01, [], is_turning=True)
        builder.add(0.01, [ImuSample(0.05, 1.0, 1.0)], is_turning=True)
        assert builder.take().samples == samples


def test_nothing_reaches_across_a_restart_or_a_rest() -> None:
    for forget in (Preintegrator.restart, lambda builder: builder.stand([])):
        builder = Preintegrator()
        fill(builder, [0.01, 0.02])
        forget(builder)
        block = fill(builder, [5.01, 5.02])
        assert block.samples == 1
        assert block.rate_rad_s == pytest.approx(5.015, abs=1e-12)
        assert block.acceleration_m_s2 == block.rate_rad_s  # none of before is averaged in
    builder = Preintegrator()
    builder.add(0.01, [], is_turning=True)
    builder.restart()
    assert builder.take().dt_s == 0.0


def test_an_encoder_slower_than_its_frames_is_taken_at_their_ends() -> None:
    wheel = WheelAngle()
    wheel.add([0.000, 0.004, 0.008], [3.0, 3.0, 3.0], 0.01)
    angle_rad, lag_rad2 = wheel.angle_at(0.01)
    assert angle_rad == pytest.approx(3.0 * 0.01)
    assert 0.0 < lag_rad2 < 1e-8  # 3 um of travel
    wheel.add([0.012, 0.016, 0.02], [3.0, 3.0, 3.0], 0.01)
    assert wheel.angle_at(0.02) == (wheel.angle_rad, 0.0)
    wheel.add([], [], 0.01)  # bridged to its end already
    assert wheel.angle_at(0.03) == (wheel.angle_rad, 0.0)


DT_S = 1e-3
COUNT_RAD = 2.0 * pi / 1024.0


def feed(wheel: WheelAngle, angles: list[float], t0_s: float = 0.0, per_frame: int = 10) -> float:
    """Counted angles at 1 kHz as the rates that an encoder makes of them; returns what the frames turned together."""
    whole = [floor(angle / COUNT_RAD) for angle in angles]
    rates = [(b - a) * COUNT_RAD / DT_S for a, b in pairwise(whole)]
    total = 0.0
    for k in range(0, len(rates), per_frame):
        part = rates[k : k + per_frame]
        total += wheel.add([t0_s + (k + i + 1) * DT_S for i in range(len(part))], part)
    return total


def counter() -> WheelAngle:
    wheel = WheelAngle()
    feed(wheel, [0.1] * 21, t0_s=-0.02)
    return wheel


def test_zeros_at_rest_show_a_counter() -> None:
    wheel = WheelAngle()
    wheel.add([0.001 * k for k in range(7)], [0.0] * 7)
    assert not wheel.is_counter
    wheel.add([0.007], [0.0])
    assert wheel.is_counter
    assert wheel.noise_rad2_s2 == 0.0


def test_noise_shows_that_an_encoder_is_no_counter() -> None:
    wheel, rng = WheelAngle(), np.random.default_rng(1)
    for k in range(200):
        times = [0.01 * k + DT_S * i for i in range(1, 11)]
        rates = (0.001 * rng.normal(size=10)).tolist()
        rates[k % 10] = 0.0  # by chance
        wheel.add(times, rates)
        wheel.rest(rates)
    assert not wheel.is_counter
    # Nine of ten samples have it; a mean that forgets with 1/50 scatters as that of 1000 of them, sqrt(2/1000).
    assert wheel.noise_rad2_s2 == pytest.approx(0.9e-6, rel=4.0 * 0.045)


paths = st.lists(st.tuples(st.floats(0.0, 3.0), st.floats(-6.0, 6.0)), min_size=1, max_size=4)


@settings(max_examples=50, deadline=None)
@given(paths, st.integers(1, 13), st.floats(0.0, 1000.0))
def test_counts_add_up(pieces: list[tuple[float, float]], per_frame: int, t0_s: float) -> None:
    """However it is driven, forward and back: the sum is never off by more than a count."""
    angles, angle = [0.1], 0.1
    for phase, rate in pieces:
        for k in range(100):
            angle += (rate + sin(phase + 0.1 * k)) * DT_S
            angles.append(angle)
    wheel = counter()
    wheel.restart()
    wheel.add([t0_s], [0.0])
    total = feed(wheel, angles, t0_s, per_frame)
    # A count, and a time stamp of up to 1000 s that is rounded to 1e-13 s.
    assert abs(wheel.angle_rad - (angle - 0.1)) <= COUNT_RAD * 1.0001
    assert total == pytest.approx(wheel.angle_rad, abs=1e-12)


def test_the_smallest_step_is_the_quantum() -> None:
    wheel = counter()
    assert wheel.variance_rad2() == pytest.approx(1e-10)  # none seen yet
    feed(wheel, [0.1 + 2.5 * DT_S * k for k in range(101)])
    assert wheel.quantum_rad == pytest.approx(COUNT_RAD, rel=1e-9)  # rounding of the time stamps
    assert wheel.variance_rad2() == pytest.approx(COUNT_RAD**2 / 12.0, rel=1e-9)
    # Five counts in each sample: no smaller step any more, in either direction.
    feed(wheel, [0.35 - 30.0 * DT_S * k for k in range(101)], t0_s=0.1)
    assert wheel.quantum_rad == pytest.approx(COUNT_RAD, rel=1e-9)
    feed(wheel, [-2.65 + 30.0 * DT_S * k for k in range(101)], t0_s=0.2)
    assert wheel.quantum_rad == pytest.approx(COUNT_RAD, rel=1e-9)


def test_a_jump_of_the_clock_is_no_angle() -> None:
    for wheel in (WheelAngle(), counter()):
        wheel.add([1.0, 1.001], [3.0, 3.0])
        before = wheel.angle_rad
        wheel.restart()
        wheel.add([900.0], [3.0])
        assert wheel.angle_rad == before
        wheel.add([900.001], [3.0])
        assert wheel.angle_rad == pytest.approx(before + 0.003)


def test_a_frame_without_samples_is_not_fresh() -> None:
    wheel = WheelAngle()
    assert not wheel.is_fresh
    wheel.add([0.0], [1.0])
    assert wheel.is_fresh
    assert wheel.add([], []) == 0.0
    assert not wheel.is_fresh


def test_lost_samples_of_a_counter_are_reported() -> None:
    """A count belongs to its own period; what was lost before it is taken from the last motion, and told."""
    wheel = counter()
    rate = 3.3
    whole = [int((0.1 + rate * DT_S * k) / COUNT_RAD) for k in range(60)]
    for k in range(1, 60):
        if not 20 <= k < 32:
            wheel.add([k * DT_S], [(whole[k] - whole[k - 1]) * COUNT_RAD / DT_S])
    off = abs(wheel.angle_rad - rate * DT_S * 59)
    gap = wheel.take_gap()
    assert 0.0 < gap < 2.0 * rate * 13 * DT_S
    assert off <= COUNT_RAD + gap
    assert wheel.take_gap() == 0.0


@pytest.mark.parametrize("is_counter", [False, True])
def test_once_the_period_is_known_a_frame_is_summed_at_once_and_to_the_same(is_counter: bool) -> None:
    """The sum of even periods, against sample by sample; uneven ones and lost ones are still taken one by one."""
    wheel = counter() if is_counter else WheelAngle()
    angles = [0.02 + 3.3 * DT_S * k + 0.05 * sin(0.01 * k) for k in range(6001)]
    if is_counter:
        angles = [COUNT_RAD * floor(angle / COUNT_RAD) for angle in angles]
    rates = [(b - a) / DT_S for a, b in pairwise(angles)]
    # A counter was fed up to zero; the sum of an analogue wheel begins with its first sample.
    one_by_one, before, t0 = 0.0, rates[0], 0.0 if is_counter else DT_S
    for k in range(0, 6000, 10):
        times = [round(DT_S * (k + i + 1), 9) for i in range(10)]
        here = rates[k : k + 10]
        wheel.add(times, here)
        for t, rate in zip(times, here, strict=True):
            one_by_one += (t - t0) * (rate if is_counter else 0.5 * (rate + before))
            t0, before = t, rate
    assert wheel.angle_rad == pytest.approx(one_by_one, abs=1e-9)  # rounding of the time stamps
    assert wheel.take_gap() == 0.0
