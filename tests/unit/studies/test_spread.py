"""Spreads against numpy on the same numbers."""

import numpy as np
import pytest

from ccatp.studies.campaign import LEAST, Histogram, pooled

BIN = 0.0012  # half a bin, 1/2000 of a decade, is 0.115 %


def errors(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).lognormal(-7.0, 1.0, count)


@pytest.mark.parametrize("share", [0.01, 0.5, 0.99, 0.999])
def test_quantiles_are_those_of_the_numbers(share: float) -> None:
    values = errors(1, 20_001)
    # Beside the bin there is the step to the next number, which in the tail of so many is 1 % at most.
    assert Histogram.of(values, 0.01).quantile(share) == pytest.approx(np.quantile(values, share), rel=BIN + 0.01)


def test_a_quantile_is_right_to_half_a_bin() -> None:
    values = np.full(7, 0.0123)
    assert Histogram.of(np.append(values, 1.0), 0.01).quantile(0.5) == pytest.approx(0.0123, rel=BIN)


def test_count_mean_maximum_and_share_within_are_exact() -> None:
    values = np.append(errors(2, 999), 0.01)  # one exactly at the limit
    spread = Histogram.of(values, 0.01)
    assert spread.count == 1000
    assert spread.mean == pytest.approx(values.mean(), rel=1e-12)  # the order of summing
    assert spread.largest == values.max()
    assert spread.within == np.count_nonzero(values <= 0.01)


def test_no_quantile_exceeds_the_maximum() -> None:
    values = np.array([0.00100001])
    assert Histogram.of(values, 0.01).quantile(1.0) == values[0]


def test_spreads_pooled_are_the_spread_of_all() -> None:
    parts = [errors(3, 500), errors(4, 30), np.empty(0)]
    one, whole = pooled([Histogram.of(part, 0.01) for part in parts]), Histogram.of(np.concatenate(parts), 0.01)
    assert np.array_equal(one.bins, whole.bins)
    assert np.array_equal(one.counts, whole.counts)
    assert (one.largest, one.within) == (whole.largest, whole.within)
    assert one.total == pytest.approx(whole.total, rel=1e-12)  # the order of summing


def test_a_spread_comes_back_from_its_arrays() -> None:
    spread = Histogram.of(errors(5, 100), 0.01)
    again = Histogram.from_arrays(spread.to_arrays("x"), "x")
    assert np.array_equal(again.bins, spread.bins)
    assert np.array_equal(again.counts, spread.counts)
    assert (again.total, again.largest, again.within) == (spread.total, spread.largest, spread.within)


def test_the_exceedance_falls_to_nothing() -> None:
    values, share = Histogram.of(errors(6, 1000), 0.01).exceedance()
    assert (np.diff(values) > 0.0).all()
    assert (np.diff(share) < 0.0).all()
    assert share[-1] == 0.0


def test_nothing_has_no_quantile_and_no_mean() -> None:
    empty = Histogram.of(np.empty(0), 0.01)
    assert empty.count == 0
    assert np.isnan([empty.quantile(0.5), empty.mean]).all()
    assert pooled([]).count == 0


def test_what_is_smaller_than_the_first_bin_counts_there() -> None:
    assert Histogram.of(np.array([0.0, LEAST / 2.0]), 0.01).bins.tolist() == [0]


@pytest.mark.parametrize("value", [-1e-6, np.nan, np.inf])
def test_errors_are_finite_and_not_negative(value: float) -> None:
    with pytest.raises(ValueError, match="must be finite and not negative"):
        Histogram.of(np.array([0.1, value]), 0.01)
