"""The mission as stories in virtual time: an ideal robot on one panel, verdicts as told."""

from collections.abc import Collection
from math import copysign, cos, hypot, sin

import pytest
from msgspec.structs import replace

from ccatp.conditions import text_of
from ccatp.conditions.danger import EDGE_SENSOR_STAYS_OFF, ENCODERS_STALE, ESTIMATE_NOT_FINITE, RIM_AHEAD
from ccatp.conditions.mission import NO_REST, STUCK_AT_EDGE
from ccatp.config.models import Config
from ccatp.core import Cause, DeckPose, PointId, Predicted, Severity, Stop, StopKind, Twist, Verdict
from ccatp.mirror.mirror import Mirror
from ccatp.survey.behaviours import SETTLE_LIMIT_S, MissionCommand
from ccatp.survey.events import (
    Abort,
    EstimateDiverged,
    Fault,
    FixFailed,
    FixStored,
    Interrupted,
    Mode,
    Pause,
    PointMissed,
    Resume,
    StopHere,
    SurveyOutcome,
)
from ccatp.survey.planning.legs import PlanError
from ccatp.survey.planning.route import Route
from ccatp.survey.route_follower import LegFollower, StateEstimate
from ccatp.survey.statechart import Mission, Survey
from tests.support.mission_story import ABORT, DT, FREE, FRONT_OFF, Story, from_first_leg


@pytest.fixture(scope="module")
def config(config: Config) -> Config:
    return from_first_leg(config)


@pytest.fixture
def story(config: Config, mirror: Mirror) -> Story:
    return Story(config, mirror)


def test_a_fix_at_the_start_comes_before_the_first_leg_and_costs_no_route(config: Config, mirror: Mirror) -> None:
    first = config.mission.model_copy(update={"fix_at_start": True})
    story = Story(config.model_copy(update={"mission": first}), mirror)
    story.until(lambda: story.orders != [] and story.orders[-1].measure)
    assert (story.v, story.omega, story.state.points.done) == (0.0, 0.0, ())
    story.finish()
    assert story.plans == []


@pytest.mark.parametrize("state", [Mode.DRIVING, Mode.MEASURING])
def test_pause_and_resume_from_every_state(story: Story, state: Mode) -> None:
    story.until_state(state)
    assert story.mission.handle(Pause(Cause("operator"))) is None
    for _ in range(100):
        assert story.frame().twist == Twist(0.0, 0.0)
    assert story.state.mode is Mode.HELD
    assert story.state.is_paused
    assert story.mission.handle(Resume()) is None
    story.finish()


def test_resume_is_refused_where_nothing_is_held(story: Story) -> None:
    story.until_state(Mode.DRIVING)
    assert story.mission.handle(Resume()) == "the mission is not held but driving"


@pytest.mark.parametrize("state", [Mode.TURNING, Mode.MEASURING, Mode.HELD])
def test_abort_goes_home_from_every_state(story: Story, state: Mode) -> None:
    if state is Mode.HELD:
        story.until_state(Mode.DRIVING)
        story.mission.handle(Pause(Cause("operator")))
    else:
        story.until_state(state)
    story.until_state(Mode.DONE, ABORT)
    assert story.state.outcome is SurveyOutcome.AT_BASE
    assert text_of(story.state.cause) == "emergency: fire"
    x, y = story.deck().x_m, story.deck().y_m
    assert hypot(x - story.base[0], y - story.base[1]) < 2e-3  # twice the arrival tolerance
    assert story.deck().heading_rad == pytest.approx(1.0, abs=0.011)  # heading tolerance and 1e-3 of frames


def test_a_robot_that_is_held_because_the_laser_does_not_follow_goes_home_by_odometry(story: Story) -> None:
    story.auto_fix = False
    story.until_state(Mode.MEASURING)
    story.mission.handle(Fault(Cause("the laser does not follow the robot")))
    assert story.state.is_faulted
    story.mission.handle(Abort(Cause("operator")))
    story.until_state(Mode.DONE)
    assert story.state.outcome is SurveyOutcome.AT_BASE


