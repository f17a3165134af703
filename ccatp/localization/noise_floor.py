"""Pure. The noise of a sensor that the filter should count with, learned while the robot stands."""

_BLOCK = 15
_MEMORY = 0.03  # weight of a new block: some thirty blocks are remembered


class NoiseFloor:
    """White-noise variance of a single sample, from means over blocks of a standing robot's samples.

    A vibration does not drift: within a block it averages out faster than white noise does. So the variance of block
    means, times the block's length, is the part that the integral of the signal will feel.

    Args:
        variance: expected of a single sample, before anything is learned.
    """

    def __init__(self, variance: float) -> None:
        self.variance = variance
        self._sum = 0.0
        self._count = 0
        self._before: float | None = None

    def restart(self) -> None:
        """Another rest begins: a block does not reach across motion. A bias hardly moves from one rest to the next."""
        self._sum, self._count = 0.0, 0

    def add(self, value: float) -> None:
        """Take one sample at rest."""
        self._sum += value
        self._count += 1
        if self._count < _BLOCK:
            return
        mean = self._sum / _BLOCK
        if self._before is not None:
            # The variance of a difference is twice that of a mean.
            found = 0.5 * _BLOCK * (mean - self._before) ** 2
            self.variance += _MEMORY * (found - self.variance)
        self._sum, self._count, self._before = 0.0, 0, mean
