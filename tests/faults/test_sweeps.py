"""The rim of all four mirrors, ways over the seams, and random faults: no fall, no false edge.

One part of 96 is swept by the slow tests, which measure for the fault table. All of it, 4 million drives, takes
five to nine hours of one core: ``make sweep``, which ``make test-slow`` ends with.
"""

import json
import os
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import cos, inf, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.core import DeckPose, EventCode, Verdict
from ccatp.danger import DangerMonitor
from ccatp.links.topics import EstimateMessage, is_estimate_due
from ccatp.sim.fault_plan import FaultPlan, Injected
from ccatp.sim.robot import Robot
from ccatp.studies.faults_study import random_plan
from ccatp.studies.sil_run import SilResult, SilRun
from tests.faults.linking import Measured
from tests.support.cases import slow_case
from tests.support.scenario import config_of, one_panel
from tests.support.sim_survey import plan_of
from tools import edge_sweep
from tools.edge_sweep import Tally, rim_case, rim_cases, seam_case, speed_of, sweep, turn_case, turn_cases

# Random plans of faults that pass by; of such missions this share has to be completed.
MISSIONS = int(os.environ.get("CCATP_FAULT_PLANS", "40"))
LEAST_COMPLETE = 0.99
FAULTS_PER_MISSION, LAST_S = 4, 80.0
SHARD, SHARDS = 5, 96
MIN_DRIVEN = 0.25
PERMIT_S = 0.1  # S22, S24

# Slower than this the way that tells a direction, 0.2 mm and more, takes longer than the bound in time.
SLOW_M_S = 0.02


Numbers = Callable[[], Sequence[int]]  # of drives, once they are asked for: it takes a while to know how many there are


def check(tally: Tally, least_driven: float = 0.0) -> None:
    print(tally.line)
    assert edge_sweep.is_good(tally), "\n".join(tally.worst)
    assert tally.drives >= least_driven


def some(seed: int, count: int, of: Callable[[], int]) -> Any:
    rng = random.Random(seed)
    return pytest.param(lambda: [rng.randrange(of()) for _ in range(count)], id="sample")


def slow(numbers: Numbers, name: str) -> Any:
    return pytest.param(numbers, marks=pytest.mark.slow, id=name)


def test_a_number_is_a_drive() -> None:
    """Every place of every rim, heading and speed has its number, and the same number is the same drive."""
    assert rim_cases() > 3_000_000
    names = {rim_case(number)[0] for number in range(0, rim_cases(), 9973)}
    assert len(names) == len(range(0, rim_cases(), 9973))
    assert {name.split()[2] for name in names} == set(edge_sweep.MIRRORS)
    assert rim_case(4)[1]() == rim_case(4)[1]()


def part_of_the_rim(part: int) -> Any:
    return slow(lambda: range(SHARD + SHARDS * part, rim_cases(), 4 * SHARDS), f"part {part}")


@pytest.mark.fault("S22")
@pytest.mark.parametrize("numbers", [some(20, 160, rim_cases), *map(part_of_the_rim, range(4))])
def test_drives_over_the_rim(numbers: Numbers, measured: Measured) -> None:
    """All drives count for falls and overrun; the time to the permit is that of those that are not slow."""
    tally, late_s, drives = Tally(), 0.0, numbers()
    for number in drives:
        one = sweep(rim_case, [number])
        tally.add(one)
        if speed_of(number) >= SLOW_M_S:
            late_s = max(late_s, one.late_s)
    check(tally, len(drives) * MIN_DRIVEN)
    measured("S22", 1e3 * tally.after_m, "mm")
    measured("S22", 1e3 * late_s, "ms")
    measured("S22", tally.falls, "falls")


@pytest.mark.fault("S24")
@pytest.mark.parametrize(
    "numbers", [some(24, 60, turn_cases), slow(lambda: range(SHARD, turn_cases(), SHARDS), "a part")]
)
def test_turns_beside_the_rim(numbers: Numbers, measured: Measured) -> None:
    tally = sweep(turn_case, numbers())
    check(tally, 60 * MIN_DRIVEN)
    assert tally.late_s <= PERMIT_S
    measured("S24", 1e3 * tally.late_s)


