"""Phase 1: the law of cosines, trilateration, joint covariance against many runs, refusals."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from ccatp.beacons.cricket.range_network import MappingError, MoteRange, PairMeans, RangeNetwork, build_network
from ccatp.beacons.cricket.self_mapping import MotePlan, conditioned, network_plan
from ccatp.beacons.cricket.trilateration import DegenerateStep, FirstMap, Sketch, map_as_possible, map_by_plan
from ccatp.config.beacon_models import CricketConfig
from ccatp.config.load import load_radio_config
from ccatp.filters.metrics import aligned_rms_m
from ccatp.sim.motes import true_motes
from ccatp.studies.mote_runs import first_map, simulate_field
from tests.unit.beacons.cricket.fields import SIGMA_M, FloatArray, near_pairs, network_of

A, B = np.zeros(2), np.array([0.0, 2.0])
LINE = [[1.0, 0.5], [1.0, 1.0], [1.0, 1.5]]


@pytest.fixture(scope="module")
def cfg() -> CricketConfig:
    return load_radio_config(None, {"system": "cricket"}).cricket


def sketch_of(places: FloatArray, rng: np.random.Generator | None = None, sigma_m: float = SIGMA_M) -> Sketch:
    network = network_of(places, near_pairs(places, 1e3), rng, sigma_m=sigma_m)
    return Sketch(network.names, PairMeans(network), 2, 60.0)


def field_ranges(
    cfg: CricketConfig, rng: np.random.Generator | None, sigma_m: float = 1e-3
) -> tuple[MotePlan, RangeNetwork]:
    plan = network_plan(cfg)
    places = true_motes(cfg, np.random.default_rng(0)).positions_m
    rows = []
    for i, j in plan.phase1_pairs:
        noise_m = 0.0 if rng is None else float(rng.normal(0.0, sigma_m))
        rows.append(
            MoteRange(plan.names[i], plan.names[j], float(np.linalg.norm(places[i] - places[j])) + noise_m, sigma_m)
        )
    return plan, build_network(rows, 2, plan.names)


def test_joint_errors_of_cosines_and_trilateration() -> None:
    places = np.array([A, B, [1.0, 1.0], [1.4, 1.3], [1.4, 0.7], [4.0, 1.5]])
    rng = np.random.default_rng(1)

    def laid(noise: np.random.Generator | None) -> Sketch:
        sketch = sketch_of(places, noise, sigma_m=1e-3)
        sketch.set_axes(0, 1)
        for mote in (2, 3, 4):
            sketch.add_by_cosines(mote, 0, 1)
        sketch.add_by_ranges(5, (2, 3, 4))
        return sketch

    sample = np.cov(np.array([laid(rng).positions_m.ravel() for _ in range(300)]).T)
    covariance = laid(None).covariance_m2
    spread = np.sqrt(covariance.diagonal())
    at = spread > 1e-9  # the origin and B's x are exact
    assert np.flatnonzero(~at).tolist() == [0, 1, 2]
    assert np.sqrt(sample.diagonal())[at] == pytest.approx(spread[at], rel=0.13)  # 300 runs: 4 %
    # correlations too: what a mote inherits from B and from its references
    scale = np.outer(spread[at], spread[at])
    assert (sample[np.ix_(at, at)] / scale) == pytest.approx(covariance[np.ix_(at, at)] / scale, abs=0.25)


@pytest.mark.parametrize(
    ("more", "what"),
    [
        ([[0.0, 1.0]], r"M2: ranges of 1.000 and 1.000 m to M0 and M1, 2.000 m apart, meet on"),
        ([[0.01, 1.0]], r"M2 from M0, M1: dilution of precision \d+(\.\d+)? exceeds 60"),
        ([*LINE, [9.0, 1.0]], "M5 from M2, M3, M4: the mirror image across them, 16 m away"),
        ([*LINE, [1.0, 9.0]], r"M5 from M2, M3, M4: .*(undetermined|dilution)"),
    ],
)
def test_motes_that_no_step_determines_are_refused(more: list[list[float]], what: str) -> None:
    sketch = sketch_of(np.array([A, B, *more]))
    sketch.set_axes(0, 1)
    for mote in (2, 3, 4)[: len(more) - 1]:
        sketch.add_by_cosines(mote, 0, 1)
    with pytest.raises(DegenerateStep, match=what):
        sketch.add_by_cosines(2, 0, 1) if len(more) == 1 else sketch.add_by_ranges(5, (2, 3, 4))


def test_a_missing_range_names_both_motes() -> None:
    network = network_of(np.array([A, B, [1.0, 1.0]]), [(0, 1), (0, 2)])
    sketch = Sketch(network.names, PairMeans(network), 2, 60.0)
    sketch.set_axes(0, 1)
    with pytest.raises(MappingError, match="no range between M1 and M2"):
        sketch.add_by_cosines(2, 0, 1)


def test_exact_ranges_give_the_field_in_its_frame(cfg: CricketConfig) -> None:
    plan, network = field_ranges(cfg, None)
    found = map_by_plan(plan, network, cfg.phase1.max_dop)
    assert found.positions_m == pytest.approx(true_motes(cfg, np.random.default_rng(0)).positions_m, abs=1e-6)
    assert found.unplaced == ()
    dops = [step.dop for step in found.steps if step.how == "trilateration"]
    # three motes 0.5 m apart, 5 to 6 m away: some 14 to 20
    assert 10.0 < min(dops) < max(dops) < 25.0


@pytest.mark.parametrize(("dimension", "reach_m"), [(2, 5.5), (3, 7.5)])
def test_without_a_plan_mote_after_mote(dimension: int, reach_m: float) -> None:
    rng = np.random.default_rng(6)
    places = rng.uniform(0.0, 10.0, (40, dimension))
    network = network_of(places, near_pairs(places, reach_m), rng, sigma_m=1e-4)
    found = map_as_possible(network, 60.0)
    placed = [mote for mote in range(40) if mote not in found.unplaced]
    assert len(placed) > 35
    assert aligned_rms_m(found.positions_m[placed], places[placed], mirrors=True) < 0.01


def test_what_hangs_on_two_ranges_is_left_out() -> None:
    places = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0], [5.0, 5.0], [9.0, 9.0]])
    network = network_of(places, [(0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3), (3, 4), (1, 4)])
    assert map_as_possible(network, 60.0).unplaced == (4,)


def test_no_triangle_no_beginning() -> None:
    network = network_of(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), [(0, 1), (1, 2), (2, 3), (0, 3)])
    with pytest.raises(DegenerateStep, match="no triangle of motes"):
        map_as_possible(network, 60.0)


DrawnErrorsFloatArray = NDArray[np.float64]
DRAWS = 800


def nees(errors: DrawnErrorsFloatArray, covariance: DrawnErrorsFloatArray) -> tuple[float, int]:
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


def apart(found: FirstMap, other: FirstMap) -> float:
    """Largest difference of two covariances, in units of the standard deviations."""
    sigmas = np.sqrt(np.maximum(other.covariance_m2.diagonal(), 1e-24))
    return float(np.abs((found.covariance_m2 - other.covariance_m2) / np.outer(sigmas, sigmas)).max())


def test_derivatives_are_too_sure_and_draws_are_not(cfg: CricketConfig) -> None:
    assert after_phase_one(cfg, range(20), 0).mean > 1.8
    assert after_phase_one(cfg, range(10), DRAWS).mean < 1.4  # 90 degrees of freedom: 1.0 within 0.30


@pytest.mark.slow
def test_nees_of_phase_one_over_200_fields(cfg: CricketConfig) -> None:
    assert after_phase_one(cfg, range(200), DRAWS).is_in_band(0.99)
