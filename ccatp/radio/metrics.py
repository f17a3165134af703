"""Pure. How good a track is: rigid alignment, root mean squares, consistency with its own covariance."""

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ccatp.filters.base import FloatArray


class RigidMotion(NamedTuple):
    """A rotation about the origin, then a translation; no scale, no reflection.

    Attributes:
        angle_rad: counter-clockwise.
        x_m: translation.
        y_m: translation.
    """

    angle_rad: float
    x_m: float
    y_m: float

    def moved(self, points_m: FloatArray) -> FloatArray:
        """Points x, y, shape (n, 2), after it."""
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        moved: FloatArray = points_m @ np.array(((c, s), (-s, c))) + np.array((self.x_m, self.y_m))
        return moved

    def turned(self, covariances: FloatArray) -> FloatArray:
        """Covariances of points, shape (..., 2, 2), after it."""
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        R = np.array(((c, -s), (s, c)))
        turned: FloatArray = R @ covariances @ R.T
        return turned


def rigid_alignment(points_m: FloatArray, onto_m: FloatArray) -> RigidMotion:
    """The rigid motion that lays points (n, 2) on others (n, 2) with the least sum of squares (Umeyama 1991, scale 1).

    In the plane the angle is that of sum conj(p - mean p) (q - mean q), the points as complex numbers. A single point,
    or points that all fall together, fix the translation alone.
    """
    p, q = points_m[:, 0] + 1j * points_m[:, 1], onto_m[:, 0] + 1j * onto_m[:, 1]
    angle = float(np.angle(np.vdot(p - p.mean(), q - q.mean())))
    shift = q.mean() - p.mean() * np.exp(1j * angle)
    return RigidMotion(angle, float(shift.real), float(shift.imag))


def rms(errors: FloatArray) -> float | None:
    """Root mean square of what is finite; None of nothing."""
    finite = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else None


def wrapped(angles_rad: FloatArray) -> FloatArray:
    """Angles in [-pi, pi)."""
    result: FloatArray = (angles_rad + np.pi) % (2.0 * np.pi) - np.pi
    return result


class Consistency(NamedTuple):
    """Mean normalised square of errors or innovations, per degree of freedom: 1 if the covariance is honest.

    Attributes:
        mean: sum of the squares over sum of the degrees of freedom.
        low: of the 95 % band that independent Gaussian errors would leave it in.
        high: its upper end.
    """

    mean: float
    low: float
    high: float


def consistency(squares: FloatArray, sizes: FloatArray) -> Consistency | None:
    """Mean of normalised squares against the chi-squared law (Bar-Shalom, Li, Kirubarajan 2001, section 5.4).

    Args:
        squares: normalised innovations (NIS) or errors (NEES) squared, shape (n,).
        sizes: degrees of freedom of each, shape (n,).
    """
    finite = np.isfinite(squares)
    freedom = float(sizes[finite].sum())
    if freedom == 0.0:
        return None
    low, high = (float(chdtri(freedom, q)) / freedom for q in (0.975, 0.025))
    return Consistency(float(squares[finite].sum()) / freedom, low, high)


def nees(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Normalised estimation error squared e^T P^-1 e of each row; errors (n, d), covariances (n, d, d)."""
    solved = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    squares: FloatArray = np.einsum("ni,ni->n", errors, solved)
    return squares
