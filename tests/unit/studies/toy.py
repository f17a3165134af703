"""A study whose jobs take no time, in a module that workers can import."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.beacons.filters.ekf_slam import BlockError
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.studies.campaign import Cell, CellResult, Factors, Job, JobOutcome, Study

SPEEDS_M_S = (0.05, 0.1)
FAULTS = "CCATP_TOY_FAULTS"  # key of a job=what it does instead of its work, in the environment


def run_job(job: Job) -> JobOutcome:
    """A number that depends on all of the job."""
    _go_wrong(job)
    value = job.cfg.run.seed * float(job.factors["speed_m_s"])
    return JobOutcome({"value": value, "lost": float("nan")}, {"values": np.array([value])})


def _go_wrong(job: Job) -> None:
    for entry in filter(None, os.environ.get(FAULTS, "").split(";")):
        key, _, what = entry.rpartition(":")
        if key != job.key:
            continue
        if what == "raise":
            raise ArithmeticError("the wheel came off")
        if what == "data":
            raise RadioDataError(Path("a.csv"), "is empty", 3)
        if what == "block":
            raise BlockError("b", "is not in the state")
        if what == "interrupt":
            raise KeyboardInterrupt
        if what == "die":
            os._exit(9)


def combine(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Mean and all values, in their order."""
    values = np.concatenate([outcome.arrays["values"] for outcome in outcomes])
    return JobOutcome({"mean": float(values.mean()), "speed": factors["speed_m_s"]}, {"values": values})


def draw(cells: Sequence[CellResult], out: Path) -> None:
    """How many cells there are."""
    (out / "figure.txt").write_text(str(len(cells)))


def load(keys: Mapping[str, object]) -> Config:
    """A configuration."""
    return load_config(None, keys)


STUDY = Study(
    name="toy",
    title="A toy",
    cells=lambda: [Cell({"speed_m_s": v}, {"limits.v_max_m_s": v}) for v in SPEEDS_M_S],
    run_job=run_job,
    combine=combine,
    columns="mean",
    draw=draw,
    mirrors=(),
    runs=3,
)
