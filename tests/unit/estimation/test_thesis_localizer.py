"""Pure but for reading the shipped configuration. The four-state localizer against the robot of ``drive``."""

from dataclasses import replace
from math import atan, cos, hypot, inf, nan, pi, sin

import numpy as np
import pytest

from ccatp.conditions import text_of
from ccatp.core import EdgeSample, ImuSample, PanelId, PanelPose, WheelSample
from ccatp.estimation.localizer_base import FilterWrap, unwrapped
from ccatp.estimation.odometry import Odometer, OdometryPose, arc_step
from ccatp.estimation.seams import HeadingFix, HeadingGate, heading_from_pair
from ccatp.estimation.thesis_localizer import ConstantAcceleration, MeasurementBuilder
from ccatp.estimation.thesis_localizer import FourStateLocalizer as Localizer
from ccatp.filters.kalman import KalmanFilter
from tests.unit.estimation.drive import (
    Errors,
    Fragile,
    Rate,
    Robot,
    changed,
    config,
    mirror,
    nothing,
    run,
    shifted,
    trapeze,
)
from tests.unit.estimation.drive import errors_of as errors

CENTRE = PanelPose(PanelId(5, 5), 0.0, 0.0, 0.3)


def make(start: PanelPose = CENTRE, wrap: FilterWrap = unwrapped, **changes: float) -> Localizer:
    return Localizer(changed("kf", None, **changes), mirror(), start, wrap)


def truth(
    start: PanelPose = CENTRE, v: Rate = nothing, omega: Rate = nothing, noise: float = 0.0, has_edges: bool = False
) -> Robot:
    return Robot(start, v, omega, Errors(noise=noise), has_edges=has_edges)


# --- the whole drive -------------------------------------------------------------------------------------------------

STRAIGHT = trapeze(0.1, 2.5, 0.1, 0.2)
TURN = trapeze(2.8, 2.0, 0.8, 2.0)


def there_and_round(t: float) -> float:
    return STRAIGHT(t) if t < 2.7 else STRAIGHT(t - 4.8)


@pytest.mark.parametrize(("noise", "limit_m", "limit_rad"), [(0.0, 5e-5, 1e-4), (1.0, 1e-4, 3e-4)])
def test_a_drive_with_a_turn_from_a_known_start(noise: float, limit_m: float, limit_rad: float) -> None:
    # Limits: without noise what remains is the frame of 10 ms against ramps that begin inside it; with noise the
    # gyroscope and encoders add some 20 um. Both are far below the 1 cm that a measurement needs.
    world = truth(v=there_and_round, omega=TURN, noise=noise)
    localizer = make()
    nis = []
    while world.t_s < 7.6:
        localizer.step(*world.frame())
        assert localizer.innovation is not None
        nis.append(localizer.innovation.nis / localizer.innovation.size)
    distance, heading = errors(localizer, world.pose)
    assert distance < limit_m
    assert abs(heading) < limit_rad
    assert localizer.t_s == world.t_s
    if noise:
        # On the straight, 250 frames of 22 rows: 1 within 4 sqrt(2/5500) = 0.08 for an exact filter, and up to two rows
        # of 22 less because the process noise is wider than what the robot does. In a turn the rate changes within a
        # frame, which the four states do not know, and NIS is no measure.
        assert np.mean(nis[15:265]) == pytest.approx(1.0 - 1.0 / 22.0, abs=0.12)


# --- measurement model -----------------------------------------------------------------------------------------------


