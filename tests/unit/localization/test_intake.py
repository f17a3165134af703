"""Pure. Which samples are used: the quick way for clean frames and the slow way for the others agree."""

from collections import Counter
from math import inf, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ccatp.core import ImuSample, WheelSample
from ccatp.estimation.sample_validation import SampleValidator

HISTORY_S = 0.2
ONE = WheelSample(1.002, 1.0, 2.0)


def intake() -> SampleValidator:
    """One that has used samples up to 1.001 s."""
    found = SampleValidator(HISTORY_S, Counter())
    assert found.columns(1.001, [WheelSample(1.0, 0.0, 0.0), WheelSample(1.001, 0.0, 0.0)]) is not None
    return found


def counts(found: SampleValidator) -> dict[str, int]:
    return {key: value for key, value in found._counts.items() if value}


def test_clean_samples_are_columns() -> None:
    columns = intake().columns(1.01, [ONE, WheelSample(1.003, 3.0, 4.0)])
    assert columns == ((1.002, 1.003), (1.0, 3.0), (2.0, 4.0))


DIRTY = {
    "a wheel without a sample": [WheelSample(1.002, None, 2.0)],
    "the other": [ONE, WheelSample(1.003, 2.0, None)],
    "a rate that is no number": [WheelSample(1.002, nan, 2.0)],
    "an infinite rate": [WheelSample(1.002, 1.0, inf)],
    "two that cancel": [WheelSample(1.002, inf, -inf)],
    "a time that is no number": [ONE, WheelSample(nan, 1.0, 2.0), WheelSample(1.004, 1.0, 2.0)],
    "the same at the end": [ONE, WheelSample(nan, 1.0, 2.0)],
    "twice": [ONE, ONE],
    "used before": [WheelSample(1.001, 1.0, 2.0), ONE],
    "backward": [WheelSample(1.003, 1.0, 2.0), ONE],
    "older than all": [WheelSample(1.0005, 1.0, 2.0)],
    "ahead": [ONE, WheelSample(1.02, 1.0, 2.0)],
    "late": [WheelSample(0.8, 1.0, 2.0)],
}


@pytest.mark.parametrize("name", DIRTY)
def test_dirty_samples_are_not(name: str) -> None:
    assert intake().columns(1.01, DIRTY[name]) is None


@pytest.mark.parametrize(
    ("name", "right", "left", "refused"),
    [
        ("a wheel without a sample", [], [1.002], {}),
        ("the other", [1.002, 1.003], [1.002], {}),
        ("a rate that is no number", [], [], {"nonfinite": 1}),
        ("an infinite rate", [], [], {"nonfinite": 1}),
        ("two that cancel", [], [], {"nonfinite": 1}),
        ("a time that is no number", [1.002, 1.004], [1.002, 1.004], {"nonfinite": 1}),
        ("twice", [1.002], [1.002], {"duplicate": 2}),
        ("used before", [1.002], [1.002], {"duplicate": 2}),
        ("backward", [1.003], [1.003], {"backward": 2}),
        ("older than all", [], [], {"backward": 2}),
        ("ahead", [1.002], [1.002], {"ahead": 2}),
        ("late", [], [], {"late": 2}),
    ],
)
def test_dirty_samples_are_judged_one_by_one(
    name: str, right: list[float], left: list[float], refused: dict[str, int]
) -> None:
    found = intake()
    one, other = found.wheels(1.01, DIRTY[name])
    assert [t for t, _ in one] == right
    assert [t for t, _ in other] == left
    assert counts(found) == refused  # each wheel counts for itself


times = st.integers(0, 30).map(lambda k: 0.98 + 0.002 * k)
rates = st.one_of(st.none(), st.sampled_from([0.0, 1.0, -2.5, nan, inf]))
ordered = st.lists(times, max_size=6, unique=True).map(sorted)


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.one_of(
            st.lists(st.tuples(times, rates, rates), max_size=5),
            ordered.map(lambda found: [(t, 1.0, t) for t in found]),
        ),
        max_size=5,
    )
)
def test_quick_and_slow_use_and_count_the_same(frames: list[list[tuple[float, float | None, float | None]]]) -> None:
    quick, slow = intake(), intake()
    for k, rows in enumerate(frames):
        frame_s, samples = 1.01 + 0.01 * k, [WheelSample(*row) for row in rows]
        columns = quick.columns(frame_s, samples) if samples else ((), (), ())
        if columns is None:
            right, left = quick.wheels(frame_s, samples)
        else:
            right, left = list(zip(*columns[:2], strict=True)), list(zip(columns[0], columns[2], strict=True))
        assert (right, left) == slow.wheels(frame_s, samples)
        assert counts(quick) == counts(slow)
        assert quick.backward_source == slow.backward_source


def test_five_backward_samples_in_a_row_name_the_sensor() -> None:
    found = intake()
    for k in range(4):
        found.wheels(1.01, [WheelSample(0.99 - 0.001 * k, 1.0, None)])
    assert found.backward_source == ""
    found.wheels(1.01, [WheelSample(0.9, 1.0, None)])
    assert found.backward_source == "right encoder"


def test_a_good_sample_ends_the_row() -> None:
    found = intake()
    for k in range(4):
        found.wheels(1.01, [WheelSample(0.99 - 0.001 * k, 1.0, 1.0)])
    found.wheels(1.01, [ONE])
    found.wheels(1.01, [WheelSample(0.9, 1.0, 1.0)])
    assert found.backward_source == ""


IMU = {
    "nonfinite": ImuSample(1.002, nan, 0.0),
    "ahead": ImuSample(1.02, 0.0, 0.0),
    "late": ImuSample(0.7, 0.0, 0.0),
    "duplicate": ImuSample(1.001, 0.0, 0.0),
    "backward": ImuSample(0.999, 0.0, 0.0),
}


@pytest.mark.parametrize("reason", IMU)
def test_unusable_samples_of_the_inertial_unit(reason: str) -> None:
    found, good = intake(), ImuSample(1.003, 0.0, 0.0)
    found.imu(1.001, [ImuSample(1.001, 0.0, 0.0)])
    assert list(found.imu(1.01, [IMU[reason], good])) == [good]
    assert counts(found) == {reason: 1}


def test_a_jump_of_the_clock_forgets_all_times() -> None:
    found = intake()
    found.restart()
    assert found.columns(0.01, [WheelSample(0.005, 1.0, 2.0)]) is not None
