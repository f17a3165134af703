"""Damaged and odd recordings, made from sound ones: what reader and filter make of them."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ccatp.beacons.config.models import RecordingsConfig
from ccatp.beacons.datasets.assembly import checked_run
from ccatp.beacons.datasets.events import Recording
from ccatp.beacons.datasets.tables import RadioDataError, Table
from ccatp.beacons.datasets.trajectory import pose_of_truth
from ccatp.beacons.estimation.evaluation import judge
from ccatp.beacons.estimation.recording import RecordedRun, ReferencePath
from ccatp.beacons.studies.recordings import EstimateError, estimate
from ccatp.core import FloatArray
from tests.unit.beacons.datasets.sets import BEACONS, World, world

Tables = dict[str, Table]
Change = Callable[[FloatArray], FloatArray]
NEAR, NEAR_M = 2.0, 0.1  # handled: errors at most this factor times those of the sound recording, plus this


class Sound(NamedTuple):
    """A recording without damage, its truth, and a generator of random numbers."""

    tables: Tables
    truth: World
    rng: np.random.Generator

    def rows(self, kind: str, change: Change) -> Tables:
        """The tables, with the rows of one kind changed, in lines of their own."""
        values = change(self.tables[kind].values.copy())
        return {**self.tables, kind: Table(Path("run.csv"), values, np.arange(1, len(values) + 1))}

    def timed(self, change: Change, *kinds: str) -> Tables:
        """The tables, with the rows of some kinds changed, or of all that have a time."""
        found = self
        for kind in kinds or [kind for kind in ("odom", "range", "truth") if kind in self.tables]:
            found = found._replace(tables=found.rows(kind, change))
        return found.tables


def sound(seed: int, *, has_truth: bool) -> Sound:
    """Two minutes among four beacons, with noise of 5 % of each step, 0.002 rad of each turn, 0.05 m of each range."""
    rng = np.random.default_rng(seed)
    w = world(seed=seed + 1, seconds=120.0)
    distance = w.distance_m * (1.0 + 0.05 * rng.standard_normal(w.distance_m.size))
    turn = w.turn_rad + 0.002 * rng.standard_normal(w.turn_rad.size)
    columns = {
        "odom": (w.times_s, np.append(0.0, distance), np.append(0.0, turn), np.zeros(w.times_s.size)),
        "range": (w.read_s, w.read_beacon.astype(float), w.range_m),
        "beacon": (np.arange(4.0), *np.array(list(BEACONS.values())).T, np.full(4, np.nan)),
    }
    if has_truth:
        columns["truth"] = (w.times_s, *w.poses.T)
    lines = np.argsort(np.concatenate([columns["odom"][0], columns["range"][0]]), kind="stable")
    ranks = np.empty(lines.size, dtype=np.int64)
    ranks[lines] = np.arange(1, lines.size + 1)  # events in one file, by time
    count = w.times_s.size
    at = {"odom": ranks[:count], "range": ranks[count:], "truth": ranks[:count], "beacon": np.zeros(4, dtype=np.int64)}
    tables = {kind: Table(Path("run.csv"), np.column_stack(each), at[kind]) for kind, each in columns.items()}
    return Sound(tables, w, rng)


def column(at: int, change: Change, rows: slice | None = None) -> Change:
    """Changes one column of some rows."""

    def changed(values: FloatArray) -> FloatArray:
        part = rows or slice(None)
        values[part, at] = change(values[part, at])
        return values

    return changed


def set_back(s: Sound, by_s: float, from_s: float = 60.0, *kinds: str) -> Tables:
    """Values only: the lines stay, so that parts of one file can be cut together."""
    tables = dict(s.tables)
    for kind in kinds or ("odom", "range", "truth"):
        if kind in tables:
            values = tables[kind].values.copy()
            values[values[:, 0] > from_s, 0] -= by_s
            tables[kind] = tables[kind]._replace(values=values)
    return tables


def cut(begin_s: float, end_s: float) -> Change:
    """Leaves a time out."""
    return lambda rows: rows[(rows[:, 0] < begin_s) | (rows[:, 0] >= end_s)]


def some(s: Sound, share: float, value: float, at: int = 2) -> Change:
    """A share of the values of a column is another one."""

    def change(rows: FloatArray) -> FloatArray:
        rows[s.rng.random(len(rows)) < share, at] = value
        return rows

    return change


def doubled_times(rows: FloatArray) -> FloatArray:
    """Every step in two halves of the same time."""
    halves = rows.copy()
    halves[:, 1:] *= 0.5
    found = np.repeat(halves, 2, axis=0)
    found[1::2, 1] += 1e-9  # else they would be one row twice
    return found


def shifted(rows: FloatArray, by_s: float) -> FloatArray:
    """The same rows at other times."""
    found = rows.copy()
    found[:, 0] += by_s
    return found


def exchanged(rows: FloatArray) -> FloatArray:
    """The first two places are exchanged."""
    found = rows.copy()
    found[:2, 1:] = rows[1::-1, 1:]
    return found


def zero_now_and_then(rows: FloatArray) -> FloatArray:
    """Every 97th pose is zero."""
    rows[::97, 1:] = 0.0
    return rows


def shuffled(s: Sound) -> Change:
    """Rows in a random order."""
    return lambda rows: rows[s.rng.permutation(len(rows))]


def spiked(value: float, at: int, *where: int) -> Change:
    """Some rows have another value."""

    def change(rows: FloatArray) -> FloatArray:
        rows[list(where), at] = value
        return rows

    return change


def of_truth(change: Change) -> Callable[[Sound], Tables]:
    """Changes the truth, if there is one."""
    return lambda s: s.rows("truth", change) if "truth" in s.tables else s.tables


ATTACKS: dict[str, Callable[[Sound], Tables]] = {
    "5 % ranges of 65.535 m": lambda s: s.rows("range", some(s, 0.05, 65.535)),
    "one range of 65.535 m": lambda s: s.rows("range", spiked(65.535, 2, 40)),
    "20 % ranges of 0 m": lambda s: s.rows("range", some(s, 0.2, 0.0)),
    "5 % ranges of -1 m": lambda s: s.rows("range", some(s, 0.05, -1.0)),
    "10 % ranges of 0.3 m": lambda s: s.rows("range", some(s, 0.1, 0.3)),
    "10 % ranges of 12 m": lambda s: s.rows("range", some(s, 0.1, 12.0)),
    "half of the ranges NaN": lambda s: s.rows("range", some(s, 0.5, np.nan)),
    "ranges infinite now and then": lambda s: s.rows("range", some(s, 0.05, np.inf)),
    "a beacon frozen": lambda s: s.rows(
        "range", lambda r: np.where((r[:, 1:2] == 1) & (r[:, :1] > 30) & (r[:, :1] < 90) & (np.arange(3) == 2), 3.3, r)
    ),
    "ranges in mm": lambda s: s.rows("range", column(2, lambda v: 1000.0 * v)),
    "ranges in cm": lambda s: s.rows("range", column(2, lambda v: 100.0 * v)),
    "ranges in feet": lambda s: s.rows("range", column(2, lambda v: v / 0.3048)),
    "ranges in km": lambda s: s.rows("range", column(2, lambda v: v / 1000.0)),
    "odometry in mm": lambda s: s.rows("odom", column(1, lambda v: 1000.0 * v)),
    "odometry in cm": lambda s: s.rows("odom", column(1, lambda v: 100.0 * v)),
    "odometry in feet": lambda s: s.rows("odom", column(1, lambda v: v / 0.3048)),
    "turns in degrees": lambda s: s.rows("odom", column(2, np.degrees)),
    "turns without sign": lambda s: s.rows("odom", column(2, np.abs)),
    "survey in mm": lambda s: s.rows("beacon", lambda r: r * [1, 1000, 1000, 1]),
    "survey in cm": lambda s: s.rows("beacon", lambda r: r * [1, 100, 100, 1]),
    "times in ms": lambda s: s.timed(column(0, lambda v: 1e3 * v)),
    "times in us": lambda s: s.timed(column(0, lambda v: 1e6 * v)),
    "times in ns": lambda s: s.timed(column(0, lambda v: 1e9 * v)),
    "times of ranges in ms": lambda s: s.timed(column(0, lambda v: 1e3 * v), "range"),
    "times of odometry in ms": lambda s: s.timed(column(0, lambda v: 1e3 * v), "odom"),
    "clock set back by 10 s": lambda s: set_back(s, 10.0),
    "clock set back by 1.5 s": lambda s: set_back(s, 1.5),
    "clock set back by 100 s": lambda s: set_back(s, 100.0, 110.0),
    "clock set forward by 5 s": lambda s: set_back(s, -5.0),
    "clock set forward by a day": lambda s: set_back(s, -86400.0),
    "clock of ranges set back by 3 s": lambda s: set_back(s, 3.0, 60.0, "range"),
    "clock of ranges set forward by 3 s": lambda s: set_back(s, -3.0, 60.0, "range"),
    "clock of odometry set back by 3 s": lambda s: set_back(s, 3.0, 60.0, "odom"),
    "clock of ranges 2 s late": lambda s: set_back(s, -2.0, -1.0, "range"),
    "clock of ranges 5 s early": lambda s: set_back(s, 5.0, -1.0, "range"),
    "rows of odometry shuffled": lambda s: s.rows("odom", shuffled(s)),
    "rows of ranges shuffled": lambda s: s.rows("range", shuffled(s)),
    "odometry twice": lambda s: s.rows("odom", lambda r: np.repeat(r, 2, axis=0)),
    "odometry in halves of equal time": lambda s: s.rows("odom", doubled_times),
    "two runs in one file": lambda s: s.timed(lambda r: np.vstack([r, shifted(r, 1e-4)])),
    "odometry NaN at the start": lambda s: s.rows("odom", column(1, lambda v: v * np.nan, slice(1, 30))),
    "odometry NaN at the end": lambda s: s.rows("odom", column(1, lambda v: v * np.nan, slice(-30, None))),
    "odometry NaN in the middle": lambda s: s.rows("odom", column(1, lambda v: v * np.nan, slice(600, 620))),
    "odometry paused at the start": lambda s: s.rows("odom", cut(0.5, 10.0)),
    "odometry paused at the end": lambda s: s.rows("odom", cut(105.0, 119.5)),
    "odometry paused in the middle": lambda s: s.rows("odom", cut(50.0, 60.0)),
    "every tenth row of odometry lost": lambda s: s.rows("odom", lambda r: r[np.arange(len(r)) % 10 != 5]),
    "one step of 100 m": lambda s: s.rows("odom", spiked(100.0, 1, 500)),
    "one step of 3 m": lambda s: s.rows("odom", spiked(3.0, 1, 500)),
    "steps of 65.536 m": lambda s: s.rows("odom", spiked(65.536, 1, 200, 500, 900)),
    "one turn of 2 pi": lambda s: s.rows("odom", spiked(6.2832, 2, 500)),
    "one turn of 3 rad": lambda s: s.rows("odom", spiked(3.0, 2, 500)),
    "first step of 50 m": lambda s: s.rows("odom", spiked(50.0, 1, 1)),
    "first time zero, others of today": lambda s: s.timed(lambda r: np.vstack([r[:1], shifted(r[1:], 1.7e9)])),
    "two beacons exchanged in the survey": lambda s: s.rows("beacon", exchanged),
    "one beacon surveyed 3 m off": lambda s: s.rows("beacon", lambda r: r + np.outer(np.eye(4)[2], [0, 3.0, 0, 0])),
    "truth without heading": of_truth(column(3, lambda v: v * np.nan)),
    "truth of constant heading": of_truth(column(3, lambda v: v * 0.0)),
    "heading of the truth in degrees": of_truth(column(3, np.degrees)),
    "heading of the truth turned": of_truth(column(3, lambda v: v + 1.2)),
    "truth zero now and then": of_truth(zero_now_and_then),
    "truth begins late": of_truth(lambda r: r[100:]),
    "truth in mm": of_truth(lambda r: r * [1, 1000, 1000, 1]),
    "clock of the truth 3 s late": of_truth(column(0, lambda v: v + 3.0)),
    "truth jumps once": of_truth(spiked(40.0, 1, 300)),
    "first truth at zero": of_truth(lambda r: np.vstack([r[:1] * [1, 0, 0, 0], r[1:]])),
}  # fmt: skip


class Judged(NamedTuple):
    """``outcome``: handled, named or silent; errors of the path and of the beacons, m; new warnings."""

    outcome: str
    path_m: float
    beacons_m: float
    said: tuple[str, ...]


def run_of(tables: Tables) -> RecordedRun:
    names = ("6", "7", "8", "9")
    return checked_run(Recording(Path("run.csv"), "run", "csv", tables, names))


def errors_of(run: RecordedRun, w: World, cfg: RecordingsConfig) -> tuple[float, float, tuple[str, ...]]:
    """Errors against the real truth, whatever the recording says of it, without alignment of what a truth gave."""
    truth = ReferencePath(w.times_s, *w.poses.T)
    first = run.first_pose if run.truth is not None else pose_of_truth(truth, run.steps, [])
    track = estimate(replace(run, first_pose=first), cfg, "ekf-slam")
    judged = judge(track, replace(run, truth=truth, beacon_truth_m=BEACONS))
    lost = set(run.beacon_ids) - track.beacons.keys()
    beacons_m = np.inf if judged.beacon_rmse_m is None or lost else judged.beacon_rmse_m
    path_m = np.inf if judged.trajectory_rmse_m is None else judged.trajectory_rmse_m
    if run.truth is not None:  # errors that the user would see
        seen = judge(track, run)
        path_m = max(path_m, np.inf if seen.trajectory_rmse_m is None else seen.trajectory_rmse_m)
        if run.beacon_truth_m:
            beacons_m = max(beacons_m, np.inf if seen.beacon_rmse_m is None else seen.beacon_rmse_m)
    return float(path_m), float(beacons_m), (*run.warnings, *track.warnings)


@cache
def _undamaged(seed: int, has_truth: bool, cfg: RecordingsConfig) -> tuple[float, float, tuple[str, ...]]:
    s = sound(seed, has_truth=has_truth)
    return errors_of(run_of(s.tables), s.truth, cfg)


def attacked(name: str, seed: int, cfg: RecordingsConfig, *, has_truth: bool) -> Judged:
    """One attack on one recording."""
    s = sound(seed, has_truth=has_truth)
    path_m, beacons_m, usual = _undamaged(seed, has_truth, cfg)
    try:
        run = run_of(ATTACKS[name](s))
        late_path_m, late_beacons_m, said = errors_of(run, s.truth, cfg)
    except (RadioDataError, EstimateError) as error:
        return Judged("named", np.inf, np.inf, (str(error),))
    new = tuple(line for line in said if line not in usual)
    is_near = late_path_m <= NEAR * path_m + NEAR_M and late_beacons_m <= NEAR * beacons_m + NEAR_M
    return Judged("handled" if is_near else "named" if new else "silent", late_path_m, late_beacons_m, new)
