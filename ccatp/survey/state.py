"""The state of a survey as one frozen value: engagement and work, trust in the pose, place on the route, points."""

from collections.abc import Mapping, Sequence
from math import inf

import msgspec

from ccatp.control.gate import Purpose
from ccatp.control.tracker import LegPhase
from ccatp.core import PointId, Stop
from ccatp.survey.behaviours import Measuring, RequestState, Retreat, ReturnHome, Settling
from ccatp.survey.budget import BudgetProgress
from ccatp.survey.engagement import Engagement, Faulted, Held, Kind, Over, Paused, Phase, Ready
from ccatp.survey.events import DRIVING, PURPOSES, RETURNING, TURNING, Mode
from ccatp.survey.planning.route import Route
from ccatp.survey.points import PointLog
from ccatp.survey.route_follower import Leg


class OnLeg(Phase, frozen=True, tag=True):
    """Drives a leg; ``leg``: ``None`` until it is planned."""

    leg: Leg | None = None

    kind = Kind.WORK

    @property
    def mode(self) -> Mode:
        """Whether it turns first, or drives."""
        tracked = None if self.leg is None else self.leg.motion
        return DRIVING if tracked is not None and tracked.phase is LegPhase.DRIVE else TURNING


class Travel(OnLeg, frozen=True, tag=True):
    """Drives to the next stop."""


class ShowHeading(OnLeg, frozen=True, tag=True):
    """Drives a short leg, with a fix at each end, that shows the heading of a robot that was lost."""


class Returning(Phase, frozen=True, tag=True):
    """Drives home; ``way``: ``None`` until it is planned."""

    way: ReturnHome | None = None

    kind, shown = Kind.HOME, RETURNING


SurveyPhase = Ready | Travel | ShowHeading | Settling | Measuring | Retreat | Returning | Held | Paused | Faulted | Over


class Located(msgspec.Struct, frozen=True, tag=True):
    """The pose is trusted. ``stands_until_s``: no motion before then, until danger has judged the new pose."""

    stands_until_s: float = -inf


class Found(msgspec.Struct, frozen=True, tag=True):
    """A fix since the last frame makes the pose trusted again."""


class Unconfirmed(msgspec.Struct, frozen=True, tag=True):
    """A fix has to confirm the pose before the robot moves."""


class Lost(msgspec.Struct, frozen=True, tag=True):
    """The pose is known to be wrong. ``legs_left``: most legs that may be driven to determine the heading."""

    legs_left: int = 0


class OnRoute(msgspec.Struct, frozen=True, tag=True):
    """The next leg is that to the present stop."""


class OffRoute(msgspec.Struct, frozen=True, tag=True):
    """A route is planned before the next leg."""


class Missed(msgspec.Struct, frozen=True, tag=True):
    """The last fix shows the robot too far from its point, so that the next leg is a correction."""


class Corrected(msgspec.Struct, frozen=True, tag=True):
    """The position was corrected at a stop. Before the leg to another stop, the turn there has to be safe."""

    stop: Stop


class SurveyState(Engagement, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """The state of a survey."""

    phase: SurveyPhase = Ready()
    route: Route
    stop_index: int = 0  # of the stop driven to, or measured at
    pose: Located | Found | Unconfirmed | Lost = Located()
    course: OnRoute | OffRoute | Missed | Corrected = OnRoute()
    was_reverse: bool = True  # the last leg that showed the heading; the next one leads the other way
    inflates_covariance: bool = False  # the next command tells the localizer to inflate its covariance
    is_confirmed: bool = False  # a fix was taken since a way was found last
    recoveries_s: tuple[float, ...] = ()  # times of the recent divergences of the estimate
    points: PointLog = PointLog()
    arrived_at: PointId | None = None  # the last point with an arrival
    request: int = 0  # number of the last requested measurement
    corrections: int = 0
    failures: int = 0  # failed measurements in a row
    backoffs: int = 0  # since the last point was left
    budget: BudgetProgress = BudgetProgress()

    @property
    def mode(self) -> Mode:
        """Public name of the phase."""
        return Mode(self.phase.mode)

    @property
    def stop(self) -> Stop | None:
        """The stop of the route that is driven to, or measured at; ``None`` after the last."""
        stops = self.route.stops
        return stops[self.stop_index] if self.stop_index < len(stops) else None

    @property
    def stops(self) -> Sequence[Stop]:
        """The stops being driven along: the route, the way home, or a leg that shows the heading."""
        phase = self.phase
        if isinstance(phase, Returning) and phase.way is not None:
            return phase.way.stops
        if isinstance(phase, ShowHeading) and phase.leg is not None:
            return (phase.leg.stop,)
        return self.route.stops

    @property
    def next_point(self) -> PointId | None:
        """The point to be measured next, at the current stop or a later one."""
        return next((stop.point for stop in self.route.stops[self.stop_index :] if stop.point is not None), None)

    @property
    def measuring_point(self) -> PointId | None:
        """The point being measured; ``None`` for a fix that only relocalizes."""
        stop = self.stop
        return None if self.needs_fix or stop is None else stop.point

    @property
    def purpose(self) -> Purpose:
        """The purpose for the drive gate. After an abort, legs that show the heading belong to the way home."""
        if self.abort_cause and isinstance(self.phase, ShowHeading):
            return Purpose.HOMEWARD
        return PURPOSES[self.mode]

    @property
    def needs_fix(self) -> bool:
        """The pose is not trusted: the robot needs a fix before it moves on."""
        return isinstance(self.pose, Lost | Unconfirmed)

    @property
    def is_lost(self) -> bool:
        """The pose is known to be wrong. At the start it only has to be confirmed."""
        return isinstance(self.pose, Lost)

    @property
    def stands_until_s(self) -> float:
        """No motion before then."""
        return self.pose.stands_until_s if isinstance(self.pose, Located) else -inf

    @property
    def stands_for_fix(self) -> bool:
        """The robot stands still for a fix that it needs."""
        return self.needs_fix and isinstance(self.phase, Settling | Measuring)

    @property
    def is_awaiting_fix(self) -> bool:
        """Whether the last requested measurement, number ``request``, is still wanted."""
        return isinstance(self.phase, Measuring) and self.phase.request is RequestState.MADE

    @property
    def eta_s(self) -> float:
        """Least time that the rest of the survey takes, s; nothing is left of one that was given up or is over."""
        return 0.0 if self.abort_cause or self.kind is Kind.OVER else self.route.remaining_s(self.stop_index)


def by_reason(causes: Mapping[PointId, str]) -> dict[str, list[str]]:
    """Names of points ("row-column-number") by the reason why they were left out."""
    named: dict[str, list[str]] = {}
    for point, why in causes.items():
        named.setdefault(why, []).append(f"{point.row}-{point.col}-{point.point}")
    return named
