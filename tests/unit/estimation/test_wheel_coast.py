"""Pure. Wheels without samples: the prediction against a servo in small steps, and what it says about its errors."""

from itertools import pairwise
from math import inf, sqrt

import numpy as np
import pytest

from ccatp.control.wheel_motion import SentDrives, SetPoints
from ccatp.core import EdgeSample, PanelPose, WheelSample
from ccatp.estimation.full_state import FullStateLocalizer
from ccatp.estimation.localizer_base import EdgeScanner
from ccatp.estimation.odometry import WheelAngle
from ccatp.estimation.wheel_coast import CoastedMotion, WheelCoast
from tests.unit.estimation.drive import STEEP, Frame, Robot, build, config, trapeze

FRAME_S = 0.01
STILL = SetPoints(0.0, 0.0)


class Servo:
    """Two wheels of first order, integrated in steps of 0.5 ms by the midpoint rule."""

    STEPS = 20

    def __init__(self, lag_s: float) -> None:
        self.lag_s, self.rates = lag_s, np.zeros(2)

    def frame(self, set_points: SetPoints) -> tuple[float, float]:
        dt_s, turned = FRAME_S / self.STEPS, np.zeros(2)
        for _ in range(self.STEPS):
            before = self.rates
            middle = before + 0.5 * dt_s / self.lag_s * (np.array(set_points[:2]) - before)
            self.rates = before + dt_s / self.lag_s * (np.array(set_points[:2]) - middle)
            turned = turned + middle * dt_s
        return float(turned[0]), float(turned[1])


def driven(lag_s: float, frames: int = 150) -> tuple[Servo, WheelCoast]:
    """A robot that accelerates and cruises; the prediction knows a lag of 80 ms, and learns."""
    servo, coast = Servo(lag_s), WheelCoast(0.08)
    for k in range(frames):
        set_points = SetPoints(min(3.0, 0.06 * k), min(2.0, 0.04 * k))
        coast.follow(FRAME_S, set_points, *servo.frame(set_points))
        coast.learn(FRAME_S, *servo.rates.tolist())
    return servo, coast


@pytest.mark.parametrize("lag_s", [0.065, 0.08, 0.095])
def test_wheels_that_run_down_turn_as_a_servo_does_whose_lag_was_learned(lag_s: float) -> None:
    servo, coast = driven(lag_s, 400)
    right, left = servo.rates.tolist()
    coast.begin(right, left, 1e-10, is_resting=False)
    off, variance = np.zeros(2), np.zeros(2)
    for k in range(80):
        set_points = SetPoints(3.0, 2.0) if k < 15 else STILL
        predicted, turned = coast.advance(FRAME_S, set_points), servo.frame(set_points)
        off += np.array(predicted[:2]) - turned
        variance += predicted[2:4]
        # A prediction that only kept the rate of before the gap would be 0.24 rad too far at its end.
        assert np.all(np.abs(off) < 3.0 * np.sqrt(variance) + 1e-9)
        assert np.all(np.abs(off) < 0.01)  # a third of a millimetre; the lag alone was wrong by 0.045 rad
    assert list(coast.rates) == pytest.approx([0.0, 0.0], abs=0.01)  # after seven times the lag


def test_a_prediction_from_rest_starts_with_the_drive_that_comes_in_the_gap() -> None:
    servo, coast = Servo(0.08), WheelCoast(0.08)
    coast.stand()
    coast.begin(0.0, 0.0, 1e-6, is_resting=True)
    for _ in range(10):
        assert coast.advance(FRAME_S, STILL) == CoastedMotion(0.0, 0.0, 0.0, 0.0, 0.0)
    assert not coast.has_moved
    for _ in range(30):
        predicted = coast.advance(FRAME_S, SetPoints(1.0, -1.0))
        assert predicted[:2] == pytest.approx(servo.frame(SetPoints(1.0, -1.0)), abs=1e-6)
    assert coast.has_moved


def test_every_growth_of_the_covariance_is_one() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        servo, coast = driven(0.08, int(rng.integers(3, 40)))
        right_rad_s, left_rad_s = servo.rates.tolist()
        coast.begin(right_rad_s, left_rad_s, 1e-6, is_resting=False)
        for _ in range(40):
            known = SetPoints(*rng.uniform(-5.0, 5.0, 2).tolist(), *rng.uniform(-0.01, 0.01, 2).tolist())
            *_, right, left, both = coast.advance(FRAME_S, known if rng.random() < 0.8 else None)
            assert right >= 0.0
            assert left >= 0.0
            assert both * both <= right * left * (1.0 + 1e-9) + 1e-30


def test_without_set_points_anything_from_running_to_a_stop_is_as_likely() -> None:
    coast = WheelCoast(0.08)
    coast.begin(3.0, 3.0, 0.0, is_resting=False)
    frames = [coast.advance(FRAME_S, None) for _ in range(100)]
    way_rad = sum(frame.right_rad for frame in frames)
    assert way_rad == pytest.approx(0.5 * 3.0 * 0.4)  # it stands 0.4 s after its last drive
    assert sqrt(sum(frame.right_rad2 for frame in frames)) == pytest.approx(3.0 * 0.4 / sqrt(12.0))


