"""Maps among wrong ranges: consensus, the robust minimum, the honest sigma, and what contradicts a map."""

import numpy as np
import pytest
from scipy.special import ndtri

from ccatp.beacons.cricket.flip_search import residual_scale, scaled, searched
from ccatp.beacons.cricket.map_fit import MapFitSettings, MapModel, fit_from_afar, fit_map
from ccatp.beacons.cricket.map_start import grown
from ccatp.beacons.cricket.mote_map import map_motes
from ccatp.beacons.cricket.range_network import PairMeans, RangeNetwork
from ccatp.beacons.cricket.unfolding import agreement_of
from ccatp.filters.metrics import aligned_rms_m
from tests.unit.motes.fields import SIGMA_M, FloatArray, near_pairs, network_of

ROBUST = MapFitSettings(robust_scale=4.0)
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
    means = PairMeans(network)
    errors = []
    for draw in range(6):
        found = grown(9, means.pairs, means.ranges_m, means.sigmas_m, dimension, 4.0, np.random.default_rng(draw))
        assert found is not None
        errors.append(aligned_rms_m(found, places, mirrors=True))
    assert np.median(errors) < 0.1


def test_nothing_grows_without_a_triangle() -> None:
    places = np.random.default_rng(1).uniform(0.0, 8.0, (6, 2))
    means = PairMeans(network_of(places, [(i, j) for i in range(3) for j in range(3, 6)]))
    assert grown(6, means.pairs, means.ranges_m, means.sigmas_m, 2, 4.0, np.random.default_rng(0)) is None


def test_a_mote_of_too_few_ranges_stays_out() -> None:
    places = np.random.default_rng(1).uniform(0.0, 8.0, (6, 2))
    pairs = [pair for pair in near_pairs(places, ALL_HEAR) if 5 not in pair]
    means = PairMeans(network_of(places, [*pairs, (0, 5)]))
    found = grown(6, means.pairs, means.ranges_m, means.sigmas_m, 2, 4.0, np.random.default_rng(0))
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
        found, is_settled = searched(model, afar, ROBUST)
        assert found.cost <= best * (1.0 + 1e-6)
        assert is_settled
    assert astray > 0


@pytest.mark.parametrize("finds_sigma", [False, True])
def test_a_tenth_of_the_ranges_may_be_wrong(finds_sigma: bool) -> None:
    network, places, rows = wrong(11, 10, 5)
    found = map_motes(network, ROBUST, finds_sigma=finds_sigma)
    assert aligned_rms_m(found.positions_m, places, mirrors=True) < 0.01
    assert found.agreement.outlying == tuple(rows)
    assert not found.agreement.is_denied
    assert found.sigma_m == pytest.approx(SIGMA_M, rel=0.5)


def test_the_same_ranges_give_the_same_map() -> None:
    network, _, _ = wrong(3, 7, 2)
    first, again = map_motes(network, ROBUST), map_motes(network, ROBUST)
    assert (first.positions_m == again.positions_m).all()


@pytest.mark.parametrize("given", [0.2, 1.0, 5.0])
def test_the_scale_of_sound_residuals(given: float) -> None:
    """Whatever the sigmas were taken for; 8 sets of 45 ranges tell it to a few hundredths on the average."""
    scales = []
    for seed in range(8):
        network, places, _ = wrong(seed, 10, 0)
        network.sigmas_m[:] = given * SIGMA_M
        model = MapModel(network)
        scales.append(scaled(model, fit_map(model, model.state(places), ROBUST), ROBUST).factor)
    assert np.mean(scales) == pytest.approx(1.0 / given, rel=0.15)


def test_the_scale_takes_no_comfort_in_residuals_that_a_fit_makes_nought() -> None:
    """Of 45 residuals 20 are nought by the unknowns alone: the median of all would be a quarter of theirs."""
    network, places, _ = wrong(1, 10, 0)
    model = MapModel(network)
    fit = fit_map(model, model.state(places), ROBUST)
    shares = (np.arange(25) + 0.5) / 25
    residuals = np.concatenate([np.zeros(20), SIGMA_M * ndtri(0.5 + 0.5 * shares)])
    assert residual_scale(model, fit._replace(residuals_m=residuals)) > 0.8


def test_ranges_that_fit_no_map_deny_it() -> None:
    rng = np.random.default_rng(5)
    network, _, _ = wrong(5, 6, 0)
    network.ranges_m[:] = rng.uniform(1.0, 9.0, len(network.ranges_m))
    assert map_motes(network, ROBUST).agreement.is_denied


def test_what_denies_a_map() -> None:
    network, places, rows = wrong(2, 8, 3)
    model = MapModel(network)
    fit = fit_map(model, model.state(places), ROBUST)
    dof = len(network.ranges_m) - 13
    sound = agreement_of(fit, network.sigmas_m, dof)
    assert (sound.outlying, sound.outliers, sound.is_denied) == (tuple(rows), 3, False)
    assert sound.factor == pytest.approx(1.0, abs=0.8)
    assert agreement_of(fit, 0.5 * network.sigmas_m, dof).factor == pytest.approx(4.0 * sound.factor)
    assert agreement_of(fit, 0.3 * network.sigmas_m, dof).is_denied
    assert agreement_of(fit, network.sigmas_m, 5).is_denied  # three of five to spare
    assert not agreement_of(fit._replace(weights=np.ones(28)), 1e3 * network.sigmas_m, 0).is_denied
