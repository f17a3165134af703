"""The study `recordings`: estimators on the shipped sets, over the whole run and from later starts.

The estimators are our own ones, and with ``--peers`` those of GTSAM.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from math import hypot, sqrt
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ccatp.beacons.config.load import load_radio_config
from ccatp.beacons.config.models import RecordingConfig, RecordingsConfig
from ccatp.beacons.cricket.measured_map import map_measured
from ccatp.beacons.datasets.doubts import (
    known_place_doubts,
    map_against_survey,
    map_doubts,
    stray_beacons,
    sudden_disagreement,
    survey_doubts,
)
from ccatp.beacons.datasets.mounting import radio_doubts
from ccatp.beacons.datasets.sheets import read_level_places, read_levels, read_ranges
from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.beacons.estimation.batch_smoother import lagged_run, smooth
from ccatp.beacons.estimation.causal import filter_run
from ccatp.beacons.estimation.evaluation import RECKONING, judge, reckoned_track, result_data
from ccatp.beacons.estimation.level_fix import LevelLocator, fingerprint_fits, grid_points, judged
from ccatp.beacons.estimation.path_loss import fit_path_loss
from ccatp.beacons.estimation.predictions import predicted, prediction_doubts
from ccatp.beacons.estimation.recording import EstimatedPath, RecordedRun
from ccatp.beacons.studies.gtsam_peer import PeerGaveUp, Progress, import_gtsam, run_gtsam
from ccatp.beacons.studies.recorded_sets import SHIPPED, found_in, recorded_run, recorded_window, sets_in
from ccatp.errors import CcatpError, ExitStatus
from ccatp.filters.base import FilterError
from ccatp.missions import Part
from ccatp.studies.campaign import CampaignError, Cell, CellResult, Factors, Job, JobOutcome, Study
from ccatp.studies.results import Measure, draw_ranges, rows_by

FILTERS = ("ekf-slam", "fixed-lag", "smoother")
PEERS = ("GTSAM iSAM2", "GTSAM batch")


class EstimateError(CcatpError):
    """Data from which an estimator gets no result."""

    exit_status = ExitStatus.USAGE


ROUNDING_COUNTS = 0.25  # of the configured standard deviation of a range, above which that of its rounding is added


def settings_of(run: RecordedRun, assumed: RecordingsConfig) -> RecordingConfig:
    """The settings of the run's format. If its ranges come in steps, step^2 / 12 is added to their variance."""
    cfg: RecordingConfig = getattr(assumed, run.kind)
    rounding_m = run.range_step_m / sqrt(12.0)
    if rounding_m <= ROUNDING_COUNTS * cfg.radio.range_sigma_m:
        return cfg
    radio = cfg.radio.model_copy(update={"range_sigma_m": hypot(cfg.radio.range_sigma_m, rounding_m)})
    return cfg.model_copy(update={"radio": radio})


def estimate(run: RecordedRun, assumed: RecordingsConfig, filter_name: str) -> EstimatedPath:
    """Estimate a run by one of ``FILTERS``.

    Raises EstimateError: the estimate is not finite, the data do not determine it, or the estimator has no model of
    beacons that move.
    """
    cfg = settings_of(run, assumed)
    if run.moving and filter_name == "smoother":
        raise EstimateError(
            f"{run.name}: the smoother has no model of beacons that move ({', '.join(run.moving)}); use ekf-slam or "
            "fixed-lag"
        )
    try:
        if filter_name == "smoother":
            track = smooth(run, cfg, assumed.filter, perf_counter)
        elif filter_name == "fixed-lag":
            track = lagged_run(run, cfg, assumed.filter, perf_counter, assumed.fixed_lag)
        else:
            track = filter_run(run, cfg, assumed.filter, perf_counter)
    except (FilterError, np.linalg.LinAlgError) as error:
        raise EstimateError(
            f"{run.name}: {filter_name} finds no finite map for these data ({str(error)[:80]}); look at its warnings"
        ) from error
    surveyed = survey_doubts(track, run.beacon_truth_m) if run.truth is None else []
    if run.known_map is not None:
        # Where the estimate follows its readings, the wrong place has bent it, and with it what fits the others.
        surveyed += map_doubts(track, run.known_map) or known_place_doubts(run, track, cfg.radio.camera_field_rad)
        surveyed += map_against_survey(run.known_map, run.beacon_truth_m)
    surveyed += radio_doubts(run, track)
    own_m, used_m = getattr(assumed, run.kind).radio.range_sigma_m, cfg.radio.range_sigma_m
    if used_m > own_m:
        surveyed.append(
            f"ranges come in steps of {run.range_step_m:.3g} m: their noise is taken as {used_m:.2g} m, not "
            f"{run.kind}.radio.range_sigma_m = {own_m:g}"
        )
    doubts = prediction_doubts(predicted(run, track, cfg.radio.camera_field_rad))
    return track._replace(
        warnings=(*track.warnings, *stray_beacons(run, track), *sudden_disagreement(track), *surveyed, *doubts)
    )


