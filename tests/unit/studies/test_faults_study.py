"""The study of whole missions with random faults: its plans, a real job, what a cell says."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from ccatp.config.load import load_config
from ccatp.mirror.mirror import build_mirror
from ccatp.studies import faults_study
from ccatp.studies.campaign import CellResult, Job, JobOutcome, cells_of, plain
from ccatp.studies.faults_study import FIRST_S, LONGEST_S, is_recoverable, random_plan
from ccatp.studies.job_store import table
from tests.faults.campaign import single

DANGER = {"true_edges": 0, "false_edges": 1, "falls": 0, "max_overrun_mm": 2.0}


def outcome(seed: int, how: str, **changes: Any) -> JobOutcome:
    values = {
        "seed": seed,
        "outcome": how,
        "cause": "" if how == "complete" else "held",
        "injected": {"planned": 12, "acted": 11},
        "is_recoverable": how == "complete",
        "weak_frames": 0,
        "points": {"measured": 9, "total": 9},
        "danger": DANGER,
        "mission_time_s": 110.0,
        "lower_bound_s": 100.0,
        "within_budget": True,
        "states_s": {"driving": 60.0},
    }
    return JobOutcome(values | changes, {})


def run(faults: str, seed: int = 5) -> Mapping[str, Any]:
    keys = {"run.mirror": "fyst-m2", "run.panels": 1, "run.seed": seed, **faults_study.STUDY.defaults}
    return faults_study.run_job(Job("faults", {"faults": faults}, seed, load_config(None, keys))).values


def test_a_plan_lies_within_its_mission_and_is_of_its_seed() -> None:
    plan = random_plan(7, 40, 500.0)
    assert plan == random_plan(7, 40, 500.0) != random_plan(8, 40, 500.0)
    assert len(plan.faults) == 40
    assert all(FIRST_S <= fault.at_s <= 500.0 and fault.end_s - fault.at_s <= LONGEST_S for fault in plan.faults)
    assert max(fault.at_s for fault in plan.faults) > 400.0


@pytest.mark.parametrize("faults", [faults_study.NONE, faults_study.RANDOM])
def test_a_real_job(faults: str) -> None:
    values = run(faults)
    assert values["outcome"] == "complete", values["cause"]
    assert values["points"]["measured"] == values["points"]["total"] == 9
    assert (values["danger"]["falls"], values["weak_frames"]) == (0, 0)
    planned = faults_study.FAULTS_PER_MISSION if faults == faults_study.RANDOM else 0
    assert values["injected"]["planned"] == planned
    assert planned / 2 <= values["injected"]["acted"] <= planned


def test_fans_that_seem_to_fail_on_an_overhang_wait_for_an_operator() -> None:
    fans, other = (
        single('signal = "fans"\ntype = "off"\nat_s = 5.0'),
        single('signal = "soc"\ntype = "off"\nat_s = 5.0'),
    )
    upright, overhanging = (
        build_mirror(load_config(None, {"run.mirror": name}).mirror) for name in ("fyst-m1", "fyst-m2")
    )
    assert not is_recoverable(fans, overhanging)
    assert is_recoverable(fans, upright)
    assert is_recoverable(other, overhanging)


def test_fans_below_their_floor_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ccatp.sim.rules.FanRules.thrust", 0.0)
    monkeypatch.setattr("ccatp.sim.world.World._fall", lambda self: None)
    assert run(faults_study.RANDOM)["weak_frames"] > 1000


def test_a_cell_says_who_was_not_completed_and_is_drawn(tmp_path: Path) -> None:
    results = []
    for cell in cells_of(faults_study.STUDY):
        runs = [outcome(1, "complete"), outcome(2, "stopped", weak_frames=4)]
        values, arrays = faults_study.STUDY.combine(cell.factors, runs)
        results.append(CellResult(cell.factors, {"runs": 2, **values}, arrays))
    first = results[0].values
    assert (first["complete"], first["ended"]) == (1, ["seed 2 stopped: held"])
    assert first["recoverable"] == {"runs": 1, "complete": 1}
    assert (first["danger"]["false_edges"], first["weak_frames"]) == (2, 4)
    assert (first["injected"]["acted"], first["points"]["total"], first["time_ratio"]) == (22, 18, 1.1)
    lines = table([plain({**cell.factors, **cell.values}) for cell in results], faults_study.COLUMNS).splitlines()
    assert len(lines) == 2 + 8
    assert lines[3].startswith("| thesis-m1 | random | 2 | 1 |")
    assert "seed 2 stopped: held" in lines[3]
    faults_study.STUDY.draw(results, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"faults.png", "faults.pdf"}
