"""The whole batch: the 45 ranges of the paper, offsets, known places, hundreds of motes, bound and frame."""

import numpy as np
import pytest
from scipy.special import ndtri

from ccatp.beacons.cricket.map_fit import (
    MapFitSettings,
    MapModel,
    agreement_of,
    bound_rms_m,
    fit_from_afar,
    fit_map,
    position_covariance,
)
from ccatp.beacons.cricket.map_start import classical_scaling, completed, grown, unfolded
from ccatp.beacons.cricket.mote_map import map_motes, pinned_map, plain_frame, residual_scale, scaled, unfold
from ccatp.beacons.cricket.range_network import RangeNetwork, RigidBody, components
from ccatp.beacons.cricket.rigidity import find_fold_over
from ccatp.beacons.rigid_motion import aligned_rms_m, best_motion
from tests.support.cases import slow_case
from tests.unit.beacons.cricket.fields import (
    ALL,
    FORTY_FIVE,
    HEADS,
    SIGMA_M,
    STAND,
    STANDS,
    FloatArray,
    near_pairs,
    network_of,
)

ROBUST = MapFitSettings(robust_scale=4.0)
BODIES = [RigidBody(f"N{number}", tuple(range(3 * number, 3 * number + 3)), STAND) for number in range(6)]


def stands(rng: np.random.Generator, repeats: int) -> RangeNetwork:
    return network_of(STANDS, FORTY_FIVE, rng, sigma_m=SIGMA_M / np.sqrt(repeats), bodies=BODIES)


@pytest.mark.parametrize(("repeats", "limit_m"), [(1, 0.050), (60, 0.010)])
def test_the_papers_own_ranges(repeats: int, limit_m: float) -> None:
    """The best map is as good as published ranges allow; that it is found from nothing is the next test."""
    rng, errors = np.random.default_rng(1), []
    for _ in range(50):
        model = MapModel(stands(rng, repeats))
        errors.append(aligned_rms_m(fit_map(model, model.state(STANDS), ROBUST).state.positions_m, STANDS))
    assert np.median(errors) < limit_m
    bound = bound_rms_m(MapModel(stands(rng, repeats)), STANDS, range(18), aligned=True)
    assert bound is not None
    assert np.sqrt(np.mean(np.square(errors))) < 1.3 * bound


# With less noise the same ways lead to it.
@pytest.mark.parametrize("repeats", [1, pytest.param(60, marks=pytest.mark.slow)])
def test_the_best_map_is_found_from_nothing(repeats: int) -> None:
    for seed in range(2):
        network = stands(np.random.default_rng(seed), repeats)
        model = MapModel(network)
        best = fit_map(model, model.state(STANDS), ROBUST)
        assert map_motes(network, ROBUST).fit.cost <= best.cost * (1.0 + 1e-6)


def test_a_common_offset() -> None:
    rng = np.random.default_rng(3)
    heads = [(3 * i, 3 * j) for i, j in ALL]  # ranges of other lengths than those between neighbours
    network = network_of(STANDS, FORTY_FIVE + heads, rng, sigma_m=1e-3, bodies=BODIES, offset_m=0.12)
    without, found = map_motes(network, ROBUST), map_motes(network, ROBUST, with_offset=True)
    assert found.fit.state.offset_m == pytest.approx(0.12, abs=0.005)
    assert aligned_rms_m(found.positions_m, STANDS) < 0.2 * aligned_rms_m(without.positions_m, STANDS)


def test_known_motes_give_frame_and_side() -> None:
    known = np.full((6, 2), np.nan)
    known[:3] = HEADS[:3]
    found = map_motes(network_of(HEADS, ALL, np.random.default_rng(5), known_m=known), ROBUST)
    assert found.free == 0
    assert found.positions_m == pytest.approx(HEADS, abs=0.03)


