"""Pure. Which samples are used; the noise learned at rest, and what a rest shows."""

from collections import Counter
from math import inf, nan, pi, sqrt

import numpy as np
import pytest

from ccatp.config.models import FullStateConfig
from ccatp.core import DeckPose, GravitySample, ImuSample, PanelPose, WheelSample
from ccatp.estimation.localizer_base import SampleValidator
from ccatp.estimation.odometry import Terrain
from ccatp.estimation.rest import NoiseFloor, ZeroVelocityDetector, heading_from_gravity
from ccatp.estimation.state_model import BA, BG, PSI, W
from ccatp.kinematics import difference, wrap_pi
from ccatp.mirror.mirror import Mirror
from tests.unit.estimation.drive import FRAME_S, STEEP, Errors, Frame, Robot, build, run, trapeze

HISTORY_S = 0.2
ONE = WheelSample(1.002, 1.0, 2.0)


def intake() -> SampleValidator:
    """One that has used samples up to 1.001 s."""
    found = SampleValidator(HISTORY_S, 7.0, Counter())
    found.wheels(1.001, [WheelSample(1.0, 0.0, 0.0), WheelSample(1.001, 0.0, 0.0)])
    return found


def counts(found: SampleValidator) -> dict[str, int]:
    return {key: value for key, value in found._counts.items() if value}


@pytest.mark.parametrize(
    ("samples", "right", "left", "refused"),  # each wheel counts for itself
    [
        ([ONE, WheelSample(1.003, 3.0, 4.0)], [1.002, 1.003], [1.002, 1.003], {}),
        ([WheelSample(1.002, None, 2.0)], [], [1.002], {}),
        ([ONE, WheelSample(1.003, 2.0, None)], [1.002, 1.003], [1.002], {}),
        ([WheelSample(1.002, nan, 2.0)], [], [], {"nonfinite": 1}),
        ([WheelSample(1.002, 1.0, inf)], [], [], {"nonfinite": 1}),
        ([WheelSample(1.002, inf, -inf)], [], [], {"nonfinite": 1}),
        (
            [ONE, WheelSample(nan, 1.0, 2.0), WheelSample(1.004, 1.0, 2.0)],
            [1.002, 1.004],
            [1.002, 1.004],
            {"nonfinite": 1},
        ),
        ([WheelSample(1.002, 8.0, 2.0), WheelSample(1.003, 1.0, -8.0)], [1.003], [1.002], {"too_fast": 2}),
        ([ONE, ONE], [1.002], [1.002], {"duplicate": 2}),
        ([WheelSample(1.001, 1.0, 2.0), ONE], [1.002], [1.002], {"duplicate": 2}),
        ([WheelSample(1.003, 1.0, 2.0), ONE], [1.003], [1.003], {"backward": 2}),
        ([WheelSample(1.0005, 1.0, 2.0)], [], [], {"backward": 2}),
        ([ONE, WheelSample(1.02, 1.0, 2.0)], [1.002], [1.002], {"ahead": 2}),
        ([WheelSample(0.8, 1.0, 2.0)], [], [], {"late": 2}),
    ],
)
def test_wheel_samples_are_judged_one_by_one(
    samples: list[WheelSample], right: list[float], left: list[float], refused: dict[str, int]
) -> None:
    found = intake()
    (right_times, right_rates), (left_times, left_rates) = found.wheels(1.01, samples)
    assert (list(right_times), list(left_times)) == (right, left)
    assert (len(right_rates), len(left_rates)) == (len(right), len(left))
    assert counts(found) == refused


IMU = {
    "nonfinite": ImuSample(1.002, nan, 0.0),
    "ahead": ImuSample(1.02, 0.0, 0.0),
    "late": ImuSample(0.7, 0.0, 0.0),
    "duplicate": ImuSample(1.001, 0.0, 0.0),
    "backward": ImuSample(0.999, 0.0, 0.0),
}


@pytest.mark.parametrize("reason", IMU)
def test_unusable_samples_of_the_inertial_unit(reason: str) -> None:
    found, good = intake(), ImuSample(1.003, 0.0, 0.0)
    found.imu(1.001, [ImuSample(1.001, 0.0, 0.0)])
    assert list(found.imu(1.01, [IMU[reason], good])) == [good]
    assert counts(found) == {reason: 1}


