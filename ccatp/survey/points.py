"""What a survey has done for its points: measured, failed, to be measured next. One frozen value."""

from collections.abc import Collection, Mapping, Sequence

import msgspec
from msgspec.structs import replace

from ccatp.core import PointId


class Failure(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """Why a point is not measured. ``is_tried``: its measurement failed; else there is no time for it."""

    why: str
    is_tried: bool = True
    had_second_try: bool = False  # it is not tried again


class PointLog(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """Points measured, in order; failed, in the order of their first failure; and due.

    A point is in one of ``done`` and ``failed`` at most. ``due``: measure these next, in this order, instead of the
    points of the planned route.
    """

    done: tuple[PointId, ...] = ()
    failed: Mapping[PointId, Failure] = msgspec.field(default_factory=dict)
    due: tuple[PointId, ...] = ()

    @property
    def skipped(self) -> tuple[PointId, ...]:
        """Points whose measurement failed."""
        return tuple(point for point, failure in self.failed.items() if failure.is_tried)

    @property
    def causes(self) -> dict[PointId, str]:
        """Why each failed point is not measured."""
        return {point: failure.why for point, failure in self.failed.items()}

    def measure(self, point: PointId) -> "PointLog":
        """The point is measured."""
        if point in self.done:
            return self
        failed = {other: failure for other, failure in self.failed.items() if other != point}
        return PointLog((*self.done, point), failed, self._without((point,)))

    def fail(self, point: PointId, why: str) -> "PointLog":
        """A measurement of the point failed; one that is measured remains so."""
        if point in self.done:
            return self
        before = self.failed.get(point)
        failure = Failure(why, had_second_try=before is not None and before.had_second_try)
        return replace(self, failed={**self.failed, point: failure}, due=self._without((point,)))

    def give_up(self, points: Sequence[PointId], why: str, due: Sequence[PointId]) -> "PointLog":
        """Leave out ``points``, also from the second round, and measure those of ``due`` next."""
        lost = {
            point: Failure(why, is_tried=point in self.failed and self.failed[point].is_tried, had_second_try=True)
            for point in points
        }
        return replace(self, failed={**self.failed, **lost}, due=tuple(due))

    def begin_second_round(self) -> "PointLog":
        """Failed points that were not tried again yet are due; the last first, because the robot is nearest to it."""
        due = tuple(point for point, failure in self.failed.items() if not failure.had_second_try)[::-1]
        return replace(
            self, failed={point: replace(f, had_second_try=True) for point, f in self.failed.items()}, due=due
        )

    def take_over(self, done: Sequence[PointId], skipped: Collection[PointId]) -> "PointLog":
        """The same with what the database says, which is newer: points measured, and those whose measurement failed."""
        failed = {point: replace(f, is_tried=point in skipped) for point, f in self.failed.items() if point not in done}
        new = {point: Failure("not measured") for point in skipped if point not in failed and point not in done}
        return PointLog(tuple(done), failed | new, self._without((*new, *done)))

    def _without(self, points: Collection[PointId]) -> tuple[PointId, ...]:
        return tuple(point for point in self.due if point not in points)
