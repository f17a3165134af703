"""The benchmarks: equality with the peers, the same problems each time, the format. No times are asserted."""

import json
import multiprocessing
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from ccatp.cli.study import bench as command
from ccatp.config.load import load_config
from ccatp.links.robot_codec import decode_from_client, decode_from_robot, encode
from ccatp.links.robot_messages import Drive, Sensors
from ccatp.mirror.mirror import build_mirror
from ccatp.sim.robot import Robot
from ccatp.studies import bench, bench_cases, bench_frame, calibrator
from ccatp.studies.bench import step_case
from ccatp.studies.bench_cases import Contender, races
from ccatp.studies.bench_frame import BenchError, LockstepRun, Moment, ProcessUse
from ccatp.studies.calibrator import BUSY, IDLE, LOADS, ONE_CORE, load
from ccatp.studies.machine import machine

STEPS = 10
CFG = load_config()
RACES = list(races(CFG))


def fixed(value: float) -> Contender:
    """A contender whose result does not change."""
    return lambda: iter([tuple, *[(np.full(2, value), np.eye(2))] * bench_cases.STEPS])


@pytest.mark.parametrize(("value", "difference"), [(1.0 + 2e-10, "2e-10"), (float("nan"), "nan")])
def test_a_peer_with_another_result_ends_the_run(value: float, difference: str) -> None:
    assert step_case("case", fixed(1.0), "P", fixed(1.0 + 5e-11), 1)["largest_difference"] == pytest.approx(5e-11)
    with pytest.raises(BenchError, match=f"case: results differ from those of P by {difference}, more than 1e-10"):
        step_case("case", fixed(1.0), "P", fixed(value), 1)


def test_a_missing_peer_leaves_ours_and_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("filterpy.kalman", "stonesoup.predictor.kalman"):
        monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setattr(bench, "races", lambda _: RACES[:1])
    printed, filterpy, stonesoup = cases = list(bench.step_cases(CFG, 1))
    result = {"machine": machine(), "equal_within": 1e-10, "cases": cases}
    assert printed["ratio"] > 0.0
    assert (filterpy["peer"], filterpy["ratio"], stonesoup["peer"]) == (None, None, None)
    assert filterpy["note"] == "filterpy is not installed: pip install 'ccatp[peers]'"
    assert bench.tables(result).endswith("* Stone Soup is not installed: pip install 'ccatp[peers]'\n")
    lines = bench.tables({**result, "cases": cases * 2}).splitlines()
    assert lines[-2:] == [f"* {filterpy['note']}", f"* {stonesoup['note']}"]
    assert "\n".join(lines).count("not installed") == 2


def test_the_page_begins_with_a_frame_of_each_kind_and_the_ratios_of_each_peer() -> None:
    frames = [
        {"name": name, "us_p50": us, "peer": "plain processes", "ratio": us / 200.0}
        for name, us in (("mission in process, a", 100.0), ("lockstep, idle", 400.0), ("lockstep, busy", 500.0))
    ]
    steps = [{"peer": peer, "ratio": ratio} for peer, ratio in (("x", 0.5), ("y", 0.25), (None, None), ("x", 0.125))]
    assert bench.result_lines(frames, steps).splitlines() == [
        "A frame takes 100 µs (mission in process, a), 0.50 times the time of plain processes.",
        "A frame takes 400 µs (lockstep, idle), 2.00 times the time of plain processes.",
        "Time of a step divided by that of the peer: x 0.12 to 0.50, y 0.25.",
    ]
    assert bench.result_lines([], [{"peer": None, "ratio": None}]) == ""


