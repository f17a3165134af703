"""Reports of a robot that stands, and the advice that goes with a cause."""

import re

import pytest

from ccatp.conditions import DANGER, SURVEY, condition_of
from ccatp.daemon.main_loop import STANDS_REPEAT_S, STANDS_REPORT_S, StandstillReport


def test_it_is_reported_after_half_a_minute_and_again_after_each_minute() -> None:
    report, said = StandstillReport(), dict[int, float]()
    for k in range(2000):
        lasts_s = report.lasts_s(0.1 * k, stands=k != 1500)
        if lasts_s is not None:
            said[k] = lasts_s
    first, again = 10.0 * STANDS_REPORT_S, 10.0 * STANDS_REPEAT_S
    assert list(said) == pytest.approx([first, first + again, 1501 + first], abs=1)  # a frame
    assert list(said.values()) == pytest.approx([30.0, 90.0, 30.0], abs=0.2)


@pytest.mark.parametrize(
    ("cause", "advice"),
    [
        pytest.param("no way on: walled in", "`ccatp abort`", id="a text that varies"),
        pytest.param("an edge sensor chatters, for 30 s", "Clean it", id="a hold that lasts"),
        pytest.param("an edge sensor chatters, again after 2 retries", "Clean it", id="a hold that comes again"),
        pytest.param("nobody has heard of this", "", id="unknown"),
    ],
)
def test_advice_is_that_of_the_row_whose_message_it_is(cause: str, advice: str) -> None:
    row = condition_of(cause)
    assert (row is not None) is bool(advice)
    assert row is None or row.advice.startswith(advice)


def test_each_row_is_found_by_its_message() -> None:
    for row in (*DANGER, *SURVEY):
        found = condition_of(re.sub(r"{.*?}", "left", row.message))
        assert found is not None
        assert found.message == row.message
