"""Drives a leg (thesis 3.2) at the usual or the reduced speed; plans corrections and legs that show the heading."""

import dataclasses
from math import atan2, ceil, cos, hypot, pi, sin
from operator import itemgetter
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from ccatp.config.models import Config
from ccatp.control.thrust import TurnCreep
from ccatp.control.tracker import DONE, LegMotion, LegTracker
from ccatp.core import DeckPose, FloatArray, PanelId, PanelPose, Predicted, Stop, StopKind, Twist
from ccatp.kinematics import difference
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.legs import build_body, course_of_heading, room_m, sensor_depths

# Step in which a turn is checked. Between two steps a sensor at 0.13 m is up to 0.03 mm further out than at the steps.
_SWEEP_RAD = 0.04
# A leg that shows the heading: step of the search for room, least length, standard deviations of the heading to either
# side, and least part of the way that leads away from the rim where the robot could not turn.
_STEP_M = 0.01
_SHORTEST_M = 0.04
_SIGMAS = 2.0
_LEAVING = 0.5
_CREEP_STEP_RAD = 0.2  # step in which the creep of a turn is summed
_SLANT = 0.1  # largest shift of a leg's end beside its line, as a part of its length


class LegAim(NamedTuple):
    """End of a correction, in the frame of the panel on which the robot stands, after a turn in place."""

    x_m: float
    y_m: float
    reverse: bool
    turn_rad: float


def plan_aim(
    pose: tuple[float, float, float], target: tuple[float, float], tolerance_m: float, margin: float
) -> LegAim:
    """The least motion from ``pose`` (x, y, heading) to within the tolerance of ``target`` (x, y) in the same plane.

    It is straight along the heading if the lateral error is at most ``margin`` of the tolerance. Otherwise the robot
    first turns its head or its tail to the target, whichever turn is smaller.
    """
    x, y, heading = pose
    dx, dy = target[0] - x, target[1] - y
    c, s = cos(heading), sin(heading)
    ahead, beside = c * dx + s * dy, c * dy - s * dx
    if abs(beside) <= margin * tolerance_m:
        return LegAim(x + ahead * c, y + ahead * s, ahead < 0.0, 0.0)
    turn = difference(atan2(dy, dx), heading)
    if abs(turn) <= 0.5 * pi:
        return LegAim(*target, False, turn)
    return LegAim(*target, True, difference(turn, pi))


class StateEstimate(msgspec.Struct, frozen=True):
    """The localizer's estimate for one frame.

    ``creep``: drift (dx, dy) per metre of travel, in the plane of ``pose``. ``ahead``: predicted state, in the same
    plane, when the twist decided now takes effect; ``None``: at once. Steering uses ``ahead``; arrival and rest are
    judged by ``pose``. ``sigma_m``: standard deviation of the position in its worst direction. ``turn_creep_m_rad``:
    downhill creep per radian of a turn, mean over all headings, m. ``gap_s``: time without encoder samples since the
    last fix.
    """

    t_s: float
    dt_s: float
    pose: PanelPose
    speed_m_s: float
    rate_rad_s: float
    creep: tuple[float, float] = (0.0, 0.0)
    ahead: Predicted | None = None
    sigma_m: float = 0.0
    heading_sigma_rad: float = 0.0
    turn_creep_m_rad: float = 0.0
    gap_s: float = 0.0

    @property
    def steered(self) -> Predicted:
        """The state in which the next twist will take effect."""
        if self.ahead is not None:
            return self.ahead
        pose = self.pose
        return Predicted((pose.x_m, pose.y_m, pose.heading_rad), self.speed_m_s, self.rate_rad_s)

    @property
    def lead_rad(self) -> float:
        """Turn of the robot until the next twist takes effect."""
        return 0.0 if self.ahead is None else self.ahead.pose[2] - self.pose.heading_rad


class Leg(msgspec.Struct, frozen=True, tag=True):
    """The leg to a stop and its progress."""

    stop: Stop
    motion: LegMotion | None = None  # None before the first frame of the leg
    deadline_s: float = 0.0
    aim: tuple[PanelId, LegAim] | None = None  # of a correction; valid while the robot stays on that panel
    target: tuple[PanelId, tuple[float, float]] | None = None  # the stop in the frame of a panel, m


def _course(start: DeckPose | Stop, stop: Stop) -> float:
    return atan2(stop.y_m - start.y_m, stop.x_m - start.x_m)


