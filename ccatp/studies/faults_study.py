"""The study `faults`: whole missions without faults and with random temporary faults: falls, completion."""

import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.sim.fault_plan import SENSOR_SIGNALS, FaultPlan, parse_plan
from ccatp.studies.campaign import Cell, CellResult, Factors, Job, JobOutcome, Study
from ccatp.studies.mission_study import dangers, sums, times
from ccatp.studies.results import LIMIT, colour, levels, plot
from ccatp.studies.sil_run import SilRun
from ccatp.survey.composition import assemble

LONGEST_S = 2.0
FIRST_S = 3.0  # earliest begin of a fault: the sensors have sent data before
NONE, RANDOM = "none", "random"
FAULTS_PER_MISSION = 12
_SPREAD = 0.3  # vertical spread of the dots of a row


def random_plan(seed: int, count: int, last_s: float) -> FaultPlan:
    """Random temporary faults of sensors, frames, clock and wheels; the plan depends only on the arguments.

    All begin before robot time ``last_s``; each lasts at most ``LONGEST_S``.
    """
    rng = random.Random(f"plan {seed}")
    texts = []
    for _ in range(count):
        signal, kind, keys = _draw(rng)
        at_s, for_s = rng.uniform(FIRST_S, last_s), rng.uniform(0.05, LONGEST_S)
        texts.append(
            f'[[fault]]\nsignal = "{signal}"\ntype = "{kind}"\nat_s = {at_s:.3f}\nfor_s = {for_s:.3f}\n{keys}\n'
        )
    return parse_plan("".join(texts), f"plan {seed}")


def _draw(rng: random.Random) -> tuple[str, str, str]:
    if rng.random() < 0.25:
        others = [
            ("frames", "drop", f"every = {rng.randint(1, 4)}"),
            ("frames", "reorder", f"every = {rng.randint(2, 5)}"),
            ("frames", "duplicate", "every = 2"),
            ("clock", "jump", f"by_s = {rng.uniform(-0.5, 0.5):.3f}"),
            ("body", "slip", f"factor = {rng.uniform(0.2, 1.0):.3f}"),
            ("right_wheel", "blocked", ""),
            ("left_wheel", "blocked", ""),
            ("faults", "raise", 'names = ["imu", "edge"]'),
        ]
        return rng.choice(others)
    signal = rng.choice(SENSOR_SIGNALS)
    kinds = [
        ("off", ""),
        ("stuck", ""),
        ("garbage", f"beyond = {rng.choice((0.0, 0.3))}"),
        ("wrong", f"factor = {rng.uniform(0.5, 1.5):.3f}"),
        ("slow", f"every = {rng.randint(2, 20)}"),
        ("delayed", f'by_s = {rng.uniform(0.02, 0.5):.3f}\nstamps = "{rng.choice(("old", "fresh"))}"'),
        ("intermittent", f"period_s = {rng.uniform(0.01, 0.3):.3f}\nduty = 0.5"),
        ("saturated", "low = -0.1\nhigh = 0.1" if not signal.startswith("edge") else "high = 0.0"),
        ("non_finite", 'token = "NaN"'),
    ]
    return signal, *rng.choice(kinds)


def run_job(job: Job) -> JobOutcome:
    """Run one mission."""
    cfg, plan, mirror = job.cfg, FaultPlan(), build_mirror(job.cfg.mirror)
    if job.factors["faults"] == RANDOM:
        plan = random_plan(job.seed, FAULTS_PER_MISSION, assemble(cfg).lower_bound_s)
    run = SilRun(cfg, plan)
    found = run.run()
    names = ("points", "danger", "mission_time_s", "lower_bound_s", "within_budget")
    values: dict[str, Any] = {
        "seed": job.seed,
        "outcome": found.outcome,
        "cause": found.cause,
        # A fault after the end, or between two readings of a slow sensor, has no effect.
        "injected": {"planned": len(plan.faults), "acted": sum(one.samples > 0 for one in run.injected)},
        "is_recoverable": is_recoverable(plan, mirror),
        "weak_frames": run.weak_frames,
        **{name: found.summary[name] for name in names},
        "states_s": found.states_s,
    }
    return JobOutcome(values)


def is_recoverable(plan: FaultPlan, mirror: Mirror) -> bool:
    """Whether a mission must continue without an operator: apparent failures of the fans on an overhang need one."""
    return not (mirror.overhang and any(fault.signal == "fans" for fault in plan.faults))


def combine(_: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Sums over the missions, and the causes of those that were not completed."""
    values = [outcome.values for outcome in outcomes]
    is_complete = [v["outcome"] == "complete" for v in values]
    recoverable = [v["outcome"] == "complete" for v in values if v["is_recoverable"]]
    figures: dict[str, Any] = {
        "complete": sum(is_complete),
        "recoverable": {"runs": len(recoverable), "complete": sum(recoverable)},
        "ended": [f"seed {v['seed']} {v['outcome']}: {v['cause']}" for v in values if v["outcome"] != "complete"],
        "danger": dangers(values),
        "weak_frames": sum(v["weak_frames"] for v in values),
        **{of: sums(v[of] for v in values) for of in ("points", "injected")},
        **times(values),
    }
    arrays = {
        "time_ratio": np.array([v["mission_time_s"] / v["lower_bound_s"] for v in values]),
        "is_complete": np.array(is_complete, dtype=np.float64),
    }
    return JobOutcome(figures, arrays)


def draw(cells: Sequence[CellResult], out: Path) -> None:
    """Figure ``faults``, the cost of faults in time: a dot for each completed mission, a cross for each other one."""
    kinds = levels(cells, "faults")
    with plot(out / "faults", 7.0, 1.0 + 0.55 * len(cells)) as (axes,):
        for k, cell in enumerate(cells):
            ratios, is_complete = cell.arrays["time_ratio"], cell.arrays["is_complete"].astype(bool)
            rows = k + _SPREAD * np.linspace(-1.0, 1.0, len(ratios)) if len(ratios) > 1 else np.array([float(k)])
            shade = colour(kinds.index(cell.factors["faults"]))
            axes.plot(ratios[is_complete], rows[is_complete], ".", color=shade, markersize=5)
            axes.plot(ratios[~is_complete], rows[~is_complete], "x", color=LIMIT, markersize=6)
        axes.set_yticks(range(len(cells)), [f"{c.factors['mirror']}, faults: {c.factors['faults']}" for c in cells])
        axes.invert_yaxis()
        axes.set_xlabel("mission time over its bound; a cross: not completed")


STUDY = Study(
    cells=lambda: [Cell({"faults": kind}) for kind in (NONE, RANDOM)],
    run_job=run_job,
    combine=combine,
    columns="""
        complete
        recoverable: runs complete
        danger: falls false_edges max_overrun_mm
        weak_frames
        points: measured total
        injected: planned acted
        mission_time_s time_ratio ended
    """,
    draw=draw,
    defaults={"run.filter": "ekf", "run.world": "hard"},
    mirrors=("thesis-m1", "thesis-m2", "fyst-m1", "fyst-m2"),
    runs=75,
)
