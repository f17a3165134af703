"""Replay: a localizer processes the events of a recorded run; errors against the truth or the recorded estimates."""

from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ccatp.config.models import FOUR_STATE, Config
from ccatp.core import DeckPose, FloatArray, IntArray
from ccatp.estimation.fixes import FixRefused
from ccatp.estimation.wheel_coast import CoastedMotion
from ccatp.filters.base import Filter, FilterError, FilterModel, Innovation
from ccatp.filters.metrics import nees, rms
from ccatp.localizer import Localizer, build_localizer, build_with_uncertainty
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.surface import MirrorError
from ccatp.records.run_reader import Event, Fixed, Marked, Trace, TraceBuilder
from ccatp.records.summary import distribution
from ccatp.records.timeline import common_rows, rows_of
from ccatp.report.html import render
from ccatp.sensing.wheel_means import as_standing
from ccatp.studies.results import value_at
from ccatp.studies.smoother import ROUNDING, Smoothed, Smoother

# Largest number of calls that can be undone. A late fix goes back some seconds, which are a few hundred calls.
REACH = 2000
# Steps in one smoother: about 30 MB at 20 states, so smoothing needs little more memory than the record itself.
CHAPTER = 4096
# Wheel rate above which the robot moves: ten times the noise of an encoder that gives rates.
TURNING_RAD_S = 0.01
_FIGURES, _DECIMALS = ("mean", "p50", "p99", "max"), 9  # of errors, mm
REPRODUCED = 1e-9
"""Largest difference, m and rad, with which a replay counts as equal to the run: that of rounding alone."""


# -- a filter that can be smoothed ------------------------------------------------------------------------------------


class _State(NamedTuple):
    """A mean and its covariance: the part of a filter that a smoother reads."""

    mean: FloatArray
    covariance: FloatArray


class _Past(NamedTuple):
    """The state before a call, and F, predicted mean and Q of the call's transition; None for an update."""

    mean: FloatArray
    covariance: FloatArray
    step: tuple[FloatArray, FloatArray, FloatArray] | None


class RecordingFilter:
    """Wraps a filter and records every transition of the state for a smoother.

    A ``reset`` to an earlier state of the filter removes the later record. A ``reset`` before any record sets the
    initial state. Any other one is a transition (``transition_of_reset``). The record takes 12 kB per transition at 20
    states. ``count``: number of recorded transitions.
    """

    def __init__(self, filter_: Filter) -> None:
        self._filter = filter_
        self._past: list[_Past] = []
        self.count = 0
        self._look()

    def _look(self) -> None:
        filter_ = self._filter
        self.mean, self.covariance, self.transition = filter_.mean, filter_.covariance, filter_.transition

    def predict(self, F: FloatArray | FilterModel, Q: FloatArray) -> None:
        """As ``Filter.predict``."""
        mean, covariance = self.mean, self.covariance
        self._filter.predict(F, Q)
        self._look()
        noise = added_noise(covariance, self.transition, self.covariance, Q)
        self._past.append(_Past(mean, covariance, (self.transition, self.mean, noise)))
        self.count += 1

    def update(self, z: FloatArray, H: FloatArray | FilterModel, R: FloatArray) -> Innovation:
        """As ``Filter.update``."""
        past = _Past(self.mean, self.covariance, None)
        innovation = self._filter.update(z, H, R)
        self._look()
        self._past.append(past)
        return innovation

    def reset(self, mean: FloatArray, covariance: FloatArray) -> None:
        """As ``Filter.reset``."""
        mean_before, covariance_before = self.mean, self.covariance
        is_transition = bool(self._past) and not self._take_back(mean, covariance)
        self._filter.reset(mean, covariance)
        self._look()
        if is_transition:
            F, Q = transition_of_reset(covariance_before, self.covariance)
            self._past.append(_Past(mean_before, covariance_before, (F, self.mean, Q)))
            self.count += 1

    def _take_back(self, mean: FloatArray, covariance: FloatArray) -> bool:
        """Remove the record after the state with these arrays; False: there is no such state."""
        if mean is self.mean and covariance is self.covariance:
            return True
        past = self._past
        for k in range(len(past) - 1, max(len(past) - REACH, 0) - 1, -1):
            if past[k].mean is mean and past[k].covariance is covariance:
                self.count -= sum(one.step is not None for one in past[k:])
                del past[k:]
                return True
        return False

    def smooth(self) -> Smoothed:
        """The smoothed first three states after 0, 1, ... ``count`` transitions: means (k, 3), covariances (k, 3, 3).

        Raises FilterDiverged: a smoothed state is not finite.
        """
        steps = [(mean, covariance, *step) for mean, covariance, step in self._past if step is not None]
        n = len(steps)
        means, covariances = np.empty((n + 1, 3)), np.empty((n + 1, 3, 3))
        end = _State(self.mean, self.covariance)
        means[n], covariances[n] = end.mean[:3], end.covariance[:3, :3]
        for first in reversed(range(0, n, CHAPTER)):
            chapter, last = Smoother(end.mean.size), min(first + CHAPTER, n)
            for step in steps[first:last]:
                chapter.record(*step)
            found = chapter.smooth(cast(Filter, end))  # which reads its mean and covariance only
            means[first:last], covariances[first:last] = found.means[:-1, :3], found.covariances[:-1, :3, :3]
            end = _State(found.means[0], found.covariances[0])
        return Smoothed(means, covariances)