def test_the_command_and_its_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "QUICK_ROUNDS", 1)
    page = tmp_path / "bench.md"
    arguments = ["--quick", "--steps-only", "--json", "--markdown", str(page)]
    done = CliRunner().invoke(command, arguments, standalone_mode=False)
    assert done.exception is None
    result = json.loads(done.stdout)
    assert {"cpu", "cores", "python", "numpy"} <= result["machine"].keys()
    assert result["equal_within"] == 1e-10
    for case in result["cases"]:
        assert case["us_p99"] >= case["us_p50"] > 0.0
        if case["peer"] is None:
            assert case["name"].startswith("ekf-slam, 200")  # whole matrices of that size take too long
            continue
        assert case["ratio"] == pytest.approx(case["us_p50"] / case["peer_us_p50"])
        assert case["largest_difference"] <= 1e-10
    names = {case["peer"] for case in result["cases"]} - {None}
    assert names == {name for one in RACES for name in one.peers}
    table = [line for line in page.read_text().splitlines() if line.startswith("|")]
    assert len(table) == len(result["cases"]) + 2
    assert len({line.count("|") for line in table}) == 1
    assert page.read_text().endswith(bench.tables(result))
    assert page.read_text().startswith(
        "# Benchmarks\n\n**Result.** Time of a step divided by that of the peer: eq. 2.13 "
    )
    written = page.read_text()
    page.write_text(f"old\n{bench.BY_HAND}kept\n")
    bench.write_page(page, result)
    assert page.read_text() == f"{written}\n{bench.BY_HAND}kept\n"


# -- a frame -----------------------------------------------------------------------------------------------------------


FRAME_US = 1e4


def moment(robot_s: float, wall_s: float, main: tuple[float, int], supervisor: tuple[float, int]) -> Moment:
    return Moment(robot_s, wall_s, {"supervisor": ProcessUse(*supervisor), "main": ProcessUse(*main)})


WALL = {"tick_us_p50": 100.0, "tick_us_p99": 200.0, "realtime_factor": 20.0}
SUMMARY = {"mission_time_s": 30.0, "wall": WALL}
RUN = LockstepRun(SUMMARY, 6.0, moment(5.0, 1.0, (0.5, 10), (0.1, 1)), moment(25.0, 3.0, (0.9, 4010), (0.2, 101)))


def test_a_lockstep_frame_counts_between_two_moments() -> None:
    case = bench_frame.lockstep_case("lockstep", [RUN], FRAME_US, [50.0])
    assert case["us_p50"] == pytest.approx(1000.0)  # 2 s for 2000 frames
    assert case["times_real_time"] == pytest.approx(10.0)
    assert case["whole_times_real_time"] == pytest.approx(5.0)
    assert case["ratio"] == pytest.approx(20.0)
    assert (case["tick_us_p50"], case["tick_us_p99"]) == (100.0, 200.0)
    with pytest.raises(BenchError, match="lockstep: fewer than 500 frames"):
        bench_frame.lockstep_case("lockstep", [RUN._replace(last=RUN.first)], FRAME_US, [50.0])


def test_each_process_and_all_together() -> None:
    slower = RUN._replace(last=moment(25.0, 3.0, (1.3, 4010), (0.2, 101)))
    every, supervisor, main = bench_frame.process_cases([RUN, slower], FRAME_US, [100.0, 150.0])
    assert [case["name"].rpartition(", ")[2] for case in (every, supervisor, main)] == [
        "all processes", "supervisor", "main",
    ]  # fmt: skip
    assert main["us_p50"] == pytest.approx(300.0)  # of 200 and 400
    assert main["us_spread"] == pytest.approx([200.0, 400.0])
    assert every["us_p50"] == pytest.approx(350.0)
    assert (main["wake_ups"], supervisor["wake_ups"]) == (pytest.approx(2.0), pytest.approx(0.05))
    assert every["peer_us_p50"] == pytest.approx(125.0)


