"""Noise of the odometry, from what a solution by least squares leaves of it: variance components.

The noise of distance, of turning and of the lateral distance each have a factor f on the configured variance. With the
residuals e of the odometry, their covariance Q = sum f_i Q_i, and the covariance C of their estimates,

    s_i = sum e^T Q^-1 f_i Q_i Q^-1 e,    r_i = sum tr(Q^-1 f_i Q_i) - tr(Q^-1 C Q^-1 f_i Q_i),

f_i <- f_i s_i / r_i has its fixed point where the restricted likelihood is largest (Foerstner 1979; Patterson and
Thompson 1971). r_i, the redundancy, is the number of errors that the readings show: at intervals in which the vehicle
moves less than the readings tell, the residuals are small whatever the noise is, and count for as little. The prior of
each factor is an inverse gamma distribution that counts for ``ASSUMED`` such errors.
"""

from typing import NamedTuple

import numpy as np

from ccatp.beacons.config.models import OdometryNoiseConfig
from ccatp.beacons.estimation.batch_problem import BatchProblem
from ccatp.beacons.estimation.batch_unknowns import BatchState
from ccatp.beacons.estimation.least_squares import Factored
from ccatp.beacons.estimation.motion import POSE, scaled_noise
from ccatp.beacons.estimation.reckoning import CALIBRATION
from ccatp.core import FloatArray

ASSUMED = 10.0  # number of independent errors of odometry for which the configured noise counts
LEAST = 1e-3  # smallest factor
# Largest factor: errors of ranges that last (heights, an antenna off the vehicle's middle) look like motion, too, and
# then the path follows the readings. Without a limit such runs end at factors of 40 to 300 and a NEES above 40.
MOST = 2.0


class OdometryNoise(NamedTuple):
    """Factors on the configured variances of the odometry."""

    distance: float = 1.0
    turn: float = 1.0
    lateral: float = 1.0

    def of(self, configured: OdometryNoiseConfig) -> OdometryNoiseConfig:
        """The configured noise with these factors."""
        return scaled_noise(configured, self._asdict())


def odometry_noise(
    problem: BatchProblem, state: BatchState, factored: Factored, configured: OdometryNoiseConfig, noise: OdometryNoise,
    before: OdometryNoise,
) -> OdometryNoise:  # fmt: skip
    """One iteration of the factors. ``factored``: at the state.

    ``noise``: those of the problem. ``before``: as known without these data.
    """
    r = problem.residuals(state)
    W, by_steps = r.odometry_information, r.by_steps
    by_shared = np.zeros((len(W), POSE, problem.free.size))
    by_shared[:, :, : len(CALIBRATION)] = by_steps[:, :, 2 * POSE :]
    C = factored.step_covariances(by_steps[:, :, : 2 * POSE], by_shared[:, :, problem.free])
    We = np.einsum("kij,kj->ki", W, r.odometry)
    left = W - W @ C @ W
    calibration = state.shared[: len(CALIBRATION)]

    def covariances(factors: OdometryNoise) -> FloatArray:
        return problem.reckoning.increments(calibration, factors.of(configured))[2]

    nothing, found = OdometryNoise(0.0, 0.0, 0.0), []
    rest = covariances(nothing)  # what is not of these parts: guesses over gaps
    for (name, factor), known in zip(noise._asdict().items(), before, strict=True):
        Q = covariances(nothing._replace(**{name: factor})) - rest
        s, redundancy = float(np.einsum("ki,kij,kj->", We, Q, We)), float(np.einsum("kij,kji->", left, Q))
        found.append(float(np.clip((ASSUMED * known + s * factor) / (ASSUMED + redundancy), LEAST, MOST)))
    return OdometryNoise(*found)