# -- the drives that acted --------------------------------------------------------------------------------------------


def acted(**echo: float) -> SetPoints | None:
    """Drive 7 at (2, 1) was in force at the end of the last frame, drive 8 at (4, 3) was sent."""
    sent = SentDrives(config().robot, FRAME_S)
    sent.add(7, 2.0, 1.0)
    sent.add(8, 4.0, 3.0)
    sent.acted(FRAME_S, 7, FRAME_S, FRAME_S, False)
    given = {"seq": 8, "age": FRAME_S, "permit_age": FRAME_S, "held": False} | echo
    return sent.acted(FRAME_S, int(given["seq"]), given["age"], given["permit_age"], bool(given["held"]))


@pytest.mark.parametrize(
    ("echo", "right"),
    [
        ({"seq": 7, "age": 0.02}, 2.0),
        ({}, 4.0),
        ({"age": 0.0025}, 2.5),  # it arrived a quarter of the frame ago
        ({"seq": 7, "age": 0.26, "held": True}, 0.0),  # older than 0.25 s since the frame began
        ({"seq": 7, "age": 0.254, "held": True}, 1.2),
        ({"seq": 7, "age": 0.1, "permit_age": 0.256, "held": True}, 0.8),
        ({"seq": 7, "age": 0.1, "permit_age": 0.01, "held": True}, 0.0),  # the newest permit denies it
        ({"seq": 0, "age": 0.0, "permit_age": 0.0, "held": True}, 2.0),  # in this instant
    ],
)
def test_the_echo_says_which_drive_acted_for_how_long(echo: dict[str, float], right: float) -> None:
    found = acted(**echo)
    assert found is not None
    assert found.right_rad_s == pytest.approx(right)
    assert found.right_doubt_rad == 0.0


def test_a_robot_that_holds_by_itself_stopped_at_an_unknown_time_of_the_frame() -> None:
    found = acted(seq=7, age=0.1, permit_age=0.1, held=True)
    assert found is not None
    assert found.right_rad_s == pytest.approx(1.0)
    assert abs(found.right_doubt_rad) == pytest.approx(2.0 * FRAME_S / sqrt(12.0))


def test_a_drive_that_was_not_sent_here_is_unknown() -> None:
    assert acted(seq=99) is None
    assert acted(seq=99, held=True, permit_age=0.01) == STILL


# -- samples again ----------------------------------------------------------------------------------------------------


def counted(begin_s: float, end_s: float, rate: float) -> tuple[list[float], list[float]]:
    times = [begin_s + 1e-3 * (k + 1) for k in range(round((end_s - begin_s) / 1e-3))]
    return times, [rate] * len(times)


@pytest.mark.parametrize(("begin_s", "angle_rad"), [(0.1, 3.0 * 0.2), (0.16, 3.0 * 0.1 + 5.0 * 0.06 + 3.0 * 0.04)])
def test_late_samples_replace_the_prediction_and_lost_ones_do_not(begin_s: float, angle_rad: float) -> None:
    """Whether all samples of the gap of 60 ms come with the next frames, or only those after it."""
    wheel = WheelAngle()
    for k in range(10):
        wheel.add(*counted(0.01 * k, 0.01 * (k + 1), 3.0), FRAME_S)
    begun = wheel.angle_rad
    for k in range(6):
        assert wheel.is_silent(0.11 + 0.01 * k)
        wheel.coast(5.0 * FRAME_S)
    for end_s in (0.17, 0.18, 0.19, 0.2):
        readings = counted(begin_s, end_s, 3.0)
        if wheel.is_coasting:
            readings = wheel.end_coasting(0.16, 5.0, *readings)  # type: ignore[assignment]
        wheel.add(*readings, FRAME_S)
        begin_s = end_s
    assert wheel.angle_rad - begun == pytest.approx(angle_rad - 0.3, abs=2e-3)  # half a sample of the old rate


def test_samples_from_within_the_predicted_time_do_not_count_twice() -> None:
    wheel = WheelAngle()
    for k in range(10):
        wheel.add(*counted(0.01 * k, 0.01 * (k + 1), 3.0), FRAME_S)
    begun = wheel.angle_rad
    for _ in range(6):
        wheel.coast(0.03)
    readings = wheel.end_coasting(0.16, 3.0, *counted(0.13, 0.17, 3.0))
    assert wheel.has_lost
    wheel.add(*readings, FRAME_S)
    assert wheel.angle_rad - begun == pytest.approx(3.0 * 0.07, abs=1e-6)


def test_an_encoder_slower_than_its_frames_is_not_silent() -> None:
    wheel = WheelAngle()
    for k in range(5):
        wheel.add([0.02 * (k + 1)], [3.0], FRAME_S)
    assert not wheel.is_silent(0.11)
    assert wheel.is_silent(0.14)


def test_a_transition_in_a_gap_of_the_edge_sensors_is_none() -> None:
    scanner = EdgeScanner()
    scanner.scan([EdgeSample(0.0, 1, 1, 1, 1)])
    assert scanner.scan([EdgeSample(0.2, 0, 1, 1, 1)]) == []
    assert len(scanner.scan([EdgeSample(0.21, 1, 1, 1, 1)])) == 1


