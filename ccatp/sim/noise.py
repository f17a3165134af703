"""Pure. Random numbers of the simulated world: one stream per kind, each a function of the seed alone."""

from math import exp, sqrt

import numpy as np

_BLOCK = 4096
_SAME_STEP_S = 1e-9  # differences of frame times are equal to within rounding


class NoiseStream:
    """Standard normal numbers of one kind, drawn in blocks: a function of the seed only.

    Args:
        rng: the kind's own generator.
    """

    __slots__ = ("_block", "_next", "_rng")

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._block: list[float] = []
        self._next = 0

    def take(self, count: int) -> list[float]:
        """The next ``count`` numbers."""
        start = self._next
        self._next = end = start + count
        if end <= len(self._block):
            return self._block[start:end]
        rest = self._block[start:]
        while len(rest) < count:
            rest += self._rng.standard_normal(_BLOCK).tolist()
        self._block, self._next = rest, count
        return rest[:count]

    def one(self) -> float:
        """The next number."""
        at = self._next
        if at < len(self._block):
            self._next = at + 1
            return self._block[at]
        return self.take(1)[0]


class OrnsteinUhlenbeck:
    """Stationary process with ``cov(x(t), x(t+d)) = sigma^2 exp(-d/T)``, exact at whatever times it is asked for.

    ``x(t+d) = a x(t) + sigma sqrt(1 - a^2) n`` with ``a = exp(-d/T)``; the first value is one of the stationary
    distribution. A time during which nobody asks costs nothing.
    """

    __slots__ = ("_keep", "_kick", "_noise", "_sigma", "_step_s", "_t_s", "_time_s", "_value")

    def __init__(self, sigma: float, time_s: float, rng: np.random.Generator) -> None:
        """Draw the value at t = 0.

        Args:
            sigma: stationary standard deviation; 0 gives 0 for ever.
            time_s: correlation time T.
            rng: the process's own generator.
        """
        self._noise = NoiseStream(rng)
        self._sigma, self._time_s = sigma, time_s
        self._value = sigma * self._noise.one()
        self._t_s = 0.0
        self._step_s, self._keep, self._kick = 0.0, 1.0, 0.0

    def at(self, t_s: float) -> float:
        """The value at ``t_s``, which is not before the time asked for last."""
        step_s = t_s - self._t_s
        if step_s <= 0.0 or self._sigma == 0.0:
            return self._value
        if not -_SAME_STEP_S < step_s - self._step_s < _SAME_STEP_S:
            self._step_s, self._keep = step_s, exp(-step_s / self._time_s)
            self._kick = self._sigma * sqrt(1.0 - self._keep * self._keep)
        self._t_s = t_s
        self._value = self._keep * self._value + self._kick * self._noise.one()
        return self._value


class DriftingBias:
    """An offset drawn at boot that walks: ``b_k = b_(k-1) + walk sqrt(dt) n``.

    Args:
        start: value at boot.
        walk: standard deviation of the change within one second; grows with the square root of the time.
        rng: the bias's own generator.

    Attributes:
        value: the offset now.
    """

    __slots__ = ("_noise", "_walk", "value")

    def __init__(self, start: float, walk: float, rng: np.random.Generator) -> None:
        self._noise, self._walk = NoiseStream(rng), walk
        self.value = start

    @property
    def is_drifting(self) -> bool:
        """Whether it walks at all."""
        return self._walk > 0.0

    def step(self, dt_s: float) -> None:
        """Go on by ``dt_s``."""
        if self._walk:
            self.value += self._walk * sqrt(dt_s) * self._noise.one()
