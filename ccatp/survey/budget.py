"""The time budget of a survey: compares the remaining work with the remaining time."""

from collections.abc import Callable, Sequence
from math import hypot, pi
from typing import NamedTuple

from ccatp.config.models import LimitsConfig
from ccatp.core import DeckPose, PointId
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.search import leg_time, turn_time

# Points of a panel to measure when there is no time for all: corners and centre, or three that determine a plane.
LEVELS = (frozenset((1, 3, 5, 7, 9)), frozenset((1, 3, 8)))
_TURN_RAD = 0.5 * pi  # assumed before every leg
_DOCKING_S = 15.0  # escape from the rim, turns on the way, the turn at base
_FIRST_S = 60.0  # planned time after which the ratio of real to planned time is known
_LARGEST_PACE = 5.0


def home_time_s(mirror: Mirror, limits: LimitsConfig, x_m: float, y_m: float) -> float:
    """Upper estimate of the time from a place on the deck to base, s, without planning a route."""
    length_m = mirror.home_way_m(x_m, y_m)
    stops = 1 + int(length_m)
    return leg_time(length_m, limits) + stops * turn_time(_TURN_RAD, limits) + _DOCKING_S


class BudgetProgress(NamedTuple):
    """Start (robot time), planned times of the work done and of the next point, time in earlier processes, s.

    ``is_review_due``: a point was left since the last review.
    """

    begun_s: float | None = None
    planned_s: float = 0.0
    next_s: float = 0.0
    before_s: float = 0.0
    is_review_due: bool = False


class TimeBudget:
    """Compares the remaining work with the rest of ``budget_s``, from the first frame until home or complete."""

    def __init__(self, budget_s: float, mirror: Mirror, limits: LimitsConfig, measuring_time_s: float) -> None:
        self.budget_s = budget_s
        self._limits, self._measuring_s = limits, measuring_time_s
        self._place_of: Callable[[PointId], tuple[float, float]] = mirror.point_on_deck
        self._mirror = mirror

    def _home_s(self, point: PointId) -> float:
        return home_time_s(self._mirror, self._limits, *self._place_of(point))

    def tour_s(self, x_m: float, y_m: float, points: Sequence[PointId]) -> float:
        """An estimate of the time to drive to the points in their order and to measure them."""
        total_s = 0.0
        turn_s = turn_time(_TURN_RAD, self._limits)
        for point in points:
            px, py = self._place_of(point)
            total_s += leg_time(hypot(px - x_m, py - y_m), self._limits) + turn_s + self._measuring_s
            x_m, y_m = px, py
        return total_s

    def progress(self, before: BudgetProgress, pose: DeckPose, left: Sequence[PointId]) -> BudgetProgress:
        """The progress after a point; ``left``: remaining points."""
        next_s = self.tour_s(pose.x_m, pose.y_m, left[:1])
        return before._replace(planned_s=before.planned_s + before.next_s, next_s=next_s)

    def review(
        self, progress: BudgetProgress, t_s: float, pose: DeckPose, left: Sequence[PointId]
    ) -> Sequence[PointId] | None:
        """The remaining points that there is time for: ``left`` itself if all, None to go home now."""
        elapsed_s = progress.before_s + t_s - (progress.begun_s if progress.begun_s is not None else t_s)
        late = elapsed_s / progress.planned_s if progress.planned_s > _FIRST_S else 1.0
        pace = min(max(late, 1.0), _LARGEST_PACE)
        left_s = self.budget_s - elapsed_s
        x, y = pose.x_m, pose.y_m
        if not left or pace * self.tour_s(x, y, left) <= left_s:
            return left
        if pace * (progress.next_s + self._home_s(left[0])) > left_s:
            return None
        thinned: Sequence[PointId] = left
        for level in LEVELS:
            thinned = [point for point in left if point.point in level]
            if not thinned:
                return None
            if pace * (self.tour_s(x, y, thinned) + self._home_s(thinned[-1])) <= left_s:
                break
        return left if len(thinned) == len(left) else thinned
