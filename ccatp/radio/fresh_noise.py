"""Pure. What the motion has added to the covariance of the pose since something was last heard."""

from ccatp.filters.base import FloatArray


class FreshNoise:
    """N <- G N G^T + Q, N symmetric, G = dh(pose)/d(pose): the identity, but for the derivatives by the heading.

    Six numbers in place of an array of nine: an update of so small a one by NumPy takes longer than the rest.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Something was heard."""
        self._xx = self._xy = self._xt = self._yy = self._yt = self._tt = 0.0

    def step(self, F: FloatArray, Q: FloatArray) -> None:
        """The vehicle moves on: Jacobian and noise of its states, each of shape (v, v), the pose first."""
        f, g, tt = F.item(0, 2), F.item(1, 2), self._tt
        xt, yt = self._xt + f * tt, self._yt + g * tt
        self._xx += f * (self._xt + xt) + Q.item(0, 0)
        self._xy += g * self._xt + f * yt + Q.item(0, 1)
        self._yy += g * (self._yt + yt) + Q.item(1, 1)
        self._xt, self._yt, self._tt = xt + Q.item(0, 2), yt + Q.item(1, 2), tt + Q.item(2, 2)

    def seen(self, hx: float, hy: float, ht: float) -> float:
        """H N H^T of a row with these derivatives by the pose."""
        across = hx * (hx * self._xx + 2.0 * (hy * self._xy + ht * self._xt))
        return across + hy * (hy * self._yy + 2.0 * ht * self._yt) + ht * ht * self._tt
