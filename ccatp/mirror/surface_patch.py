"""Pure. A mirror's surface around a place that moves slowly: one exact expansion, carried on by Taylor's theorem."""

from math import inf

from ccatp.mirror.surface import Jet, Surface

_ADJACENT, _AHEAD = 1.3, 0.75  # their product is less than 1: a place always lies within its own expansion


class SurfacePatch:
    """Height, slopes and curvatures to third order in the way from the last expansion, at a quarter of the price.

    What is left out belongs to the fourth derivatives, which stay below 1e-3 1/m^3 on these mirrors: within 5 mm a
    height is off by less than 1e-12 m, a slope by less than 2e-10, a second derivative by less than 5e-8 1/m.

    Args:
        surface: the surface.
        reach_m: how far in x and in y an expansion is used.
    """

    __slots__ = ("_jet", "_reach_m", "_surface", "_third", "_x_m", "_y_m")

    def __init__(self, surface: Surface, reach_m: float) -> None:
        self._surface, self._reach_m = surface, reach_m
        self._x_m = self._y_m = inf
        self._jet: Jet = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._third = (0.0, 0.0, 0.0, 0.0)

    def jet(self, x: float, y: float) -> Jet:
        """All of (f, fx, fy, fxx, fxy, fyy), as ``Surface.jet``."""
        dx, dy, reach = x - self._x_m, y - self._y_m, self._reach_m
        if not (-reach < dx < reach and -reach < dy < reach):
            return self._expand(x, y)
        f, fx, fy, fxx, fxy, fyy = self._jet
        fxxx, fxxy, fxyy, fyyy = self._third
        # Half of what the second derivatives change by: their mean on the way makes the slopes exact to this order.
        hxx, hxy, hyy = 0.5 * (fxxx * dx + fxxy * dy), 0.5 * (fxxy * dx + fxyy * dy), 0.5 * (fxyy * dx + fyyy * dy)
        gx, gy = (fxx + hxx) * dx + (fxy + hxy) * dy, (fxy + hxy) * dx + (fyy + hyy) * dy
        bend = hxx * dx * dx + 2.0 * hxy * dx * dy + hyy * dy * dy
        rise = (fx + 0.5 * gx) * dx + (fy + 0.5 * gy) * dy - bend / 6.0
        return f + rise, fx + gx, fy + gy, fxx + 2.0 * hxx, fxy + 2.0 * hxy, fyy + 2.0 * hyy

    def _expand(self, x: float, y: float) -> Jet:
        way_x, way_y, limit = x - self._x_m, y - self._y_m, _ADJACENT * self._reach_m
        if -limit < way_x < limit and -limit < way_y < limit:
            # Whoever has just left the last square most likely goes on: the next one begins here.
            self._x_m, self._y_m = x + _AHEAD * way_x, y + _AHEAD * way_y
        else:
            self._x_m, self._y_m = x, y
        self._jet, self._third = self._surface.jet(self._x_m, self._y_m), self._surface.third(self._x_m, self._y_m)
        return self.jet(x, y)
