"""EkfSlam against a dense textbook filter, written here: full matrices, an inverse, Joseph's form."""

import numpy as np
import pytest

from ccatp.core import FloatArray
from ccatp.filters.base import FilterDiverged, FilterShapeError
from ccatp.filters.ekf_slam import BlockError, EkfSlam, columns_of


class Dense:
    """x and P of everything, each step by full matrices."""

    def __init__(self, x: FloatArray, P: FloatArray) -> None:
        self.x, self.P = x.copy(), P.copy()

    def predict(self, vehicle: FloatArray, F: FloatArray, Q: FloatArray) -> None:
        v, n = vehicle.size, self.x.size
        whole, noise = np.eye(n), np.zeros((n, n))
        whole[:v, :v], noise[:v, :v] = F, Q
        self.x[:v] = vehicle
        self.P = whole @ self.P @ whole.T + noise

    def update(self, H: FloatArray, nu: FloatArray, R: FloatArray) -> float:
        S = H @ self.P @ H.T + R
        K = self.P @ H.T @ np.linalg.inv(S)
        rest = np.eye(self.x.size) - K @ H
        self.x = self.x + K @ nu
        self.P = rest @ self.P @ rest.T + K @ R @ K.T
        return float(nu @ np.linalg.inv(S) @ nu)

    def augment(self, mean: FloatArray, J: FloatArray, Jz: FloatArray, R: FloatArray) -> None:
        across = J @ self.P
        own = J @ self.P @ J.T + Jz @ R @ Jz.T
        self.P = np.block([[self.P, across.T], [across, own]])
        self.x = np.concatenate([self.x, mean])

    def remove(self, place: slice) -> None:
        keep = np.r_[0 : place.start, place.stop : self.x.size]
        self.x, self.P = self.x[keep], self.P[np.ix_(keep, keep)]


def spread(rng: np.random.Generator, n: int) -> FloatArray:
    root = rng.normal(size=(n, n))
    P: FloatArray = root @ root.T / n + 0.1 * np.eye(n)
    return P


def a_pair(rng: np.random.Generator) -> tuple[EkfSlam, Dense]:
    x, P = rng.normal(size=4), spread(rng, 4)
    c, C = rng.normal(size=2), spread(rng, 2)
    whole = np.zeros((6, 6))
    whole[:4, :4], whole[4:, 4:] = P, C
    return EkfSlam(x, P, c, C), Dense(np.concatenate([x, c]), whole)


def check_same(ours: EkfSlam, dense: Dense) -> None:
    assert ours.mean == pytest.approx(dense.x, abs=1e-9)
    assert ours.covariance == pytest.approx(dense.P, abs=1e-9)
    assert np.array_equal(ours.covariance, ours.covariance.T)


@pytest.mark.parametrize("seed", range(4))
def test_a_run_of_everything_equals_the_dense_filter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ours, dense = a_pair(rng)
    names: list[int] = []
    for k in range(60):
        F, Q, new = np.eye(4) + 0.3 * rng.normal(size=(4, 4)), spread(rng, 4), rng.normal(size=4)
        ours.predict(new, F, Q)
        dense.predict(new, F, Q)
        if k % 5 == 0:
            b = int(rng.integers(1, 4))
            columns = np.sort(rng.choice(ours.size, 3, replace=False))
            J, Jz, R, mean = rng.normal(size=(b, 3)), rng.normal(size=(b, 2)), spread(rng, 2), rng.normal(size=b)
            whole = np.zeros((b, ours.size))
            whole[:, columns] = J
            dense.augment(mean, whole, Jz, R)
            ours.augment(k, mean, columns, J, Jz, R)
            names.append(k)
        block = ours.block(names[int(rng.integers(len(names)))])
        columns = columns_of(range(3), slice(4, 6), block)
        m = 1 if k % 2 else int(rng.integers(1, 4))
        H, nu, R = rng.normal(size=(m, columns.size)), rng.normal(size=m), spread(rng, m)
        whole = np.zeros((m, ours.size))
        whole[:, columns] = H
        expected = dense.update(whole, nu, R)
        if m == 1 and k % 4 == 1:
            nis = ours.update_row(columns, H[0], float(nu[0]), float(R[0, 0])).nis
        else:
            nis = ours.update(columns, H, nu, R).nis
        assert nis == pytest.approx(expected, rel=1e-9)
        if k % 11 == 10:
            gone = names.pop(int(rng.integers(len(names))))
            dense.remove(ours.block(gone))
            ours.remove(gone)
        check_same(ours, dense)


def test_prediction_is_f_p_ft_and_reaches_the_map() -> None:
    """Fails on F^T P F, and where the cross-covariance with beacons stays behind."""
    rng = np.random.default_rng(5)
    ours, _ = a_pair(rng)
    ours.augment("b", np.zeros(2), np.arange(2), np.eye(2))
    before, F = ours.covariance.copy(), np.array([[1.0, 0, -3, 0], [0, 1, 2, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]])
    ours.predict(np.zeros(4), F, np.eye(4))
    assert ours.covariance[:4, :4] == pytest.approx(F @ before[:4, :4] @ F.T + np.eye(4))
    assert ours.covariance[:4, :4] != pytest.approx(F.T @ before[:4, :4] @ F + np.eye(4))
    assert ours.covariance[:4, 6:] == pytest.approx(F @ before[:4, 6:])
    assert ours.covariance[6:, :4] == pytest.approx((F @ before[:4, 6:]).T)
    assert ours.covariance[4:, 4:] == pytest.approx(before[4:, 4:])


