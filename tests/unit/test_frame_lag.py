"""How late frames are served, against two clocks that drift apart."""

import pytest

from ccatp.daemon.robot_session import MAX_DRIFT, LatenessStatistics


def serve(lag: LatenessStatistics, late_s: dict[int, float], frames: int = 100, drift: float = 0.0) -> list[float]:
    """Frames of 100 Hz that come 3 ms after they were taken, some of them later."""
    return [lag.add(0.01 * k, 500.0 + (1.0 + drift) * 0.01 * k + 0.003 + late_s.get(k, 0.0)) for k in range(frames)]


def test_prompt_frames_do_not_lag() -> None:
    lag = LatenessStatistics(0.02)
    assert max(serve(lag, {})) == pytest.approx(0.0, abs=1e-9)
    assert lag.missed_deadlines == 0
    assert lag.worst_s == pytest.approx(0.0, abs=1e-9)


def test_late_frames_are_as_late_as_they_are_and_slips_are_counted() -> None:
    lag = LatenessStatistics(0.02)
    found = serve(lag, {20: 0.3, 21: 0.29, 22: 0.28, 40: 0.019, 60: 0.021})
    assert [found[k] for k in (19, 20, 21, 22, 23, 40, 60)] == pytest.approx(
        [0.0, 0.3, 0.29, 0.28, 0.0, 0.019, 0.021], abs=1e-4
    )
    assert lag.missed_deadlines == 4
    assert lag.worst_s == pytest.approx(0.3, abs=1e-4)


def test_a_first_frame_that_was_late_is_soon_no_measure() -> None:
    lag = LatenessStatistics(0.02)
    serve(lag, {0: 1.0})
    assert lag.add(1.0, 501.003 + 0.03) == pytest.approx(0.03, abs=1e-3)


@pytest.mark.parametrize("drift", [-0.9 * MAX_DRIFT, 0.9 * MAX_DRIFT])
def test_clocks_may_drift_apart(drift: float) -> None:
    assert max(serve(LatenessStatistics(0.02), {}, 50_000, drift)) == pytest.approx(0.0, abs=1e-6)
    assert serve(LatenessStatistics(0.02), {49_999: 0.1}, 50_000, drift)[-1] == pytest.approx(0.1, abs=1e-4)


def test_a_clock_that_was_set_begins_anew() -> None:
    lag = LatenessStatistics(0.02)
    serve(lag, {})
    assert lag.add(0.5, 501.1) == 0.0  # backwards
    assert lag.add(0.51, 501.14) == pytest.approx(0.03, abs=1e-3)
    lag.reset()
    assert lag.add(0.52, 900.0) == 0.0
    assert lag.add(7000.0, 900.01) == 0.0  # forwards
    assert lag.add(7000.01, 900.05) == pytest.approx(0.03, abs=1e-3)