def test_rows_are_those_of_equation_2_12_and_not_of_2_3() -> None:
    cfg = config()
    builder = MeasurementBuilder(cfg.robot, cfg.localizer)
    z, H, R = builder.stack(1.0, [ImuSample(1.0, 0.1, 0.2)], ([1.0], [3.0]), ([1.0], [4.0]))
    per_r, turn = 1.0 / 0.03, 0.15 / 0.06
    np.testing.assert_allclose(z, [3.0, 4.0, 0.1, 0.2])
    expected = np.array([[per_r, 0, 0, turn], [per_r, 0, 0, -turn], [0, 1, 0, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(H, expected)  # the last row as printed in 2.4 would be (0, 0, 1, 0)
    np.testing.assert_allclose(R, np.square([0.001, 0.001, 0.0059, 0.0087]))


def test_one_wheel_missing_is_used_with_the_other() -> None:
    localizer = make()
    for k in range(200):
        t = 0.01 * k
        right = WheelSample(t, 0.1 / 0.03, None) if k % 2 else WheelSample(t, None, 0.1 / 0.03)
        localizer.step(t, [ImuSample(t, 0.0, 0.0)], [right], [])
    assert localizer.speed_m_s == pytest.approx(0.1, abs=1e-3)  # 1 %: the rate splits over two alternating wheels
    assert localizer.innovation is not None
    assert localizer.innovation.size == 3


def test_process_noise_is_one_impulse_at_the_beginning() -> None:
    F, Q = ConstantAcceleration(config().localizer).over(0.01)
    assert F.tolist() == [[1, 0.01, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.01], [0, 0, 0, 1]]  # eq. 2.11
    impulse = np.diag([0.0, 1.0 * 0.01, 0.0, 4.0 * 0.01])
    np.testing.assert_allclose(Q, F @ impulse @ F.T, rtol=1e-12)  # rounding


# --- equation 2.14 ---------------------------------------------------------------------------------------------------


def printed_2_14(v: float, theta: float, dt: float) -> tuple[float, float]:
    """The thesis as printed: the time step inside the cosine, and missing on the speed."""
    return v * cos(theta * dt), v * sin(theta * dt)


@pytest.mark.fault("S29")
def test_the_step_is_2_14_as_meant_and_not_as_printed() -> None:
    v, theta, dt = 0.1, 0.7, 0.01
    step = arc_step(v, theta, 0.0, dt)
    assert step == pytest.approx((v * dt * cos(theta), v * dt * sin(theta)), abs=1e-16)  # rounding
    assert hypot(*step) == pytest.approx(v * dt, rel=1e-12)
    assert step != pytest.approx(printed_2_14(v, theta, dt), rel=0.5)


@pytest.mark.fault("S29")
@pytest.mark.parametrize("turn", [-3.0, -0.1, -1.1e-4, -0.9e-4, 0.0, 0.9e-4, 1.1e-4, 0.5, 2.0])
def test_the_step_is_the_chord_of_the_arc(turn: float) -> None:
    v, theta, dt = 0.1, -2.0, 0.5
    # Analytic integral of v (cos, sin)(theta + omega t), as complex numbers; its own series for a small turn.
    rotor = (np.exp(1j * turn) - 1.0) / (1j * turn) if abs(turn) > 1e-3 else 1.0 + 0.5j * turn - turn**2 / 6.0
    expected = v * dt * np.exp(1j * theta) * rotor
    assert complex(*arc_step(v, theta, turn, dt)) == pytest.approx(expected, abs=1e-13)  # fault S29 asks for 1e-9


# --- crossings -------------------------------------------------------------------------------------------------------


@pytest.mark.fault("S29")
@pytest.mark.parametrize("forward", [True, False])
@pytest.mark.parametrize("entering", [0.0, 0.2, -0.4, 0.9])
@pytest.mark.parametrize("normal", [0.0, pi / 2, pi, -pi / 2])
def test_entering_angle_for_every_edge_and_direction(normal: float, entering: float, forward: bool) -> None:
    # Line through the origin with that normal; the robot crosses it at ``entering`` to the normal. A sensor (a, b) of a
    # robot at travel s is on the line where s = -(a cos e - b sin e)/cos e.
    heading = normal + entering + (0.0 if forward else pi)
    e = heading - normal
    places = []
    for b in (0.09, -0.09):
        s = -(0.09 * cos(e) - b * sin(e)) / cos(e)
        places.append(OdometryPose(s * 1.0, 0.0, 0.0))  # the odometer's x axis is the heading
    found, length, across = heading_from_pair(places[0], places[1], (0.09, 0.09), (0.09, -0.09), normal)
    assert (found - heading + pi / 2) % pi - pi / 2 == pytest.approx(0.0, abs=1e-12)  # rounding
    assert across == pytest.approx(0.18)
    assert length == pytest.approx(0.18 / abs(cos(e)))
    travel = places[0].x_m - places[1].x_m
    assert (normal + atan(travel / 0.18) - heading + pi / 2) % pi - pi / 2 == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("direction", "backward"), [(0.08, False), (1.5, True), (-1.7, False), (-0.5, True)])
def test_a_crossing_corrects_the_heading(direction: float, backward: bool) -> None:
    # 5 mrad of start error; after front and rear pair have crossed one or two seams 1 mrad may remain: 1 kHz at 0.1 m/s
    # places a sensor within 0.1 mm, 0.3 mrad of the 0.18 m between two sensors.
    ahead = 0.2
    start = PanelPose(
        PanelId(5, 5), ahead * cos(direction), ahead * sin(direction), direction + (pi if backward else 0.0)
    )
    sign = -1.0 if backward else 1.0
    world = truth(start, v=lambda t: sign * trapeze(0.1, 9.0, 0.1, 0.2)(t), noise=1.0, has_edges=True)
    localizer = make(PanelPose(start.panel, start.x_m + 0.001, start.y_m - 0.001, start.heading_rad + 0.005))
    run(localizer, world.frames(4.8))
    assert localizer.counts["crossings_used"] >= 4
    assert localizer.counts["crossings_gated"] == 0
    assert localizer.pose.panel != start.panel
    _, heading = errors(localizer, world.pose)
    assert abs(heading) < 0.001
    assert localizer.heading_sigma_rad < 0.0005
    assert abs(heading) < 4.0 * localizer.heading_sigma_rad


def crossing_run(**changes: float) -> Localizer:
    start = PanelPose(PanelId(5, 5), 0.15, 0.0, 0.1)
    localizer = make(start, unwrapped, **changes)
    run(localizer, truth(start, v=lambda _: 0.1, has_edges=True).frames(3.5))
    return localizer


def test_crossings_need_speed_and_straightness() -> None:
    assert crossing_run().counts["crossings_used"] == 4
    assert crossing_run(crossing_min_speed_m_s=0.2).counts["crossings_used"] == 0
    start = PanelPose(PanelId(5, 5), 0.15, 0.0, 0.0)
    turning = make(start)
    run(turning, truth(start, v=lambda _: 0.1, omega=lambda _: 0.05, has_edges=True).frames(3.5))
    assert turning.counts["crossings_used"] == 0


def test_a_single_false_crossing_is_refused_and_a_confident_error_is_not_kept() -> None:
    gate = HeadingGate(5.0)
    false = HeadingFix(0.1, 1e-7)
    assert gate.extra_variance(false, 1e-8) is None
    assert gate.extra_variance(HeadingFix(0.0, 1e-7), 1e-8) == 0.0
    assert gate.extra_variance(false, 1e-8) is None
    assert gate.extra_variance(HeadingFix(-0.1, 1e-7), 1e-8) is None  # does not agree with the one before
    assert gate.extra_variance(HeadingFix(-0.1002, 1e-7), 1e-8) == pytest.approx(0.1002**2)


def test_a_heading_that_is_wrong_beyond_its_sigma_recovers_at_the_seam() -> None:
    start = PanelPose(PanelId(5, 5), 0.15, 0.0, 0.1)
    localizer = make(PanelPose(start.panel, start.x_m, start.y_m, 0.13), start_heading_sigma_rad=0.001)
    world = truth(start, v=lambda _: 0.1, has_edges=True)
    run(localizer, world.frames(3.5))
    assert localizer.counts["crossings_gated"] == 1
    assert abs(errors(localizer, world.pose)[1]) < 0.001  # 1 kHz edges


def test_an_edge_far_from_any_seam_is_no_crossing() -> None:
    localizer = make()
    world = truth(v=lambda _: 0.1, has_edges=True)
    for k, (t, imu, encoders, edges, _) in enumerate(world.frames(1.0)):
        if k == 50:
            edges[:] = [EdgeSample(e.t_s, 0, 0, 1, 1) for e in edges]
        localizer.step(t, imu, encoders, edges)
    assert localizer.counts["crossings_used"] == localizer.counts["crossings_gated"] == 0


# --- stops, fixes, resets --------------------------------------------------------------------------------------------


def test_rest_leaves_a_consistent_covariance() -> None:
    filter_ = KalmanFilter(np.zeros(4), np.eye(4))
    localizer = make(wrap=lambda _: filter_)
    run(localizer, truth(v=lambda _: 0.1, omega=lambda _: 0.3).frames(0.5))
    heading, variance = filter_.mean[2], filter_.covariance[2, 2]
    pose = localizer.pose
    localizer.rest()
    assert (localizer.speed_m_s, localizer.rate_rad_s) == (0.0, 0.0)
    assert localizer.pose == pose
    assert filter_.mean.tolist() == [0.0, 0.0, heading, 0.0]
    sigmas = [1e-4, 1e-3, np.sqrt(variance), 1e-4]
    np.testing.assert_allclose(filter_.covariance, np.diag(np.square(sigmas)), rtol=1e-12)  # no correlation is left


def test_a_late_fix_belongs_to_its_own_time() -> None:
    # The fix is of the standstill one second ago; since then the robot has turned, driven and crossed a seam.
    start = PanelPose(PanelId(5, 5), 0.32, 0.02, 0.1)
    world = truth(start, v=trapeze(1.0, 9.0, 0.1, 2.0), omega=trapeze(1.0, 9.0, 0.2, 8.0))
    localizer = make(PanelPose(start.panel, start.x_m + 0.002, start.y_m - 0.001, 0.1), history_s=0.3)
    run(localizer, world.frames(0.5))
    fix = world.fix()
    run(localizer, world.frames(0.75))
    assert localizer.pose.panel == PanelId(5, 6)
    # The weight is 99 %: 20 mm at 0.01 rad since the fix beside 2 mm. 50 um: 1 % of the jump, and the 20 um within
    # which the odometer takes a robot for standing still. At "now" the fix would be 20 mm off.
    assert localizer.fuse_fix(fix) == pytest.approx(hypot(0.002, 0.001), rel=0.02)
    assert errors(localizer, world.pose)[0] < 5e-5


def test_the_odometer_keeps_a_standstill_and_drops_older_steps() -> None:
    odometer = Odometer(0.2)
    assert odometer.oldest_s == inf
    assert odometer.at(1.0) == OdometryPose(0.0, 0.0, 0.0)
    odometer.start(0.0)
    for k in range(1, 1001):
        odometer.advance(0.01 * k, 1e-7, 0.0, 0.01)
    assert odometer.oldest_s == 0.0
    for k in range(1001, 1101):
        odometer.advance(0.01 * k, 0.1, 0.0, 0.01)
    assert odometer.oldest_s == pytest.approx(10.79, abs=0.02)  # 0.2 s and the entry before
    assert odometer.at(10.905).x_m == pytest.approx(0.0905, abs=2e-6)  # creep of the standstill
    assert odometer.at(99.0) == odometer.place


# --- faults ----------------------------------------------------------------------------------------------------------


@pytest.mark.fault("S27")
def test_a_diverged_filter_freezes_the_pose_until_the_next_fix() -> None:
    filter_ = Fragile(KalmanFilter(np.zeros(4), np.eye(4)))
    localizer = make(wrap=lambda _: filter_)
    world = truth(v=trapeze(0.0, 0.5, 0.02, 0.2))
    run(localizer, world.frames(0.2))
    filter_.is_broken = True
    localizer.step(*world.frame())
    assert localizer.is_frozen
    assert localizer.hold_cause
    assert text_of(localizer.hold_cause) == "filter: for the sake of the test"
    pose = localizer.pose
    filter_.is_broken = False
    run(localizer, world.frames(0.5))
    localizer.rest()
    assert localizer.pose == pose
    assert localizer.counts["diverged"] == 1
    localizer.fuse_fix(world.fix())
    localizer.clear_hold()
    assert not localizer.is_frozen
    assert errors(localizer, world.pose)[0] < 1e-6
    assert localizer.heading_sigma_rad == pytest.approx(0.01 * 2**0.5, rel=0.02)  # the start's sigma on top; one frame
    run(localizer, world.frames(0.2))
    assert not localizer.hold_cause


@pytest.mark.parametrize("left", [1.0, -1.0])
def test_an_impossible_speed_freezes_instead_of_moving(left: float) -> None:
    localizer = make()
    run(localizer, truth(v=lambda _: 0.05).frames(0.3))
    pose = localizer.pose
    rate = 2.9 * config().robot.max_wheel_rad_s  # less than what the encoders may not show
    localizer.step(0.31, [], [WheelSample(0.31, rate, left * rate)], [])
    assert localizer.is_frozen
    assert localizer.pose == pose
    assert text_of(localizer.hold_cause).endswith("more than the wheels can do")


@pytest.mark.fault("S4")
@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_values_that_are_not_finite_never_reach_the_filter(bad: float) -> None:
    clean, bad_wheels, bad_imu = make(), make(), make()
    world = truth(v=lambda _: 0.05, noise=1.0)
    for frame in world.frames(0.3):
        t, imu, encoders, edges, _ = frame
        clean.step(*frame)
        noisy = [WheelSample(t, bad, 1.0), WheelSample(bad, 1.0, 1.0), WheelSample(t, 1.0, bad)]
        bad_wheels.step(t, imu, [*encoders, *noisy], edges)
        bad_imu.step(t, [*imu, ImuSample(t, bad, 0.0), ImuSample(t, 0.0, bad)], encoders, edges)
    assert bad_wheels.pose == clean.pose
    assert bad_wheels.counts["nonfinite"] == 30 * 3
    assert bad_imu.counts["imu_doubted"] == 30 * 3  # all of a frame
    assert errors(bad_imu, world.pose)[0] < 1e-3


@pytest.mark.parametrize("shift", [-4294.967296, -0.15, 0.15, 1e6])
def test_a_jump_of_the_clock_does_not_move_the_pose(shift: float) -> None:
    # S12: no step above 1 mm. One frame of 10 ms is lost while the jump is confirmed.
    localizer = make()
    world = truth(v=lambda _: 0.05)
    run(localizer, world.frames(0.5))
    before = localizer.deck_pose
    later = world.frames(0.02)
    run(localizer, [shifted(frame, shift) for frame in later])
    assert localizer.counts["resyncs"] == 1
    assert errors(localizer, before)[0] < 1e-6
    assert localizer.t_s == later[-1][0] + shift
    assert localizer.counts["backward"] == 0
    assert localizer.innovation is not None
    assert localizer.innovation.size == 22  # the samples of the new time base count
    assert localizer.position_sigma_m > 0.05 * 0.1  # what may have happened meanwhile
    fix = world.fix()
    assert localizer.fuse_fix(replace(fix, t_s=fix.t_s + shift)) < 0.002


@pytest.mark.fault("S11")
def test_five_backward_frames_in_a_row_ask_for_a_hold() -> None:
    localizer = make()
    frames = truth().frames(0.2)
    run(localizer, frames)
    for k in range(5):
        assert not localizer.hold_cause
        localizer.step(*frames[-2 - k])
    assert text_of(localizer.hold_cause) == "time stamps of the frames run backward"


@pytest.mark.fault("S11")
@pytest.mark.parametrize("source", ["imu", "right encoder", "left encoder"])
def test_five_backward_samples_in_a_row_ask_for_a_hold(source: str) -> None:
    localizer = make()
    run(localizer, truth().frames(0.2))
    for k in range(5):
        assert not localizer.hold_cause
        t = 0.1505 - 0.001 * k
        imu = [ImuSample(t, 0.0, 0.0)] if source == "imu" else []
        right, left = (0.0 if source == name else None for name in ("right encoder", "left encoder"))
        localizer.step(0.21 + 0.01 * k, imu, [] if imu else [WheelSample(t, right, left)], [])
    assert text_of(localizer.hold_cause) == f"time stamps of the {source} run backward"
    assert localizer.counts["backward"] == 5
    localizer.clear_hold()
    assert not localizer.hold_cause
