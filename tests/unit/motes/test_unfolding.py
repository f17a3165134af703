"""First maps: classical scaling, unfolding where plain descent folds, patches of many motes, repair, mirror images."""

import numpy as np
import pytest

from ccatp.beacons.cricket.flip_search import unfold
from ccatp.beacons.cricket.map_fit import MapFitSettings, MapModel, fit_map
from ccatp.beacons.cricket.map_start import stitched
from ccatp.beacons.cricket.range_network import PairMeans, components
from ccatp.beacons.cricket.unfolding import classical_scaling, completed, repaired, unfolded
from ccatp.filters.metrics import aligned_rms_m
from tests.unit.motes.fields import ALL, HEADS, FloatArray, near_pairs, network_of

SETTINGS = MapFitSettings(robust_scale=4.0)


def drawn(count: int, dimension: int, neighbours: float, seed: int) -> tuple[FloatArray, list[tuple[int, int]]]:
    """Motes in a square or cube of reach 1 with about so many neighbours each."""
    unit = np.pi if dimension == 2 else 4.0 * np.pi / 3.0
    side = (unit * count / neighbours) ** (1.0 / dimension)
    places = np.random.default_rng(seed).uniform(0.0, side, (count, dimension))
    return places, near_pairs(places, 1.0)


@pytest.mark.parametrize("dimension", [2, 3])
def test_classical_scaling_of_all_distances_is_exact(dimension: int) -> None:
    places = np.random.default_rng(1).normal(size=(8, dimension))
    table = np.linalg.norm(places[:, None] - places[None], axis=2)
    assert aligned_rms_m(classical_scaling(table, dimension), places, mirrors=True) < 1e-9


def test_missing_distances_go_the_shortest_way() -> None:
    table = completed(3, np.array([[0, 1], [1, 2]]), np.array([1.0, 2.0]))
    assert table[0, 2] == pytest.approx(3.0)


def test_unfolding_finds_maps_that_plain_descent_folds() -> None:
    ends = []
    for seed in range(12):
        places, pairs = drawn(30, 3, 16.0, seed)
        if components(30, np.array(pairs)).max() > 0:
            continue
        network = network_of(places, pairs, sigma_m=1e-3)
        means, model = PairMeans(network), MapModel(network)
        plain = classical_scaling(completed(30, means.pairs, means.ranges_m), 3)
        start = unfolded(30, means.pairs, means.ranges_m, means.sigmas_m, 3)
        ends.append([fit_map(model, model.state(first), MapFitSettings()).cost < 1e-6 for first in (plain, start)])
    plain_found, found = np.sum(ends, axis=0)
    assert found > plain_found


def test_places_may_be_drawn_instead() -> None:
    means = PairMeans(network_of(HEADS, ALL))
    places = unfolded(6, means.pairs, means.ranges_m, means.sigmas_m, 2, rng=np.random.default_rng(1))
    assert aligned_rms_m(places, HEADS, mirrors=True) < 1e-3


@pytest.mark.parametrize(("dimension", "neighbours"), [(2, 13.0), (3, 26.0)])
def test_patches_agree_on_one_map(dimension: int, neighbours: float) -> None:
    places, pairs = drawn(150, dimension, neighbours, 5)
    means = PairMeans(network_of(places, pairs, np.random.default_rng(0), sigma_m=1e-3))
    found = stitched(150, means, dimension)
    held = np.isfinite(found[:, 0])
    assert held.mean() > 0.9
    assert aligned_rms_m(found[held], places[held], mirrors=True) < 0.05  # a twentieth of the reach: the right basin


def test_no_patch_no_place() -> None:
    network = network_of(HEADS, [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)])
    assert np.isnan(stitched(6, PairMeans(network), 2)).all()


def test_a_single_mote_on_the_wrong_side_is_turned_over() -> None:
    places, pairs = drawn(25, 2, 13.0, 8)
    network = network_of(places, pairs, np.random.default_rng(1), sigma_m=1e-3)
    model = MapModel(network)
    right = fit_map(model, model.state(places), SETTINGS)
    wrong = places.copy()
    mote = int(np.argmax(places[:, 0]))  # at the rim, with all its partners on one side
    partners = places[[b for pair in pairs for a, b in (pair, pair[::-1]) if a == mote]]
    centre, normal = partners.mean(axis=0), np.linalg.svd(partners - partners.mean(axis=0))[2][-1]
    wrong[mote] -= 2.0 * ((wrong[mote] - centre) @ normal) * normal
    folded = fit_map(model, model.state(wrong), SETTINGS)
    assert folded.cost > 2.0 * right.cost
    mended = unfold(model, folded, SETTINGS)
    assert mended.turned >= 1
    assert mended.fit.cost == pytest.approx(right.cost, rel=1e-6)


def test_a_mote_that_two_ranges_hold_is_told_to_be_doubtful() -> None:
    network = network_of(HEADS, [pair for pair in ALL if 5 not in pair] + [(3, 5), (4, 5)])
    model = MapModel(network)
    found = unfold(model, fit_map(model, model.state(HEADS), SETTINGS), SETTINGS)
    assert [fold.motes for fold in found.doubtful] == [(5,)]
    assert found.doubtful[0].cost_gap == pytest.approx(0.0, abs=1e-6)


def test_a_place_that_is_folded_together_is_mapped_anew() -> None:
    places, pairs = drawn(60, 2, 14.0, 11)
    network = network_of(places, pairs, np.random.default_rng(2), sigma_m=1e-3)
    model = MapModel(network)
    right = fit_map(model, model.state(places), SETTINGS)
    wrong = places.copy()
    corner = np.argsort(places.sum(axis=1))[:5]  # five motes of a corner, mirrored together
    centre = wrong[corner].mean(axis=0) + 0.35
    along = np.array([1.0, -1.0]) / np.sqrt(2.0)
    offset = wrong[corner] - centre
    wrong[corner] = centre + 2.0 * np.outer(offset @ along, along) - offset
    folded = fit_map(model, model.state(wrong), SETTINGS)
    assert folded.cost > 1.5 * right.cost
    assert repaired(model, folded, SETTINGS).cost == pytest.approx(right.cost, rel=1e-6)


def test_a_good_map_is_left_alone() -> None:
    network = network_of(HEADS, ALL, np.random.default_rng(3))
    model = MapModel(network)
    fit = fit_map(model, model.state(HEADS), SETTINGS)
    assert repaired(model, fit, SETTINGS) is fit
    assert unfold(model, fit, SETTINGS).turned == 0
