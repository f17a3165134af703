"""The study `traits`: the estimators and dead reckoning on simulated runs with traits of real recordings.

With peers each run is given to GTSAM, too, and the errors are compared in pairs.
"""

from collections.abc import Sequence
from itertools import combinations
from math import exp, log, sqrt
from time import perf_counter
from typing import Any

import numpy as np

from ccatp.beacons.config.models import RecordingsConfig
from ccatp.beacons.estimation.evaluation import RECKONING, judge, reckoned_track, truth_at
from ccatp.beacons.estimation.recording import EstimatedPath, RecordedRun
from ccatp.beacons.studies.gtsam_peer import PeerGaveUp, run_gtsam
from ccatp.beacons.studies.recordings import FILTERS, PEERS, EstimateError, estimate, peer_track
from ccatp.beacons.studies.trait_runs import TRAITS, trait_run
from ccatp.core import FloatArray
from ccatp.filters.metrics import nees, rms
from ccatp.missions import Part
from ccatp.studies.campaign import Cell, Factors, Job, JobOutcome, Study

PLAIN = "plain"
_ISAM2, _BATCH = PEERS
_INSIDE = 5.991  # chi-squared of two degrees of freedom, 95 %
_COMPARED = ("path_m", "unaligned_m", "beacons_m")


def run_trait(job: Job) -> JobOutcome:
    """One estimator on one simulated run: errors, NEES, and the share of positions inside their 95 % ellipse.

    With a peer among the factors also the errors of that on the same run, unless it gave up or took too long.
    """
    traits, estimator = str(job.factors["traits"]), str(job.factors["estimator"])
    run = trait_run([] if traits == PLAIN else traits.split("+"), job.seed)
    begin_s = perf_counter()
    try:
        track = _track(run, job.cfg, estimator)
    except EstimateError:
        return JobOutcome({"gave_up": True})
    values: dict[str, Any] = {"run_s": perf_counter() - begin_s, **_errors(track, run)}
    if (peer := job.factors.get("peer")) is not None:
        try:
            tracks = run_gtsam(run, job.cfg.csv, perf_counter, job.cfg.run.peer_limit_s)
            values["peer"] = _errors(peer_track(tracks, str(peer)), run)
        except PeerGaveUp:
            values["peer_gave_up"] = True
    if estimator in FILTERS:
        found = judge(track, run).nees
        values["nees"] = None if found is None else found.mean
        values["covered"] = _covered(track, run)
    return JobOutcome(values)


def _track(run: RecordedRun, cfg: RecordingsConfig, estimator: str) -> EstimatedPath:
    return estimate(run, cfg, estimator) if estimator in FILTERS else reckoned_track(run)


def _off(track: EstimatedPath, run: RecordedRun) -> FloatArray:
    """Poses minus the true ones, shape (n, 3)."""
    if run.truth is None:
        return np.empty((0, 3))
    return track.poses - truth_at(run.truth, track.times_s)


def _errors(track: EstimatedPath, run: RecordedRun) -> dict[str, float | None]:
    """Errors of the path after one rigid alignment and without any, and of the beacons after that of the path."""
    judged = judge(track, run)
    off_m = np.hypot(*_off(track, run)[:, :2].T)
    return dict(zip(_COMPARED, (judged.trajectory_rmse_m, rms(off_m), judged.beacon_rmse_m), strict=True))


def _covered(track: EstimatedPath, run: RecordedRun) -> float:
    off = _off(track, run)
    known = np.isfinite(off[:, 0])
    return float(np.mean(nees(off[known, :2], track.covariances[known, :2, :2]) < _INSIDE))


def combine_traits(_: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Medians of the errors, means of NEES and coverage, ratios to the peer, and how often either gave up."""
    rows = [outcome.values for outcome in outcomes]
    values: dict[str, Any] = {key: sum(key in row for row in rows) for key in ("gave_up", "peer_gave_up")}
    for key in (*_COMPARED, "nees", "covered", "run_s"):
        known = [row[key] for row in rows if row.get(key) is not None]
        values[key] = float(np.median(known) if key in _COMPARED else np.mean(known)) if known else None
    largest = [row["nees"] for row in rows if row.get("nees") is not None]
    values["nees_most"] = max(largest, default=None)
    values["each_path_m"] = [row.get("path_m") for row in rows]
    values["ratio"] = {key: _ratio(rows, key) for key in _COMPARED}
    return JobOutcome(values)


def _ratio(rows: Sequence[Any], key: str) -> dict[str, Any]:
    """Geometric mean of an error's ratio to that of the peer on the same run, and two standard errors about it."""
    peers = [(row.get(key), row.get("peer", {}).get(key)) for row in rows]
    logs = [log(own / other) for own, other in peers if own is not None and other is not None]
    if len(logs) < 2:
        return {"mean": None, "band": None}
    mean, off = float(np.mean(logs)), 2.0 * float(np.std(logs, ddof=1)) / sqrt(len(logs))
    return {"mean": exp(mean), "band": [exp(mean - off), exp(mean + off)]}


def trait_cells(estimators: Sequence[str] = (RECKONING, *FILTERS)) -> list[Cell]:
    """Each trait alone, none, and all pairs, times the estimators."""
    names = [PLAIN, *TRAITS, *("+".join(pair) for pair in combinations(TRAITS, 2))]
    return [Cell({"traits": name, "estimator": estimator}) for name in names for estimator in estimators]


def _beside_peers() -> list[Cell]:
    """The same cells, each beside GTSAM: iSAM2, or its batch for the smoother."""
    peers = [_BATCH if cell.factors["estimator"] == "smoother" else _ISAM2 for cell in trait_cells()]
    return [Cell({**cell.factors, "peer": peer}) for cell, peer in zip(trait_cells(), peers, strict=True)]


STUDY = Study(
    cells=trait_cells,
    with_peers=_beside_peers,
    run_job=run_trait,
    combine=combine_traits,
    columns="""
        path_m unaligned_m beacons_m nees nees_most covered gave_up peer_gave_up run_s
        ratio.path_m: mean band
        ratio.unaligned_m: mean band
        ratio.beacons_m: mean band
    """,
    draw=lambda _cells, _out: None,
    mirrors=(),
    loader=Part("ccatp.beacons.config.load:load_recordings_config"),
)
