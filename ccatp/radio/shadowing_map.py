"""Pure. Static shadowing as a filter can hold it: values at the points of a grid, and how a place follows from them."""

import numpy as np

from ccatp.filters.base import FloatArray


class ShadowingMap:
    """Kriging of a Gaussian field with covariance sigma^2 exp(-d / L) (Gudmundson 1991) from its values at grid points.

    The field at a place is k^T C^-1 f + rest, with f the values at the points, C their covariance, k the covariances
    between place and points; the rest has the variance sigma^2 - k^T C^-1 k and counts as white. The states are
    w = R^-1 f with C = R R^T, so that a prior of them is the identity, and the row of a place is k^T R^-T.

    Args:
        size_m: the room.
        spacing_m: between grid points; the outermost lie on the walls.
        sigma_db: sigma.
        length_m: L.
    """

    def __init__(self, size_m: tuple[float, float], spacing_m: float, sigma_db: float, length_m: float) -> None:
        axes = [np.linspace(0.0, size, max(2, round(size / spacing_m) + 1)) for size in size_m]
        grid = np.meshgrid(*axes, indexing="ij")
        self._points = np.column_stack([axis.ravel() for axis in grid])
        self._variance = sigma_db**2
        self._length_m = length_m
        offsets = self._points[:, None] - self._points[None, :]
        root = np.linalg.cholesky(self._covariance(np.hypot(offsets[..., 0], offsets[..., 1])))
        self._inverse_root: FloatArray = np.linalg.solve(root, np.eye(len(root)))

    @property
    def size(self) -> int:
        """How many states it takes."""
        return len(self._points)

    def row(self, x_m: float, y_m: float) -> tuple[FloatArray, float]:
        """Derivatives of the field at a place by the states, shape (size,), and the variance of the rest, dB^2."""
        distances = np.hypot(self._points[:, 0] - x_m, self._points[:, 1] - y_m)
        row = self._inverse_root @ self._covariance(distances)
        return row, max(self._variance - float(row @ row), 0.0)

    def _covariance(self, distance_m: FloatArray) -> FloatArray:
        return np.asarray(self._variance * np.exp(-distance_m / self._length_m))
