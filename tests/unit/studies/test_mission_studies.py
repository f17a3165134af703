"""The studies of whole missions: cells, figures, drawings; and every study by its command, on one or two cells."""

import gc
import json
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.cli import main
from ccatp.config.load import load_config
from ccatp.core import Cause
from ccatp.mirror.mirror import build_mirror
from ccatp.records import run_reader, summary
from ccatp.sim.world import TruthRow
from ccatp.studies import STUDIES, faults_study, find_study, sil_run
from ccatp.studies.campaign import Job, JobOutcome, Study, cells_of, jobs_of
from ccatp.studies.faults_study import FIRST_S, LONGEST_S, is_recoverable, random_plan
from ccatp.studies.mission_study import (
    COLUMN,
    LEAST,
    STOP_COLUMNS,
    Histogram,
    chi_square_figures,
    combine_missions,
    pooled,
    run_mission,
)
from ccatp.studies.physics_study import BODY_RANGES, body_cells, drawn_body
from ccatp.studies.results import columns_of, plain
from ccatp.studies.sil_run import SilRun, SilTrace
from ccatp.studies.survey_studies import GROUPS, SENSITIVITY, TIME, combine_filters
from ccatp.survey.composition import assemble
from ccatp.survey.events import Pause
from tests.support.scenario import RADIO_DATA
from tests.support.sim_survey import plan_of

SIGMA_M, SIGMA_RAD = 1e-3, 2e-3
ONE_PANEL: dict[str, object] = {"run.panels": 1, "mission.calibration_length_m": 0.0}  # a mission of a minute


