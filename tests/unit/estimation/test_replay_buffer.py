"""Pure. A measurement that comes late is taken at its own time, and what followed is done again."""

from dataclasses import replace
from functools import cache, partial
from math import cos

import numpy as np
import pytest

from ccatp.conditions import text_of
from ccatp.core import Fix, FloatArray
from ccatp.estimation.fixes import FixGated, FixRefused, fix_row
from ccatp.estimation.full_state import FullStateLocalizer
from ccatp.estimation.localizer_base import unwrapped
from ccatp.estimation.odometry import Terrain
from ccatp.estimation.state_filter import ReplayBuffer
from ccatp.estimation.state_model import STATES, V, W, X, Y
from ccatp.filters import FILTERS
from ccatp.filters.kalman import KalmanFilter
from tests.unit.estimation.drive import (
    FRAME_S,
    STEEP,
    Fragile,
    Frame,
    Rate,
    Robot,
    build,
    errors_of,
    fix_at,
    mirror,
    run,
    shifted,
    trapeze,
)
from tests.unit.estimation.test_full_state import NOISY, STRAIGHT
from tests.unit.estimation.test_seams import across_it, before_a_seam

F, Q = np.array([[1.0, 0.1], [0.0, 1.0]]), np.diag([1e-3, 2e-3])
H, R = np.array([[1.0, 0.0]]), np.array([0.04])


class Recorded:
    """A linear filter of two states and its replay buffer; a step every 0.1 s."""

    def __init__(self, reach_s: float = 10.0) -> None:
        self.filter = KalmanFilter(np.zeros(2), np.eye(2))
        self.replay_buffer = ReplayBuffer(self.filter, reach_s)

    def step(self, k: int) -> None:
        self.replay_buffer.begin(0.1 * k, 0.1)
        self.replay_buffer.do(lambda: self.filter.predict(F, Q))
        self.replay_buffer.do(lambda: self.measure(0.3 * k, H))

    def measure(self, z: float, row: FloatArray) -> None:
        self.filter.update(np.array([z]), row, R)

    def late(self, t_s: float, z: float) -> int:
        return self.replay_buffer.take(t_s, lambda _: self.measure(z, np.array([[0.2, 1.0]])))


def same(one: Recorded, other: Recorded) -> None:
    sigma = np.sqrt(other.filter.covariance.diagonal())
    per_sigma = np.outer(sigma, sigma)
    np.testing.assert_allclose(one.filter.mean, other.filter.mean, rtol=1e-13)  # rounding
    # Rounding again; a covariance near zero has the rounding of the two variances, not of its own value.
    np.testing.assert_allclose(
        one.filter.covariance / per_sigma, other.filter.covariance / per_sigma, atol=1e-14, rtol=0.0
    )


@pytest.mark.parametrize("order", [(1,), (5,), (9,), (10,), (3, 6, 9), (9, 3, 6), (9, 6, 3), (6, 6, 3)])
def test_late_measurements_in_any_order_are_as_good_as_in_time(order: tuple[int, ...]) -> None:
    in_time, late = Recorded(), Recorded()
    for k in range(1, 11):
        in_time.step(k)
        late.step(k)
        for _ in range(order.count(k)):
            in_time.measure(float(k), np.array([[0.2, 1.0]]))
    for k in order:
        assert late.late(0.1 * k, float(k)) == 10 - k
    same(late, in_time)


