"""The benchmarks: equality with the peers, the same problems each time, the format. No times are asserted."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from ccatp.cli.study import bench as command
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.studies import bench, bench_cases
from ccatp.studies.bench import BenchError, cpu_model, largest_difference, machine, race, step_case
from ccatp.studies.bench_cases import (
    Contender,
    FilterProblem,
    dense_slam,
    our_filter,
    our_slam,
    printed_filter,
    range_problem,
    slam_problem,
    thesis_problem,
)

STEPS = 10


@pytest.fixture(scope="module")
def cfg() -> Config:
    return load_config()


@pytest.mark.parametrize(
    ("filter_name", "problem_of", "peer_of"),
    [
        pytest.param(name, problem_of, peer_of, id=f"{name}-{k}-{peer}")
        for k, (name, problem_of, peers) in enumerate(bench.FILTER_CASES)
        for peer, peer_of in peers.items()
    ],
)
def test_filters_equal_their_peers(
    cfg: Config,
    filter_name: str,
    problem_of: Callable[[Config], FilterProblem],
    peer_of: Callable[[FilterProblem], Contender],
) -> None:
    problem = problem_of(cfg)
    assert problem.readings.shape == (bench_cases.STEPS, problem.variances.size)
    assert largest_difference(our_filter(filter_name, problem), peer_of(problem), STEPS) < bench.EQUAL_WITHIN


@pytest.mark.parametrize("beacons", [4, 20])
def test_slam_by_blocks_equals_whole_matrices(beacons: int) -> None:
    problem = slam_problem(beacons)
    ours = our_slam(problem)
    assert largest_difference(ours, dense_slam(problem), STEPS) < bench.EQUAL_WITHIN
    mean, covariance = ours.result()
    measured = slice(5, 7)
    assert np.trace(covariance[measured, measured]) < 0.8 * np.trace(problem.covariance[measured, measured])
    assert mean.size == 5 + 2 * beacons


def fixed(value: float) -> Contender:
    """A contender whose result does not change."""
    return Contender(lambda: None, lambda _: None, lambda: (np.full(2, value), np.eye(2)))


@pytest.mark.parametrize(("value", "difference"), [(1.0 + 2e-10, "2e-10"), (float("nan"), "nan")])
def test_a_peer_with_another_result_ends_the_run(value: float, difference: str) -> None:
    assert step_case("case", fixed(1.0), "P", fixed(1.0 + 5e-11), 1)["largest_difference"] == pytest.approx(5e-11)
    with pytest.raises(BenchError, match=f"case: results differ from those of P by {difference}, more than 1e-10"):
        step_case("case", fixed(1.0), "P", fixed(value), 1)


def test_the_problems_are_a_function_of_the_seed(cfg: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    def readings() -> list[Any]:
        problems = [problem_of(cfg).readings for _, problem_of, _ in bench.FILTER_CASES]
        return [*problems, range_problem(cfg).ranges_m, slam_problem(4).ranges_m]

    first, again = readings(), readings()
    monkeypatch.setattr(bench_cases, "SEED", 2)
    for one, same, other in zip(first, again, readings(), strict=True):
        assert np.array_equal(one, same)
        assert not np.array_equal(one, other)


def test_a_race_times_every_step_of_both(cfg: Config) -> None:
    problem = thesis_problem(cfg, 2)
    times_us = race(our_filter("kf", problem), printed_filter(problem), 2, STEPS)
    assert times_us.shape == (2, 2, STEPS)
    assert times_us.min() > 0.0
    assert race(our_filter("kf", problem), None, 1, STEPS).shape == (1, 1, STEPS)


def test_a_missing_peer_leaves_ours_and_says_how_to_install_it(cfg: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("filterpy.kalman", "stonesoup.predictor.kalman"):
        monkeypatch.setitem(sys.modules, package, None)
    cases = [case for case in bench.step_cases(cfg, 1) if case["peer"] is None and "slam" not in case["name"]]
    assert len(cases) == 2 * len(bench.FILTER_CASES)
    assert all(case["us_p50"] > 0.0 and case["ratio"] is None for case in cases)
    assert cases[0]["note"] == "filterpy is not installed: pip install 'ccatp[peers]'"
    result = {"machine": machine(), "equal_within": 1e-10, "cases": cases}
    assert "pip install 'ccatp[peers]'" in bench.markdown(result)
    assert "pip install 'ccatp[peers]'" in bench.terminal_lines(result)[1]


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
        assert {"name", "us_p50", "us_p99", "peer", "peer_us_p50", "ratio"} <= case.keys()
        if case["peer"] is None:
            assert case["name"].startswith("ekf-slam, 200")  # whole matrices of that size take too long
            assert case["us_p50"] > 0.0
            continue
        assert case["ratio"] == pytest.approx(case["us_p50"] / case["peer_us_p50"])
        assert case["largest_difference"] <= 1e-10
    peers = {case["peer"] for case in result["cases"]} - {None}
    assert peers == {*bench.LINEAR, "scipy.optimize.least_squares", "whole matrices in numpy"}
    table = [line for line in page.read_text().splitlines() if line.startswith("|")]
    assert len(table) == len(result["cases"]) + 2
    assert len({line.count("|") for line in table}) == 1
    assert len(bench.terminal_lines(result)) == len(result["cases"]) + 1


class Rehearsed:
    def __init__(self, measured: int) -> None:
        self.mission_time_s = 20.0
        self.summary = {"points": {"measured": measured, "total": 9}}


def test_a_mission_in_process(cfg: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def rehearse(part: Config) -> Rehearsed:
        asked.append(part.run.panels)
        return Rehearsed(9)

    monkeypatch.setattr(bench, "rehearse", rehearse)
    case = bench.rehearsal_case(cfg, 1)
    assert asked == [1]
    assert case["times_real_time"] == pytest.approx(20.0 / case["wall_s"])
    assert case["ratio"] == pytest.approx(1.0 / case["times_real_time"])
    assert case["peer_us_p50"] == pytest.approx(1e4)  # a frame of 100 Hz
    assert "1 panel |" in bench.markdown({"machine": machine(), "equal_within": 1e-10, "cases": [case]})
    monkeypatch.setattr(bench, "rehearse", lambda _: Rehearsed(8))
    with pytest.raises(BenchError, match="measured 8 of 9 points"):
        bench.rehearsal_case(cfg, 1)


def test_a_mission_in_lockstep(cfg: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    wall = {"tick_us_p50": 100.0, "tick_us_p99": 200.0, "realtime_factor": 20.0}
    commands: list[list[str]] = []

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        return subprocess.CompletedProcess(command, 0, json.dumps({"mission_time_s": 30.0, "wall": wall}), "")

    monkeypatch.setattr(subprocess, "run", run)
    case = bench.lockstep_case(cfg, 4, ("--config", "c.toml"))
    assert commands[0][2:8] == ["ccatp", "run", "--sim", "--json", "--panels", "4"]
    assert commands[0][8:10] == ["--config", "c.toml"]
    assert case["tick_us_p99"] == 200.0
    assert case["times_real_time"] == pytest.approx(30.0 / case["wall_s"])
    monkeypatch.setattr(subprocess, "run", lambda c, **_: subprocess.CompletedProcess(c, 4, "", "first\nccatp: held\n"))
    with pytest.raises(BenchError, match="ended with status 4: ccatp: held"):
        bench.lockstep_case(cfg, 1)

    def late(command: list[str], **_: Any) -> None:
        raise subprocess.TimeoutExpired(command, bench.TIMEOUT_S)

    monkeypatch.setattr(subprocess, "run", late)
    with pytest.raises(BenchError, match="was not over after 900 s"):
        bench.lockstep_case(cfg, 1)


def test_the_machine(tmp_path: Path) -> None:
    info = tmp_path / "cpuinfo"
    info.write_text("processor : 0\nmodel name\t: Some CPU @ 1 GHz\nmodel name : Other\n")
    assert cpu_model(info) == "Some CPU @ 1 GHz"
    assert cpu_model(tmp_path / "none") != "Some CPU @ 1 GHz"
    assert f"Python {sys.version_info.major}." in bench.machine_line(machine(info))
