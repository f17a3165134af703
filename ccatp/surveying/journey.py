"""Pure. A series of stops and the leg being driven: the path planner of thesis 3.2 as the mission uses it."""

from collections.abc import Callable, Sequence
from math import hypot
from typing import NamedTuple

from ccatp.control.tracker import DONE, LegTracker
from ccatp.mirror.mirror import Mirror
from ccatp.samples import DeckPose, PanelId, PanelPose, PointId, Predicted, Stop, Twist
from ccatp.surveying.correction import Aim


class Motion(NamedTuple):
    """What the localizer says about the present frame.

    ``creep`` is the drift (dx, dy) per metre of travel in the plane of ``pose``. ``ahead`` is where the robot will be,
    in the same plane, when the twist decided now takes effect; ``None`` where that is at once. Whether it has arrived
    and stands still is judged by ``pose``; it is steered by ``ahead``. ``sigma_of`` says how well the position is
    known, in its worst direction, m.
    """

    t_s: float
    dt_s: float
    pose: PanelPose
    deck_of: Callable[[PanelPose], DeckPose]  # hardly ever asked for, and not cheap
    speed_m_s: float
    rate_rad_s: float
    creep: tuple[float, float] = (0.0, 0.0)
    ahead: Predicted | None = None
    sigma_of: Callable[[], float] = float  # hardly ever asked for either

    @property
    def steered(self) -> Predicted:
        """The state that the next twist will meet."""
        if self.ahead is not None:
            return self.ahead
        pose = self.pose
        return Predicted((pose.x_m, pose.y_m, pose.heading_rad), self.speed_m_s, self.rate_rad_s)

    @property
    def lead_rad(self) -> float:
        """How far the robot will have turned until then."""
        return 0.0 if self.ahead is None else self.ahead.pose[2] - self.pose.heading_rad

    @property
    def deck(self) -> DeckPose:
        """The pose in the deck frame."""
        return self.deck_of(self.pose)

    def with_only(self, *, ahead: bool, creep: bool) -> "Motion":
        """The same without what steering is not to use: the prediction, the drift."""
        return Motion(
            self.t_s,
            self.dt_s,
            self.pose,
            self.deck_of,
            self.speed_m_s,
            self.rate_rad_s,
            self.creep if creep else (0.0, 0.0),
            self.ahead if ahead else None,
            self.sigma_of,
        )


class Journey:
    """Keeps the current stop until all are exhausted, and drives the leg to it.

    Args:
        mirror: gives the stops in the frame of the panel on which the robot is.
        tracker: the leg tracker.
        timeout_factor: a motion that takes longer than this times its bang-bang time plus 5 s is overdue.
        stops: the stops, in order.

    Attributes:
        current: the stop being tracked; ``None`` when all are exhausted.
        index: its place among them.
    """

    def __init__(self, mirror: Mirror, tracker: LegTracker, timeout_factor: float, stops: Sequence[Stop]) -> None:
        """Stand before the first leg."""
        self._mirror, self._tracker, self._timeout_factor = mirror, tracker, timeout_factor
        self.stops = tuple(stops)
        self.index = 0
        self.current: Stop | None = self.stops[0] if self.stops else None
        self._is_begun = False
        self._deadline_s = 0.0
        self._target: tuple[PanelId, Stop, tuple[float, float]] | None = None
        self._aim: tuple[PanelId, Aim] | None = None

    @property
    def next_point(self) -> PointId | None:
        """The point to be measured next, at the current stop or a later one."""
        return next((stop.point for stop in self.stops[self.index :] if stop.point is not None), None)

    def advance(self) -> None:
        """The current stop is done with."""
        self.index += 1
        self.current = self.stops[self.index] if self.index < len(self.stops) else None
        self._is_begun, self._aim = False, None

    def interrupt(self) -> None:
        """The robot stopped on the way: the leg begins anew, from wherever it is then."""
        self._is_begun, self._aim = False, None

    def correct(self, panel: PanelId, aim: Aim) -> None:
        """The leg to the current stop is a correction, as long as the robot stays on the panel."""
        self._is_begun, self._aim = False, (panel, aim)

    def follow(self, motion: Motion, stop: Stop) -> Twist:
        """One frame of the leg to ``stop``: the twist until the next frame."""
        state, panel = motion.steered, motion.pose.panel
        target, reverse = self.target_in(panel, stop), stop.reverse
        if self._aim is not None and self._aim[0] == panel:
            x, y, reverse, _ = self._aim[1]
            target = x, y
        if not self._is_begun:
            self._is_begun = True
            self._tracker.begin(state.pose, target, reverse, motion.creep)
            self._set_deadline(motion.t_s)
        tracker = self._tracker
        before = tracker.phase
        twist = tracker.step(state.pose, target, motion.dt_s, state, motion.creep)
        if tracker.phase is not before and tracker.phase is not DONE:
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
        x, y = self.target_in(pose.panel, stop)
        return hypot(x - pose.x_m, y - pose.y_m)

    def _set_deadline(self, t_s: float) -> None:
        self._deadline_s = t_s + 5.0 + self._timeout_factor * self._tracker.planned_s

    def target_in(self, panel: PanelId, stop: Stop) -> tuple[float, float]:
        """The stop in the frame of a panel, (x, y), m."""
        cached = self._target
        if cached is not None and cached[0] == panel and cached[1] is stop:
            return cached[2]
        x, y, _ = self._mirror.panels[panel].from_deck(self._mirror.surface_point(stop.x_m, stop.y_m))
        self._target = (panel, stop, (x, y))
        return x, y