def added_noise(P: FloatArray, F: FloatArray, predicted: FloatArray, Q: FloatArray) -> FloatArray:
    """Q of ``P' = F P F^T + Q`` if F is a regression and the given Q only a part of the added noise.

    P and ``predicted``: covariances before and after; F and Q: transition and given noise; all (n, n).
    """
    excess = predicted - F.dot(P).dot(F.T) - Q
    sigma = np.sqrt(np.maximum(predicted.diagonal(), 0.0))
    # Rounding is left out, so that a state without noise stays without noise.
    is_rounding = bool((np.abs(excess) <= ROUNDING * np.outer(sigma, sigma)).all())
    return Q if is_rounding else Q + excess


def transition_of_reset(before: FloatArray, after: FloatArray) -> tuple[FloatArray, FloatArray]:
    """F and Q (n, n) of a reset, from the covariances (n, n) before and after it.

    States with a changed variance are replaced (their rows of F are zero), the others are kept. This requires that the
    covariance of the others is unchanged, and that they are uncorrelated with the replaced ones. Otherwise F is zero:
    the state after the reset is independent of that before.
    """
    rounding = ROUNDING * np.sqrt(np.outer(after.diagonal(), after.diagonal()).clip(0.0))
    has_changed = np.abs(after - before) > rounding
    is_drawn = has_changed.diagonal()
    drawn, kept = np.flatnonzero(is_drawn), np.flatnonzero(~is_drawn)
    if has_changed[np.ix_(kept, kept)].any() or after[np.ix_(drawn, kept)].any():
        return np.zeros_like(after), after.copy()
    F, Q = np.diag((~is_drawn).astype(np.float64)), np.zeros_like(after)
    Q[np.ix_(drawn, drawn)] = after[np.ix_(drawn, drawn)]
    return F, Q


# -- replay -----------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Replayed:
    """The estimates of a localizer for a run, each before the fix at that frame; the same poses smoothed."""

    trace: Trace
    moving: IntArray  # frames in which the wheels turn
    feet: FloatArray  # of fixes used in the run: frame before, deck x, y of the origin by the fix, shape (f, 3)
    smoothed: Trace | None = None
    fixes: int = 0
    refused: int = 0  # by this localizer
    set_aside: int = 0  # not given to the localizer in the run, and not here
    # First fix that only one of run and replay used: its time, this localizer's reason (empty if it was used).
    first_difference: tuple[float, str] | None = None
    counts: dict[str, int] = field(default_factory=dict)


def has_smoother(cfg: Config) -> bool:
    """Whether the filter contains the whole pose, as a smoother requires."""
    return cfg.run.filter not in FOUR_STATE


