"""The end of phase 2: the other motes of a stand from its first, and the plan that knows them."""

import numpy as np
import pytest

from ccatp.beacons.cricket.self_mapping import complete_stands, loose_plan, network_plan
from ccatp.config.load import load_radio_config
from ccatp.sim.motes import true_motes

CFG = load_radio_config(None, {"system": "cricket"}).cricket
PLAN = network_plan(CFG)
TRUE_M = true_motes(CFG, np.random.default_rng(0)).positions_m


def test_the_plan_of_the_paper() -> None:
    assert len(PLAN.names) == 20
    assert PLAN.names[:4] == ("A", "B", "N1-1", "N1-2")
    assert [PLAN.names[mote] for mote in PLAN.heads] == [f"N{number}-1" for number in range(1, 7)]
    # A to B, both to three motes, 45 between stands
    assert len(PLAN.phase1_pairs) == 1 + 6 + 45
    assert np.isfinite(PLAN.surveyed_m).sum() == 3
    assert PLAN.mapped == tuple(range(2, 20))


def test_loose_motes_are_all_asked() -> None:
    plan = loose_plan(CFG, ("a", "b", "c"))
    assert plan.phase1_pairs == plan.phase2_pairs == ((0, 1), (0, 2), (1, 2))
    assert plan.heads == plan.anchors == ()


def test_exact_heads_and_turns_give_all_motes() -> None:
    heads = list(PLAN.heads)
    whole = complete_stands(PLAN, TRUE_M, np.zeros((40, 40)), TRUE_M[heads], np.zeros((12, 12)))
    assert whole.positions_m == pytest.approx(TRUE_M[list(whole.motes)])
    assert not whole.covariance_m2.any()


def test_errors_of_a_stands_turn_reach_its_other_motes() -> None:
    rng, sigma_m, found = np.random.default_rng(1), 0.01, []
    heads, covariance = list(PLAN.heads), np.zeros((36, 36))
    for _ in range(400):
        first_m = TRUE_M + rng.normal(0.0, sigma_m, TRUE_M.shape)
        heads_m = TRUE_M[heads] + rng.normal(0.0, 0.002, (6, 2))
        whole = complete_stands(PLAN, first_m, np.eye(40) * sigma_m**2, heads_m, np.eye(12) * 0.002**2)
        found.append((whole.positions_m - TRUE_M[list(whole.motes)]).ravel())
        covariance = whole.covariance_m2
    sample = np.cov(np.array(found).T)
    # 400 runs: a standard deviation is known to 4 %
    assert np.sqrt(sample.diagonal()) == pytest.approx(np.sqrt(covariance.diagonal()), rel=0.15)
    assert np.sqrt(covariance[0, 0]) == pytest.approx(0.002)
    assert np.sqrt(covariance[2:6, 2:6].trace()) > 2.0 * 0.002
