"""Figures of estimates against a reference, done by hand."""

from math import pi, sqrt

import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.core import FloatArray
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.records.run_reader import Trace
from ccatp.studies.replay import (
    REPRODUCED,
    Replayed,
    ReplayEvaluation,
    csv_lines,
    difference,
    errors_of,
    figures,
    fix_distances_m,
    judge,
    table_lines,
)

NONE = np.empty(0, dtype=np.int64)


@pytest.fixture(scope="module")
def mirror() -> Mirror:
    return build_mirror(load_config().mirror)


def trace(x_m: list[float], heading_rad: float = 0.0, *, first: int = 0, covariance: FloatArray | None = None) -> Trace:
    k = len(x_m)
    seq = np.arange(first, first + k)
    pose = np.column_stack([x_m, np.zeros(k), np.full(k, heading_rad)])
    t_s = np.array(0.01 * seq, dtype=np.float64)
    return Trace(seq, t_s, pose, np.zeros(k), None if covariance is None else np.tile(covariance, (k, 1, 1)))


def test_the_figures() -> None:
    errors = errors_of(
        trace([0.001, 0.002, 0.003, 0.004], 0.002), trace([0.0] * 4), np.array([1, 3]), np.array([2, 9])
    )  # fmt: skip
    found = figures(errors)
    assert found["position_error_mm"] == pytest.approx({"mean": 2.5, "p50": 2.5, "p99": 3.97, "max": 4.0})
    assert found["moving_error_mm"]["rms"] == pytest.approx(sqrt(10.0))  # of 2 and 4
    assert found["arrival_error_mm"] == pytest.approx({"rms": 3.0, "max": 3.0})
    assert found["heading_error_mrad"]["rms"] == pytest.approx(2.0)
    assert found["nees_mean"] is None


def test_frames_that_both_have_are_compared_with_height_and_the_short_way_round() -> None:
    high = trace([0.003])._replace(height_m=np.array([0.004]))
    assert errors_of(high, trace([0.0]), NONE, NONE).distance_m == pytest.approx([0.005])
    shifted = errors_of(trace([1.0, 2.0, 3.0], first=4), trace([0.0, 0.0, 1.0], first=3), NONE, NONE)
    assert shifted.distance_m.tolist() == [1.0, 1.0]
    turned = errors_of(trace([0.0], pi - 0.01), trace([0.0], -pi + 0.02), NONE, NONE)
    assert turned.turn_rad == pytest.approx([-0.03])


def test_nees_takes_correlations_into_account() -> None:
    covariance = np.array([[4e-6, 0.0, 1e-6], [0.0, 1.0, 0.0], [1e-6, 0.0, 1e-6]])
    errors = errors_of(trace([0.002], 0.001, covariance=covariance), trace([0.0]), NONE, NONE)
    # The inverse of [[4, 1], [1, 1]] is [[1, -1], [-1, 4]] / 3: (2, 1) gives (4 - 4 + 4) / 3.
    assert errors.nees == pytest.approx([4.0 / 3.0])
    singular = errors_of(trace([0.002], covariance=np.zeros((3, 3))), trace([0.0]), NONE, NONE)
    assert figures(singular)["nees_mean"] is None


@pytest.mark.parametrize(("by_m", "is_same"), [(0.0, True), (0.9 * REPRODUCED, True), (1.1 * REPRODUCED, False)])
def test_a_replay_reproduces_up_to_rounding(by_m: float, is_same: bool) -> None:
    found = difference(errors_of(trace([by_m, 0.0]), trace([0.0, 0.0]), NONE, NONE))
    assert found["reproduced"] is is_same
    assert found["frames"] == 2
    assert found["position_mm"] == pytest.approx({"rms": 1e3 * by_m / sqrt(2.0), "max": 1e3 * by_m}, abs=1e-15)
    turned = difference(errors_of(trace([0.0], by_m), trace([0.0]), NONE, NONE))
    assert turned["reproduced"] is is_same
    assert not difference(errors_of(trace([1.0]), trace([1.0], first=7), NONE, NONE))["reproduced"]  # no common frame


