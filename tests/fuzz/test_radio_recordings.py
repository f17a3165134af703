"""Damaged and odd recordings are handled or named: no wrong result comes without a word."""

import pytest

from ccatp.beacons.config.load import load_recordings_config
from tests.fuzz.radio_attacks import ATTACKS, attacked

SEEDS = (0, 1, 2)
OF_TRUTH = [name for name in ATTACKS if "truth" in name]
EVERY = [(name, seed, has_truth) for name in ATTACKS for seed in SEEDS for has_truth in (True, False)]
# One of each mechanism, with what becomes of it.
FEW = [
    ("clock set forward by 5 s", False, "named"),
    ("first truth at zero", True, "handled"),
    ("truth of constant heading", True, "handled"),
    ("ranges in feet", False, "named"),
]


@pytest.mark.parametrize(("name", "has_truth", "outcome"), FEW)
def test_an_attack_is_handled_or_named(name: str, has_truth: bool, outcome: str) -> None:
    assert attacked(name, SEEDS[0], load_recordings_config(), has_truth=has_truth).outcome == outcome


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed", "has_truth"), EVERY)
def test_no_attack_gives_a_wrong_result_without_a_word(name: str, seed: int, has_truth: bool) -> None:
    if name in OF_TRUTH and not has_truth:
        return  # nothing to attack
    found = attacked(name, seed, load_recordings_config(), has_truth=has_truth)
    assert found.outcome != "silent", found
