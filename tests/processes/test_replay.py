"""What the daemon recorded, through `ccatp replay` and `ccatp align`; and its runs against those in one process."""

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.beacons.config.load import load_radio_config
from ccatp.beacons.studies.mote_navigation import rehearse_beacons
from ccatp.cli import main
from ccatp.config.load import load_config
from ccatp.config.package import configs_dir
from ccatp.mirror.mirror import build_mirror
from ccatp.mirror.mirror_alignment import compare, survey_result
from ccatp.records.recorder import iter_messages
from ccatp.records.run_reader import open_recordings, read_run
from ccatp.sim.fault_plan import read_plan
from ccatp.studies.sil_run import SilRun
from tests.faults.linking import Measured
from tests.processes.conftest import Start
from tests.support.runs import RecordedRun, Run, figures_of


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


def test_the_same_filter_reproduces_the_run_and_the_smoother_is_clearly_better_between_the_stops(
    recorded_run: RecordedRun, capsys: pytest.CaptureFixture[str]
) -> None:
    result = result_of(capsys, "replay", recorded_run.run_dir, "--smooth")
    is_smoother_better(result)
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
    (recording,) = open_recordings(recorded_run.run_dir)
    assert recording.config({}) == load_config(recorded_run.run_dir / "config.toml")


RESTARTS = """
[[fault]]
signal = "robot"
type = "reboot"
at_s = 10.0

[[fault]]
signal = "clock"
type = "jump"
at_s = 18.0
by_s = -5.0

[[fault]]
signal = "clock"
type = "wrap"
at_s = 26.0
modulo_s = 12.0

[[fault]]
signal = "robot"
type = "reboot"
at_s = 32.0
"""


@pytest.mark.fault("P25")
def test_a_run_with_restarts_and_steps_of_the_clock_is_read_as_it_was(
    start: Start, tmp_path: Path, capsys: pytest.CaptureFixture[str], measured: Measured
) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(RESTARTS, encoding="utf-8")
    run = start("--panels", "1", "--faults", str(plan))
    assert run.wait() == 0, run.stderr
    status = main(["replay", str(run.run_dir), "--json"])
    printed = capsys.readouterr()
    assert status == 0, printed.err
    result, summary = json.loads(printed.out), run.summary["localization_error_mm"]
    assert result["difference"]["reproduced"]
    for name in ("mean", "p50", "p99", "max"):
        assert result["recorded"]["position_error_mm"][name] == pytest.approx(summary[name], abs=2e-3)
    (recording,) = open_recordings(run.run_dir)
    assert sum(step.kind == "restart" for step in recording.timeline.steps) == 2
    assert (np.diff(recording.timeline.t_s) > 0.0).all()
    frames = int(recording.timeline.number[-1])
    assert recording.timeline.t_s[-1] == pytest.approx(0.01 * frames, abs=1e-6)
    measured("P25", 0 if result["difference"]["reproduced"] else 1)


def test_its_panels_lie_as_they_were_simulated(recorded_run: RecordedRun, capsys: pytest.CaptureFixture[str]) -> None:
    result = result_of(capsys, "align", recorded_run.run_dir)
    assert (len(result["panels"]), result["points"]["measured"]) == (2, 18)
    assert result["truth"]["agrees"]
    # The summary has the fixes as they were computed during the run, without the adjustment of the laser network, and
    # its supervisor asks the truth itself; both round to nanometres.
    survey = read_run(recorded_run.run_dir, {})
    cfg, planned = survey.cfg, {point.panel for point in survey.planned}
    as_fixed = survey_result(build_mirror(cfg.mirror), cfg.align, cfg.robot.puck_height_m, survey.measured, planned)
    assert survey.injected is not None
    against = compare(as_fixed.panels, survey.injected)
    assert against is not None
    panels = recorded_run.summary["panels"]
    assert (1e6 * against.piston_rms_m, 1e6 * against.tilt_rms_rad) == pytest.approx(
        (panels["piston_rms_um"], panels["tilt_rms_urad"]), abs=2e-3
    )


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
    first = stopped(start("--panels", "1", "--world", "thesis", "--filter", "kf"), points=1)
    stopped(start("--resume", run_dir=first.run_dir), points=3)
    result = result_of(capsys, "replay", first.run_dir)
    assert result["recordings"] == 2
    assert result["difference"]["reproduced"]


