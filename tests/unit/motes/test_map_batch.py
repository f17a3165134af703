"""Model and fit of a map: derivatives by differences, recovery, robustness, covariance against many runs."""

import numpy as np
import pytest

from ccatp.beacons.cricket.map_fit import MapFitSettings, MapModel, fit_map, position_covariance
from ccatp.beacons.cricket.range_network import RigidBody
from ccatp.filters.metrics import aligned_rms_m, best_motion
from tests.unit.motes.fields import ALL, HEADS, SIGMA_M, FloatArray, near_pairs, network_of

PLAIN = MapFitSettings()


def field_3d(rng: np.random.Generator) -> FloatArray:
    return np.asarray(rng.uniform(-2.0, 2.0, (9, 3)))


@pytest.mark.parametrize("dimension", [2, 3])
def test_derivatives_of_everything(dimension: int) -> None:
    rng = np.random.default_rng(1)
    places = rng.uniform(-2.0, 2.0, (9, dimension))
    local = rng.normal(size=(3, dimension))
    bodies = [RigidBody("a", (1, 2, 3), local), RigidBody("b", (4, 5, 6), local)]
    known = np.full((9, dimension), np.nan)
    known[0], known[7, 0] = 0.5, -1.0
    model = MapModel(
        network_of(places, near_pairs(places, 9.0), rng, bodies=bodies, known_m=known),
        with_offset=True,
        with_scale=True,
    )
    state = model.state(places, 0.1, 0.02)
    J = model.jacobian(state).toarray()
    assert J.shape == (36, model.size)
    # two loose motes less the known coordinates, two bodies, offset and scale
    assert model.size == 3 * dimension - (dimension + 1) + 2 * (dimension + dimension * (dimension - 1) // 2) + 2
    h = 1e-6
    for column in range(model.size):
        step = np.zeros(model.size)
        step[column] = h
        slope = (model.residuals(model.moved(state, -step)) - model.residuals(model.moved(state, step))) / (2.0 * h)
        assert J[:, column] == pytest.approx(slope, abs=1e-7)


def test_a_state_is_as_known_and_rigid() -> None:
    local = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]])
    known = np.full((6, 2), np.nan)
    known[0] = (3.0, 4.0)
    network = network_of(HEADS, ALL, bodies=[RigidBody("a", (3, 4, 5), local)], known_m=known)
    model = MapModel(network)
    state = model.moved(model.state(HEADS), np.full(model.size, 0.3))
    assert state.positions_m[0].tolist() == [3.0, 4.0]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        length = np.linalg.norm(state.positions_m[3 + a] - state.positions_m[3 + b])
        assert length == pytest.approx(np.linalg.norm(local[a] - local[b]))
    assert np.linalg.det(state.rotations[0]) == pytest.approx(1.0)


def test_exact_ranges_give_the_exact_map_in_space() -> None:
    rng = np.random.default_rng(2)
    places = field_3d(rng)
    model = MapModel(network_of(places, near_pairs(places, 9.0)))
    fit = fit_map(model, model.state(places + rng.normal(0.0, 0.2, places.shape)), PLAIN)
    assert fit.is_at_rest
    assert aligned_rms_m(fit.state.positions_m, places) < 1e-7


def test_offset_and_scale_with_known_places() -> None:
    known = np.full((6, 2), np.nan)
    known[:3] = HEADS[:3]
    network = network_of(HEADS, ALL, known_m=known, offset_m=0.12, scale=1.03)
    model = MapModel(network, with_offset=True, with_scale=True)
    fit = fit_map(model, model.state(HEADS + 0.1), PLAIN)
    assert (fit.state.offset_m, fit.state.scale) == pytest.approx((0.12, 0.03), abs=1e-6)
    assert fit.state.positions_m == pytest.approx(HEADS, abs=1e-6)


def test_one_wrong_range_moves_a_robust_map_little() -> None:
    network = network_of(HEADS, ALL * 3)
    network.ranges_m[7] += 0.7
    model = MapModel(network)
    plain = fit_map(model, model.state(HEADS), PLAIN)
    robust = fit_map(model, model.state(HEADS), MapFitSettings(robust_scale=3.0))
    assert aligned_rms_m(plain.state.positions_m, HEADS) > 0.02
    assert aligned_rms_m(robust.state.positions_m, HEADS) < 0.001
    assert robust.weights[7] < 0.01
    assert np.delete(robust.weights, 7).min() > 0.9


def test_too_few_steps_are_told() -> None:
    model = MapModel(network_of(HEADS, ALL))
    fit = fit_map(
        model, model.state(HEADS + np.random.default_rng(1).normal(size=(6, 2))), MapFitSettings(max_iterations=2)
    )
    assert not fit.is_at_rest
    assert fit.iterations == 2


def test_sparse_and_dense_steps_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    places = rng.uniform(0.0, 10.0, (30, 2))
    model = MapModel(network_of(places, near_pairs(places, 5.0), rng))
    dense = fit_map(model, model.state(places), PLAIN)
    monkeypatch.setattr("ccatp.beacons.cricket.map_fit._DENSE", 0)
    sparse = fit_map(model, model.state(places), PLAIN)
    assert sparse.cost == pytest.approx(dense.cost, rel=1e-9)
    assert sparse.state.positions_m == pytest.approx(dense.state.positions_m, abs=1e-6)


def test_the_covariance_is_that_of_many_runs() -> None:
    rng = np.random.default_rng(4)
    errors, free = [], 0
    covariance = np.zeros((12, 12))
    for _ in range(400):
        model = MapModel(network_of(HEADS, ALL, rng))
        fit = fit_map(model, model.state(HEADS), PLAIN)
        found = fit.state.positions_m
        errors.append((best_motion(found, HEADS).moved(found) - HEADS).ravel())
        covariance, free = position_covariance(model, fit)
    assert free == 3
    sample = np.cov(np.array(errors).T)
    # 400 runs: a variance is known to 7 %
    assert sample.diagonal() == pytest.approx(covariance.diagonal(), rel=0.3)
    assert np.trace(sample) == pytest.approx(np.trace(covariance), rel=0.08)


def test_known_places_pin_the_covariance() -> None:
    known = np.full((6, 2), np.nan)
    known[0], known[1, 1] = HEADS[0], HEADS[1, 1]
    model = MapModel(network_of(HEADS, ALL, known_m=known))
    fit = fit_map(model, model.state(HEADS), PLAIN)
    covariance, free = position_covariance(model, fit)
    assert free == 0
    assert covariance[:2, :2] == pytest.approx(np.zeros((2, 2)))
    # across the field the frame's error shows: 7 m from N1, where N2's y of 5 m away holds it
    assert np.sqrt(covariance[11, 11]) > SIGMA_M / 2.0
