"""Pure. The study `faults`: whole missions without faults, and with random ones that pass by: falls, completion."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ccatp.assembly import assemble
from ccatp.mirror.mirror import Mirror
from ccatp.sim.faults.plan import FaultPlan
from ccatp.studies.campaign import Cell, Column, Factors, Job, Outcome, Study
from ccatp.studies.fault_plans import random_plan
from ccatp.studies.faults_figures import draw_faults
from ccatp.studies.faulty_rehearsal import FaultyRehearsal
from ccatp.studies.mission_cell import dangers, times
from ccatp.studies.rehearsal import rehearse
from ccatp.studies.rehearsal_result import Rehearsal

NONE, RANDOM = "none", "random"
FAULTS_PER_MISSION = 12
COLUMNS = (
    Column("complete", "complete"),
    Column("recoverable", "recoverable.runs"),
    Column("of these complete", "recoverable.complete"),
    Column("falls", "danger.falls"),
    Column("false edges", "danger.false_edges"),
    Column("largest overrun, mm", "danger.max_overrun_mm", ".1f"),
    Column("frames below the fans' floor", "weak_frames"),
    Column("points measured", "points.measured"),
    Column("of", "points.total"),
    Column("faults", "injected.planned"),
    Column("that acted", "injected.acted"),
    Column("mission, s", "mission_time_s", ".0f"),
    Column("time / bound", "time_ratio", ".4f"),
    Column("ended by", "ended"),
)


def cells() -> Sequence[Cell]:
    """Without and with faults."""
    return [Cell({"faults": kind}) for kind in (NONE, RANDOM)]


def run_job(job: Job) -> Outcome:
    """One mission."""
    if job.factors["faults"] == NONE:
        about = {"injected": {"planned": 0, "acted": 0}, "is_recoverable": True, "weak_frames": 0}
        return _outcome(job, rehearse(job.cfg), about)
    parts = assemble(job.cfg)
    plan = random_plan(job.seed, FAULTS_PER_MISSION, parts.lower_bound_s)
    rehearsal = FaultyRehearsal(job.cfg, plan)
    result = rehearsal.run()
    about = {
        # A fault that comes after the end, or between two readings of a slow sensor, does nothing.
        "injected": {"planned": len(plan.faults), "acted": sum(record.samples > 0 for record in rehearsal.injected)},
        "is_recoverable": is_recoverable(plan, parts.mirror),
        "weak_frames": rehearsal.weak_frames,
    }
    return _outcome(job, result, about)


def is_recoverable(plan: FaultPlan, mirror: Mirror) -> bool:
    """Whether a mission shall go on by itself: fans that seem to fail on an overhang wait for an operator."""
    return not (mirror.overhang and any(fault.signal == "fans" for fault in plan.faults))


def _outcome(job: Job, rehearsal: Rehearsal, about: dict[str, Any]) -> Outcome:
    summary = rehearsal.summary
    values: dict[str, Any] = {
        "seed": job.seed,
        "outcome": rehearsal.outcome,
        "cause": rehearsal.cause,
        **about,
        **{name: summary[name] for name in ("points", "danger", "mission_time_s", "lower_bound_s", "within_budget")},
        "states_s": rehearsal.states_s,
    }
    return Outcome(values, {})


def combine(factors: Factors, outcomes: Sequence[Outcome]) -> Outcome:
    """Sums over the missions; how those ended that were not completed."""
    values = [outcome.values for outcome in outcomes]
    ended = [f"seed {v['seed']} {v['outcome']}: {v['cause']}" for v in values if v["outcome"] != "complete"]
    recoverable = [v for v in values if v["is_recoverable"]]
    figures: dict[str, Any] = {
        "complete": _complete(values),
        "recoverable": {"runs": len(recoverable), "complete": _complete(recoverable)},
        "ended": ended,
        "danger": dangers([v["danger"] for v in values]),
        "weak_frames": sum(v["weak_frames"] for v in values),
        **{of: {name: sum(v[of][name] for v in values) for name in values[0][of]} for of in ("points", "injected")},
        **times(values),
    }
    arrays = {
        "time_ratio": np.array([v["mission_time_s"] / v["lower_bound_s"] for v in values]),
        "is_complete": np.array([float(v["outcome"] == "complete") for v in values]),
    }
    return Outcome(figures, arrays)


def _complete(values: Sequence[Any]) -> int:
    return sum(v["outcome"] == "complete" for v in values)


STUDY = Study(
    name="faults",
    title="Whole missions without faults, and with faults that pass by",
    cells=cells,
    run_job=run_job,
    combine=combine,
    columns=COLUMNS,
    draw=draw_faults,
    defaults={"run.filter": "ekf", "run.world": "hard"},
    mirrors=("thesis-m1", "thesis-m2", "fyst-m1", "fyst-m2"),
    runs=75,
)
