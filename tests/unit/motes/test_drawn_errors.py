"""Errors of a trilateration by drawing them: as by derivatives where these are small, and honest where they are not."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from ccatp.beacons.cricket.self_mapping import conditioned
from ccatp.beacons.cricket.trilateration import FirstMap, map_as_possible, map_by_plan
from ccatp.config.beacon_models import CricketConfig
from ccatp.config.load import load_radio_config
from ccatp.studies.mote_runs import first_map, run_filter, simulate_field
from tests.unit.motes.fields import near_pairs, network_of
from tests.unit.motes.test_trilateration import field_ranges

FloatArray = NDArray[np.float64]
DRAWS = 800


@pytest.fixture(scope="module")
def cfg() -> CricketConfig:
    return load_radio_config(None, {"system": "cricket"}).cricket


def nees(errors: FloatArray, covariance: FloatArray) -> tuple[float, int]:
    """Squared error in units of the covariance, and its degrees of freedom: what is known exactly does not count."""
    variances, axes = np.linalg.eigh(covariance)
    free = variances > 1e-14
    return float(((axes[:, free].T @ errors) ** 2 / variances[free]).sum()), int(free.sum())


class Consistency(NamedTuple):
    """Mean NEES for each degree of freedom, and how many there were."""

    mean: float
    dof: int

    def is_in_band(self, share: float) -> bool:
        low, high = (float(chi2.ppf(at, self.dof)) / self.dof for at in (0.5 - share / 2, 0.5 + share / 2))
        return low <= self.mean <= high


def after_phase_one(cfg: CricketConfig, seeds: range, draws: int) -> Consistency:
    total, dof = 0.0, 0
    for seed in seeds:
        field = simulate_field(cfg, seed)
        found, motes = first_map(cfg, field, draws), list(field.plan.heads)
        at = (np.array(motes)[:, None] * 2 + np.arange(2)).ravel()
        known = field.plan.surveyed_m[motes].ravel()
        mean = (found.positions_m + found.bias_m)[motes].ravel()
        mean, covariance = conditioned(mean, found.covariance_m2[np.ix_(at, at)], known)
        squares, free = nees(mean - field.true_m[motes].ravel(), covariance)
        total, dof = total + squares, dof + free
    return Consistency(total / dof, dof)


def after_phase_two(pairs: str, seeds: range) -> Consistency:
    keys = {"system": "cricket", "cricket.phase2.pairs": pairs, "cricket.phase2.max_updates": 60}
    cfg = load_radio_config(None, keys | {"cricket.phase2.target_rms_m": 1e-6}).cricket
    total, dof = 0.0, 0
    for seed in seeds:
        run = run_filter(cfg, simulate_field(cfg, seed))
        squares, free = nees((run.positions_m - run.true_m).ravel(), run.covariance_m2)
        total, dof = total + squares, dof + free
    return Consistency(total / dof, dof)


def apart(found: FirstMap, other: FirstMap) -> float:
    """Largest difference of two covariances, in units of the standard deviations."""
    sigmas = np.sqrt(np.maximum(other.covariance_m2.diagonal(), 1e-24))
    return float(np.abs((found.covariance_m2 - other.covariance_m2) / np.outer(sigmas, sigmas)).max())


def test_small_errors_are_those_of_the_derivatives(cfg: CricketConfig) -> None:
    plan, network = field_ranges(cfg, None, 1e-6)
    drawn = map_by_plan(plan, network, cfg.phase1.max_dop, 4000)
    straight = map_by_plan(plan, network, cfg.phase1.max_dop)
    assert (drawn.positions_m == straight.positions_m).all()
    assert (
        apart(drawn, straight) < 0.1
    )  # 4000 draws tell a correlation within 0.016; 36 x 36 of them within six times that
    assert np.abs(drawn.bias_m).max() < 0.1 * np.sqrt(drawn.covariance_m2.diagonal().max())
    assert (straight.bias_m == 0.0).all()


def test_a_triangle_to_begin_with_has_its_own_errors() -> None:
    rng = np.random.default_rng(6)
    places = rng.uniform(0.0, 10.0, (12, 2))
    network = network_of(places, near_pairs(places, 8.0), rng, sigma_m=1e-6)
    drawn, straight = map_as_possible(network, 60.0, 4000), map_as_possible(network, 60.0)
    assert apart(drawn, straight) < 0.1
    assert straight.covariance_m2.diagonal().min() >= 0.0


def test_the_same_ranges_give_the_same_map(cfg: CricketConfig) -> None:
    plan, network = field_ranges(cfg, np.random.default_rng(1), 1e-3)
    one, other = (map_by_plan(plan, network, cfg.phase1.max_dop, 200) for _ in range(2))
    assert (one.covariance_m2 == other.covariance_m2).all()
    assert (one.bias_m == other.bias_m).all()


def test_derivatives_are_too_sure_and_draws_are_not(cfg: CricketConfig) -> None:
    assert after_phase_one(cfg, range(20), 0).mean > 1.8
    assert after_phase_one(cfg, range(20), DRAWS).mean < 1.4  # 180 degrees of freedom: 1.0 within 0.21


@pytest.mark.slow
def test_nees_of_phase_one_over_200_fields(cfg: CricketConfig) -> None:
    assert after_phase_one(cfg, range(200), DRAWS).is_in_band(0.99)


@pytest.mark.slow
@pytest.mark.parametrize("pairs", ["adjacent", "all"])
def test_nees_of_phase_two_over_200_fields(pairs: str) -> None:
    assert after_phase_two(pairs, range(200)).is_in_band(0.99)
