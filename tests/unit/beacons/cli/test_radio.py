"""The commands ``ccatp radio slam``, ``calibrate``, ``fix``, ``fuzzy``; survey commands given a run among beacons."""

import json
import sys
import tomllib
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.datasets.reader import read_run
from ccatp.beacons.estimation.evaluation import judge
from ccatp.beacons.estimation.recording import KnownMap
from ccatp.beacons.studies.gtsam_peer import PeerError, PeerGaveUp, run_gtsam
from ccatp.cli import main
from ccatp.filters.base import FilterDiverged
from tests.support.command import answered, printed
from tests.support.scenario import RADIO_DATA
from tests.unit.beacons.datasets.sets import (
    BEACONS,
    csv_lines,
    labyrinth_lines,
    recorded,
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


def said(capsys: pytest.CaptureFixture[str], *argv: object) -> tuple[int, str, str]:
    status = main([str(part) for part in argv])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def reported(capsys: pytest.CaptureFixture[str], *argv: object) -> Any:
    return answered(capsys, "radio", *argv)


@pytest.mark.parametrize("filter_name", ["ekf-slam", "fixed-lag", "smoother"])
def test_json_is_the_contracts(
    recording: Path, tmp_path: Path, filter_name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "map.png"
    argv = ("radio", "slam", recording, "--filter", filter_name, "--json", "--figure", picture)
    status, out, err = said(capsys, *argv)
    data = json.loads(out)
    assert status == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert set(data) >= CONTRACT
    assert (data["dataset"], data["filter"]) == ("mine", filter_name)
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
    assert (data["delayed"] is None) == (filter_name != "fixed-lag")
    assert all(warning in err for warning in data["warnings"])


def test_the_result_is_written_as_files_of_which_the_graph_is_read_again(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out_dir = tmp_path / "result"
    data = reported(capsys, "slam", recording, "--filter", "fixed-lag", "--out", out_dir, "--json")
    path = np.genfromtxt(out_dir / "path.csv", delimiter=",", names=True)
    assert path.dtype.names is not None
    assert path.dtype.names[:4] == ("time_s", "x_m", "y_m", "heading_rad")
    assert (path["xx_m2"] > 0.0).all()
    assert (out_dir / "path_delayed.csv").is_file()
    found = tomllib.loads((out_dir / "map.toml").read_text(encoding="utf-8"))
    assert found["beacons"].keys() == data["beacons"].keys()
    for name, one in found["beacons"].items():
        assert one["position_m"] == pytest.approx(data["beacons"][name], abs=0.05)  # those of the data are aligned
    assert np.shape(found["joint"]["covariance_m2"]) == (8, 8)
    readings = (out_dir / "readings.csv").read_text(encoding="utf-8").splitlines()
    assert readings[0].endswith("residual_m,nis,nis_size,is_used")
    used = [line for line in readings if line.endswith(",1")]
    assert len(used) == data["updates"]
    graph = reported(capsys, "slam", out_dir / "graph.pyfg", "--json")
    assert graph["beacon_rmse_m"] < 0.5
    true, again = (read_run(file, None, None).truth for file in (recording, out_dir / "graph.pyfg"))
    assert true is not None
    assert again is not None
    for own, of_graph in zip(true[1:], again[1:], strict=True):  # x, y and heading
        assert of_graph == pytest.approx(np.interp(again.times_s, true.times_s, own), abs=1e-6)  # nine decimals
    status, _, err = said(capsys, "radio", "slam", recording, "--out", recording)
    assert status == 2
    assert "is a file" in err


def test_what_is_not_known_is_null(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write_plaza(tmp_path, world(seconds=30.0), mat=False)
    (tmp_path / "Field1_GT.txt").unlink()
    (tmp_path / "Field1_TL.txt").unlink()
    data = reported(capsys, "slam", file, "--filter", "smoother", "--set", "plaza.priors.range_scale=0.0")
    unknown = ("trajectory_rmse_m", "heading_rmse_rad", "beacon_rmse_m", "nees_mean", "range_scale")
    assert {data[key] for key in unknown} == {None}
    assert len(data["beacons"]) == len(BEACONS)
    reported(capsys, "slam", file, "--out", tmp_path / "out", "--json")
    graph = reported(capsys, "slam", tmp_path / "out/graph.pyfg", "--json")
    assert {graph[key] for key in unknown[:4]} == {None}
    assert any("no reference trajectory" in line for line in graph["warnings"])


def test_a_truth_of_one_row_is_no_trajectory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = labyrinth_lines(world(seconds=30.0))
    first = next(line for line in lines if line.startswith("gt2"))
    file = write_lines(tmp_path / "lab.txt", [first, *(line for line in lines if not line.startswith("gt2"))])
    data = reported(capsys, "slam", file, "--filter", "smoother")
    assert data["trajectory_rmse_m"] is data["nees_mean"] is None
    assert data["beacon_rmse_m"] < 0.5
    assert any("no reference trajectory: the truth has 1 row" in warning for warning in data["warnings"])


def test_the_table_names_what_was_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_mrclam(tmp_path, world(seconds=30.0), robot=3)
    out = said(capsys, "radio", "slam", tmp_path, "--robot", "3", "--filter", "smoother")[1]
    for word in ("robot 3 (mrclam): 30 s", "smoother: ", "m rms, heading", "turn_scale", "NEES"):
        assert word in out
    places, residuals, advice = (part.splitlines() for part in out.split("\n\n")[-3:])
    for rows in (places, residuals):
        assert {row.split()[0] for row in rows[1:]} == set(BEACONS)
    assert advice[0].startswith("measure next: beacon ")


@pytest.mark.parametrize("error", [FilterDiverged("prediction is not finite"), np.linalg.LinAlgError("singular")])
def test_an_estimator_that_finds_nothing(
    recording: Path, error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def diverging(*_: object) -> None:
        raise error

    monkeypatch.setattr("ccatp.beacons.studies.recordings.lagged_run", diverging)
    assert main(["radio", "slam", str(recording)]) == 2
    assert f"mine: fixed-lag finds no finite map for these data ({error})" in capsys.readouterr().err.splitlines()[-1]


XBEE = RADIO_DATA / "xbee_rssi"
needs_xbee = pytest.mark.skipif(not XBEE.is_dir(), reason="the XBee sheets are not beside the checkout")
CORNERS = ("--beacon", "A=0,0", "--beacon", "B=0,4", "--beacon", "C=4,0")


def pairs(folder: Path) -> Path:
    rows = [f"{d},{-45.0 - 25.0 * np.log10(d) + 0.5 * (-1) ** k:.4f}" for k, d in enumerate((0.5, 1, 2, 3, 4, 5))]
    (folder / "pairs.csv").write_text("distance_m,rssi_dbm\n" + "\n".join(rows) + "\n")
    return folder / "pairs.csv"


def test_calibrate_prints_what_the_configuration_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = said(capsys, "radio", "calibrate", pairs(tmp_path), "--figure", tmp_path / "a.png")
    assert (status, err) == (0, "")
    assert "reference_dbm = -44." in out
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    found = reported(capsys, "calibrate", pairs(tmp_path))
    assert found["exponent"] == pytest.approx(2.5, abs=0.3)
    assert found["places"] == 6
    assert found["white_sigma_db"] is None


def test_fuzzy_tells_the_speed_at_a_point(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = reported(capsys, "fuzzy", "--at", 2.0, 0.0, "--at", 0.05, 2.0, "--figure", tmp_path / "b.png")
    assert [point["speed_m_s"] for point in found["points"]] == [0.15, 0.05]
    assert (tmp_path / "b.png").read_bytes().startswith(b"\x89PNG")


def places(folder: Path) -> Path:
    rows = []
    for x in (0.5, 1.5, 2.5, 3.5):
        for y in (0.5, 1.5, 2.5, 3.5):
            r = [np.hypot(x - bx, y - by) for bx, by in ((0, 0), (0, 4), (4, 0))]
            rows.append(f"{x},{y}," + ",".join(f"{-45.0 - 25.0 * np.log10(d) + 0.1 * ((x + y) % 2):.3f}" for d in r))
    (folder / "places.csv").write_text("x,y,RSSI A,RSSI B,RSSI C\n" + "\n".join(rows) + "\n")
    return folder / "places.csv"


def test_fix_finds_places_and_exchanged_beacons(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = places(tmp_path)
    found = reported(capsys, "fix", file, *CORNERS, "--fingerprints", file)
    assert found["leave_one_out"] is True
    assert found["mean_error_m"] < 0.15
    other = tmp_path / "other.csv"
    other.write_text(file.read_text().replace("RSSI B,RSSI C", "RSSI C,RSSI B"))
    status, out, err = said(capsys, "radio", "fix", other, *CORNERS, "--fingerprints", file)
    assert status == 0
    assert "beacons look exchanged: B is C, C is B" in err
    exchanged = reported(capsys, "fix", other, *CORNERS, "--fingerprints", file, "--exchange", "B,C")
    assert exchanged["mean_error_m"] < 0.15
    assert "mean error" in out


@needs_xbee
def test_xbee_scenario_1_is_fixed_within_its_limit(capsys: pytest.CaptureFixture[str]) -> None:
    folder = XBEE / "Scenario1"
    common = (*CORNERS, "--fingerprints", folder / "Database_Scenario1.xlsx")
    tests = reported(capsys, "fix", folder / "Tests_Scenario1.xlsx", "--exchange", "B,C", *common)
    own = reported(capsys, "fix", folder / "Database_Scenario1.xlsx", *common)
    assert tests["mean_error_m"] <= 1.3
    assert own["mean_error_m"] <= 1.3
    inside = (tests["in_region"] + own["in_region"]) / (len(tests["points"]) + len(own["points"]))
    assert 0.80 <= inside <= 0.95


@needs_xbee
def test_xbee_sheets_and_logs_agree(capsys: pytest.CaptureFixture[str]) -> None:
    sheet = XBEE / "Scenario1" / "Pathloss_Scenario1.xlsx"
    one = reported(capsys, "calibrate", sheet)
    logs = XBEE / "Scenario1" / "Pathloss" / "Zigbee"
    other = reported(capsys, "calibrate", logs, "--points", sheet)
    assert other["readings"] == 900
    assert other["exponent"] == pytest.approx(one["exponent"], abs=0.05)
    assert other["shadowing_sigma_db"] > 5.0 * other["white_sigma_db"]


# -- GTSAM on the same input: it solves what it can, and says so where it cannot --------------------------------------

SETTINGS = load_recordings_config().csv


def no_clock() -> float:
    """Time stands still."""
    return 0.0


@pytest.mark.parametrize("bearings", [True, False], ids=["range-bearing", "range-only"])
def test_both_solve_a_run_without_calibration_errors(bearings: bool) -> None:
    pytest.importorskip("gtsam", reason="the extra peers is not installed")
    run = recorded(world(seconds=60.0), bearings=bearings)
    isam2, batch = run_gtsam(run, SETTINGS, no_clock, np.inf)
    for track in (isam2, batch):
        found = judge(track, run)
        assert found.trajectory_rmse_m == pytest.approx(0.0, abs=0.1)
        assert found.beacon_rmse_m == pytest.approx(0.0, abs=0.15)
        assert set(track.beacons) == set(BEACONS)
    assert len(isam2.update_s) == len(run.readings.times_s)


def test_what_cannot_be_solved_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gtsam", reason="the extra peers is not installed")
    run = recorded(world(seconds=20.0))
    nothing = np.full(len(run.readings.times_s), np.nan)
    received = replace(run, readings=run.readings._replace(range_m=nothing, rssi_dbm=nothing - 50.0))
    with pytest.raises(PeerGaveUp, match="no factor of signal strengths"):
        next(run_gtsam(received, SETTINGS, no_clock, np.inf))
    with pytest.raises(PeerGaveUp, match=r"^simulated: GTSAM gave up: .*$"):
        next(run_gtsam(replace(run, first_pose=(np.nan, 0.0, 0.0)), SETTINGS, no_clock, np.inf))
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(PeerError, match=r"ccatp\[peers\]"):
        next(run_gtsam(run, SETTINGS, no_clock, np.inf))


def test_a_slow_peer_tells_how_far_it_is_and_stops_at_the_limit() -> None:
    pytest.importorskip("gtsam", reason="the extra peers is not installed")
    run, ticks, shown = recorded(world(seconds=20.0)), count(), list[int]()

    def progress(total: int) -> Callable[[int], None]:
        shown.append(total)
        return shown.append

    with pytest.raises(
        PeerGaveUp, match=r"^simulated: GTSAM was stopped after 30 s, at 1\d% of the run: run.peer_limit"
    ):
        next(run_gtsam(run, SETTINGS, lambda: float(next(ticks)), 30.0, progress))
    assert shown[0] == len(run.readings.times_s) + 1
    assert shown[1:] == [*range(1, len(shown))]


def test_a_batch_that_is_stopped_leaves_the_result_of_isam2() -> None:
    pytest.importorskip("gtsam", reason="the extra peers is not installed")
    now_s, tick_s = 0.0, 0.0

    def clock_s() -> float:
        nonlocal now_s
        now_s += tick_s
        return now_s

    tracks = run_gtsam(recorded(world(seconds=20.0)), SETTINGS, clock_s, 0.5)
    assert set(next(tracks).beacons) == set(BEACONS)
    tick_s = 1.0
    with pytest.raises(
        PeerGaveUp, match=r"^simulated: GTSAM's batch was stopped after 0.5 s and 1 steps: run.peer_lim"
    ):
        next(tracks)


def test_a_peer_takes_a_known_map() -> None:
    pytest.importorskip("gtsam", reason="the extra peers is not installed")
    run, places_m = recorded(world(seconds=20.0), bearings=False), np.array([*BEACONS.values()])
    run = replace(run, known_map=KnownMap(tuple(BEACONS), places_m, 1e-6 * np.eye(8), np.full(4, np.nan)))
    for track in run_gtsam(run, SETTINGS, no_clock, np.inf):
        found = judge(track, run)
        assert found.beacon_rmse_m == pytest.approx(0.0, abs=0.01)
        assert found.trajectory_rmse_m == pytest.approx(0.0, abs=0.1)


def test_a_known_map_localizes_the_vehicle(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From its third beacon and a start beside the true one, without a truth: the frame is that of the map."""
    w = world(seconds=60.0)
    lines = [line for line in csv_lines(w) if not line.startswith(("truth", "beacon"))]
    file = write_lines(tmp_path / "mine.csv", lines)
    rows = [f"{name},{x},{y},0.01" for name, (x, y) in BEACONS.items() if name != "9"]
    write_lines(tmp_path / "anchors.csv", ["anchor,x,y,sigma_m", *rows, "unheard,1,2,0.01"])
    options = ("--map", tmp_path / "anchors.csv", "--out", tmp_path / "out")
    status, _, err = said(capsys, "radio", "slam", file, *options)
    assert (status, "give it with --start X,Y,HEADING" in err) == (2, True)
    status, _, err = said(capsys, "radio", "slam", file, *options, "--start", "3,1")
    assert (status, "--start 3,1: is not X,Y,HEADING in m, m, rad" in err) == (2, True)
    status, _, err = said(capsys, "radio", "slam", file, *options, "--start", "3,1,1e5")
    assert (status, "--start 3,1,1e5: must be numbers within ±10000, in m, m, rad" in err) == (2, True)
    data = reported(capsys, "slam", file, *options, "--start", "3.05,0.95,0.42", "--json")
    assert "beacons that the known map lacks are mapped: 9" in data["warnings"]
    assert not [line for line in data["warnings"] if "the first pose is the origin" in line]
    for name, at in BEACONS.items():
        assert data["beacons"][name] == pytest.approx(at, abs=0.05)
    path = np.genfromtxt(tmp_path / "out/path.csv", delimiter=",", names=True)
    true_m = [np.interp(path["time_s"], w.times_s, w.poses[:, k]) for k in range(2)]
    off_m = np.hypot(path["x_m"] - true_m[0], path["y_m"] - true_m[1])
    assert off_m[-100:].max() < 0.1
    # The map of this run, with its joint covariance, is a known map again.
    again = reported(capsys, "slam", file, "--map", tmp_path / "out/map.toml", "--start", "3,1,0.4", "--json")
    assert again["beacons"]["9"] == pytest.approx(BEACONS["9"], abs=0.05)


def test_slam_with_peers_prints_all_side_by_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("gtsam", reason="the extra peers is not installed")
    file = write_lines(tmp_path / "mine.csv", csv_lines(world(seconds=20.0)))
    rows = [
        line for line in printed(capsys, "radio", "slam", file, "--peers").splitlines() if line.startswith("| mine")
    ]
    names = [line.split("|")[2].strip() for line in rows]
    assert names == ["dead reckoning", "ekf-slam", "fixed-lag", "smoother", "GTSAM iSAM2", "GTSAM batch"]


def test_a_peer_that_gives_up_leaves_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("gtsam", reason="the extra peers is not installed")
    lines = [line for line in csv_lines(world(seconds=20.0)) if not line.startswith("range,")]
    assert main(["radio", "slam", str(write_lines(tmp_path / "bearings.csv", lines)), "--peers"]) == 0
    out, err = capsys.readouterr()
    rows = [[cell.strip() for cell in line.split("|")[2:-1]] for line in out.splitlines() if line.startswith("| bear")]
    assert [row[0] for row in rows if row[-1] == "True"] == ["GTSAM iSAM2", "GTSAM batch"]
    assert len(rows) == 6
    assert "warning: bearings: not all readings have a range" in err


def test_beacons_that_move_are_named_and_written_with_their_times(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = reported(capsys, "slam", recording, "--moving", "8", "--filter", "ekf-slam", "--out", tmp_path, "--json")
    assert "8" not in data["beacons"]
    assert len(data["moving"]["8"]["time_s"]) == len(data["moving"]["8"]["at_m"]) > 50
    rows = (tmp_path / "moving.csv").read_text().splitlines()
    assert rows[0] == "time_s,beacon,x_m,y_m,xx_m2,xy_m2,yy_m2"
    assert len(rows) == 1 + len(data["moving"]["8"]["time_s"])
    status, _, error = said(capsys, "radio", "slam", recording, "--moving", "nine")
    assert status == 2
    assert "has no reading of beacon nine, which is to move; there are 6, 7, 8, 9" in error
    status, _, error = said(capsys, "radio", "slam", recording, "--moving", "8", "--filter", "smoother")
    assert status == 2
    assert "the smoother has no model of beacons that move" in error


def test_keys_without_effect_on_a_recording_are_named(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = ("--set", "plaza.radio.range_sigma_m=0.3", "--set", "csv.priors.beacon_offset_m=0.2")
    data = reported(capsys, "slam", recording, "--filter", "ekf-slam", *settings, "--json")
    assert data["warnings"][:2] == [
        "plaza.radio.range_sigma_m = 0.3 has no effect: the settings of this recording are those of csv",
        "csv.priors.beacon_offset_m = 0.2 has no effect with --filter ekf-slam",
    ]


def test_two_tags_are_written_with_each_reading(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [
        f"{line},{'ab'[k // 2 % 2]}" if line.startswith(("range", "bearing")) else line
        for k, line in enumerate(recording.read_text().splitlines())
    ]
    file = write_lines(tmp_path / "tags.csv", [*lines, "tag,a,0,0.001", "tag,b,0,-0.001"])
    status, _, error = said(capsys, "radio", "slam", file, "--out", tmp_path / "out")
    assert status == 0
    assert "graph.pyfg is not written: the format has no places of several tags" in error
    rows = (tmp_path / "out" / "readings.csv").read_text().splitlines()
    assert rows[0].startswith("time_s,beacon,tag,")
    assert {row.split(",")[2] for row in rows[1:]} == {"a", "b"}
    assert not (tmp_path / "out" / "graph.pyfg").exists()
