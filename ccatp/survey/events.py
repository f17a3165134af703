"""What a mission is at and what may happen to it: modes, events, transitions; what comes between two frames."""

from enum import StrEnum
from types import MappingProxyType
from typing import NamedTuple

from ccatp.control.gate import Purpose
from ccatp.core import PointId


class MissionState(StrEnum):
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
    # Among beacons:
    MAPPING = "mapping"  # stands while motes map themselves
    VISITING = "visiting"  # on the way to a waypoint
    FOLLOWING = "following"  # behind the target


IDLE, TURNING, DRIVING, SETTLING, MEASURING, BACKING_OFF, RETURNING, HELD, DONE, *AMONG_BEACONS = MissionState
MAPPING, VISITING, FOLLOWING = AMONG_BEACONS


class MissionEvent(StrEnum):
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


class SurveyOutcome(StrEnum):
    """How a mission ended."""

    NONE = ""
    COMPLETE = "complete"
    AT_BASE = "aborted, at base"
    STOPPED = "stopped"


_ANYWHERE = {MissionEvent.HOLD: HELD, MissionEvent.FINISHED: DONE}
_SURVEYING = _ANYWHERE | {
    MissionEvent.EDGE: BACKING_OFF,
    MissionEvent.GO_HOME: RETURNING,
    MissionEvent.GO_ON: TURNING,
}
# (state, event) -> state. An edge outranks an abort: while backing off GO_HOME changes nothing. DONE is final.
TRANSITIONS = MappingProxyType(
    {
        IDLE: _SURVEYING | {MissionEvent.FIND: SETTLING},
        TURNING: _SURVEYING | {MissionEvent.TURNED: DRIVING, MissionEvent.ARRIVED: SETTLING},
        DRIVING: _SURVEYING | {MissionEvent.REALIGN: TURNING, MissionEvent.ARRIVED: SETTLING},
        SETTLING: _SURVEYING | {MissionEvent.SETTLED: MEASURING},
        MEASURING: _SURVEYING,
        BACKING_OFF: _ANYWHERE | {MissionEvent.FIND: SETTLING},
        RETURNING: _ANYWHERE | {MissionEvent.EDGE: BACKING_OFF},
        HELD: _SURVEYING | {MissionEvent.FIND: SETTLING},
        DONE: {},
        **dict.fromkeys(AMONG_BEACONS, _ANYWHERE),
    }
)
# What the last gate lets a state of a survey move for.
PURPOSES = MappingProxyType(
    {
        IDLE: Purpose.STAND,
        TURNING: Purpose.SURVEY,
        DRIVING: Purpose.SURVEY,
        SETTLING: Purpose.STAND,
        MEASURING: Purpose.STAND,
        BACKING_OFF: Purpose.RETREAT,
        RETURNING: Purpose.HOMEWARD,
        HELD: Purpose.STAND,
        DONE: Purpose.STAND,
    }
)


def next_state(state: MissionState, event: MissionEvent) -> MissionState:
    """The state after ``event``; total over all pairs."""
    return TRANSITIONS[state].get(event, state)


class Pause(NamedTuple):
    """Hold until an operator resumes."""

    cause: str


class Resume(NamedTuple):
    """Go on after a hold; what holds the robot must be gone."""


class Abort(NamedTuple):
    """Return to base and end there."""

    cause: str


class StopHere(NamedTuple):
    """Hold the wheels and end here."""


class Interrupted(NamedTuple):
    """Frames or verdicts are not fresh: hold until they are."""

    cause: str


class Fault(NamedTuple):
    """Something is wrong: hold until an operator resumes."""

    cause: str
    loses_pose: bool = False


class EstimateDiverged(NamedTuple):
    """The localizer is frozen until it has a fix; what comes again and again is a fault."""

    cause: str
    t_s: float


class TrackingGap(NamedTuple):
    """The robot may have moved while it was not observed: it does not drive on before a fix, and a sure heading."""


class EmergencyKnown(NamedTuple):
    """An emergency that is latched when the first verdict comes is not new."""


class TakenOver(NamedTuple):
    """Go on with a state that another process left; before the first frame. The robot is found before it moves.

    ``measured``, in this order, and ``skipped`` as the mission's database has them; ``elapsed_s``: mission time so far.
    ``is_new_run``: an operator goes on with what had ended: what failed is tried again, and time counts from here.
    """

    measured: tuple[PointId, ...]
    skipped: tuple[PointId, ...] = ()
    elapsed_s: float = 0.0
    is_new_run: bool = False


class FixStored(NamedTuple):
    """The measurement that was asked for is taken, fused and stored; ``None``: it only serves to find the robot."""

    point: PointId | None
    heading_sigma_rad: float = 0.0


class PointMissed(NamedTuple):
    """The fix shows the robot too far from its point, which has to be approached again from where it really is."""


class FixFailed(NamedTuple):
    """The measurement failed for good: the point is skipped; several in a row hold the robot."""

    point: PointId | None
    cause: str
    heading_sigma_rad: float = 0.0


SurveyInput = (
    Pause | Resume | Abort | StopHere | Interrupted | Fault | EstimateDiverged | TrackingGap | EmergencyKnown
    | TakenOver | FixStored | PointMissed | FixFailed
)  # fmt: skip