def half_of_the_seams(half: int) -> Any:
    # Neither mirrors nor kinds of crossing may fall out of step with the shards.
    numbers = range(edge_sweep.SEAMS * half // 2, edge_sweep.SEAMS * (half + 1) // 2)
    return slow(lambda: [k for k in numbers if k // 8 % SHARDS == SHARD % SHARDS], f"half {half}")


@pytest.mark.fault("S20", "S21")
@pytest.mark.parametrize("numbers", [some(21, 24, lambda: edge_sweep.SEAMS), *map(half_of_the_seams, range(2))])
def test_ways_and_stops_over_seams(numbers: Numbers, measured: Measured) -> None:
    tally = sweep(seam_case, numbers())
    check(tally)
    assert tally.over_gap > 2
    measured("S20", tally.false_edges / tally.transits)
    measured("S21", float(tally.false_edges))


# -- the whole sweep --------------------------------------------------------------------------------------------------


def few_drives(monkeypatch: pytest.MonkeyPatch, falls_at: int | None = None) -> None:
    """Ten drives over a rim and five over seams, in blocks of four."""

    def case(number: int) -> tuple[str, Callable[[], Tally]]:
        return f"drive {number}", lambda: Tally(drives=1, falls=int(number == falls_at))

    monkeypatch.setattr(edge_sweep, "BLOCK", 4)
    monkeypatch.setattr(edge_sweep, "KINDS", {"rim": (case, lambda: 10), "seam": (case, lambda: 5)})


def test_the_edge_sweep_is_every_drive_once() -> None:
    swept: dict[str, list[range]] = {}
    for kind, first in edge_sweep.blocks():
        swept.setdefault(kind, []).append(range(first, first + edge_sweep.BLOCK))
    for kind, count in (("rim", rim_cases()), ("turn", turn_cases()), ("seam", edge_sweep.SEAMS)):
        firsts = sorted(part.start for part in swept[kind])
        assert firsts == list(range(0, count, edge_sweep.BLOCK))


def test_the_edge_sweep_continues_where_it_was_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    few_drives(monkeypatch)
    assert edge_sweep.main([str(tmp_path), "--workers", "1", "--blocks", "2"]) == 0
    path = tmp_path / "blocks.jsonl"
    path.write_text(path.read_text()[:-5])  # killed while it wrote
    assert edge_sweep.main([str(tmp_path), "--workers", "1"]) == 0
    said = capsys.readouterr().out
    assert "1 of 5 blocks are done, 4 to do" in said
    assert "rim: 3 of 3 blocks, 10 drives" in said
    assert "seam: 2 of 2 blocks, 5 drives" in said


def test_the_edge_sweep_reports_which_robot_fell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    few_drives(monkeypatch, falls_at=3)
    assert edge_sweep.main([str(tmp_path), "--workers", "1"]) == 1
    assert "drive 3: 1 drives" in capsys.readouterr().out
    assert edge_sweep.main([str(tmp_path), "--workers", "1"]) == 1  # nor is it forgotten
    monkeypatch.setattr(edge_sweep, "build_id", lambda: "another")
    few_drives(monkeypatch)
    assert edge_sweep.main([str(tmp_path), "--workers", "1"]) == 0
    builds = [json.loads(line)["build"] for line in (tmp_path / "blocks.jsonl").read_text().split("\n") if line]
    assert builds[:5] != builds[5:] == ["another"] * 5


# -- random faults -----------------------------------------------------------------------------------------------------


def passing(seed: int) -> FaultPlan:
    """Faults of a mission on one panel."""
    return random_plan(seed, FAULTS_PER_MISSION, LAST_S)


@dataclass(frozen=True, slots=True)
class Ending:
    """What became of one mission."""

    plan: FaultPlan
    injected: tuple[Injected, ...]
    result: SilResult

    @property
    def line(self) -> str:
        """For people: faults, outcome, cause, falls, points."""
        faults = ", ".join(f"{f.signal} {f.type} at {f.at_s:.1f}" for f in self.plan.faults)
        points = self.result.summary["points"]
        falls = self.result.summary["danger"]["falls"]
        return f"{faults}: {self.result.outcome} ({self.result.cause}), {points['measured']} points, {falls} falls"


def survey(seed: int, plan: FaultPlan) -> Ending:
    """One panel in the hard world with the extended filter."""
    cfg = config_of(run__world="hard", run__panels=1, run__seed=seed)
    rehearsal = SilRun(cfg, plan)
    result = rehearsal.run()
    return Ending(plan, rehearsal.injected, result)


@pytest.mark.parametrize("seed", [19, pytest.param(45, marks=pytest.mark.slow)])
def test_a_slip_in_the_calibration_drive_does_not_mislead_for_good(seed: int) -> None:
    # The body slips in a turn; what the filter learns of it, wheel base and gyroscope, would be wrong ever after.
    ending = survey(seed, passing(seed))
    assert any(record.signal == "body" and record.changed for record in ending.injected)
    assert ending.result.outcome == "complete", ending.line
    assert ending.result.summary["points"]["measured"] == ending.result.summary["points"]["total"]


def test_a_rim_on_the_map_of_a_robot_that_finds_itself_is_no_edge() -> None:
    # An encoder at its rail turns the estimate by a radian: looks at the map show a rim, until the heading is found.
    ending = survey(189, passing(189))
    assert any(record.signal == "encoder_left" and record.changed for record in ending.injected)
    assert (ending.result.outcome, ending.result.summary["points"]["measured"]) == ("complete", 9), ending.line


@pytest.mark.slow
def test_nobody_falls_and_what_passes_by_is_survived() -> None:
    incomplete = []
    for seed in range(MISSIONS):
        ending = survey(seed, passing(seed))
        assert ending.result.summary["danger"]["falls"] == 0, ending.line
        assert ending.result.outcome in {"complete", "faulted", "aborted, at base"}, ending.line
        time_s = ending.result.summary["mission_time_s"]
        for record in ending.injected:
            assert record.at_s is not None
            # A second before the end a sensor of 20 Hz, too, has been read.
            assert record.samples > 0 or record.at_s > time_s - 1.0, (record, ending.line)
        if ending.result.outcome != "complete":
            incomplete.append(ending.line)
    assert len(incomplete) <= max(1, (1.0 - LEAST_COMPLETE) * MISSIONS), "\n".join(incomplete)


# -- a robot that is not where it takes itself to be -------------------------------------------------------------------


# The first panel lies at a corner. These meet the rim; most others find themselves before. How often they meet it
# depends on the rounding of the processor.
@pytest.mark.fault("S23")
@pytest.mark.parametrize("seeds", [(62,), slow_case((22, 69))])
def test_no_retreat_falls_at_a_corner(seeds: tuple[int, ...], measured: Measured) -> None:
    """Somewhere on the way the robot is put elsewhere and turned."""
    edges = 0
    for seed in seeds:
        rng = random.Random(seed)
        ranges = {"at_s": (3, 40), "dx_m": (-0.1, 0.1), "dy_m": (-0.1, 0.1), "dheading_rad": (-0.8, 0.8)}
        drawn = {key: round(rng.uniform(*ends), 2 if key == "at_s" else 3) for key, ends in ranges.items()}
        plan = plan_of(" ".join(["body kidnap", *(f"{key}={value:.3f}" for key, value in drawn.items())]))
        rehearsal = SilRun(one_panel(run__world="hard", run__seed=seed), plan)
        result = rehearsal.run()
        assert rehearsal.injected[0].changed
        danger = result.summary["danger"]
        measured("S23", danger["falls"])
        edges += danger["true_edges"]
        assert result.outcome == "complete" or result.cause  # held, and it is said why
    assert edges >= len(seeds)


# -- the verdict of the frame before -----------------------------------------------------------------------------------


def furthest_over_the_rim_m(name: str, start: DeckPose, v_m_s: float, seed: int, *, is_previous: bool) -> float:
    """How far a sensor comes beyond the rim where main goes by the verdict on this frame, or on the one before."""
    cfg, mirror = edge_sweep.world(name)
    robot = Robot(cfg, mirror, np.random.default_rng(seed))
    robot.join("controller")
    robot.join("monitor")
    plant, rate = robot.world.plant, v_m_s / cfg.robot.wheel_radius_m
    plant.place(start.x_m, start.y_m, start.heading_rad)
    robot._sensors.edges.place(plant)
    robot.command_fans(1, *cfg.robot.fan_duty)
    monitor = DangerMonitor(mirror, cfg.robot, cfg.danger, cfg.health)
    estimate: EstimateMessage | None = None
    before: Verdict | None = None
    furthest_m, frames_left = -inf, 700
    while frames_left:
        frames_left -= 1
        robot.advance()
        frame = robot.delivered
        if frame is None:
            continue
        verdict = monitor.step(frame, estimate)
        in_force, before = (before if is_previous else verdict), verdict
        drive = (rate, rate) if in_force is not None and in_force.code is EventCode.NORMAL else (0.0, 0.0)
        robot.permit(frame.seq, verdict.forward, verdict.reverse, verdict.turn)
        robot.drive(frame.seq, *drive)
        pose = plant.pose
        if is_estimate_due(frame.seq):
            estimate = EstimateMessage(
                seq=frame.seq, t_s=frame.t, x_m=pose.x_m, y_m=pose.y_m, heading_rad=pose.heading_rad, sigma_m=1e-3,
                state="driving", commanded=(0.0, rate, 0.0, rate), drive_seq=frame.seq,
            )  # fmt: skip
        c, s = cos(pose.heading_rad), sin(pose.heading_rad)
        corners = [(pose.x_m + a * c - b * s, pose.y_m + a * s + b * c) for a, b in cfg.robot.edge_sensors_m]
        furthest_m = max(furthest_m, *(-mirror.rim.signed_distance_m(*corner) for corner in corners))
        if verdict.code is EventCode.NEAR_EDGE:
            frames_left = min(frames_left, 60)  # it stands within half a second
    return furthest_m


@pytest.mark.parametrize("v_m_s", edge_sweep.SPEEDS_M_S[1:])
def test_a_decision_by_the_verdict_on_the_frame_before_costs_nothing_at_the_rim(v_m_s: float) -> None:
    """The permit on the present frame holds the wheels whatever main has decided."""
    for seed, name in enumerate(edge_sweep.MIRRORS):
        starts = (
            edge_sweep.start_before(name, place, place.normal_rad + 0.6 * (seed % 2), 1.0)
            for place in edge_sweep.places(name)[7::40]
        )
        start = next(found for found in starts if found is not None)  # it cannot stand everywhere
        now_m, before_m = (
            furthest_over_the_rim_m(name, start, v_m_s, seed, is_previous=is_previous) for is_previous in (False, True)
        )
        assert 0.0 < before_m <= edge_sweep.OVERRUN_M
        assert before_m <= now_m + 1e-4