def replay(
    cfg: Config, mirror: Mirror, events: Iterable[Event], *, smooth: bool = False,
    on_frame: Callable[[float], None] | None = None,
) -> Replayed:  # fmt: skip
    """Run the localizer of a configuration over the events of a run, from its start at base.

    ``smooth``: only if ``has_smoother``. ``on_frame`` gets the mission time of each frame, s. Raises FilterError: the
    smoothed state is not finite, or the main loop was restarted within a run that is to be smoothed.
    """
    player = _Player(cfg, mirror, smooth)
    for event in events:
        if isinstance(event, Fixed):
            player.take_fix(event)
        else:
            player.take_frame(event)
            if on_frame is not None:
                on_frame(event.t_s)
    return player.result()


class _Player:
    def __init__(self, cfg: Config, mirror: Mirror, smooth: bool) -> None:
        self._cfg, self._mirror = cfg, mirror
        self._recording: RecordingFilter | None = None
        self._wrap: Callable[[Filter], Filter] = self._record if smooth else lambda filter_: filter_
        self._localizer: Localizer = build_localizer(cfg, mirror, self._wrap)
        self._builder = TraceBuilder()
        self._steps = array("q")  # number of transitions of the filter up to each frame
        self._states = array("d")  # x, y, heading of the filter after them
        self._moving = array("q")
        self._feet = array("d")
        self._seq = -1
        self._fates: Counter[str] = Counter()
        self._first: tuple[float, str] | None = None

    def _record(self, filter_: Filter) -> Filter:
        self._recording = RecordingFilter(filter_)
        return self._recording

    def take_frame(self, event: Marked) -> None:
        if event.begun is not None:
            # A main loop that took over from another one begins at the last known pose of the robot.
            if self._recording is not None and self._seq >= 0:
                raise FilterError("the main loop was restarted within this recording, and no smoother goes across that")
            x_m, y_m, heading_rad, *sigmas = event.begun
            pose = DeckPose(x_m, y_m, heading_rad)
            self._localizer = build_with_uncertainty(self._cfg, self._mirror, pose, (sigmas[0], sigmas[1]), self._wrap)
        localizer, sensors = self._localizer, event.sensors
        imu, enc = ((), as_standing(sensors.enc)) if event.is_odometry_off else (sensors.imu, sensors.enc)
        coasted = None if event.coasted is None else CoastedMotion(*event.coasted)
        localizer.step(sensors.t, imu, enc, sensors.edge, sensors.gravity, coasted)
        if localizer.hold_cause:
            localizer.clear_hold()
        if event.doubted is not None:
            localizer.inflate_covariance(*event.doubted)
        if event.at_rest:
            localizer.rest()
        if event.number <= self._seq:
            return  # received again
        self._seq = event.number
        if any(abs(right or 0.0) > TURNING_RAD_S or abs(left or 0.0) > TURNING_RAD_S for _, right, left in sensors.enc):
            self._moving.append(event.number)
        here = localizer.pose
        self._builder.add(event.number, event.t_s, *here.panel, (here.x_m, here.y_m, here.heading_rad))
        self._builder.add_covariance(localizer.pose_covariance)
        if self._recording is not None:
            self._steps.append(self._recording.count)
            self._states.extend(self._recording.mean[:3].tolist())

    def take_fix(self, event: Fixed) -> None:
        self._fates["fixes"] += 1
        if event.was_set_aside:
            # The mission measured again instead; the replay follows the run, whatever this localizer would decide.
            self._fates["set_aside"] += 1
            return
        said = ""
        try:
            self._localizer.fuse_fix(event.fix)
        except (FixRefused, FilterError) as refusal:
            said = str(refusal)
            self._fates["refused"] += 1
        if bool(said) is event.was_fused and self._first is None:
            self._first = event.t_s, said
        if event.was_fused:
            with suppress(MirrorError):
                x, y, _ = self._mirror.foot_of_puck(event.fix.position_m, self._cfg.robot.puck_height_m)
                self._feet.extend((self._seq, x, y))

    def result(self) -> Replayed:
        trace, smoothed = self._builder.build(self._mirror), None
        if self._recording is not None:  # each pose gets the correction of the filter state from which it was predicted
            means, covariances = self._recording.smooth()
            steps = np.array(self._steps, dtype=np.int64)
            corrections = means[steps] - np.array(self._states).reshape(-1, 3)
            pose = trace.pose + corrections
            heights_m = self._mirror.surface.heights_m(pose[:, 0], pose[:, 1])
            smoothed = trace._replace(pose=pose, height_m=heights_m, covariance=covariances[steps])
        return Replayed(
            trace=trace,
            moving=np.array(self._moving, dtype=np.int64),
            feet=np.array(self._feet).reshape(-1, 3),
            smoothed=smoothed,
            first_difference=self._first,
            counts=dict(self._localizer.counts),
            **self._fates,
        )


