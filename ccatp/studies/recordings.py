"""The studies of recorded runs among beacons.

`recordings`: our estimators, and GTSAM's with ``--peers``, on the shipped sets: the whole run, and the run again from
later starts. `damage`: the filter on cut windows of them, damaged in ways that happen, each beside the same undamaged.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from ccatp.beacons.cricket.measured_map import map_measured
from ccatp.beacons.datasets.checks import survey_doubts
from ccatp.beacons.datasets.formats import run_of_events
from ccatp.beacons.datasets.reader import checked_run, read_run
from ccatp.beacons.datasets.sheets import read_ranges
from ccatp.beacons.datasets.tables import RadioDataError, Table
from ccatp.beacons.datasets.trajectory import pose_of_truth
from ccatp.beacons.slam.batch_smoother import smooth
from ccatp.beacons.slam.causal import filter_run
from ccatp.beacons.slam.evaluation import TrackEvaluation, judge, result_data, row, row_without, truth_at
from ccatp.beacons.slam.recording import EstimatedPath, RecordedRun, ReferencePath
from ccatp.config.beacon_models import RecordingsConfig
from ccatp.config.load import load_radio_config
from ccatp.core import FloatArray
from ccatp.errors import CcatpError, ExitStatus
from ccatp.filters.base import FilterError
from ccatp.studies.campaign import CampaignError, Cell, CellResult, Factors, Job, JobOutcome, Study
from ccatp.studies.gtsam_peer import PeerGaveUp, import_gtsam, run_gtsam
from ccatp.studies.results import Measure, draw_ranges, rows_by

FILTERS = ("ekf-slam", "smoother")
PEERS = ("GTSAM iSAM2", "GTSAM batch")


class EstimateError(CcatpError):
    """Data of which an estimator makes nothing."""

    exit_status = ExitStatus.USAGE


def estimate(run: RecordedRun, assumed: RecordingsConfig, filter_name: str) -> EstimatedPath:
    """A run through one of ``FILTERS``.

    Raises EstimateError: the data drove the estimator beyond finite numbers, or leave it without an answer.
    """
    cfg = getattr(assumed, run.kind)
    try:
        find = smooth if filter_name == "smoother" else filter_run
        track = find(run, cfg, assumed.filter, perf_counter)
    except (FilterError, np.linalg.LinAlgError) as error:
        raise EstimateError(
            f"{run.name}: {filter_name} finds no finite map for these data ({str(error)[:80]}); look at its warnings"
        ) from error
    if run.truth is not None:
        return track
    return track._replace(warnings=(*track.warnings, *survey_doubts(track, run.beacon_truth_m)))


def compared(run: RecordedRun, assumed: RecordingsConfig, warn: Callable[[list[str]], None]) -> list[dict[str, Any]]:
    """A row for each of our estimators and GTSAM's; without figures where GTSAM gave up, which is a warning."""
    import_gtsam()  # before the work
    rows = []
    for name in FILTERS:
        begin_s = perf_counter()
        track = estimate(run, assumed, name)
        rows.append(row(run, name, track, perf_counter() - begin_s))
    try:
        found = run_gtsam(run, getattr(assumed, run.kind), perf_counter)
    except PeerGaveUp as error:
        warn([str(error)])
        return [*rows, *(row_without(run.name, name, gave_up=True) for name in PEERS)]
    # The batch starts from what iSAM2 ended with, so its time is not a run's.
    spent_s = float(found.isam2.update_s.sum()), None
    return [
        *rows,
        *(row(run, *one, peer=True) for one in zip(PEERS, found, spent_s, strict=True)),
    ]


# -- the shipped sets -------------------------------------------------------------------------------------------------


class RecordedSet(NamedTuple):
    """Where a set lies in the folder of recordings, and its robots."""

    path: str
    robots: tuple[int | None, ...] = (None,)


SETS = {
    "Plaza2": RecordedSet("plaza/Plaza2_.mat"),
    "MRCLAM 7": RecordedSet("mrclam/set7", (1, 2, 3, 4, 5)),
    "Labyrinth": RecordedSet("uwb_labyrinth/labyrinth_0_600s.txt.gz"),
    "MRCLAM 3": RecordedSet("mrclam/set3", (3, 5)),
}
ANCHORS = "UWB anchors 8/14"
ANCHOR_METHODS = {"batch": False, "batch, offset": True}


