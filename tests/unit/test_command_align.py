"""The command ``ccatp align``: on surveys in process on all mirrors, its JSON, its files, its refusals."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.cli import main
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import Fix, PanelId, PointId
from ccatp.localizer import Localizer
from ccatp.mirror.misalignment import PanelMisalignment
from ccatp.mirror.panel_alignment import Measured
from ccatp.studies.sil_run import SilLaser, SilRun, StopRow
from tests.support.command import answered
from tests.support.scenario import MIRRORS, world_of
from tests.unit.aligning.conftest import exact_fix, misaligned, survey
from tests.unit.run_folder import make_run

CFG, M1 = world_of()
PANEL = PanelId(3, 7)
LIES = PanelMisalignment(40e-6, -90e-6, 120e-6)


class KeepingDesk(SilLaser):
    """Keeps the fix that counts for each point, as the daemon's database does."""

    def is_too_far(self, row: StopRow, point: PointId, fix: Fix, distance_m: float, localizer: Localizer) -> bool:
        is_too_far = super().is_too_far(row, point, fix, distance_m, localizer)
        if not is_too_far:
            self.kept.append(Measured(point, fix))
        return is_too_far

    kept: list[Measured]


def surveyed(run_dir: Path, cfg: Config) -> Path:
    """The run directory of a survey in process."""
    run = SilRun(cfg)
    run.laser = desk = KeepingDesk(cfg, run.mirror, run.robot)
    desk.kept = []
    assert run.run().outcome == "complete"
    return make_run(run_dir, cfg, run.parts.points, desk.kept, run.robot.world.misalignments)


def aligned(capsys: pytest.CaptureFixture[str], run_dir: Path, *args: str) -> Any:
    return answered(capsys, "align", run_dir, *args)


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """One panel measured, one begun, one to come; on one point lay something."""
    rng = np.random.default_rng(1)
    truth = misaligned(CFG, M1.panels, rng) | {PANEL: LIES}
    begun, to_come = PanelId(3, 8), PanelId(3, 9)
    planned = [point for panel in (PANEL, begun, to_come) for point in M1.point_ids(panel)]
    measured = survey(CFG, M1, {PANEL: LIES, begun: truth[begun]}, rng)[:11]
    high = PanelMisalignment(LIES.piston_m + 300e-6, LIES.tip_rad, LIES.tilt_rad)
    measured[5] = exact_fix(M1, measured[5].point, high)
    return make_run(tmp_path / "run", CFG, planned, measured, truth)


