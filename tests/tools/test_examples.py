"""What a page shows is compared with what is printed: numbers by value, everything else by text."""

import pytest

from tests.support.examples import is_like


@pytest.mark.parametrize(
    ("shown", "printed"),
    [
        ("mean 0.048 p99 1.634\n", "mean 0.049 p99 1.590\n"),
        ("9 points, ... us\nmean 0.048\n", "9 points, 442.1 us\nmean 0.049\n"),
        ("88.4... s, -0.5", "88.41 s, -0.52"),
        ("one\n...\nmean 0.048", "one\n\n0.9 two\nmean   0.048"),
        ("one\n<BLANKLINE>\ntwo", "one\n\ntwo"),
        ("wall ...", "wall time_s 1.3"),
        ("chi2 9.9/6", "chi2 9.8/6"),
    ],
)
def test_decimals_may_be_those_of_another_processor(shown: str, printed: str) -> None:
    assert is_like(shown, printed)


@pytest.mark.parametrize(
    ("shown", "printed"),
    [
        ("mean 0.048 p99 1.634", "mean 0.048 p99 1.134"),
        ("mean 0.048", "median 0.048"),
        ("9 of 9 points, 0.048", "8 of 9 points, 0.048"),
        ("mean 0.048", "mean 0.048 more"),
        # beside an ellipsis, too
        (
            "...\npiston 0.63 um rms, tip and tilt 5.21 urad rms",
            "moves\npiston 0.48 um rms, tip and tilt 2.43 urad rms",
        ),
        ("rms 0.048 ... p99 1.634", "rms 0.048 max 3.0 p99 1.134"),
        ("rms 0.048 ...", "rms 0.148 max"),
        ("... 2.34 um", "12.34 um"),
        ("88.4... s", "188.41 s"),
        ("-41.8 +- 0.6 ...", "41.8 +- 0.6 um"),
        ("9 of 9 ... mean 0.048", "8 of 9 points mean 0.048"),
    ],
)
def test_nothing_else_may_differ(shown: str, printed: str) -> None:
    assert not is_like(shown, printed)
