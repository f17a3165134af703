"""Pure. The full-state localizer: fixes that contradict it, divergence, time stamps, and each of its techniques."""

from dataclasses import replace
from math import hypot, inf, nan, sqrt
from typing import Any

import numpy as np
import pytest

from ccatp.conditions import text_of
from ccatp.core import DeckPose, FloatArray, GravitySample, PanelPose, WheelSample
from ccatp.estimation.fixes import FixGated, FixRefused
from ccatp.estimation.full_state import FullStateLocalizer
from ccatp.estimation.localizer_base import MAX_FRAME_STEP_S
from ccatp.estimation.state_model import BG, CALIBRATION, PSI, SL, SR, TX, A, V, W, X, Y
from tests.unit.estimation.drive import (
    STEEP,
    Errors,
    Frame,
    Robot,
    build,
    config,
    errors_of,
    fix_at,
    mirror,
    run,
    shifted,
    trapeze,
)
from tests.unit.estimation.test_seams import across_it, before_a_seam

NOISY = Errors(right_slip=0.02, left_slip=0.01, creep=0.02, gyro_bias=0.01, noise=1.0)
LEVEL = replace(NOISY, creep=0.0)
COUNTING = replace(NOISY, counts_per_turn=1200)
STRAIGHT = trapeze(0.5, 1.5, 0.1, 0.2)


def rested(found: FullStateLocalizer, wrong: Errors = NOISY) -> Robot:
    """A robot that has driven 0.1 m and stands, and its localizer knows where."""
    robot = Robot(v=lambda t: STRAIGHT(t) + STRAIGHT(t - 3.0), errors=wrong)
    run(found, robot.frames(2.6))
    found.fuse_fix(robot.fix())
    return robot


# -- gating -----------------------------------------------------------------------------------------------------------


def test_a_fix_places_the_robot_and_shows_its_heading_after_a_way(filter_name: str) -> None:
    """Two fixes are a base line: 0.15 m and 10 um are 0.1 mrad; a creep that were not known would look the same."""
    found = build(filter_name, creep_sigma=1e-4)
    robot = rested(found, wrong=LEVEL)
    assert errors_of(found, robot.pose)[0] < 2e-5
    assert found.innovation is not None
    assert found.innovation.size == 2
    run(found, robot.frames(2.9))
    found.fuse_fix(robot.fix())
    distance_m, heading_rad = errors_of(found, robot.pose)
    assert distance_m < 2e-5
    assert found.heading_sigma_rad < 2e-3
    assert abs(heading_rad) < 4.0 * found.heading_sigma_rad
    assert found.counts["fixes"] == 2


def test_fixes_of_a_panel_share_its_tilt() -> None:
    """A puck 0.1 mm off its place at both ends of a base line of 0.135 m turns nothing; chance would, 1 mrad."""
    found = build(  # the wheels tell no heading, but they keep it
        panel_tilt_sigma_rad=2e-3,
        creep_sigma=1e-6,
        slip_difference_sigma=1e-6,
        slip_scatter_max=1e-6,
        wheel_base_sigma=1e-6,
    )
    robot = Robot(v=lambda t: STRAIGHT(t) + STRAIGHT(t - 3.0), errors=Errors(noise=1.0))
    run(found, robot.frames(2.6))
    found.fuse_fix(robot.fix(sigma_m=1e-6, off_m=(1e-4, 1e-4)))
    run(found, robot.frames(2.9))
    found.fuse_fix(robot.fix(sigma_m=1e-6, off_m=(1e-4, 1e-4)))
    assert found.heading_sigma_rad < 2e-4
    assert abs(errors_of(found, robot.pose)[1]) < 4.0 * found.heading_sigma_rad
    assert found.position_sigma_m == pytest.approx(1e-4, rel=0.2)  # the tilt itself cannot be told from the place