@pytest.mark.parametrize("as_row", [True, False])
def test_a_reading_far_more_exact_than_the_state_leaves_a_covariance(as_row: bool) -> None:
    """P - K S K^T would leave rounding of the prior, 1e-4, where 1e-10 is right."""
    ours = EkfSlam(np.zeros(2), np.diag((3.7e12, 1.0)))
    columns, h = np.arange(2), np.array((1.1, 0.7))
    if as_row:
        ours.update_row(columns, h, 3.0, 1e-10)
    else:
        ours.update(columns, h[None, :], np.array((3.0,)), np.array((1e-10,)))
    assert np.linalg.eigvalsh(ours.covariance)[0] > 0.0
    assert ours.covariance[1, 1] == pytest.approx(1.0)
    assert ours.covariance[0, 0] == pytest.approx((0.7 / 1.1) ** 2, rel=1e-3)


def test_iterated_update_comes_to_rest_at_the_most_likely_state() -> None:
    ours = EkfSlam(np.array((3.0, 1.0)), np.diag((4.0, 4.0)))
    z, R = np.array((5.0, 0.2)), np.array((0.01, 0.001))

    def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        r = float(np.hypot(*x))
        value = np.array((r, np.arctan2(x[1], x[0])))
        return z - value, np.array(((x[0] / r, x[1] / r), (-x[1] / r**2, x[0] / r**2)))

    ours.update_iterated(np.arange(2), linearise, R, 20)
    residual, H = linearise(ours.mean)
    slope = H.T @ (residual / R) - (ours.mean - (3.0, 1.0)) / 4.0
    assert slope == pytest.approx(np.zeros(2), abs=1e-2)  # of terms of about 50
    assert ours.covariance == pytest.approx(np.linalg.inv(H.T @ np.diag(1.0 / R) @ H + np.eye(2) / 4.0), rel=1e-3)


def test_the_gate_leaves_the_state_and_the_knee_weighs_less() -> None:
    columns, h = np.arange(1), np.ones(1)
    refused = EkfSlam(np.zeros(1), np.eye(1))
    found = refused.update_row(columns, h, 10.0, 1.0, gate=9.0)
    assert (found.accepted, found.nis, refused.mean[0], refused.covariance[0, 0]) == (False, 50.0, 0.0, 1.0)
    robust = EkfSlam(np.zeros(1), np.eye(1))
    found = robust.update_row(columns, h, 10.0, 1.0, knee=2.0)
    larger = 2.0 * np.sqrt(50.0) / 2.0  # S, as large as makes its weight that of an innovation at the knee
    assert found.nis == pytest.approx(100.0 / larger)
    assert found.spread == 2.0
    assert robust.mean[0] == pytest.approx(10.0 / larger)
    refused.update(columns, h[None, :], np.array((10.0,)), np.ones(1), gate=9.0)
    assert refused.mean[0] == 0.0


def test_a_state_that_forgets() -> None:
    ours = EkfSlam(np.array((1.0, 2.0)), np.array(((1.0, 0.5), (0.5, 2.0))))
    ours.relax(1, 0.5, 0.75)
    assert ours.mean == pytest.approx((1.0, 1.0))
    assert ours.covariance == pytest.approx(np.array(((1.0, 0.25), (0.25, 0.5 + 0.75))))


def test_refusals() -> None:
    ours = EkfSlam(np.zeros(3), np.eye(3))
    with pytest.raises(FilterShapeError, match=r"F has shape \(2, 2\)"):
        ours.predict(np.zeros(3), np.eye(2), np.eye(3))
    with pytest.raises(FilterDiverged, match="prediction is not finite"):
        ours.predict(np.full(3, np.nan), np.eye(3), np.eye(3))
    with pytest.raises(FilterShapeError, match="H has shape"):
        ours.update(np.arange(3), np.ones((1, 2)), np.zeros(1), np.ones(1))
    with pytest.raises(FilterShapeError, match="R has shape"):
        ours.update(np.arange(3), np.ones((1, 3)), np.zeros(1), np.ones(2))
    with pytest.raises(FilterDiverged, match="update is not finite"):
        ours.update(np.arange(3), np.ones((1, 3)), np.full(1, np.inf), np.ones(1))
    with pytest.raises(FilterDiverged, match="not positive definite"):
        ours.update(np.arange(3), np.ones((1, 3)), np.zeros(1), np.full(1, -9.0))
    with pytest.raises(FilterDiverged, match="update is not finite"):
        ours.update_row(np.arange(3), np.ones(3), 0.0, -1.0)
    with pytest.raises(FilterShapeError, match="J_state has shape"):
        ours.augment("b", np.zeros(2), np.arange(3), np.zeros((2, 2)))
    with pytest.raises(FilterShapeError, match="J_z has shape"):
        ours.augment("b", np.zeros(2), np.arange(3), np.zeros((2, 3)), np.eye(2), np.eye(3))
    with pytest.raises(FilterDiverged, match="block 'b' is not finite"):
        ours.augment("b", np.full(2, np.nan), np.arange(3), np.zeros((2, 3)))
    ours.augment("b", np.zeros(2), np.arange(3), np.zeros((2, 3)))
    with pytest.raises(BlockError, match="block 'b' is in the state already"):
        ours.augment("b", np.zeros(2), np.arange(3), np.zeros((2, 3)))
    with pytest.raises(BlockError, match="block 'c' is not in the state"):
        ours.remove("c")
    assert "b" in ours
    assert ours.blocks == ("b",)
