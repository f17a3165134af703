"""The whole batch: the 45 ranges of the paper, offsets, known places, hundreds of motes, bound and frame."""

from dataclasses import replace

import numpy as np
import pytest

from ccatp.beacons.cricket.map_fit import MapFitSettings, MapModel, bound_rms_m, fit_map, position_covariance
from ccatp.beacons.cricket.mote_map import map_motes, pinned_map, plain_frame
from ccatp.beacons.cricket.range_network import RangeNetwork, RigidBody
from ccatp.beacons.cricket.rigidity import find_fold_over
from ccatp.filters.metrics import aligned_rms_m, best_motion
from tests.unit.motes.fields import (
    ADJACENT,
    ALL,
    FORTY_FIVE,
    HEADS,
    SIGMA_M,
    STAND,
    STANDS,
    ZIGZAG,
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
    for _ in range(100):
        model = MapModel(stands(rng, repeats))
        errors.append(aligned_rms_m(fit_map(model, model.state(STANDS), ROBUST).state.positions_m, STANDS))
    assert np.median(errors) < limit_m
    bound = bound_rms_m(MapModel(stands(rng, repeats)), STANDS, range(18), aligned=True)
    assert bound is not None
    assert np.sqrt(np.mean(np.square(errors))) < 1.3 * bound


@pytest.mark.parametrize("repeats", [1, 60])
def test_the_best_map_is_found_from_nothing(repeats: int) -> None:
    for seed in range(2):
        network = stands(np.random.default_rng(seed), repeats)
        model = MapModel(network)
        best = fit_map(model, model.state(STANDS), ROBUST)
        assert map_motes(network, ROBUST).cost <= best.cost * (1.0 + 1e-6)


@pytest.mark.slow
def test_without_shapes_it_is_found_mostly() -> None:
    """Six points seen from afar, no triangle of ranges: no start is near, the search for folds has to find the map."""
    found = 0
    for seed in range(4):
        network = replace(stands(np.random.default_rng(seed), 1), bodies=())
        model = MapModel(network)
        best = fit_map(model, model.state(STANDS), ROBUST)
        fit = map_motes(network, ROBUST)
        found += fit.cost <= best.cost * (1.0 + 1e-6)
        assert fit.cost <= best.cost * (1.0 + 1e-6) or fit.variance_factor > 2.0  # at least it shows
    assert found >= 3


def test_shapes_tell_the_map_from_its_mirror_image() -> None:
    found = map_motes(stands(np.random.default_rng(2), 60), ROBUST)
    assert aligned_rms_m(found.positions_m, STANDS, mirrors=False) < 0.02


def test_a_common_offset() -> None:
    rng = np.random.default_rng(3)
    heads = [(3 * i, 3 * j) for i, j in ALL]  # ranges of other lengths than those between neighbours
    network = network_of(STANDS, FORTY_FIVE + heads, rng, sigma_m=1e-3, bodies=BODIES, offset_m=0.12)
    without, found = map_motes(network, ROBUST), map_motes(network, ROBUST, with_offset=True)
    assert found.offset_m == pytest.approx(0.12, abs=0.005)
    assert aligned_rms_m(found.positions_m, STANDS) < 0.2 * aligned_rms_m(without.positions_m, STANDS)


def test_sigmas_that_are_guesses_are_found() -> None:
    network = network_of(HEADS, ALL * 6, np.random.default_rng(4))
    network.sigmas_m[:] = 1.0
    found = map_motes(network, ROBUST, finds_sigma=True)
    assert found.sigma_m == pytest.approx(SIGMA_M, rel=0.2)  # 90 ranges: 10 %
    assert aligned_rms_m(found.positions_m, HEADS, mirrors=True) < 0.01


def test_known_motes_give_frame_and_side() -> None:
    known = np.full((6, 2), np.nan)
    known[:3] = HEADS[:3]
    found = map_motes(network_of(HEADS, ALL, np.random.default_rng(5), known_m=known), ROBUST)
    assert found.free == 0
    assert found.positions_m == pytest.approx(HEADS, abs=0.03)


def test_two_hundred_motes_of_sparse_ranges() -> None:
    rng = np.random.default_rng(7)
    side_m = 5.5 * np.sqrt(np.pi * 200 / 14.0)
    places = rng.uniform(0.0, side_m, (200, 2))
    network = network_of(places, near_pairs(places, 5.5), rng)
    folds = find_fold_over(network, np.random.default_rng(0))
    found = map_motes(network, ROBUST, mirrors=folds.mirrors)
    lost = {mote for _, motes in folds.mirrors for mote in motes} | {
        mote for fold in found.folds for mote in fold.motes
    }
    sure = [mote for mote in range(200) if mote not in lost]
    assert len(sure) > 190
    assert found.variance_factor < 1.2
    bound = bound_rms_m(MapModel(network), places, sure, aligned=True)
    assert bound is not None
    assert aligned_rms_m(found.positions_m[sure], places[sure], mirrors=True) < 2.0 * bound  # one run


def test_a_network_in_space() -> None:
    rng = np.random.default_rng(8)
    places = rng.uniform(0.0, 6.0, (20, 3))
    network = network_of(places, near_pairs(places, 5.0), rng)
    found = map_motes(network, ROBUST)
    bound = bound_rms_m(MapModel(network), places, range(20), aligned=True)
    assert bound is not None
    assert aligned_rms_m(found.positions_m, places, mirrors=True) < 2.0 * bound


def test_the_bound_in_closed_form() -> None:
    """A mote seen from three known ones at right angles and 45 degrees: C = sigma^2 (sum u u^T)^-1."""
    places = np.array([[0.0, 0.0], [-3.0, 0.0], [0.0, -4.0], [5.0, 5.0]])
    known = places.copy()
    known[0] = np.nan
    model = MapModel(network_of(places, [(0, 1), (0, 2), (0, 3)], known_m=known))
    information = np.array([[1.5, 0.5], [0.5, 1.5]]) / SIGMA_M**2
    wanted = np.sqrt(np.trace(np.linalg.inv(information)))
    assert bound_rms_m(model, places, [0], aligned=False) == pytest.approx(wanted)


def test_no_bound_where_something_is_free() -> None:
    assert bound_rms_m(MapModel(network_of(HEADS, ZIGZAG)), HEADS, range(6), aligned=True) is None
    assert bound_rms_m(MapModel(network_of(HEADS, ADJACENT)), HEADS, range(6), aligned=True) is not None


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


def test_a_frame_wants_three_coordinates() -> None:
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