@pytest.mark.parametrize("name", [MIRRORS[0], *(pytest.param(name, marks=pytest.mark.slow) for name in MIRRORS[1:])])
def test_a_survey_recovers_what_was_simulated(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cfg = load_config(overrides={"run.mirror": name, "run.panels": 1, "mission.calibration_length_m": 0.0})
    found = aligned(capsys, surveyed(tmp_path / "run", cfg))
    assert (found["mirror"], found["world"], found["warnings"]) == (name, "thesis", [])
    assert found["points"] == {"total": 9, "measured": 9, "outliers": 0}
    truth = found["truth"]
    assert (truth["panels"], truth["dof"], truth["agrees"]) == (1, 3, True)
    assert truth["band_99"][0] < truth["chi2"] < truth["band_99"][1]
    assert truth["piston_rms_um"] < 3.0
    assert found["rms_after_um"] < 2.0 < found["rms_before_um"]


def test_the_json_is_that_of_the_contract(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = aligned(capsys, run_dir)
    (panel,) = found["panels"]
    assert {"row", "col", "piston_um", "tip_urad", "tilt_urad", "sigma", "adjusters_um", "chi2"} <= set(panel)
    assert (panel["row"], panel["col"]) == PANEL
    assert panel["piston_um"] == pytest.approx(40.0, abs=3.0)
    assert panel["tip_urad"] == pytest.approx(-90.0, abs=15.0)
    assert panel["tilt_urad"] == pytest.approx(120.0, abs=15.0)
    assert (len(panel["sigma"]), len(panel["adjusters_um"]), panel["dof"]) == (3, 5, 5)
    assert found["adjusters"] == ["V1", "V2", "V3", "V4", "V5"]
    assert panel["adjusters_um"][4] == -panel["piston_um"]  # the fifth is at the centre; > 0 towards the robot
    assert (panel["outliers"], found["points"]["outliers"]) == ([6], 1)
    assert [one["is_outlier"] for one in panel["deviations"]] == [False] * 5 + [True] + [False] * 3
    assert panel["deviations"][5]["residual_um"] == pytest.approx(300.0, abs=10.0)
    assert found["rms_after_um"] < 5.0 < found["rms_before_um"]
    assert [(one["row"], one["col"], one["points"]) for one in found["undetermined"]] == [(3, 8, 2), (3, 9, 0)]


def test_the_table_tells_the_same(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["align", str(run_dir)]) == 0
    out, err = capsys.readouterr()
    assert "fyst-m1, simulation, world thesis, seed 1\n11 of 27 points measured, 1 of them left out\n" in out
    assert "\n3/7         8 " in out
    assert "left out: 3/7/6" in out
    assert "panel 3/8 not determined: 2 of 3 points that it takes\n1 panel not measured\n" in out
    assert "half-wavefront error" in out
    assert "inside its 99 % band" in out
    assert err == "ccatp: warning: panel 3/7: left out as outliers: 3/7/6; measure them again\n"


def test_a_survey_without_a_panel_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_dir = make_run(tmp_path / "run", CFG, M1.point_ids(PANEL), [], None)
    found = aligned(capsys, run_dir)
    assert (found["panels"], found["rms_before_um"], found["rms_after_um"]) == ([], None, None)
    assert (found["truth"], found["world"]) == (None, None)
    assert main(["align", str(run_dir)]) == 0
    assert "1 panel not measured" in capsys.readouterr().out


def test_the_csv_has_a_line_a_panel_and_the_figure_is_drawn(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "panels.pdf"
    found = aligned(capsys, run_dir, "--csv", str(tmp_path / "moves.csv"), "--figure", str(picture))
    assert picture.read_bytes().startswith(b"%PDF")
    with (tmp_path / "moves.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["row"], row["col"], row["points"], row["outliers"], row["is_bent"]) == ("3", "7", "9", "6", "0")
    assert [float(row[f"V{k}_um"]) for k in range(1, 6)] == found["panels"][0]["adjusters_um"]
    assert float(row["sigma_piston_um"]) == found["panels"][0]["sigma"][0]


def test_settings_act(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    usual = aligned(capsys, run_dir)["panels"][0]
    higher = aligned(capsys, run_dir, "--set", "robot.puck_height_m=0.0501")["panels"][0]
    assert higher["piston_um"] == pytest.approx(usual["piston_um"] - 100.0, abs=0.2)
    floor = aligned(capsys, run_dir, "--set", "align.point_floor_m=1e-3")["panels"][0]
    assert floor["sigma"][0] == pytest.approx(1e3 / 3, rel=0.01)
    assert floor["outliers"] == []


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--csv", "nowhere/moves.csv"], "--csv: no directory nowhere; make it first"),
        (["--set", "run.seed=2"], "run.seed: has no effect on the alignment; what has: align., robot.puck_height_m"),
        (["--set", "align.false_alarm=2"], "align.false_alarm"),
        (
            ["--set", "align.light.fyst-m1.direction_world=[0.0, 0.0, 0.0]"],
            "direction_world = [0, 0, 0] is no direction",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    args: list[str], message: str, run_dir: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["align", str(run_dir), *args]) == 2
    out, err = capsys.readouterr()
    *warnings, line = err.splitlines()
    assert all("warning" in one for one in warnings)
    assert message in line
    assert out == ""


def test_a_csv_that_cannot_be_written_and_no_run_are_errors(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run_dir / "dir.csv").symlink_to("/dev/full")
    assert main(["align", str(run_dir), "--csv", str(run_dir / "dir.csv")]) == 2
    assert "--csv: cannot write" in capsys.readouterr().err
    (run_dir / "config.toml").unlink()
    assert main(["align", str(run_dir)]) == 2
    assert capsys.readouterr().err == f"ccatp: {run_dir}: no config.toml there; name the directory of a run\n"
