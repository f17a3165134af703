"""Pure. Leaving a point that a fix showed to be missed: by a correction, and then by the route, where that is safe."""

from ccatp.samples import Stop
from ccatp.surveying.correction import Corrector
from ccatp.surveying.journey import Journey, Motion


class MissedPoint:
    """Keeps whether the current stop was missed, and at which one the last correction was made.

    Args:
        corrector: says where a correction leads.

    Attributes:
        corrections: correction moves begun.
    """

    def __init__(self, corrector: Corrector) -> None:
        """Nothing missed."""
        self._corrector = corrector
        self._is_missed = False
        self._corrected: Stop | None = None  # until the next leg
        self.corrections = 0

    def miss(self) -> None:
        """The fix shows the robot too far from its point."""
        self._is_missed = True

    def interrupt(self) -> None:
        """The robot stopped, or goes on: wherever it is, it is not where it missed the point."""
        self._is_missed = False

    def follows_route(self, motion: Motion, stop: Stop, journey: Journey) -> bool:
        """Whether the leg to ``stop`` may be driven as planned, or as the correction that begins here.

        Args:
            motion: the present frame.
            stop: the current one.
            journey: its journey.
        """
        if self._is_missed:
            self._is_missed = False
            return self._correct(motion, stop, journey)
        if self._corrected is None or self._corrected is stop:
            return True
        self._corrected = None
        return self._corrector.can_go_on(motion.deck, stop)

    def _correct(self, motion: Motion, stop: Stop, journey: Journey) -> bool:
        panel = motion.pose.panel
        aim = self._corrector.aim(motion.pose, journey.target_in(panel, stop))
        if aim is None:
            return False
        journey.correct(panel, aim)
        self._corrected = stop
        self.corrections += 1
        return True