def test_the_bound_in_closed_form() -> None:
    """A mote seen from three known ones at right angles and 45 degrees: C = sigma^2 (sum u u^T)^-1."""
    places = np.array([[0.0, 0.0], [-3.0, 0.0], [0.0, -4.0], [5.0, 5.0]])
    known = places.copy()
    known[0] = np.nan
    model = MapModel(network_of(places, [(0, 1), (0, 2), (0, 3)], known_m=known))
    information = np.array([[1.5, 0.5], [0.5, 1.5]]) / SIGMA_M**2
    wanted = np.sqrt(np.trace(np.linalg.inv(information)))
    assert bound_rms_m(model, places, [0], aligned=False) == pytest.approx(wanted)


def test_a_pinned_map_has_the_errors_of_its_frame() -> None:
    known = np.full((6, 2), np.nan)
    known[0], known[1, 1] = HEADS[0], HEADS[1, 1]
    rng, errors = np.random.default_rng(9), []
    moved, covariance = HEADS, np.zeros((12, 12))
    turn = np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
    for _ in range(200):
        model = MapModel(network_of(HEADS, ALL, rng))
        fit = fit_map(model, model.state(HEADS), MapFitSettings())
        found_m, free_covariance = fit.state.positions_m, position_covariance(model, fit)[0]
        motion = best_motion(found_m, HEADS)
        whole = np.kron(np.eye(6), turn @ motion.rotation)
        near = motion.moved(found_m) @ turn.T + 0.3  # not quite in the frame yet
        moved, covariance = pinned_map(near, whole @ free_covariance @ whole.T, known)
        errors.append((moved - HEADS).ravel())
    sample = np.cov(np.array(errors).T)
    assert moved[0] == pytest.approx(HEADS[0])
    assert moved[1, 1] == pytest.approx(HEADS[1, 1])
    free = np.flatnonzero(np.isnan(known.ravel()))
    assert np.sqrt(sample.diagonal()[free]) == pytest.approx(np.sqrt(covariance.diagonal()[free]), rel=0.2)


def test_a_frame_needs_three_coordinates() -> None:
    with pytest.raises(ValueError, match="4 known coordinates, wanted both of one mote and one of another"):
        pinned_map(HEADS, np.eye(12), np.where(np.arange(6)[:, None] < 2, HEADS, np.nan))


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_frame_of_the_maps_own(dimension: int) -> None:
    points = np.random.default_rng(1).normal(size=(5, dimension))
    moved = plain_frame(points).moved(points)
    assert moved[0] == pytest.approx(np.zeros(dimension))
    assert moved[1, 0] > 0.0
    assert moved[1, 1:] == pytest.approx(np.zeros(dimension - 1), abs=1e-12)
    assert moved[2, 1] > 0.0
    assert aligned_rms_m(moved, points, mirrors=True) < 1e-12


PLAIN = MapFitSettings()


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


def test_too_few_steps_are_reported() -> None:
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


ALL_HEAR = 1e3