class LegFollower:
    """Drives legs, and plans short ones that are safe."""

    def __init__(self, mirror: Mirror, cfg: Config) -> None:
        self._mirror, self._mission, self._timeout_factor = mirror, cfg.mission, cfg.control.leg_timeout_factor
        self._turn_creep = TurnCreep(cfg.robot)
        self._body = build_body(cfg.robot, cfg.mission)
        limits, health = cfg.limits, cfg.health
        slow = limits.model_copy(
            update={
                "v_max_m_s": min(limits.v_max_m_s, health.slow_speed_m_s),
                "omega_max_rad_s": min(limits.omega_max_rad_s, health.slow_rate_rad_s),
            }
        )
        self.tracker = LegTracker(cfg.control, limits, cfg.robot.wheel_lag_s, slow)

    def deck_pose(self, motion: StateEstimate) -> DeckPose:
        """The pose in the deck frame: not a part of the estimate, because it is seldom needed and takes 15 us."""
        return self._mirror.deck_pose(motion.pose)

    def follow(self, leg: Leg, motion: StateEstimate, *, is_slow: bool) -> tuple[Leg, Twist]:
        """One frame of a leg: its new progress, and the twist until the next frame."""
        steered, panel, tracker = motion.ahead or motion.steered, motion.pose.panel, self.tracker
        stop, tracked, deadline_s, aim, cached = leg.stop, leg.motion, leg.deadline_s, leg.aim, leg.target
        if cached is None or cached[0] != panel:
            cached = panel, self.target_in(panel, stop)
        target, reverse = cached[1], stop.reverse
        if aim is not None and aim[0] == panel:
            x, y, reverse, _ = aim[1]
            target = x, y
        if tracked is None:
            tracked = tracker.begin(steered.pose, target, reverse, motion.creep, is_slow=is_slow)
            deadline_s = self.deadline_s(motion.t_s, tracked)
        before = tracked.phase
        tracked, twist = tracker.step(tracked, steered.pose, target, motion.dt_s, steered, motion.creep)
        if tracked.phase is not before and tracked.phase is not DONE:
            deadline_s = self.deadline_s(motion.t_s, tracked)
        return Leg(stop, tracked, deadline_s, aim, cached), twist

    def begin(self, motion: StateEstimate, stop: Stop, after: Stop | None = None) -> Leg:
        """The leg to a stop. A leg to a via point ends uphill of it, to compensate the creep of the turn there.

        The lateral part of this shift is limited. There is no shift if the clearance of turns covers the creep, or if
        a sensor would come too near to the rim. ``after``: the next stop, to which the robot turns.
        """
        here, body = self.deck_pose(motion), self._body
        length_m, course = hypot(stop.x_m - here.x_m, stop.y_m - here.y_m), _course(here, stop)
        if after is None or stop.kind is not StopKind.VIA:
            return Leg(stop)
        arrival = course + (pi if stop.reverse else 0.0)
        turn_rad = difference(_course(stop, after) + (pi if after.reverse else 0.0), arrival)
        courses = np.linspace(arrival, arrival + turn_rad, 2 + int(abs(turn_rad) / _CREEP_STEP_RAD))
        way_m, downhill = self._creep(stop, courses, motion.turn_creep_m_rad * abs(turn_rad))
        if not body.turn_clearance_m < way_m < length_m:
            return Leg(stop)
        ahead_m = max(-way_m * cos(downhill - course), -0.5 * length_m)
        most_m = _SLANT * length_m
        beside_m = min(max(-way_m * sin(downhill - course), -most_m), most_m)
        dx_m = ahead_m * cos(course) - beside_m * sin(course)
        dy_m = ahead_m * sin(course) + beside_m * cos(course)
        left = np.linspace(1.0, 0.0, len(courses))
        depths = sensor_depths(self._mirror, body, stop.x_m + left * dx_m, stop.y_m + left * dy_m, courses)
        if depths.min() < body.turn_clearance_m:
            return Leg(stop)
        return Leg(dataclasses.replace(stop, x_m=stop.x_m + dx_m, y_m=stop.y_m + dy_m))

    def _creep(self, stop: Stop, courses: FloatArray, mean_m: float) -> tuple[float, float]:
        """Creep of a turn through ``courses``, m, and its direction, rad; ``mean_m``: mean creep over all headings."""
        gravities = [self._mirror.gravity_in_robot(DeckPose(stop.x_m, stop.y_m, c)) for c in courses.tolist()]
        share = sum(map(self._turn_creep.share, gravities)) / len(gravities)
        return share * mean_m, float(courses[0]) + atan2(gravities[0][1], gravities[0][0])

    def begin_turn(self, leg: Leg, motion: StateEstimate, heading_rad: float, *, is_slow: bool) -> Leg:
        """Begin the turn to a deck heading at the end of a leg."""
        tracked = self.tracker.begin_turn(difference(heading_rad, self.deck_pose(motion).heading_rad), is_slow=is_slow)
        return replace(leg, motion=tracked, deadline_s=self.deadline_s(motion.t_s, tracked))

    def turn(self, leg: Leg, tracked: LegMotion, motion: StateEstimate, heading_rad: float) -> tuple[Leg, Twist]:
        """One frame of the turn of ``begin_turn``."""
        remaining = difference(heading_rad, self.deck_pose(motion).heading_rad + motion.lead_rad)
        tracked, twist = self.tracker.step_turn(tracked, remaining, motion.dt_s, motion.steered.omega_rad_s)
        return replace(leg, motion=tracked), twist

    def deadline_s(self, t_s: float, tracked: LegMotion) -> float:
        """Deadline of a motion that begins now, robot time: far more than its bang-bang time."""
        return t_s + 5.0 + self._timeout_factor * tracked.planned_s

    def distance_m(self, stop: Stop | None, pose: PanelPose) -> float:
        """Distance to a stop, m; 0 without a stop."""
        if stop is None:
            return 0.0
        x, y = self.target_in(pose.panel, stop)
        return hypot(x - pose.x_m, y - pose.y_m)

    def is_at_rim(self, stop: Stop) -> bool:
        """Whether a stop is so near to the rim that the robot cannot turn there freely."""
        return self._mirror.rim.signed_distance_m(stop.x_m, stop.y_m) < self._body.turning_depth_m

    def target_in(self, panel: PanelId, stop: Stop) -> tuple[float, float]:
        """The stop in the frame of a panel, (x, y), m."""
        x, y, _ = self._mirror.panels[panel].from_deck(self._mirror.surface_point(stop.x_m, stop.y_m))
        return x, y

    def correction(self, pose: PanelPose, target: tuple[float, float]) -> LegAim | None:
        """The correction to a target in the panel's frame, m; ``None``: too far, or a sensor would pass the rim."""
        cfg = self._mission
        if hypot(target[0] - pose.x_m, target[1] - pose.y_m) > cfg.correction_reach_m:
            return None
        here = pose.x_m, pose.y_m, pose.heading_rad
        aim = plan_aim(here, target, cfg.correction_tolerance_m, cfg.correction_margin)
        turned = PanelPose(pose.panel, pose.x_m, pose.y_m, pose.heading_rad + aim.turn_rad)
        there = PanelPose(pose.panel, aim.x_m, aim.y_m, turned.heading_rad)
        deck_pose = self._mirror.deck_pose
        # Between the ends, a few centimetres apart, a sensor comes nearer to the rim by at most half of that.
        is_safe = self._can_turn(deck_pose(pose), aim.turn_rad) and self._can_turn(deck_pose(turned), 0.0)
        return aim if is_safe and self._can_turn(deck_pose(there), 0.0) else None

    def can_proceed(self, pose: DeckPose, stop: Stop) -> bool:
        """Whether the turn towards ``stop`` from the end of a correction keeps every sensor on the mirror."""
        bearing = atan2(stop.y_m - pose.y_m, stop.x_m - pose.x_m) + (pi if stop.reverse else 0.0)
        return self._can_turn(pose, difference(bearing, course_of_heading(self._mirror, pose)))

    def _can_turn(self, pose: DeckPose, turn_rad: float) -> bool:
        body = self._body
        if self._mirror.rim.signed_distance_m(pose.x_m, pose.y_m) >= body.turning_depth_m:
            return True
        course = course_of_heading(self._mirror, pose)
        courses = np.linspace(course, course + turn_rad, 1 + ceil(abs(turn_rad) / _SWEEP_RAD))
        depths = sensor_depths(self._mirror, body, np.array(pose.x_m), np.array(pose.y_m), courses)
        return bool(depths.min() >= body.turn_clearance_m)

    def heading_leg(self, deck: DeckPose, sigma_rad: float, *, was_reverse: bool) -> Stop | None:
        """The stop of a straight leg, forward or reverse, that shows an uncertain heading; ``None``: there is no room.

        It drives in the direction opposite to the last leg, unless the other direction has more room.
        """
        course, cfg = course_of_heading(self._mirror, deck), self._mission
        # With this clearance no sensor leaves the mirror at any heading.
        clearance_m = max(self._body.turning_depth_m, cfg.leg_clearance_m)
        legs = []
        for is_reverse in (not was_reverse, was_reverse):
            sign = -1.0 if is_reverse else 1.0
            way = sign * cos(course), sign * sin(course)
            wanted_m, spread = cfg.alignment_leg_m, _SIGMAS * sigma_rad
            way_m = room_m(self._mirror.rim, deck, way, wanted_m, _STEP_M, clearance_m, spread=spread, leaving=_LEAVING)
            x_m, y_m = deck.x_m + way_m * way[0], deck.y_m + way_m * way[1]
            legs.append((way_m, Stop(x_m, y_m, StopKind.CALIBRATE, reverse=is_reverse)))
        way_m, stop = max(legs, key=itemgetter(0))
        return stop if way_m >= _SHORTEST_M else None