# -- judgement --------------------------------------------------------------------------------------------------------


class ReplayErrors(NamedTuple):
    """Differences between an estimate and its reference in the k common frames."""

    distance_m: FloatArray  # straight distance
    turn_rad: FloatArray  # of the heading, in (-pi, pi]
    is_moving: NDArray[np.bool_]  # the wheels turn
    is_arrival: NDArray[np.bool_]  # the robot has just come to rest at a point for the first time
    nees: FloatArray  # of x, y and heading, docs/glossary.md: 3 is expected; NaN without a covariance


def errors_of(estimate: Trace, reference: Trace, moving: IntArray, arrivals: ArrayLike) -> ReplayErrors:
    """Compare in the common frames; ``arrivals``: frames at which the robot stood at a point for the first time."""
    i, j = common_rows(estimate.seq, reference.seq)
    seqs = estimate.seq[i]
    offset = estimate.place[i] - reference.place[j]
    turn = estimate.pose[i, 2] - reference.pose[j, 2]
    turn = turn - 2.0 * np.pi * np.round(turn / (2.0 * np.pi))  # exactly zero for equal angles
    squares = np.full(len(seqs), np.nan)
    if estimate.covariance is not None:
        error = np.column_stack([offset[:, :2], turn])
        covariance = estimate.covariance[i]
        is_usable = np.linalg.det(covariance) > 0.0
        squares[is_usable] = nees(error[is_usable], covariance[is_usable])
    distance = np.linalg.norm(offset, axis=1)
    return ReplayErrors(distance, turn, np.isin(seqs, moving), np.isin(seqs, arrivals), squares)


def figures(errors: ReplayErrors) -> dict[str, Any]:
    """Statistics of errors: lengths in mm, angles in mrad; None without values."""
    distance_mm = 1e3 * errors.distance_m
    return {
        "position_error_mm": {**distribution(distance_mm, _FIGURES, decimals=_DECIMALS), "rms": rms(distance_mm)},
        "moving_error_mm": {"rms": rms(distance_mm[errors.is_moving])},
        "arrival_error_mm": _rms_and_max(distance_mm[errors.is_arrival]),
        "heading_error_mrad": {"rms": rms(1e3 * errors.turn_rad)},
        "nees_mean": _mean(errors.nees),
        "arrival_nees_mean": _mean(errors.nees[errors.is_arrival]),
    }


