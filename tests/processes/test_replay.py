"""A run of the daemon, and ``ccatp replay`` on what it recorded."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ccatp.cli import main
from ccatp.config.load import load_config
from ccatp.mirror.mirror import build_mirror
from ccatp.records.run_reader import in_order, open_run
from ccatp.studies import replay_report as comparison
from ccatp.studies.replay import replay
from ccatp.studies.replay_report import REPRODUCED
from tests.processes.conftest import NO_CALIBRATION, Run

Start = Callable[..., Run]


def ccatp_replay(run_dir: Path, *args: str) -> tuple[int, str, str]:
    command = [sys.executable, "-m", "ccatp", "replay", str(run_dir), *args]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    return done.returncode, done.stdout, done.stderr


def result_of(run_dir: Path, *args: str) -> dict[str, Any]:
    status, out, err = ccatp_replay(run_dir, "--json", *args)
    assert status == 0, err
    result: dict[str, Any] = json.loads(out)
    return result


def stopped(run: Run, points: int) -> Run:
    """The run, ended by its operator after some points."""
    run.until(lambda status: status["done"] >= points)
    assert run.ask("stop")["ok"]
    assert run.wait() == 4, run.stderr
    return run


@pytest.fixture(scope="module")
def hard_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """One panel of the hard world with the extended Kalman filter."""
    folder = tmp_path_factory.mktemp("r")
    (folder / "s").mkdir()
    run = Run(folder / "run", folder / "s", *NO_CALIBRATION, "--panels", "1", "--world", "hard", "--filter", "ekf")
    try:
        assert run.wait() == 0, run.stderr
        yield run
    finally:
        run.end()


def test_the_same_filter_reproduces_the_run(hard_run: Run) -> None:
    result = result_of(hard_run.run_dir)
    found = result["difference"]
    assert found["reproduced"]
    assert found["position_mm"]["max"] <= 1e3 * REPRODUCED
    assert found["heading_mrad"]["max"] <= 1e3 * REPRODUCED
    assert found["frames"] == result["frames"] > 1000  # every estimate
    assert result["reference"] == "truth"
    # The replay's own summary of the localization is that of the run, which is rounded to micrometres.
    recorded, summary = result["recorded"]["position_error_mm"], hard_run.summary["localization_error_mm"]
    for name in ("mean", "p50", "p99", "max"):
        assert recorded[name] == pytest.approx(summary[name], abs=2e-3)  # and has the frames before the first batch
    assert result["fixes"]["given"] >= 9
    assert not result["warnings"]


def test_its_panel_lies_as_it_was_simulated(hard_run: Run) -> None:
    command = [sys.executable, "-m", "ccatp", "align", str(hard_run.run_dir), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    result = json.loads(done.stdout)
    assert (len(result["panels"]), result["points"]["measured"]) == (1, 9)
    assert result["truth"]["agrees"]
    # The supervisor asks the truth itself; both round to nanometres.
    assert result["truth"]["piston_rms_um"] == pytest.approx(hard_run.summary["panels"]["piston_rms_um"], abs=2e-3)


@pytest.mark.parametrize("name", ["kf", "ukf"])
def test_the_other_filters_reproduce_theirs(name: str, start: Start) -> None:
    run = stopped(start("--panels", "1", "--world", "thesis", "--filter", name), points=2)
    result = result_of(run.run_dir)
    assert result["difference"]["reproduced"]
    assert result["fixes"]["given"] >= 2


def test_a_run_whose_fixes_were_doubted_is_reproduced(start: Start) -> None:
    # Every other fix of a point is doubted: half of the chi-squared distribution with two degrees lies above 1.4.
    doubting = ("--set", "etalon.doubt_nis=1.4")
    run = stopped(start("--panels", "1", "--world", "hard", "--filter", "ekf", *doubting), points=6)
    result = result_of(run.run_dir)
    assert result["fixes"]["set_aside"] >= 1
    assert result["fixes"]["first_difference"] is None
    assert result["difference"]["reproduced"]


@pytest.mark.slow
def test_a_run_in_real_time_is_reproduced(start: Start) -> None:
    # Frames go on while a fix is on its way, and batches end where the wall clock ends them.
    run = stopped(start("--panels", "1", "--world", "hard", "--filter", "ekf", "--realtime"), points=1)
    result = result_of(run.run_dir)
    assert result["difference"]["reproduced"]
    assert result["fixes"]["given"] >= 1


@pytest.mark.slow
def test_a_resumed_run_is_reproduced_in_both_parts(start: Start) -> None:
    first = stopped(start("--panels", "1", "--world", "thesis", "--filter", "kf"), points=1)
    second = Run(first.run_dir, first.runtime_dir, "--panels", "1", "--world", "thesis", "--filter", "ekf", "--resume")
    try:
        stopped(second, points=3)
    finally:
        second.end()
    result = result_of(first.run_dir)
    assert result["recordings"] == 2
    assert result["difference"]["reproduced"]  # each with its own filter


def test_a_recording_that_is_not_reproduced_is_an_error(
    hard_run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(comparison, "REPRODUCED", -1.0)  # which no replay reaches
    assert main(["replay", str(hard_run.run_dir)]) == 1
    told = capsys.readouterr()
    assert "replayed less recorded" in told.out
    assert told.err.startswith(f"ccatp: {hard_run.run_dir}: the replay does not reproduce the recorded estimates: ")
    assert told.err.count("\n") == 1
    # Another setting is asked to change something.
    assert main(["replay", str(hard_run.run_dir), "--set", "localizer.full_state.fix_gate_nis=60"]) == 0
    told = capsys.readouterr()
    assert told.out.endswith("the replay differs from the recorded estimates\n")
    assert not told.err


def test_another_filter_gives_another_track(hard_run: Run) -> None:
    result = result_of(hard_run.run_dir, "--filter", "kf")
    assert not result["difference"]["reproduced"]
    # The four-state filter knows no slip: several times the error, in a world with slip.
    means = [result[name]["position_error_mm"]["mean"] for name in ("replayed", "recorded")]
    assert means[0] > 2.0 * means[1]


def test_a_setting_changes_what_it_should(hard_run: Run) -> None:
    result = result_of(hard_run.run_dir, "--set", "localizer.full_state.fix_gate_nis=1e-6")
    assert result["fixes"]["refused"] > 0
    assert "mm from the estimate" in result["fixes"]["first_difference"]["said"]
    assert result["settings"] == {"localizer.full_state.fix_gate_nis": 1e-6}


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_the_smoother_is_clearly_better_between_the_stops(name: str, hard_run: Run) -> None:
    result = result_of(hard_run.run_dir, "--smooth", "--filter", name)
    moving = {key: result[key]["moving_error_mm"]["rms"] for key in ("replayed", "smoothed")}
    # Measured: a fifth to a quarter. Between two fixes of micrometres only what happens between them is left.
    assert moving["smoothed"] < 0.5 * moving["replayed"]
    assert result["smoothed"]["heading_error_mrad"]["rms"] < result["replayed"]["heading_error_mrad"]["rms"]


def test_a_run_that_was_torn_off_is_replayed_to_its_end(hard_run: Run, tmp_path: Path) -> None:
    torn = tmp_path / "torn"
    shutil.copytree(hard_run.run_dir, torn)
    telemetry = torn / "telemetry.mcap"
    telemetry.write_bytes(telemetry.read_bytes()[: telemetry.stat().st_size // 2])
    status, out, err = ccatp_replay(torn)
    assert status == 0
    assert "the replay reproduces the recorded estimates" in out
    assert err.startswith(f"ccatp: warning: {telemetry}: damaged or cut off before byte")
    assert err.count("\n") == 1


def test_bad_inputs_are_one_line(hard_run: Run, tmp_path: Path) -> None:
    for args, message in (
        ((tmp_path / "none",), "no such directory"),
        ((tmp_path,), "no telemetry.mcap there"),
        ((hard_run.run_dir, "--filter", "ekff"), "did you mean ekf?"),
        ((hard_run.run_dir, "--set", "localizer.full_state.fix_gate=1"), "did you mean localizer.full_state.fix_gate_"),
    ):
        status, out, err = ccatp_replay(*args)
        assert (status, out) == (2, "")
        assert message in err
        assert err.count("\n") == 1


def test_the_pure_part_does_it_without_a_process(hard_run: Run) -> None:
    (recording,) = open_run(hard_run.run_dir)
    cfg = recording.config({})
    assert cfg == load_config(hard_run.run_dir / "config.toml")
    mirror = build_mirror(cfg.mirror)
    replayed = replay(cfg, mirror, in_order(recording.messages()))
    assert (replayed.trace.pose == recording.recorded(mirror).pose).all()  # to the last bit
