"""What the daemon recorded, through `ccatp replay` and `ccatp align`."""

import json
from pathlib import Path
from typing import Any

import pytest

from ccatp.cli import main
from ccatp.config.load import load_config
from ccatp.records.run_reader import open_run
from tests.processes.conftest import Start
from tests.support.runs import RecordedRun, Run


def result_of(capsys: pytest.CaptureFixture[str], command: str, run_dir: Path, *args: str) -> dict[str, Any]:
    capsys.readouterr()
    status = main([command, str(run_dir), "--json", *args])
    printed = capsys.readouterr()
    assert (status, printed.err) == (0, "")
    result: dict[str, Any] = json.loads(printed.out)
    return result


def stopped(run: Run, points: int) -> Run:
    """The run, ended by its operator after some points."""
    run.until(lambda status: status["done"] >= points)
    assert run.ask("stop")["ok"]
    assert run.wait() == 4, run.stderr
    return run


def test_the_same_filter_reproduces_the_run(recorded_run: RecordedRun, capsys: pytest.CaptureFixture[str]) -> None:
    result = result_of(capsys, "replay", recorded_run.run_dir)
    found = result["difference"]
    assert found["reproduced"]
    assert (found["position_mm"]["max"], found["heading_mrad"]["max"]) == (0.0, 0.0)  # to the last bit
    assert found["frames"] == result["frames"] > 1000  # every estimate
    assert result["reference"] == "truth"
    # The replay's own summary of the localization is that of the run, which is rounded to micrometres.
    recorded, summary = result["recorded"]["position_error_mm"], recorded_run.summary["localization_error_mm"]
    for name in ("mean", "p50", "p99", "max"):
        assert recorded[name] == pytest.approx(summary[name], abs=2e-3)  # and has the frames before the first batch
    assert result["fixes"]["given"] >= 18
    assert not result["warnings"]
    (recording,) = open_run(recorded_run.run_dir)
    assert recording.config({}) == load_config(recorded_run.run_dir / "config.toml")


def test_its_panels_lie_as_they_were_simulated(recorded_run: RecordedRun, capsys: pytest.CaptureFixture[str]) -> None:
    result = result_of(capsys, "align", recorded_run.run_dir)
    assert (len(result["panels"]), result["points"]["measured"]) == (2, 18)
    assert result["truth"]["agrees"]
    # The supervisor asks the truth itself; both round to nanometres.
    assert result["truth"]["piston_rms_um"] == pytest.approx(recorded_run.summary["panels"]["piston_rms_um"], abs=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("args", "points"),
    [
        # Every other fix of a point is doubted: half of the chi-squared distribution with two degrees lies above 1.4.
        pytest.param(
            ("--filter", "kf", "--world", "thesis", "--set", "etalon.doubt_nis=1.4"), 4, id="doubted"
        ),  # in process: tests/unit/studies/test_replay
        pytest.param(("--filter", "ukf"), 2, id="ukf"),
        # In real time frames go on while a fix is on its way, and batches end where the wall clock ends them.
        pytest.param(("--filter", "ekf", "--world", "hard", "--realtime"), 2, id="realtime"),
    ],
)
def test_other_runs_are_reproduced(
    start: Start, args: tuple[str, ...], points: int, capsys: pytest.CaptureFixture[str]
) -> None:
    result = result_of(capsys, "replay", stopped(start("--panels", "1", *args), points).run_dir)
    assert result["difference"]["reproduced"]
    assert result["fixes"]["given"] >= points
    assert result["fixes"]["first_difference"] is None
    assert (result["fixes"]["set_aside"] >= 1) is ("kf" in args)


@pytest.mark.slow
def test_a_resumed_run_is_reproduced_in_both_parts(start: Start, capsys: pytest.CaptureFixture[str]) -> None:
    one_panel = ("--panels", "1", "--world", "thesis", "--filter")
    first = stopped(start(*one_panel, "kf"), points=1)
    stopped(start(*one_panel, "ekf", "--resume", run_dir=first.run_dir), points=3)
    result = result_of(capsys, "replay", first.run_dir)
    assert result["recordings"] == 2
    assert result["difference"]["reproduced"]  # each with its own filter


def test_another_filter_gives_another_track(recorded_run: RecordedRun, capsys: pytest.CaptureFixture[str]) -> None:
    result = result_of(capsys, "replay", recorded_run.run_dir, "--filter", "kf")
    assert not result["difference"]["reproduced"]
    # The four-state filter knows no slip: several times the error, in a world with slip.
    means = [result[name]["position_error_mm"]["mean"] for name in ("replayed", "recorded")]
    assert means[0] > 2.0 * means[1]


@pytest.mark.parametrize("name", ["ekf", pytest.param("ukf", marks=pytest.mark.slow)])
def test_the_smoother_is_clearly_better_between_the_stops(
    name: str, recorded_run: RecordedRun, capsys: pytest.CaptureFixture[str]
) -> None:
    result = result_of(capsys, "replay", recorded_run.run_dir, "--smooth", "--filter", name)
    moving = {key: result[key]["moving_error_mm"]["rms"] for key in ("replayed", "smoothed")}
    # Measured: a fifth to a quarter. Between two fixes of micrometres only what happens between them is left.
    assert moving["smoothed"] < 0.5 * moving["replayed"]
    assert result["smoothed"]["heading_error_mrad"]["rms"] < result["replayed"]["heading_error_mrad"]["rms"]
