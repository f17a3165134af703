"""The polynomial surface of a mirror in the deck frame, thesis eq. 1.1: derivatives, normal, local expansion."""

from math import inf, sqrt

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval2d

from ccatp.config.models import SurfaceConfig
from ccatp.core import FloatArray, Vector3


class MirrorError(ValueError):
    """Base of the errors of a mirror's geometry."""


class UnknownPanelError(MirrorError):
    """A panel or measurement point that the mirror does not have."""


class ConvergenceError(MirrorError):
    """An iteration on the surface did not converge: the point is far from the mirror or not finite."""


Axes = tuple[Vector3, Vector3, Vector3]
Jet = tuple[float, float, float, float, float, float]
Third = tuple[float, float, float, float]

_METRE_PER_MM = 1e-3
_NEWTON_STEPS = 20
_NEWTON_STEP_M = 1e-12  # Newton converges quadratically, so after such a step the error is at rounding level


def tangent_axes(fx: float, fy: float) -> Axes:
    """As ``Surface.axes``, from the slopes."""
    s2 = 1.0 + fx * fx
    s = sqrt(s2)
    w = sqrt(s2 + fy * fy)
    ws = w * s
    return (1.0 / s, 0.0, fx / s), (-fx * fy / ws, s / w, fy / ws), (-fx / w, -fy / w, 1.0 / w)


