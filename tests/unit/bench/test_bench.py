"""The benchmarks: equality with the peers, the same problems each time, the format. No times are asserted."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from ccatp.bench import missions, problems, report, suite
from ccatp.bench.contenders import our_filter, played_back, printed_filter
from ccatp.bench.exact import exact_filter
from ccatp.bench.machine import cpu_model, machine
from ccatp.bench.missions import BenchError
from ccatp.bench.peers import filterpy_extended, filterpy_linear, filterpy_unscented, stonesoup
from ccatp.bench.problems import (
    LINEAR_ROWS,
    POSE_ROWS,
    FilterProblem,
    linear_problem,
    mild,
    models,
    pose_problem,
    range_problem,
    survey_problem,
)
from ccatp.bench.race import Difference, largest_difference, race
from ccatp.bench.slam_race import dense_slam, our_slam, slam_problem
from ccatp.cli.study import bench
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.filters.unscented import ALPHA, BETA

STEPS = 10


@pytest.fixture(scope="module")
def cfg() -> Config:
    return load_config()


@pytest.mark.parametrize("rows", LINEAR_ROWS)
def test_the_linear_filter_equals_its_peers(cfg: Config, rows: int) -> None:
    problem = linear_problem(cfg.robot, cfg.localizer, rows, 1)
    assert problem.readings.shape == (problems.STEPS, rows)
    for peer in (printed_filter, filterpy_linear, lambda given: stonesoup("Kalman", given)):
        found = largest_difference(our_filter("kf", mild(problem)), peer(mild(problem)), STEPS)
        assert found.absolute < suite.EQUAL_WITHIN
        assert found.sigmas < 1e-9  # rounding, with room for an inverse


@pytest.mark.parametrize("rows", LINEAR_ROWS)
def test_with_the_shipped_noise_ours_is_the_exact_answer(cfg: Config, rows: int) -> None:
    problem = linear_problem(cfg.robot, cfg.localizer, rows, 1)
    exact = played_back(exact_filter(problem), STEPS)
    ours = largest_difference(our_filter("kf", problem), exact, STEPS)
    printed = largest_difference(printed_filter(problem), exact, STEPS)
    assert ours.absolute < 1e-13  # rounding of speeds and angles of the order of one
    assert ours.sigmas < 1e-9
    assert rows < 22 or printed.absolute > suite.EQUAL_WITHIN  # the printed form's own rounding


def test_the_exact_answer_on_a_case_done_by_hand() -> None:
    # Prior N(1, 4) kept, one reading 3 of variance 4: weights one half each. Sigma points of a line say the same.
    one, four, z = np.ones((1, 1)), np.array([[4.0]]), np.array([[3.0]])
    given = FilterProblem(np.ones(1), four, 0.0 * one, np.array([4.0]), z, F=one, H=one)
    for unscented in (False, True):
        exact = exact_filter(given, unscented=unscented)
        exact.step(0)
        x, P = exact.result()
        assert (x[0], P[0, 0]) == (2.0, 2.0)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_the_full_state_model_is_filtered_exactly(cfg: Config, name: str) -> None:
    problem = survey_problem(cfg, 1)
    assert (problem.mean.size, problem.variances.size) == (19, 4)
    exact = exact_filter(problem, unscented=name == "ukf")
    assert largest_difference(our_filter(name, problem), exact, 4).absolute < 1e-13  # rounding
    peers = (filterpy_extended,) if name == "ekf" else (lambda p: filterpy_unscented(p, ALPHA, BETA, 0.0),)
    for peer in peers:
        assert largest_difference(our_filter(name, problem), peer(problem), STEPS).absolute < suite.EQUAL_WITHIN


@pytest.mark.parametrize("rows", POSE_ROWS)
def test_the_nonlinear_filters_equal_their_peers(cfg: Config, rows: int) -> None:
    problem = mild(pose_problem(cfg.robot, cfg.localizer, rows, 1))
    for peer in (printed_filter, filterpy_extended, lambda given: stonesoup("ExtendedKalman", given)):
        assert largest_difference(our_filter("ekf", problem), peer(problem), STEPS).sigmas < 1e-9  # rounding
    points = {"alpha": ALPHA, "beta": BETA, "kappa": 0.0}
    for unscented in (filterpy_unscented(problem, **points), stonesoup("UnscentedKalman", problem, **points)):
        assert largest_difference(our_filter("ukf", problem), unscented, STEPS).sigmas < 1e-9  # rounding


def test_a_peer_that_computes_something_else_is_found_out(cfg: Config) -> None:
    problem = mild(pose_problem(cfg.robot, cfg.localizer, 4, 1))
    other = filterpy_unscented(problem, ALPHA, BETA, 1.0)
    assert largest_difference(our_filter("ukf", problem), other, STEPS).absolute > suite.EQUAL_WITHIN
    with pytest.raises(BenchError, match=r"differ from those of P by 2e-10, more than 1e-10"):
        suite._checked("case", "P", Difference(2e-10, 0.0))
    found = {"name": "case", "peer": "P", "largest_difference": 2e-10, "rounding_sigmas": 0.0}
    suite._check_equal({**found, "error": 1e-15, "peer_error": 2e-10})
    for error, peer_error in ((2e-10, 1e-15), (5e-11, 5e-11), (float("nan"), 2e-10)):
        with pytest.raises(BenchError, match=r"differ from those of P by 2e-10"):
            suite._check_equal({**found, "error": error, "peer_error": peer_error})
    with pytest.raises(BenchError, match=r"differ from those of P by nan"):
        suite._checked("case", "P", Difference(float("nan"), 0.0))


@pytest.mark.parametrize("rows", POSE_ROWS)
def test_the_jacobians_of_the_pose_model(cfg: Config, rows: int) -> None:
    problem = pose_problem(cfg.robot, cfg.localizer, rows, 1)
    step, x = 1e-6, problem.mean
    for model in models(problem):
        tips = np.array([model.at(x + d)[0] - model.at(x - d)[0] for d in step * np.eye(x.size)]) / (2.0 * step)
        assert model.at(x)[1] == pytest.approx(tips.T, abs=1e-6)  # central differences, values up to 100
        assert model.through(np.array([x, 2.0 * x]))[1] == pytest.approx(model.at(2.0 * x)[0])


def test_the_problems_are_a_function_of_the_seed(cfg: Config) -> None:
    for build in (linear_problem, pose_problem):
        first, again, other = (build(cfg.robot, cfg.localizer, 4, seed).readings for seed in (1, 1, 2))
        assert np.array_equal(first, again)
        assert not np.array_equal(first, other)
    ranges = [range_problem(cfg, seed).ranges_m for seed in (1, 1, 2)]
    assert np.array_equal(ranges[0], ranges[1])
    assert not np.array_equal(ranges[0], ranges[2])


def test_a_linear_problem_has_no_nonlinear_models(cfg: Config) -> None:
    with pytest.raises(ValueError, match="n = 4 with linear models"):
        models(linear_problem(cfg.robot, cfg.localizer, 2, 1))


def test_a_race_times_every_step_of_both(cfg: Config) -> None:
    problem = linear_problem(cfg.robot, cfg.localizer, 2, 1)
    times = race(our_filter("kf", problem), printed_filter(problem), STEPS, 2)
    assert times.peer_us is not None
    assert times.ours_us.shape == times.peer_us.shape == (2, STEPS)
    assert times.ours_us.min() > 0.0
    assert race(our_filter("kf", problem), None, STEPS, 1).peer_us is None


def test_a_missing_peer_leaves_ours_and_says_how_to_install_it(cfg: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("filterpy.kalman", "stonesoup.predictor.kalman"):
        monkeypatch.setitem(sys.modules, package, None)
    cases = list(suite.filter_cases(cfg, 1))
    missing = [case for case in cases if case["peer"] is None]
    assert len(missing) == 2 * (len(LINEAR_ROWS) + 2 * len(POSE_ROWS) + 2)
    assert all(case["us_p50"] > 0.0 and case["ratio"] is None for case in missing)
    assert missing[0]["note"] == "filterpy is not installed: pip install 'ccatp[peers]'"
    result = {"machine": machine(), "equal_within": 1e-10, "cases": missing}
    assert "pip install 'ccatp[peers]'" in report.markdown(result)
    assert "pip install 'ccatp[peers]'" in report.terminal_lines(result)[1]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite, "QUICK_ROUNDS", 1)


@pytest.mark.usefixtures("quick")
def test_the_command_and_its_page(tmp_path: Path) -> None:
    page = tmp_path / "bench.md"
    arguments = ["--quick", "--steps-only", "--json", "--markdown", str(page)]
    done = CliRunner().invoke(bench, arguments, standalone_mode=False)
    assert done.exception is None
    result = json.loads(done.stdout)
    assert {"cpu", "cores", "python", "numpy"} <= result["machine"].keys()
    for case in result["cases"]:
        assert {"name", "us_p50", "us_p99", "peer", "peer_us_p50", "ratio"} <= case.keys()
        if case["name"].startswith("ekf-slam, 200"):
            assert case["peer"] is None  # whole matrices of that size take too long
            assert case["us_p50"] > 0.0
            continue
        assert case["ratio"] == pytest.approx(case["us_p50"] / case["peer_us_p50"])
        assert result["equal_within"] == 1e-10
        assert case["largest_difference"] <= 1e-10 or case["error"] <= 1e-10 < case["peer_error"]
    peers = {case["peer"] for case in result["cases"]} - {None}
    assert peers == {
        "eq. 2.13 in numpy", "filterpy", "Stone Soup", "scipy.optimize.least_squares", "whole matrices in numpy",
    }  # fmt: skip
    table = [line for line in page.read_text().splitlines() if line.startswith("|")]
    assert len(table) == len(result["cases"]) + 2
    assert len({line.count("|") for line in table}) == 1
    assert len(report.terminal_lines(result)) == len(result["cases"]) + 1


class Rehearsed:
    def __init__(self, measured: int) -> None:
        self.mission_time_s = 20.0
        self.summary = {"points": {"measured": measured, "total": 9}}


def test_a_mission_in_process(cfg: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def rehearse(part: Config) -> Rehearsed:
        asked.append(part.run.panels)
        return Rehearsed(9)

    monkeypatch.setattr(missions, "rehearse", rehearse)
    case = missions.rehearsal_case(cfg, 1)
    assert asked == [1]
    assert case["times_real_time"] == pytest.approx(20.0 / case["wall_s"])
    assert case["ratio"] == pytest.approx(1.0 / case["times_real_time"])
    assert case["peer_us_p50"] == pytest.approx(1e4)  # a frame of 100 Hz
    assert "1 panel |" in report.markdown({"machine": machine(), "equal_within": 1e-10, "cases": [case]})
    monkeypatch.setattr(missions, "rehearse", lambda _: Rehearsed(8))
    with pytest.raises(BenchError, match="measured 8 of 9 points"):
        missions.rehearsal_case(cfg, 1)


def test_a_mission_in_lockstep(cfg: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    wall = {"tick_us_p50": 100.0, "tick_us_p99": 200.0, "realtime_factor": 20.0}
    commands: list[list[str]] = []

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        return subprocess.CompletedProcess(command, 0, json.dumps({"mission_time_s": 30.0, "wall": wall}), "")

    monkeypatch.setattr(subprocess, "run", run)
    case = missions.lockstep_case(cfg, 4, ("--config", "c.toml"))
    assert commands[0][2:8] == ["ccatp", "run", "--sim", "--json", "--panels", "4"]
    assert commands[0][8:10] == ["--config", "c.toml"]
    assert case["tick_us_p99"] == 200.0
    assert case["times_real_time"] == pytest.approx(30.0 / case["wall_s"])


def test_a_mission_that_fails(cfg: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "run", lambda c, **_: subprocess.CompletedProcess(c, 4, "", "first\nccatp: held\n"))
    with pytest.raises(BenchError, match="ended with status 4: ccatp: held"):
        missions.lockstep_case(cfg, 1)

    def late(command: list[str], **_: Any) -> None:
        raise subprocess.TimeoutExpired(command, missions.TIMEOUT_S)

    monkeypatch.setattr(subprocess, "run", late)
    with pytest.raises(BenchError, match="was not over after 900 s"):
        missions.lockstep_case(cfg, 1)


def test_the_machine(tmp_path: Path) -> None:
    info = tmp_path / "cpuinfo"
    info.write_text("processor : 0\nmodel name\t: Some CPU @ 1 GHz\nmodel name : Other\n")
    assert cpu_model(info) == "Some CPU @ 1 GHz"
    assert cpu_model(tmp_path / "none") != "Some CPU @ 1 GHz"
    assert f"Python {sys.version_info.major}." in report.machine_line(machine(info))
    assert "ccatp interpreted" in report.machine_line(machine(info))


@pytest.mark.parametrize("beacons", [4, 20])
def test_slam_by_blocks_equals_whole_matrices(beacons: int) -> None:
    problem = slam_problem(beacons, STEPS, 1)
    ours, dense = our_slam(problem), dense_slam(problem)
    assert largest_difference(ours, dense, STEPS).absolute < suite.EQUAL_WITHIN
    mean, covariance = ours.result()
    heard = slice(5, 7)
    assert np.trace(covariance[heard, heard]) < 0.8 * np.trace(problem.covariance[heard, heard])
    assert mean.size == 5 + 2 * beacons
