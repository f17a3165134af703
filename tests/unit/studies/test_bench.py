"""The benchmarks: equality with the peers, the same problems each time, the format. No times are asserted."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from ccatp.cli.study import bench as command
from ccatp.config.load import load_config
from ccatp.studies import bench, bench_cases
from ccatp.studies.bench import largest_difference, machine, race, step_case
from ccatp.studies.bench_cases import Contender, Race, races
from ccatp.studies.bench_frame import BenchError

STEPS = 10
CFG = load_config()
RACES = list(races(CFG))


@pytest.mark.parametrize("one", [one for one in RACES if one.peers], ids=lambda one: one.name)
def test_every_peer_computes_the_same(one: Race) -> None:
    for peer in one.peers.values():
        assert largest_difference(one.ours, peer, STEPS) < bench.EQUAL_WITHIN
    states = list(one.ours())
    assert len(states) == 1 + bench_cases.STEPS


def fixed(value: float) -> Contender:
    """A contender whose result does not change."""
    return lambda: iter([lambda: (np.full(2, value), np.eye(2))] * (1 + bench_cases.STEPS))


@pytest.mark.parametrize(("value", "difference"), [(1.0 + 2e-10, "2e-10"), (float("nan"), "nan")])
def test_a_peer_with_another_result_ends_the_run(value: float, difference: str) -> None:
    assert step_case("case", fixed(1.0), "P", fixed(1.0 + 5e-11), 1)["largest_difference"] == pytest.approx(5e-11)
    with pytest.raises(BenchError, match=f"case: results differ from those of P by {difference}, more than 1e-10"):
        step_case("case", fixed(1.0), "P", fixed(value), 1)


def test_a_race_times_every_step_of_both() -> None:
    times_us = race(RACES[0].ours, RACES[0].peers["eq. 2.13 in numpy"], 2, STEPS)
    assert times_us.shape == (2, 2, STEPS)
    assert times_us.min() > 0.0
    assert race(RACES[0].ours, None, 1, STEPS).shape == (1, 1, STEPS)


def test_a_missing_peer_leaves_ours_and_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("filterpy.kalman", "stonesoup.predictor.kalman"):
        monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setattr(bench, "races", lambda _: RACES[:1])
    printed, filterpy, stonesoup = cases = list(bench.step_cases(CFG, 1))
    result = {"machine": machine(), "equal_within": 1e-10, "cases": cases}
    assert printed["ratio"] > 0.0
    assert (filterpy["peer"], filterpy["ratio"], stonesoup["peer"]) == (None, None, None)
    assert filterpy["note"] == "filterpy is not installed: pip install 'ccatp[peers]'"
    assert bench.markdown(result).endswith("* Stone Soup is not installed: pip install 'ccatp[peers]'\n")
    assert "pip install 'ccatp[peers]'" in bench.terminal_lines(result)[2]


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
        if case["peer"] is None:
            assert case["name"].startswith("ekf-slam, 200")  # whole matrices of that size take too long
            assert case["us_p50"] > 0.0
            continue
        assert case["us_p99"] >= case["us_p50"]
        assert case["ratio"] == pytest.approx(case["us_p50"] / case["peer_us_p50"])
        assert case["largest_difference"] <= 1e-10
    names = {case["peer"] for case in result["cases"]} - {None}
    assert names == {name for one in RACES for name in one.peers}
    table = [line for line in page.read_text().splitlines() if line.startswith("|")]
    assert len(table) == len(result["cases"]) + 2
    assert len({line.count("|") for line in table}) == 1
    assert len(bench.terminal_lines(result)) == len(result["cases"]) + 1
    written = page.read_text()
    page.write_text(f"old\n{bench.BY_HAND}kept\n")
    bench.write_page(page, result)
    assert page.read_text() == f"{written}\n{bench.BY_HAND}kept\n"
