"""The summary of a run: joins estimates with the simulated truth and builds ``summary.json``.

Numbers are rounded to fixed decimals, and the result does not depend on how the rows were cut into batches: the same
run gives the same file. On a real robot arrivals are measured by the laser, and values that need the truth are null.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from math import dist, nan, sqrt
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ccatp.config.models import Config
from ccatp.core import DeckPose, EventCode, FloatArray, IntArray, PanelId, PointId, Vector3
from ccatp.mirror.mirror import Mirror

PanelFits = Mapping[PanelId, tuple[float, float, float]]  # piston (m), tip (rad), tilt (rad)

WITHIN_M = 0.010  # the thesis's requirement, part of the names of two fields
EDGE_FRAMES = 3  # a verdict may stand on samples this many frames before or after the truth's
HISTORY_ROWS = 60_000  # truth kept for arrivals and verdicts that come late: ten minutes at 100 Hz
EXACT_ROWS = 360_000  # distances whose percentiles are exact: an hour at 100 Hz, twelve bytes each
TICKS = 50_000  # of the main loop

# Columns that truth and track share, and those of the truth alone.
_SEQ, _PSI, _SURFACE = 0, 4, slice(5, 8)
_CLEARANCE, _FALLEN = 8, 9
_IN_MM = ("mean", "p50", "p99", "max")


def arrival_error_m(
    mirror: Mirror, point: PointId, place_m: Sequence[float] | FloatArray, puck_height_m: float
) -> float:
    """Distance of the puck from its target at a point, in the tangent plane of the point's panel, m.

    ``place_m`` is the surface point under the robot, deck frame. Target: the measurement point plus ``puck_height_m``
    along the normal there.
    """
    target_m = mirror.deck_from_robot(DeckPose(*mirror.point_on_deck(point), 0.0), (0.0, 0.0, puck_height_m))
    normal = np.array(mirror.surface.normal(float(place_m[0]), float(place_m[1])))
    across = np.array(mirror.panels[point.panel].axes[2])
    offset = place_m + puck_height_m * normal - target_m
    return float(np.linalg.norm(offset - (offset @ across) * across))


def measured_error_m(mirror: Mirror, point: PointId, puck_m: Vector3, puck_height_m: float) -> float:
    """Distance on the surface from the foot of a measured puck (world frame) to its measurement point, m."""
    x, y, _ = mirror.foot_of_puck(puck_m, puck_height_m)
    return dist(mirror.surface_point(x, y), mirror.surface_point(*mirror.point_on_deck(point)))


class RunningStatistics:
    """Figures of values >= 0 that come all day, in bounded memory: twelve bytes for each of ``capacity`` values.

    Mean and maximum are of all values. So are percentiles up to ``capacity`` values, and then of those whose key is a
    multiple of two, four, ...: a sample that does not depend on how the values were cut into batches.
    """

    def __init__(self, capacity: int) -> None:
        # Written at once: memory does not grow while the day goes on.
        self._keys, self._values = np.full(capacity, 0, dtype=np.uint32), np.full(capacity, 0.0)
        self._size, self._stride = 0, 1
        self.count = 0
        self._sum = self._max = 0.0

    @property
    def sample(self) -> FloatArray:
        """The values that percentiles are taken of."""
        return self._values[: self._size]

    def add(self, keys: IntArray, values: FloatArray) -> None:
        """Add values, shape (n,), each with its own number >= 0, like that of its frame."""
        if len(values):
            self.count += len(values)
            self._sum += float(values.sum())
            self._max = float(np.maximum(self._max, values.max()))  # NaN stays
            self._keep(keys, values)

    def include(self, other: "RunningStatistics") -> None:
        """Add the values of another session."""
        self.count += other.count
        self._sum += other._sum
        self._max = float(np.maximum(self._max, other._max))
        self._thin_out(max(self._stride, other._stride))
        self._keep(other._keys[: other._size], other.sample)

    def _keep(self, keys: NDArray[Any], values: FloatArray) -> None:
        while self._size + np.count_nonzero(kept := keys % self._stride == 0) > len(self._values):
            self._thin_out(2 * self._stride)
        self._put(self._size, keys[kept], values[kept])

    def _thin_out(self, stride: int) -> None:
        self._stride = stride
        left = self._keys[: self._size] % stride == 0
        self._put(0, self._keys[: self._size][left], self.sample[left])

    def _put(self, start: int, keys: NDArray[Any], values: FloatArray) -> None:
        self._size = start + len(keys)
        self._keys[start : self._size], self._values[start : self._size] = keys, values

    def figures(self, names: Sequence[str], *, scale: float, decimals: int) -> dict[str, Any]:
        """As ``distribution``, without rmse."""
        found = distribution(self.sample, names, scale=scale, decimals=decimals)
        if self.count:
            mean, most = self._sum / self.count, self._max
            found |= {"mean": rounded(mean * scale, decimals), "max": rounded(most * scale, decimals)}
        return {name: found[name] for name in names}


class SummaryBuilder:
    """Collects a session of a survey and builds the summary.

    Rows may come in batches of any size, and truth and track in any order against each other; of joined rows only
    statistics of the errors are kept.
    """

    def __init__(self, cfg: Config, mirror: Mirror, *, is_sim: bool) -> None:
        self._cfg, self._mirror, self._is_sim = cfg, mirror, is_sim
        self._points, self._lower_bound_s = 0, 0.0
        self._measured = self._skipped = self._unreliable = 0
        self._left_out: Mapping[str, Sequence[str]] = {}
        self._mission_time_s, self._is_complete = 0.0, False
        self._ticks_us = RunningStatistics(TICKS)
        self._open_truth, self._open_track = np.empty((0, 8)), np.empty((0, 8))
        self._distances, self._within = RunningStatistics(EXACT_ROWS), 0
        self._squared_turns = 0.0
        self._history: deque[FloatArray] = deque()
        self._history_rows = 0
        self._newest_seq = -1
        self._waiting_arrivals: dict[PointId, int] = {}
        self._arrivals: dict[PointId, float] = {}
        self._waiting_edges: list[int] = []
        self._true_edges = self._false_edges = self._falls = 0
        self._is_fallen = False
        self._overrun_m = 0.0
        self._friction = self._grip = self._least_grip = nan
        self._fits: PanelFits = {}
        self._injected: PanelFits | None = None

    def add_truth(self, rows: Sequence[Sequence[float]] | FloatArray) -> None:
        """Add true states, in the order of their frames.

        Columns: seq, t_s, x, y, heading (deck), X, Y, Z (surface point, deck, m), clearance of the worst edge sensor to
        the rim (m, < 0 beyond it), fallen, mask of the sensors beyond the rim; shape (n, 11).
        """
        if not len(rows):
            return
        truth = np.asarray(rows, dtype=np.float64)
        self._newest_seq = max(self._newest_seq, int(truth[-1, _SEQ]))
        fallen = np.concatenate(([self._is_fallen], truth[:, _FALLEN] > 0))
        self._falls += int(np.count_nonzero(fallen[1:] & ~fallen[:-1]))
        self._is_fallen = bool(fallen[-1])
        self._overrun_m = max(self._overrun_m, -float(truth[:, _CLEARANCE].min()))
        self._history.append(truth[:, : _CLEARANCE + 1].copy())
        self._history_rows += len(truth)
        while self._history_rows - len(self._history[0]) >= HISTORY_ROWS:
            self._history_rows -= len(self._history.popleft())
        self._open_truth = np.concatenate((self._open_truth, truth[:, :8]))[-HISTORY_ROWS:]
        self._join()
        self._settle(is_over=False)

    def add_track(self, rows: Sequence[Sequence[float]] | FloatArray) -> None:
        """Add estimates of the same frames: the first eight columns of ``add_truth``."""
        if len(rows) and self._is_sim:
            track = np.asarray(rows, dtype=np.float64)[:, :8]
            self._open_track = np.concatenate((self._open_track, track))[-HISTORY_ROWS:]
            self._join()

    def add_arrival(self, point: PointId, seq: int) -> None:
        """The robot stood at a point at frame ``seq``, before any correction; only the first arrival counts."""
        if point not in self._arrivals:
            self._waiting_arrivals.setdefault(point, seq)
            self._settle(is_over=False)

    def add_fix(self, point: PointId, puck_m: Vector3) -> None:
        """The laser measured the puck at a point, world frame; on a real robot the first fix is the arrival."""
        if not self._is_sim and point not in self._arrivals:
            height_m = self._cfg.robot.puck_height_m
            self._arrivals[point] = measured_error_m(self._mirror, point, puck_m, height_m)

    def add_verdict_event(self, seq: int, code: int) -> None:
        """The verdict's code rose to ``code`` at frame ``seq``; call once for each rise."""
        if code == EventCode.NEAR_EDGE:
            self._waiting_edges.append(seq)
            self._settle(is_over=False)

    def add_ticks(self, tick_us: ArrayLike) -> None:
        """Add wall times of main-loop ticks, microseconds."""
        ticks_us = np.array(tick_us, dtype=np.float64, ndmin=1)
        self._ticks_us.add(self._ticks_us.count + np.arange(len(ticks_us)), ticks_us)

    def set_plan(self, total_points: int, lower_bound_s: float) -> None:
        """All points of the mission, measured or not, and the rest-to-rest time of its path with the measuring."""
        self._points, self._lower_bound_s = total_points, lower_bound_s

    def set_counts(self, measured: int, skipped: int) -> None:
        """Points measured and skipped."""
        self._measured, self._skipped = measured, skipped

    def set_mission(
        self,
        measured: int,
        skipped: int,
        mission_time_s: float,
        left_out: Mapping[str, Sequence[str]] = MappingProxyType({}),
        *,
        is_complete: bool = False,
    ) -> None:
        """Points measured and skipped, the robot's time from start to end, and points left out, by the reason.

        ``is_complete``: the mission came to its end; only then the budget can have been kept.
        """
        self.set_counts(measured, skipped)
        self._mission_time_s, self._left_out, self._is_complete = mission_time_s, left_out, is_complete

    def add_grip(self, friction: float, margin: float) -> None:
        """Friction and margin of thrust as measured last; 0: not measured."""
        if margin:
            self._friction, self._grip = friction, margin
            self._least_grip = np.fmin(self._least_grip, margin)

    def set_unreliable(self, count: int) -> None:
        """Measured points whose lengths contradict each other."""
        self._unreliable = count

    def set_panels(self, fits: PanelFits, injected: PanelFits | None) -> None:
        """Misalignment of panels as fitted, and as simulated (None on a real robot)."""
        self._fits, self._injected = fits, injected

    def precede(self, earlier: "SummaryBuilder") -> None:
        """Include a session of the same mission that ended before this one began.

        Points, measured and left out, are those of the later session; the bound is that of the whole path, which the
        earlier one began.
        """
        earlier._settle(is_over=True)
        self._lower_bound_s = earlier._lower_bound_s or self._lower_bound_s
        self._mission_time_s += earlier._mission_time_s
        self._arrivals = earlier._arrivals | self._arrivals | earlier._arrivals  # the first arrival counts
        self._distances.include(earlier._distances)
        self._squared_turns += earlier._squared_turns
        self._within += earlier._within
        self._true_edges += earlier._true_edges
        self._false_edges += earlier._false_edges
        self._falls += earlier._falls
        self._overrun_m = max(self._overrun_m, earlier._overrun_m)
        self._least_grip = np.fmin(self._least_grip, earlier._least_grip)

    def build(self, wall_s: float | None = None) -> dict[str, Any]:
        """The summary, keys in the order of the command line contract; ``wall_s`` is the wall time of the run."""
        self._settle(is_over=True)
        cfg, is_sim = self._cfg, self._is_sim
        arrivals = np.array(list(self._arrivals.values()))
        # Of measured points whose arrivals are all lost with the truth, nothing is known.
        within = int(np.count_nonzero(arrivals <= WITHIN_M)) if len(arrivals) or not self._measured else None
        # Without a point that was measured the robot stood at its known start: no figure of its localization.
        distances = self._distances if self._measured else RunningStatistics(1)
        count = distances.count
        rms_rad = sqrt(self._squared_turns / count) if count else nan
        return {
            "mirror": cfg.mirror.name,
            "world": cfg.world.name if is_sim else None,
            "filter": cfg.run.filter,
            "seed": cfg.run.seed,
            "reference": "truth" if is_sim else "laser",
            "points": {
                "total": self._points,
                "measured": self._measured,
                "first_arrival_within_10mm": within,
                "skipped": self._skipped,
                **({"unreliable": self._unreliable} if self._unreliable else {}),
                **({"left_out": {why: list(names) for why, names in self._left_out.items()}} if self._left_out else {}),
            },
            "arrival_error_mm": distribution(arrivals, _IN_MM, scale=1e3, decimals=3),
            "localization_error_mm": {
                **distances.figures(_IN_MM, scale=1e3, decimals=3),
                "within_10mm_fraction": rounded(self._within / count) if count else None,
            },
            "heading_error_mrad": {"rms": rounded(1e3 * rms_rad, 3)},
            "mission_time_s": rounded(self._mission_time_s, 3),
            "lower_bound_s": rounded(self._lower_bound_s, 3),
            "within_budget": self._within_budget(),
            "danger": {
                "true_edges": self._true_edges if is_sim else None,
                "false_edges": self._false_edges if is_sim else None,
                "falls": self._falls if is_sim else None,
                "max_overrun_mm": rounded(self._overrun_m * 1e3, 3) if is_sim else None,
            },
            "grip": {
                "friction": rounded(self._friction, 3),
                "margin": rounded(self._grip, 3),
                "least_margin": rounded(self._least_grip, 3),
            },
            "panels": self._panels(),
            "wall": wall_figures(self._mission_time_s, wall_s, self._ticks_us.sample),
        }

    def _within_budget(self) -> bool | None:
        if self._mission_time_s > self._cfg.run.budget_s:
            return False
        return True if self._measured and self._is_complete else None

    def _panels(self) -> dict[str, Any]:
        known = self._injected or {}
        differences = [np.subtract(fit, known[panel]) for panel, fit in sorted(self._fits.items()) if panel in known]
        table = np.array(differences, dtype=np.float64).reshape(-1, 3)
        return {
            "count": len(self._fits),
            "piston_rms_um": _rms(table[:, 0], 1e6),
            "tilt_rms_urad": _rms(table[:, 1:].ravel(), 1e6),
        }

    def _join(self) -> None:
        truth, track = self._open_truth, self._open_track
        seqs, i, j = np.intersect1d(truth[:, _SEQ], track[:, _SEQ], return_indices=True)
        if not len(seqs):
            return
        distance = np.linalg.norm(track[j, _SURFACE] - truth[i, _SURFACE], axis=1)
        turn = track[j, _PSI] - truth[i, _PSI]
        self._distances.add(seqs.astype(np.int64), distance)
        self._within += int(np.count_nonzero(distance <= WITHIN_M))
        self._squared_turns += float((np.arctan2(np.sin(turn), np.cos(turn)) ** 2).sum())
        self._open_truth, self._open_track = np.delete(truth, i, axis=0), np.delete(track, j, axis=0)

    def _settle(self, *, is_over: bool) -> None:
        for point, seq in list(self._waiting_arrivals.items()):
            if seq <= self._newest_seq and len(found := self._truth(seq, seq)):
                height_m = self._cfg.robot.puck_height_m
                self._arrivals[point] = arrival_error_m(self._mirror, point, found[0][_SURFACE], height_m)
                del self._waiting_arrivals[point]
        for seq in list(self._waiting_edges):
            first, last = seq - EDGE_FRAMES, seq + EDGE_FRAMES
            if (is_over or last <= self._newest_seq) and len(found := self._truth(first, last)):
                is_true = bool((found[:, _CLEARANCE] < 0.0).any())
                self._true_edges += is_true
                self._false_edges += not is_true
                self._waiting_edges.remove(seq)

    def _truth(self, first: int, last: int) -> FloatArray:
        # Newest first: what is asked for happened just now.
        found = []
        for batch in reversed(self._history):
            if batch[-1, _SEQ] < first:
                break
            if batch[0, _SEQ] <= last:
                found.append(batch[(batch[:, _SEQ] >= first) & (batch[:, _SEQ] <= last)])
        return np.concatenate(found) if found else np.empty((0, _CLEARANCE + 1))


