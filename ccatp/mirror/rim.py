"""The rim: outline of the panels with the seams filled, as a signed distance in the deck plane, m.

The outline is rectilinear and symmetric about x = 0. Near a place, only a few of its edges matter.
"""

from collections.abc import Sequence
from itertools import pairwise
from math import hypot, inf, isfinite, sqrt

import numpy as np

from ccatp.core import FloatArray
from ccatp.mirror.layout import PanelGrid
from ccatp.mirror.surface import MirrorError

Span = tuple[float, float, float]

_ROUNDING_M = 1e-9
_BOX_M = 0.25  # half the side of the square for which edges are selected


class Outline:
    """Edges of the right half of an outline, deck plane, m: upright (x, low y, high y), level (y, low x, high x)."""

    __slots__ = ("_level", "_upright")

    def __init__(self, upright: Sequence[Span], level: Sequence[Span]) -> None:
        self._upright, self._level = tuple(upright), tuple(level)

    def signed_distance_m(self, x: float, y: float) -> float:
        """Distance to the outline: > 0 inside, < 0 beyond it, m. Exact; -inf for a NaN."""
        x = abs(x)  # the outline is symmetric: the nearest point lies on the point's own side
        best = inf
        inside = False
        for half, low, high in self._upright:
            dx = x - half
            d2 = dx * dx
            if y < low:
                d2 += (low - y) * (low - y)
            elif y <= high:
                if dx <= 0.0:
                    inside = True
            else:
                d2 += (y - high) * (y - high)
            if d2 < best:  # noqa: PLR1730 - a call costs as much as the rest of the loop
                best = d2
        for level, near, far in self._level:
            dy = y - level
            d2 = dy * dy
            if d2 < best:
                if not near <= x <= far:
                    dx = near - x if x < near else x - far
                    d2 += dx * dx
                if d2 < best:  # noqa: PLR1730 - as above
                    best = d2
        return sqrt(best) if inside else -sqrt(best)

    def part(self, x: float, y: float, radius_m: float) -> "Outline":
        """The edges that decide the signed distance of a point within ``radius_m`` of (x, y).

        A distance changes by at most the way travelled. So an edge that is further from the centre than the nearest one
        by more than twice the radius is nearest to no point of the disc. An upright edge is also kept if its slab
        reaches into the disc, because it separates inside from outside.
        """
        limit_m = abs(self.signed_distance_m(x, y)) + 2.0 * radius_m + _ROUNDING_M
        x = abs(x)
        upright = [
            (half, low, high)
            for half, low, high in self._upright
            if hypot(x - half, _outside(y, low, high)) <= limit_m or _outside(y, low, high) <= radius_m + _ROUNDING_M
        ]
        level = [(at, near, far) for at, near, far in self._level if hypot(_outside(x, near, far), y - at) <= limit_m]
        return Outline(upright, level)


class NearOutline:
    """Signed distances of places that follow each other closely, from the edges near them only."""

    __slots__ = ("_outline", "_part", "_x_m", "_y_m")

    def __init__(self, outline: Outline) -> None:
        self._outline = self._part = outline
        self._x_m = self._y_m = inf

    def signed_distance_m(self, x: float, y: float) -> float:
        """As ``Outline.signed_distance_m``, equal to the last bit."""
        if not (-_BOX_M < x - self._x_m < _BOX_M and -_BOX_M < y - self._y_m < _BOX_M):
            self._x_m, self._y_m = x, y
            self._part = self._outline.part(x, y, 1.5 * _BOX_M)  # a disc that contains the square
        return self._part.signed_distance_m(x, y)


def _outside(value: float, low: float, high: float) -> float:
    return max(low - value, value - high, 0.0)


Box = tuple[float, float, float]
Point = tuple[float, float]

_CLEARANCE_TOLERANCE_M = 1e-9