COMPARED = (
    "dataset", "filter", "trajectory_rmse_m", "heading_rmse_rad", "beacon_rmse_m", "range_scale", "nis_mean",
    "nees_mean", "update_us_p50", "run_s", "gave_up",
)  # fmt: skip


def compared(
    run: RecordedRun, assumed: RecordingsConfig, warn: Callable[[list[str]], None], progress: Progress
) -> list[dict[str, Any]]:
    """A row of ``COMPARED`` for dead reckoning, each of our estimators, and GTSAM's.

    If GTSAM fails, its remaining rows have no values, and there is a warning. Raises PeerError: GTSAM is not installed.
    """
    import_gtsam()  # fails before the computation
    tracks: list[tuple[str, EstimatedPath | None, float | None]] = [(RECKONING, reckoned_track(run), None)]
    for name in FILTERS[:-1] if run.moving else FILTERS:  # the smoother has no model of beacons that move
        begin_s = perf_counter()
        tracks.append((name, estimate(run, assumed, name), perf_counter() - begin_s))
    peers = run_gtsam(run, settings_of(run, assumed), perf_counter, assumed.run.peer_limit_s, progress)
    names = list(PEERS)
    try:
        while names:
            found = next(peers)
            # The batch starts from the result of iSAM2, so its time is not that of a run.
            run_s = float(found.update_s.sum()) if names[0] == PEERS[0] else None
            tracks.append((names.pop(0), found, run_s))
    except PeerGaveUp as error:
        warn([str(error)])
        tracks += [(name, None, None) for name in names]
    rows = []
    for name, track, run_s in tracks:
        data = {} if track is None else result_data(run, name, track, judge(track, run))
        if name not in FILTERS:
            data["nees_mean"] = None  # covariances of the peers are not computed
        known = {"dataset": run.name, "filter": name, "run_s": run_s, "gave_up": track is None}
        rows.append({key: data.get(key) for key in COMPARED} | known)
    return rows


ANCHORS = "UWB anchors 8/14"
ANCHOR_METHODS = {"batch": False, "batch, offset": True}
LEVELS = "XBee scenario 1"
LEVEL_METHODS = ("fingerprints", "fingerprints, each by the others", "path-loss sheet")
XBEE_M = {"A": (0.0, 0.0), "B": (0.0, 4.0), "C": (4.0, 0.0)}  # corners of a square of 4 m: fits text and levels
XBEE_ROOM = grid_points((-1.0, -1.0), (5.0, 5.0), 0.1)


# -- recordings -------------------------------------------------------------------------------------------------------

START_SHARE, MOST_SHARE = 0.1, 0.8  # of the run: delay of the start per seed, largest delay; seed 0 has the whole run
_ERRORS = {"path_m": "trajectory_rmse_m", "heading_rad": "heading_rmse_rad", "beacons_m": "beacon_rmse_m"}
_DELAYED = {"delayed_path_m": "trajectory_rmse_m", "delayed_nees": "nees_mean"}
_SHOWN = {"range_scale": "range_scale", "nis": "nis_mean", "nees": "nees_mean", "update_us": "update_us_p50"}


