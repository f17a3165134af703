"""Pure. A series of stops and the leg being driven: the path planner of thesis 3.2 as the mission uses it."""

from collections.abc import Callable, Sequence
from math import hypot
from typing import NamedTuple

from ccatp.control.tracker import LegTracker, Phase
from ccatp.mirror.mirror import Mirror
from ccatp.samples import DeckPose, PanelId, PanelPose, Stop, Twist

STILL = Twist(0.0, 0.0)


class Motion(NamedTuple):
    """What the localizer says about the present frame."""

    t_s: float
    dt_s: float
    pose: PanelPose
    deck_of: Callable[[PanelPose], DeckPose]  # hardly ever asked for, and not cheap
    speed_m_s: float
    rate_rad_s: float

    @property
    def deck(self) -> DeckPose:
        """The pose in the deck frame."""
        return self.deck_of(self.pose)


class Journey:
    """Keeps the current and the next stop until all are exhausted, and drives the leg to the current one.

    Args:
        mirror: gives the stops in the frame of the panel on which the robot is.
        tracker: the leg tracker.
        timeout_factor: a motion that takes longer than this times its bang-bang time plus 5 s is overdue.
        stops: the stops, in order.
    """

    def __init__(self, mirror: Mirror, tracker: LegTracker, timeout_factor: float, stops: Sequence[Stop]) -> None:
        """Stand before the first leg."""
        self._mirror, self._tracker, self._timeout_factor = mirror, tracker, timeout_factor
        self.stops = tuple(stops)
        self.index = 0
        self._is_begun = False
        self._deadline_s = 0.0
        self._target: tuple[PanelId, Stop, tuple[float, float]] | None = None

    @property
    def current(self) -> Stop | None:
        """The stop being tracked; ``None`` when all are exhausted."""
        return self.stops[self.index] if self.index < len(self.stops) else None

    @property
    def upcoming(self) -> Stop | None:
        """The stop after the current one, or ``None``."""
        return self.stops[self.index + 1] if self.index + 1 < len(self.stops) else None

    def advance(self) -> None:
        """The current stop is done with."""
        self.index += 1
        self._is_begun = False

    def interrupt(self) -> None:
        """The robot stopped on the way: the leg begins anew, from wherever it is then."""
        self._is_begun = False

    def follow(self, motion: Motion, stop: Stop) -> Twist:
        """One frame of the leg to ``stop``: the twist until the next frame."""
        pose = (motion.pose.x_m, motion.pose.y_m, motion.pose.heading_rad)
        target = self._target_in(motion.pose.panel, stop)
        if not self._is_begun:
            self._is_begun = True
            self._tracker.begin(pose, target, stop.reverse)
            self._set_deadline(motion.t_s)
        before = self._tracker.phase
        twist = self._tracker.step(pose, target, motion.dt_s)
        if self._tracker.phase is not before and self._tracker.phase is not Phase.DONE:
            self._set_deadline(motion.t_s)
        return twist

    def is_overdue(self, t_s: float) -> bool:
        """Whether the leg begun takes far longer than it should."""
        return self._is_begun and t_s > self._deadline_s

    def distance_m(self, pose: PanelPose) -> float:
        """Distance to the current stop, m (0 where there is none)."""
        stop = self.current
        if stop is None:
            return 0.0
        x, y = self._target_in(pose.panel, stop)
        return hypot(x - pose.x_m, y - pose.y_m)

    def _set_deadline(self, t_s: float) -> None:
        self._deadline_s = t_s + 5.0 + self._timeout_factor * self._tracker.planned_s

    def _target_in(self, panel: PanelId, stop: Stop) -> tuple[float, float]:
        cached = self._target
        if cached is not None and cached[0] == panel and cached[1] is stop:
            return cached[2]
        x, y, _ = self._mirror.panels[panel].from_deck(self._mirror.surface_point(stop.x_m, stop.y_m))
        self._target = (panel, stop, (x, y))
        return x, y
