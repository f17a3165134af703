"""``ccatp radio slam``: the contract's JSON, the table, the picture, one line for each fault."""

import json
from pathlib import Path

import numpy as np
import pytest

from ccatp.cli import main
from ccatp.filters import FilterDiverged
from tests.unit.beacons.datasets.sets import (
    BEACONS,
    csv_lines,
    labyrinth_lines,
    world,
    write_lines,
    write_mrclam,
    write_plaza,
)

CONTRACT = {
    "dataset", "filter", "trajectory_rmse_m", "heading_rmse_rad", "beacon_rmse_m", "beacons", "range_scale",
    "range_offset_m", "nis_mean", "nees_mean", "updates", "update_us_p50", "warnings",
}  # fmt: skip


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A minute of a simulated run."""
    return write_lines(tmp_path_factory.mktemp("csv") / "mine.csv", csv_lines(world(seconds=60.0)))


@pytest.mark.parametrize("filter_name", ["ekf-slam", "smoother"])
def test_json_is_the_contracts(recording: Path, filter_name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["radio", "slam", str(recording), "--filter", filter_name, "--json"]) == 0
    out, err = capsys.readouterr()
    data = json.loads(out)
    assert set(data) >= CONTRACT
    assert data["dataset"] == "mine"
    assert data["filter"] == filter_name
    assert data["trajectory_rmse_m"] < 0.1
    assert data["heading_rmse_rad"] < 0.1
    assert data["beacon_rmse_m"] < 0.2
    assert set(data["beacons"]) == set(BEACONS)
    offsets = [np.hypot(*np.subtract(data["beacons"][name], place)) for name, place in BEACONS.items()]
    assert np.sqrt(np.mean(np.square(offsets))) == pytest.approx(data["beacon_rmse_m"])
    assert data["range_scale"] == pytest.approx(1.0, abs=0.1)
    assert data["updates"] > 200
    assert data["update_us_p50"] > 0.0
    assert (data["nis_mean"] is None) == (filter_name == "smoother")
    assert data["nees_mean"] > 0.0
    assert all(warning in err for warning in data["warnings"])


def test_what_is_not_known_is_null(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write_plaza(tmp_path, world(seconds=60.0), mat=False)
    (tmp_path / "Field1_GT.txt").unlink()
    (tmp_path / "Field1_TL.txt").unlink()
    assert main(["radio", "slam", str(file), "--json", "--filter", "smoother"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["trajectory_rmse_m"] is data["heading_rmse_rad"] is data["beacon_rmse_m"] is data["nees_mean"] is None
    assert len(data["beacons"]) == len(BEACONS)


@pytest.mark.parametrize("filter_name", ["ekf-slam", "smoother"])
def test_a_truth_of_one_row_is_no_trajectory(
    tmp_path: Path, filter_name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = labyrinth_lines(world(seconds=30.0))
    first = next(line for line in lines if line.startswith("gt2"))
    file = write_lines(tmp_path / "lab.txt", [first, *(line for line in lines if not line.startswith("gt2"))])
    assert main(["radio", "slam", str(file), "--json", "--filter", filter_name]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["trajectory_rmse_m"] is data["nees_mean"] is None
    assert data["beacon_rmse_m"] < 0.5
    assert "no reference trajectory: the truth has 1 row" in data["warnings"][-1] + data["warnings"][0]


def test_the_table_names_what_was_found(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["radio", "slam", str(recording), "--filter", "smoother"]) == 0
    out = capsys.readouterr().out
    for word in ("mine (csv): 60 s", "smoother: ", "m rms, heading", "range_scale 1.0", "NEES"):
        assert word in out
    rows = [line.split() for line in out.splitlines()[-len(BEACONS) :]]
    assert {row[0] for row in rows} == set(BEACONS)


def test_settings_change_what_is_assumed(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changes = ["--set", "csv.priors.range_scale=0.0"]
    assert main(["radio", "slam", str(recording), "--json", "--filter", "smoother", *changes]) == 0
    assert json.loads(capsys.readouterr().out)["range_scale"] is None


def test_the_robot_is_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_mrclam(tmp_path, world(seconds=30.0), robot=3)
    assert main(["radio", "slam", str(tmp_path), "--robot", "3", "--json", "--filter", "smoother"]) == 0
    assert json.loads(capsys.readouterr().out)["dataset"].endswith("robot 3")


@pytest.mark.parametrize("filter_name", ["ekf-slam", "smoother"])
def test_the_picture(recording: Path, tmp_path: Path, filter_name: str, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "map.png"
    assert main(["radio", "slam", str(recording), "--filter", filter_name, "--figure", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    capsys.readouterr()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["missing"], "missing: no such file or folder"),
        (["{csv}", "--robot", "1"], "a csv set has one vehicle: leave out --robot"),
        (["{csv}", "--format", "labyrinth"], "mine.csv:2: 'event,time_s,...' is none of range2"),
        (["{csv}", "--format", "lidar"], "'lidar' is not one of"),
        (["{csv}", "--filter", "particle"], "'particle' is not one of"),
        (["{csv}", "--figure", "{tmp}/no/map.png"], "--figure: no directory"),
        (["{csv}", "--figure", "{tmp}/map.wrong"], "map.wrong: no format by that name"),
        (["{csv}", "--set", "csv.radio.range_sigma_m=-1"], "csv.radio.range_sigma_m"),
        (["{csv}", "--set", "csv.radio.nothing=1"], "csv.radio.nothing"),
    ],
)
def test_a_fault_is_one_line_and_status_2(
    recording: Path, tmp_path: Path, arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    filled = [argument.format(csv=recording, tmp=tmp_path) for argument in arguments]
    assert main(["radio", "slam", *filled, "--json"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert told in err.splitlines()[-1]


@pytest.mark.parametrize("error", [FilterDiverged("prediction is not finite"), np.linalg.LinAlgError("singular")])
def test_an_estimator_that_finds_nothing(
    recording: Path, error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def diverging(*_: object) -> None:
        raise error

    monkeypatch.setattr("ccatp.beacons.slam.causal.filter_run", diverging)
    assert main(["radio", "slam", str(recording)]) == 2
    assert f"mine: ekf-slam finds no finite map for these data ({error})" in capsys.readouterr().err.splitlines()[-1]
