"""Pure. Filters: consistent where the noise is as modelled, and right where quadrature tells the answer."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import chi2

from ccatp.core import FloatArray
from ccatp.filters import FILTERS
from ccatp.studies.smoother import Smoother

BOTH = pytest.mark.parametrize("name", ["ekf", "ukf"])
DT_S, SEEDS, STEPS = 0.1, 50, 60
BEACONS_M = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]])


class Turn:
    """A unicycle (x, y, heading, speed, rate), at constant speed and rate over a step."""

    def through(self, X: FloatArray) -> FloatArray:
        middle = X[:, 2] + 0.5 * DT_S * X[:, 4]
        out = X.copy()
        out[:, 0] += DT_S * X[:, 3] * np.cos(middle)
        out[:, 1] += DT_S * X[:, 3] * np.sin(middle)
        out[:, 2] += DT_S * X[:, 4]
        return out

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        middle = x[2] + 0.5 * DT_S * x[4]
        c, s = DT_S * np.cos(middle), DT_S * np.sin(middle)
        F = np.eye(5)
        F[0, 2:] = -x[3] * s, c, -0.5 * DT_S * x[3] * s
        F[1, 2:] = x[3] * c, s, 0.5 * DT_S * x[3] * c
        F[2, 4] = DT_S
        return self.through(x[None])[0], F


class Ranges:
    """Distances to the beacons, and the rate."""

    def through(self, X: FloatArray) -> FloatArray:
        away = X[:, None, :2] - BEACONS_M
        return np.hstack([np.sqrt((away**2).sum(axis=2)), X[:, 4:]])

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        H = np.zeros((4, 5))
        away = x[:2] - BEACONS_M
        H[:3, :2] = away / np.sqrt((away**2).sum(axis=1))[:, None]
        H[3, 4] = 1.0
        return self.through(x[None])[0], H


Q = np.diag([1e-8, 1e-8, 1e-8, 1e-4, 1e-3])
R = np.array([1e-4, 1e-4, 1e-4, 4e-4])
START, COVARIANCE = np.array([1.0, 1.2, 0.3, 0.4, 0.2]), np.diag([1e-3, 1e-3, 1e-3, 1e-3, 1e-2])
# Ten times the variance of heading and speed, and what a step bends passes its noise of 0.1 mm: the filters stay
# consistent, but the smoothed first state does not (NEES 6.7 in place of 5).


class Cube:
    """A strong bend in one dimension: x + x^3 / 10."""

    def through(self, X: FloatArray) -> FloatArray:
        return X + 0.1 * X**3

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.through(x), np.array([[1.0 + 0.3 * float(x[0]) ** 2]])


class Run(NamedTuple):
    """NEES and NIS of each step, NEES of each smoothed state."""

    nees: list[float]
    nis: list[float]
    smoothed: list[float]


def run(name: str, seed: int) -> Run:
    rng = np.random.default_rng(seed)
    x = START + np.sqrt(COVARIANCE.diagonal()) * rng.normal(size=5)
    truth, filter_, smoother = [x], FILTERS[name](START, COVARIANCE), Smoother(5)
    nees, nis = [], []
    for _ in range(STEPS):
        x = Turn().through(x[None])[0] + np.sqrt(Q.diagonal()) * rng.normal(size=5)
        truth.append(x)
        smoother.predict(filter_, Turn(), Q)
        z = Ranges().through(x[None])[0] + np.sqrt(R) * rng.normal(size=4)
        nis.append(filter_.update(z, Ranges(), R).nis)
        e = x - filter_.mean
        nees.append(float(e @ np.linalg.solve(filter_.covariance, e)))
    found = smoother.smooth(filter_)
    errors = [t - m for t, m in zip(truth, found.means, strict=True)]
    whole = [float(e @ np.linalg.solve(P, e)) for e, P in zip(errors, found.covariances, strict=True)]
    return Run(nees, nis, whole)


def band(freedom: int) -> tuple[float, float]:
    """The 95 % band of a chi-squared."""
    return float(chi2.ppf(0.025, freedom)), float(chi2.ppf(0.975, freedom))


@BOTH
def test_tracking_is_consistent(name: str) -> None:
    runs = [run(name, seed) for seed in range(SEEDS)]
    # Independent between seeds at any one step; within a run the innovations are white, so all NIS count.
    nis = sum(sum(r.nis) for r in runs)
    low, high = band(4 * STEPS * SEEDS)
    assert low < nis < high
    low, high = band(5 * SEEDS)
    for step in (19, 39, 59):
        assert low < sum(r.nees[step] for r in runs) < high, step
    for step in (0, 30):
        assert low < sum(r.smoothed[step] for r in runs) < high, step


def moments_by_quadrature(m: float, P: float, z: float, r: float, q: float) -> tuple[float, float, float, float]:
    """Mean and variance of f(x) + noise of variance q, and of x given f(x) + noise of variance r = z, on a grid."""
    x = np.linspace(m - 10.0 * np.sqrt(P), m + 10.0 * np.sqrt(P), 200_001)
    f = x + 0.1 * x**3
    w = np.exp(-0.5 * (x - m) ** 2 / P)
    w /= w.sum()
    ahead = float(w @ f)
    spread = float(w @ (f - ahead) ** 2) + q
    w *= np.exp(-0.5 * (z - f) ** 2 / r)
    w /= w.sum()
    mean = float(w @ x)
    return ahead, spread, mean, float(w @ (x - mean) ** 2)


@BOTH
@pytest.mark.parametrize("sigma", [0.02, 0.04])
def test_against_dense_quadrature(name: str, sigma: float) -> None:
    """Both filters leave out terms of the order of the bend: 0.3 sigma^2 of f against its slope of 1.3."""
    m, P, z, r, q = 1.0, sigma**2, 1.1 + 2.0 * sigma, (0.8 * sigma) ** 2, (0.3 * sigma) ** 2
    ahead, spread, mean, variance = moments_by_quadrature(m, P, z, r, q)
    bend = 0.3 * sigma / 1.3  # of the second order, in units of sigma
    filter_ = FILTERS[name](np.array([m]), np.array([[P]]))
    filter_.update(np.array([z]), Cube(), np.array([r]))
    assert abs(filter_.mean[0] - mean) < 2.0 * bend * np.sqrt(variance)
    assert filter_.covariance[0, 0] == pytest.approx(variance, rel=4.0 * bend)
    filter_.reset(np.array([m]), np.array([[P]]))
    filter_.predict(Cube(), np.array([[q]]))
    assert abs(filter_.mean[0] - ahead) < 2.0 * bend * np.sqrt(spread)
    assert filter_.covariance[0, 0] == pytest.approx(spread, rel=4.0 * bend)


def test_sigma_points_are_closer_than_the_tangent() -> None:
    ahead = moments_by_quadrature(1.0, 0.09, 1.2, 0.01, 0.0)[0]
    error = {}
    for name in ("ekf", "ukf"):
        filter_ = FILTERS[name](np.ones(1), np.array([[0.09]]))
        filter_.predict(Cube(), np.zeros((1, 1)))
        error[name] = abs(float(filter_.mean[0]) - ahead)
    assert error["ukf"] < 1e-6  # three points are exact for a cubic; what is left is the grid
    assert error["ekf"] == pytest.approx(0.3 * 0.09, rel=1e-6)  # E[0.1 x^3] - 0.1 m^3 = 0.3 m P


def test_jacobians_of_the_problem_are_its_differences() -> None:
    steps = 1e-6 * np.eye(5)
    for model in (Turn(), Ranges()):
        numeric = (model.through(START + steps) - model.through(START - steps)).T / 2e-6
        np.testing.assert_allclose(model.at(START)[1], numeric, atol=1e-8)  # rounding of 1e-16 over the step of 1e-6


class Linear:
    def __init__(self, A: FloatArray) -> None:
        self.A = A

    def through(self, X: FloatArray) -> FloatArray:
        image: FloatArray = X.dot(self.A.T)
        return image

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.A @ x, self.A


@BOTH
@pytest.mark.parametrize("count", [1, 2, 5, 6, 8, 23])
def test_a_model_that_is_linear_is_the_matrix(name: str, count: int) -> None:
    A, rng = np.array([[1.0, 0.3], [-0.2, 0.9]]), np.random.default_rng(count)
    H, z, R = rng.normal(size=(count, 2)), rng.normal(size=count), rng.uniform(0.2, 0.3, count)

    nis: list[float] = []
    model, matrix = (FILTERS[n](np.array([1.0, -2.0]), np.array([[2.0, 0.4], [0.4, 1.0]])) for n in (name, "kf"))
    for F, rows, filter_ in ((Linear(A), Linear(H), model), (A, H, matrix)):
        filter_.predict(F, 0.1 * np.eye(2))
        nis.append(filter_.update(z, rows, R).nis)
        nis.append(filter_.update(z, rows, np.diag(R)).nis)
    assert nis[:2] == pytest.approx(nis[2:], rel=1e-13)  # rounding
    np.testing.assert_allclose(model.mean, matrix.mean, rtol=1e-12, atol=1e-15)  # rounding of a prior of 2
    np.testing.assert_allclose(model.covariance, matrix.covariance, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(model.transition, A, rtol=1e-13)


# -- the linear filter on the thesis's four states --------------------------------------------------------------------

KF_STEPS, KF_DT_S = 40, 0.01
KF_F = np.eye(4)
KF_F[0, 1] = KF_F[2, 3] = KF_DT_S
IMPULSE = np.array([0.0, 1.0, 0.0, 2.0]) * np.sqrt(KF_DT_S)
KF_Q = KF_F @ np.diag(IMPULSE**2) @ KF_F.T
WHEELS = np.array([[33.0, 0.0, 0.0, 2.5], [33.0, 0.0, 0.0, -2.5]])
INERTIAL = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
KF_START = np.diag([1e-4, 1e-2, 1e-4, 1e-2])


def kf_rows(count: int) -> tuple[FloatArray, FloatArray]:
    """H and R of ``count`` samples of each wheel and one of the inertial unit; shipped noise."""
    H = np.vstack([np.repeat(WHEELS, count, axis=0), INERTIAL])
    return H, np.concatenate([np.full(2 * count, 1e-6), [3.5e-5, 7.6e-5]])


@pytest.mark.parametrize("count", [0, 1, 10])
def test_errors_and_innovations_are_as_large_as_said(count: int) -> None:
    H, R = kf_rows(count)
    nis, nees = 0.0, []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        x = np.sqrt(KF_START.diagonal()) * rng.normal(size=4)
        kf = FILTERS["kf"](np.zeros(4), KF_START)
        for _ in range(KF_STEPS):
            x = KF_F @ (x + IMPULSE * rng.normal(size=4))
            kf.predict(KF_F, KF_Q)
            nis += kf.update(H @ x + np.sqrt(R) * rng.normal(size=R.size), H, R).nis
        error = x - kf.mean
        nees.append(float(error @ np.linalg.solve(kf.covariance, error)))
    # The 95 % bands; innovations are white, so all of them count.
    assert chi2.ppf(0.025, R.size * KF_STEPS * SEEDS) < nis < chi2.ppf(0.975, R.size * KF_STEPS * SEEDS)
    assert chi2.ppf(0.025, 4 * SEEDS) < sum(nees) < chi2.ppf(0.975, 4 * SEEDS)
