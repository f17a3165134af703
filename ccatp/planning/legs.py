"""Pure. Straight legs against the rim, and the way around a stepped corner."""

from collections.abc import Iterable, Sequence
from enum import IntEnum
from math import atan2, cos, hypot, inf, sin

from ccatp.mirror.mirror import Mirror
from ccatp.planning.stance import Body, Place
from ccatp.samples import PanelId

_ROUNDING_M = 1e-9
# A sensor whose track meets a seam more steeply than 30 degrees is over it soon; the danger rules know how soon.
_STEEP = 0.5
# Further than this from a seam's border a track that should pass beside it does.
_BESIDE_M = 0.008
# A track across a seam at 60 degrees from its normal is within the gap for twice its width. More is avoided: with a
# little more slant, or a wide gap, the danger rules take it for the mirror's edge.
_LONGEST_CROSSING = 2.0


class Grazing(IntEnum):
    """How a leg lies to the seams that are oblique to it: the more, the worse."""

    NONE = 0
    BESIDE = 1  # a sensor passes so near that errors may carry it over the gap
    ALONG = 2  # a sensor runs along within the gap: an edge, as far as anybody can tell


_GRAZING_M = (0.0, 0.4, 4.0)  # what a way may be longer to be without


class LegRules:
    """Says which straight legs the robot may drive.

    Args:
        mirror: the mirror.
        body: the robot and its clearances.
    """

    def __init__(self, mirror: Mirror, body: Body) -> None:
        """Find the rim's re-entrant corners and the places from which the robot can drive around them."""
        self._rim, self._body = mirror.rim, body
        self._sensors: list[list[float]] = body.sensors_m.tolist()
        self._corners, self._nodes = _reentrant_corners(mirror, body)
        self._seams = _seam_lines(mirror)
        self._half_gap_m = 0.5 * mirror.gap_m
        self._explained_m = _LONGEST_CROSSING * mirror.gap_m
        self._beside_m = self._half_gap_m + _BESIDE_M

    def clearance_m(self, a: Place, b: Place) -> float:
        """Clearance of the leg from ``a`` to ``b``: exact, or a lower bound that suffices for every rule, m."""
        # The distance from the rim changes by at most the distance driven.
        at_least = 0.5 * (a.depth_m + b.depth_m - hypot(b.x_m - a.x_m, b.y_m - a.y_m))
        if at_least >= self._body.turning_depth_m:
            return at_least
        return self._rim.segment_clearance_m(a.x_m, a.y_m, b.x_m, b.y_m)

    def is_enough(self, clearance_m: float) -> bool:
        """Whether the robot's origin may pass the rim so near."""
        return clearance_m >= self._body.leg_clearance_m - _ROUNDING_M

    def is_clear(self, a: Place, b: Place) -> bool:
        """Whether the robot's origin keeps the clearance of a leg from ``a`` to ``b``."""
        return self.is_enough(self.clearance_m(a, b))

    def are_sensors_clear(self, a: Place, b: Place, course_rad: float, clearance_m: float) -> bool:
        """Whether the sensors of a robot that faces ``course_rad`` all the way keep their clearance between the ends.

        Where no re-entrant corner is near, the mirror is convex, and a sensor is nearest to the rim at an end of its
        straight track: the ends are the stances' affair.

        Args:
            a, b: ends of the leg.
            course_rad: what the robot faces.
            clearance_m: clearance of the leg itself, from ``clearance_m``.
        """
        body = self._body
        if clearance_m >= body.reach_m + body.turn_clearance_m:
            return True
        if self._corner_distance_m(a, b) >= body.reach_m + body.turn_clearance_m:
            return True
        c, s = cos(course_rad), sin(course_rad)
        return all(
            self._rim.segment_clearance_m(
                a.x_m + c * ox - s * oy, a.y_m + s * ox + c * oy, b.x_m + c * ox - s * oy, b.y_m + s * ox + c * oy
            )
            >= body.turn_clearance_m
            for ox, oy in self._sensors
        )

    def grazing(self, a: Place, b: Place, course_rad: float) -> Grazing:
        """Whether a sensor may run along a seam on the leg from ``a`` to ``b``, which looks like the mirror's edge.

        Args:
            a, b: ends of the leg.
            course_rad: what the robot faces.
        """
        dx, dy = b.x_m - a.x_m, b.y_m - a.y_m
        length = hypot(dx, dy)
        c, s = cos(course_rad), sin(course_rad)
        found = Grazing.NONE
        for start, way, lines, (p, q) in zip((a.x_m, a.y_m), (dx, dy), self._seams, ((c, -s), (s, c)), strict=True):
            if abs(way) >= _STEEP * length:
                continue
            for ox, oy in self._sensors:
                low = start + p * ox + q * oy
                high = low + way
                if low > high:
                    low, high = high, low
                for line in lines:
                    if low - self._beside_m < line < high + self._beside_m:
                        if self._runs_along(low, high, line, length):
                            return Grazing.ALONG
                        found = Grazing.BESIDE
        return found

    def _runs_along(self, low: float, high: float, line: float, length: float) -> bool:
        """Whether a track of ``length`` between two places across a seam lies in its gap for long."""
        overlap = min(high, line + self._half_gap_m) - max(low, line - self._half_gap_m)
        if overlap < 0.0:
            return False
        across = high - low
        within = length if across == 0.0 else overlap / across * length
        return within > self._explained_m

    def way_around(self, a: Place, b: Place) -> tuple[Place, ...]:
        """Best chain of places that leads from ``a`` around stepped corners to ``b``, ends left out.

        Dijkstra's algorithm on the visibility graph of the corners, inset by the clearance, and of the two elbows from
        which both ends lie along the panels' rows and columns: on such legs no sensor runs along a seam.

        Returns:
            The places between; none where the straight leg is good, and where there is no way.
        """
        if self._is_good(a, b):
            return ()
        places = [a, *self._nodes, *self._elbows(a, b), b]
        cost = {0: 0.0}
        before: dict[int, int] = {}
        open_places = set(range(len(places)))
        while open_places:
            k = min(open_places, key=lambda i: cost.get(i, inf))
            if k not in cost:
                return ()
            if k == len(places) - 1:
                break
            open_places.remove(k)
            for i in open_places:
                total = cost[k] + hypot(places[i].x_m - places[k].x_m, places[i].y_m - places[k].y_m)
                if total < cost.get(i, inf) and self.is_clear(places[k], places[i]):
                    total += _GRAZING_M[self._grazing_facing(places[k], places[i])]
                    if total < cost.get(i, inf):
                        cost[i], before[i] = total, k
        chain = []
        k = len(places) - 1
        while (k := before[k]) != 0:
            chain.append(places[k])
        return tuple(reversed(chain))

    def elbows(self, sources: Iterable[Place], targets: Sequence[Place]) -> list[Place]:
        """Elbows between all places of two groups between which the straight leg is not good."""
        return [elbow for a in sources for b in targets if not self._is_good(a, b) for elbow in self._elbows(a, b)]

    def _is_good(self, a: Place, b: Place) -> bool:
        return self.is_clear(a, b) and not self._grazing_facing(a, b)

    def _grazing_facing(self, a: Place, b: Place) -> Grazing:
        return self.grazing(a, b, atan2(b.y_m - a.y_m, b.x_m - a.x_m))

    def _elbows(self, a: Place, b: Place) -> list[Place]:
        """The corners of the rectangle over a and b at which the robot can turn."""
        places = []
        for x, y in ((a.x_m, b.y_m), (b.x_m, a.y_m)):
            depth = self._rim.signed_distance_m(x, y)
            if depth >= self._body.turning_depth_m:
                places.append(Place(x, y, depth))
        return places

    def _corner_distance_m(self, a: Place, b: Place) -> float:
        return min((_segment_distance(corner, a, b) for corner in self._corners), default=inf)