@cache
def shipped_run(folder: str, name: str, robot: int | None) -> RecordedRun:
    """One run of a set (raises CampaignError: no folder is given; RadioDataError: the set is not there)."""
    if not folder:
        raise CampaignError("where the recordings are is not known; give --data DIR")
    return read_run(Path(folder) / SETS[name].path, None, robot)


@cache
def shipped_window(folder: str, name: str, robot: int | None, begin_s: float, length_s: float) -> RecordedRun:
    """A part of a run, times in s from its beginning; what is known of its first pose is the truth's, if there is one.

    The truth is not looked at by the checks of the reader.
    """
    run = shipped_run(folder, name, robot)
    tables, truth = events_of(run, begin_s, begin_s + length_s)
    return _read_again(run, tables, truth)


def events_of(run: RecordedRun, begin_s: float, end_s: float) -> tuple[dict[str, Table], ReferencePath | None]:
    """What was recorded in a part of a run, as tables of events of our own CSV, and the truth of that part."""
    start_s = run.steps.times_s[0]

    def table(*columns: FloatArray) -> Table:
        values = np.column_stack(columns)
        inside = (values[:, 0] >= start_s + begin_s) & (values[:, 0] <= start_s + end_s)
        return Table(Path(run.name), values[inside], np.flatnonzero(inside) + 1)

    steps, readings, known = run.steps, run.readings, np.isfinite
    moves = (np.concatenate([[0.0], column]) for column in (steps.distance_m, steps.turn_rad, steps.lateral_m))
    tables = {"odom": table(steps.times_s, *moves)}
    for kind, column in zip(("range", "bearing", "rssi"), readings[2:], strict=True):
        there = known(column)
        if there.any():
            tables[kind] = table(readings.times_s[there], readings.beacon[there].astype(float), column[there])
    truth = None if run.truth is None else ReferencePath(*table(*run.truth).values.T)
    return tables, truth


def _read_again(run: RecordedRun, tables: Mapping[str, Table], truth: ReferencePath | None) -> RecordedRun:
    """Tables of events as the reader would take them, checked without the truth, which is put back behind that."""
    again = checked_run(run_of_events(Path(run.name), dict(tables), run.beacon_ids), Path(run.name))
    pose = pose_of_truth(truth, again.steps, [])
    return replace(again, name=run.name, kind=run.kind, first_pose=pose, truth=truth, beacon_truth_m=run.beacon_truth_m)


# -- recordings -------------------------------------------------------------------------------------------------------

START_SHARE, MOST_SHARE = 0.1, 0.8  # of the run, later for each seed; seed 0 has all of it
_ERRORS = {"path_m": "trajectory_rmse_m", "heading_rad": "heading_rmse_rad", "beacons_m": "beacon_rmse_m"}
_SHOWN = {"range_scale": "range_scale", "nis": "nis_mean", "nees": "nees_mean", "update_us": "update_us_p50"}


def run_recordings(job: Job) -> JobOutcome:
    """One estimator on one set, all of it or from a later start: means over its robots."""
    cfg, name, estimator = job.cfg, str(job.factors["data"]), str(job.factors["estimator"])
    share = START_SHARE * job.seed
    if share > MOST_SHARE:
        raise CampaignError(f"a recording is started at most {MOST_SHARE:.0%} later; give a smaller --seed or --runs")
    if name == ANCHORS:
        return _mapped_anchors(cfg, share, with_offset=ANCHOR_METHODS[estimator])
    rows = []
    for robot in SETS[name].robots:
        run = shipped_run(cfg.run.data, name, robot)
        if share > 0.0:
            span_s = float(run.steps.times_s[-1] - run.steps.times_s[0])
            run = shipped_window(cfg.run.data, name, robot, share * span_s, span_s)
        begin_s = perf_counter()
        if estimator in FILTERS:
            track, run_s = estimate(run, cfg, estimator), None
        else:
            found = run_gtsam(run, getattr(cfg, run.kind), perf_counter)
            track = found[PEERS.index(estimator)]
        run_s = perf_counter() - begin_s
        data = result_data(run, estimator, track, judge(track, run))
        rows.append({key: data[value] for key, value in (_ERRORS | _SHOWN).items()} | {"run_s": run_s})
    values = {key: [one[key] for one in rows] for key in rows[0]}
    if estimator not in FILTERS:
        values["nees"] = [None]  # it is asked for no covariances
    return JobOutcome({"robots": values, **{key: _mean(each) for key, each in values.items()}})


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _mapped_anchors(cfg: RecordingsConfig, share: float, *, with_offset: bool) -> JobOutcome:
    """The map of surveyed anchors from the standstills of a trolley, without those before the start."""
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