def test_a_single_wrong_fix_is_refused(filter_name: str) -> None:
    found = build(filter_name)
    robot = rested(found)
    before = found.pose, found.state[0].copy(), found.state[1].copy()
    with pytest.raises(FixGated, match=r"fix is 30\.0 mm from the estimate, sigma 0\.01 mm"):
        found.fuse_fix(robot.fix(off_m=(0.03, 0.0)))
    assert found.pose == before[0]
    assert np.array_equal(found.state[0], before[1])
    assert np.array_equal(found.state[1], before[2])
    assert found.counts["fixes_gated"] == 1
    assert found.fuse_fix(robot.fix()) < 1e-5
    assert not found.notices


@pytest.mark.parametrize("off_sigmas", [6.5, 7.5])
def test_a_fix_is_refused_beyond_the_limit_of_the_gate(off_sigmas: float) -> None:
    """Seven sigmas: their square is a NIS of 50."""
    found = build()
    robot = rested(found)
    x, P = found.state
    sigma = sqrt(P[X, X] + P[TX, TX] + 2.0 * P[X, TX] + 1e-10)
    fix = fix_at(robot.t_s, (float(x[X]) + off_sigmas * sigma, float(x[Y])))
    if off_sigmas < sqrt(50.0):
        found.fuse_fix(fix)
    else:
        with pytest.raises(FixGated):
            found.fuse_fix(fix)


OFF = (0.03, -0.02)
NEARLY = [OFF, (0.031, -0.02), (0.03, -0.021)]


def test_three_fixes_that_agree_relocate_the_robot(filter_name: str, full: Any) -> None:
    found = build(filter_name)
    robot = rested(found)
    heading, variance = found.deck_pose.heading_rad, float(found.state[1][PSI, PSI])
    for off in NEARLY[:2]:
        with pytest.raises(FixGated):
            found.fuse_fix(robot.fix(off_m=off))
    jump_m = found.fuse_fix(robot.fix(off_m=NEARLY[2]))
    assert jump_m == pytest.approx(sqrt(0.03**2 + 0.021**2), abs=3e-5)
    assert found.notices == ["3 fixes in a row say that the pose is 36.6 mm wrong: it starts again"]
    assert (found.counts["fixes_gated"], found.counts["reinitialised"], found.counts["fixes"]) == (3, 1, 2)
    assert found.deck_pose.x_m == pytest.approx(robot.x_m + 0.03, abs=1e-9)
    assert found.deck_pose.heading_rad == pytest.approx(heading, abs=1e-12)
    assert found.state[1][PSI, PSI] == pytest.approx(variance + full.relocated_heading_sigma_rad**2)
    assert found.position_sigma_m < 1.3e-5


def begin_anew(found: FullStateLocalizer, robot: Robot, off_m: tuple[float, float]) -> None:
    for _ in range(2):
        with pytest.raises(FixGated):
            found.fuse_fix(robot.fix(off_m=off_m))
    found.fuse_fix(robot.fix(off_m=off_m))


def test_a_leg_that_ended_elsewhere_makes_the_heading_uncertain() -> None:
    found = build()
    robot = rested(found)
    start = found.deck_pose
    run(found, robot.frames(2.9))
    end, before = found.deck_pose, float(found.state[1][PSI, PSI])
    leg_m = hypot(end.x_m - start.x_m, end.y_m - start.y_m)
    begin_anew(found, robot, (0.03, 0.03))
    doubt_rad = sqrt(float(found.state[1][PSI, PSI]) - before)
    assert doubt_rad == pytest.approx(hypot(0.03, 0.03) / leg_m, rel=0.02)  # the estimate is some 0.1 mm off


