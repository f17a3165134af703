"""Prior of slip and creep for the next leg, from the means and the scatter of the legs driven so far."""

from collections.abc import Sequence
from math import exp, log
from typing import NamedTuple

import numpy as np

from ccatp.config.models import FullStateConfig
from ccatp.core import FloatArray
from ccatp.estimation.state_model import SLIPS

# Candidates for the scatter, from constant to arbitrary, a factor of sqrt(2) apart.
_CANDIDATES = tuple(1e-7 * 2.0 ** (k / 2.0) for k in range(38))
_FORGETTING = 0.99  # of the likelihoods per leg, so that a change of the floor is noticed within a hundred legs
_LEAST = 1e-14


class SlipPopulation:
    """Bayesian estimate of parameters that each leg draws from N(mu_j, sigma^2), with unknown mu_j and common sigma.

    The estimate y_j of a leg with variance R_j is one sample: y_j ~ N(mu_j, sigma^2 + R_j). For a given sigma the means
    follow by the Kalman equations. Each candidate of a grid of sigmas has its own means, and a weight by the likelihood
    of its predictions. So the same constants serve a floor without slip and one on which each leg slips differently.
    ``expected``: mean and standard deviation of each mu before the first leg; ``scatter``: expectation of sigma^2.
    """

    def __init__(self, expected: Sequence[tuple[float, float]], largest: float) -> None:
        self._sigmas = [s for s in _CANDIDATES if s <= largest]
        # Either the wheels do not slip (the smallest candidate), or they slip with an unknown scale, whose logarithm is
        # uniform. Before the first leg both are equally likely.
        self._prior = [log(max(len(self._sigmas) - 1, 1)), *[0.0] * (len(self._sigmas) - 1)]
        self._logs = [0.0] * len(self._sigmas)
        self._means = [[mean] * len(self._sigmas) for mean, _ in expected]
        self._variances = [[sigma * sigma] * len(self._sigmas) for _, sigma in expected]
        self.means = self.mean_variances = [0.0] * len(expected)
        self.scatter = 0.0
        self._mix()

    def learn(self, samples: Sequence[tuple[float, float] | None], share: float = 1.0) -> None:
        """Take a leg's estimate of each parameter with its variance, without the prior; None: not observed.

        ``share``: factor of sigma^2 in them; more than 1 if the parameters also wander within the leg.
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


# Ratio of the variances after and before a leg above which the leg has not observed a parameter.
_TAUGHT = 0.9999
# var(s_R - s_L) over var((s_R + s_L)/2) for two wheels of one population.
_DIFFERENCE = 4.0

# Matrix from the states (SR, SL, C, CT) to the parameters (mean slip, difference of slips, creeps), and its inverse.
_PARAMETERS = np.eye(4)
_PARAMETERS[:2, :2] = [[0.5, 0.5], [1.0, -1.0]]
_STATES = np.linalg.inv(_PARAMETERS)
_SLIP_BLOCK = np.ix_(SLIPS, SLIPS)


def _parameters_of(mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means (4,) and variances (4,) of the parameters in a state (n,), (n, n)."""
    known = _PARAMETERS.dot(covariance[_SLIP_BLOCK]).dot(_PARAMETERS.T).diagonal()
    return _PARAMETERS.dot(mean[SLIPS]), known


class LegScatter(NamedTuple):
    """Variances of a leg's values about their means: mean slip, difference of the slips, creep, creep of turns."""

    slip: float
    difference: float
    creep: float
    turn_creep: float


class SlipWander(NamedTuple):
    """Variances by which the slip of each wheel and both creeps change."""

    slip: float
    creep: float
    turn_creep: float


class LegTransition(NamedTuple):
    """From (right slip, left slip, creeps) to the next leg: s' = F s + b + e, with the covariance Q of e."""

    F: FloatArray
    b: FloatArray
    Q: FloatArray


