"""Pure. What the legs driven so far tell about the next one: mean and scatter of a parameter that each leg redraws."""

from math import exp, log

# Candidates for the scatter, from "does not change" to "anything goes"; a factor of sqrt(2) apart.
_CANDIDATES = tuple(1e-7 * 2.0 ** (k / 2.0) for k in range(38))
_FORGETTING = 0.99  # of the likelihoods per leg, so that a world that changes is noticed within a hundred legs
_LEAST = 1e-14


class Population:
    """Bayes for a parameter that is drawn anew for each leg from N(mu, sigma^2), both unknown.

    After a leg its estimate y with variance R is one sample: y ~ N(mu, sigma^2 + R). Given sigma, the mean follows by
    the Kalman equations; each candidate of a grid of sigmas has a mean of its own and the weight that its predictions
    have earned. So one set of constants serves a floor on which wheels never slip and one on which each leg slips
    differently: what the mixture expects of the next leg is what the filter is given.

    Args:
        mean: expectation before the first leg.
        sigma: standard deviation of that expectation.
        largest: the largest scatter thought possible; candidates beyond it are left out.

    Attributes:
        mean: expectation of the next leg's parameter.
        mean_variance: how well it is known.
        scatter: the expectation of sigma^2, which is what the next leg will show of it.
    """

    def __init__(self, mean: float, sigma: float, largest: float) -> None:
        self._sigmas = [s for s in _CANDIDATES if s <= largest]
        # Either the wheels hold, which is the smallest candidate, or they slip, and then nothing is known of the scale
        # but its limits: its logarithm is uniform. Before the first leg one is as likely as the other.
        self._prior = [log(max(len(self._sigmas) - 1, 1)), *[0.0] * (len(self._sigmas) - 1)]
        self._logs = [0.0] * len(self._sigmas)
        self._means = [mean] * len(self._sigmas)
        self._variances = [sigma * sigma] * len(self._sigmas)
        self.mean = self.mean_variance = self.scatter = 0.0
        self._mix()

    @property
    def variance(self) -> float:
        """Variance of the next leg's parameter: scatter plus what is not known of the mean."""
        return self.scatter + self.mean_variance

    def learn(self, value: float, variance: float, share: float = 1.0) -> None:
        """Take a leg's estimate of its parameter.

        Args:
            value: the estimate.
            variance: what the leg's own measurements give it, without the prior.
            share: of the scatter's variance in it: more than one where the parameter also wanders within the leg.
        """
        for k, sigma in enumerate(self._sigmas):
            known, e = self._variances[k], value - self._means[k]
            total = known + share * sigma * sigma + variance
            self._logs[k] = _FORGETTING * self._logs[k] - 0.5 * (e * e / total + log(total))
            self._means[k] += known / total * e
            self._variances[k] = max(known * (1.0 - known / total), _LEAST)
        top = max(self._logs)
        self._logs = [likelihood - top for likelihood in self._logs]
        self._mix()

    def _mix(self) -> None:
        logs = [a + b for a, b in zip(self._logs, self._prior, strict=True)]
        top = max(logs)
        weights = [exp(value - top) for value in logs]
        total = sum(weights)
        weights = [weight / total for weight in weights]
        self.mean = sum(w * m for w, m in zip(weights, self._means, strict=True))
        self.mean_variance = sum(
            w * (v + (m - self.mean) ** 2) for w, m, v in zip(weights, self._means, self._variances, strict=True)
        )
        self.scatter = sum(w * s * s for w, s in zip(weights, self._sigmas, strict=True))