_SHOWN_AS = {"left_out": "not measured"}  # a key whose name is no word for people


def format_table(summary: Mapping[str, Any], ended: str = "") -> str:
    """The summary as a short table for a terminal: how it ended, then one line a section, a dash for null."""
    summary = {name: value for name, value in summary.items() if name != "ended"}
    single = [
        f"{_SHOWN_AS.get(key, key)} {_text(value)}" for key, value in summary.items() if not isinstance(value, Mapping)
    ]
    sections = [(name, section) for name, section in summary.items() if isinstance(section, Mapping)]
    lines = [("ended", [ended])] if ended else []
    lines += [
        ("run", single),
        *((n, [f"{_SHOWN_AS.get(key, key)} {_text(value)}" for key, value in s.items()]) for n, s in sections),
    ]
    width = max(len(name) for name, _ in lines)
    return "\n".join(f"{name.replace('_', ' '):<{width}}  {'  '.join(values)}" for name, values in lines)


def _text(value: Any) -> str:
    if isinstance(value, Mapping):  # points by the reason why they were left out
        return ", ".join(f"{len(names)} ({why})" for why, names in value.items())
    return "-" if value is None else "yes" if value is True else "no" if value is False else f"{value}"


def distribution(
    errors_m: FloatArray, names: Sequence[str], *, scale: float = 1.0, decimals: int = 6
) -> dict[str, Any]:
    """Figures of errors, shape (k,), by name: rmse, mean, p50, p99, p99_9, max; null where there are none."""
    if not len(errors_m):
        return dict.fromkeys(names)
    p50, p99, p99_9 = np.percentile(errors_m, (50.0, 99.0, 99.9))
    figures = {"mean": errors_m.mean(), "p50": p50, "p99": p99, "p99_9": p99_9, "max": errors_m.max()}
    figures["rmse"] = np.sqrt(np.mean(errors_m**2))
    return {name: rounded(figures[name] * scale, decimals) for name in names}


def _rms(values: FloatArray, scale: float) -> float | None:
    return rounded(np.sqrt(np.mean(values**2)) * scale, 3) if len(values) else None


def wall_figures(
    mission_time_s: float, wall_s: float | None, ticks_us: Sequence[float] | FloatArray
) -> dict[str, float | None]:
    """Wall time of a run, and of the main loop's ticks."""
    p50, p99 = np.percentile(ticks_us, (50, 99)) if len(ticks_us) else (None, None)
    return {
        "time_s": rounded(wall_s, 3),
        "realtime_factor": rounded(mission_time_s / wall_s, 2) if wall_s else None,
        "tick_us_p50": rounded(p50, 1),
        "tick_us_p99": rounded(p99, 1),
    }


def rounded(value: Any, decimals: int = 6) -> float | None:
    """The value, None where JSON has no number for it; never a negative zero."""
    return None if value is None or not np.isfinite(value) else round(float(value), decimals) + 0.0
