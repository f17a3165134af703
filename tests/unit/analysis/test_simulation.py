"""A survey that is simulated in this process has the tables of a recorded one."""

from pathlib import Path

import numpy as np
import pytest

import ccatp
from ccatp.analysis.survey import SurveyRun
from ccatp.conditions.mission import LASER_NOT_FOLLOWING
from ccatp.core import PanelId
from ccatp.errors import ConfigError
from ccatp.studies.sil_run import rehearse
from tests.support.scenario import config_of

HARD = {"mirror": "fyst-m2", "seed": 4, "world": "hard"}
NO_DRIVE = {"mission.calibration_length_m": 0.0}  # the calibration drive takes as long as a panel


@pytest.fixture(scope="module")
def run() -> SurveyRun:
    return ccatp.simulate(**HARD, panels=1, settings=NO_DRIVE)  # type: ignore[arg-type]


def test_it_is_the_survey_of_its_configuration(run: SurveyRun) -> None:
    keys = {"run__seed": 4, "run__world": "hard", "run__panels": 1, "mission__calibration_length_m": 0.0}
    result = rehearse(config_of("fyst-m2", **keys))
    track = run.track()
    columns = ("true_x_m", "true_y_m", "true_heading_rad", "x_m", "y_m", "heading_rad")
    assert np.array_equal(np.column_stack([track[name] for name in columns]), result.track[:, 1:])
    assert run.summary == result.summary
    assert run.findings.outcome.text == "complete"


def test_points_panels_and_samples(run: SurveyRun) -> None:
    assert list(run.points["status"]) == ["measured"] * 9
    assert run.points["first_arrival_mm"].max() < 10.0  # the requirement
    assert run.summary is not None
    assert run.points["first_arrival_mm"].max() == pytest.approx(
        run.summary["arrival_error_mm"]["max"], abs=5e-4
    )  # rounded to 1 um
    (panel,) = run.panels
    injected = run.findings.record.injected
    assert injected is not None
    piston_m, _, _ = injected[PanelId(int(panel["row"]), int(panel["col"]))]
    assert abs(panel["piston_um"] - 1e6 * piston_m) < 5.0 * panel["sigma_piston_um"]
    imu, track = run.samples("imu"), run.track()
    true_rad_s = np.gradient(np.unwrap(track["true_heading_rad"]), track["t_s"])
    likeness = [
        np.corrcoef(imu["wz_rad_s"], np.interp(imu["t_s"] + by_s, track["t_s"], true_rad_s))[0, 1]
        for by_s in (0.0, 0.5)
    ]
    assert likeness[0] > 0.9 > likeness[1]  # also in the noise of the hard world, and at no other time


def test_times_of_all_tables_agree_where_the_clock_of_the_robot_is_set_back(tmp_path: Path) -> None:
    """By the truth: the robot stands where a fix is taken, and the gyroscope sees its turns."""
    plan = tmp_path / "plan.toml"
    plan.write_text('[[fault]]\nsignal = "clock"\ntype = "jump"\nat_s = 30.0\nby_s = -25.0\n')
    run = ccatp.simulate(mirror="fyst-m2", seed=4, world="thesis", panels=1, faults=plan, settings=NO_DRIVE)
    track, imu, fixes = run.track(), run.samples("imu"), run.fixes
    assert (np.diff(track["t_s"]) > 0.0).all()
    turned_rad = np.interp(imu["t_s"], track["t_s"], np.unwrap(track["true_heading_rad"]))
    assert np.abs(np.cumsum(imu["wz_rad_s"] * 0.01) - (turned_rad - turned_rad[0])).max() < 0.02  # noise of a minute
    assert fixes["t_s"].max() > 40.0
    for fix_s in fixes["t_s"]:
        standing = (track["t_s"] > fix_s - 0.1) & (track["t_s"] <= fix_s)
        assert np.ptp(track["true_x_m"][standing]) < 1e-3  # the robot stands, which drives 0.01 m in this time


def test_pose_and_sigma_of_a_row_belong_to_one_moment(run: SurveyRun) -> None:
    """A fix moves the pose by many of the sigmas that it leaves."""
    track = run.track()
    error_m = np.hypot(track["x_m"] - track["true_x_m"], track["y_m"] - track["true_y_m"])
    shaken_m = 2e-4  # the body shakes at rest in this world, which no sigma of a place contains
    assert np.max(error_m - 6.0 * track["sigma_m"]) < shaken_m


def test_a_fault_plan_acts_on_robot_and_laser(tmp_path_factory: pytest.TempPathFactory) -> None:
    plan = tmp_path_factory.mktemp("plan") / "plan.toml"
    fault = '[[fault]]\nsignal = "encoder_{}"\ntype = "off"\nat_s = 25.0\nfor_s = 1.0\n'
    laser = '[[fault]]\nsignal = "laser"\ntype = "offset"\nchannel = 3\nat_s = 0.0\nfor_s = 1e6\noffset_m = 1e-3\n'
    plan.write_text(fault.format("right") + fault.format("left") + laser)
    run = ccatp.simulate(**HARD, panels=1, faults=plan, settings=NO_DRIVE, keep_samples=False)  # type: ignore[arg-type]
    (alarm,) = run.alarms[run.alarms["name"] == "encoders_stale"]
    assert 25.0 < alarm["raised_t_s"] < 25.5
    assert alarm["ended_t_s"] > alarm["raised_t_s"]
    assert set(run.fixes["left_out"]) == {"3"}
    with pytest.raises(ValueError, match="this simulation kept no samples: simulate with keep_samples=True"):
        run.samples("imu")


def test_a_laser_that_does_not_follow_ends_a_simulation_as_it_ends_a_run(tmp_path: Path) -> None:
    """The daemon's checks of a fix are made here, too: no point is measured where the robot is not."""
    (tmp_path / "plan.toml").write_text('[[fault]]\nsignal = "laser"\ntype = "at_rest"\nat_s = 8.0\nfor_s = 20.0\n')
    run = ccatp.simulate(panels=1, seed=1, faults=tmp_path / "plan.toml", settings=NO_DRIVE, keep_samples=False)
    measured = run.points[run.points["status"] == "measured"]
    assert len(measured) == 2
    assert float(measured["measured_at_mm"].max()) < 10.0
    assert run.findings.outcome.text == "ended with status 4, held"
    assert run.findings.outcome.cause.startswith(LASER_NOT_FOLLOWING.message.split("{")[0].strip())


def test_a_value_that_cannot_be_used_is_one_line() -> None:
    with pytest.raises(ConfigError, match=r'run\.mirror = "fyst-m9" is no mirror; did you mean fyst-m2'):
        ccatp.simulate(mirror="fyst-m9")
    with pytest.raises(ConfigError, match="no_such_key"):
        ccatp.simulate(settings={"run.no_such_key": 1})
