"""Pure. An affine transition of a filter's state."""

import numpy as np

from ccatp.filters.base import FloatArray


class Affine:
    """x <- F x + b, as a ``Transition`` for the nonlinear filters.

    Args:
        F: shape (n, n).
        b: shape (n,).
    """

    def __init__(self, F: FloatArray, b: FloatArray) -> None:
        self._F, self._b = F, b

    @classmethod
    def shift(cls, b: FloatArray) -> "Affine":
        """Translate by b: x <- x + b."""
        return cls(np.eye(b.size), b)

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Image of x (n,) and the Jacobian (n, n)."""
        return self._F.dot(x) + self._b, self._F

    def through(self, points: FloatArray) -> FloatArray:
        """Images of the rows (k, n)."""
        image: FloatArray = points.dot(self._F.T) + self._b
        return image
