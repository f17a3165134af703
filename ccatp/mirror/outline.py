"""Pure. A rectilinear outline, mirror-symmetric about x = 0, and the few of its edges that count near a place."""

from collections.abc import Sequence
from math import hypot, inf, sqrt

Span = tuple[float, float, float]

_ROUNDING_M = 1e-9
_BOX_M = 0.25  # half the side of the square for which edges are picked at a time


class Outline:
    """Upright and level edges of the right half of an outline, deck plane, m.

    Args:
        upright: (x, low y, high y) of edges and of the slabs that they bound on the right.
        level: (y, low x, high x).
    """

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

        A distance changes by at most the way travelled: what lies further from the centre than the nearest edge by
        more than twice the radius is nearest to no point of the disc. An upright edge tells inside from beyond, too,
        wherever its slab reaches into the disc.
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
    """Signed distances of places that stay near each other for a while: only the edges around them are looked at.

    Args:
        outline: the whole outline.
    """

    __slots__ = ("_outline", "_part", "_x_m", "_y_m")

    def __init__(self, outline: Outline) -> None:
        self._outline = self._part = outline
        self._x_m = self._y_m = inf

    def signed_distance_m(self, x: float, y: float) -> float:
        """As ``Outline.signed_distance_m``, the same to the last bit."""
        if not (-_BOX_M < x - self._x_m < _BOX_M and -_BOX_M < y - self._y_m < _BOX_M):
            self._x_m, self._y_m = x, y
            self._part = self._outline.part(x, y, 1.5 * _BOX_M)  # the square's corners, and some
        return self._part.signed_distance_m(x, y)


def _outside(value: float, low: float, high: float) -> float:
    """How far a value lies outside an interval."""
    return max(low - value, value - high, 0.0)
