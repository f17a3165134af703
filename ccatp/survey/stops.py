"""Standing at a stop until the measurement, the way home, and what the mission wants of a frame."""

import msgspec

from ccatp.config.models import ControlConfig
from ccatp.control.tracker import LegPhase, LegTracker
from ccatp.core import PointId, Stop, StopKind, Twist, difference
from ccatp.survey.route_follower import RouteFollower, StateEstimate

# Sums of frame periods are not exact: half a nanosecond must not cost a frame.
TIME_EPSILON_S = 5e-10


class StandstillDetector:
    """At rest: both speeds, or both of their running means, have been below the limits for the settling time.

    Fans shake the body with a mean of zero; wheels that run down, or that creep, move the mean as well.
    """

    __slots__ = ("_cfg", "_mean_rate_rad_s", "_mean_speed_m_s", "_since_s")

    def __init__(self, cfg: ControlConfig) -> None:
        self._cfg = cfg
        self.reset()

    def reset(self) -> None:
        """The robot moves, or may have moved."""
        self._since_s: float | None = None
        self._mean_speed_m_s: float | None = None
        self._mean_rate_rad_s = 0.0

    def is_rest(self, t_s: float, dt_s: float, speed_m_s: float, rate_rad_s: float) -> bool:
        """Take the speeds of a frame, ``dt_s`` after the one before; whether the robot is at rest."""
        cfg = self._cfg
        if self._mean_speed_m_s is None:
            self._mean_speed_m_s, self._mean_rate_rad_s = speed_m_s, rate_rad_s
        share = dt_s / (cfg.settle_mean_time_s + dt_s)
        self._mean_speed_m_s += share * (speed_m_s - self._mean_speed_m_s)
        self._mean_rate_rad_s += share * (rate_rad_s - self._mean_rate_rad_s)
        is_slow = self._is_slow(speed_m_s, rate_rad_s) or self._is_slow(self._mean_speed_m_s, self._mean_rate_rad_s)
        if not is_slow:
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = t_s
        return t_s - self._since_s >= cfg.settle_time_s - TIME_EPSILON_S

    def _is_slow(self, speed_m_s: float, rate_rad_s: float) -> bool:
        return abs(speed_m_s) <= self._cfg.settle_speed_m_s and abs(rate_rad_s) <= self._cfg.settle_rate_rad_s


# Wheels stop within half a second: a robot that is not at rest after this long creeps, or its sensors say so.
SETTLE_LIMIT_S = 10.0


class SettleAndMeasure:
    """From the end of a leg to the request for a measurement, after standing for ``measuring_time_s``."""

    def __init__(self, control: ControlConfig, measuring_time_s: float) -> None:
        self._stillness = StandstillDetector(control)
        self._measuring_time_s = measuring_time_s
        self._rest_by_s: float | None = None
        self._measure_at_s = 0.0
        self._arrived_at: PointId | None = None
        self._is_anew = False
        self.request = 0
        self.is_asked = False

    def interrupt(self) -> None:
        """The robot moves, or may have moved: the stop begins anew."""
        self.is_asked = self._is_anew = False
        self._stillness.reset()
        self._rest_by_s = None

    def is_quiet(self, motion: StateEstimate) -> bool:
        """Take the speeds of a frame; whether the robot has been at rest for the settling time."""
        return self._stillness.is_rest(motion.t_s, motion.dt_s, motion.speed_m_s, motion.rate_rad_s)

    def has_settled(self, motion: StateEstimate) -> bool:
        """One frame of coming to rest; whether that is over, and the measuring time begins."""
        if self._rest_by_s is None:
            self._rest_by_s = motion.t_s + SETTLE_LIMIT_S
        if not self.is_quiet(motion):
            return False
        self._begin(motion.t_s)
        return True

    def _begin(self, t_s: float) -> None:
        self._measure_at_s = t_s + self._measuring_time_s - TIME_EPSILON_S
        self._rest_by_s = t_s + SETTLE_LIMIT_S

    def is_restless(self, t_s: float) -> bool:
        """Whether coming to rest, or standing still for a measurement, takes far longer than it should."""
        return self._rest_by_s is not None and t_s > self._rest_by_s

    def arrival_at(self, point: PointId | None) -> PointId | None:
        """The point, where the robot has come to rest there for the first time."""
        if point is None or point == self._arrived_at:
            return None
        self._arrived_at = point
        return point

    def repeat(self) -> None:
        """The measurement failed: it is asked for once more, after another measuring time."""
        self.is_asked, self._is_anew = False, True

    def is_due(self, motion: StateEstimate) -> bool:
        """Take a frame of the measuring time; whether to ask for the measurement now. True once at each stop.

        Motion spoils the measurement, also one in progress: the time begins again, and what was asked for is dropped.
        """
        t_s = motion.t_s
        if self._is_anew:
            self._is_anew = False
            self._begin(t_s)
        if not self.is_quiet(motion):
            if self.is_asked:
                self.is_asked = False
                self._begin(t_s)
            self._measure_at_s = t_s + self._measuring_time_s - TIME_EPSILON_S
        if self.is_asked or t_s < self._measure_at_s:
            return False
        self._rest_by_s = None
        self.is_asked = True
        self.request += 1
        return True


STILL = Twist(0.0, 0.0)


class ReturnToBase:
    """Drives a route whose last stop is base; ``journey`` is exhausted once the robot stands there."""

    def __init__(self, journey: RouteFollower, tracker: LegTracker) -> None:
        self.journey, self._tracker = journey, tracker
        self._is_docking = False

    @property
    def is_at_base(self) -> bool:
        """Whether the robot stands at base, turned as it should be."""
        return self.journey.current is None

    def interrupt(self) -> None:
        """The robot stopped on the way: the leg begins anew."""
        self._is_docking = False
        self.journey.interrupt()

    def step(self, motion: StateEstimate, is_quiet: bool) -> Twist:
        """One frame of the way home; ``is_quiet``: the robot has been at rest for the settling time."""
        stop = self.journey.current
        if stop is None:
            return STILL
        if self._is_docking:
            return self._dock(motion, stop, is_quiet)
        twist = self.journey.follow(motion, stop)
        if self._tracker.phase is not LegPhase.DONE:
            return twist
        if stop.kind is not StopKind.BASE:
            self.journey.advance()
            return STILL
        self._is_docking = True
        if stop.heading_rad is not None:
            self._tracker.begin_turn(difference(stop.heading_rad, motion.deck.heading_rad))
        return STILL

    def _dock(self, motion: StateEstimate, stop: Stop, is_quiet: bool) -> Twist:
        if stop.heading_rad is not None and self._tracker.phase is LegPhase.TURN:
            remaining = difference(stop.heading_rad, motion.deck.heading_rad + motion.lead_rad)
            return self._tracker.step_turn(remaining, motion.dt_s, motion.steered.omega_rad_s)
        if is_quiet:
            self.journey.advance()
        return STILL


class MissionCommand(msgspec.Struct, frozen=True):
    """What the mission wants of the present frame.

    Attributes:
        twist: the velocity wanted until the next frame.
        at_rest: the robot has come to rest in this frame.
        arrived: the measurement point at which it did so for the first time; corrections are no arrivals.
        measure: have the laser system measure now (of a point, or after a back-off to find itself again).
    """

    twist: Twist
    at_rest: bool = False
    arrived: PointId | None = None
    measure: bool = False


HOLD_POSITION = MissionCommand(STILL)