def test_edge_backs_off_at_most_60_mm_turns_away_fixes_and_resumes(story: Story, config: Config) -> None:
    story.drive_on()
    start = (story.x, story.y)
    story.frame(FRONT_OFF)
    for _ in range(60):
        assert story.frame(FRONT_OFF).twist.v_m_s <= 0.0
    backed = len(story.orders)
    assert story.state.cause == RIM_AHEAD.cause()
    story.until(lambda: story.state.mode is not Mode.BACKING_OFF)
    assert all(-config.mission.backoff_speed_m_s <= o.twist.v_m_s <= 0.0 for o in story.orders[backed:])
    assert hypot(story.x - start[0], story.y - start[1]) <= config.mission.backoff_m + 0.01
    assert story.state.mode is Mode.SETTLING
    story.until(lambda: story.orders[-1].measure)
    assert story.state.points.done == ()  # that fix was none of a point
    story.until(lambda: story.state.mode is Mode.DRIVING)
    assert len(story.plans) == 1  # the route goes on from where the robot really is
    story.finish()


def test_an_edge_that_does_not_clear_faults(story: Story) -> None:
    story.drive_on()
    story.until_state(Mode.HELD, FRONT_OFF)
    assert "stuck at the edge" in text_of(story.state.cause)
    assert not story.state.is_faulted  # it may have been a flash of light
    story.until(lambda: story.state.is_faulted, FRONT_OFF, frames=3100)
    assert "stuck at the edge" in text_of(story.state.cause)


def test_an_edge_that_does_not_clear_faults_by_its_own_cause(story: Story) -> None:
    story.drive_on()
    story.until_state(Mode.HELD, FRONT_OFF)
    story.frame(replace(FRONT_OFF, severity=Severity.HOLD, cause=ENCODERS_STALE.cause(), reverse=False))
    assert story.state.cause == ENCODERS_STALE.cause()
    story.until(lambda: story.state.is_faulted, FRONT_OFF, frames=3100)
    assert story.state.cause == STUCK_AT_EDGE.cause()


def test_a_pose_lost_while_it_measures_leaves_the_deadline_of_rest(story: Story) -> None:
    story.auto_fix = False
    story.until_state(Mode.MEASURING)
    point = story.state.measuring_point
    story.until(lambda: story.orders[-1].measure)
    story.mission.handle(FixStored(point, heading_sigma_rad=1.0))
    assert story.state.is_lost
    story.omega = 0.2
    for _ in range(round(SETTLE_LIMIT_S / DT) + 5):
        story.frame()
        story.omega = 0.2  # it does not come to rest
    assert story.state.cause.condition == NO_REST.name
    assert story.state.is_faulted


def test_no_leg_of_the_route_is_driven_with_a_heading_in_doubt(story: Story) -> None:
    """A fix that is stored late, on the way to another point, leaves the heading in doubt."""
    story.drive_on()
    leg = story.state.stops[story.state.stop_index]
    story.mission.handle(FixStored(PointId(5, 5, 3), heading_sigma_rad=1.0))
    assert story.state.is_lost
    story.until(lambda: story.state.stops != story.stops)
    (short,) = story.state.stops
    assert short.point is None
    assert short != leg


def found_at_the_edge(story: Story) -> None:
    """After a retreat and a fix the sensor is off still."""
    story.until_state(Mode.DRIVING)
    story.frame(FRONT_OFF)
    for _ in range(12):
        story.frame(FRONT_OFF)
    story.until_state(Mode.MEASURING)
    story.until(lambda: not story.state.is_lost)
    story.orders.clear()


def test_found_at_an_edge_it_stands_until_the_danger_loop_knows_where(story: Story) -> None:
    found_at_the_edge(story)
    for _ in range(19):
        story.frame(FRONT_OFF)
    assert not any(order.twist.v_m_s or order.twist.omega_rad_s for order in story.orders)
    assert story.state.mode is not Mode.BACKING_OFF
    story.until_state(Mode.DRIVING)
    story.finish()


def test_an_edge_that_the_danger_loop_still_sees_then_is_left_again(story: Story) -> None:
    found_at_the_edge(story)
    for _ in range(22):
        story.frame(FRONT_OFF)
    assert story.state.mode is Mode.BACKING_OFF


