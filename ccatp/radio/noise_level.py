"""Pure. The noise of a sensor, learned from what its innovations leave."""


class NoiseLevel:
    """A factor f on the variances of a sensor's noise, by maximum likelihood on the way.

    After an innovation of variance S = H P H^T + f r the expected noise squared, given the innovation, is
    f r [1 + (f r / S)(nis - 1)] (the step of expectation maximisation, Shumway and Stoffer 1982). f follows the mean of
    it, each innovation weighted by f r / S, the share of it that is noise.

    Args:
        prior: innovations that the starting value counts for.
        memory: innovations after which older ones fade; 0: the factor stays one.
    """

    def __init__(self, prior: float, memory: float) -> None:
        self.factor = 1.0
        self._seen, self._memory = prior, memory

    def learn(self, nis: float, share: float) -> None:
        """Take an innovation: its normalised square, and f r / S."""
        if self._memory <= 0.0:
            return
        self._seen = min(self._seen + share, self._memory)
        self.factor *= 1.0 + share * (nis - 1.0) / self._seen
