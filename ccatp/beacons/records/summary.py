"""``summary.json`` of a mission among beacons: figures of merit against the truth where that is known."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.links import topics as beacon_topics
from ccatp.beacons.links.messages import (
    TRACK_COLUMNS,
    TRUTH_COLUMNS,
    PoseTruth,
    pose_errors,
    pose_track,
    pose_truth,
    table,
)
from ccatp.beacons.rigid_motion import aligned_rms_m, rms_m
from ccatp.core import FloatArray
from ccatp.filters.metrics import nees
from ccatp.links import topics
from ccatp.records.recorder import RobotClock
from ccatp.records.run_record import RunRecord
from ccatp.records.summary import distribution, rounded, wall_figures

WITHIN_SIGMAS = 3.0
_DISTRIBUTION = ("rmse", "mean", "p50", "p99", "max")


@dataclass(slots=True)
class BeaconSummary(RunRecord):
    """Collects a run; ``has_truth``: it is simulated."""

    cfg: RadioConfig
    has_truth: bool
    track: list[Sequence[float]] = field(default_factory=list)  # rows of the topic ``beacon_track``
    truth: list[Sequence[float | None]] = field(default_factory=list)  # rows of the topic ``beacon_truth``
    places: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # true, of radios and motes
    beacons: Mapping[str, Sequence[float]] = field(default_factory=dict)  # ellipses of the newest map, by name
    score: tuple[float, int] = (0.0, 0)  # of that map: sum of NIS, its degrees of freedom
    readings: tuple[int, int] = (0, 0)  # used, refused
    notes: Mapping[str, float] = field(default_factory=dict)
    reached: list[tuple[int, Sequence[float]]] = field(default_factory=list)  # frame; x, y, xx, xy, yy by the estimate
    events: Counter[str] = field(default_factory=Counter)  # how often motion began to be denied, by the signal
    mission_time_s: float = 0.0  # by the robot's clock
    outcome: str = ""
    cause: str = ""
    ticks_us: list[float] = field(default_factory=list)
    signal: str = ""  # by which motion is denied at present

    def take(self, message: topics.Message) -> None:
        """Take one message of the run."""
        if isinstance(message, beacon_topics.BeaconTrack):
            self.track += message.rows
        elif isinstance(message, beacon_topics.BeaconTruth):
            self.truth += message.rows
        elif isinstance(message, beacon_topics.BeaconPlaces):
            self.places = message.places
        elif isinstance(message, beacon_topics.BeaconMapMessage):
            self.beacons, self.notes = message.beacons, message.notes
            self.score, self.readings = (message.nis_sum, message.nis_size), (message.used, message.refused)
        elif isinstance(message, beacon_topics.BeaconArrival):
            self.reached.append((message.seq, message.estimate))
        elif isinstance(message, topics.Timing):
            self.ticks_us += message.tick_us
        elif isinstance(message, topics.DangerEvent):
            if message.signal and message.signal != self.signal:
                self.events[message.signal] += 1
            self.signal = message.signal
        elif isinstance(message, topics.MissionStatus):
            self.mission_time_s, self.outcome, self.cause = message.elapsed_s, message.outcome, message.cause

    def build(self, wall_s: float) -> dict[str, Any]:
        """The summary; lengths in m, angles in rad, times in s. Values that need the truth are null without it."""
        cfg = self.cfg
        track = pose_track(table(self.track, TRACK_COLUMNS))
        truth = pose_truth(table(self.truth, TRUTH_COLUMNS))
        if len(track.seq):  # the last drive may have been driven, or not
            truth = truth.at(truth.seq <= track.seq[-1])
        _, i, j = np.intersect1d(track.seq, truth.seq, return_indices=True)
        track, true = track.at(i), truth.at(j)
        # A robot that stands until motes have mapped themselves navigates from then on.
        is_navigating = track.t_s >= self.notes.get("map_time_s", 0.0)
        if is_navigating.any():
            track, true = track.at(is_navigating), true.at(is_navigating)
        known = self.has_truth and len(true.seq) > 0
        errors = pose_errors(track, true) if known else np.empty((0, 3))
        return {
            "system": cfg.system,
            "seed": cfg.run.seed,
            "outcome": self.outcome,
            "cause": self.cause,
            "waypoints": self._waypoints(truth if known else None),
            "trajectory_rmse_m": rounded(aligned_rms_m(track.place_m, true.place_m)) if known else None,
            "position_error_m": distribution(np.hypot(errors[:, 0], errors[:, 1]), _DISTRIBUTION),
            "heading_rmse_rad": rounded(np.sqrt(np.mean(errors[:, 2] ** 2))) if known else None,
            "dead_reckoning_rmse_m": rounded(rms_m(track.reckoned_m, true.place_m)) if known else None,
            "path_length_m": rounded(np.hypot(*np.diff(true.place_m, axis=0).T).sum()) if known else None,
            "beacons": self._beacon_figures(known=known),
            "target": self._target_figures(truth, known=known),
            "obstacles": _obstacle_figures(truth, known=known),
            "consistency": {
                "pose_nees_mean": rounded(np.mean(nees(errors, track.covariance))) if known else None,
                "nis_mean": rounded(self.score[0] / self.score[1]) if self.score[1] else None,
                "readings": self.readings[0],
                "refused": self.readings[1],
            },
            "danger": dict(sorted(self.events.items())),
            "map": {name: rounded(value) for name, value in sorted(self.notes.items())},
            "mission_time_s": rounded(self.mission_time_s, 3),
            "wall": wall_figures(self.mission_time_s, wall_s, self.ticks_us),
        }

    def _waypoints(self, truth: PoseTruth | None) -> dict[str, Any]:
        """Reached by the estimate, and how often the truth was within 3 sigma of it then."""
        within: int | None = None
        cfg = self.cfg
        total = 0 if cfg.follow.is_active else cfg.mission.laps * len(cfg.workspace.waypoints_m)
        if truth is not None:
            places = dict(zip(truth.seq.astype(int).tolist(), truth.place_m, strict=True))
            reached = [(estimate, places[seq]) for seq, estimate in self.reached if seq in places]
            within = sum(sigmas_off(estimate, place_m) <= WITHIN_SIGMAS for estimate, place_m in reached)
        return {"total": total, "reached": len(self.reached), "within_3_sigma": within}

    def _beacon_figures(self, *, known: bool) -> dict[str, Any]:
        found = {name: place for name, place in self.beacons.items() if name != self.cfg.follow.target}
        judged = beacon_errors(found, self.places) if known else {}
        errors, squares = [error_m for error_m, _ in judged.values()], [nees for _, nees in judged.values()]
        return {
            "count": len(self.places) if known else None,
            "mapped": len(found),
            "rmse_m": rounded(np.sqrt(np.mean(np.square(errors)))) if errors else None,
            "max_m": rounded(max(errors)) if errors else None,
            "nees_mean": rounded(np.mean(squares)) if squares else None,
            "places_m": {name: [rounded(place[0]), rounded(place[1])] for name, place in sorted(found.items())},
        }

    def _target_figures(self, truth: PoseTruth, *, known: bool) -> dict[str, Any] | None:
        cfg = self.cfg
        if not cfg.follow.is_active:
            return None
        safe_m, settled_s = cfg.follow.safe_distance_m, cfg.observation.every_steps * cfg.run.step_s
        late = truth.at((truth.t_s >= settled_s) & np.isfinite(truth.target_m[:, 0]) & known)
        distances = np.hypot(*(late.place_m - late.target_m).T)
        place = self.beacons.get(cfg.follow.target) if known else None
        return {
            "safe_distance_m": safe_m,
            "distance_mean_m": rounded(distances.mean()) if len(distances) else None,
            "distance_min_m": rounded(distances.min()) if len(distances) else None,
            "distance_rms_off_m": rounded(np.sqrt(np.mean((distances - safe_m) ** 2))) if len(distances) else None,
            "final_error_m": None if place is None else rounded(np.hypot(*(place[:2] - truth.target_m[-1]))),
        }


def _obstacle_figures(truth: PoseTruth, *, known: bool) -> dict[str, Any] | None:
    clearances = truth.clearance_m[np.isfinite(truth.clearance_m)]
    if known and not len(clearances):
        return None
    least_m = clearances.min() if known else None
    return {"least_clearance_m": rounded(least_m), "touched": None if least_m is None else bool(least_m <= 0.0)}


def sigmas_off(estimate: Sequence[float], true_m: FloatArray) -> float:
    """How many standard deviations an estimate, x, y, xx, xy, yy, is off the true place, root(e^T P^-1 e)."""
    x, y, xx, xy, yy = estimate
    off = true_m - (x, y)
    return float(np.sqrt(off @ np.linalg.solve(np.array(((xx, xy), (xy, yy))), off)))


def beacon_errors(
    beacons: Mapping[str, Sequence[float]], places: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Distance from the true place and NEES (2 is expected) of the beacons whose place is known, by name."""
    found = {}
    for name, (x, y, xx, xy, yy) in sorted(beacons.items()):
        if name in places:
            off = np.subtract((x, y), places[name])
            found[name] = float(np.hypot(*off)), float(off @ np.linalg.pinv(np.array(((xx, xy), (xy, yy)))) @ off)
    return found


def beacon_record(cfg: RadioConfig, _run_dir: Path, _clock: RobotClock, is_sim: bool) -> BeaconSummary:
    """The record of a run."""
    return BeaconSummary(cfg, is_sim)