def _seam_lines(mirror: Mirror) -> tuple[list[float], list[float]]:
    """The deck x of the seams between columns, the deck y of those between rows."""
    xs, ys = set(), set()
    half_gap = 0.5 * mirror.gap_m
    for panel in mirror.panels.values():
        row, col = panel.id
        if PanelId(row, col + 1) in mirror.panels:
            xs.add(round(panel.x_m + panel.half_x_m + half_gap, 6))
        if PanelId(row + 1, col) in mirror.panels:
            ys.add(round(panel.y_m + panel.half_y_m + half_gap, 6))
    return sorted(xs), sorted(ys)


def _reentrant_corners(mirror: Mirror, body: Body) -> tuple[list[tuple[float, float]], list[Place]]:
    """Corners of the rim at which the mirror has 270 degrees, and for each the place inset by the clearance."""
    vertices = [(float(x), float(y)) for x, y in mirror.rim.vertices]
    corners, nodes = [], []
    for (x0, y0), (x1, y1), (x2, y2) in zip(
        vertices[-1:] + vertices[:-1], vertices, vertices[1:] + vertices[:1], strict=True
    ):
        if (x1 - x0) * (y2 - y1) - (y1 - y0) * (x2 - x1) >= 0.0:
            continue
        corners.append((x1, y1))
        # The bisector between coming from the last vertex and going on against the next points to the inside.
        before, after = atan2(y1 - y0, x1 - x0), atan2(y1 - y2, x1 - x2)
        inset = max(body.leg_clearance_m, body.turning_depth_m / 2**0.5) + _ROUNDING_M
        x, y = x1 + inset * (cos(before) + cos(after)), y1 + inset * (sin(before) + sin(after))
        depth = mirror.rim.signed_distance_m(x, y)
        if depth >= body.turning_depth_m:
            nodes.append(Place(x, y, depth))
    return corners, nodes


def _segment_distance(p: tuple[float, float], a: Place, b: Place) -> float:
    ux, uy = b.x_m - a.x_m, b.y_m - a.y_m
    wx, wy = p[0] - a.x_m, p[1] - a.y_m
    length2 = ux * ux + uy * uy
    t = 0.0 if length2 == 0.0 else min(max((wx * ux + wy * uy) / length2, 0.0), 1.0)
    return hypot(wx - t * ux, wy - t * uy)