def test_another_filter_gives_another_track(recorded_run: RecordedRun, capsys: pytest.CaptureFixture[str]) -> None:
    result = result_of(capsys, "replay", recorded_run.run_dir, "--filter", "kf")
    assert not result["difference"]["reproduced"]
    # The four-state filter knows no slip: several times the error, in a world with slip.
    means = [result[name]["position_error_mm"]["mean"] for name in ("replayed", "recorded")]
    assert means[0] > 2.0 * means[1]


@pytest.mark.slow
def test_the_smoother_of_another_filter_is_clearly_better(
    recorded_run: RecordedRun, capsys: pytest.CaptureFixture[str]
) -> None:
    is_smoother_better(result_of(capsys, "replay", recorded_run.run_dir, "--smooth", "--filter", "ukf"))


def is_smoother_better(result: dict[str, Any]) -> None:
    moving = {key: result[key]["moving_error_mm"]["rms"] for key in ("replayed", "smoothed")}
    # Measured: a fifth to a quarter. Between two fixes of micrometres only what happens between them is left.
    assert moving["smoothed"] < 0.5 * moving["replayed"]
    assert result["smoothed"]["heading_error_mrad"]["rms"] < result["replayed"]["heading_error_mrad"]["rms"]


# -- runs through the real processes against the same runs in one process: surveys, and missions among beacons ---------

# Read by every process of the run at its start: the wall clock is an hour early or an hour late, anew at each look.
RESTLESS_CLOCK = """
import datetime, itertools, time

step = itertools.cycle((3600, -3600)).__next__
time_s, time_ns = time.time, time.time_ns
time.time = lambda: time_s() + step()
time.time_ns = lambda: time_ns() + step() * 10**9


class Restless(datetime.datetime):
    @classmethod
    def now(cls, tz=None):
        return super().now(tz) + datetime.timedelta(seconds=step())


datetime.datetime = Restless
"""


LASER = '[[fault]]\nsignal = "laser"\nat_s = 12.0\nfor_s = 25.0\n{}\n'


@pytest.mark.fault("S13")
@pytest.mark.parametrize(
    ("fault", "calibrates"),
    [
        # A channel is left out of the fixes; the survey goes on to its end.
        pytest.param('type = "offset"\nchannel = 2\noffset_m = 0.2', False, id="offset"),
        # Fixes are refused, repeated and given up in the same places, and the missions end alike.
        pytest.param('type = "at_rest"', False, marks=pytest.mark.slow, id="at rest"),
        pytest.param('type = "noisy"\nfactor = 3e4', False, marks=pytest.mark.slow, id="noisy"),
        pytest.param("", False, marks=pytest.mark.slow, id="no fault"),
        pytest.param("", True, marks=pytest.mark.slow, id="after a calibration drive"),
    ],
)
def test_a_rehearsal_is_the_run_without_the_sockets(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, measured: Measured, fault: str, calibrates: bool
) -> None:
    (tmp_path / "clock").mkdir()
    (tmp_path / "clock" / "sitecustomize.py").write_text(RESTLESS_CLOCK)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "clock"), *sys.path]))
    plan = tmp_path / "plan.toml"
    plan.write_text(LASER.format(fault) if fault else "")
    args = f"--panels 1 --mirror thesis-m1 --filter ekf --world hard --seed 3 --faults {plan}"
    run = start(*args.split(), calibrates=calibrates)
    run.wait()
    labels = [json.loads(line)["timestamp"] for line in (run.run_dir / "log.jsonl").read_text().splitlines()]
    instants = [datetime.fromisoformat(label) for label in labels]
    assert max(abs(b - a) for a, b in pairwise(instants)) > timedelta(minutes=50)  # the clock did step
    mission = SilRun(load_config(run.run_dir / "config.toml"), read_plan(plan, lockstep=True))
    rehearsal = mission.run()

    # Every frame's true place, to the last bit: a difference anywhere upstream moves the robot sooner or later.
    messages = iter_messages(run.run_dir / "telemetry.mcap")
    batches = [json.loads(message.payload)["rows"] for message in messages if message.topic == "truth"]
    driven = np.array([row[1:5] for rows in batches for row in rows])
    rehearsed = rehearsal.track[:, :4]
    assert len(rehearsed) > 2000
    differs = np.flatnonzero((driven[: len(rehearsed)] != rehearsed).any(axis=1))
    measured("S13", differs.size)
    assert differs.size == 0, f"first in frame {differs[0]}: {driven[differs[0]]} is not {rehearsed[differs[0]]}"

    found, rehearsed_summary = figures_of(run.summary), figures_of(json.loads(json.dumps(rehearsal.summary)))
    left_out, rehearsed_left_out = (one["points"].pop("left_out", {}) for one in (found, rehearsed_summary))
    assert found == rehearsed_summary
    # The daemon's client names the server beside the reason.
    assert sorted(left_out.values()) == sorted(rehearsed_left_out.values())
    assert run.summary["ended"]["what"] == rehearsal.outcome
    assert run.summary["ended"]["condition"] == mission.mission.state.cause.condition
    is_given_up = "at_rest" in fault or "noisy" in fault
    assert (rehearsal.outcome == "complete") is not is_given_up, run.stderr
    assert bool(left_out) is is_given_up


