"""State of a mission: one frozen value; modes, events and transitions; what may happen to it."""

from collections.abc import Mapping, Sequence
from enum import Enum, StrEnum
from math import inf
from types import MappingProxyType
from typing import NamedTuple

import msgspec

from ccatp.control.gate import Purpose
from ccatp.core import PointId, Severity, Stop
from ccatp.survey.behaviours import Retreat, ReturnHome, Settling
from ccatp.survey.budget import BudgetProgress
from ccatp.survey.planning.route import Route
from ccatp.survey.route_follower import Leg


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


class FixNeed(Enum):
    """Whether a fix comes before the next move."""

    NONE = "none"
    CONFIRM = "confirm"  # at the start: the pose is not confirmed yet
    RELOCALIZE = "relocalize"  # the pose is known to be wrong


class Hold(NamedTuple):
    """How the robot is held."""

    by_hand: bool = False  # until an operator resumes
    is_fault: bool = False  # an operator has to look after it
    rejects_odometry: bool = False  # whatever wheels and inertial unit say, the robot stands


class HoldState(msgspec.Struct, frozen=True):
    """What every mission knows at one time: what it is at, how it is held, and why; times are robot time, s."""

    mode: MissionState = IDLE
    outcome: SurveyOutcome = SurveyOutcome.NONE
    cause: str = ""
    hold: Hold = Hold()
    abort_cause: str = ""  # why the mission was given up
    interlock: str = ""  # why nothing may move: an earthquake
    is_latched: bool = False  # of the newest verdict: an emergency, an earthquake, the gravest finding
    is_shaking: bool = False
    severity: Severity = Severity.NONE
    is_slow: bool = False
    full_fans: bool = False  # the robot shall be pressed on with full fans, from now on
    has_looked: bool = False  # a sensor that stays off was looked at with a fix
    finding: str = ""  # the cause for which the robot was sent home last
    emergency_epoch: int | None = 0  # the newest emergency acted on; None: what the first verdict has is not new
    stuck_s: float | None = None  # since when a retreat led nowhere
    resumes_after_s: float = -inf  # a hold that goes on by itself lasts at least until then

    @property
    def rejects_odometry(self) -> bool:
        """Held because wheels or inertial unit are not to be believed."""
        return self.mode is HELD and self.hold.rejects_odometry

    @property
    def is_faulted(self) -> bool:
        """An operator has to look after it."""
        return self.hold.is_fault

    @property
    def is_held_by_hand(self) -> bool:
        """Held until an operator resumes."""
        return self.mode is HELD and self.hold.by_hand

    @property
    def is_paused(self) -> bool:
        """Held until an operator resumes, or reports that an earthquake is over."""
        return self.mode is HELD and (self.hold.by_hand or bool(self.interlock))

    @property
    def stands_for_fix(self) -> bool:
        """It stands so that a fix shows where it is."""
        return False

    @property
    def is_recovering(self) -> bool:
        """It leaves an edge, or has to be found, before it may go home."""
        return False


class SurveyState(HoldState, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """All that a survey knows at one time."""

    route: Route
    stop_index: int = 0  # of the stop driven to, or measured at
    behaviour: Leg | Settling | Retreat | ReturnHome | None = None  # made on entry into a mode, dropped on leaving it
    fix: FixNeed = FixNeed.NONE
    done: tuple[PointId, ...] = ()  # points measured, in order
    skipped: tuple[PointId, ...] = ()  # points whose measurement failed
    failure_causes: Mapping[PointId, str] = msgspec.field(default_factory=dict)  # of those not measured since
    due: tuple[PointId, ...] = ()  # points to be measured next, in this order, away from the planned route
    retried: frozenset[PointId] = frozenset()  # points that failed and were due once more
    is_off_route: bool = False
    is_review_due: bool = False
    inflates_covariance: bool = False  # the localizer shall widen its covariance; the next command says so once
    wants_calibration: bool = False  # the calibration drive was given up, too far from where it leads
    is_missed: bool = False  # the last fix shows the robot too far from its point
    corrected: Stop | None = None  # the stop of the last correction
    corrections: int = 0
    request: int = 0  # number of the measurement that was asked for last
    arrived_at: PointId | None = None  # the last point with an arrival
    failures: int = 0  # failed measurements in a row
    heading_legs_left: int = 0  # of the search for the heading
    was_reverse: bool = True
    budget: BudgetProgress = BudgetProgress()
    is_found: bool = False  # a fix has just found the robot
    backoffs: int = 0
    stands_until_s: float = -inf  # nothing moves before then
    recoveries_s: tuple[float, ...] = ()  # when the estimate broke down lately

    @property
    def stop(self) -> Stop | None:
        """The stop of the route that is driven to, or measured at; ``None`` behind the last."""
        stops = self.route.stops
        return stops[self.stop_index] if self.stop_index < len(stops) else None

    @property
    def stops(self) -> Sequence[Stop]:
        """What is being driven along: the route, the way home, or a leg that shows the heading."""
        behaviour = self.behaviour
        if isinstance(behaviour, ReturnHome):
            return behaviour.stops
        if isinstance(behaviour, Leg) and self.fix is not FixNeed.NONE:
            return (behaviour.stop,)
        return self.route.stops

    @property
    def next_point(self) -> PointId | None:
        """The point to be measured next, at the current stop or a later one."""
        return next((stop.point for stop in self.route.stops[self.stop_index :] if stop.point is not None), None)

    @property
    def measuring_point(self) -> PointId | None:
        """The point being measured; ``None`` for a fix that only serves to find the robot again."""
        stop = self.stop
        return None if self.fix is not FixNeed.NONE or stop is None else stop.point

    @property
    def purpose(self) -> Purpose:
        """What the last gate lets the robot move for: legs that show the heading may be part of the way home."""
        if self.abort_cause and self.fix is not FixNeed.NONE and self.mode in (TURNING, DRIVING):
            return Purpose.HOMEWARD
        return PURPOSES[self.mode]

    @property
    def is_lost(self) -> bool:
        """The pose is known to be wrong, and is to be found again; at the start it is only to be confirmed."""
        return self.fix is FixNeed.RELOCALIZE

    @property
    def stands_for_fix(self) -> bool:
        """It stands so that a fix shows where it is."""
        return self.fix is not FixNeed.NONE and self.mode in (SETTLING, MEASURING)

    @property
    def is_recovering(self) -> bool:
        """It leaves an edge, or has to be found, before it may go home."""
        return self.mode is BACKING_OFF or self.fix is not FixNeed.NONE

    @property
    def is_awaiting_fix(self) -> bool:
        """Whether the measurement asked for last, number ``request``, is still wanted."""
        behaviour = self.behaviour
        return self.mode is MEASURING and isinstance(behaviour, Settling) and behaviour.is_requested

    @property
    def eta_s(self) -> float:
        """Least time that the rest of the survey takes, s; nothing is left of one that was given up or is over."""
        return 0.0 if self.abort_cause or self.mode is DONE else self.route.remaining_s(self.stop_index)


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


def by_reason(causes: Mapping[PointId, str]) -> dict[str, list[str]]:
    """Points, as people name them, by why they were left out."""
    named: dict[str, list[str]] = {}
    for point, why in causes.items():
        named.setdefault(why, []).append(f"{point.row}-{point.col}-{point.point}")
    return named