class Rim(Outline):
    """Outline of a whole mirror along the panels' outer edges, with stepped corners; distances > 0 on the mirror.

    ``vertices``: corners counter-clockwise, shape (n, 2), deck plane, m.
    """

    __slots__ = ("_boxes", "_edges", "vertices")

    def __init__(self, slabs: Sequence[Span]) -> None:
        """Slabs (half width, low y, high y) from low to high y, without gaps."""
        widths = [0.0, *(half for half, _, _ in slabs), 0.0]
        levels = [slabs[0][1], *(high for _, _, high in slabs)]
        steps = zip(levels, pairwise(widths), strict=True)
        super().__init__(slabs, [(y, min(a, b), max(a, b)) for y, (a, b) in steps])
        self._boxes = _maximal_boxes(slabs)
        right = [(half, y) for half, low, high in slabs for y in (low, high)]
        corners = right + [(-x, y) for x, y in reversed(right)]
        self.vertices: FloatArray = np.array(corners)
        self._edges = tuple(zip(corners, [*corners[1:], corners[0]], strict=True))

    def signed_distances_m(self, xs: FloatArray, ys: FloatArray) -> FloatArray:
        """Signed distances of many points; ``xs`` and ``ys`` broadcast against each other, m."""
        x, y = np.broadcast_arrays(np.abs(np.asarray(xs, dtype=np.float64)), np.asarray(ys, dtype=np.float64))
        best = np.full(x.shape, inf)
        inside = np.zeros(x.shape, dtype=np.bool_)
        for half, low, high in self._upright:
            dy = np.maximum(np.maximum(low - y, y - high), 0.0)
            np.minimum(best, np.hypot(x - half, dy), out=best)
            inside |= (dy == 0.0) & (x <= half)
        for level, near, far in self._level:
            dx = np.maximum(np.maximum(near - x, x - far), 0.0)
            np.minimum(best, np.hypot(dx, y - level), out=best)
        return np.where(inside, best, -best)

    def segment_clearance_m(self, x0: float, y0: float, x1: float, y1: float) -> float:
        """Least signed distance along the straight segment from (x0, y0) to (x1, y1), m, to 1 nm.

        On the mirror this is the distance between segment and outline. If the segment leaves the mirror, it is minus
        the largest distance beyond the rim. Raises ``MirrorError`` for a coordinate that is not finite.
        """
        if not isfinite(x0 + y0 + x1 + y1):
            raise MirrorError(f"segment from ({x0}, {y0}) to ({x1}, {y1}) is not finite")
        beyond = self._largest_excess_m(x0, y0, x1, y1)
        if beyond > _CLEARANCE_TOLERANCE_M:
            return -beyond
        a, b = (x0, y0), (x1, y1)
        left, right = (x0, x1) if x0 < x1 else (x1, x0)
        low, high = (y0, y1) if y0 < y1 else (y1, y0)
        least = limit = inf
        # Two segments that do not cross are nearest to each other at one of their ends; the end of an edge is the
        # beginning of the next one. Edges are upright or level, so most are told to be too far by one coordinate.
        for c, d in self._edges:
            if c[0] == d[0]:
                if c[0] - right > limit or left - c[0] > limit:
                    continue
            elif c[1] - high > limit or low - c[1] > limit:
                continue
            least = min(least, to_segment_m(a, c, d), to_segment_m(b, c, d), to_segment_m(c, a, b))
            limit = least + _CLEARANCE_TOLERANCE_M  # far above the rounding of a distance
        return least

    def _largest_excess_m(self, x0: float, y0: float, x1: float, y1: float) -> float:
        """Largest distance of a point of the segment from the mirror, 0 on it, by branch and bound.

        The distance from a box is convex along the segment. So between two points the distance from the union is at
        most the minimum over the boxes of the larger distance of the two points.
        """
        start, end = self._box_distances(x0, y0), self._box_distances(x1, y1)
        best = max(min(start), min(end))
        pending = [(x0, y0, start, x1, y1, end)]
        while pending:
            ax, ay, a, bx, by, b = pending.pop()
            bound = min(max(p, q) for p, q in zip(a, b, strict=True))
            if bound <= best + _CLEARANCE_TOLERANCE_M:
                continue
            mx, my = 0.5 * (ax + bx), 0.5 * (ay + by)
            middle = self._box_distances(mx, my)
            best = max(best, min(middle))
            pending.append((ax, ay, a, mx, my, middle))
            pending.append((mx, my, middle, bx, by, b))
        return best

    def _box_distances(self, x: float, y: float) -> list[float]:
        x = abs(x)
        return [hypot(max(x - half, 0.0), max(low - y, y - high, 0.0)) for half, low, high in self._boxes]


def build_rim(grid: PanelGrid) -> Rim:
    """Rim of a panel grid; a step between two rows lies on the wider row's own edge."""
    spans = [grid.row_span(row) for row in range(1, grid.rows + 1)]
    slabs: list[Span] = []
    low = spans[0][1]
    for (half, _, high), (half_next, low_next, _) in pairwise(spans):
        if half == half_next:
            continue
        step = high if half > half_next else low_next
        slabs.append((half, low, step))
        low = step
    return Rim([*slabs, (spans[-1][0], low, spans[-1][2])])


def _maximal_boxes(slabs: Sequence[Span]) -> tuple[Box, ...]:
    """Largest boxes (half width, low, high) inside the outline; their union is the mirror."""
    boxes: dict[Box, None] = {}  # an ordered set, because different slabs may give equal boxes
    for k, (half, _, _) in enumerate(slabs):
        first = last = k
        while first > 0 and slabs[first - 1][0] >= half:
            first -= 1
        while last + 1 < len(slabs) and slabs[last + 1][0] >= half:
            last += 1
        boxes[half, slabs[first][1], slabs[last][2]] = None
    return tuple(boxes)


def to_segment_m(p: Point, a: Point, b: Point) -> float:
    """Distance of a point from the segment ab."""
    ux, uy = b[0] - a[0], b[1] - a[1]
    wx, wy = p[0] - a[0], p[1] - a[1]
    length2 = ux * ux + uy * uy
    t = 0.0 if length2 == 0.0 else min(max((wx * ux + wy * uy) / length2, 0.0), 1.0)
    return hypot(wx - t * ux, wy - t * uy)