def combine_recordings(_: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """The whole run, and median and 10 to 90 % of the errors over the later starts."""
    whole, later = dict(outcomes[0].values), [outcome.values for outcome in outcomes[1:]]
    for key in _ERRORS:
        known = [one[key] for one in later if one.get(key) is not None]
        ends = np.percentile(known, (10, 50, 90)).tolist() if known else [None] * 3
        whole[f"started_{key}"] = dict(zip(("p10", "p50", "p90"), ends, strict=True))
    return JobOutcome(whole)


def recordings_cells(estimators: Sequence[str] = FILTERS) -> list[Cell]:
    """Sets times estimators, and the map of surveyed anchors."""
    cells = [Cell({"data": name, "estimator": one}) for name in SETS for one in estimators]
    return cells + [Cell({"data": ANCHORS, "estimator": one}) for one in ANCHOR_METHODS]


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
        path_m heading_rad beacons_m range_scale nis nees update_us run_s
        started_path_m: p10 p50 p90
        started_beacons_m: p10 p50 p90
    """,
    draw=draw_recordings,
    mirrors=(),
    runs=6,
    loader="load_recordings_config",
)

# -- damage -----------------------------------------------------------------------------------------------------------

WINDOW_S = 240.0
WINDOWS = 3  # of each run, evenly spread
SILENCE_S = 60.0
STRAIGHT_RAD = 0.35  # turning of a way that leaves mirror images possible
EPOCH_S, LATE_S = 1e6, 1.5
WRONG_SHARE, DELAYED_SHARE, ZERO_SHARE = 0.1, 0.25, 0.05
DELAY_M = 3.0  # mean of what a reflected way is longer
MOVED_M, APART_M = 3.0, 1.0
_NEAR, _NEAR_M = 2.0, 0.1  # so many times the undamaged error, and so much more, is recovered
_COVERED = 13.8  # chi-squared of two degrees of freedom, 99.9 %

Tables = dict[str, Table]


class Damage(NamedTuple):
    """What a damage is given: all that it changes is returned anew."""

    tables: Tables
    truth: ReferencePath | None
    run: RecordedRun  # undamaged
    track: EstimatedPath  # of the filter on it
    middle_s: float
    rng: np.random.Generator

    def where(self, kind: str, change: Callable[[FloatArray], FloatArray]) -> Tables:
        """The tables with the rows of a kind changed, if there are any."""
        if kind not in self.tables:
            return self.tables
        return {**self.tables, kind: _with(self.tables[kind], change)}

    def readings(self, change: Callable[[FloatArray], FloatArray]) -> "Damage":
        """With the rows of all readings changed."""
        changed = {kind: _with(table, change) for kind, table in self.tables.items() if kind != "odom"}
        return self._replace(tables={**self.tables, **changed})


def _with(table: Table, change: Callable[[FloatArray], FloatArray]) -> Table:
    values = change(table.values.copy())
    return Table(table.file, values, np.arange(1, len(values) + 1))


def _later(rows: FloatArray, from_s: float, by_s: float) -> FloatArray:
    rows[rows[:, 0] > from_s, 0] += by_s
    return rows


def _cut(rows: FloatArray, begin_s: float, end_s: float) -> FloatArray:
    return rows[(rows[:, 0] < begin_s) | (rows[:, 0] >= end_s)]


def _renamed(rows: FloatArray, names: Mapping[float, float], from_s: float) -> FloatArray:
    late = rows[:, 0] > from_s
    rows[late, 1] = [names.get(beacon, beacon) for beacon in rows[late, 1].tolist()]
    return rows


def _two_beacons(damage: Damage) -> tuple[int, int]:
    """The surveyed one that is read most often, and the next of those that stand well away from it."""
    run = damage.run
    counts = np.bincount(run.readings.beacon, minlength=len(run.beacon_ids))
    placed = sorted(
        (k for k, name in enumerate(run.beacon_ids) if name in run.beacon_truth_m), key=lambda k: -counts[k]
    )
    first, *others = placed
    at = np.array([run.beacon_truth_m[run.beacon_ids[k]] for k in placed])
    apart_m = np.hypot(*(at - at[0]).T)[1:]
    return first, next(k for k, far_m in zip(others, apart_m, strict=True) if far_m > APART_M)


def straight(damage: Damage) -> Damage:
    """The longest part that hardly turns: beacons on either side of it look alike to ranges."""
    headings = damage.track.poses[:, 2]
    spans, first = [], 0
    for last in range(len(headings)):
        while np.ptp(headings[first : last + 1]) > STRAIGHT_RAD:
            first += 1
        spans.append((damage.track.times_s[last] - damage.track.times_s[first], first, last))
    _, first, last = max(spans)
    begin_s, end_s = damage.track.times_s[[first, last]].tolist()
    inside = {
        kind: _with(t, lambda rows: rows[(rows[:, 0] >= begin_s) & (rows[:, 0] <= end_s)])
        for kind, t in damage.tables.items()
    }
    return damage._replace(tables={kind: table for kind, table in inside.items() if len(table.values)})


def swapped(damage: Damage) -> Damage:
    """Two beacons exchange their names half way."""
    a, b = map(float, _two_beacons(damage))
    damage = damage.readings(lambda rows: _renamed(rows, {a: b, b: a}, damage.middle_s))
    return damage._replace(run=_exchanged(damage.run, int(a), int(b)))


def _exchanged(run: RecordedRun, a: int, b: int) -> RecordedRun:
    first, second = run.beacon_ids[a], run.beacon_ids[b]
    places = dict(run.beacon_truth_m)
    places[first], places[second] = places[second], places[first]
    return replace(run, beacon_truth_m=places)


def misread_survey(damage: Damage) -> Damage:
    """The survey has two beacons exchanged."""
    return damage._replace(run=_exchanged(damage.run, *_two_beacons(damage)))


def moved(damage: Damage) -> Damage:
    """A beacon stands elsewhere from half way on: its readings are those of the new place."""
    which, _ = _two_beacons(damage)
    name = damage.run.beacon_ids[which]
    old = np.array(damage.run.beacon_truth_m[name])
    angle = damage.rng.uniform(0.0, 2.0 * np.pi)
    new = old + MOVED_M * np.array([np.cos(angle), np.sin(angle)])
    path = damage.track.poses if damage.truth is None else np.column_stack(damage.truth[1:])
    times_s = damage.track.times_s if damage.truth is None else damage.truth.times_s

    def change(rows: FloatArray, of: Callable[[FloatArray], FloatArray]) -> FloatArray:
        is_its = (rows[:, 1] == which) & (rows[:, 0] > damage.middle_s)
        at = np.column_stack([np.interp(rows[is_its, 0], times_s, path[:, k]) for k in range(2)])
        rows[is_its, 2] += of(new - at) - of(old - at)
        return rows

    tables = damage.where("range", partial(change, of=lambda way: np.hypot(*way.T)))
    damage = damage._replace(tables=tables)
    damage = damage._replace(
        tables=damage.where("bearing", partial(change, of=lambda way: np.arctan2(way[:, 1], way[:, 0])))
    )
    return damage._replace(
        run=replace(damage.run, beacon_truth_m={**damage.run.beacon_truth_m, name: (float(new[0]), float(new[1]))})
    )


def kidnapped(damage: Damage) -> Damage:
    """Nothing is recorded while the vehicle drives on, and the clocks stand."""
    begin_s, end_s = damage.middle_s, damage.middle_s + 0.5 * SILENCE_S
    tables = {
        kind: _with(table, lambda rows: _later(_cut(rows, begin_s, end_s), begin_s, begin_s - end_s))
        for kind, table in damage.tables.items()
    }
    truth = damage.truth
    if truth is not None:
        truth = ReferencePath(*_later(_cut(np.column_stack(truth), begin_s, end_s), begin_s, begin_s - end_s).T)
    return damage._replace(tables=tables, truth=truth)


def wrong_names(damage: Damage) -> Damage:
    """A tenth of the readings has another beacon's name."""
    count, seed = len(damage.run.beacon_ids), int(damage.rng.integers(1 << 30))

    def change(rows: FloatArray) -> FloatArray:
        # Range and bearing of one reading are misread together: the draw is of its time.
        draws = np.array([np.random.default_rng((seed, int(t_s * 1e3) & 0xFFFFFFFF)).random(2) for t_s in rows[:, 0]])
        wrong = draws[:, 0] < WRONG_SHARE
        rows[wrong, 1] = (rows[wrong, 1] + 1.0 + np.floor(draws[wrong, 1] * (count - 1))) % count
        return rows

    return damage.readings(change)


def odometry_gap(damage: Damage) -> Damage:
    """The odometry is silent for a minute."""
    begin_s = damage.middle_s
    return damage._replace(tables=damage.where("odom", lambda rows: _cut(rows, begin_s, begin_s + SILENCE_S)))


def reading_gap(damage: Damage) -> Damage:
    """No beacon answers for a minute."""
    begin_s = damage.middle_s
    return damage.readings(lambda rows: _cut(rows, begin_s, begin_s + SILENCE_S))


def two_epochs(damage: Damage) -> Damage:
    """The recorder's clock is set half way, by days."""
    tables = {kind: _with(t, lambda rows: _later(rows, damage.middle_s, EPOCH_S)) for kind, t in damage.tables.items()}
    truth = damage.truth
    if truth is not None:
        truth = ReferencePath(*_later(np.column_stack(truth), damage.middle_s, EPOCH_S).T)
    return damage._replace(tables=tables, truth=truth)


def late_readings(damage: Damage) -> Damage:
    """The clock of the readings is set half way, by more than a second."""
    return damage.readings(lambda rows: _later(rows, damage.middle_s, LATE_S))


def reflected(damage: Damage) -> Damage:
    """A quarter of the ranges is too long, exponentially distributed."""

    def change(rows: FloatArray) -> FloatArray:
        is_late = damage.rng.random(len(rows)) < DELAYED_SHARE
        rows[is_late, 2] += damage.rng.exponential(DELAY_M, int(is_late.sum()))
        return rows

    return damage._replace(tables=damage.where("range", change))


def zeros(damage: Damage) -> Damage:
    """Ranges of 0 where no answer came."""

    def change(rows: FloatArray) -> FloatArray:
        rows[damage.rng.random(len(rows)) < ZERO_SHARE, 2] = 0.0
        return rows

    return damage._replace(tables=damage.where("range", change))


DAMAGES: dict[str, Callable[[Damage], Damage]] = {
    "mirror image: a straight way alone": straight,
    "two beacons exchange names": swapped,
    "two beacons exchanged in the survey": misread_survey,
    "a beacon is moved by 3 m": moved,
    "vehicle kidnapped for 30 s": kidnapped,
    "10 % wrong identifiers": wrong_names,
    "odometry silent for 60 s": odometry_gap,
    "beacons silent for 60 s": reading_gap,
    "two clock epochs": two_epochs,
    "clock of the readings off by 1.5 s": late_readings,
    "25 % of the ranges by reflection": reflected,
    "5 % ranges of 0 m": zeros,
}
CASES = [(name, robot, window) for name, one in SETS.items() for robot in one.robots for window in range(WINDOWS)]
OUTCOMES = ("recovered", "reported", "uncertain", "wrong")


@cache
def _undamaged(folder: str, case: int, assumed: RecordingsConfig) -> tuple[RecordedRun, EstimatedPath, TrackEvaluation]:
    name, robot, window = CASES[case]
    whole = shipped_run(folder, name, robot)
    span_s = float(whole.steps.times_s[-1] - whole.steps.times_s[0])
    begin_s = max(span_s - WINDOW_S, 0.0) * window / (WINDOWS - 1)
    run = shipped_window(folder, name, robot, begin_s, WINDOW_S)
    track = estimate(replace(run, truth=None), assumed, FILTERS[0])
    return run, track, judge(track, run)


def run_damage(job: Job) -> JobOutcome:
    """One damaged window: which of ``OUTCOMES`` it has."""
    cfg, kind, case = job.cfg, str(job.factors["damage"]), job.seed % len(CASES)
    run, track, before = _undamaged(cfg.run.data, case, cfg)
    tables, truth = events_of(run, 0.0, WINDOW_S)
    middle_s = float(run.steps.times_s[0]) + 0.5 * WINDOW_S
    rng = np.random.default_rng((job.seed, list(DAMAGES).index(kind)))
    damage = DAMAGES[kind](Damage(tables, truth, run, track, middle_s, rng))
    values: dict[str, Any] = {"case": " ".join(map(str, CASES[case])), "path_m": None, "beacons_m": None, "new": []}
    values |= {"path_before_m": before.trajectory_rmse_m, "beacons_before_m": before.beacon_rmse_m}
    try:
        again = _read_again(damage.run, damage.tables, damage.truth)
        found = estimate(replace(again, truth=None), cfg, FILTERS[0])
    except (RadioDataError, EstimateError) as error:
        return JobOutcome(values | {"outcome": "reported", "new": [str(error)]})
    said = {_unnumbered(line) for line in (*run.warnings, *track.warnings)}
    new = [line for line in (*again.warnings, *found.warnings) if _unnumbered(line) not in said]
    after = judge(found, again)
    pairs = ((after.trajectory_rmse_m, before.trajectory_rmse_m), (after.beacon_rmse_m, before.beacon_rmse_m))
    is_near = all(late is None or late <= _NEAR * (early or 0.0) + _NEAR_M for late, early in pairs)
    is_near &= bool(found.beacons) and track.beacons.keys() & set(again.beacon_ids) <= found.beacons.keys()
    outcome = (
        "recovered" if is_near else "reported" if new else "uncertain" if _covers(found, again, after) else "wrong"
    )
    errors = {"path_m": after.trajectory_rmse_m, "beacons_m": after.beacon_rmse_m}
    return JobOutcome(values | errors | {"outcome": outcome, "new": new})


def _unnumbered(line: str) -> str:
    return re.sub(r"(?<!beacon )(?<!beacons )\d+(\.\d+)?", "#", line)


def _covers(track: EstimatedPath, run: RecordedRun, judged: TrackEvaluation) -> bool:
    """Whether errors of the path and of each beacon are as large as the covariances allow."""
    truth = np.full((len(track.times_s), 3), np.nan) if run.truth is None else truth_at(run.truth, track.times_s)
    known = np.isfinite(truth[:, 0])
    spread_m2 = np.trace(track.covariances[known, :2, :2], axis1=1, axis2=2)
    is_path = not known.any() or float(np.mean(judged.errors_m[known] ** 2)) < 9.0 * float(spread_m2.mean())
    errors_m = judged.beacon_errors_m
    widths_m = {name: np.sqrt(np.linalg.eigvalsh(track.beacons[name].covariance)[-1]) for name in errors_m}
    return is_path and all(errors_m[name] ** 2 < _COVERED * widths_m[name] ** 2 for name in errors_m)


def combine_damage(_: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """How many variants had each outcome, and which were wrong."""
    runs = [outcome.values for outcome in outcomes]
    values: dict[str, Any] = {name: sum(run["outcome"] == name for run in runs) for name in OUTCOMES}
    return JobOutcome(values | {"wrong_cases": [run["case"] for run in runs if run["outcome"] == "wrong"]})


DAMAGE = Study(
    cells=lambda: [Cell({"damage": name}) for name in DAMAGES],
    run_job=run_damage,
    combine=combine_damage,
    columns=f"{' '.join(OUTCOMES)} wrong_cases",
    draw=lambda _cells, _out: None,
    mirrors=(),
    runs=len(CASES),
    loader="load_recordings_config",
)
