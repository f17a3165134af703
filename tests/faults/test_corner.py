"""Retreats at a corner of the mirror by a robot that is not where it takes itself to be: whichever rim is behind it."""

import random

import pytest

from ccatp.studies.faults_study import FaultySilRun
from tests.faults.campaign import short_survey, single, was_real
from tests.faults.linking import Measured

# The first panel lies at a corner. These meet the rim, some more than once; most others find themselves before.
SEEDS = (0, 10, 22, 52, 62, 69)


def carried_off(seed: int) -> FaultySilRun:
    """A survey of the corner panel; somewhere on the way the robot is put elsewhere and turned."""
    rng = random.Random(seed)
    at_s, dx_m, dy_m, turn_rad = (
        rng.uniform(3, 40),
        rng.uniform(-0.1, 0.1),
        rng.uniform(-0.1, 0.1),
        rng.uniform(-0.8, 0.8),
    )
    plan = single(
        f'signal = "body"\ntype = "kidnap"\nat_s = {at_s:.2f}\ndx_m = {dx_m:.3f}\ndy_m = {dy_m:.3f}\n'
        f"dheading_rad = {turn_rad:.3f}\n"
    )
    return FaultySilRun(short_survey(run__filter="ekf", run__seed=seed), plan)


@pytest.mark.fault("S23")
def test_no_retreat_falls_at_a_corner(measured: Measured) -> None:
    edges = 0
    for seed in SEEDS:
        rehearsal = carried_off(seed)
        result = rehearsal.run()
        assert was_real(rehearsal.injected[0])
        danger = result.summary["danger"]
        measured("S23", danger["falls"])
        edges += danger["true_edges"]
        assert result.outcome == "complete" or result.cause  # held, and it is said why
    assert edges >= 4
