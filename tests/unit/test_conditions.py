"""What the table of conditions tells an operator stands on its own."""

import re
from math import inf

import pytest
from msgspec.json import decode, encode
from msgspec.structs import replace

from ccatp.conditions import Condition, all_conditions, text_of
from ccatp.conditions.danger import FAN_WEAK, NO_ESTIMATE
from ccatp.conditions.mission import MEASUREMENTS_FAILED
from ccatp.core import NO_CAUSE, Cause

# A reference to another row, which an operator who reads one alarm does not see.
ELSEWHERE = re.compile(r"\b(as above|as for|the same (for|where|but)|see above)\b", re.IGNORECASE)


@pytest.mark.parametrize("row", all_conditions(), ids=lambda row: row.name)
def test_an_advice_refers_to_no_other_row(row: Condition) -> None:
    assert row.advice
    assert not ELSEWHERE.search(row.advice)


def test_the_text_of_a_cause_has_its_numbers_duration_repetition_and_what_is_found_besides() -> None:
    cause = FAN_WEAK.cause(side="left")
    assert text_of(cause) == "the left fan gets weak"
    assert text_of(replace(cause, lasted_s=30.0)) == "the left fan gets weak, for 30 s"
    assert text_of(replace(cause, repetition=2, besides=NO_ESTIMATE.cause())) == (
        "the left fan gets weak, on repetition 2; no estimate"
    )
    assert text_of(NO_CAUSE) == ""


def test_a_cause_of_another_version_is_shown_with_its_name_and_its_values() -> None:
    assert text_of(Cause("mirror_on_fire", {"at_m": 1.5})) == "mirror_on_fire (at_m 1.5)"
    assert text_of(Cause("fan_weak", {"which": "left"})) == "fan_weak (which left)"
    assert text_of(Cause("leg_overdue", {"x_m": "far", "y_m": 1.0})) == "leg_overdue (x_m far, y_m 1.0)"


def test_values_travel_as_numbers_or_text() -> None:
    cause = MEASUREMENTS_FAILED.cause(count=3, why=ValueError("no fix"), share=inf)
    assert cause.values == {"count": 3, "why": "no fix", "share": "inf"}
    assert decode(encode(cause), type=Cause) == cause
