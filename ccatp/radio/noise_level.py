"""Pure. The noise of a sensor, learned from what its innovations leave."""

from math import exp


class NoiseLevel:
    """A factor f on the variances of a noise, by maximum likelihood on the way (Fisher scoring).

    An innovation of variance S, of which the share a = f r / S is this noise, has the log-likelihood
    -(ln S + nu^2 / S) / 2: its derivative by ln f is a (nis - 1) / 2, its Fisher information a^2 / 2. So
    J <- J + a^2, ln f <- ln f + a (nis - 1) / J.

    Args:
        prior: J at the start, the innovations that the starting value counts for.
        memory: largest J: older innovations fade; 0: the factor stays one.
    """

    def __init__(self, prior: float, memory: float) -> None:
        self.factor = 1.0
        self._information, self._memory = prior, memory

    def learn(self, nis: float, share: float) -> None:
        """Take an innovation: its normalised square, and the share of this noise in its variance."""
        if self._memory <= 0.0:
            return
        information = self._information + share * share
        self._information = information = min(self._memory, information)
        change = share * (nis - 1.0) / information
        if not -LARGEST < change < LARGEST:
            change = LARGEST if change > 0.0 else -LARGEST
        factor = self.factor * exp(change)
        if not 1.0 / FURTHEST < factor < FURTHEST:
            factor = FURTHEST if factor > 1.0 else 1.0 / FURTHEST
        self.factor = factor


LARGEST = 0.3
"""Most that one innovation may change the logarithm of the factor."""
FURTHEST = 100.0
"""Largest factor, and one over the least: a sensor ten times worse than promised is not one to be believed."""
