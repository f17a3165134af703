"""Pure. What the legs driven so far tell about the next one: means and scatter of what each leg draws anew."""

from collections.abc import Sequence
from math import exp, log

# Candidates for the scatter, from "does not change" to "anything goes"; a factor of sqrt(2) apart.
_CANDIDATES = tuple(1e-7 * 2.0 ** (k / 2.0) for k in range(38))
_FORGETTING = 0.99  # of the likelihoods per leg, so that a world that changes is noticed within a hundred legs
_LEAST = 1e-14


class Population:
    """Bayes for parameters that are drawn anew for each leg from N(mu_j, sigma^2): sigma common, all unknown.

    After a leg its estimate y_j with variance R_j is one sample: y_j ~ N(mu_j, sigma^2 + R_j). Given sigma, the means
    follow by the Kalman equations; each candidate of a grid of sigmas has means of its own and the weight that its
    predictions have earned. So one set of constants serves a floor on which wheels never slip and one on which each leg
    slips differently: what the mixture expects of the next leg is what the filter is given.

    Args:
        expected: of each parameter, mean and standard deviation of mu before the first leg.
        largest: the largest scatter thought possible; candidates beyond it are left out.

    Attributes:
        means: expectation of each parameter in the next leg.
        mean_variances: how well they are known.
        scatter: the expectation of sigma^2, which is what the next leg will show of it.
    """

    def __init__(self, expected: Sequence[tuple[float, float]], largest: float) -> None:
        self._sigmas = [s for s in _CANDIDATES if s <= largest]
        # Either the wheels hold, which is the smallest candidate, or they slip, and then nothing is known of the scale
        # but its limits: its logarithm is uniform. Before the first leg one is as likely as the other.
        self._prior = [log(max(len(self._sigmas) - 1, 1)), *[0.0] * (len(self._sigmas) - 1)]
        self._logs = [0.0] * len(self._sigmas)
        self._means = [[mean] * len(self._sigmas) for mean, _ in expected]
        self._variances = [[sigma * sigma] * len(self._sigmas) for _, sigma in expected]
        self.means = self.mean_variances = [0.0] * len(expected)
        self.scatter = 0.0
        self._mix()

    def learn(self, samples: Sequence[tuple[float, float] | None], share: float = 1.0) -> None:
        """Take what a leg says of its parameters.

        Args:
            samples: of each parameter the estimate, and the variance that the leg's own measurements give it, without
                the prior; None where the leg says nothing of it.
            share: of sigma^2 in them: more than one where the parameters also wander within the leg.
        """
        self._logs = [_FORGETTING * likelihood for likelihood in self._logs]
        for sample, means, variances in zip(samples, self._means, self._variances, strict=True):
            if sample is None:
                continue
            value, variance = sample
            for k, sigma in enumerate(self._sigmas):
                known, e = variances[k], value - means[k]
                total = known + share * sigma * sigma + variance
                self._logs[k] -= 0.5 * (e * e / total + log(total))
                means[k] += known / total * e
                variances[k] = max(known * (1.0 - known / total), _LEAST)
        top = max(self._logs)
        self._logs = [likelihood - top for likelihood in self._logs]
        self._mix()

    def _mix(self) -> None:
        logs = [a + b for a, b in zip(self._logs, self._prior, strict=True)]
        top = max(logs)
        weights = [exp(value - top) for value in logs]
        total = sum(weights)
        weights = [weight / total for weight in weights]
        self.means = [sum(w * m for w, m in zip(weights, means, strict=True)) for means in self._means]
        self.mean_variances = [
            sum(w * (v + (m - mixed) ** 2) for w, m, v in zip(weights, means, variances, strict=True))
            for mixed, means, variances in zip(self.means, self._means, self._variances, strict=True)
        ]
        self.scatter = sum(w * s * s for w, s in zip(weights, self._sigmas, strict=True))
