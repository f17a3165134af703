"""The study `traits`: the estimators, GTSAM's and dead reckoning on simulated runs with traits of real recordings."""

from collections.abc import Sequence
from itertools import combinations
from time import perf_counter
from typing import Any

import numpy as np

from ccatp.beacons.config.models import RecordingsConfig
from ccatp.beacons.estimation.evaluation import RECKONING, judge, reckoned_track, truth_at
from ccatp.beacons.estimation.recording import EstimatedPath, RecordedRun
from ccatp.beacons.studies.gtsam_peer import PeerGaveUp, run_gtsam
from ccatp.beacons.studies.recordings import FILTERS, PEERS, EstimateError, estimate
from ccatp.beacons.studies.trait_runs import TRAITS, trait_run
from ccatp.filters.metrics import nees
from ccatp.missions import Part
from ccatp.studies.campaign import Cell, Factors, Job, JobOutcome, Study

PLAIN = "plain"
_INSIDE = 5.991  # chi-squared of two degrees of freedom, 95 %


def run_trait(job: Job) -> JobOutcome:
    """One estimator on one simulated run: errors, NEES, and the share of positions inside their 95 % ellipse."""
    traits, estimator = str(job.factors["traits"]), str(job.factors["estimator"])
    run = trait_run([] if traits == PLAIN else traits.split("+"), job.seed)
    begin_s = perf_counter()
    try:
        track = _track(run, job.cfg, estimator)
    except (PeerGaveUp, EstimateError):
        return JobOutcome({"gave_up": True})
    values: dict[str, Any] = {"run_s": perf_counter() - begin_s}
    judged = judge(track, run)
    values |= {"path_m": judged.trajectory_rmse_m, "beacons_m": judged.beacon_rmse_m}
    if estimator in FILTERS:
        values["nees"] = None if judged.nees is None else judged.nees.mean
        values["covered"] = _covered(track, run)
    return JobOutcome(values)


def _track(run: RecordedRun, cfg: RecordingsConfig, estimator: str) -> EstimatedPath:
    if estimator in FILTERS:
        return estimate(run, cfg, estimator)
    if estimator in PEERS:
        return run_gtsam(run, cfg.csv, perf_counter)[PEERS.index(estimator)]
    return reckoned_track(run)


def _covered(track: EstimatedPath, run: RecordedRun) -> float | None:
    if run.truth is None:
        return None
    errors = track.poses - truth_at(run.truth, track.times_s)
    known = np.isfinite(errors[:, 0])
    return float(np.mean(nees(errors[known, :2], track.covariances[known, :2, :2]) < _INSIDE))


def combine_traits(_: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Medians of the errors, means of NEES and coverage, and how many estimators gave up."""
    rows = [outcome.values for outcome in outcomes]
    values: dict[str, Any] = {"gave_up": sum("gave_up" in row for row in rows)}
    for key, middle in (
        ("path_m", np.median), ("beacons_m", np.median), ("nees", np.mean), ("covered", np.mean), ("run_s", np.mean),
    ):  # fmt: skip
        known = [row[key] for row in rows if row.get(key) is not None]
        values[key] = float(middle(known)) if known else None
    largest = [row["nees"] for row in rows if row.get("nees") is not None]
    values["nees_most"] = max(largest, default=None)
    values["each_path_m"] = [row.get("path_m") for row in rows]
    return JobOutcome(values)


def trait_cells(estimators: Sequence[str] = (RECKONING, *FILTERS)) -> list[Cell]:
    """Each trait alone, none, and all pairs, times the estimators."""
    names = [PLAIN, *TRAITS, *("+".join(pair) for pair in combinations(TRAITS, 2))]
    return [Cell({"traits": name, "estimator": estimator}) for name in names for estimator in estimators]


STUDY = Study(
    cells=trait_cells,
    with_peers=lambda: trait_cells((RECKONING, *FILTERS, *PEERS)),
    run_job=run_trait,
    combine=combine_traits,
    columns="path_m beacons_m nees nees_most covered gave_up run_s",
    draw=lambda _cells, _out: None,
    mirrors=(),
    loader=Part("ccatp.beacons.config.load:load_recordings_config"),
)
