"""Pure. The way home: stops to base, the turn to its heading, standing still there."""

from ccatp.angles import difference
from ccatp.control.tracker import LegTracker, Phase
from ccatp.samples import Stop, StopKind, Twist
from ccatp.surveying.journey import Journey, Motion

STILL = Twist(0.0, 0.0)


class Homing:
    """Drives a journey whose last stop is base.

    Args:
        journey: the stops.
        tracker: the leg tracker of that journey, borrowed for the last turn.

    Attributes:
        journey: as given; exhausted once the robot stands at base.
    """

    def __init__(self, journey: Journey, tracker: LegTracker) -> None:
        """Stand before the first leg."""
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

    def step(self, motion: Motion, is_quiet: bool) -> Twist:
        """One frame of the way home.

        Args:
            motion: the present frame.
            is_quiet: the robot has been at rest for the settling time.
        """
        stop = self.journey.current
        if stop is None:
            return STILL
        if self._is_docking:
            return self._dock(motion, stop, is_quiet)
        twist = self.journey.follow(motion, stop)
        if self._tracker.phase is not Phase.DONE:
            return twist
        if stop.kind is not StopKind.BASE:
            self.journey.advance()
            return STILL
        self._is_docking = True
        if stop.heading_rad is not None:
            self._tracker.begin_turn(difference(stop.heading_rad, motion.deck.heading_rad))
        return STILL

    def _dock(self, motion: Motion, stop: Stop, is_quiet: bool) -> Twist:
        if stop.heading_rad is not None and self._tracker.phase is Phase.TURN:
            remaining = difference(stop.heading_rad, motion.deck.heading_rad + motion.lead_rad)
            return self._tracker.step_turn(remaining, motion.dt_s, motion.steered.omega_rad_s)
        if is_quiet:
            self.journey.advance()
        return STILL
