"""Pure. The linear filter on the thesis's four states: consistent where the noise is as modelled."""

import numpy as np
import pytest
from scipy.stats import chi2

from ccatp.core import FloatArray
from ccatp.filters import FILTERS

SEEDS, STEPS, DT_S = 50, 40, 0.01
F = np.eye(4)
F[0, 1] = F[2, 3] = DT_S
IMPULSE = np.array([0.0, 1.0, 0.0, 2.0]) * np.sqrt(DT_S)
Q = F @ np.diag(IMPULSE**2) @ F.T
WHEELS = np.array([[33.0, 0.0, 0.0, 2.5], [33.0, 0.0, 0.0, -2.5]])
INERTIAL = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
START = np.diag([1e-4, 1e-2, 1e-4, 1e-2])


def rows(count: int) -> tuple[FloatArray, FloatArray]:
    """H and R of ``count`` samples of each wheel and one of the inertial unit; shipped noise."""
    H = np.vstack([np.repeat(WHEELS, count, axis=0), INERTIAL])
    return H, np.concatenate([np.full(2 * count, 1e-6), [3.5e-5, 7.6e-5]])


@pytest.mark.parametrize("count", [0, 1, 10])
def test_errors_and_innovations_are_as_large_as_said(count: int) -> None:
    H, R = rows(count)
    nis, nees = 0.0, []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        x = np.sqrt(START.diagonal()) * rng.normal(size=4)
        kf = FILTERS["kf"](np.zeros(4), START)
        for _ in range(STEPS):
            x = F @ (x + IMPULSE * rng.normal(size=4))
            kf.predict(F, Q)
            nis += kf.update(H @ x + np.sqrt(R) * rng.normal(size=R.size), H, R).nis
        error = x - kf.mean
        nees.append(float(error @ np.linalg.solve(kf.covariance, error)))
    # The 95 % bands; innovations are white, so all of them count.
    assert chi2.ppf(0.025, R.size * STEPS * SEEDS) < nis < chi2.ppf(0.975, R.size * STEPS * SEEDS)
    assert chi2.ppf(0.025, 4 * SEEDS) < sum(nees) < chi2.ppf(0.975, 4 * SEEDS)