class SlipPrior:
    """Prior of slip and creep for each leg.

    Right and left slip are separated into their mean (observed by the distance) and their difference (observed by the
    heading). Both wheels belong to one population, so both show how much legs differ. If legs hardly differ, the next
    leg keeps the state with its correlations. If each leg slips differently, it begins with the mean of all legs. The
    scatter of slip is learned (``SlipPopulation``); that of creep is a fixed part of its value.

    In each leg a parameter is m + d with an unknown mean m, and d drawn again with the learned scatter.
    """

    def __init__(self, cfg: FullStateConfig) -> None:
        # Half the difference of two draws has the same variance as their mean.
        expected = (cfg.slip_mean, cfg.slip_sigma), (0.0, 0.5 * cfg.slip_difference_sigma)
        self._slip_scatter = SlipPopulation(expected, cfg.slip_scatter_max)
        self._means = np.array((cfg.slip_mean, 0.0, 0.0, 0.0))
        sigmas = cfg.slip_sigma, cfg.slip_difference_sigma, cfg.creep_sigma, cfg.turn_creep_sigma_m_rad
        self._variances = np.square(sigmas)
        self._creep_shares = cfg.creep_scatter_share**2, cfg.turn_creep_scatter_share**2
        self._wander = cfg.wander_fraction**2 / cfg.wander_time_s
        self._scatters = self._learned()
        self._is_open = False
        self._wandered = 0.0  # variance of the mean slip's wander in this leg, as a part of the scatter

    def _learned(self) -> LegScatter:
        slip, squares = self._slip_scatter.scatter, np.square(self._means[2:]) + self._variances[2:]
        creep, turn_creep = (self._creep_shares * squares).tolist()
        return LegScatter(slip, _DIFFERENCE * slip, creep, turn_creep)

    def _open(self) -> None:
        self._is_open = True
        self._wandered = 0.0
        self._prior = self._means, self._variances + self._scatters

    @property
    def scatter(self) -> tuple[float, float]:
        """Learned standard deviations of the mean slip and of the creep from leg to leg."""
        return self._scatters.slip**0.5, self._scatters.creep**0.5

    def first(self) -> tuple[FloatArray, FloatArray]:
        """Prior of (right slip, left slip, creeps) before the first leg: mean (4,), covariance (4, 4)."""
        self._open()
        means, variances = self._prior
        return _STATES.dot(means), (_STATES * variances).dot(_STATES.T)

    def begin(self, mean: FloatArray, covariance: FloatArray) -> LegTransition:
        """Begin a leg from the state at the end of the last one, mean (n,) and covariance (n, n)."""
        found, known = _parameters_of(mean, covariance)
        # The gain with which a leg updates m is beta; ``own`` is the variance of m that remains.
        before, self._scatters = self._scatters, self._learned()
        beta = self._variances / (self._variances + before)
        own = self._variances * (1.0 - beta)
        self._means = self._means + beta * (found - self._means)
        self._variances = own + beta * beta * known
        self._open()
        F, Q = (_STATES * beta).dot(_PARAMETERS), (_STATES * (own + self._scatters)).dot(_STATES.T)
        return LegTransition(F, _STATES.dot(self._means) - F.dot(mean[SLIPS]), Q)

    def wander(self, dt_s: float) -> SlipWander:
        """How slip and creep wander in a step of ``dt_s`` within the leg."""
        per_step = self._wander * dt_s
        self._wandered += per_step
        scatter = self._scatters
        return SlipWander(2.0 * per_step * scatter.slip, per_step * scatter.creep, per_step * scatter.turn_creep)

    def end(self, mean: FloatArray, covariance: FloatArray) -> None:
        """End the leg at a fix: learn the scatter from the state after it, (n,) and (n, n)."""
        if not self._is_open:
            return
        self._is_open = False
        found, known = (values.tolist() for values in _parameters_of(mean, covariance))
        means, variances = (values.tolist() for values in self._prior)
        wander = self._wandered * self._scatters.slip
        alone: list[tuple[float, float] | None] = []
        for k, (scale, weight) in enumerate(((1.0, 1.0), (0.5, _DIFFERENCE))):
            before = variances[k] + weight * wander
            if not 0.0 < known[k] < _TAUGHT * before:
                alone.append(None)
                continue
            # The Gaussian posterior divided by the prior is the likelihood of the leg alone.
            information = 1.0 / known[k] - 1.0 / before
            value = (found[k] / known[k] - means[k] / before) / information
            alone.append((scale * value, scale * scale * (1.0 / information)))
        if any(alone):
            self._slip_scatter.learn(alone, 1.0 + self._wandered)

    def forget_leg(self) -> None:
        """Drop the leg, whose measurements are not trusted."""
        self._is_open = False
