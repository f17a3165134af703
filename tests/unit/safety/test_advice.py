"""What the table of conditions tells an operator stands on its own."""

import re

import pytest

from ccatp.conditions import TABLE, Condition, condition_of
from tests.support.rows import DANGER

# A reference to another row, which an operator who reads one alarm does not see.
ELSEWHERE = re.compile(r"\b(as above|as for|the same (for|where|but)|see above)\b", re.IGNORECASE)


@pytest.mark.parametrize("row", TABLE.values(), ids=lambda row: row.name)
def test_an_advice_refers_to_no_other_row(row: Condition) -> None:
    assert row.advice
    assert not ELSEWHERE.search(row.advice)


@pytest.mark.parametrize("row", [row for row in DANGER if "{" not in row.message], ids=lambda row: row.name)
@pytest.mark.parametrize("end", ["", ", for 30 s", ", on repetition 1", ", again after 2 retries"])
def test_a_cause_with_its_duration_or_repetition_is_that_of_its_row(row: Condition, end: str) -> None:
    found = condition_of(row.message + end)
    assert found is not None
    assert found.message == row.message
