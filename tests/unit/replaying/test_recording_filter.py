"""The recording filter: the same filter, and a smoother that sees what it should."""

from collections.abc import Callable

import numpy as np
import pytest

from ccatp.core import FloatArray
from ccatp.filters import FILTERS, Smoother
from ccatp.studies import replay as recording_filter
from ccatp.studies.replay import RecordingFilter, added_noise, transition_of_reset

N = 4
F = np.eye(N) + np.diag([0.5, 0.2, 0.1], 1)
Q = np.diag([0.3, 0.0, 0.2, 0.1])  # one state without noise
H = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
R = np.array([0.5, 0.25])
READINGS = np.random.default_rng(3).normal(size=(12, 2))


def assert_same(found: FloatArray, wanted: object) -> None:
    # 1e-9: twelve steps back through covariances with a condition number of some 1e3, states of order 1.
    np.testing.assert_allclose(found, np.asarray(wanted, dtype=np.float64), rtol=0.0, atol=1e-9)


def started(name: str) -> RecordingFilter:
    filter_ = RecordingFilter(FILTERS[name](np.zeros(N), np.eye(N)))
    filter_.reset(np.ones(N), 2.0 * np.eye(N))
    return filter_


def drive(filter_: RecordingFilter, readings: FloatArray) -> None:
    for z in readings:
        filter_.predict(F, Q)
        filter_.update(z, H, R)


def by_hand(name: str) -> tuple[FloatArray, FloatArray]:
    filter_, smoother = FILTERS[name](np.ones(N), 2.0 * np.eye(N)), Smoother(N)
    for z in READINGS:
        smoother.predict(filter_, F, Q)
        filter_.update(z, H, R)
    found = smoother.smooth(filter_)
    return found.means[:, :3], found.covariances[:, :3, :3]


@pytest.fixture(params=[(2000, 4096), (0, 4096), (3, 5)], ids=["all pending", "none pending", "chapters"])
def sizes(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    reach, chapter = request.param
    monkeypatch.setattr(recording_filter, "REACH", reach)
    monkeypatch.setattr(recording_filter, "CHAPTER", chapter)


@pytest.mark.usefixtures("sizes")
@pytest.mark.parametrize("name", sorted(FILTERS))
def test_it_filters_as_the_filter_in_it_and_smooths_as_the_smoother(name: str) -> None:
    filter_, alone = started(name), FILTERS[name](np.ones(N), 2.0 * np.eye(N))
    for z in READINGS:
        filter_.predict(F, Q)
        alone.predict(F, Q)
        assert filter_.update(z, H, R).nis == pytest.approx(alone.update(z, H, R).nis, rel=1e-12)  # rounding
        assert_same(filter_.mean, alone.mean)
        assert_same(filter_.covariance, alone.covariance)
    assert filter_.count == len(READINGS)
    means, covariances = by_hand(name)
    found = filter_.smooth()
    assert_same(found.means, means)
    assert_same(found.covariances, covariances)


def test_what_was_taken_back_is_forgotten() -> None:
    filter_ = started("ekf")
    drive(filter_, READINGS[:5])
    kept = filter_.mean, filter_.covariance
    drive(filter_, READINGS[:4] + 3.0)  # not what was read, as it turns out
    filter_.reset(*kept)
    assert filter_.count == 5
    drive(filter_, READINGS[5:])
    means, covariances = by_hand("ekf")
    found = filter_.smooth()
    assert_same(found.means, means)
    assert_same(found.covariances, covariances)


def test_a_late_reading_between_prediction_and_update() -> None:
    # As the journal does it: back to the state after a prediction, the late one first, then the others again.
    filter_ = started("ekf")
    drive(filter_, READINGS[:6])
    filter_.predict(F, Q)
    kept = filter_.mean, filter_.covariance
    drive(filter_, READINGS[7:9])
    filter_.reset(*kept)
    filter_.update(READINGS[6], H, R)
    drive(filter_, READINGS[7:])
    means, _ = by_hand("ekf")
    assert_same(filter_.smooth().means, means)


def test_a_reset_to_the_present_state_changes_nothing() -> None:
    filter_ = started("ekf")
    drive(filter_, READINGS[:5])
    filter_.reset(filter_.mean, filter_.covariance)
    drive(filter_, READINGS[5:])
    assert_same(filter_.smooth().means, by_hand("ekf")[0])


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_a_shift_of_the_state_shifts_what_is_smoothed(name: str) -> None:
    # The model is linear: from the shift on, everything is as before plus what becomes of the shift.
    shift, filter_ = np.array([10.0, 0.0, -7.0, 1.0]), started(name)
    drive(filter_, READINGS[:6])
    filter_.reset(filter_.mean + shift, filter_.covariance)
    for z in READINGS[6:]:
        shift = F.dot(shift)
        filter_.predict(F, Q)
        filter_.update(z + H.dot(shift), H, R)
    means, _ = by_hand(name)
    found = filter_.smooth().means
    assert len(found) == len(means) + 1  # the shift is a transition
    assert_same(found[:7], means[:7])
    assert_same(found[7], means[6] + [10.0, 0.0, -7.0])


def test_nothing_is_known_across_a_state_drawn_anew() -> None:
    filter_ = started("ekf")
    drive(filter_, READINGS[:6])
    before = filter_.mean[:3].copy(), filter_.covariance[:3, :3].copy()
    filter_.reset(np.zeros(N), 9.0 * np.eye(N))
    drive(filter_, READINGS[6:])
    found = filter_.smooth()
    assert_same(found.means[6], before[0])
    assert_same(found.covariances[6], before[1])


def some_covariance() -> FloatArray:
    root = np.random.default_rng(1).normal(size=(N, N))
    return np.asarray(root @ root.T + np.eye(N))


def redrawn(P: FloatArray) -> FloatArray:
    after = P.copy()
    after[1, :] = after[:, 1] = 0.0
    after[1, 1] = 7.0
    return after


def asymmetric_in_the_last_bit(P: FloatArray) -> FloatArray:
    after = P.copy()
    after[0, 1] = np.nextafter(after[0, 1], np.inf)
    return after


def more_certain(P: FloatArray) -> FloatArray:
    return 0.5 * P


def inflated(P: FloatArray) -> FloatArray:
    return P + np.diag([1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("change", "diagonal_of_F", "variance"),
    [
        (np.copy, [1, 1, 1, 1], 0.0),
        (asymmetric_in_the_last_bit, [1, 1, 1, 1], 0.0),
        (redrawn, [1, 0, 1, 1], 7.0),
        (more_certain, [0, 0, 0, 0], None),
        (inflated, [0, 0, 0, 0], None),
    ],
)
def test_what_a_reset_was(
    change: Callable[[FloatArray], FloatArray], diagonal_of_F: list[int], variance: float | None
) -> None:
    P = some_covariance()
    after = change(P)
    transition, noise = transition_of_reset(P, after)
    np.testing.assert_array_equal(transition, np.diag(diagonal_of_F))
    # 1e-12: P is of order 10, and what was redrawn is exactly what stands there.
    np.testing.assert_allclose(transition @ P @ transition.T + noise, after, atol=1e-12)
    if variance is not None:
        assert noise[1, 1] == variance


def test_noise_is_what_was_given_unless_the_prediction_added_more() -> None:
    P = some_covariance()
    predicted = F @ P @ F.T + Q
    assert added_noise(P, F, predicted, Q) is Q
    more = np.diag([0.0, 0.0, 0.0, 1e-3])
    np.testing.assert_allclose(added_noise(P, F, predicted + more, Q), Q + more, atol=1e-12)  # rounding of 10