class Surface:
    """Height of the ideal mirror over the deck plane, ``f(x, y) = sum c_ij x^i y^j`` (thesis eq. 1.1, deck frame, m).

    Scalar methods use nested Horner schemes in plain floats, because they run several times per control frame. The
    methods with plural names take arrays.
    """

    __slots__ = ("_coefficients", "_rows", "_with_slopes")

    def __init__(self, coefficients: FloatArray) -> None:
        """``coefficients``: c_ij in m^(1-i-j), shape (powers of x, powers of y).

        Raises ``ValueError`` for another dimension.
        """
        if coefficients.ndim != 2:
            raise ValueError(f"surface coefficients need shape (i, j), got {coefficients.shape}")
        self._coefficients = c = coefficients.astype(np.float64)
        self._with_slopes = together = np.zeros((*c.shape, 3))  # of f, fx and fy
        together[..., 0] = c
        together[:-1, :, 1], together[:, :-1, 2] = polyder(c, axis=0), polyder(c, axis=1)
        # Highest power first, as for Horner's scheme, without the trailing zeros of each row.
        self._rows = tuple(tuple(np.trim_zeros(row, "b")[::-1].tolist()) for row in c[::-1])

    def height_m(self, x: float, y: float) -> float:
        """Height f(x, y) above the deck plane, m."""
        f = 0.0
        for row in self._rows:
            q = 0.0
            for c in row:
                q = q * y + c
            f = f * x + q
        return f

    def gradient(self, x: float, y: float) -> tuple[float, float]:
        """Slopes (fx, fy), dimensionless."""
        f = fx = fy = 0.0
        for row in self._rows:
            q = q1 = 0.0
            for c in row:
                q1 = q1 * y + q
                q = q * y + c
            fx = fx * x + f
            f = f * x + q
            fy = fy * x + q1
        return fx, fy

    def jet(self, x: float, y: float) -> Jet:
        """All of (f, fx, fy, fxx, fxy, fyy) in one pass."""
        f = fx = fy = half_fxx = fxy = half_fyy = 0.0
        for row in self._rows:
            q = q1 = half_q2 = 0.0
            for c in row:
                half_q2 = half_q2 * y + q1
                q1 = q1 * y + q
                q = q * y + c
            half_fxx = half_fxx * x + fx
            fx = fx * x + f
            f = f * x + q
            fxy = fxy * x + fy
            fy = fy * x + q1
            half_fyy = half_fyy * x + half_q2
        return f, fx, fy, 2.0 * half_fxx, fxy, 2.0 * half_fyy

    def third(self, x: float, y: float) -> Third:
        """Third derivatives (fxxx, fxxy, fxyy, fyyy), 1/m^2."""
        f = fx = fy = half_fxx = fxy = half_fyy = sixth_fxxx = half_fxxy = half_fxyy = sixth_fyyy = 0.0
        for row in self._rows:
            q = q1 = half_q2 = sixth_q3 = 0.0
            for c in row:
                sixth_q3 = sixth_q3 * y + half_q2
                half_q2 = half_q2 * y + q1
                q1 = q1 * y + q
                q = q * y + c
            sixth_fxxx = sixth_fxxx * x + half_fxx
            half_fxx = half_fxx * x + fx
            fx = fx * x + f
            f = f * x + q
            half_fxxy = half_fxxy * x + fxy
            fxy = fxy * x + fy
            fy = fy * x + q1
            half_fxyy = half_fxyy * x + half_fyy
            half_fyy = half_fyy * x + half_q2
            sixth_fyyy = sixth_fyyy * x + sixth_q3
        return 6.0 * sixth_fxxx, 2.0 * half_fxxy, 2.0 * half_fxyy, 6.0 * sixth_fyyy

    def normal(self, x: float, y: float) -> Vector3:
        """Unit normal on the drive side, ``n = (-fx, -fy, 1)/W``, deck frame."""
        fx, fy = self.gradient(x, y)
        w = sqrt(1.0 + fx * fx + fy * fy)
        return -fx / w, -fy / w, 1.0 / w

    def point(self, x: float, y: float) -> Vector3:
        """Surface point (x, y, f(x, y)), deck frame, m."""
        return x, y, self.height_m(x, y)

    def axes(self, x: float, y: float) -> Axes:
        """Orthonormal tangent frame (e1, e2, n) at (x, y), deck frame.

        ``e1 = (1, 0, fx)/sqrt(1 + fx^2)`` is the tangent of the line y = const towards +x, n the normal, e2 = n x e1.
        """
        return tangent_axes(*self.gradient(x, y))

    def drop(self, start: Vector3, direction: Vector3) -> Vector3:
        """Point where the line ``start + s direction`` meets the surface near s = 0; raises ``ConvergenceError``."""
        x0, y0, z0 = start
        ux, uy, uz = direction
        s = 0.0
        for _ in range(_NEWTON_STEPS):
            x, y = x0 + s * ux, y0 + s * uy
            f, fx, fy, _, _, _ = self.jet(x, y)
            step = (f - z0 - s * uz) / (uz - fx * ux - fy * uy)
            s += step
            if abs(step) < _NEWTON_STEP_M:
                return self.point(x0 + s * ux, y0 + s * uy)
        raise ConvergenceError(f"no surface point on the line through {start} along {direction}")

    def foot(self, p: Vector3) -> tuple[float, float, float]:
        """Foot (x, y) of the perpendicular from ``p`` and distance d along the normal, > 0 on the drive side; deck, m.

        Solves ``p = S(x, y) + d n(x, y)`` by Newton's iteration; raises ``ConvergenceError``.
        """
        px, py, pz = p
        x, y = px, py
        for _ in range(_NEWTON_STEPS):
            f, fx, fy, fxx, fxy, fyy = self.jet(x, y)
            r = pz - f
            gx, gy = px - x + r * fx, py - y + r * fy
            jxx, jxy, jyy = r * fxx - 1.0 - fx * fx, r * fxy - fx * fy, r * fyy - 1.0 - fy * fy
            det = jxx * jyy - jxy * jxy
            dx, dy = (jxy * gy - jyy * gx) / det, (jxy * gx - jxx * gy) / det
            x, y = x + dx, y + dy
            if abs(dx) + abs(dy) < _NEWTON_STEP_M:
                fx, fy = self.gradient(x, y)
                return x, y, (pz - self.height_m(x, y)) * sqrt(1.0 + fx * fx + fy * fy)
        raise ConvergenceError(f"no foot on the surface for the deck point {p}")

    def heights_m(self, xs: FloatArray, ys: FloatArray) -> FloatArray:
        """Heights of many points; ``xs`` and ``ys`` of equal shape, result of that shape, m."""
        return np.asarray(polyval2d(xs, ys, self._coefficients), dtype=np.float64)

    def gradients(self, xs: FloatArray, ys: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Slopes (fx, fy) of many points, each of the shape of ``xs``."""
        fx, fy = polyval2d(xs, ys, self._with_slopes[..., 1:])
        return fx, fy

    def heights_and_gradients(self, xs: FloatArray, ys: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Heights, m, and slopes (f, fx, fy) of many points, each of the shape of ``xs``."""
        f, fx, fy = polyval2d(xs, ys, self._with_slopes)
        return f, fx, fy


def build_surface(cfg: SurfaceConfig, drive_side: int) -> Surface:
    """Surface of a mirror in its deck frame: ``f_deck(x, y) = s f_mirror(s x, y)`` with s = ``drive_side``, +1 or -1.

    ``cfg`` has coefficients a_ij in mm over the normalisation radius, mirror frame (thesis eq. 1.1).
    """
    size_x = 1 + max((i for i, _, _ in cfg.terms), default=0)
    size_y = 1 + max((j for _, j, _ in cfg.terms), default=0)
    coefficients = np.zeros((size_x, size_y))
    radius_m = cfg.normalisation_radius_mm * _METRE_PER_MM
    for i, j, a_mm in cfg.terms:
        coefficients[i, j] += drive_side ** (i + 1) * a_mm * _METRE_PER_MM / radius_m ** (i + j)
    return Surface(coefficients)


_ADJACENT, _AHEAD = 1.3, 0.75  # their product is less than 1, so that a place always lies within its own expansion


class SurfacePatch:
    """Height, slopes and curvatures by an expansion of third order, at a quarter of the cost of the polynomial.

    The error is that of the fourth derivatives, which stay below 1e-3 1/m^3 on these mirrors: within 5 mm a height is
    off by less than 1e-12 m, a slope by less than 2e-10, a second derivative by less than 5e-8 1/m. An expansion is
    used within ``reach_m`` in x and in y.
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
        # Half of the change of the second derivatives; with their means the slopes are exact to this order.
        hxx, hxy, hyy = 0.5 * (fxxx * dx + fxxy * dy), 0.5 * (fxxy * dx + fxyy * dy), 0.5 * (fxyy * dx + fyyy * dy)
        gx, gy = (fxx + hxx) * dx + (fxy + hxy) * dy, (fxy + hxy) * dx + (fyy + hyy) * dy
        bend = hxx * dx * dx + 2.0 * hxy * dx * dy + hyy * dy * dy
        rise = (fx + 0.5 * gx) * dx + (fy + 0.5 * gy) * dy - bend / 6.0
        return f + rise, fx + gx, fy + gy, fxx + 2.0 * hxx, fxy + 2.0 * hxy, fyy + 2.0 * hyy

    def _expand(self, x: float, y: float) -> Jet:
        way_x, way_y, limit = x - self._x_m, y - self._y_m, _ADJACENT * self._reach_m
        if -limit < way_x < limit and -limit < way_y < limit:
            # A robot that just left the last square probably drives on, so the next one is placed ahead of it.
            self._x_m, self._y_m = x + _AHEAD * way_x, y + _AHEAD * way_y
        else:
            self._x_m, self._y_m = x, y
        self._jet, self._third = self._surface.jet(self._x_m, self._y_m), self._surface.third(self._x_m, self._y_m)
        return self.jet(x, y)