@pytest.mark.parametrize("late_s", [0.01, 0.03])
def test_the_row_of_a_late_fix_is_its_derivative(late_s: float) -> None:
    x, terrain, step = build().state[0].copy(), Terrain(mirror()), 1e-6
    z = x[:2] + 1e-3
    x[[V, W]] = 0.1, 0.5

    def row_at(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return fix_row(z, x, terrain.at(float(x[X]), float(x[Y])), late_s)

    _, row = row_at(x)
    residuals = [[row_at(x + sign * step * unit)[0] for sign in (-1.0, 1.0)] for unit in np.eye(STATES)]
    numeric = np.array([(before - after) / (2.0 * step) for before, after in residuals]).T
    # Rounding of metres over the step; that the slope under the robot moves with it is left out: f'' v late = 5e-5.
    np.testing.assert_allclose(row, numeric, atol=1e-4)
    assert abs(row[0, V]) > 0.9 * late_s * np.cos(0.3)


# -- in the localizer -------------------------------------------------------------------------------------------------


def twice(*rates: Rate) -> Rate:
    return lambda t: sum(rate(t) for rate in rates)


CORNER = trapeze(2.05, 1.3, 0.8, 2.0)
DRIVES = {
    "straight on": (trapeze(0.5, 9.0, 0.1, 0.2), lambda _: 0.0, 3.0),
    "round a corner": (twice(STRAIGHT, trapeze(3.4, 9.0, 0.1, 0.2)), CORNER, 4.0),
    "a rest in between": (twice(STRAIGHT, trapeze(4.2, 1.5, 0.1, 0.2)), CORNER, 6.0),
}


@cache
def driven(name: str) -> tuple[list[Frame], list[Fix]]:
    """The frames of a drive, and a fix at the end of each."""
    v, omega, duration_s = DRIVES[name]
    robot, frames, fixes = Robot(v=v, omega=omega, errors=NOISY), [], []
    for _ in range(round(duration_s / FRAME_S)):
        frames.append(robot.frame())
        fixes.append(robot.fix())
    return frames, fixes


class Story:
    """A drive that several localizers hear of.

    Attributes:
        ends: frames after which the filter has taken a step, or the robot stood.
        fixes: for each frame, taken at its end.
    """

    def __init__(
        self, name: str, filter_name: str = "ekf", use: dict[str, bool] | None = None, **changes: float
    ) -> None:
        self.frames, self.fixes = driven(name)
        self._listener = partial(build, filter_name, STEEP, use, unwrapped, **changes)
        self.ends: list[int] = []
        listener = self._listener()
        for k, frame in enumerate(self.frames):
            before = listener.state[0]
            listener.step(*frame)
            if listener.state[0] is not before or listener.is_resting:
                self.ends.append(k)

    def end_after(self, t_s: float) -> int:
        return next(k for k in self.ends if k * FRAME_S >= t_s)

    def tell(self, deliveries: dict[int, list[Fix]]) -> FullStateLocalizer:
        """What a localizer finds that gets fixes after these frames."""
        found = self._listener()
        for k, frame in enumerate(self.frames):
            found.step(*frame)
            for fix in deliveries.get(k, []):
                found.fuse_fix(fix)
        return found


def apart(one: FullStateLocalizer, other: FullStateLocalizer) -> tuple[float, float]:
    """Largest difference of mean and covariance, in standard deviations; speeds at rest are known to nothing."""
    (x, P), (y, S) = one.state, other.state
    sigma = np.sqrt(P.diagonal()) + 1e-9
    return float(np.max(np.abs(x - y) / sigma)), float(np.max(np.abs(P - S) / np.outer(sigma, sigma)))


@pytest.mark.parametrize(("turn_creep_sigma_m_rad", "limit"), [(1e-6, 1e-4), (0.002, 3e-4)])
@pytest.mark.parametrize(
    ("name", "taken_s", "told_s"),
    [("straight on", 1.5, 1.6), ("round a corner", 1.8, 3.7), ("a rest in between", 3.6, 4.5)],
)
def test_a_late_fix_is_as_good_as_one_in_time(
    filter_name: str, name: str, taken_s: float, told_s: float, turn_creep_sigma_m_rad: float, limit: float
) -> None:
    """Without what a leg passes on to the next, which was passed on before the fix was known."""
    story = Story(
        name, filter_name, use={"slip_per_leg": False}, rewind_s=3.0, turn_creep_sigma_m_rad=turn_creep_sigma_m_rad
    )
    taken, reported = story.end_after(taken_s), story.end_after(told_s)
    fix = story.fixes[taken]
    in_time, late = story.tell({taken: [fix]}), story.tell({reported: [fix]})
    assert (in_time.counts["late_fixes"], late.counts["late_fixes"]) == (0, 1)
    mean, covariance = apart(in_time, late)
    # The ground is looked up where the filter thought it was: slopes off by 1e-7 in some hundred steps. Sigma points
    # lose half the digits of a covariance whose smallest variances are 1e-12 of its largest. With the creep of turns
    # the covariance of place and creep is off by 1.6e-4 after a corner.
    assert mean < 1e-5
    assert covariance < limit


@pytest.mark.parametrize("inside", [1, 3])
def test_a_fix_within_a_block_is_carried_to_its_end(inside: int) -> None:
    """In time it ends the block, so the noise of the block is taken in other portions: that is what differs."""
    story = Story("straight on")
    end = story.end_after(1.8)
    taken, reported = end - inside, story.end_after(2.6)
    in_time, late = (story.tell({k: [story.fixes[taken]]}) for k in (taken, reported))
    pose = [np.array([found.deck_pose.x_m, found.deck_pose.y_m]) for found in (in_time, late)]
    # v times the time to the block's end would be 1 mm for each frame.
    assert np.abs(pose[0] - pose[1]).max() < 5e-5
    late_only = story.tell({})
    assert np.abs(np.array([late_only.deck_pose.x_m, late_only.deck_pose.y_m]) - pose[0]).max() > 5e-4


def test_a_fix_older_than_the_path_or_from_the_future_is_refused() -> None:
    story = Story("straight on", rewind_s=0.5)
    found = story.tell({})
    before = found.deck_pose, found.state[0]
    with pytest.raises(FixRefused, match=r"fix of 2\.000 s is outside the known path, 2\.4\d0 s to 3\.100 s"):
        found.fuse_fix(story.fixes[199])
    assert found.deck_pose == before[0]
    assert np.array_equal(found.state[0], before[1])
    found.fuse_fix(story.fixes[280])
    there = found.deck_pose.x_m, found.deck_pose.y_m
    with pytest.raises(FixRefused, match=r"fix of 3\.110 s is outside the known path, \S+ s to 3\.100 s"):
        found.fuse_fix(fix_at(3.11, there))
    found.fuse_fix(fix_at(3.09, there))  # clocks may differ by a frame or ten


def test_a_standstill_however_long_does_not_grow_and_takes_a_measurement_of_its_beginning() -> None:
    reach_s, walked = 2.0, 5
    recorded = Recorded(reach_s)
    for k in range(1, walked + 1):
        recorded.step(k)
    stood_s, z = 0.1 * walked, 0.7
    row = np.array([[0.0, 1.0]])
    for k in range(1000):
        recorded.replay_buffer.begin(stood_s + 0.1 * (k + 1), 0.0)
        recorded.replay_buffer.do(partial(recorded.measure, 0.0, row))
        kept = sum(len(entry.steps) for entry in recorded.replay_buffer._entries)
        assert kept <= 2 * walked + reach_s / 0.1 + 1
    assert len(recorded.replay_buffer._entries) == 2
    # Taken in the standstill or at its first instant, it is a measurement of today's state.
    for t_s in (stood_s + 0.05, stood_s):
        assert recorded.replay_buffer.oldest_s <= t_s
        today = Recorded()
        today.filter.reset(recorded.filter.mean, recorded.filter.covariance)
        today.measure(z, np.array([[0.2, 1.0]]))
        recorded.late(t_s, z)
        same(recorded, today)


def fragile() -> tuple[FullStateLocalizer, Fragile]:
    filter_ = Fragile(FILTERS["ekf"](np.zeros(STATES), np.eye(STATES)))
    return build(wrap=lambda _: filter_), filter_


def test_a_filter_that_starts_again_stays_finite() -> None:
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
    assert not found.hold_cause
    assert errors_of(found, robot.pose)[0] < 1e-6  # it stands
    assert found.is_resting


def test_a_filter_that_diverges_at_a_fix_begins_anew_with_it() -> None:
    found, filter_ = fragile()
    robot = Robot(v=STRAIGHT, errors=NOISY)
    run(found, robot.frames(1.03))
    filter_.is_broken = True
    found.fuse_fix(robot.fix())
    assert found.counts["diverged"] == 1
    assert text_of(found.hold_cause) == "filter: for the sake of the test"
    assert not found.is_frozen
    assert errors_of(found, robot.pose)[0] < 1e-9


@pytest.mark.parametrize("before_s", [2.01, 2.03])
def test_after_a_reboot_fixes_are_taken(before_s: float) -> None:
    """Wherever in a block it was: nothing of the old time base decides about a fix."""
    found, robot = build(), Robot(v=trapeze(0.5, 9.0, 0.1, 0.2))
    for frame in robot.frames(before_s):
        found.step(*shifted(frame, 500.0))
    base_s = robot.t_s
    for frame in robot.frames(0.5):
        found.step(*shifted(frame, -base_s))
    found.fuse_fix(replace(robot.fix(), t_s=robot.t_s - base_s))
    assert errors_of(found, robot.pose)[0] < 3e-5


def test_silent_encoders_are_no_rest() -> None:
    found, robot = build(), Robot(v=trapeze(0.5, 9.0, 0.1, 0.2))
    for k, frame in enumerate(robot.frames(3.0)):
        found.step(*(frame._replace(encoders=[]) if 150 <= k < 180 else frame))
        assert not found.is_resting or k < 60
    assert errors_of(found, robot.pose)[0] < 4.0 * found.position_sigma_m


@pytest.mark.parametrize("within", [0, 3])
def test_a_relocation_while_the_robot_drives(within: int) -> None:
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


def test_repeated_steps_are_not_counted_again() -> None:
    start = before_a_seam(0, True)
    robot, found = Robot(start, v=across_it(), has_edges=True), build(start=start, rewind_s=5.0)
    frames = robot.frames(1.4)
    fix = robot.fix()
    run(found, frames + robot.frames(2.8))
    found.fuse_fix(fix)
    assert found.counts["crossings_used"] == 8
    assert found.counts["late_fixes"] == 1