def stops_of(errors_m: list[float], approaches: list[int] | None = None) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Stops at the points of one panel in turn, each this far off along x, in truth, in the estimate and at the fix."""
    rows = np.zeros((len(errors_m), len(STOP_COLUMNS)))
    approach = np.array(approaches or [1] * len(errors_m))
    rows[:, COLUMN["t_s"]] = np.arange(len(errors_m))
    rows[:, COLUMN["row"]] = rows[:, COLUMN["col"]] = 1
    rows[:, COLUMN["point"]] = np.cumsum(approach == 1)
    rows[:, COLUMN["approach"]] = approach
    for name in ("error_x_m", "arrival_m", "distance_m", "fix_distance_m"):
        rows[:, COLUMN[name]] = errors_m
    rows[:, COLUMN["nis"]] = (np.array(errors_m) / SIGMA_M) ** 2
    rows[:, [COLUMN["p_xx"], COLUMN["p_yy"]]] = SIGMA_M**2
    rows[:, COLUMN["p_hh"]] = SIGMA_RAD**2
    return rows


def mission(errors_m: list[float], approaches: list[int] | None = None, **changes: Any) -> JobOutcome:
    """A mission whose localization errors are those at its stops."""
    times = {"mission_time_s": 110.0, "lower_bound_s": 100.0, "tour_bound_s": 90.0, "budget_s": 3600.0}
    counts = {"counts": {"fixes": 9}, "corrections": sum(a > 1 for a in approaches or [])}
    values: dict[str, Any] = {"outcome": "complete", "cause": "", "within_budget": True, **times, **counts}
    values |= {
        "points": {"total": 9, "measured": 9, "first_arrival_within_10mm": 9, "skipped": 0},
        "heading_error_mrad": {"count": 2, "square_sum": 8.0},
        "danger": {"true_edges": 0, "false_edges": 1, "falls": 0, "max_overrun_mm": 0.5},
        "panels": {"count": 1, "piston_rms_um": 3.0, "tilt_rms_urad": None},
        "states_s": {"driving": 60.0, "turning": 50.0, "settling": 5.0, "measuring": 4.0},
        **changes,
    }
    errors = np.array(errors_m)
    arrays = {
        **Histogram.of(errors).to_arrays("localization"),
        **Histogram.of(errors[1:]).to_arrays("localization_later"),
        "stops": stops_of(errors_m, approaches),
        "bounds": np.array([(k, 8e-6, 2e-6, e, 0.0) for k, e in enumerate(errors_m)]),
    }
    return JobOutcome(values, arrays)


def test_stop_errors_stand_beside_the_bound_without_each_first_stop() -> None:
    values, arrays = combine_filters({}, [mission([0.1, 0.003]), mission([0.1, 0.004])])
    assert values["bound"]["rms_mm"] == pytest.approx(2.0 * 2.0**0.5, abs=1e-3)
    assert values["bound"]["error_rms_mm"] == pytest.approx(12.5**0.5, abs=1e-3)
    assert values["bound"]["ratio"] == pytest.approx((12.5 / 8.0) ** 0.5, abs=1e-3)
    assert values["bound"]["with_accelerometer"]["ratio"] == pytest.approx((12.5 / 2.0) ** 0.5, abs=1e-3)
    assert arrays["bounds"].shape == (2, 5)
    alone, _ = combine_filters({}, [mission([0.1])])
    assert alone["bound"]["ratio"] is None
    assert alone["bound"]["error_rms_mm"] is None


def test_the_margin_is_that_of_the_slowest_mission() -> None:
    values, _ = TIME.combine({}, [mission([0.001]), mission([0.001], mission_time_s=130.0)])
    assert values["margin_s"] == 3600.0 - 130.0
    assert values["tour_ratio"] == pytest.approx(120.0 / 90.0, abs=1e-4)
    held, _ = TIME.combine({}, [mission([0.001], outcome="held")])
    assert (held["margin_s"], held["tour_ratio"]) == (None, None)


def test_each_group_of_disturbances_is_added_and_taken_away() -> None:
    cells = {str(cell.factors["group"]): cell for cell in SENSITIVITY.cells()}
    quiet, hard = (load_config(None, {"run.world": name}).world for name in ("thesis", "hard"))
    slip, rest = (load_config(None, cells[name].overrides).world for name in ("plus slip", "minus slip"))
    assert (slip.slip_max, slip.creep_fraction) == (hard.slip_max, 0.0)
    assert (rest.slip_max, rest.creep_fraction) == (0.0, hard.creep_fraction)
    # With all groups added, the quiet world is the hard one but for its name.
    keys = set(type(quiet).model_fields) - {"name"}
    differing = {key for key in keys if getattr(quiet, key) != getattr(hard, key)}
    assert differing <= {key for group in GROUPS.values() for key in group}


# -- the missions of a cell -------------------------------------------------------------------------------------------

BIN = 0.0012  # half a bin, 1/2000 of a decade, is 0.115 %


def errors(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).lognormal(-7.0, 1.0, count)


def test_a_histogram_has_the_figures_of_its_values() -> None:
    values = np.append(errors(1, 20_000), 0.01)  # one exactly at the limit
    found = Histogram.of(values)
    for share in (0.01, 0.5, 0.99, 0.999):
        # Beside the bin there is the step to the next number, which in the tail of so many is 1 % at most.
        assert found.quantile(share) == pytest.approx(np.quantile(values, share), rel=BIN + 0.01)
    assert Histogram.of(np.append(np.full(7, 0.0123), 1.0)).quantile(0.5) == pytest.approx(0.0123, rel=BIN)
    assert Histogram.of(np.array([0.00100001])).quantile(1.0) == 0.00100001  # not beyond the maximum
    assert (found.count, found.largest) == (20_001, values.max())
    assert found.mean == pytest.approx(values.mean(), rel=1e-12)  # the order of summing
    assert found.within == np.count_nonzero(values <= 0.01)
    assert Histogram.of(np.array([0.0, LEAST / 2.0])).counts.nonzero()[0].tolist() == [0]
    assert Histogram.of(np.array([1e6])).quantile(0.5) < Histogram.of(np.array([1e6])).largest == 1e6
    edges, share_beyond = found.exceedance()
    assert (np.diff(edges) > 0.0).all()
    assert (np.diff(share_beyond) < 0.0).all()
    assert share_beyond[-1] == 0.0
    with pytest.raises(ValueError, match="must be finite and not negative"):
        Histogram.of(np.array([0.1, -1e-6]))
    with pytest.raises(ValueError, match="must be finite and not negative"):
        Histogram.of(np.array([0.1, np.nan]))


def test_histograms_are_pooled_and_stored() -> None:
    parts = [errors(3, 500), errors(4, 30), np.empty(0)]
    one, whole = pooled([Histogram.of(part) for part in parts]), Histogram.of(np.concatenate(parts))
    again = Histogram.from_arrays(whole.to_arrays("x"), "x")
    for found in (one, again):
        assert np.array_equal(found.counts, whole.counts)
        assert (found.largest, found.within) == (whole.largest, whole.within)
        assert found.total == pytest.approx(whole.total, rel=1e-12)  # the order of summing
    empty = Histogram.of(np.empty(0))
    assert np.isnan([empty.quantile(0.5), empty.mean]).all()
    assert empty.count == pooled([]).count == 0


def test_every_error_of_every_run_counts_once() -> None:
    values, arrays = combine_missions({}, [mission([0.012, 0.001]), mission([0.002, 0.003, 0.004])])
    errors = values["arrival_error_mm"]
    assert (errors["mean"], errors["p50"], errors["max"]) == pytest.approx((4.4, 3.0, 12.0))
    assert errors["within_10mm_fraction"] == 0.8
    later = values["arrival_error_after_first_leg_mm"]
    assert (later["mean"], later["max"]) == pytest.approx((8.0 / 3.0, 4.0), abs=1e-4)  # rounded to 0.1 um
    localization = values["localization_error_mm"]
    assert (localization["mean"], localization["max"]) == pytest.approx((4.4, 12.0))
    assert localization["within_10mm_fraction"] == 0.8
    assert values["localization_error_after_first_leg_mm"]["max"] == pytest.approx(4.0)
    assert values["heading_error_mrad"]["rms"] == 2.0
    assert values["stop_error_mm"]["rms"] == pytest.approx((174.0 / 5.0) ** 0.5, abs=1e-4)
    assert arrays["stops"][:, 0].tolist() == [0.0, 0.0, 1.0, 1.0, 1.0]  # the run
    assert values["panels"] == {"piston_rms_um": 3.0, "tilt_rms_urad": None}
    assert values["danger"] == {"true_edges": 0, "false_edges": 2, "falls": 0, "max_overrun_mm": 0.5}
    assert (values["counts"], values["points"]["measured"]) == ({"fixes": 18}, 18)


def test_a_corrected_point_arrives_once_and_is_left_where_it_was_seen_last() -> None:
    values, _ = combine_missions({}, [mission([0.012, 0.001, 0.003], [1, 2, 1])])
    assert values["corrections"] == 1
    assert values["arrival_error_mm"]["max"] == 12.0
    assert values["nis"]["count"] == 3
    assert values["nees"]["position"]["count"] == 2
    assert values["after_correction_mm"] == {"max": 3.0, "true_max": 3.0}


def test_times_are_those_of_complete_missions() -> None:
    slow = mission([0.001], mission_time_s=130.0, states_s={"driving": 130.0})
    held = mission([0.001], outcome="held", cause="lost", mission_time_s=1.0)
    values, _ = combine_missions({}, [mission([0.001]), slow, held])
    assert (values["complete"], values["causes"]) == (2, ["lost"])
    assert (values["mission_time_s"], values["mission_time_max_s"]) == (120.0, 130.0)
    assert (values["time_ratio"], values["within_budget"]) == (1.2, 2)
    assert values["states_s"] == {"driving": 95.0, "turning": 25.0, "settling": 2.5, "measuring": 2.0}


def test_a_mission_that_reached_nothing_has_no_figures() -> None:
    values, _ = combine_missions({}, [mission([], outcome="held", cause="lost")])
    assert values["arrival_error_mm"]["mean"] is values["time_ratio"] is values["nees"]["pose"]["band_95"] is None
    assert values["after_correction_mm"] == {"max": None, "true_max": None}
    assert values["stop_error_mm"] == {"rms": None, "p50": None, "after_first_leg": {"rms": None, "p50": None}}
    plain(values)


def test_the_band_holds_the_mean_of_a_consistent_filter() -> None:
    rng = np.random.default_rng(1)
    means = [chi_square_figures(rng.chisquare(3, 200), 3) for _ in range(400)]
    share = np.mean([figures["is_within_band"] for figures in means])
    assert share == pytest.approx(0.95, abs=0.03)  # 3 sigmas of 400 draws
    half = 1.96 * (6.0 / 200) ** 0.5  # the normal distribution that chi-square with 600 degrees of freedom nearly is
    assert means[0]["band_95"] == pytest.approx([3.0 - half, 3.0 + half], abs=0.02)
    assert np.mean([figures["within_95_fraction"] for figures in means]) == pytest.approx(0.95, abs=0.01)
    assert chi_square_figures(np.full(200, 4.0), 3)["is_within_band"] is False


def test_a_real_mission_says_the_same_as_its_summary() -> None:
    cfg = load_config(None, {**ONE_PANEL, "run.mirror": "thesis-m1", "run.filter": "ekf", "run.world": "hard"})
    outcome = run_mission(Job("trial", {}, cfg.run.seed, cfg))
    values, _ = combine_missions({}, [outcome])
    # A summary is rounded to 1 um. Between its stop and the end of the measurement the fans shake the robot: by 7 um
    # rms at either time (1 mm/s over a frame), so by 10 um between the two, of which four sigmas are allowed.
    for name, tolerance_mm in (("localization_error_mm", 1e-3), ("arrival_error_mm", 0.04)):
        summary = outcome.values[name]
        assert values[name]["mean"] == pytest.approx(summary["mean"], abs=tolerance_mm)
        assert values[name]["max"] == pytest.approx(summary["max"], abs=tolerance_mm)
    assert values["points"] == outcome.values["points"]


# -- truth and estimate of a mission -----------------------------------------------------------------------------------

FRAMES, DELAY = 2500, 3  # more than two batches; frames by which the estimates lag behind the truth


def test_late_estimates_meet_their_truth_across_batches() -> None:
    parts = assemble(load_config(None, {"run.panels": 1}))
    base = parts.mirror.base_pose

    def true_row(seq: int) -> TruthRow:
        x_m, y_m = base.x_m + 1e-5 * seq, base.y_m
        return seq, 0.01 * seq, x_m, y_m, 0.0, *parts.mirror.surface_point(x_m, y_m), 1.0, 0, 0

    trace = SilTrace(parts)
    for seq in range(FRAMES):
        trace.note_truth(true_row(seq))
        if seq >= DELAY:
            trace.note_estimate(seq - DELAY, 0.01 * (seq - DELAY), parts.mirror.base_panel_pose)
    assert tuple(trace.truth_at(FRAMES - 1 - DELAY)) == true_row(FRAMES - 1 - DELAY)
    trace.builder.set_counts(measured=1, skipped=0)  # without a point there is no figure of the localization
    track, summary = trace.join(), trace.builder.build()
    assert track[:, 0] == pytest.approx(0.01 * np.arange(FRAMES - DELAY))
    assert track[:, 1] - track[:, 4] == pytest.approx(1e-5 * np.arange(FRAMES - DELAY), abs=1e-12)  # rounding
    assert track[:, 5] == pytest.approx(base.y_m, abs=1e-12)
    assert summary["localization_error_mm"]["max"] == pytest.approx(1e-2 * (FRAMES - DELAY - 1), rel=0.02)  # slope


# -- the study `faults` -----------------------------------------------------------------------------------------------


def test_a_plan_lies_within_its_mission_and_is_of_its_seed() -> None:
    plan = random_plan(7, 40, 500.0)
    assert plan == random_plan(7, 40, 500.0) != random_plan(8, 40, 500.0)
    assert len(plan.faults) == 40
    assert all(FIRST_S <= fault.at_s <= 500.0 and fault.end_s - fault.at_s <= LONGEST_S for fault in plan.faults)
    assert max(fault.at_s for fault in plan.faults) > 400.0


@pytest.mark.parametrize(
    ("signal", "mirror", "is_so"), [("fans", "fyst-m2", False), ("fans", "fyst-m1", True), ("soc", "fyst-m2", True)]
)
def test_fans_that_seem_to_fail_on_an_overhang_wait_for_an_operator(signal: str, mirror: str, is_so: bool) -> None:
    plan = plan_of(f"{signal} off at_s=5.0")
    assert is_recoverable(plan, build_mirror(load_config(None, {"run.mirror": mirror}).mirror)) is is_so


def test_a_cell_names_the_missions_that_are_not_complete() -> None:
    injected: Any = {"injected": {"planned": 12, "acted": 11}}
    ended: Any = {"is_recoverable": False, "weak_frames": 4, "outcome": "faulted", "cause": "held"}
    whole = mission([0.001], seed=1, is_recoverable=True, weak_frames=0, **injected)
    values, _ = faults_study.STUDY.combine({}, [whole, mission([0.001], seed=2, **ended, **injected)])
    assert (values["complete"], values["ended"]) == (1, ["seed 2 faulted: held"])
    assert values["recoverable"] == {"runs": 1, "complete": 1}
    assert (values["danger"]["false_edges"], values["weak_frames"]) == (2, 4)
    assert (values["injected"]["acted"], values["points"]["total"], values["time_ratio"]) == (22, 18, 1.1)


# -- memory over a day -------------------------------------------------------------------------------------------------


DAY_FRAMES = 24 * 3600 * 100
MOST_IN_A_DAY_BYTES = 5 << 20
# Caches fill; then the frames that are compared. Half way between two hand-overs of a thousand frames to the summary.
WARM_UP_FRAMES, COMPARED_FRAMES = 12_500, 40_000
# A point that was measured is kept with its fix.
POINT_BYTES = 4096
# A run in one process keeps its whole track for the study of it; a daemon records it.
TRACK = [tracemalloc.Filter(inclusive=False, filename_pattern=str(one.__file__)) for one in (sil_run, run_reader)]


class Enough(Exception):
    """The frames that are compared have been served."""


class MeasuredRun(SilRun):
    """Traced memory after the warm-up and at the end, and how many points were done then."""

    def __init__(self, *, is_paused: bool) -> None:
        super().__init__(load_config())
        self._is_paused, self._frames = is_paused, 0
        self.bytes: list[int] = []
        self.points: list[int] = []

    def _note_truth(self) -> None:
        super()._note_truth()
        self._frames += 1
        if self._frames == 1000 and self._is_paused:
            self.mission.handle(Pause(Cause("operator")))
        if self._frames in (WARM_UP_FRAMES, WARM_UP_FRAMES + COMPARED_FRAMES):
            gc.collect()
            left = tracemalloc.take_snapshot().filter_traces(TRACK)
            self.bytes.append(sum(trace.size for trace in left.traces))
            self.points.append(len(self.mission.state.points.done))
            if len(self.bytes) == 2:
                raise Enough


@pytest.mark.slow
@pytest.mark.parametrize("is_paused", [True, False], ids=["held", "driving"])
def test_frames_leave_nothing_behind(is_paused: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(summary, "HISTORY_ROWS", 5000)  # bounded, but as it is full only after the warm-up
    run = MeasuredRun(is_paused=is_paused)
    tracemalloc.start()
    try:
        with pytest.raises(Enough):
            run.run()
    finally:
        tracemalloc.stop()
    grown, points = run.bytes[1] - run.bytes[0], run.points[1] - run.points[0]
    assert (points == 0) is is_paused
    assert grown - points * POINT_BYTES <= MOST_IN_A_DAY_BYTES * COMPARED_FRAMES / DAY_FRAMES


# -- every study by its command, on one or two cells: its configurations, figures and files ----------------------------

CAMPAIGNS = {name: study for name in STUDIES if isinstance(study := find_study(name), Study)}
ONE_PANEL_ARGS = ("--panels", "1", "--set", "mission.calibration_length_m=0")  # a mission of a minute
RECORDINGS = RADIO_DATA
FEW_STEPS = ("--set", "run.steps=300")

# Choices of cells, further arguments, and the stems of all figures.
RUNS: dict[str, tuple[tuple[str, ...], tuple[str, ...], str]] = {
    "thesis": (
        ("noise=normal", "system=thesis", "noise_is_variance=True", "period_error=0.008"), ONE_PANEL_ARGS,
        "trajectory_normal localization_normal waypoints_normal",
    ),
    "filters": (
        ("world=thesis", "filter=ekf"), ONE_PANEL_ARGS,
        "localization-thesis-m1 arrival-thesis-m1 bound-thesis-m1 consistency-thesis-m1",
    ),
    "time": (("order=thesis", "v_max_m_s=0.2", "measuring_time_s=0.5"), ONE_PANEL_ARGS, "time-thesis-m1"),
    "sensitivity": (("group=none",), ONE_PANEL_ARGS, "sensitivity-thesis-m1"),
    "ablation": (("world=hard", "without=nothing"), ONE_PANEL_ARGS, "ablation-thesis-m1-hard"),
    "danger": (
        ("speed_m_s=0.2", "crossing=0,turn"), ("--mirror", "thesis-m1"),
        "danger_false_edges_thesis-m1 danger_overrun_thesis-m1",
    ),
    "faults": (("faults=random",), ("--mirror", "thesis-m1", *ONE_PANEL_ARGS), "faults"),
    "physics": (("mirror=fyst-m1", "tyre=flat", "friction=0.8", "margin=1.3"), ONE_PANEL_ARGS, "physics-fyst-m1-130"),
    "bodies": (("mirror=fyst-m1", "tyre=flat", "body=2"), ONE_PANEL_ARGS, "bodies-fyst-m1"),
    "stops": (("mirror=fyst-m1", "tyre=round", "thrust=shipped", "speed=safe"), (), "stops-fyst-m1"),
    "slides": (("mirror=fyst-m1", "friction=0.1"), (), "slides"),
    "cricket": (("case=zigzag-printed,all-printed,batch-45-once",), (), "figure_11_12 figure_14 figure_9_10_13 ways"),
    "recordings": (
        ("data=Plaza2,XBee scenario 1", "estimator=ekf-slam,fingerprints"), ("--data", str(RECORDINGS)), "recordings",
    ),
    "traits": (("traits=plain", "estimator=ekf-slam"), (), ""),
    "damage": (("damage=5 % ranges of 0 m", "estimator=ekf-slam"), ("--data", str(RECORDINGS / "plaza")), ""),
    "mote-navigation": ((), ("--set", "mission.laps=1"), "mote_navigation"),
    "radio-signals": (("condition=white 2 dB",), (), "radio_signals"),
    "radio-slam": (("room=3 m", "condition=white", "every=30"), FEW_STEPS, "radio_slam"),
    "radio-cases": (("case=I",), FEW_STEPS, "radio_cases"),
    "radio-follow": (
        ("case=ideal", "condition=as printed"), FEW_STEPS, "radio_follow_target radio_follow_beacons",
    ),
}  # fmt: skip


def has(cell: Any, key: str) -> bool:
    for part in key.split("."):
        if part not in cell:
            return False
        cell = cell[part]
    return True


# The others share their code, or that of the missions with a rigid body, which take a quarter of a minute.
SLOW = ("ablation", "bodies", "cricket", "damage", "faults", "physics", "sensitivity", "slides", "stops", "time")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in CAMPAIGNS]
)
def test_a_study_writes_its_figures_and_all_that_its_table_shows(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    only, args, stems = RUNS[name]
    if any(str(RECORDINGS) in arg for arg in args) and not RECORDINGS.is_dir():
        pytest.skip(f"no recorded data at {RECORDINGS}")
    chosen = [word for choice in only for word in ("--only", choice)]
    line = ["study", name, "--runs", "1", "--workers", "1", "--out", str(tmp_path), "--json", *chosen, *args]
    assert main(line) == 0
    cells = json.loads(capsys.readouterr().out)["cells"]
    assert all(cell["runs"] == 1 for cell in cells)
    assert all(cell.get("complete", 1) == 1 for cell in cells)
    for key in columns_of(CAMPAIGNS[name].columns):
        assert any(has(cell, key) for cell in cells), key
    figures = {path.name for path in tmp_path.iterdir() if path.suffix in {".png", ".pdf"}}
    assert figures == {f"{stem}{suffix}" for stem in stems.split() for suffix in (".png", ".pdf")}
    assert len((tmp_path / "table.md").read_text().splitlines()) == 4 + len(cells)


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_cells_are_configurations_of_their_own(name: str) -> None:
    study = CAMPAIGNS[name]
    cells = cells_of(study)
    load = study.loader.get()
    plan = jobs_of(study, cells, lambda keys: load(None, keys), {}, 1)
    configurations = [group[0].cfg.model_dump_json() for group in plan]
    if name not in {
        "cricket",
        "danger",
        "radio-signals",
        "faults",
        "recordings",
        "damage",
        "traits",
    }:  # their jobs look at the factors
        assert len(set(configurations)) == len(configurations)
    assert len({str(cell.factors) for cell in cells}) == len(cells)


def test_a_body_is_drawn_by_its_number_within_the_ranges() -> None:
    cells = [cell for cell in body_cells() if (cell.factors["mirror"], cell.factors["tyre"]) == ("fyst-m1", "flat")]
    drawn = [dict(cell.overrides) for cell in cells]
    assert len(drawn) == 8
    for number, keys in enumerate(drawn, 1):
        own = drawn_body(number)
        assert {name: keys[name] for name in own} == own == drawn_body(number)
        physics = load_config(None, keys).sim.physics
        for name, (low, high) in BODY_RANGES.items():
            assert low <= getattr(physics, name) == own[f"sim.physics.{name}"] <= high
    assert len({keys["sim.physics.accelerometer_s"] for keys in drawn}) == 8
