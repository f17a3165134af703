"""Rigid motions between point sets: the best one, and the error that it leaves."""

from typing import NamedTuple

import numpy as np

from ccatp.core import FloatArray


class RigidMotion(NamedTuple):
    """x -> R x + t: rotation R, orthogonal, shape (d, d); translation t, m, shape (d,)."""

    rotation: FloatArray
    translation_m: FloatArray

    @property
    def angle_rad(self) -> float:
        """Angle of a rotation in the plane, counter-clockwise."""
        return float(np.arctan2(self.rotation[1, 0], self.rotation[0, 0]))

    def moved(self, points_m: FloatArray) -> FloatArray:
        """The images of points, shape (n, d)."""
        return points_m @ self.rotation.T + self.translation_m

    def turned(self, covariances_m2: FloatArray) -> FloatArray:
        """The covariances of the images, shape (..., d, d)."""
        turned: FloatArray = self.rotation @ covariances_m2 @ self.rotation.T
        return turned

    def turned_map(self, covariance_m2: FloatArray) -> FloatArray:
        """The covariance of the images of n points together, shape (n d, n d)."""
        d = len(self.rotation)
        n = len(covariance_m2) // d
        blocks = covariance_m2.reshape(n, d, n, d).swapaxes(1, 2)
        return self.turned(blocks).swapaxes(1, 2).reshape(n * d, n * d)


def best_motion(
    source_m: FloatArray, target_m: FloatArray, *, mirrors: bool = False, weights: FloatArray | None = None
) -> RigidMotion:
    """The motion that minimises sum(w |R a + t - b|^2) (Kabsch 1976, Umeyama 1991), without a scale; (n, d) points.

    With ``mirrors`` R may be a reflection, because ranges alone do not distinguish a map from its mirror image.
    """
    w = np.ones(len(source_m)) if weights is None else weights
    w = w / w.sum()
    centre_a, centre_b = w @ source_m, w @ target_m
    U, _, Vt = np.linalg.svd((source_m - centre_a).T @ ((target_m - centre_b) * w[:, None]))
    signs = np.ones(source_m.shape[1])
    if not mirrors and np.linalg.det(U @ Vt) < 0.0:
        signs[-1] = -1.0
    rotation = (U * signs @ Vt).T
    return RigidMotion(rotation, centre_b - rotation @ centre_a)


def aligned_rms_m(found_m: FloatArray, true_m: FloatArray, *, mirrors: bool = False) -> float:
    """Root mean square distance of points (n, d) from the truth after the best rigid motion, sqrt(mean |e|^2)."""
    moved = best_motion(found_m, true_m, mirrors=mirrors).moved(found_m)
    return rms_m(moved, true_m)


def rms_m(found_m: FloatArray, true_m: FloatArray) -> float:
    """Root mean square distance of points from the truth as they are, sqrt(mean |e|^2)."""
    return float(np.sqrt(((found_m - true_m) ** 2).sum(axis=1).mean()))


def rigid_modes(points_m: FloatArray) -> FloatArray:
    """Infinitesimal rigid motions of points: translations, then rotations, orthonormal, shape (n d, d (d + 1) / 2)."""
    count, dimension = points_m.shape
    centred = points_m - points_m.mean(axis=0)
    modes = []
    for axis in range(dimension):
        mode = np.zeros((count, dimension))
        mode[:, axis] = 1.0
        modes.append(mode.ravel())
    for a in range(dimension):
        for b in range(a + 1, dimension):
            mode = np.zeros((count, dimension))
            mode[:, a], mode[:, b] = -centred[:, b], centred[:, a]
            modes.append(mode.ravel())
    basis = np.column_stack(modes)
    U, singular, _ = np.linalg.svd(basis, full_matrices=False)
    return np.asarray(U[:, singular > 1e-12 * singular[0]])
