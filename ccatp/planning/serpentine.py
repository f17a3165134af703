"""Pure. The points of all panels as one serpentine over whole lines, upright or level, from the best of its starts."""

from collections.abc import Callable, Iterator, Sequence
from itertools import chain

from ccatp.config.models import LimitsConfig
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.panels import POINTS_PER_ROW
from ccatp.planning.bound import path_time
from ccatp.samples import PointId, Stop, StopKind

# Line and place within the line, both counted over the whole grid of panels.
_Split = Callable[[PointId], tuple[int, int]]


def fastest_serpentine(mirror: Mirror, points: Sequence[PointId], limits: LimitsConfig) -> list[PointId]:
    """The points line by line, every second line backwards: the fastest from base of all eight such orders.

    On a line nothing has to be turned for, so that quarter turns remain at the ends of the lines only. Compared are
    the least times of the straight legs from point to point, turns included; of equals the first of ``serpentines``.

    Args:
        mirror: the mirror; its base pose is the start.
        points: what to measure, in any order.
        limits: motion limits by which turns are weighed against ways.

    Returns:
        The same points.
    """
    return min(serpentines(points), key=lambda order: _straight_time(mirror, order, limits))


def serpentines(points: Sequence[PointId]) -> Iterator[list[PointId]]:
    """All eight serpentines: along the rows, along the columns; each from any of its corners.

    Args:
        points: in any order.
    """
    for split in (_on_row, _on_column):
        lines = _lines(points, split)
        for stacked in (lines, lines[::-1]):
            for odd in (0, 1):
                turned = (line[::-1] if k % 2 != odd else line for k, line in enumerate(stacked))
                yield list(chain.from_iterable(turned))


def _lines(points: Sequence[PointId], split: _Split) -> list[list[PointId]]:
    lines: dict[int, list[PointId]] = {}
    for point in sorted(points, key=split):
        lines.setdefault(split(point)[0], []).append(point)
    return list(lines.values())


def _on_row(point: PointId) -> tuple[int, int]:
    upward, along = divmod(point.point - 1, POINTS_PER_ROW)
    return point.row * POINTS_PER_ROW + upward, point.col * POINTS_PER_ROW + along


def _on_column(point: PointId) -> tuple[int, int]:
    line, place = _on_row(point)
    return place, line


def _straight_time(mirror: Mirror, order: Sequence[PointId], limits: LimitsConfig) -> float:
    stops = [Stop(x, y, StopKind.MEASURE, point) for point in order for x, y in (mirror.point_on_deck(point),)]
    return path_time(stops, mirror.base_pose, limits, mirror, 0.0)
