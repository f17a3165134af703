"""Pure. The mirror's surface around the robot, from one exact evaluation carried on by Taylor's theorem."""

from math import sqrt
from typing import NamedTuple

from ccatp.mirror.mirror import Mirror

# Third derivatives of these mirrors stay below 3e-3 1/m^2: within this distance a slope is off by less than 1e-7.
_REACH_M = 5e-3
# A tangent plane flatter than this has no downhill direction worth the name.
_LEVEL = 1e-3


class Slope(NamedTuple):
    """First and second derivatives of the surface at a deck point, and the downhill unit tangent.

    Attributes:
        fx, fy: slopes.
        fxx, fxy, fyy: second derivatives, 1/m.
        gx, gy: deck components of the downhill direction in the tangent plane; zero on level ground.
    """

    fx: float
    fy: float
    fxx: float
    fxy: float
    fyy: float
    gx: float
    gy: float


class Terrain:
    """Slopes where the robot is, at a fraction of the cost of the polynomial.

    Args:
        mirror: the ideal mirror.
    """

    def __init__(self, mirror: Mirror) -> None:
        self._surface = mirror.surface
        self._gravity = mirror.rotate_deck_from_world((0.0, 0.0, 1.0))  # the telescope points to the zenith
        self._x_m = self._y_m = float("inf")
        self._f_m = 0.0
        self._slope = Slope(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def at(self, x_m: float, y_m: float) -> Slope:
        """Slopes at a deck point."""
        dx, dy = x_m - self._x_m, y_m - self._y_m
        if not -_REACH_M < dx < _REACH_M or not -_REACH_M < dy < _REACH_M:
            return self._evaluate(x_m, y_m)
        fx, fy, fxx, fxy, fyy, gx, gy = self._slope
        return Slope(fx + fxx * dx + fxy * dy, fy + fxy * dx + fyy * dy, fxx, fxy, fyy, gx, gy)

    def height_m(self, x_m: float, y_m: float) -> float:
        """Height of the surface over a deck point."""
        dx, dy = x_m - self._x_m, y_m - self._y_m
        if not -_REACH_M < dx < _REACH_M or not -_REACH_M < dy < _REACH_M:
            self._evaluate(x_m, y_m)
            return self._f_m
        fx, fy, fxx, fxy, fyy, _, _ = self._slope
        return self._f_m + fx * dx + fy * dy + 0.5 * (fxx * dx * dx + fyy * dy * dy) + fxy * dx * dy

    def _evaluate(self, x_m: float, y_m: float) -> Slope:
        self._f_m, fx, fy, fxx, fxy, fyy = self._surface.jet(x_m, y_m)
        self._x_m, self._y_m = x_m, y_m
        self._slope = Slope(fx, fy, fxx, fxy, fyy, *self._downhill(fx, fy))
        return self._slope

    def _downhill(self, fx: float, fy: float) -> tuple[float, float]:
        """Deck components of gravity's part along the surface, as a unit vector."""
        gx, gy, gz = self._gravity
        norm = 1.0 + fx * fx + fy * fy
        # n = (-fx, -fy, 1)/W; what is left of g without its part along n.
        along = (gz - fx * gx - fy * gy) / norm
        tx, ty, tz = gx + along * fx, gy + along * fy, gz - along
        length = sqrt(tx * tx + ty * ty + tz * tz)
        return (tx / length, ty / length) if length > _LEVEL else (0.0, 0.0)