def test_a_sensor_that_stays_off_is_looked_at_with_one_fix(story: Story) -> None:
    stays_off = replace(
        FRONT_OFF, cause=EDGE_SENSOR_STAYS_OFF.cause(), signal="front_left", severity=Severity.HOLD, reverse=False
    )
    story.until_state(Mode.DRIVING)
    measured = len(story.state.points.done)
    for _ in range(300):
        story.frame(stays_off)
    assert story.state.mode is Mode.HELD
    assert story.state.cause == EDGE_SENSOR_STAYS_OFF.cause()
    assert sum(order.measure for order in story.orders[-300:]) == 1
    assert not any(order.twist.v_m_s or order.twist.omega_rad_s for order in story.orders[-300:])
    assert len(story.state.points.done) == measured  # the fix is nobody's point
    story.until(lambda: len(story.state.points.done) == 3)  # it came on: the survey goes on by itself


@pytest.mark.parametrize("severity", [Severity.NONE, Severity.SLOW, Severity.HOLD])
def test_a_cause_that_is_not_known_holds_the_robot_although_all_is_permitted(story: Story, severity: Severity) -> None:
    """The danger loop is of another version, so what it means to permit is not known."""
    story.drive_on()
    unknown = replace(FREE, cause=Cause("mirror_on_fire"), severity=severity)
    assert story.frame(unknown).twist == Twist(0.0, 0.0)
    assert (story.state.mode, text_of(story.state.cause)) == (Mode.HELD, "mirror_on_fire")
    story.finish()  # it is gone: a fix comes first
    assert story.state.outcome is SurveyOutcome.COMPLETE


def test_pause_while_backing_off_holds_and_resume_finds_the_robot_first(story: Story) -> None:
    story.drive_on()
    story.frame(FRONT_OFF)
    assert story.mission.handle(Pause(Cause("operator"))) is None
    for _ in range(50):
        assert story.frame(FRONT_OFF).twist == Twist(0.0, 0.0)
    assert story.mission.handle(Resume()) is None
    story.until(lambda: story.orders[-1].measure)  # nothing but a fix comes first
    assert all(order.twist == Twist(0.0, 0.0) for order in story.orders[-30:])
    story.finish()


def test_missing_data_during_a_back_off_only_pause_it(story: Story) -> None:
    story.drive_on()
    story.frame(FRONT_OFF)
    for _ in range(20):
        assert story.frame(replace(FRONT_OFF, reverse=False)).twist == Twist(0.0, 0.0)
    assert story.state.mode is Mode.BACKING_OFF
    assert story.frame(FRONT_OFF).twist.v_m_s < 0.0


def test_a_robot_that_cannot_be_found_does_not_drive(story: Story) -> None:
    story.auto_fix = False
    story.drive_on()
    for _ in range(60):
        story.frame(FRONT_OFF)
    for _ in range(3):
        assert not story.state.is_faulted
        story.until(lambda: story.state.is_awaiting_fix)
        asked = story.t
        story.mission.handle(FixFailed(story.state.measuring_point, "no answer"))
        story.frame()
        assert not story.state.is_awaiting_fix  # not before the robot has stood for another measuring time
    assert story.t - asked < 0.02
    assert story.state.is_faulted
    assert "cannot be found again: no answer" in text_of(story.state.cause)
    story.mission.handle(Resume())
    story.until(lambda: story.state.is_awaiting_fix)  # it tries again, and does not move before
    assert all(order.twist == Twist(0.0, 0.0) for order in story.orders[-60:])


def test_a_robot_that_stands_to_be_found_needs_no_permission(story: Story) -> None:
    story.until_state(Mode.DRIVING)
    story.mission.handle(Fault(Cause("filter: not finite"), loses_pose=True))
    story.mission.handle(Resume())
    denied = replace(FREE, forward=False, reverse=False, turn=False, cause=ESTIMATE_NOT_FINITE.cause())
    story.until(lambda: story.orders[-1].measure, denied)
    story.frame(denied)
    assert story.state.mode is Mode.HELD  # found, and waits for the permission to move
    story.finish()


class Creeping(Story):
    """Turns leave the place uncertain."""

    def motion(self) -> StateEstimate:
        return replace(super().motion(), sigma_m=self.sigma_m)

    sigma_m = 0.0


@pytest.mark.parametrize("sigma_m", [0.003, 0.004])
def test_a_turn_that_leaves_the_place_uncertain_ends_with_a_fix(config: Config, mirror: Mirror, sigma_m: float) -> None:
    """The leg then begins again, once, however little the fix says."""
    story = Creeping(config, mirror)
    story.sigma_m = sigma_m
    story.finish()
    extra = sum(order.measure for order in story.orders) - 3
    assert (extra > 0) is (sigma_m > 0.0033)
    assert extra <= 3