def test_a_jump_of_the_clock_drops_all_times() -> None:
    found = intake()
    found.restart()
    assert found.wheels(0.01, [WheelSample(0.005, 1.0, 2.0)]) == (((0.005,), (1.0,)), ((0.005,), (2.0,)))


def test_rest_begins_after_its_time_and_only_once() -> None:
    found = ZeroVelocityDetector(0.25, NoiseFloor(1e-4), NoiseFloor(1e-4))
    begun = [found.stood(0.05) for _ in range(8)]
    assert begun == [False] * 4 + [True] + [False] * 3
    assert found.is_resting


WINDOW = 15  # samples in a mean of the noise floor


# -- the noise that counts --------------------------------------------------------------------------------------------


def learned(samples: np.ndarray, expected: float = 1.0) -> float:
    floor = NoiseFloor(expected)
    for sample in samples.tolist():
        floor.add(sample)
    return floor.variance


@pytest.mark.parametrize("sigma", [0.1, 10.0])
def test_of_white_noise_the_variance_is_learned(sigma: float) -> None:
    rng = np.random.default_rng(1)
    found = [learned(5.0 + sigma * rng.normal(size=6000)) for _ in range(20)]
    # Remembered are 2/0.03 = 67 squares of one degree of freedom; neighbours share a mean, which makes it 3/2 of that.
    scatter = sqrt(2.0 / 67.0 * 1.5)
    assert np.mean(found) == pytest.approx(sigma**2, rel=4.0 * scatter / sqrt(20))
    assert np.std(found) < 1.5 * scatter * sigma**2


def test_a_bias_is_no_noise_and_a_restart_drops_half_a_mean() -> None:
    floor = NoiseFloor(1.0)
    for _ in range(100 * WINDOW):
        floor.add(3.0)
    assert floor.variance == pytest.approx(0.97**99, rel=1e-9)
    before = floor.variance
    for _ in range(WINDOW - 1):
        floor.add(1e3)  # what a motion leaves
    floor.restart()
    for _ in range(WINDOW):
        floor.add(3.0)
    assert floor.variance == pytest.approx(0.97 * before, rel=1e-9)


# -- gravity ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("psi", [*np.linspace(-3.1, 3.1, 9).tolist(), pi, -pi + 1e-9, 7.0])
def test_heading_from_gravity(mirror: Mirror, psi: float) -> None:
    at = mirror.deck_pose(STEEP)
    gx, gy, _ = mirror.gravity_in_robot(DeckPose(at.x_m, at.y_m, psi))
    found = heading_from_gravity(float(np.arctan2(gy, gx)), Terrain(mirror).at(at.x_m, at.y_m))
    assert abs(difference(found, psi)) < 1e-13  # rounding


# -- at rest in the localizer -----------------------------------------------------------------------------------------


def with_gravity(frames: list[Frame], mirror: Mirror, pose: DeckPose, sigma: float = 0.0) -> list[Frame]:
    rng = np.random.default_rng(7)
    g = np.array(mirror.gravity_in_robot(pose))
    return [
        frame._replace(gravity=GravitySample(frame.t_s, *(g + sigma * rng.normal(size=3)).tolist())) for frame in frames
    ]


def test_the_localizer_rests_when_the_wheels_have_stood_long_enough(full: FullStateConfig) -> None:
    robot, found = Robot(v=trapeze(0.0, 0.5, 0.05, 0.2)), build()
    begun_s = None
    for frame in robot.frames(1.2):
        found.step(*frame)
        if found.is_resting and begun_s is None:
            begun_s = frame.t_s
    # At 0.2 m/s^2 the wheel is slower than 0.1 mm/s in the last half millisecond only; then whole frames.
    assert begun_s == pytest.approx(0.5 + full.rest_after_s, abs=FRAME_S + 1e-9)
    assert found.speed_m_s == found.rate_rad_s == 0.0


def test_a_robot_that_drives_on_slowly_never_rests() -> None:
    robot, found = Robot(v=lambda _: 0.0002), build()
    for frame in robot.frames(1.0):
        found.step(*frame)
        assert not found.is_resting


