"""Pure. Where a survey stands: what its rooms share, and the few moves between the states that all of them make."""

from collections.abc import Callable, Collection, Sequence
from math import inf

from ccatp.config.models import Config
from ccatp.control.gate import Purpose
from ccatp.mirror.mirror import Mirror
from ccatp.planning.route import Route
from ccatp.samples import DeckPose, PointId, Severity, Stop
from ccatp.surveying.alignment import Aligner
from ccatp.surveying.correction import Corrector
from ccatp.surveying.homing import Homing
from ccatp.surveying.journey import Journey
from ccatp.surveying.leftovers import Leftovers
from ccatp.surveying.missed_point import MissedPoint
from ccatp.surveying.pace import PacedTracker
from ccatp.surveying.retreat import Retreat
from ccatp.surveying.states import HELD, PURPOSES, Event, Outcome, State, next_state
from ccatp.surveying.stopover import Stopover

PlanHome = Callable[[DeckPose], tuple[Stop, ...]]
PlanRest = Callable[[Route, DeckPose, Collection[PointId]], Route]
PlanPoints = Callable[[DeckPose, Sequence[PointId]], Route]


class Standing:
    """State, causes and parts of one survey.

    Args:
        cfg: the configuration.
        mirror: the mirror surveyed.
        route: the route of the survey.
        has_planner: points that failed once can be planned for.
        heading_sigma_of: how well the heading is known, rad.

    Attributes:
        state, outcome, cause: as operators see them.
        done, skipped: points, in the order in which that happened.
        leftovers: the points that failed.
        survey: the journey along the route.
        home: the way home, once it is planned.
        abort_cause: why the survey was given up, or ``None``.
        bar: why nothing may move, an earthquake, or empty.
        is_latched: an emergency is in force.
        is_shaking: there is an earthquake, though the robot may be leaving an edge first.
        severity: of the newest verdict.
        is_held_by_hand: somebody has to resume.
        is_faulted: something is wrong, and an operator has to look after it.
        is_hold_deaf: held because wheels or inertial unit are not to be believed.
        is_lost: a fix comes before the next move, because the pose is known to be wrong or (``is_at_start``) not
            confirmed yet.
        is_off_route: the way back to the route has to be planned.
        is_review_due: the time budget has to be looked at.
        doubts_pose: the localizer shall doubt its pose.
        wants_calibration: the calibration drive was given up, too far from where it leads.
        wants_full_fans: the robot shall be pressed on with all that the fans have.
        retreat: the retreat from an edge under way.
        stuck_s: when a retreat led nowhere, robot time.
        backoffs: retreats since the last point.
        waits_until_s: a hold that goes on by itself lasts at least until then, robot time.
        stands_until_s: nothing moves before then, whatever the state, robot time.
    """

    def __init__(
        self, cfg: Config, mirror: Mirror, route: Route, heading_sigma_of: Callable[[], float], *, has_planner: bool
    ) -> None:
        """Idle at base."""
        self.cfg, self.mirror, self.route, self._has_planner = cfg, mirror, route, has_planner
        self.tracker = PacedTracker(cfg.control, cfg.limits, cfg.health, cfg.robot.wheel_lag_s)
        self.survey = self.journey_along(route.stops)
        self.home: Homing | None = None
        self.stopover = Stopover(cfg.control, cfg.etalon.measuring_time_s)
        self.missed = MissedPoint(Corrector(mirror, cfg.robot, cfg.mission))
        self.aligner = Aligner(mirror, cfg.robot, cfg.mission, heading_sigma_of, self.journey_along)
        self.leftovers = Leftovers()
        self.state, self.outcome, self.cause = State.IDLE, Outcome.NONE, ""
        self.done: list[PointId] = []
        self.skipped: list[PointId] = []
        self.abort_cause: str | None = None
        self.bar = ""
        self.is_latched = self.is_shaking = False
        self.severity = Severity.NONE
        self.is_held_by_hand = self.is_faulted = self.is_hold_deaf = False
        self.is_lost = self.is_at_start = cfg.mission.fix_at_start
        self.is_off_route = self.is_review_due = self.doubts_pose = self.wants_full_fans = False
        self.wants_calibration = False
        self.retreat: Retreat | None = None
        self.stuck_s: float | None = None
        self.backoffs = 0
        self.waits_until_s = self.stands_until_s = -inf
        self._recoveries_s: list[float] = []

    def journey_along(self, stops: Sequence[Stop]) -> Journey:
        """A journey along stops."""
        return Journey(self.mirror, self.tracker, self.cfg.control.leg_timeout_factor, stops)

    @property
    def journey(self) -> Journey:
        """The journey being made: the survey, the way home, or a leg that shows the heading."""
        if self.aligner.journey is not None:
            return self.aligner.journey
        return self.survey if self.home is None else self.home.journey

    @property
    def ignores_motion(self) -> bool:
        """Held because wheels or inertial unit are not to be believed: whatever they say, the robot stands."""
        return self.state is HELD and self.is_hold_deaf

    @property
    def purpose(self) -> Purpose:
        """What the last gate lets the robot move for: legs that show the heading may be part of the way home."""
        if self.is_lost and self.abort_cause is not None and self.state in (State.TURNING, State.DRIVING):
            return Purpose.HOMEWARD
        return PURPOSES[self.state]

    @property
    def is_awaiting_fix(self) -> bool:
        """Whether the measurement asked for last is still wanted."""
        return self.state is State.MEASURING and self.stopover.is_asked

    def apply(self, event: Event) -> None:
        """Something happened: the table says what state that makes."""
        self.state = next_state(self.state, event)

    def lose(self) -> None:
        """The pose is known to be wrong: a fix comes before the next move."""
        self.is_lost, self.is_at_start = True, False

    def interrupt_travel(self) -> None:
        """Drive the leg anew from where the robot is."""
        (self.survey if self.home is None else self.home).interrupt()

    def interrupt_parts(self) -> None:
        """Forget where in a leg, a stop or a docking the robot was: it begins anew from where it is."""
        self.interrupt_travel()
        self.stopover.interrupt()
        self.missed.interrupt()
        self.aligner.interrupt()

    # -- holding and going on -------------------------------------------------------------------------------------

    def hold(self, cause: str, *, by_hand: bool) -> None:
        """Hold, until somebody resumes or until the cause is gone."""
        self.interrupt_parts()
        self.apply(Event.HOLD)
        self.is_held_by_hand = by_hand
        self.is_hold_deaf = False
        self.cause = cause

    def interrupt(self, cause: str) -> bool:
        """Hold until frames and verdicts are fresh again; returns whether that was news."""
        if self.state in (State.IDLE, State.HELD, State.DONE):
            return False
        self.hold(cause, by_hand=False)
        return True

    def fault(self, cause: str, *, is_lost: bool = False) -> None:
        """Hold until an operator resumes, because something is wrong; where the pose is, a fix comes first then."""
        if self.state is State.DONE:
            return
        self.is_lost |= is_lost
        self.hold(cause, by_hand=True)
        self.is_faulted = True

    def await_recovery(self, cause: str, *, is_pose_doubted: bool = False) -> None:
        """Hold until the cause is gone, and then find out where the robot is before moving on."""
        if self.state is State.DONE or (self.state is HELD and self.is_held_by_hand):
            return
        self.lose()
        was_deaf = self.ignores_motion
        if not self.interrupt(cause):
            self.cause = cause
        self.is_hold_deaf = was_deaf or is_pose_doubted

    def recover(self, cause: str, t_s: float) -> None:
        """Hold, and go on with a fix; what comes again and again is a fault.

        Args:
            cause: why.
            t_s: now.
        """
        if self.state is State.DONE or (self.state is HELD and self.is_held_by_hand):
            return
        health = self.cfg.health
        self._recoveries_s = [since_s for since_s in self._recoveries_s if t_s - since_s <= health.retry_window_s]
        if self._recoveries_s and t_s - self._recoveries_s[-1] <= health.pause_limit_s:
            self._recoveries_s.pop()  # still the same: frame by frame it is asked for again
        self._recoveries_s.append(t_s)
        if len(self._recoveries_s) > 1 + health.retries:
            self.fault(cause, is_lost=True)
        else:
            self.await_recovery(cause)
            # A filter that is frozen cannot tell when the robot stands.
            self.waits_until_s = t_s + health.retry_after_s

    def go_on(self) -> None:
        """To what is next: finding the robot, home, the next stop, or the end."""
        self.interrupt_parts()
        self.doubts_pose |= self.ignores_motion
        self.is_faulted = False
        # Wherever a hold left the robot: the route's next turn may not be safe there.
        self.is_off_route |= self.state is State.HELD
        if self.is_lost:
            self.apply(Event.FIND)
        elif self.abort_cause is not None:
            self.cause = self.abort_cause
            self.home = None  # planned anew from where the robot is now
            self.apply(Event.GO_HOME)
        elif self.survey.current is None and not self._has_more():
            self.outcome = Outcome.COMPLETE
            self.apply(Event.FINISHED)
        else:
            self.cause = ""
            self.apply(Event.GO_ON)

    def _has_more(self) -> bool:
        """Whether points are due away from the planned route: those that failed once, or a thinned rest."""
        if not self._has_planner:
            return False
        self.leftovers.begin_second_round()
        self.is_off_route |= bool(self.leftovers.due)
        return bool(self.leftovers.due)