@pytest.mark.parametrize("doubts_odometry", [True, False])
def test_what_odometry_did_before_a_fault_that_loses_the_pose_is_doubted(story: Story, doubts_odometry: bool) -> None:
    """Once, as what the localizer gets from it is added; a filter that has diverged begins again by itself."""
    story.until_state(Mode.DRIVING)
    event = (
        Fault(Cause("blocked"), loses_pose=True)
        if doubts_odometry
        else EstimateDiverged(Cause("filter"), story.motion().t_s)
    )
    story.mission.handle(event)
    orders = [story.frame() for _ in range(20)]
    assert [order.inflates_covariance for order in orders] == [doubts_odometry, *[False] * 19]


def test_a_robot_that_never_rests_is_a_fault(story: Story) -> None:
    story.until_state(Mode.SETTLING)
    for _ in range(1100):
        story.v = 0.01
        story.frame()
        if story.state.is_faulted:
            break
    assert "does not come to rest" in text_of(story.state.cause)


def test_a_fix_committed_after_the_way_was_planned_anew_counts_once(story: Story) -> None:
    # A slow disk: the robot was paused meanwhile, and went on by a way whose next stop is not the point.
    via = Stop(*story.mirror.point_on_deck(PointId(5, 5, 5)), StopKind.VIA)
    planner = story.planner(
        rejoin=lambda route, start, skip: story.route_of((via, *story.plan_rest(route, start, skip).stops))
    )
    story.mission = Mission(Survey(story.config, story.mirror, story.route_of(story.stops), planner))
    story.auto_fix = False
    story.until(lambda: story.state.is_awaiting_fix)
    point = story.state.measuring_point
    assert point is not None
    story.mission.handle(Interrupted(Cause("a late frame")))
    story.until(lambda: bool(story.plans))
    story.mission.handle(FixStored(point))
    assert story.state.points.done == (point,)
    asked = []
    while story.state.mode is not Mode.DONE:
        if story.frame().measure:
            asked.append(story.state.measuring_point)
            story.mission.handle(FixStored(story.state.measuring_point))
    assert point not in asked
    assert [p.point for p in story.state.points.done] == [1, 2, 3]


def test_a_leg_that_does_not_end_faults(story: Story) -> None:
    story.until_state(Mode.DRIVING)
    x, y = story.x, story.y
    for _ in range(3000):
        story.frame()
        story.x, story.y = x, y  # the wheels spin
        if story.state.mode is Mode.HELD:
            break
    assert story.state.is_faulted
    assert "overdue" in text_of(story.state.cause)


def test_stop_ends_where_the_robot_stands(story: Story) -> None:
    story.until_state(Mode.DRIVING)
    story.mission.handle(StopHere())
    assert story.state.outcome is SurveyOutcome.STOPPED
    assert story.frame().twist == Twist(0.0, 0.0)
    assert story.mission.handle(Pause(Cause("late"))) == "the mission is over"
    assert story.mission.handle(Abort(Cause("late"))) == "the mission is over"


def miss(story: Story, ahead_m: float, left_m: float) -> None:
    """The fix at the first point shows the robot beside it: the stop lies so far ahead of and left of it."""
    story.auto_fix = False
    story.until(lambda: story.state.is_awaiting_fix)
    c, s = cos(story.heading), sin(story.heading)
    story.x -= c * ahead_m - s * left_m
    story.y -= s * ahead_m + c * left_m
    story.mission.handle(PointMissed())
    assert story.state.points.done == ()


def speeds_until_rest(story: Story) -> list[float]:
    speeds: list[float] = []

    def is_at_rest() -> bool:
        speeds.append(story.v)
        return story.orders[-1].at_rest

    story.frame()
    story.until(is_at_rest)
    return speeds[1:]


def distance_m(story: Story) -> float:
    return story.mission.survey.follower.distance_m(story.state.stop, story.motion().pose)


