"""Pure. Points whose measurement failed: why, and each of them once more when the others are done."""

from collections.abc import Mapping, Sequence

from ccatp.samples import PointId

# Planned at a time: a way through so many points takes less than the robot's frames may wait.
CHUNK = 12


def by_reason(causes: Mapping[PointId, str]) -> dict[str, list[str]]:
    """Points, as people name them, by why they were left out."""
    named: dict[str, list[str]] = {}
    for point, why in causes.items():
        named.setdefault(why, []).append(f"{point.row}-{point.col}-{point.point}")
    return named


class Leftovers:
    """Keeps what is to be measured off the planned route.

    Attributes:
        causes: why a point was skipped.
        due: points to be measured in this order, away from the planned route.
    """

    def __init__(self) -> None:
        """Nothing failed."""
        self.causes: dict[PointId, str] = {}
        self.due: list[PointId] = []
        self._tried_again: set[PointId] = set()

    def failed(self, point: PointId, cause: str) -> None:
        """The measurement of a point failed."""
        self.causes[point] = cause
        self._is_over(point)

    def measured(self, point: PointId) -> None:
        """A point is measured, perhaps after it failed."""
        self.causes.pop(point, None)
        self._is_over(point)

    def _is_over(self, point: PointId) -> None:
        if point in self.due:
            self.due.remove(point)

    def begin_second_round(self) -> None:
        """What failed and was not tried again yet is due; last first, because the robot is nearer to that."""
        if not self.due:
            self.due = [point for point in reversed(self.causes) if point not in self._tried_again]
            self._tried_again.update(self.due)

    def thin_out(self, points: Sequence[PointId], wanted: Sequence[PointId], cause: str) -> None:
        """Of these points only the wanted ones are due; there is no time for the others."""
        self.due = list(wanted)
        dropped = set(points).difference(wanted)
        self.causes |= {point: cause for point in points if point in dropped}
        self._tried_again |= dropped

    @property
    def chunk(self) -> list[PointId]:
        """The points to be planned next."""
        return self.due[:CHUNK]