def _mean(values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else None


def difference(errors: ReplayErrors) -> dict[str, Any]:
    """Differences between replayed and recorded estimates, and whether they are only rounding."""
    distance, turn = errors.distance_m, np.abs(errors.turn_rad)
    return {
        "frames": int(distance.size),
        "position_mm": _rms_and_max(1e3 * distance),
        "heading_mrad": _rms_and_max(1e3 * turn),
        "reproduced": bool(distance.size and max(distance.max(), turn.max()) <= REPRODUCED),
    }


def _rms_and_max(values: FloatArray) -> dict[str, float | None]:
    return {"rms": rms(values), "max": float(values.max()) if values.size else None}


class ReplayEvaluation(NamedTuple):
    """One recording and its replay; ``arrivals``: frames at which the robot stood at a point for the first time."""

    replayed: Replayed
    recorded: Trace
    truth: Trace | None
    arrivals: ArrayLike
    mirror: Mirror


def judge(parts: Sequence[ReplayEvaluation]) -> dict[str, Any]:
    """Errors of recorded, replayed and smoothed estimates, and the difference between replay and record.

    Errors are relative to the truth if every recording has one. Otherwise they are relative to the recorded estimates,
    which then have no errors. The distance of each fix from the estimate before it needs no truth.
    """
    has_truth = all(part.truth is not None for part in parts)
    recorded, replayed = [part.recorded for part in parts], [part.replayed.trace for part in parts]
    references = [part.truth if has_truth and part.truth is not None else part.recorded for part in parts]
    smoothed = [part.replayed.smoothed for part in parts if part.replayed.smoothed is not None]

    if not has_truth:  # the difference from another estimate says nothing about a covariance
        replayed, smoothed = ([one._replace(covariance=None) for one in part] for part in (replayed, smoothed))

    def errors(estimates: Sequence[Trace], references: Sequence[Trace]) -> ReplayErrors:
        each = [
            errors_of(estimate, reference, part.replayed.moving, part.arrivals)
            for part, estimate, reference in zip(parts, estimates, references, strict=True)
        ]
        return ReplayErrors(*(np.concatenate(column) for column in zip(*each, strict=True)))

    def fix_distance_mm(estimates: Sequence[Trace]) -> dict[str, float | None]:
        """Distribution of the distance of each fix from the estimate before it."""
        each = []
        for part, estimate in zip(parts, estimates, strict=True):
            seq, x, y = part.replayed.feet.T
            rows = rows_of(estimate.seq, seq)
            known = rows >= 0  # an estimate may be lost
            feet = np.column_stack([x, y, part.mirror.surface.heights_m(x, y)])
            each.append(estimate.place[rows[known]] - feet[known])
        return distribution(1e3 * np.linalg.norm(np.concatenate(each), axis=1), _FIGURES, decimals=_DECIMALS)

    return {
        "reference": "truth" if has_truth else "recorded",
        "recorded": {
            **(figures(errors(recorded, references)) if has_truth else {}),
            "fix_distance_mm": fix_distance_mm(recorded),
        },
        "replayed": {**figures(errors(replayed, references)), "fix_distance_mm": fix_distance_mm(replayed)},
        "smoothed": figures(errors(smoothed, references)) if len(smoothed) == len(parts) else None,
        "difference": difference(errors(replayed, recorded)),
    }


_POSE = ("x_m", "y_m", "heading_rad")


def table_lines(result: Mapping[str, Any]) -> list[str]:
    """The result of ``judge`` as a table: a column for each estimate, a dash for unknown values."""
    columns = [name for name in ("recorded", "replayed", "smoothed") if result[name] is not None]
    return render("replay.txt", result=result, columns=columns, text=_cell).splitlines()


def _cell(figures: Mapping[str, Any], key: str) -> str:
    value = value_at(figures, key)
    if value is None:
        return "-"
    return f"{value:.4f}" if value == 0.0 or abs(value) >= 1e-3 else f"{value:.1e}"


def csv_lines(parts: Sequence[ReplayEvaluation]) -> Iterator[str]:
    """Poses of each frame, deck frame: replayed, smoothed, recorded and true; empty cells if a pose is missing."""
    others = [f"{name}_{key}" for name in ("smoothed", "recorded", "true") for key in _POSE]
    yield ",".join(("part", "seq", "t_s", *_POSE, *others))
    for number, part in enumerate(parts, 1):
        trace, rest = part.replayed.trace, (part.replayed.smoothed, part.recorded, part.truth)
        poses_of = [dict(zip(one.seq.tolist(), one.pose.tolist(), strict=True)) if one else {} for one in rest]
        for seq, t_s, pose in zip(trace.seq.tolist(), trace.t_s.tolist(), trace.pose.tolist(), strict=True):
            found = [cell for poses in poses_of for cell in poses.get(seq, ("", "", ""))]
            yield ",".join(map(str, (number, seq, t_s, *pose, *found)))
