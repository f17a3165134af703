"""Random attacks on samples: a robot never moves, or arrives, on a pose that they do not support, without a word."""

from collections import Counter

import pytest

from tests.faults.attacks import attack, run_attack

# One that is reported, one that lost most counts of an encoder for half a second, and others.
SEEDS = (0, 7, 30)
CAMPAIGN = range(100, 250)


def test_an_attack_is_a_function_of_its_seed_and_attacks_differ() -> None:
    texts = [attack(seed).text for seed in range(100)]
    assert texts == [attack(seed).text for seed in range(100)]
    assert len(set(texts)) == len(texts)


@pytest.mark.parametrize("seed", [SEEDS[0], *(pytest.param(seed, marks=pytest.mark.slow) for seed in SEEDS[1:])])
def test_an_attack_is_handled_or_reported(seed: int) -> None:
    result = run_attack(seed)
    assert result.wrong == []
    assert result.is_complete or result.cause


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10))
def test_a_campaign_of_attacks_is_handled_or_reported(part: int) -> None:
    results = [run_attack(seed) for seed in CAMPAIGN[part::10]]
    print(Counter(result.kind for result in results))
    assert [(result.attack.seed, result.wrong) for result in results if result.wrong] == []
    assert all(result.is_complete or result.cause for result in results)