def begin_leg(found: FullStateLocalizer, robot: Robot) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of the state where the robot drives off."""
    while found.is_resting:
        run(found, robot.frames(0.01))
    return found.state


@pytest.mark.parametrize("slip_per_leg", [True, False])
def test_after_odometry_was_wrong_a_fix_corrects_only_the_pose(filter_name: str, slip_per_leg: bool) -> None:
    """An encoder is stuck for a part of the leg; the doubt comes when the robot stands, or while it drives."""
    for doubted_after_s in (1.0, 1.9):
        found = build(filter_name, use={"slip_per_leg": slip_per_leg})
        robot = rested(found)
        x, P = begin_leg(found, robot)
        frames = robot.frames(1.9)
        for k, frame in enumerate(frames):
            stuck = [WheelSample(t_s, 0.0, left) for t_s, _, left in frame.encoders]
            found.step(*(frame._replace(encoders=stuck) if 50 <= k < 80 else frame))
            if k + 1 == round(100 * doubted_after_s):
                found.inflate_covariance(0.05, 0.15)
        taught = np.abs(found.state[0] - x)[CALIBRATION] / np.sqrt(P.diagonal())[CALIBRATION]
        assert taught.max() > 3.0 or doubted_after_s < 1.9
        found.fuse_fix(robot.fix())
        assert errors_of(found, robot.pose)[0] < 2e-5
        y, S = found.state
        block = np.ix_(CALIBRATION, CALIBRATION)
        np.testing.assert_allclose(y[CALIBRATION], x[CALIBRATION], atol=1e-9)
        np.testing.assert_allclose(S[block], P[block], rtol=1e-6, atol=1e-12)


def test_a_second_relocation_in_a_row_resets_what_was_learned() -> None:
    found = build()
    robot = rested(found)
    learned = begin_leg(found, robot)[1][BG, BG]
    run(found, robot.frames(1.9))
    begin_anew(found, robot, (0.0, 0.03))
    assert found.state[1][BG, BG] == pytest.approx(learned)
    begin_anew(found, robot, (0.0, 0.06))
    assert found.state[1][BG, BG] > 10.0 * learned
    assert found.deck_pose.y_m == pytest.approx(robot.y_m + 0.06, abs=1e-4)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"t_s": nan}, "fix is not finite"),
        ({"position_m": (0.0, nan, 0.0)}, r"fix is not finite: \(0.0, nan, 0.0\) m"),
        ({"position_m": (0.0, inf, 0.0)}, "fix is not finite"),
        ({"covariance_m2": (nan,) * 9}, "fix is not finite"),
        ({"covariance_m2": (0.0,) * 9}, r"fix has the covariance .* along the surface"),
        ({"covariance_m2": (-1e-10, 0.0, 0.0, 0.0, 1e-10, 0.0, 0.0, 0.0, 1e-10)}, "along the surface"),
        ({"position_m": (40.0, -900.0, 300.0)}, "has no foot on the mirror"),
        ({"t_s": 0.0}, "outside the known path"),
    ],
)
def test_a_fix_that_reports_nothing_is_refused(change: dict[str, Any], match: str) -> None:
    found = build()
    robot = rested(found)
    run(found, robot.frames(2.8))
    before = found.pose, found.state[0]
    with pytest.raises(FixRefused, match=match) as refusal:
        found.fuse_fix(replace(robot.fix(), **change))
    assert not isinstance(refusal.value, FixGated)
    assert found.pose == before[0]
    assert np.array_equal(found.state[0], before[1])


@pytest.mark.parametrize(
    ("offs", "reinitialised"),  # None: a true fix
    [
        ([OFF, (-0.03, 0.02), (0.03, 0.02)], 0),  # they do not agree
        ([OFF, (0.0335, -0.02), (0.03, -0.0235)], 0),  # each 3.5 mm from the one before
        ([OFF, OFF, None, OFF, OFF], 0),  # a true one ends the row
        ([OFF, OFF, (-0.05, 0.0), OFF, OFF, OFF], 1),  # a wild one in between begins it anew
    ],
)
def test_only_three_consecutive_fixes_that_agree_relocate_the_robot(
    offs: list[tuple[float, float] | None], reinitialised: int
) -> None:
    found = build()
    robot = rested(found)
    gated = 0
    for off in offs:
        try:
            found.fuse_fix(robot.fix() if off is None else robot.fix(off_m=off))
        except FixGated:
            gated += 1
    assert gated == len(offs) - offs.count(None) - reinitialised
    assert found.counts["reinitialised"] == reinitialised


# -- divergence -------------------------------------------------------------------------------------------------------


def test_a_speed_that_no_wheel_can_give_is_a_divergence() -> None:
    found, robot = build(), Robot(v=STRAIGHT, errors=NOISY)
    run(found, robot.frames(1.2))
    rate = 2.9 * config().robot.max_wheel_rad_s  # less than what the encoders may not show
    for frame in robot.frames(0.1):
        encoders = [s._replace(right_rad_s=rate, left_rad_s=rate) for s in frame.encoders]
        found.step(*frame._replace(encoders=encoders))
    assert found.is_frozen
    assert "more than the wheels can do" in text_of(found.hold_cause)


# -- time stamps ------------------------------------------------------------------------------------------------------


def at_constant_speed(before: DeckPose, after: DeckPose, way_m: float) -> bool:
    """Within a millimetre; the slip that is not known makes 2 % of the way."""
    hx, hy, _, _ = mirror().body_axes(before)
    return abs(after.x_m - before.x_m - way_m * hx) < 1e-3 and abs(after.y_m - before.y_m - way_m * hy) < 1e-3


@pytest.mark.parametrize("jump_s", [-1.0, 1e4])
def test_when_the_clock_jumps_the_pose_does_not_step(jump_s: float) -> None:
    found, robot = build(), Robot(v=trapeze(0.5, 9.0, 0.1, 0.2), errors=NOISY)
    run(found, robot.frames(1.81))
    before, variance, t_s = found.deck_pose, float(found.state[1][X, X]), found.t_s
    found.step(*shifted(robot.frame(), jump_s))
    assert (found.deck_pose, found.t_s) == (before, t_s)  # a frame from elsewhere changes nothing
    assert found.counts["suspect_frames"] == 1
    found.step(*shifted(robot.frame(), jump_s))
    assert found.counts["resyncs"] == 1
    assert found.t_s == pytest.approx(robot.t_s + jump_s)
    assert at_constant_speed(before, found.deck_pose, 0.0)
    # What may have happened meanwhile.
    assert found.state[1][X, X] > variance + (0.09 * MAX_FRAME_STEP_S) ** 2
    for frame in robot.frames(0.5):
        found.step(*shifted(frame, jump_s))
    assert not found.is_frozen
    assert not found.hold_cause


# -- techniques -------------------------------------------------------------------------------------------------------


def both(name: str, frames: list[Frame], start: PanelPose = STEEP) -> tuple[FullStateLocalizer, FullStateLocalizer]:
    """The same drive with a technique and without."""
    found = build(start=start), build(start=start, use={name: False})
    for localizer in found:
        run(localizer, frames)
    return found


def test_zero_velocity_is_a_switch() -> None:
    with_, without = both("zero_velocity", Robot(v=STRAIGHT, errors=COUNTING).frames(2.9))
    full = config().localizer.full_state
    sigmas = full.rest_speed_sigma_m_s, full.rest_acceleration_sigma_m_s2, full.rest_turn_sigma_rad_s
    for state, sigma in zip((V, A, W), sigmas, strict=True):
        assert sqrt(with_.state[1][state, state]) <= sigma
        assert sqrt(without.state[1][state, state]) > 5.0 * sigma


def test_rest_biases_is_a_switch() -> None:
    with_, without = both("rest_biases", Robot(errors=NOISY).frames(3.3))
    assert sqrt(with_.state[1][BG, BG]) < 1.2e-3
    assert sqrt(without.state[1][BG, BG]) > 1.5e-3  # what the first quarter of a second showed
    assert with_.state[0][BG] == pytest.approx(0.01, abs=4e-3)


def test_seams_is_a_switch() -> None:
    start = before_a_seam(0, True)
    with_, without = both("seams", Robot(start, v=across_it(), has_edges=True).frames(4.2), start)
    assert with_.counts["crossings_used"] == 8
    assert without.counts["crossings_used"] == without.counts["crossings_gated"] == 0
    assert with_.state[1][X, X] < 4e-8
    assert without.state[1][X, X] > 1e-6


def test_gravity_is_a_switch() -> None:
    robot = Robot()
    gravity = mirror().gravity_in_robot(robot.pose)
    frames = [frame._replace(gravity=GravitySample(frame.t_s, *gravity)) for frame in robot.frames(5.3)]
    with_, without = both("gravity", frames)
    assert with_.heading_sigma_rad < 0.85 * without.heading_sigma_rad
    assert without.heading_sigma_rad == pytest.approx(0.01, rel=1e-2)


def test_slip_per_leg_is_a_switch() -> None:
    found = {}
    for is_used in (True, False):
        localizer = build(use={"slip_per_leg": is_used})
        robot = rested(localizer)
        run(localizer, robot.frames(0.7))
        before = localizer.state[1][[SR, SL], [SR, SL]]
        run(localizer, robot.frames(0.3))
        found[is_used] = localizer.state[1][[SR, SL], [SR, SL]] / before
    # 0.75 % of scatter from leg to leg against what the wheels' travel to the first fix left of 1.7 %.
    assert (found[True] > 1.05).all()
    assert (found[False] <= 1.0 + 1e-2).all()


def test_the_accelerometer_is_a_switch() -> None:
    with_, without = both("accelerometer", Robot(v=STRAIGHT, errors=COUNTING).frames(1.3))
    assert with_.state[1][A, A] < 0.9 * without.state[1][A, A]  # 0.1 m/s^2 of jumps against some counts in 40 ms


# -- the whole drive --------------------------------------------------------------------------------------------------

L_SHAPED = (lambda t: STRAIGHT(t) + STRAIGHT(t - 3.1), trapeze(2.05, 1.3, 0.8, 2.0))


@pytest.mark.parametrize(("turn_creep_sigma_m_rad", "limit"), [(1e-6, 0.25), (0.002, 0.3)])
@pytest.mark.parametrize("wrong", [NOISY, COUNTING])
def test_ekf_and_ukf_agree(wrong: Errors, turn_creep_sigma_m_rad: float, limit: float) -> None:
    """What sigma points see of the bends is small against what is not known.

    The gyroscope's scale error times the rate is the strongest of them: a percent of what is not known of the rate goes
    to the bias at each turn. The size of a turn, with which the body creeps, has a bend where the turn begins.
    """
    robot = Robot(v=L_SHAPED[0], omega=L_SHAPED[1], errors=wrong)
    found = [build(name, turn_creep_sigma_m_rad=turn_creep_sigma_m_rad) for name in ("ekf", "ukf")]
    for fix_after_s in (2.0, 3.6):
        frames = robot.frames(fix_after_s)
        for localizer in found:
            run(localizer, frames)
            localizer.fuse_fix(robot.fix())
    (x, P), (y, S) = (localizer.state for localizer in found)
    sigma = np.sqrt(P.diagonal())
    assert np.max(np.abs(x - y) / (sigma + 1e-9)) < limit
    assert np.sqrt(S.diagonal())[:13] == pytest.approx(sigma[:13], rel=0.06)
    for localizer in found:
        distance_m, heading_rad = errors_of(localizer, robot.pose)
        assert distance_m < 2e-5
        assert abs(heading_rad) < 4.0 * localizer.heading_sigma_rad


def test_between_steps_of_the_filter_the_pose_advances_by_dead_reckoning() -> None:
    """An all but perfect robot, known to be one: each frame's pose, whether the filter has stepped or not."""
    robot = Robot(
        v=L_SHAPED[0], omega=L_SHAPED[1], errors=Errors(noise=1e-3)
    )  # exact zeros would be those of a counter
    found = build(
        slip_mean=0.0,
        slip_sigma=1e-6,
        slip_scatter_max=1e-6,
        slip_difference_sigma=1e-6,
        creep_sigma=1e-6,
        turn_creep_sigma_m_rad=1e-9,
        wheel_base_sigma=1e-6,
    )
    for _ in range(500):
        found.step(*robot.frame())
        distance_m, heading_rad = errors_of(found, robot.pose)
        # The wheels' noise of 1 urad/s, and what of it the gyroscope's 9 urad/s are trusted.
        assert distance_m < 1e-6
        assert abs(heading_rad) < 1e-5
        assert found.t_s == robot.t_s
