"""Pure. The full-state localizer after something went wrong: divergence, reboot, silence, a pose that was not true."""

from math import cos

import numpy as np
import pytest

from ccatp.core import DeckPose, Fix, PanelPose
from ccatp.estimation.fixes import FixGated
from ccatp.estimation.state_model import PSI
from tests.unit.localization.drive import STEEP, Robot, build, errors_of, fix_at, mirror, run, trapeze
from tests.unit.localization.test_full_state import NOISY, STRAIGHT, fragile, rested, shifted
from tests.unit.localization.test_journal import Story
from tests.unit.localization.test_rest import with_gravity
from tests.unit.localization.test_seam_lines import across_it, before_a_seam


def at(fix: Fix, t_s: float) -> Fix:
    return Fix(t_s, fix.position_m, fix.covariance_m2, fix.dop, fix.channels, fix.residual_rms_m)


def test_a_revived_filter_stays_alive() -> None:
    """The wheels went on while the filter stood; that way is not taken for one of the first block."""
    found, filter_ = fragile()
    robot = Robot(v=STRAIGHT, errors=NOISY)
    run(found, robot.frames(1.0))
    filter_.is_broken = True
    run(found, robot.frames(1.5))
    assert found.is_frozen
    filter_.is_broken = False
    found.fuse_fix(robot.fix())
    found.clear_hold()
    run(found, robot.frames(1.0))
    assert not found.hold_requested
    assert errors_of(found, robot.pose)[0] < 1e-6  # it stands
    assert found.is_resting


def test_a_robot_that_never_stopped_is_followed_again() -> None:
    found, filter_ = fragile()
    robot = Robot(v=trapeze(0.5, 9.0, 0.1, 0.2), errors=NOISY)
    run(found, robot.frames(1.3))
    filter_.is_broken = True
    run(found, robot.frames(0.2))
    filter_.is_broken = False
    found.fuse_fix(robot.fix())
    run(found, robot.frames(1.0))
    assert not found.is_frozen
    # 2 % of slip that are not known, on 0.1 m, and the first block, whose speed is not known.
    assert errors_of(found, robot.pose)[0] < 5e-3
    assert found.speed_m_s == pytest.approx(0.1, abs=5e-3)


def test_a_filter_that_diverges_at_a_fix_begins_anew_with_it() -> None:
    found, filter_ = fragile()
    robot = Robot(v=STRAIGHT, errors=NOISY)
    run(found, robot.frames(1.03))
    filter_.is_broken = True
    found.fuse_fix(robot.fix())
    assert found.counts["diverged"] == 1
    assert found.hold_cause == "filter: for the sake of the test"
    assert not found.is_frozen
    assert errors_of(found, robot.pose)[0] < 1e-9


@pytest.mark.parametrize("jump_s", [-500.0, 1e4])
@pytest.mark.parametrize("before_s", [1.81, 1.83])
def test_after_a_jump_of_the_clock_it_measures_the_same_speed(jump_s: float, before_s: float) -> None:
    """What the wheels did in the frame that begins the new time base belongs to the gap."""
    found, robot = build(), Robot(v=trapeze(0.5, 9.0, 0.1, 0.2), errors=NOISY)
    run(found, robot.frames(before_s))
    for _ in range(2):
        found.step(*shifted(robot.frame(), jump_s))
    before, true = found.deck_pose, robot.pose
    for frame in robot.frames(0.5):
        found.step(*shifted(frame, jump_s))
    assert found.speed_m_s == pytest.approx(0.1, abs=2e-3)  # 2 % of slip
    after, now = found.deck_pose, robot.pose
    assert after.x_m - before.x_m == pytest.approx(now.x_m - true.x_m, abs=2e-3)


@pytest.mark.parametrize("before_s", [2.01, 2.02, 2.03, 2.04])
def test_after_a_reboot_fixes_are_taken(before_s: float) -> None:
    """Wherever in a block it was: nothing of the old time base decides about a fix."""
    found, robot = build(), Robot(v=trapeze(0.5, 9.0, 0.1, 0.2))
    for frame in robot.frames(before_s):
        found.step(*shifted(frame, 500.0))
    base_s = robot.t_s
    for frame in robot.frames(0.5):
        found.step(*shifted(frame, -base_s))
    found.fuse_fix(at(robot.fix(), robot.t_s - base_s))
    assert errors_of(found, robot.pose)[0] < 3e-5


