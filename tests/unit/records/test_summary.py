"""Tests of the summary against a plain recomputation, whatever the order and size of the batches."""

import json
from math import hypot, pi

import numpy as np
import pytest
from numpy.typing import NDArray

from ccatp.core import DeckPose, PanelId, PointId
from ccatp.records import summary as summary_module
from ccatp.records.summary import RunningStatistics, SummaryBuilder, format_table
from tests.support.scenario import config_of, mirror_of

POINT, OTHER = PointId(5, 5, 3), PointId(5, 5, 4)
CFG, MIRROR = config_of(), mirror_of()


@pytest.fixture
def builder() -> SummaryBuilder:
    return make()


def make(*, lower_bound_s: float = 3000.0, is_sim: bool = True) -> SummaryBuilder:
    made = SummaryBuilder(CFG, MIRROR, is_sim=is_sim)
    made.set_plan(693, lower_bound_s)
    made.set_counts(1, 0)
    return made


def truth_row(
    seq: int, x: float = 0.0, y: float = 0.0, psi: float = 0.0, clearance: float = 1.0, fallen: int = 0
) -> list[float]:
    return [seq, seq / 100, x, y, psi, *MIRROR.surface_point(x, y), clearance, fallen, int(clearance < 0)]


def tables(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(1)
    seq = np.arange(count, dtype=np.float64)
    truth: NDArray[np.float64] = np.column_stack((seq, seq / 100, rng.normal(size=(count, 6))))
    truth = np.column_stack((truth, np.ones(count), np.zeros((count, 2))))
    track: NDArray[np.float64] = truth[:, :9].copy()
    track[:, 2:8] += rng.normal(scale=3e-3, size=(count, 6))
    return truth, track


def test_errors_are_those_of_a_plain_recomputation(builder: SummaryBuilder) -> None:
    truth, track = tables(1000)
    builder.add_truth(truth[:-10])  # the last frames have no truth, the first no estimate
    builder.add_track(track[20:])
    built = builder.build()
    errors_mm = 1e3 * np.array([hypot(*(b - a)) for a, b in zip(truth[20:-10, 5:8], track[20:-10, 5:8], strict=True)])
    found = built["localization_error_mm"]
    # the summary is rounded to 1 um, six decimals for the fraction
    assert found["mean"] == pytest.approx(sum(errors_mm) / 970, abs=6e-4)
    assert found["max"] == pytest.approx(max(errors_mm), abs=6e-4)
    ordered = sorted(errors_mm)
    assert found["p50"] == pytest.approx((ordered[484] + ordered[485]) / 2, abs=6e-4)
    assert ordered[958] <= found["p99"] + 6e-4
    assert found["p99"] <= ordered[961] + 6e-4
    assert found["within_10mm_fraction"] == pytest.approx(sum(e <= 10.0 for e in errors_mm) / 970, abs=6e-7)
    assert 0.5 < found["within_10mm_fraction"] < 1.0
    turns = track[20:-10, 4] - truth[20:-10, 4]
    assert built["heading_error_mrad"]["rms"] == pytest.approx(1e3 * (sum(turns**2) / 970) ** 0.5, abs=6e-4)


def test_batches_of_any_size_and_order_give_the_same_summary() -> None:
    truth, track = tables(900)
    results = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        cuts = sorted(rng.integers(0, 900, size=12))
        parts = [("truth", part) for part in np.split(truth, cuts)]
        order = rng.permutation(13)
        for position, part in zip(order, np.split(track, cuts), strict=True):
            parts.insert(int(position) * 2, ("track", part))
        made = make()
        made.add_arrival(POINT, 450)
        made.add_verdict_event(449, 1)
        for kind, part in parts:
            (made.add_truth if kind == "truth" else made.add_track)(part)
        results.append(json.dumps(made.build()))
    assert len(set(results)) == 1
    assert json.loads(results[0])["localization_error_mm"]["mean"] > 1.0


def test_statistics_of_a_long_run_take_bounded_memory() -> None:
    keys = np.arange(10_000)
    values = np.random.default_rng(1).gamma(2.0, size=len(keys))
    names = "mean", "p50", "p99", "max"
    found = []
    for size in (1, 7, 10_000):
        statistics = RunningStatistics(3000)
        for batch in np.split(keys, range(size, len(keys), size)):
            statistics.add(batch, values[batch])
        assert statistics.sample.tolist() == values[::4].tolist()  # 10,000 / 4 < 3000 < 10,000 / 2
        found.append(statistics.figures(names, scale=1.0, decimals=9))
    assert found[0] == found[1] == found[2]
    expected = [values.mean(), *np.percentile(values[::4], (50, 99)), values.max()]
    assert list(found[0].values()) == pytest.approx(expected, abs=1e-9)  # of the rounding
    short, whole = RunningStatistics(3000), RunningStatistics(3000)
    short.add(keys[:100], values[:100])
    short.include(statistics)
    assert whole.figures(("max",), scale=1.0, decimals=9) == {"max": None}
    assert short.sample.tolist() == values[:100:4].tolist() + values[::4].tolist()
    whole.include(short)
    assert whole.count == 10_100
    assert whole.figures(names, scale=1.0, decimals=9) == short.figures(names, scale=1.0, decimals=9)
    assert whole.figures(("max",), scale=1.0, decimals=9) == {"max": found[0]["max"]}


def test_heading_error_is_wrapped(builder: SummaryBuilder) -> None:
    builder.add_truth([truth_row(1, psi=pi - 0.001)])
    builder.add_track([truth_row(1, psi=-pi + 0.002)])
    assert builder.build()["heading_error_mrad"]["rms"] == 3.0


@pytest.mark.parametrize("truth_first", [True, False])
def test_arrival_error_is_that_of_the_puck_in_the_panel_plane(truth_first: bool) -> None:
    builder = make()
    x, y = MIRROR.point_on_deck(POINT)
    row = truth_row(7, x + 3e-3, y - 4e-3)
    row[7] += 5e-3  # along the normal, nearly: a misaligned panel is no arrival error
    if truth_first:
        builder.add_truth([row])
    builder.add_arrival(POINT, 7)
    if not truth_first:
        builder.add_truth([row])
    built = builder.build()
    # 5 mm aside on the deck's projection; the slope (< 5 deg here) and the lift across it change it by at most 0.4 mm
    assert built["arrival_error_mm"]["mean"] == pytest.approx(5.0, abs=0.4)
    assert built["points"]["first_arrival_within_10mm"] == 1


def test_arrival_at_the_target_has_no_error_and_only_the_first_counts(builder: SummaryBuilder) -> None:
    x, y = MIRROR.point_on_deck(POINT)
    builder.add_truth([truth_row(1, x, y), truth_row(2, x + 0.02, y), truth_row(3, x, y)])
    builder.add_arrival(POINT, 1)
    builder.add_arrival(POINT, 2)
    builder.add_arrival(PointId(5, 5, 1), 2)
    builder.add_arrival(PointId(5, 5, 2), 99)
    built = builder.build()
    assert built["points"]["first_arrival_within_10mm"] == 1
    assert built["arrival_error_mm"]["max"] > 100.0


def test_an_arrival_is_found_long_after_its_frame(builder: SummaryBuilder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(summary_module, "HISTORY_ROWS", 100)
    for start in range(0, 300, 10):
        builder.add_truth([truth_row(seq) for seq in range(start, start + 10)])
    builder.add_arrival(POINT, 205)
    found = builder.build()["arrival_error_mm"]
    assert found["max"] > 0.0
    builder.add_arrival(PointId(5, 5, 1), 100)  # beyond what is kept: never guessed
    assert builder.build()["arrival_error_mm"] == found


def test_an_edge_is_true_where_a_sensor_was_beyond_the_rim(builder: SummaryBuilder) -> None:
    clearance = {20: -0.004, 33: -0.0021}
    builder.add_verdict_event(17, 1)  # three frames before the truth's
    builder.add_verdict_event(24, 1)  # four frames after
    builder.add_truth([truth_row(seq, clearance=clearance.get(seq, 0.1)) for seq in range(30)])
    builder.add_verdict_event(30, 1)  # its frames are not all there yet
    builder.add_truth([truth_row(seq, clearance=clearance.get(seq, 0.1)) for seq in range(30, 40)])
    builder.add_verdict_event(39, 1)  # the run ends before its last frames
    builder.add_verdict_event(20, 2)  # an abort is no edge
    assert builder.build()["danger"] == {"true_edges": 2, "false_edges": 2, "falls": 0, "max_overrun_mm": 4.0}


def test_falls_are_counted_once_each_across_batches(builder: SummaryBuilder) -> None:
    for batch in ([0, 1], [1, 1], [0, 0], [1]):
        builder.add_truth([truth_row(i, fallen=f) for i, f in enumerate(batch)])
    assert builder.build()["danger"]["falls"] == 2


def test_panels_compare_fit_with_injected(builder: SummaryBuilder) -> None:
    a, b, c = PanelId(1, 1), PanelId(1, 2), PanelId(1, 3)
    fits = {a: (3e-6, 1e-6, 0.0), b: (4e-6, 0.0, 1e-6), c: (9.0, 9.0, 9.0)}
    builder.set_panels(fits, {b: (0.0, 0.0, 0.0), a: (0.0, 0.0, 0.0)})
    # sqrt((9 + 16) / 2) um; sqrt((1 + 0 + 0 + 1) / 4) urad; the third has no truth
    assert builder.build()["panels"] == {"count": 3, "piston_rms_um": 3.536, "tilt_rms_urad": 0.707}


def test_a_whole_summary_has_the_keys_of_the_contract_in_their_order(builder: SummaryBuilder) -> None:
    builder.set_mission(690, 3, 3600.0, is_complete=True)
    builder.add_ticks([100.0, 110.0])
    builder.add_ticks(np.array([120.0]))
    built = builder.build(60.0)
    assert list(built) == [
        *("mirror", "world", "filter", "seed", "reference", "points", "arrival_error_mm", "localization_error_mm"),
        *("heading_error_mrad", "mission_time_s", "lower_bound_s", "within_budget", "danger", "grip", "panels", "wall"),
    ]
    assert list(built["points"]) == ["total", "measured", "first_arrival_within_10mm", "skipped"]
    assert list(built["arrival_error_mm"]) == ["mean", "p50", "p99", "max"]
    assert list(built["localization_error_mm"]) == ["mean", "p50", "p99", "max", "within_10mm_fraction"]
    assert built["points"] == {"total": 693, "measured": 690, "first_arrival_within_10mm": None, "skipped": 3}
    assert built["within_budget"] is True
    assert built["wall"] == {"time_s": 60.0, "realtime_factor": 60.0, "tick_us_p50": 110.0, "tick_us_p99": 119.8}
    json.dumps(built, allow_nan=False)


def test_without_a_measured_point_no_figure_of_localization_and_no_budget_is_claimed(builder: SummaryBuilder) -> None:
    truth, track = tables(40)
    builder.add_truth(truth)
    builder.add_track(track)
    builder.set_mission(0, 0, 30.0, is_complete=True)
    built = builder.build()
    assert set(built["localization_error_mm"].values()) == {None}
    assert (built["heading_error_mrad"]["rms"], built["within_budget"]) == (None, None)
    builder.set_mission(1, 0, 30.0, is_complete=True)
    built = builder.build()
    assert None not in {*built["localization_error_mm"].values(), built["heading_error_mrad"]["rms"]}
    assert built["within_budget"] is True


@pytest.mark.parametrize(
    ("time_s", "is_complete", "expected"), [(30.0, True, True), (30.0, False, None), (3601.0, False, False)]
)
def test_only_a_complete_mission_has_kept_its_budget(
    builder: SummaryBuilder, time_s: float, is_complete: bool, expected: bool | None
) -> None:
    builder.set_mission(5, 0, time_s, is_complete=is_complete)
    assert builder.build()["within_budget"] is expected


def test_a_real_robot_has_null_where_the_truth_is_needed() -> None:
    builder = make(is_sim=False)
    builder.add_track(tables(10)[1])
    builder.add_arrival(POINT, 3)
    builder.add_verdict_event(3, 1)
    builder.set_mission(693, 0, 3700.0)
    builder.set_panels({PanelId(1, 1): (0.0, 0.0, 0.0)}, None)
    built = builder.build()
    assert (built["world"], built["reference"]) == (None, "laser")
    assert built["points"]["first_arrival_within_10mm"] is None  # no fix of a measured point is known
    assert set(built["danger"].values()) == {None}
    assert {*built["arrival_error_mm"].values(), *built["localization_error_mm"].values()} == {None}
    assert built["heading_error_mrad"]["rms"] is None
    assert built["panels"] == {"count": 1, "piston_rms_um": None, "tilt_rms_urad": None}
    assert built["within_budget"] is False
    assert built["wall"]["time_s"] is None


def test_on_a_real_robot_the_first_fix_at_a_point_is_its_arrival() -> None:
    builder, height_m = make(is_sim=False), CFG.robot.puck_height_m
    x, y = MIRROR.point_on_deck(POINT)
    for offset_m in (0.012, 0.001):  # a correction move in between
        builder.add_fix(POINT, MIRROR.puck_world(DeckPose(x + offset_m, y, 0.3), height_m))
    builder.add_fix(OTHER, MIRROR.puck_world(DeckPose(*MIRROR.point_on_deck(OTHER), 0.0), height_m))
    built = builder.build()
    assert built["points"]["first_arrival_within_10mm"] == 1
    assert built["arrival_error_mm"]["max"] == pytest.approx(12.0, abs=0.2)  # along the surface: its slope is 0.1
    assert built["arrival_error_mm"]["mean"] == pytest.approx(6.0, abs=0.1)
    assert make().build()["reference"] == "truth"


def test_a_diverged_estimate_gives_a_file_that_json_can_hold(builder: SummaryBuilder) -> None:
    truth, track = tables(4)
    track[2, 5] = np.nan
    builder.add_truth(truth)
    builder.add_track(track)
    built = builder.build()["localization_error_mm"]
    assert built["mean"] is None
    assert built["within_10mm_fraction"] <= 0.75


def test_the_table_has_every_figure_and_counts_points_left_out_by_reason(builder: SummaryBuilder) -> None:
    text = format_table(builder.build())
    assert len(text.splitlines()) == 9
    for part in ("points                 total 693  measured 1", "mean -", "within_budget -"):
        assert part in text
    assert format_table({"ended": {"what": "stopped"}, **builder.build()}, "stopped by eva") == "\n".join(
        [f"{'ended':<21}  stopped by eva", *text.splitlines()]
    )
    builder.set_mission(1, 2, 3.0, {"operator": ["1-2-3", "1-2-4"], "no fix": ["1-2-5"]})
    (line,) = (line for line in format_table(builder.build()).splitlines() if line.startswith("points"))
    assert line.endswith("not measured 2 (operator), 1 (no fix)")


def test_points_whose_lengths_contradict_each_other_are_counted_where_there_are_any(builder: SummaryBuilder) -> None:
    assert "unreliable" not in builder.build()["points"]
    builder.set_unreliable(2)
    assert builder.build()["points"]["unreliable"] == 2


def test_a_mission_in_two_sessions_has_one_summary() -> None:
    first, second = make(lower_bound_s=50.0), make(lower_bound_s=20.0)
    places = {point: MIRROR.point_on_deck(point) for point in (POINT, OTHER)}
    truth, track = tables(40)
    first.add_truth([truth_row(1, *places[POINT], clearance=-0.002)])
    first.add_arrival(POINT, 1)
    first.add_verdict_event(1, 1)
    first.set_mission(1, 0, 30.0)
    second.add_truth(truth[:20])  # its frames are counted anew
    second.add_track(track[:20])
    second.add_truth([truth_row(30, 0.3, 0.3), truth_row(31, *places[OTHER])])
    second.add_arrival(POINT, 30)  # approached once more: the first time counts
    second.add_arrival(OTHER, 31)
    second.set_mission(2, 0, 25.0)
    alone = second.build()
    second.precede(first)
    both = second.build()
    assert alone["points"]["first_arrival_within_10mm"] == 1
    assert (both["points"]["measured"], both["points"]["first_arrival_within_10mm"]) == (2, 2)
    assert both["arrival_error_mm"]["max"] < 0.01
    assert (both["mission_time_s"], both["lower_bound_s"]) == (55.0, 50.0)
    assert both["danger"] == {"true_edges": 1, "false_edges": 0, "falls": 0, "max_overrun_mm": 2.0}
    assert both["localization_error_mm"] == alone["localization_error_mm"]