def test_the_rows_of_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[tuple[Any, ...]] = []

    def run(*arguments: Any) -> LockstepRun:
        started.append(arguments)
        return RUN

    monkeypatch.setattr(bench_frame, "lockstep_run", run)
    monkeypatch.setattr(bench_frame, "rehearsal", lambda _cfg, _panels: (20.0, 1.0))
    monkeypatch.setattr(bench_frame, "calibrate", lambda: (50.0, 40.0))
    quick = bench_frame.frame_cases(CFG, ("--config", "c.toml"), quick=True)
    assert started == [(1, ("--config", "c.toml"))] * len(LOADS)
    cases = bench_frame.frame_cases(CFG, (), quick=False)
    assert started[-1] == (1, ("--realtime",))
    assert len(cases) == len(quick) + 1
    in_process, idle = cases[0], cases[1]
    assert (in_process["times_real_time"], in_process["ratio"]) == (pytest.approx(20.0), pytest.approx(10.0))
    assert idle["name"].endswith("2 panels, idle")
    assert (cases[-1]["us_p50"], cases[-1]["us_p99"], cases[-1]["ratio"]) == (100.0, 200.0, pytest.approx(0.01))
    result = {"machine": machine(), "cases": cases}
    table = [line for line in bench.tables(result).splitlines() if line.startswith("|")]
    assert len(table) == len(cases) + 2
    assert len({line.count("|") for line in table}) == 1
    assert "| 200 |" in table[-1]
    assert "| 0.010 |" in table[-1]


def test_a_mission_that_measured_too_little_gives_no_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    def measures(points: int) -> None:
        found = SimpleNamespace(mission_time_s=20.0, summary={"points": {"measured": points, "total": 9}})
        monkeypatch.setattr(bench_frame, "rehearse", lambda part: found if part.run.panels == 1 else None)

    measures(9)
    assert bench_frame.rehearsal(CFG, 1)[0] == 20.0
    measures(8)
    with pytest.raises(BenchError, match="measured 8 of 9 points"):
        bench_frame.rehearsal(CFG, 1)


class FakeRun:
    """A run that has ended."""

    def __init__(self, command: list[str], stdout: Any, stderr: Any, **_: Any) -> None:
        self.command, self.pid = command, 1
        self.returncode = int(command[-1])
        stdout.write(json.dumps(SUMMARY))
        stderr.write("first\nccatp: held\n")

    def poll(self) -> int:
        return self.returncode


@pytest.mark.parametrize(
    ("status", "timeout_s", "text"),
    [
        (4, 900.0, "ended with status 4: ccatp: held"),
        (0, 900.0, "over before it was looked at twice"),
        (0, 0.0, "not over after 0 s"),
    ],
)
def test_a_run_that_gives_no_figure(status: int, timeout_s: float, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "Popen", FakeRun)
    monkeypatch.setattr(bench_frame, "TIMEOUT_S", timeout_s)
    monkeypatch.setattr(bench_frame, "_run_command", lambda *_: ["ccatp", str(status)])
    with pytest.raises(BenchError, match=text):
        bench_frame.lockstep_run(1)


def test_the_calibrators_lines_are_those_of_the_robot_link() -> None:
    line = json.dumps(calibrator.SENSORS, separators=(",", ":")).encode()
    assert isinstance(decode_from_robot(line), Sensors)
    assert isinstance(decode_from_client(json.dumps(calibrator.DRIVE).encode()), Drive)
    robot = Robot(CFG, build_mirror(CFG.mirror), np.random.default_rng(1))
    robot.join("monitor")
    robot.join("controller")
    for number in range(300):
        robot.advance()
        robot.permit(number, True, True, True)
        robot.drive(number, 1.0, 1.1)
    assert robot.delivered is not None
    assert len(line) == pytest.approx(len(encode(robot.delivered)), rel=0.1)


def test_the_calibrator_under_each_load(capfd: pytest.CaptureFixture[str]) -> None:
    assert calibrator.main(["--rounds", "1", "--frames", "20", "--json"]) == 0
    result = json.loads(capfd.readouterr().out)
    assert list(result) == [IDLE, ONE_CORE, BUSY]
    assert all(len(row["us"]) == 1 and row["us"][0] > 0.0 and row["cpu_us"][0] > 0.0 for row in result.values())


def test_a_load_ends_with_its_block() -> None:
    cores = os.sched_getaffinity(0)
    with load(ONE_CORE):
        assert os.sched_getaffinity(0) == {min(cores)}
    assert os.sched_getaffinity(0) == cores
    with load(BUSY):
        assert len(multiprocessing.active_children()) == len(cores)
    assert not multiprocessing.active_children()