def run_recordings(job: Job) -> JobOutcome:
    """One estimator on one set, the whole run or from a later start: means over its robots."""
    cfg, name, estimator = job.cfg, str(job.factors["data"]), str(job.factors["estimator"])
    share = START_SHARE * job.seed
    if share > MOST_SHARE:
        raise CampaignError(f"a recording is started at most {MOST_SHARE:.0%} later; give a smaller --seed or --runs")
    if name == ANCHORS:
        return _mapped_anchors(cfg, share, with_offset=ANCHOR_METHODS[estimator])
    if name == LEVELS:
        return _fixed_levels(Path(cfg.run.data) / "xbee_rssi/Scenario1", share, estimator)
    try:
        rows = [_on_robot(job, robot, share) for robot in sets_in(cfg.run.data)[name].robots]
    except (PeerGaveUp, EstimateError, RadioDataError) as error:  # a mean over the others could not be compared
        return JobOutcome({"gave_up": True, "why": str(error)})
    values = {key: [one[key] for one in rows] for key in rows[0]}
    if estimator not in FILTERS:
        values["nees"] = [None]  # covariances of the peers are not computed
    return JobOutcome({"robots": values, **{key: _mean(each) for key, each in values.items()}})


def _on_robot(job: Job, robot: int | None, share: float) -> dict[str, float | None]:
    """The errors of one robot of a set. Raises PeerGaveUp, EstimateError, RadioDataError: there is no estimate."""
    cfg, name, estimator = job.cfg, str(job.factors["data"]), str(job.factors["estimator"])
    run = recorded_run(cfg.run.data, name, robot)
    if share > 0.0:
        span_s = float(run.steps.times_s[-1] - run.steps.times_s[0])
        run = recorded_window(cfg.run.data, name, robot, share * span_s, span_s)
    begin_s = perf_counter()
    if estimator in FILTERS:
        track = estimate(run, cfg, estimator)
    else:
        tracks = run_gtsam(run, settings_of(run, cfg), perf_counter, cfg.run.peer_limit_s)
        track = peer_track(tracks, estimator)
    run_s = perf_counter() - begin_s
    data = result_data(run, estimator, track, judge(track, run))
    late = data["delayed"] or dict.fromkeys(_DELAYED.values())
    row: dict[str, float | None] = {key: data[value] for key, value in (_ERRORS | _SHOWN).items()}
    return row | {key: late[value] for key, value in _DELAYED.items()} | {"run_s": run_s}


def peer_track(tracks: Iterator[EstimatedPath], name: str) -> EstimatedPath:
    """That of the estimates of ``run_gtsam`` with a name of ``PEERS``; the batch is not computed without need."""
    return next(islice(tracks, PEERS.index(name), None))


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _mapped_anchors(cfg: RecordingsConfig, share: float, *, with_offset: bool) -> JobOutcome:
    """Map of surveyed anchors from the standstills of a trolley, without those before the start."""
    file = Path(cfg.run.data) / "uwb_planar/session_8_14.csv"
    cricket = load_radio_config(
        None, {"system": "cricket", "cricket.batch.estimates_offset": with_offset}, simulates=False
    ).cricket
    ranges, begin_s = read_ranges(file, cricket.ranging.sigma_m), perf_counter()
    poses = list(ranges.groups)[round(share * len(ranges.groups)) :]
    motes = {mote for pose in poses for mote in ranges.groups[pose]}
    kept = ranges._replace(
        readings=tuple(one for one in ranges.readings if motes & {one.first, one.second}),
        groups={pose: ranges.groups[pose] for pose in poses},
    )
    rows = re.findall(r"Anchor (\d) *\| *(\S+) *\| *(\S+) *\|", file.with_name("README.md").read_text(encoding="utf-8"))
    truth_m = {f"anchor{number}": (float(x_m), float(y_m)) for number, x_m, y_m in rows}
    found = map_measured(cricket, "batch", kept, None, truth_m)
    return JobOutcome({"beacons_m": found.data["rms_m"]["p50"], "run_s": perf_counter() - begin_s})