@pytest.mark.parametrize("ahead_m", [0.02, -0.02])
def test_a_point_missed_along_the_heading_is_approached_straight(story: Story, ahead_m: float) -> None:
    miss(story, ahead_m, 0.004)
    heading = story.heading
    for speed in speeds_until_rest(story):
        assert speed * ahead_m > -1e-5  # 0.5 mm/s: the end of the feed-forward may overshoot
    assert story.heading == pytest.approx(heading, abs=1e-6)  # what lies beside is within tolerance
    assert distance_m(story) == pytest.approx(0.004, abs=3e-4)  # stop tolerance
    assert (story.plans, story.state.corrections) == ([], 1)


@pytest.mark.parametrize("ahead_m", [0.01, -0.01])
@pytest.mark.parametrize("left_m", [0.015, -0.015])
def test_a_point_missed_beside_the_heading_is_turned_to_by_the_smaller_angle(
    story: Story, ahead_m: float, left_m: float
) -> None:
    miss(story, ahead_m, left_m)
    heading = story.heading
    assert all(speed * ahead_m > -5e-6 for speed in speeds_until_rest(story))  # forward, or in reverse, all the way
    turned_rad = copysign(0.983, ahead_m * left_m)  # atan(15/10)
    assert story.heading - heading == pytest.approx(turned_rad, abs=0.02)  # twice the heading tolerance
    assert distance_m(story) < 5e-4  # stop tolerance, and the heading tolerance over 18 mm
    assert (story.plans, story.state.corrections) == ([], 1)


def test_a_point_missed_by_far_is_reached_by_a_new_route(story: Story) -> None:
    miss(story, 0.04, 0.04)
    story.until(lambda: story.state.is_awaiting_fix)
    assert (len(story.plans), story.state.corrections) == (1, 0)
    assert distance_m(story) < 5e-4  # stop tolerance


def test_a_miss_that_a_pause_overtakes_ends_in_a_new_route(story: Story) -> None:
    miss(story, 0.03, 0.0)
    story.frame(None)
    story.auto_fix = True
    story.until_state(Mode.DONE)
    assert len(story.plans) == 1


def test_after_a_correction_an_unsafe_turn_is_planned_anew(story: Story, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LegFollower, "can_proceed", lambda *_: False)
    miss(story, 0.02, 0.0)
    story.auto_fix = True
    story.until_state(Mode.DONE)
    assert len(story.plans) == 1  # of the leg after the correction; the one after that is as planned
    assert len(story.state.points.done) == 3


def test_the_robot_is_steered_by_where_it_will_be_and_judged_by_where_it_is(story: Story) -> None:
    story.drive_on()
    now = story.motion()
    x, y, heading = now.steered.pose
    assert (x, y, heading) == (story.x, story.y, story.heading)
    aside = Predicted((x - 0.002 * sin(heading), y + 0.002 * cos(heading), heading + 0.05), story.v, story.omega)
    seen = replace(now, ahead=aside)
    assert seen.lead_rad == pytest.approx(0.05)
    assert story.mission.step(seen, FREE).twist.omega_rad_s < -0.1  # it will be left of its line and heading off it


@pytest.mark.parametrize("key", ["predicts_delay", "compensates_creep"])
def test_what_is_switched_off_does_not_steer(config: Config, mirror: Mirror, key: str) -> None:
    control = config.control.model_copy(update={key: False})
    story = Story(config.model_copy(update={"control": control}), mirror)
    story.drive_on()
    now = story.motion()
    x, y, heading = now.steered.pose
    ahead = Predicted((x, y, heading + 0.05), story.v, story.omega)
    used = (
        replace(now, ahead=ahead)
        if key == "predicts_delay"
        else replace(now, creep=(-0.1 * sin(heading), 0.1 * cos(heading)))
    )
    with_it, without = (Story(config, mirror), story)
    with_it.until(lambda: with_it.mission.state.mode is Mode.DRIVING and with_it.v > 0.09)
    assert abs(without.mission.step(used, FREE).twist.omega_rad_s) < 1e-3  # all but on its line: little to steer
    assert abs(with_it.mission.step(used, FREE).twist.omega_rad_s) > 0.1


