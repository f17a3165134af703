"""Pure. States of a mission among beacons."""

from enum import StrEnum


class State(StrEnum):
    """What the mission is at; idle, held and done mean to the danger loop that the robot stands."""

    IDLE = "idle"
    MAPPING = "mapping"  # stands while motes map themselves
    VISITING = "visiting"  # on the way to a waypoint
    FOLLOWING = "following"  # behind the target
    RETURNING = "returning"  # to where it started
    HELD = "held"
    DONE = "done"


IDLE, MAPPING, VISITING, FOLLOWING, RETURNING, HELD, DONE = State
MOVING = (VISITING, FOLLOWING, RETURNING)