# -- missions among beacons --------------------------------------------------------------------------------------------

# A lap, a waypoint, a few seconds: what differs between daemon and rehearsal differs from the first frame on.
SHORT = {
    "zigbee": ("mission.laps=1",),
    "follow": ("mission.follow_s=6",),
    "cricket": ("cricket.ranging.repeats=4", "workspace.loops=false", "workspace.waypoints_m=[[2.5, 1.5]]"),
}
LONGER = {"follow": ("mission.follow_s=15",)}


class BeaconRun(Run):
    """`ccatp run --sim` of a mission among beacons."""

    free_ports = ("--set", "sim.robot.port=0", "--set", "dashboard.enabled=false")


Begin = Callable[..., BeaconRun]


@pytest.fixture
def begin(tmp_path: Path, runtime_dir: Path) -> Iterator[Begin]:
    with ExitStack() as stack:

        def start(system: str, *args: str) -> BeaconRun:
            config = ("--config", str(configs_dir() / f"{system}.toml"))
            return stack.enter_context(BeaconRun(tmp_path / "run", runtime_dir, *config, *args))

        yield start


@pytest.mark.parametrize(
    ("system", "settings"),
    [
        *(pytest.param(*item, marks=[] if item[0] == "zigbee" else pytest.mark.slow) for item in SHORT.items()),
        *(pytest.param(*item, marks=pytest.mark.slow, id=f"longer {item[0]}") for item in LONGER.items()),
    ],
)
def test_the_daemon_does_what_the_rehearsal_does(begin: Begin, system: str, settings: tuple[str, ...]) -> None:
    run = begin(system, *(part for setting in settings for part in ("--set", setting)), "--json")
    assert run.wait() == 0, run.stderr
    summary = json.loads(run.stdout)
    assert summary == run.summary
    rehearsal = rehearse_beacons(load_radio_config(run.run_dir / "config.toml"))
    assert summary["ended"]["what"] == rehearsal.outcome == "complete"
    assert figures_of(summary) == figures_of(rehearsal.summary)
    topics = {message.topic for message in iter_messages(run.run_dir / "telemetry.mcap")}
    assert {"beacon_track", "beacon_map", "beacon_truth", "beacon_places", "sensors", "mission"} <= topics
    assert (run.run_dir / "log.jsonl").stat().st_size


def test_an_operator_pauses_resumes_and_aborts(begin: Begin) -> None:
    run = begin("zigbee", "--set", "mission.laps=50", "--set", "mission.time_limit_s=1e5")
    run.until(lambda status: status["done"] >= 1)
    assert run.ask("pause")["status"]["state"] == "held"
    assert run.query("SELECT count(*) FROM waypoint WHERE reached_s NOTNULL")[0][0] >= 1
    assert run.ask("resume")["ok"]
    run.until_state("visiting")
    assert run.ask("abort")["ok"]
    assert run.wait() == 3, run.stderr
    assert run.summary["outcome"] == "aborted, at base"