def test_where_no_way_leads_on_or_home_a_fix_comes_before_the_fault(config: Config, mirror: Mirror) -> None:
    story = Story(config, mirror)

    def refuse(*_: object) -> Route:
        raise PlanError("walled in")

    planner = story.planner(home=refuse, rejoin=refuse)
    story.mission = Mission(Survey(config, mirror, story.route_of(story.stops), planner))
    story.until_state(Mode.DRIVING)
    story.mission.handle(PointMissed())
    story.mission.handle(Pause(Cause("operator")))
    story.mission.handle(Resume())
    for event, cause in ((None, "on"), (Resume(), "on"), (Abort(Cause("fire")), "home")):
        if event is not None:
            story.mission.handle(event)
        story.frame()
        assert story.state.mode is Mode.SETTLING
        begun = len(story.orders)
        story.until(lambda: story.state.is_faulted)
        assert [order.measure for order in story.orders[begun:]].count(True) == 1
        assert all(order.twist == Twist(0.0, 0.0) for order in story.orders[begun:])
        assert text_of(story.state.cause) == f"no way {cause}: walled in"


def test_a_robot_whose_estimate_is_beyond_the_rim_continues_after_a_fix(config: Config, mirror: Mirror) -> None:
    story = Story(config, mirror)

    def rejoin(route: Route, start: DeckPose, skip: Collection[PointId]) -> Route:
        if not [order for order in story.orders if order.measure]:
            raise PlanError("start is 0.2 m beyond the rim")
        return story.plan_rest(route, start, skip)

    story.mission = Mission(Survey(config, mirror, story.route_of(story.stops), story.planner(rejoin=rejoin)))
    story.until_state(Mode.DRIVING)
    story.mission.handle(Pause(Cause("operator")))
    story.mission.handle(Resume())
    story.finish()
    assert len(story.plans) == 1


class Gap(Story):
    """A story with a gap in the encoder samples, until the next fix."""

    gap_s, sigma_m, heading_sigma_rad = 0.0, 0.0, 0.0

    def motion(self) -> StateEstimate:
        sigmas = {"sigma_m": self.sigma_m, "heading_sigma_rad": self.heading_sigma_rad}
        return replace(super().motion(), gap_s=self.gap_s, **sigmas)

    def frame(self, verdict: Verdict | None = FREE) -> MissionCommand:
        order = super().frame(verdict)
        if order.measure:
            self.gap_s = self.sigma_m = self.heading_sigma_rad = 0.0
        return order

    def open(self, sigma_m: float, heading_sigma_rad: float) -> None:
        self.gap_s, self.sigma_m, self.heading_sigma_rad = 0.1, sigma_m, heading_sigma_rad


@pytest.mark.parametrize(("sigma_m", "heading_sigma_rad"), [(0.0034, 0.0), (0.0, 0.03), (0.003, 0.02)])
def test_after_a_gap_that_leaves_the_arrival_uncertain_a_fix_comes_before_the_next_move(
    config: Config, mirror: Mirror, sigma_m: float, heading_sigma_rad: float
) -> None:
    story = Gap(config, mirror)
    story.drive_on()
    story.open(sigma_m, heading_sigma_rad)
    begun = len(story.orders)
    story.until(lambda: story.orders[-1].measure)
    assert story.state.points.done == ()  # that fix was none of a point
    assert all(order.twist == Twist(0.0, 0.0) for order in story.orders[begun:])
    story.finish()


def test_a_gap_that_leaves_the_arrival_certain_costs_nothing(config: Config, mirror: Mirror) -> None:
    story = Gap(config, mirror)
    story.drive_on()
    story.open(0.001, 0.005)
    story.finish()
    assert story.plans == []


@pytest.mark.parametrize(("sigma_m", "stands"), [(0.02, False), (0.04, True)])
def test_on_the_way_home_a_gap_has_to_leave_the_clearance_from_the_rim(
    config: Config, mirror: Mirror, sigma_m: float, stands: bool
) -> None:
    story = Gap(config, mirror)
    story.drive_on()
    story.until(lambda: story.state.mode is Mode.RETURNING and story.v > 0.05, ABORT)
    story.open(sigma_m, 0.0)
    story.frame(ABORT)
    assert (story.state.mode is Mode.SETTLING) is stands
    story.until_state(Mode.DONE, ABORT)
    assert story.state.outcome is SurveyOutcome.AT_BASE


def test_eta_falls_as_stops_are_done(story: Story) -> None:
    assert story.state.eta_s == 3.0
    story.until(lambda: len(story.state.points.done) == 2)
    assert story.state.eta_s == 1.0
    story.mission.handle(Abort(Cause("operator")))
    assert story.state.eta_s == 0.0
    story.until_state(Mode.DONE)
    assert story.state.eta_s == 0.0
