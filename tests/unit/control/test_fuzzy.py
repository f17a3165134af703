"""The Sugeno controller, against weighted means by hand."""

import pytest

from ccatp.beacons.steering import FuzzyGapError, Sugeno
from ccatp.config.beacon_models import FuzzyConfig
from ccatp.config.load import load_radio_config


def two_terms(rules: list[dict[str, object]]) -> FuzzyConfig:
    terms = {"low": (-1.0, -1.0, 0.0, 1.0), "high": (0.0, 1.0, 9.0, 9.0)}
    inputs = {"a": {"terms": terms}, "b": {"terms": terms}}
    return FuzzyConfig.model_validate({"inputs": inputs, "outputs": {"slow": 1.0, "fast": 3.0}, "rules": rules})


FULL: list[dict[str, object]] = [
    {"when": {"a": "low"}, "then": "slow"},
    {"when": {"a": "high", "b": "low"}, "then": "fast"},
    {"when": {"a": "high", "b": "high"}, "then": "slow"},
]


def test_one_rule_alone_gives_its_output() -> None:
    assert Sugeno(two_terms(FULL)).evaluate((0.0, 0.5)) == 1.0
    assert Sugeno(two_terms(FULL)).evaluate((1.0, 0.0)) == 3.0


def test_output_is_the_mean_weighted_by_products() -> None:
    # weights 0.75, 0.25 * 0.6, 0.25 * 0.4
    expected = (0.75 * 1.0 + 0.15 * 3.0 + 0.10 * 1.0) / 1.0
    assert Sugeno(two_terms(FULL)).evaluate((0.25, 0.4)) == pytest.approx(expected)


def test_beyond_the_last_shoulder_an_input_counts_as_there() -> None:
    sugeno = Sugeno(two_terms(FULL))
    assert sugeno.evaluate((50.0, -50.0)) == 3.0
    assert sugeno.memberships(0, 50.0) == [0.0, 1.0]


def test_rules_with_a_gap_are_refused() -> None:
    with pytest.raises(FuzzyGapError, match="no rule of the fuzzy controller fires at a = 1, b = 1; add a rule"):
        Sugeno(two_terms(FULL[:2]))


def test_the_shipped_speed_falls_with_the_error_and_rises_with_the_distance() -> None:
    sugeno = Sugeno(load_radio_config().control.fuzzy)
    assert sugeno.inputs == ("distance_m", "heading_error_rad")
    by_error = [sugeno.evaluate((1.5, 0.1 * k)) for k in range(20)]
    by_distance = [sugeno.evaluate((0.1 * k, 0.0)) for k in range(20)]
    assert by_error == sorted(by_error, reverse=True)
    assert by_distance == sorted(by_distance)
    assert by_error[0] == by_distance[-1] == 0.15