def test_silent_encoders_are_no_rest() -> None:
    found, robot = build(), Robot(v=trapeze(0.5, 9.0, 0.1, 0.2))
    for k, frame in enumerate(robot.frames(3.0)):
        found.step(*(frame._replace(encoders=[]) if 150 <= k < 180 else frame))
        assert not found.is_resting or k < 60
    assert errors_of(found, robot.pose)[0] < 4.0 * found.position_sigma_m


def test_at_rest_a_fix_may_come_late() -> None:
    """A standstill is one moment, however long: nothing has changed since its beginning."""
    found, robot = build(), Robot(v=STRAIGHT)
    run(found, robot.frames(2.6))
    fix = robot.fix()
    run(found, robot.frames(6.0))
    found.fuse_fix(fix)
    assert errors_of(found, robot.pose)[0] < 2e-5


@pytest.mark.parametrize("within", [0, 1, 2, 3])
def test_a_new_beginning_while_it_drives(within: int) -> None:
    """The third of three fixes that agree, of some frames ago: the robot has gone on, and the wheels tell how fast."""
    story = Story("straight on")
    end = story.end_after(1.8)
    found = build()
    for frame in story.frames[: end + 1]:
        found.step(*frame)
    here, speed = found.deck_pose, found.speed_m_s
    true = fix_at(story.fixes[end - within].t_s, (here.x_m + 0.06, here.y_m))
    for _ in range(2):
        with pytest.raises(FixGated):
            found.fuse_fix(true)
    assert found.deck_pose == here
    found.fuse_fix(true)
    assert found.deck_pose.x_m - here.x_m - 0.06 == pytest.approx(1e-3 * within * cos(0.3), abs=5e-5)  # 2 % of slip
    assert found.speed_m_s == pytest.approx(speed, abs=1e-3)
    for frame in story.frames[end + 1 : end + 61]:
        found.step(*frame)
    assert found.deck_pose.x_m - here.x_m - 0.06 == pytest.approx((1e-3 * within + 0.06) * cos(0.3), abs=3e-3)


def test_what_is_learned_at_rest_is_told() -> None:
    robot, found = Robot(), build(start_heading_sigma_rad=0.3)
    turned = DeckPose(robot.x_m, robot.y_m, robot.pose.heading_rad + 0.2)
    run(found, with_gravity(robot.frames(3.3), mirror(), turned))
    assert found.deck_pose.heading_rad == pytest.approx(float(found.state[0][PSI]), abs=1e-12)
    assert found.deck_pose.heading_rad == pytest.approx(turned.heading_rad, abs=0.01)  # as good as three chunks


def test_a_fix_at_rest_leaves_no_speed() -> None:
    found = build()
    rested(found)
    assert found.is_resting
    assert found.speed_m_s == 0.0
    assert found.rate_rad_s == 0.0


def test_what_is_done_again_does_not_count_again() -> None:
    start = before_a_seam(0, True)
    robot, found = Robot(start, v=across_it(), has_edges=True), build(start=start, rewind_s=5.0)
    frames = robot.frames(1.4)
    fix = robot.fix()
    run(found, frames + robot.frames(2.8))
    found.fuse_fix(fix)
    assert found.counts["crossings_used"] == 8
    assert found.counts["late_fixes"] == 1


def test_the_innovation_is_that_of_the_last_fix() -> None:
    """Of the one that came last, not of the one that was taken last, which is done again after it."""
    story = Story("straight on")
    early, later = story.end_after(1.2), story.end_after(2.0)
    alone = story.tell({later: [story.fixes[early]]}).innovation
    found = build()
    for frame in story.frames[: later + 1]:
        found.step(*frame)
    found.fuse_fix(story.fixes[later - 4])
    found.fuse_fix(story.fixes[early])
    assert found.innovation is not None
    assert alone is not None
    assert found.innovation.residual == pytest.approx(alone.residual, abs=1e-9)


def test_a_new_beginning_has_no_innovation() -> None:
    found = build()
    robot = rested(found)
    assert found.innovation is not None
    for _ in range(2):
        with pytest.raises(FixGated):
            found.fuse_fix(robot.fix(off_m=(0.05, 0.0)))
    found.fuse_fix(robot.fix(off_m=(0.05, 0.0)))
    assert found.innovation is None


def test_a_new_beginning_keeps_what_was_learned_of_the_sensors() -> None:
    found = build(start=PanelPose(STEEP.panel, 0.0, 0.0, 0.3))
    robot = rested(found)
    before = found.state[0][6:13].copy()
    for _ in range(2):
        with pytest.raises(FixGated):
            found.fuse_fix(robot.fix(off_m=(0.05, 0.0)))
    found.fuse_fix(robot.fix(off_m=(0.05, 0.0)))
    assert np.array_equal(found.state[0][6:13], before)
