"""Pure. The mission as a total state machine: states, events, and the table of transitions."""

from enum import StrEnum
from types import MappingProxyType

from ccatp.control.gate import Purpose


class State(StrEnum):
    """What the mission is at."""

    IDLE = "idle"
    TURNING = "turning"
    DRIVING = "driving"
    SETTLING = "settling"
    MEASURING = "measuring"
    BACKING_OFF = "backing off"
    RETURNING = "returning"
    HELD = "held"
    DONE = "done"


IDLE, TURNING, DRIVING, SETTLING, MEASURING, BACKING_OFF, RETURNING, HELD, DONE = State


class Event(StrEnum):
    """What can happen to it. Every event has a meaning in every state; where the table is silent it changes nothing."""

    GO_ON = "go on"  # the survey starts, or goes on to the next leg
    TURNED = "turned"  # the robot points at the stop
    REALIGN = "realign"  # it does not any more
    ARRIVED = "arrived"  # the stop is reached
    SETTLED = "settled"  # the robot is at rest there
    EDGE = "edge"  # code 1: near the mirror's edge
    GO_HOME = "go home"  # code 2, or the operator's abort
    FIND = "find"  # stand still for a fix: the pose is not to be trusted
    HOLD = "hold"  # pause, fault, or no permission to move
    FINISHED = "finished"  # all points done, at base after an abort, or stopped


class Outcome(StrEnum):
    """How a mission ended."""

    NONE = ""
    COMPLETE = "complete"
    AT_BASE = "aborted, at base"
    STOPPED = "stopped"


_ANYWHERE = {Event.HOLD: State.HELD, Event.FINISHED: State.DONE}
_SURVEYING = _ANYWHERE | {Event.EDGE: State.BACKING_OFF, Event.GO_HOME: State.RETURNING, Event.GO_ON: State.TURNING}

# (state, event) -> state. An edge outranks an abort: while backing off GO_HOME changes nothing. DONE is final.
TRANSITIONS = MappingProxyType(
    {
        State.IDLE: _ANYWHERE
        | {
            Event.GO_ON: State.TURNING,
            Event.GO_HOME: State.RETURNING,
            Event.EDGE: State.BACKING_OFF,
            Event.FIND: State.SETTLING,
        },
        State.TURNING: _SURVEYING | {Event.TURNED: State.DRIVING, Event.ARRIVED: State.SETTLING},
        State.DRIVING: _SURVEYING | {Event.REALIGN: State.TURNING, Event.ARRIVED: State.SETTLING},
        State.SETTLING: _SURVEYING | {Event.SETTLED: State.MEASURING},
        State.MEASURING: _SURVEYING,
        State.BACKING_OFF: _ANYWHERE | {Event.FIND: State.SETTLING},
        State.RETURNING: _ANYWHERE | {Event.EDGE: State.BACKING_OFF},
        State.HELD: _ANYWHERE
        | {
            Event.GO_ON: State.TURNING,
            Event.GO_HOME: State.RETURNING,
            Event.EDGE: State.BACKING_OFF,
            Event.FIND: State.SETTLING,
        },
        State.DONE: {},
    }
)


# What the last gate lets a state move for.
PURPOSES = MappingProxyType(
    {
        State.IDLE: Purpose.STAND,
        State.TURNING: Purpose.SURVEY,
        State.DRIVING: Purpose.SURVEY,
        State.SETTLING: Purpose.STAND,
        State.MEASURING: Purpose.STAND,
        State.BACKING_OFF: Purpose.RETREAT,
        State.RETURNING: Purpose.HOMEWARD,
        State.HELD: Purpose.STAND,
        State.DONE: Purpose.STAND,
    }
)


def next_state(state: State, event: Event) -> State:
    """The state after ``event``; total over all pairs."""
    return TRANSITIONS[state].get(event, state)
