"""The study `damage`: causal estimators on damaged windows of recorded runs, compared with the undamaged windows."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from ccatp.beacons.config.models import RecordingsConfig
from ccatp.beacons.datasets.tables import RadioDataError, Table
from ccatp.beacons.estimation.evaluation import TrackEvaluation, comparable, judge
from ccatp.beacons.estimation.recording import EstimatedPath, RecordedRun, ReferencePath
from ccatp.beacons.studies.recorded_sets import events_of, found_in, read_again, recorded_run, recorded_window, sets_in
from ccatp.beacons.studies.recordings import EstimateError, estimate
from ccatp.core import FloatArray
from ccatp.missions import Part
from ccatp.studies.campaign import Cell, Factors, Job, JobOutcome, Study

WINDOW_S = 240.0
WINDOWS = 3  # of each run, evenly spread; one of a run that is no longer than a window
SILENCE_S = 60.0
ESTIMATORS = ("fixed-lag", "ekf-slam")
STRAIGHT_RAD = 0.35  # largest change of heading on a path that leaves mirror images possible
EPOCH_S, LATE_S = 1e6, 1.5
WRONG_SHARE, DELAYED_SHARE, ZERO_SHARE = 0.1, 0.25, 0.05
DELAY_M = 3.0  # mean excess of a reflected range
MOVED_M, APART_M = 3.0, 1.0
_NEAR, _NEAR_M = 2.0, 0.1  # recovered: error at most this factor times the undamaged one, plus this distance
# No alarms: most recordings have a few readings out of the odometry's time, and errors that last are a kind of noise.
_NO_ALARM = ("before the first or after the last odometry", "of its readings count as one")
_COVERED = 13.8  # chi-squared of two degrees of freedom, 99.9 %

Tables = dict[str, Table]


class DamageImpossibleError(ValueError):
    """A recording has not what a damage needs: two surveyed beacons apart, or readings after it."""


class Damage(NamedTuple):
    """The input of a damage function, which returns a changed copy."""

    tables: Tables
    truth: ReferencePath | None
    run: RecordedRun  # undamaged
    track: EstimatedPath  # of the estimator on it
    middle_s: float
    rng: np.random.Generator

    def where(self, kind: str, change: Callable[[FloatArray], FloatArray]) -> Tables:
        """The tables, with the rows of one kind changed if there are any."""
        if kind not in self.tables:
            return self.tables
        return {**self.tables, kind: _with(self.tables[kind], change)}

    def everything(self, change: Callable[[FloatArray], FloatArray]) -> "Damage":
        """A copy with changed rows in all tables and in the truth."""
        tables = {kind: _with(table, change) for kind, table in self.tables.items()}
        truth = None if self.truth is None else ReferencePath(*change(np.column_stack(self.truth)).T)
        return self._replace(tables={kind: table for kind, table in tables.items() if len(table.values)}, truth=truth)

    def readings(self, change: Callable[[FloatArray], FloatArray]) -> "Damage":
        """A copy with changed rows in all tables of readings."""
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
    """The surveyed beacon with most readings, and the one with next most that is further than APART_M from it."""
    run = damage.run
    counts = np.bincount(run.readings.beacon, minlength=len(run.beacon_ids))
    placed = sorted(
        (k for k, name in enumerate(run.beacon_ids) if name in run.beacon_truth_m), key=lambda k: -counts[k]
    )
    if not placed:
        raise DamageImpossibleError
    first, *others = placed
    at = np.array([run.beacon_truth_m[run.beacon_ids[k]] for k in placed])
    apart_m = np.hypot(*(at - at[0]).T)[1:]
    second = next((k for k, far_m in zip(others, apart_m, strict=True) if far_m > APART_M), None)
    if second is None:
        raise DamageImpossibleError
    return first, second


def straight(damage: Damage) -> Damage:
    """Only the longest almost straight part: ranges do not tell on which side of it a beacon is."""
    headings = damage.track.poses[:, 2]
    spans, first = [], 0
    for last in range(len(headings)):
        while np.ptp(headings[first : last + 1]) > STRAIGHT_RAD:
            first += 1
        spans.append((damage.track.times_s[last] - damage.track.times_s[first], first, last))
    _, first, last = max(spans)
    begin_s, end_s = damage.track.times_s[[first, last]].tolist()
    return damage.everything(lambda rows: rows[(rows[:, 0] >= begin_s) & (rows[:, 0] <= end_s)])


def swapped(damage: Damage) -> Damage:
    """Two beacons exchange their names in the middle of the window."""
    a, b = map(float, _two_beacons(damage))
    damage = damage.readings(lambda rows: _renamed(rows, {a: b, b: a}, damage.middle_s))
    return damage._replace(run=_exchanged(damage.run, int(a), int(b)))


def _exchanged(run: RecordedRun, a: int, b: int) -> RecordedRun:
    first, second = run.beacon_ids[a], run.beacon_ids[b]
    places = dict(run.beacon_truth_m)
    places[first], places[second] = places[second], places[first]
    return replace(run, beacon_truth_m=places)


def misread_survey(damage: Damage) -> Damage:
    """Two beacons are exchanged in the survey."""
    return damage._replace(run=_exchanged(damage.run, *_two_beacons(damage)))


def moved(damage: Damage) -> Damage:
    """A beacon is moved in the middle of the window: later readings are those of the new place."""
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
    """The vehicle drives on for half of SILENCE_S without any recording, and the clocks stop meanwhile.

    Without any reading afterwards this leaves no trace, so it is no damage of the recording.
    """
    begin_s, end_s = damage.middle_s, damage.middle_s + 0.5 * SILENCE_S
    if not any((table.values[:, 0] >= end_s).any() for kind, table in damage.tables.items() if kind != "odom"):
        raise DamageImpossibleError
    return damage.everything(lambda rows: _later(_cut(rows, begin_s, end_s), begin_s, begin_s - end_s))


def wrong_names(damage: Damage) -> Damage:
    """A tenth of the readings have another beacon's name."""
    count, seed = len(damage.run.beacon_ids), int(damage.rng.integers(1 << 30))

    def change(rows: FloatArray) -> FloatArray:
        # The random numbers depend on the time, so range and bearing of one reading get the same wrong name.
        draws = np.array([np.random.default_rng((seed, int(t_s * 1e3) & 0xFFFFFFFF)).random(2) for t_s in rows[:, 0]])
        wrong = draws[:, 0] < WRONG_SHARE
        rows[wrong, 1] = (rows[wrong, 1] + 1.0 + np.floor(draws[wrong, 1] * (count - 1))) % count
        return rows

    return damage.readings(change)


