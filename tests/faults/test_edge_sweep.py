"""The rim of all four mirrors, centimetre by centimetre, and ways over the seams: nobody falls, no false edge.

``make test-slow`` runs one shard of 96 of the whole sweep; ``CCATP_SWEEP_SHARD=i/n`` takes another, ``0/1`` all of it
(4 million drives, some 15 hours of one core).
"""

import os
import random
from collections.abc import Callable, Iterable

import pytest

from tests.faults import edge_sweep
from tests.faults.edge_sweep import (
    OVERRUN_M,
    Tally,
    rim_case,
    rim_cases,
    seam_case,
    speed_of,
    sweep,
    turn_case,
    turn_cases,
)

SHARD, SHARDS = map(int, os.environ.get("CCATP_SWEEP_SHARD", "5/96").split("/"))
SEAMS = 1_000_000  # of the whole sweep
MIN_DRIVEN = 0.25
PERMIT_S = 0.1  # S22, S24

Measured = Callable[..., None]
# Slower than this the way that tells a direction, 0.2 mm and more, takes longer than the bound in time.
SLOW_M_S = 0.02


def check(tally: Tally) -> None:
    print(tally.line)
    assert not tally.falls, "\n".join(tally.worst)
    assert not tally.unseen, "\n".join(tally.worst)
    assert tally.after_m <= OVERRUN_M, "\n".join(tally.worst)
    assert not tally.false_edges, "\n".join(tally.worst)


def check_rim(numbers: Iterable[int], measured: Measured) -> None:
    """All drives count for falls and overrun; the time to the permit is that of those that are not slow."""
    tally, late_s = Tally(), 0.0
    count = 0
    for number in numbers:
        one = sweep(rim_case, [number])
        tally.add(one)
        count += 1
        if speed_of(number) >= SLOW_M_S:
            late_s = max(late_s, one.late_s)
    check(tally)
    assert tally.drives > count * MIN_DRIVEN
    measured("S22", 1e3 * tally.after_m, "mm")
    measured("S22", 1e3 * late_s, "ms")
    measured("S22", tally.falls, "falls")


def test_a_number_is_a_drive() -> None:
    """Every place of every rim, heading and speed has its number, and the same number is the same drive."""
    assert rim_cases() > 3_000_000
    names = {rim_case(number)[0] for number in range(0, rim_cases(), 9973)}
    assert len(names) == len(range(0, rim_cases(), 9973))
    assert {name.split()[2] for name in names} == set(edge_sweep.MIRRORS)
    assert rim_case(4)[1]() == rim_case(4)[1]()


@pytest.mark.fault("S22")
def test_a_sample_of_the_rim(measured: Measured) -> None:
    rng = random.Random(20)
    check_rim([rng.randrange(rim_cases()) for _ in range(160)], measured)


@pytest.mark.fault("S24")
def test_a_sample_of_turns_beside_the_rim(measured: Measured) -> None:
    rng = random.Random(24)
    tally = sweep(turn_case, [rng.randrange(turn_cases()) for _ in range(60)])
    check(tally)
    assert tally.drives > 60 * MIN_DRIVEN
    assert tally.late_s <= PERMIT_S
    measured("S24", 1e3 * tally.late_s)


@pytest.mark.fault("S20", "S21")
def test_a_sample_of_ways_and_stops_over_seams(measured: Measured) -> None:
    rng = random.Random(21)
    tally = sweep(seam_case, [rng.randrange(SEAMS) for _ in range(24)])
    check(tally)
    assert tally.over_gap > 2
    measured("S20", tally.false_edges / tally.transits)
    measured("S21", float(tally.false_edges))


@pytest.mark.slow
@pytest.mark.fault("S22")
@pytest.mark.parametrize("part", range(4))
def test_the_rim(part: int, measured: Measured) -> None:
    check_rim(range(SHARD + SHARDS * part, rim_cases(), 4 * SHARDS), measured)


@pytest.mark.slow
@pytest.mark.fault("S24")
def test_turns_beside_the_rim(measured: Measured) -> None:
    tally = sweep(turn_case, range(SHARD, turn_cases(), SHARDS))
    check(tally)
    measured("S24", 1e3 * tally.late_s)


@pytest.mark.slow
@pytest.mark.fault("S20", "S21")
@pytest.mark.parametrize("part", range(2))
def test_ways_and_stops_over_seams(part: int, measured: Measured) -> None:
    # Neither mirrors nor kinds of crossing may fall out of step with the shards.
    numbers = range(SEAMS * part // 2, SEAMS * (part + 1) // 2)
    tally = sweep(seam_case, [k for k in numbers if k // 8 % SHARDS == SHARD % SHARDS])
    check(tally)
    measured("S20", tally.false_edges / tally.transits)
    measured("S21", float(tally.false_edges))
