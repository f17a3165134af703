"""The study `thesis`: readings of its text, its localizer and its published figures."""

from pathlib import Path

import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.core import EdgeSample, Fix, ImuSample, WheelSample
from ccatp.estimation.thesis_localizer import STATES
from ccatp.filters import FILTERS
from ccatp.mirror.mirror import build_mirror
from ccatp.studies.campaign import CellResult, Job, JobOutcome
from ccatp.studies.mission_study import Histogram
from ccatp.studies.thesis_study import PUBLISHED, ThesisLocalizer, cells, combine, draw, overrides_of, run_job


@pytest.mark.parametrize(("noise", "table"), [("normal", 0.0087), ("twice", 0.0175)])
@pytest.mark.parametrize("noise_is_variance", [False, True])
def test_the_table_is_read_as_sigma_or_as_variance(noise: str, table: float, noise_is_variance: bool) -> None:
    cfg = load_config(overrides=overrides_of(noise, noise_is_variance=noise_is_variance, period_error=0.013))
    expected = table**0.5 if noise_is_variance else table
    assert cfg.world.gyroscope_sigma_rad_s == pytest.approx(expected)
    assert cfg.localizer.gyroscope_sigma_rad_s == cfg.world.gyroscope_sigma_rad_s  # R follows, thesis 2.3.1
    sim = cfg.sim.robot
    assert sim.frame_hz == pytest.approx(100.0 / 1.013)
    assert sim.frame_hz == sim.imu_hz == sim.encoder_hz  # one sample per frame


CFG = load_config(overrides=overrides_of("normal", noise_is_variance=False, period_error=0.0))
MIRROR = build_mirror(CFG.mirror)


def built() -> ThesisLocalizer:
    filter_ = FILTERS["kf"](np.zeros(STATES), np.eye(STATES))
    return ThesisLocalizer(filter_, MIRROR, CFG.robot, CFG.localizer, MIRROR.base_panel_pose)


def step(localizer: ThesisLocalizer, t_s: float, rate: float) -> None:
    localizer.step(t_s, [ImuSample(t_s, 0.0, 0.0)], [WheelSample(t_s, rate, rate)], [EdgeSample(t_s, 1, 1, 1, 1)])


def test_a_fixed_step_believes_in_a_shorter_way() -> None:
    localizer, start = built(), MIRROR.base_panel_pose
    localizer.period_factor = 1.013
    period_s, rate = 0.01 * 1.013, 0.1 / CFG.robot.wheel_radius_m
    for k in range(101):
        step(localizer, k * period_s, rate)
    pose = localizer.pose
    way_m = np.hypot(pose.x_m - start.x_m, pose.y_m - start.y_m)
    # 100 steps of 10 ms at 0.1 m/s, less what the filter needs to find the speed.
    assert way_m == pytest.approx(0.1, abs=1e-3)
    # A fix carries the true time; the localizer's own would be earlier than its path by now.
    x, y, z = MIRROR.puck_world(localizer.deck_pose, CFG.robot.puck_height_m)
    t_s = 100 * period_s
    localizer.fuse_fix(Fix(t_s, (x, y, z), (1e-10, 0, 0, 0, 1e-10, 0, 0, 0, 1e-10), 1.0, (1, 2, 3, 4), 0.0))
    assert localizer.counts["fixes"] == 1


def test_only_a_filter_with_a_fixed_step_can_have_a_period_error() -> None:
    cfg = load_config(overrides=overrides_of("normal", noise_is_variance=False, period_error=0.0, is_ours=True))
    with pytest.raises(ValueError, match="'ekf' reads time stamps: only kf can have a period error"):
        run_job(Job("thesis", {"period_error": 0.013}, 1, cfg))


def test_the_cells_are_all_readings_of_both_systems() -> None:
    factors = [cell.factors for cell in cells()]
    assert len(factors) == 14
    assert sum(f["system"] == "thesis" for f in factors) == 10
    assert not any(f["period_error"] for f in factors if f["system"] == "ours")
    for cell in cells():
        load_config(overrides=cell.overrides)


def outcome(fraction: float, mean: float) -> JobOutcome:
    figures = {"within_10mm_fraction": fraction, "mean": mean, "max": 20.0}
    values = {"outcome": "complete", "cause": "", "waypoints": 36, "wanted": 36, "time_s": 500.0}
    localization = Histogram.of(np.linspace(0.0, 0.02, 100)).to_arrays("localization")
    track = np.tile(np.linspace(0.0, 1.0, 20, dtype=np.float32)[:, None], 5)
    arrays: dict[str, np.ndarray] = {"waypoint_m": np.linspace(0.0, 0.02, 36), "track": track, **localization}
    return JobOutcome({**values, "localization": figures, "waypoint": figures}, arrays)


def test_a_published_figure_is_measured_in_scatters_of_a_run() -> None:
    values, _ = combine({"noise": "normal"}, [outcome(0.9, 3.0), outcome(1.0, 4.0)])
    found = values["localization"]["within_10mm_fraction"]
    assert found["mean"] == pytest.approx(0.95)
    assert found["run_to_run"] == pytest.approx(0.1 / 2.0**0.5)
    # One run there, two here.
    assert found["published_minus_mean_in_scatters"] == pytest.approx(0.0121 / (0.1 / 2.0**0.5 * 1.5**0.5))
    assert found["is_published_within"] is True
    assert values["waypoint"]["mean"]["is_published_within"] is False  # 6.4 mm, 3.5 and 0.7
    assert values["waypoint"]["max"]["is_published_within"] is None  # the largest of five runs is no mean
    assert values["localization"]["is_published_within"] is False  # share and mean are, the largest is not
    assert values["complete"] == 2


def test_every_figure_of_the_thesis_is_drawn(tmp_path: Path) -> None:
    results = []
    for cell in cells():
        values, arrays = combine(cell.factors, [outcome(0.9, 3.0), outcome(1.0, 4.0)])
        results.append(CellResult(cell.factors, values, arrays))
    draw(results, tmp_path)
    stems = ("trajectory", "localization", "waypoints")
    assert {path.name for path in tmp_path.glob("*.png")} == {f"{s}_{noise}.png" for s in stems for noise in PUBLISHED}


@pytest.mark.slow
def test_a_whole_run_reaches_all_waypoints() -> None:
    found = run_job(Job("thesis", {"period_error": 0.0}, CFG.run.seed, CFG))
    assert (found.values["outcome"], found.values["waypoints"]) == ("complete", 36)
    assert found.values["localization"]["mean"] < 1.0  # a quiet world: white noise of the table, no disturbance