@pytest.mark.parametrize("by_s", [-5.0, -1.001, 0.0011, 100.0])
def test_an_edge_sample_with_an_impossible_time_stamp_is_not_used_and_hides_no_seam(by_s: float) -> None:
    start = PanelPose(STEEP.panel, STEEP.x_m, STEEP.y_m, 0.0)
    frames = Robot(start, v=trapeze(0.1, 6.0, 0.1, 0.2), has_edges=True).frames(6.2)
    found = {}
    for is_misdated in (False, True):
        localizer = build(start=start)
        for number, frame in enumerate(frames):
            wrong = [frame.edges[-1]._replace(t_s=max(frame.t_s + by_s, 0.0))] if is_misdated and number == 110 else []
            localizer.step(*frame._replace(edges=[*frame.edges, *wrong]))
        found[is_misdated] = localizer
    assert found[False].counts["crossings_used"] > 0
    assert found[True].counts["crossings_used"] == found[False].counts["crossings_used"]
    assert found[True].deck_pose == found[False].deck_pose
    assert (found[True].counts["edge_misdated"], found[False].counts["edge_misdated"]) == (1, 0)


# -- the localizer ----------------------------------------------------------------------------------------------------


def driving(frames: int = 150) -> tuple[FullStateLocalizer, Robot]:
    robot = Robot(v=trapeze(0.5, 9.0, 0.1, 0.2))
    localizer = build()
    for frame in robot.frames(0.01 * frames):
        localizer.step(*frame)
    return localizer, robot


def stamped(frame: Frame, by_s: float) -> Frame:
    encoders = [sample._replace(t_s=max(sample.t_s + by_s, 0.0)) for sample in frame.encoders]
    return frame._replace(encoders=encoders)


@pytest.mark.parametrize("by_s", [-5.0, -0.5, 0.012, 0.4, 5.0])
def test_samples_with_an_impossible_time_stamp_are_a_gap(by_s: float) -> None:
    """They are left out. Its set points are unknown, so the body may have stopped at once."""
    localizer, robot = driving(800)
    known_m = localizer.position_sigma_m
    for frame in robot.frames(0.3):
        localizer.step(*stamped(frame, by_s))
    assert localizer.gap_s == pytest.approx(0.3)
    assert localizer.coasted is not None
    assert sum(localizer.counts[reason] for reason in ("ahead", "late", "backward")) == 2 * 300
    off_m = np.hypot(localizer.deck_pose.x_m - robot.x_m, localizer.deck_pose.y_m - robot.y_m)
    assert off_m < 3.0 * localizer.position_sigma_m
    # 0.1 m/s for 0.3 s, and nothing known about the drives.
    assert localizer.position_sigma_m**2 - known_m**2 > 0.005**2


def test_a_sample_may_be_later_than_its_frame_by_the_rounding_of_both_times() -> None:
    localizer, robot = driving()
    for frame in robot.frames(0.1):
        localizer.step(*stamped(frame, 0.0009))
    assert localizer.gap_s == 0.0


def test_the_fix_after_a_gap_corrects_the_pose_and_teaches_nothing() -> None:
    before = driving(45)[0].state[0][[6, 7, 9, 10, 11, 12]]  # at the begin of the leg
    localizer, robot = driving(120)
    for frame in robot.frames(0.2):
        localizer.step(*frame._replace(encoders=[]), SetPoints(*robot.wheel_rates(robot.t_s)))
    for frame in robot.frames(8.5):
        localizer.step(*frame)
    assert localizer.gap_s == pytest.approx(0.2)
    localizer.fuse_fix(robot.fix(off_m=(0.003, 0.0)))
    assert localizer.gap_s == 0.0
    assert localizer.state[0][[6, 7, 9, 10, 11, 12]] == pytest.approx(before, abs=1e-12)


def test_in_a_gap_the_standard_deviations_are_those_of_each_frame() -> None:
    localizer, robot = driving()
    sigmas = []
    for frame in robot.frames(0.2):
        localizer.step(*frame._replace(encoders=[]))
        sigmas.append(localizer.position_sigma_m)
    assert all(after > before for before, after in pairwise(sigmas))


def test_one_silent_wheel_is_predicted_and_the_other_one_counts() -> None:
    localizer, robot = driving()
    for frame in robot.frames(0.3):
        half = [WheelSample(t_s, right, None) for t_s, right, _ in frame.encoders]
        localizer.step(*frame._replace(encoders=half), SetPoints(*robot.wheel_rates(robot.t_s)))
    assert localizer.coasted is not None
    assert localizer.coasted.right_rad2 == 0.0
    assert localizer.coasted.left_rad2 > 0.0
    off_m = np.hypot(localizer.deck_pose.x_m - robot.x_m, localizer.deck_pose.y_m - robot.y_m)
    assert off_m < min(3.0 * localizer.position_sigma_m, 0.002)
    assert localizer.position_sigma_m < inf
