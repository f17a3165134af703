"""The way home: from any place on the mirror to base along panels inside the rim, as a series of stops."""

import numpy as np

from ccatp.config.models import LimitsConfig, MissionConfig, RobotConfig
from ccatp.core import DeckPose, Stop, StopKind, difference
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.escape import find_escape, find_retreats
from ccatp.survey.planning.legs import (
    LegRules,
    OutsideMirrorError,
    UnreachablePointError,
    build_body,
    build_places,
    course_of_heading,
    in_parts,
)
from ccatp.survey.planning.search import Search, SearchNode, Target, turn_time

# About one stop per panel: there the robot points itself at base anew.
_LONGEST_LEG_M = 0.75


def plan_way_home(
    mirror: Mirror,
    start: DeckPose,
    base: DeckPose,
    robot: RobotConfig,
    limits: LimitsConfig,
    mission: MissionConfig,
) -> tuple[Stop, ...]:
    """Stops from a deck pose anywhere on the mirror to base; the last is base itself, with its heading.

    Near the rim the first stop leads straight away from it, forward or in reverse, to where the robot can turn. From
    there on legs and turns keep the clearances of a survey. Raises ``OutsideMirrorError`` (start), and
    ``UnreachableError`` if base lies where the clearances allow no way.
    """
    body = build_body(robot, mission)
    here, goal = build_places(mirror, body, np.array([start.x_m, base.x_m]), np.array([start.y_m, base.y_m]))
    if not here.depth_m > 0.0:
        raise OutsideMirrorError(
            f"no way home from ({start.x_m:.3f}, {start.y_m:.3f}) m: {-here.depth_m:.3f} m beyond the rim of "
            f"{mirror.name}"
        )
    first = SearchNode(here, course_of_heading(mirror, start), 0.0)
    if here.stance is not None:
        first = find_escape(mirror, body, first, limits)
    search = Search(LegRules(mirror, body), limits)
    arrivals = search.advance([first], (), Target(goal, find_retreats(mirror, body, [goal])[0]))
    if not arrivals:
        raise UnreachablePointError(
            f"no safe way to base at ({base.x_m:.3f}, {base.y_m:.3f}) m, {goal.depth_m:.3f} m from the rim of "
            f"{mirror.name}, with leg_clearance_m = {mission.leg_clearance_m} and "
            f"turn_clearance_m = {mission.turn_clearance_m}"
        )
    path = _best(arrivals, course_of_heading(mirror, base), limits).path()
    ends = [Stop(a.place.x_m, a.place.y_m, StopKind.VIA, None, a.reverse) for a in path[:-1]]
    ends.append(Stop(base.x_m, base.y_m, StopKind.BASE, None, path[-1].reverse, base.heading_rad))
    begins = [(here.x_m, here.y_m), *((stop.x_m, stop.y_m) for stop in ends)]
    return tuple(
        part for begin, end in zip(begins, ends, strict=False) for part in in_parts(*begin, end, _LONGEST_LEG_M)
    )


def _best(arrivals: list[SearchNode], course_rad: float, limits: LimitsConfig) -> SearchNode:
    """The cheapest way in, the turn to the final course included; one from which that turn is safe, if there is."""

    def rank(arrival: SearchNode) -> tuple[bool, float]:
        turned_s = turn_time(difference(course_rad, arrival.course_rad), limits)
        return not arrival.place.can_turn(arrival.course_rad, course_rad), arrival.cost_s + turned_s

    return min(arrivals, key=rank)