def _fixed_levels(folder: Path, share: float, method: str) -> JobOutcome:
    """Positions from one level of each radio, without those before the start.

    The names B and C are exchanged in the file of test points.
    """
    begin_s, is_by_others = perf_counter(), method == LEVEL_METHODS[1]
    known = read_level_places(folder / "Database_Scenario1.xlsx")[1]
    tests = [place.renamed({"B": "C", "C": "B"}) for place in read_level_places(folder / "Tests_Scenario1.xlsx")[1]]
    places = list(known) if is_by_others else tests
    first = round(share * len(places))
    if method == LEVEL_METHODS[2]:
        fits = dict.fromkeys(XBEE_M, fit_path_loss(read_levels(folder / "Pathloss_Scenario1.xlsx", "Zigbee", None)[1]))
        each = [fits] * len(places)
    else:
        each = [fingerprint_fits(known, XBEE_M, k if is_by_others else None) for k in range(len(places))]
    found = [
        LevelLocator(XBEE_M, one, XBEE_ROOM).fix(p.levels_dbm)
        for one, p in zip(each[first:], places[first:], strict=True)
    ]
    result = judged(found, places[first:], 0.9)
    values = {"path_m": result["mean_error_m"], "covered": result["coverage"], "run_s": perf_counter() - begin_s}
    return JobOutcome(values)


def combine_recordings(_: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Values of the whole run, and median and 10 to 90 % of the errors over the later starts."""
    whole, later = dict(outcomes[0].values), [outcome.values for outcome in outcomes[1:]]
    whole["gave_up"] = sum("gave_up" in outcome.values for outcome in outcomes)
    whole["why"] = list(dict.fromkeys(outcome.values["why"] for outcome in outcomes if "why" in outcome.values))
    for key in _ERRORS:
        known = [one[key] for one in later if one.get(key) is not None]
        ends = np.percentile(known, (10, 50, 90)).tolist() if known else [None] * 3
        whole[f"started_{key}"] = dict(zip(("p10", "p50", "p90"), ends, strict=True))
    return JobOutcome(whole)


def recordings_cells(estimators: Sequence[str] = FILTERS) -> list[Cell]:
    """Sets times estimators, the map of surveyed anchors, and positions from levels (mean error as ``path_m``)."""
    cells = [Cell({"data": name, "estimator": one}) for name in SHIPPED for one in estimators]
    others = {ANCHORS: ANCHOR_METHODS, LEVELS: LEVEL_METHODS}
    return cells + [Cell({"data": name, "estimator": one}) for name, methods in others.items() for one in methods]


def of_folder(study: Study, cfg: RecordingsConfig) -> Study:
    """The study of the sets that the folder holds, with the estimators of the study."""
    sets, left_out = found_in(cfg.run.data)
    study = replace(study, notes=left_out)
    shipped = [cell for cell in study.cells() if cell.factors["data"] in (*sets, ANCHORS, LEVELS)]
    if any(cell.factors["data"] in sets for cell in shipped):
        return replace(study, cells=lambda: shipped)
    estimators = dict.fromkeys(cell.factors["estimator"] for cell in study.cells() if cell.factors["data"] in SHIPPED)
    own = [Cell({"data": name, "estimator": one}) for name in sets for one in estimators]
    return replace(study, cells=lambda: own)


def draw_recordings(cells: Sequence[CellResult], out: Path) -> None:
    """Figure ``recordings``: whole run (mark), later starts (median as a dot, 10 to 90 % as a bar)."""
    measures = [
        Measure(label, (f"started_{key}.p10", f"started_{key}.p90"), f"started_{key}.p50", key)
        for key, label in (("path_m", "error of the path, m"), ("beacons_m", "error of the beacons, m"))
    ]
    title = "Later starts: median (dot), 10 to 90 % (bar); whole run (mark)"
    draw_ranges(rows_by(cells, "data", "estimator"), measures, title, out / "recordings")


RECORDINGS = Study(
    cells=recordings_cells,
    with_peers=lambda: recordings_cells((*FILTERS, *PEERS)),
    run_job=run_recordings,
    combine=combine_recordings,
    columns="""
        path_m heading_rad beacons_m range_scale nis nees delayed_path_m delayed_nees covered gave_up update_us run_s
        started_path_m: p10 p50 p90
        started_beacons_m: p10 p50 p90
        why
    """,
    draw=draw_recordings,
    mirrors=(),
    of_config=of_folder,
    runs=6,
    loader=Part("ccatp.beacons.config.load:load_recordings_config"),
)