def odometry_gap(damage: Damage) -> Damage:
    """The odometry is missing for a minute."""
    begin_s = damage.middle_s
    return damage._replace(tables=damage.where("odom", lambda rows: _cut(rows, begin_s, begin_s + SILENCE_S)))


def reading_gap(damage: Damage) -> Damage:
    """All readings are missing for a minute."""
    begin_s = damage.middle_s
    return damage.readings(lambda rows: _cut(rows, begin_s, begin_s + SILENCE_S))


def two_epochs(damage: Damage) -> Damage:
    """The recorder's clock jumps by days in the middle of the window."""
    return damage.everything(lambda rows: _later(rows, damage.middle_s, EPOCH_S))


def late_readings(damage: Damage) -> Damage:
    """The clock of the readings jumps by more than a second in the middle of the window."""
    return damage.readings(lambda rows: _later(rows, damage.middle_s, LATE_S))


def reflected(damage: Damage) -> Damage:
    """A quarter of the ranges are too long, with an exponentially distributed excess."""

    def change(rows: FloatArray) -> FloatArray:
        is_late = damage.rng.random(len(rows)) < DELAYED_SHARE
        rows[is_late, 2] += damage.rng.exponential(DELAY_M, int(is_late.sum()))
        return rows

    return damage._replace(tables=damage.where("range", change))


def zeros(damage: Damage) -> Damage:
    """A share of the ranges is 0, as after a timeout."""

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
OUTCOMES = ("recovered", "reported", "uncertain", "wrong", "impossible")


@cache
def cases_of(folder: str) -> list[tuple[str, int | None, int]]:
    """Set, robot and window of each case."""
    runs = [(name, robot) for name, one in sets_in(folder).items() for robot in one.robots]
    return [
        (name, robot, window)
        for name, robot in runs
        for window in range(WINDOWS if span_s(recorded_run(folder, name, robot)) > WINDOW_S else 1)
    ]


def span_s(run: RecordedRun) -> float:
    """How long a run is."""
    return float(run.steps.times_s[-1] - run.steps.times_s[0])


@cache
def _undamaged(
    folder: str, case: int, assumed: RecordingsConfig, estimator: str
) -> tuple[RecordedRun, EstimatedPath, TrackEvaluation]:
    name, robot, window = cases_of(folder)[case]
    begin_s = max(span_s(recorded_run(folder, name, robot)) - WINDOW_S, 0.0) * window / (WINDOWS - 1)
    run = recorded_window(folder, name, robot, begin_s, WINDOW_S)
    track = estimate(replace(run, truth=None), assumed, estimator)
    return run, track, judge(track, run)


def new_warnings(warned: Sequence[str], before: Sequence[str]) -> list[str]:
    """Those that say more than the ones ``before``, apart from numbers and from beacons that are no longer named."""
    said = {part for line in before for part in _parts(line)}
    return [line for line in warned if not said.issuperset(_parts(line))]


def _parts(line: str) -> list[str]:
    """A warning without its numbers, once for each of the beacons at its beginning."""
    if shared := re.match(r"beacons? ((?:[^ ,]+, )*[^ ,]+) (could not be placed|may lie)", line):
        return [f"{name} {shared[2]}" for name in shared[1].split(", ")]
    return [re.sub(r"(?<!beacon )(?<!beacons )\d+(\.\d+)?", "#", line)]