def wrong(seed: int, count: int, outliers: int, dimension: int = 2) -> tuple[RangeNetwork, FloatArray, list[int]]:
    """All ranges of drawn motes, some of them 0.5 to 4 m too long."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0.0, 8.0, (count, dimension))
    network = network_of(places, near_pairs(places, ALL_HEAR), rng)
    rows = rng.choice(len(network.ranges_m), outliers, replace=False)
    network.ranges_m[rows] += rng.uniform(0.5, 4.0, outliers)
    return network, places, sorted(rows.tolist())


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_grown_map_is_not_bent(dimension: int) -> None:
    network, places, _ = wrong(1, 9, 4, dimension)
    errors = []
    for draw in range(6):
        found = grown(network, 4.0, np.random.default_rng(draw))
        assert found is not None
        errors.append(aligned_rms_m(found, places, mirrors=True))
    assert np.median(errors) < 0.1


def test_nothing_grows_without_a_triangle() -> None:
    places = np.random.default_rng(1).uniform(0.0, 8.0, (6, 2))
    network = network_of(places, [(i, j) for i in range(3) for j in range(3, 6)])
    assert grown(network, 4.0, np.random.default_rng(0)) is None


def test_a_mote_of_too_few_ranges_stays_out() -> None:
    places = np.random.default_rng(1).uniform(0.0, 8.0, (6, 2))
    pairs = [pair for pair in near_pairs(places, ALL_HEAR) if 5 not in pair]
    found = grown(network_of(places, [*pairs, (0, 5)]), 4.0, np.random.default_rng(0))
    assert found is not None
    assert np.isnan(found[5]).all()
    assert aligned_rms_m(found[:5], places[:5], mirrors=True) < 1e-9


def test_the_robust_minimum_is_found_where_least_squares_leads_astray() -> None:
    astray = 0
    for seed in range(6):
        network, places, _ = wrong(seed, 8, 4)
        model = MapModel(network)
        best = fit_map(model, model.state(places), ROBUST).cost
        afar = fit_from_afar(model, model.state(places), ROBUST)
        astray += afar.cost > best * (1.0 + 1e-6)
        assert map_motes(network, ROBUST).fit.cost <= best * (1.0 + 1e-6)
    assert astray > 0


@pytest.mark.parametrize("finds_sigma", [False, True])
def test_a_tenth_of_the_ranges_may_be_wrong(finds_sigma: bool) -> None:
    network, places, rows = wrong(11, 10, 5)
    found = map_motes(network, ROBUST, finds_sigma=finds_sigma)
    assert aligned_rms_m(found.positions_m, places, mirrors=True) < 0.01
    assert found.agreement.outlying == tuple(rows)
    assert not found.agreement.is_denied
    assert found.sigma_m == pytest.approx(SIGMA_M, rel=0.5)


@pytest.mark.parametrize("given", [0.2, 1.0, 5.0])
def test_the_scale_of_sound_residuals(given: float) -> None:
    """Whatever the sigmas were taken for; 8 sets of 45 ranges tell it to a few hundredths on the average."""
    scales = []
    for seed in range(8):
        network, places, _ = wrong(seed, 10, 0)
        network.sigmas_m[:] = given * SIGMA_M
        model = MapModel(network)
        _, at, _ = scaled(model, fit_map(model, model.state(places), ROBUST), ROBUST)
        scales.append(at.network.sigmas_m[0] / network.sigmas_m[0])
    assert np.mean(scales) == pytest.approx(1.0 / given, rel=0.15)


def test_the_scale_takes_no_comfort_in_residuals_that_a_fit_makes_nought() -> None:
    """Of 45 residuals 20 are nought by the unknowns alone: the median of all would be a quarter of theirs."""
    network, places, _ = wrong(1, 10, 0)
    model = MapModel(network)
    fit = fit_map(model, model.state(places), ROBUST)
    shares = (np.arange(25) + 0.5) / 25
    residuals = np.concatenate([np.zeros(20), SIGMA_M * ndtri(0.5 + 0.5 * shares)])
    assert residual_scale(model, fit._replace(residuals_m=residuals)) > 0.8


def test_what_denies_a_map() -> None:
    network, places, rows = wrong(2, 8, 3)
    model = MapModel(network)
    fit = fit_map(model, model.state(places), ROBUST)
    dof = len(network.ranges_m) - 13
    sound = agreement_of(fit, network.sigmas_m, dof)
    assert (sound.outlying, sound.is_denied) == (tuple(rows), False)
    assert sound.factor == pytest.approx(1.0, abs=0.8)
    assert agreement_of(fit, 0.5 * network.sigmas_m, dof).factor == pytest.approx(4.0 * sound.factor)
    assert agreement_of(fit, 0.3 * network.sigmas_m, dof).is_denied
    assert agreement_of(fit, network.sigmas_m, 5).is_denied  # three of five to spare
    assert not agreement_of(fit._replace(weights=np.ones(28)), 1e3 * network.sigmas_m, 0).is_denied


def drawn(count: int, dimension: int, neighbours: float, seed: int) -> tuple[FloatArray, list[tuple[int, int]]]:
    """Motes in a square or cube of reach 1 with about so many neighbours each."""
    unit = np.pi if dimension == 2 else 4.0 * np.pi / 3.0
    side = (unit * count / neighbours) ** (1.0 / dimension)
    places = np.random.default_rng(seed).uniform(0.0, side, (count, dimension))
    return places, near_pairs(places, 1.0)


def test_unfolding_finds_maps_that_plain_descent_folds() -> None:
    ends = []
    for seed in range(5):
        places, pairs = drawn(30, 3, 16.0, seed)
        if components(30, np.array(pairs)).max() > 0:
            continue
        network = network_of(places, pairs, sigma_m=1e-3)
        model = MapModel(network)
        plain, start = classical_scaling(completed(network), 3), unfolded(network)
        ends.append([fit_map(model, model.state(first), MapFitSettings()).cost < 1e-6 for first in (plain, start)])
    plain_found, found = np.sum(ends, axis=0)
    assert found > plain_found


@pytest.mark.parametrize(("count", "dimension", "neighbours"), [slow_case(200, 2, 14.0), (150, 3, 26.0)])
def test_many_motes_are_mapped(count: int, dimension: int, neighbours: float) -> None:
    places, pairs = drawn(count, dimension, neighbours, 9 - dimension)
    network = network_of(places, pairs, np.random.default_rng(0), sigma_m=1e-3)
    folds = find_fold_over(network, np.random.default_rng(0))
    found = map_motes(network, ROBUST, mirrors=folds.mirrors)
    lost = {mote for fold in found.folds for mote in fold.motes}
    sure = sorted(set(range(count)) - lost - {mote for _, motes in folds.mirrors for mote in motes})
    assert len(sure) > 0.95 * count
    assert found.variance_factor < 1.2  # four standard deviations of chi-squared with some 500 degrees of freedom
    bound = bound_rms_m(MapModel(network), places, sure, aligned=True)
    assert bound is not None
    assert aligned_rms_m(found.positions_m[sure], places[sure], mirrors=True) < 2.0 * bound  # one run


def test_a_single_mote_on_the_wrong_side_is_turned_over() -> None:
    places, pairs = drawn(25, 2, 13.0, 8)
    network = network_of(places, pairs, np.random.default_rng(1), sigma_m=1e-3)
    model = MapModel(network)
    right = fit_map(model, model.state(places), ROBUST)
    wrong = places.copy()
    mote = int(np.argmax(places[:, 0]))  # at the rim, with all its partners on one side
    partners = places[[b for pair in pairs for a, b in (pair, pair[::-1]) if a == mote]]
    centre, normal = partners.mean(axis=0), np.linalg.svd(partners - partners.mean(axis=0))[2][-1]
    wrong[mote] -= 2.0 * ((wrong[mote] - centre) @ normal) * normal
    folded = fit_map(model, model.state(wrong), ROBUST)
    assert folded.cost > 2.0 * right.cost
    mended, turned, _ = unfold(model, folded, ROBUST)
    assert turned >= 1
    assert mended.cost == pytest.approx(right.cost, rel=1e-6)


def test_a_mote_with_two_ranges_is_reported_as_uncertain() -> None:
    network = network_of(HEADS, [pair for pair in ALL if 5 not in pair] + [(3, 5), (4, 5)])
    model = MapModel(network)
    _, _, doubtful = unfold(model, fit_map(model, model.state(HEADS), ROBUST), ROBUST)
    assert [fold.motes for fold in doubtful] == [(5,)]
    assert doubtful[0].cost_gap == pytest.approx(0.0, abs=1e-6)