def test_the_distance_of_a_fix_is_that_to_the_estimate_before_it(mirror: Mirror) -> None:
    heights = mirror.surface.heights_m(np.array([0.0, 0.1, 0.2]), np.zeros(3))
    estimate = trace([0.0, 0.1, 0.2], first=5)._replace(height_m=heights)
    found = fix_distances_m(estimate, np.array([[6.0, 0.1, 0.003], [7.0, 0.2, 0.0]]), mirror)
    assert found == pytest.approx([0.003, 0.0], abs=2e-5)  # the surface falls by less than that over 3 mm


def judged(mirror: Mirror, *, has_truth: bool, is_smoothed: bool = True, first: int = 0) -> ReplayEvaluation:
    replayed = Replayed(
        trace([0.002, 0.002], first=first, covariance=np.eye(3)),
        np.array([first]),
        smoothed=trace([0.001, 0.0], first=first) if is_smoothed else None,
    )
    truth = trace([0.0, 0.0], first=first) if has_truth else None
    return ReplayEvaluation(replayed, trace([0.004, 0.002], first=first), truth, NONE, mirror)


def test_with_a_truth_all_three_are_judged_by_it(mirror: Mirror) -> None:
    found = judge([judged(mirror, has_truth=True), judged(mirror, has_truth=True)])
    assert found["reference"] == "truth"
    means = {name: found[name]["position_error_mm"]["mean"] for name in ("recorded", "replayed", "smoothed")}
    assert means == pytest.approx({"recorded": 3.0, "replayed": 2.0, "smoothed": 0.5})
    assert found["difference"]["position_mm"]["max"] == pytest.approx(2.0)
    assert found["difference"]["frames"] == 4


def test_without_one_the_record_is_the_reference_and_not_judged(mirror: Mirror) -> None:
    found = judge([judged(mirror, has_truth=True), judged(mirror, has_truth=False)])
    assert found["reference"] == "recorded"
    assert set(found["recorded"]) == {"fix_distance_mm"}
    assert found["replayed"]["position_error_mm"]["max"] == pytest.approx(2.0)
    assert judge([judged(mirror, has_truth=False, is_smoothed=False)])["smoothed"] is None


def test_the_table_has_a_column_for_each_estimate(mirror: Mirror) -> None:
    lines = list(table_lines(judge([judged(mirror, has_truth=True)])))
    assert lines[0].split() == ["error", "against", "the", "truth", "recorded", "replayed", "smoothed"]
    assert lines[1].split() == ["position", "mean", "(mm)", "3.0000", "2.0000", "0.5000"]
    assert lines[-2].split() == ["position", "(mm)", "1.4142", "2.0000"]
    assert next(line for line in lines if "at arrivals rms" in line).split()[-3:] == ["-", "-", "-"]
    without = list(table_lines(judge([judged(mirror, has_truth=False, is_smoothed=False)])))
    assert without[0].split() == ["error", "against", "the", "recorded", "estimate", "recorded", "replayed"]
    assert without[1].split() == ["position", "mean", "(mm)", "-", "1.0000"]
    part = judged(mirror, has_truth=True)._replace(recorded=trace([0.002, 0.002 + 3e-14]))
    assert list(table_lines(judge([part])))[-2].split()[-1] == "3.0e-11"


def test_the_rows_of_the_csv(mirror: Mirror) -> None:
    rows = [line.split(",") for line in csv_lines([judged(mirror, has_truth=False, first=3)])]
    assert rows[0][:6] == ["part", "seq", "t_s", "x_m", "y_m", "heading_rad"]
    assert rows[0][-3:] == ["true_x_m", "true_y_m", "true_heading_rad"]
    assert ",".join(rows[1]) == "1,3,0.03,0.002,0.0,0.0,0.001,0.0,0.0,0.004,0.0,0.0,,,"
    assert len(rows) == 3