def run_damage(job: Job) -> JobOutcome:
    """Run the estimator on one damaged window; its outcome is one of ``OUTCOMES``."""
    cfg, kind, case = job.cfg, str(job.factors["damage"]), job.seed % len(cases_of(job.cfg.run.data))
    estimator = str(job.factors["estimator"])
    try:
        run, track, before = _undamaged(cfg.run.data, case, cfg, estimator)
    except (RadioDataError, EstimateError) as error:  # nothing to compare with
        name = " ".join(map(str, cases_of(cfg.run.data)[case]))
        return JobOutcome({"case": name, "new": [str(error)], "outcome": "impossible", "unsurveyed": "impossible"})
    tables, truth = events_of(run, 0.0, WINDOW_S)
    middle_s = float(run.steps.times_s[0]) + 0.5 * min(WINDOW_S, span_s(run))
    rng = np.random.default_rng((job.seed, list(DAMAGES).index(kind)))
    values: dict[str, Any] = {
        "case": " ".join(map(str, cases_of(cfg.run.data)[case])),
        "path_m": None,
        "beacons_m": None,
        "new": [],
    }
    values |= {"path_before_m": before.trajectory_rmse_m, "beacons_before_m": before.beacon_rmse_m}
    try:
        damage = DAMAGES[kind](Damage(tables, truth, run, track, middle_s, rng))
    except DamageImpossibleError:
        return JobOutcome(values | {"outcome": "impossible", "unsurveyed": "impossible"})
    try:
        again = read_again(damage.run, damage.tables, damage.truth)
        found = estimate(replace(again, truth=None), cfg, estimator)
    except (RadioDataError, EstimateError) as error:
        return JobOutcome(values | {"outcome": "reported", "unsurveyed": "reported", "new": [str(error)]})
    warned = [line for line in (*again.warnings, *found.warnings) if not any(part in line for part in _NO_ALARM)]
    new = new_warnings(warned, (*run.warnings, *track.warnings))
    after = judge(found, again)
    pairs = ((after.trajectory_rmse_m, before.trajectory_rmse_m), (after.beacon_rmse_m, before.beacon_rmse_m))
    is_near = all(late is None or late <= _NEAR * (early or 0.0) + _NEAR_M for late, early in pairs)
    is_near &= bool(found.beacons) and track.beacons.keys() & set(again.beacon_ids) <= found.beacons.keys()
    silent = "recovered" if is_near else "uncertain" if _covers(found, again, after) else "wrong"
    outcome = "reported" if new and not is_near else silent
    # The outcome without the warnings of the survey, for a user who has surveyed no beacons.
    unsurveyed = silent if all("survey" in line for line in new) else outcome
    errors = {"path_m": after.trajectory_rmse_m, "beacons_m": after.beacon_rmse_m}
    return JobOutcome(values | errors | {"outcome": outcome, "unsurveyed": unsurveyed, "new": new})


def _covers(track: EstimatedPath, run: RecordedRun, judged: TrackEvaluation) -> bool:
    """Whether the covariances allow the errors of the path and of each beacon."""
    known = np.isfinite(judged.errors_m)
    spread_m2 = np.trace(comparable(track, run.truth).covariances[known, :2, :2], axis1=1, axis2=2)
    is_path = not known.any() or float(np.mean(judged.errors_m[known] ** 2)) < 9.0 * float(spread_m2.mean())
    errors_m = judged.beacon_errors_m
    widths_m = {name: np.sqrt(np.linalg.eigvalsh(track.beacons[name].covariance)[-1]) for name in errors_m}
    return is_path and all(errors_m[name] ** 2 < _COVERED * widths_m[name] ** 2 for name in errors_m)


def combine_damage(_: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Number of variants with each outcome, and the cases of the wrong ones."""
    runs = [outcome.values for outcome in outcomes]
    values: dict[str, Any] = {name: sum(run["outcome"] == name for run in runs) for name in OUTCOMES}
    values["wrong_unsurveyed"] = sum(run["unsurveyed"] == "wrong" for run in runs)
    return JobOutcome(values | {"wrong_cases": [run["case"] for run in runs if run["outcome"] == "wrong"]})


STUDY = Study(
    cells=lambda: [Cell({"damage": name, "estimator": one}) for one in ESTIMATORS for name in DAMAGES],
    run_job=run_damage,
    combine=combine_damage,
    columns=f"{' '.join(OUTCOMES)} wrong_unsurveyed wrong_cases",
    draw=lambda _cells, _out: None,
    mirrors=(),
    of_config=lambda study, cfg: replace(
        study, runs=len(cases_of(cfg.run.data)), notes=found_in(cfg.run.data).left_out
    ),
    runs=30,
    loader=Part("ccatp.beacons.config.load:load_recordings_config"),
)
