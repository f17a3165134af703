"""Pure. Random numbers of the simulated world: one stream per kind, each a function of the seed alone."""

from collections.abc import Callable, Iterator
from itertools import chain, islice
from math import exp, sqrt

import numpy as np

from ccatp.samples import FloatArray

WHOLE = 1.5 * 2.0**52
"""``x + WHOLE - WHOLE`` is ``x`` rounded to a whole number while ``|x| < 2**51``: no call, no integer in between."""

BLOCK = 4096
"""Numbers drawn at a time: plain floats from a list are cheaper than calls to the generator."""

_SAME_STEP_S = 1e-9  # differences of frame times are equal to within rounding


class NoiseStream:
    """Standard normal numbers of one kind: a function of the seed only.

    Args:
        rng: the kind's own generator.

    Attributes:
        one: gives the next number.
    """

    __slots__ = ("_numbers", "one")

    def __init__(self, rng: np.random.Generator) -> None:
        blocks: Iterator[list[float]] = iter(lambda: rng.standard_normal(BLOCK).tolist(), None)
        self._numbers = chain.from_iterable(blocks)
        self.one: Callable[[], float] = self._numbers.__next__

    def take(self, count: int) -> list[float]:
        """The next ``count`` numbers."""
        return list(islice(self._numbers, count))


class OrnsteinUhlenbeck:
    """Stationary process with ``cov(x(t), x(t+d)) = sigma^2 exp(-d/T)``, exact at whatever times it is asked for.

    ``x(t+d) = a x(t) + sigma sqrt(1 - a^2) n`` with ``a = exp(-d/T)``; the first value is one of the stationary
    distribution. A time during which nobody asks costs nothing.
    """

    __slots__ = ("_keep", "_kick", "_one", "_sigma", "_step_s", "_t_s", "_time_s", "_value")

    def __init__(self, sigma: float, time_s: float, rng: np.random.Generator) -> None:
        """Draw the value at t = 0.

        Args:
            sigma: stationary standard deviation; 0 gives 0 for ever.
            time_s: correlation time T.
            rng: the process's own generator.
        """
        self._one = NoiseStream(rng).one
        self._sigma, self._time_s = sigma, time_s
        self._value = sigma * self._one()
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
        self._value = value = self._keep * self._value + self._kick * self._one()
        return value


class DriftingBias:
    """An offset drawn at boot that walks: ``b_k = b_(k-1) + walk sqrt(dt) n``.

    Args:
        start: value at boot.
        walk: standard deviation of the change within one second; grows with the square root of the time.
        step_s: dt, the time between two steps.
        rng: the bias's own generator.
    """

    __slots__ = ("_kick", "_rng", "_value")

    def __init__(self, start: float, walk: float, step_s: float, rng: np.random.Generator) -> None:
        self._value, self._kick, self._rng = start, walk * sqrt(step_s), rng

    def ahead(self, count: int) -> FloatArray:
        """The offset after each of the next ``count`` steps, shape (count,)."""
        if not self._kick:
            return np.full(count, self._value)
        kicks = self._kick * self._rng.standard_normal(count)
        walk: FloatArray = np.cumsum(np.concatenate(([self._value], kicks)))
        self._value = float(walk[-1])
        return walk[1:]
