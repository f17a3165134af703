"""Missions of a cell, pooled."""

import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.studies.campaign import Job, plain
from ccatp.studies.mission_study import COLUMN, chi_square_figures, combine_missions, nees, run_mission
from tests.unit.studies.missions import SIGMA_M, mission, stops_of


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
    assert values["arrival_error_mm"]["mean"] is None
    assert values["time_ratio"] is None
    assert values["nees"]["pose"]["band_95"] is None
    assert values["after_correction_mm"] == {"max": None, "true_max": None}
    assert values["stop_error_mm"] == {"rms": None, "p50": None, "after_first_leg": {"rms": None, "p50": None}}
    plain(values)


def test_normalised_errors_are_those_of_the_covariance() -> None:
    rows = stops_of([2.0 * SIGMA_M, 0.0])
    rows[1, [COLUMN["error_heading_rad"], COLUMN["p_hh"]]] = 0.3, 0.01
    assert nees(rows, 3) == pytest.approx([4.0, 9.0])
    assert nees(rows, 2) == pytest.approx([4.0, 0.0])
    rows[0, COLUMN["p_xx"]] = -1.0
    assert np.isnan(nees(rows, 3)[0])


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
    cfg = load_config(None, {"run.mirror": "thesis-m1", "run.panels": 1, "run.filter": "ekf", "run.world": "hard"})
    outcome = run_mission(Job("trial", {}, cfg.run.seed, cfg))
    values, _ = combine_missions({}, [outcome])
    # A summary is rounded to 1 um. Between its stop and the end of the measurement the fans shake the robot: by 7 um
    # rms at either time (1 mm/s over a frame), so by 10 um between the two, of which four sigmas are allowed.
    for name, tolerance_mm in (("localization_error_mm", 1e-3), ("arrival_error_mm", 0.04)):
        summary = outcome.values[name]
        assert values[name]["mean"] == pytest.approx(summary["mean"], abs=tolerance_mm)
        assert values[name]["max"] == pytest.approx(summary["max"], abs=tolerance_mm)
    assert values["points"] == outcome.values["points"]