@pytest.mark.parametrize("counts_per_turn", [0, 1200])
def test_biases_show_at_rest(filter_name: str, counts_per_turn: int) -> None:
    wrong = Errors(gyro_bias=0.02, accelerometer_bias=-0.3, noise=1.0, counts_per_turn=counts_per_turn)
    robot, found = Robot(errors=wrong), build(filter_name)
    run(found, robot.frames(0.25 + 8 * 1.0))
    mean, P = found.state
    gyro, accelerometer = sqrt(P[BG, BG]), sqrt(P[BA, BA])
    # 800 samples, and what is not known of rate and acceleration at the stop; both are small against the prior.
    assert gyro == pytest.approx(sqrt(0.0087**2 / 800 + P[W, W]), rel=0.3)  # the noise itself is learned, within 20 %
    assert accelerometer < 1.5e-3
    assert abs(mean[BG] - 0.02) < 4.0 * gyro
    assert abs(mean[BA] + 0.3) < 4.0 * accelerometer


def test_a_rest_is_used_when_the_robot_drives_off() -> None:
    """Half a second at rest, less than fills a chunk."""
    robot, found = Robot(v=trapeze(0.75, 1.0, 0.1, 0.2), errors=Errors(gyro_bias=0.02)), build()
    run(found, robot.frames(0.74))
    before = found.state[1][BG, BG]
    run(found, robot.frames(0.06))
    # Some 50 samples against the 20 of the frames before the rest was certain.
    assert found.state[1][BG, BG] < 0.5 * before
    assert found.state[0][BG] == pytest.approx(0.02, abs=1e-4)  # no noise: what is left of a prior of 17 mrad/s


def test_gravity_shows_the_heading_of_a_robot_at_rest(mirror: Mirror, filter_name: str) -> None:
    robot, found = Robot(), build(filter_name, start_heading_sigma_rad=0.3)
    turned = DeckPose(robot.x_m, robot.y_m, robot.pose.heading_rad + 0.2)
    run(found, with_gravity(robot.frames(6.3), mirror, turned))
    # Six chunks, each as good as the floor of 30 mrad and its noise; and what the prior of 0.3 rad pulls.
    assert found.state[0][PSI] == pytest.approx(turned.heading_rad, abs=0.2 * 0.03)
    assert found.heading_sigma_rad == pytest.approx(0.034 / sqrt(6.0), rel=0.1)
    assert found.counts["gravity_gated"] == 0


@pytest.mark.parametrize("beyond", [0.02, -0.02])
def test_gravity_across_the_cut_of_the_angle(mirror: Mirror, full: FullStateConfig, beyond: float) -> None:
    """The heading is within 20 mrad of pi, gravity says that it is on the other side."""
    start = PanelPose(STEEP.panel, 0.0, 0.0, pi + beyond)
    robot, found = Robot(start), build(start=start, start_heading_sigma_rad=0.1)
    truth = DeckPose(robot.x_m, robot.y_m, wrap_pi(robot.pose.heading_rad - 2.0 * beyond))
    assert abs(found.deck_pose.heading_rad - truth.heading_rad) > 6.0
    run(found, with_gravity(robot.frames(1.3), mirror, truth))
    gx, gy, _ = mirror.gravity_in_robot(truth)
    variance = (full.gravity_sigma_rad**2 / (gx * gx + gy * gy)) / 100 + full.gravity_floor_rad**2
    left = difference(float(found.state[0][PSI]), truth.heading_rad)
    assert left == pytest.approx(2.0 * beyond * variance / (variance + 0.1**2), rel=1e-3)  # the frames before the rest


@pytest.mark.parametrize("by_s", [-5.0, -1.001, 0.0011, 5.0])
def test_gravity_with_an_impossible_time_stamp_is_not_used(mirror: Mirror, by_s: float) -> None:
    robot, found = Robot(), build(start_heading_sigma_rad=0.3)
    before = float(found.state[0][PSI])
    turned = DeckPose(robot.x_m, robot.y_m, robot.pose.heading_rad + 0.2)
    frames = with_gravity(robot.frames(6.3), mirror, turned)
    run(found, [f._replace(gravity=f.gravity and f.gravity._replace(t_s=f.t_s + by_s)) for f in frames])
    assert found.state[0][PSI] == pytest.approx(before, abs=1e-12)
    assert found.counts["gravity_misdated"] == len(frames)


def test_gravity_that_contradicts_is_gated(mirror: Mirror) -> None:
    robot, found = Robot(), build()
    before = float(found.state[0][PSI])
    run(found, with_gravity(robot.frames(1.3), mirror, DeckPose(robot.x_m, robot.y_m, before + 0.5)))
    assert found.counts["gravity_gated"] == 1
    assert found.state[0][PSI] == pytest.approx(before, abs=1e-12)
