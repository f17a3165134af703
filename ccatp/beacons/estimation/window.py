"""The fixed-lag smoother: the filter between solutions of a window of recent readings that are linearised again.

The window is a ``BatchProblem`` of the readings of the last minutes, with a ``MarginalPrior`` of what came before. It
is solved when it has grown by a share, and whenever a beacon has joined. Its result replaces the filter's estimate of
pose, calibration and beacons. What the filter alone has in its state (readings that wait, errors that last) keeps its
relation to these.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError

from ccatp.beacons.config.models import FixedLagConfig, PriorsConfig, RecordingConfig, SlamFilterConfig
from ccatp.beacons.estimation.batch_problem import BatchProblem, BeaconNoise
from ccatp.beacons.estimation.batch_unknowns import (
    BEACON,
    HEIGHT,
    SHARED,
    BatchState,
    MarginalPrior,
    PlacePrior,
    of_priors,
)
from ccatp.beacons.estimation.beacon_slam import BeaconSlam
from ccatp.beacons.estimation.least_squares import Factored, descend, eliminated, t_weights
from ccatp.beacons.estimation.measurement_models import ANTENNA, HEIGHT_M2
from ccatp.beacons.estimation.motion import POSE
from ccatp.beacons.estimation.odometry_noise import OdometryNoise, odometry_noise
from ccatp.beacons.estimation.range_noise import range_noise
from ccatp.beacons.estimation.reckoning import CALIBRATION
from ccatp.beacons.estimation.recording import (
    BeaconId,
    BoolArray,
    DelayedPath,
    RecordedRun,
    Steps,
    first_of_each,
)
from ccatp.core import FloatArray

SPACING_S = 0.5  # longest interval between poses without readings
SOONEST_S = 1.0  # shortest interval between solutions
GROWTH = 0.1  # of the window between solutions: the filter's linearisations last that long
KEPT = 0.75  # share of the longest window that is kept when its beginning is marginalised
ITERATIONS = 12
ENOUGH = 1e-4  # relative decrease of the cost at which it has converged; the next solution goes on from there
REPORTED = 3.0  # readings that count as one, above which that is reported
EARLIER_S = 2.0  # of odometry before the window, for its delay


SETTLED = 50  # iterations: the variance falls by a factor of FREEDOM + 1 in one where readings tell nothing
LEAST_INFORMATION = 1e-3  # of the readings on a calibration, relative to that of its prior; less is rounding
FREEDOM = 8.0  # of Student's t of a calibration: one of several cores costs less than a Gaussian would take
# Standard deviation of a calibration among instruments, as a share of the prior, which is that of the worst ones.
# Covariances are those of errors with this spread, though the estimate assumes the core, which is narrower.
USUAL = 0.7
# Levels are left out: the spread of transmitters is no fault of an instrument.
INSTRUMENTAL = (
    *CALIBRATION, "range_scale", "range_offset_m", "bearing_offset_rad", *ANTENNA, HEIGHT_M2,
)  # fmt: skip


def reweighted(priors: PriorsConfig, squares: Mapping[str, Sequence[float]]) -> PriorsConfig:
    """Gaussian priors with the weight that Student's t has at calibrations of these expected squares.

    The scale of t is ``core`` times the standard deviation of the prior. The variance is (freedom scale^2 + square) /
    (freedom + 1), with which the square of an unobserved calibration stays that of the scale.
    """
    sigmas = {}
    for name in INSTRUMENTAL:
        scale = priors.core * float(getattr(priors, name))
        if scale > 0.0:
            found = squares.get(name, (scale**2,))
            sigmas[name] = sqrt((FREEDOM * scale**2 + sum(found)) / (FREEDOM + len(found)))
    return priors.model_copy(update=sigmas)


def excesses(assumed: PriorsConfig, configured: PriorsConfig) -> dict[str, tuple[float, float]]:
    """Variances of the priors that were assumed, and those of instruments, by name."""
    return {name: (getattr(assumed, name) ** 2, (USUAL * getattr(configured, name)) ** 2) for name in INSTRUMENTAL}


def spread_by_priors(factored: Factored, problem: BatchProblem, configured: PriorsConfig) -> Factored:
    """The factors with the covariances of errors among instruments."""
    variances = np.full((2, problem.free.size), np.inf)
    for name, found in excesses(problem.priors, configured).items():
        if name in SHARED:
            variances[:, SHARED.index(name)] = found
        else:
            variances[:, len(SHARED) + HEIGHT :: BEACON] = np.array(found)[:, None]
    return factored.spread_by(*variances[:, problem.free])


class _Solved(NamedTuple):
    problem: BatchProblem
    state: BatchState
    factored: Factored
    times_s: FloatArray


def settled_square(value: float, variance: float, assumed: float, scale: float) -> float:
    """Expected square of a calibration when it and the weight of its prior have converged, from a flat prior on.

    ``value``, ``variance``: its estimate under a Gaussian prior with the standard deviation ``assumed``. ``scale``:
    that of Student's t. If the readings alone tell x with the information J, the estimate under a prior of variance w
    is P J x, P = 1 / (J + 1 / w). From the core on, with one weight a solution, many solutions would be needed for a
    value of many cores: an antenna that is elsewhere would be found metres later, and an offset of the ranges be taken
    for errors that last. Of readings that tell nothing x is a quotient of rounding errors, many sigmas from zero.
    """
    information, pull = 1.0 / variance - assumed**-2, value / variance
    if information < LEAST_INFORMATION * assumed**-2:
        return scale**2
    P = 1.0 / information
    for _ in range(SETTLED):
        w = (FREEDOM * scale**2 + (P * pull) ** 2 + P) / (FREEDOM + 1.0)
        P = 1.0 / (information + 1.0 / w)
    return (P * pull) ** 2 + P


class Window:
    """Solves the window and corrects a ``BeaconSlam``; ``delayed`` is the path as estimated ``lag_s`` later.

    ``assumed``: the priors of the calibration in the filter's estimate. ``noise``: of the ranges, and ``odometry``:
    factors on that of the odometry, as estimated from the last solution.
    """

    def __init__(self, run: RecordedRun, cfg: RecordingConfig, how: SlamFilterConfig, lag: FixedLagConfig) -> None:
        self._run, self._lag, self._spacing_s = run, lag, lag.lag_s / lag.poses
        self._rest = how.rest_speed_m_s, how.rest_turn_rad_s
        self._doubtful = max(how.doubt_pose_after - 1, 1)  # refusals in a row
        self._was_doubtful = False
        self._stands = np.array([name not in run.moving for name in run.beacon_ids])  # others are the filter's alone
        readings = run.readings.with_distances(cfg.radio.camera_field_rad)
        self._readings = readings.where(self._stands[readings.beacon])
        steps_s = run.steps.times_s
        self._grid_s = steps_s[first_of_each(steps_s, SPACING_S)]
        self._begin_s, self._solved_s = float(steps_s[0]), float(steps_s[0])
        self._marginal: MarginalPrior | None = None
        self._last: _Solved | None = None
        self._seen: tuple[object, ...] = (0, 0)
        self.noise = BeaconNoise.configured(len(run.beacon_ids) * len(run.radios))
        self._raised = run.raised if cfg.priors.beacon_height_m2 > 0.0 else np.zeros(len(run.beacon_ids), dtype=bool)
        self.raised = [name for name, is_raised in zip(run.beacon_ids, self._raised, strict=True) if is_raised]
        self._places = None if run.known_map is None else PlacePrior.of_run(run, run.beacon_ids)
        self._configured, self._cfg = cfg, cfg.model_copy(update={"priors": reweighted(cfg.priors, {})})
        self.odometry = self._odometry_before = OdometryNoise()
        self.assumed = self._cfg.priors
        self._due_s, self._placed = self._begin_s, frozenset[str]()
        self._delayed = list[tuple[float, FloatArray, FloatArray]]()

    def step(self, time_s: float, slams: Sequence[BeaconSlam], times_s: FloatArray, poses: FloatArray) -> None:
        """Solve the window if that is due, and correct the filter.

        ``slams``: all hypotheses of the filter, the best one first. ``times_s``, ``poses``: the filter's path up to
        now, shapes (k,) and (k, 3).
        """
        slam = slams[0]
        events = (slam.jumps, len(slam.moved))
        if len(slams) > 1 or events != self._seen:  # the past of this window is not that of the filter any more
            self._restart(time_s, slam)
            self._seen = events
            return
        if time_s < self._solved_s + SOONEST_S:
            return
        placed = frozenset(map(str, slam.beacons)) - {*self._run.moving}
        joins = not placed <= self._placed or bool(slam.likely().keys() - {*self._run.moving})
        self._solved_s = time_s if joins or not placed else self._solved_s
        # Refused readings may be good ones, linearised too far off: solve before the filter doubts its pose.
        is_doubtful = slam.refused_in_a_row >= self._doubtful
        begins_to_doubt, self._was_doubtful = is_doubtful and not self._was_doubtful, is_doubtful
        if joins or (placed and (time_s >= self._due_s or begins_to_doubt)):
            self.solve(time_s, slam, times_s, poses)
            self._placed = frozenset(map(str, slam.beacons)) - {*self._run.moving}

    def solve(self, time_s: float, slam: BeaconSlam, times_s: FloatArray, poses: FloatArray) -> None:
        """Solve the window, and correct the filter."""
        self._solved_s = time_s
        self._due_s = time_s + max(SOONEST_S, GROWTH * (time_s - self._begin_s))
        likely = {name: place_m for name, place_m in slam.likely().items() if name not in self._run.moving}
        solved = self._solution(time_s, slam, likely, times_s, poses)
        if solved is None:
            return
        for name in likely:
            slam.join(name, solved.state.beacons[self._run.beacon_ids.index(str(name)), :2])
        self._last, self.assumed = solved, solved.problem.priors
        self._correct(slam, solved, time_s)
        self._learn(solved)
        slam.take_odometry_noise(self._cfg.odometry)
        self.noise = range_noise(solved.problem, solved.state, self.noise)
        for k, (radio, name) in enumerate(product(self._run.radios, self._run.beacon_ids)):
            slam.take_noise(name, radio, *(float(column[k]) for column in (self.noise.variance, *self.noise[2:])))
        self._hand_over(time_s - self._lag.lag_s)
        if time_s - self._begin_s > self._lag.window_s:
            self._marginalise(time_s - KEPT * self._lag.window_s)

    def delayed(self, slam: BeaconSlam, times_s: FloatArray, poses: FloatArray, covariances: FloatArray) -> DelayedPath:
        """Solve once more, at the end of the run: the whole delayed path.

        Before the first window it is the filter's path, which is given.
        """
        if self._last is not None:
            self.solve(float(times_s[-1]), slam, times_s, poses)
        self._hand_over(np.inf)
        begin_s = self._delayed[0][0] if self._delayed else np.inf
        early, next_s = [], -np.inf
        for k, time_s in enumerate(times_s.tolist()):
            if next_s <= time_s < begin_s:
                early.append((time_s, poses[k], covariances[k]))
                next_s = time_s + self._spacing_s
        return DelayedPath(self._lag.lag_s, *map(np.array, zip(*early, *self._delayed, strict=True)))

    @property
    def settings(self) -> RecordingConfig:
        """The settings in use.

        The priors are Gaussian, with the weights of Student's t at the calibration of the last solution; the noise of
        the odometry is that estimated from it.
        """
        return self._cfg

    def findings(self) -> Iterator[str]:
        """What was found of the noise, and what was done about it."""
        heard = product([f" by tag {tag.name}" for tag in self._run.tags] or [""], self._run.beacon_ids)
        names = [(f"{name}{by}", k) for k, (by, name) in enumerate(heard) if self.noise.repeats[k] > REPORTED]
        for name, k in names:
            yield (
                f"range errors of beacon {name} last for {self.noise.lasts_s[k]:.1f} s: {self.noise.repeats[k]:.0f} "
                "of its readings count as one"
            )

    def _of_filter(self, k: int) -> tuple[int, ...]:
        """States of a beacon that the filter has, too."""
        return (0, 1, HEIGHT) if self._raised[k] else (0, 1)

    # -- the window ---------------------------------------------------------------------------------------------------

    def _steps(self, begin_s: float, end_s: float) -> Steps:
        steps = self._run.steps
        first = max(int(np.searchsorted(steps.times_s, begin_s - EARLIER_S, side="right")) - 1, 0)
        last = min(int(np.searchsorted(steps.times_s, end_s)), steps.times_s.size - 1)
        rows = (np.broadcast_to(row, steps.distance_m.shape)[first:last] for row in steps[1:])
        return Steps(steps.times_s[first : last + 1], *rows)

    def _problem(self, begin_s: float, end_s: float, used: BoolArray, *, from_begin: bool) -> BatchProblem:
        """Of the readings after ``begin_s`` (or at it, at the beginning of the run) up to ``end_s``."""
        r = self._readings
        inside = (r.times_s <= end_s) & ((r.times_s >= begin_s) if from_begin else (r.times_s > begin_s))
        readings = r.where(inside)
        grid_s = self._grid_s[(self._grid_s > begin_s) & (self._grid_s < end_s)]
        times_s = np.union1d(np.union1d(readings.times_s, grid_s), (begin_s, end_s))
        steps = self._steps(begin_s, end_s)
        return BatchProblem(
            steps, readings, times_s, self._run.first_pose, self._cfg, used, self._rest, self._marginal,
            self.noise, self._places, self._raised,
        )  # fmt: skip

    def _solution(
        self, time_s: float, slam: BeaconSlam, likely: Mapping[BeaconId, FloatArray], times_s: FloatArray,
        poses: FloatArray,
    ) -> _Solved | None:  # fmt: skip
        used = self._stands & [name in slam.beacons or name in likely for name in self._run.beacon_ids]
        if self._marginal is not None:
            used |= self._marginal.known
        problem = self._problem(self._begin_s, time_s, used, from_begin=self._marginal is None)
        start = self._start(problem, slam, times_s, poses)
        for name, place_m in likely.items():
            start.beacons[self._run.beacon_ids.index(str(name)), :2] = place_m
        try:
            state, _ = descend(problem, start, ITERATIONS, enough=ENOUGH)
            weights = t_weights(problem.residuals(state).chi2, problem.sizes, problem.radio.freedom)
            factored = Factored(problem.normal_equations(state, weights * problem.power))
        except LinAlgError:
            return None  # these readings do not determine the beacons: the filter goes on alone
        return _Solved(problem, state, factored, problem.times_s)

    def _start(self, problem: BatchProblem, slam: BeaconSlam, times_s: FloatArray, poses: FloatArray) -> BatchState:
        """The last solution, with the filter's path since then and the beacons that have joined."""
        at_s, last = problem.times_s, self._last
        filtered = np.column_stack([np.interp(at_s, times_s, column) for column in poses.T])
        shared = np.zeros(len(SHARED)) if last is None else last.state.shared.copy()
        beacons = np.zeros((len(self._run.beacon_ids), BEACON)) if last is None else last.state.beacons.copy()
        if last is not None:
            old = at_s <= last.times_s[-1]
            filtered[old] = np.column_stack([np.interp(at_s[old], last.times_s, c) for c in last.state.poses.T])
        for name, (value, _) in slam.calibration.items():
            shared[SHARED.index(name)] = value
        for k, name in enumerate(self._run.beacon_ids):
            if name in slam.beacons:
                beacons[k, self._of_filter(k)] = slam.engine.mean[slam.place(name)]
        return BatchState(filtered, shared, beacons)

    def _correct(self, slam: BeaconSlam, solved: _Solved, time_s: float) -> None:
        """Replace the filter's estimate by that of the window."""
        whole = np.zeros((POSE + solved.problem.free.size,) * 2)
        free = np.concatenate([np.ones(POSE, dtype=bool), solved.problem.free])
        whole[np.ix_(free, free)] = solved.factored.covariance_at(-1)
        names = [name for name in slam.calibration if solved.problem.free[SHARED.index(name)]]
        rows = [*range(POSE), *(POSE + SHARED.index(name) for name in names)]
        placed = [k for k, name in enumerate(self._run.beacon_ids) if self._stands[k] and name in slam.beacons]
        for k in placed:
            rows += [POSE + len(SHARED) + BEACON * k + state for state in self._of_filter(k)]
        values = np.concatenate([solved.state.poses[-1], solved.state.shared, solved.state.beacons.ravel()])
        slam.replace(time_s, names, [self._run.beacon_ids[k] for k in placed], values[rows], whole[np.ix_(rows, rows)])

    def _learn(self, solved: _Solved) -> None:
        """Give the prior of each calibration its weight at this solution, and estimate the noise of the odometry."""
        variances = solved.problem.spread(solved.factored.shared_covariance().diagonal())
        squares, configured = dict[str, list[float]](), self._configured.priors
        for k in np.flatnonzero(solved.problem.free[: len(SHARED)]).tolist():
            if (name := SHARED[k]) in INSTRUMENTAL:
                scale, assumed = configured.core * getattr(configured, name), getattr(solved.problem.priors, name)
                value, variance = float(solved.state.shared[k]), float(variances[k])
                squares[name] = [settled_square(value, variance, assumed, scale)]
        raised = solved.problem.used & self._raised
        of_heights = variances[len(SHARED) :].reshape(-1, BEACON)[raised, HEIGHT]
        squares[HEIGHT_M2] = (solved.state.beacons[raised, HEIGHT] ** 2 + of_heights).tolist()
        priors = reweighted(configured, squares)
        self.odometry = odometry_noise(*solved[:3], self._configured.odometry, self.odometry, self._odometry_before)
        odometry = self.odometry.of(self._configured.odometry)
        self._cfg = self._cfg.model_copy(update={"priors": priors, "odometry": odometry})

    def _marginalise(self, before_s: float) -> None:
        """Keep what the readings up to a pose of the window tell as a prior, and begin there."""
        last = self._last
        if last is None:
            return
        at = int(np.searchsorted(last.times_s, before_s))
        cut_s = float(last.times_s[at])
        head = self._problem(self._begin_s, cut_s, last.problem.used, from_begin=self._marginal is None)
        poses = np.column_stack([np.interp(head.times_s, last.times_s, c) for c in last.state.poses.T])
        state = BatchState(poses, last.state.shared, last.state.beacons)
        weights = t_weights(head.residuals(state).chi2, head.sizes, head.radio.freedom)
        information, side = eliminated(head.normal_equations(state, weights * head.power))
        assumed, pull = head.assumed(state.shared, state.beacons)
        information[POSE:, POSE:] -= assumed  # the priors stay where they are
        side[POSE:] += pull
        self._begin(cut_s, state, last.problem.used, head.free, information, side)

    def _begin(
        self, begin_s: float, state: BatchState, known: BoolArray, free: BoolArray, information: FloatArray,
        side: FloatArray,
    ) -> None:  # fmt: skip
        kept = np.concatenate([np.ones(POSE, dtype=bool), free])
        whole, g = np.zeros((kept.size, kept.size)), np.zeros(kept.size)
        whole[np.ix_(kept, kept)], g[kept] = information, side
        self._marginal = MarginalPrior.made(state, -1, known, whole, g)
        self._begin_s = begin_s

    def _restart(self, time_s: float, slam: BeaconSlam) -> None:
        """Begin a window now, with the filter's estimate as its prior."""
        self._hand_over(np.inf)
        self._odometry_before, self._was_doubtful = self.odometry, False
        used = self._stands & [name in slam.beacons for name in self._run.beacon_ids]
        names, placed = list(slam.calibration), np.flatnonzero(used).tolist()
        shared, beacons = np.zeros(len(SHARED)), np.zeros((len(used), BEACON))
        rows = [*range(POSE), *(POSE + SHARED.index(name) for name in names)]
        for k in placed:
            rows += [POSE + len(SHARED) + BEACON * k + state for state in self._of_filter(k)]
            beacons[k, self._of_filter(k)] = slam.engine.mean[slam.place(self._run.beacon_ids[k])]
        for name, (value, _) in slam.calibration.items():
            shared[SHARED.index(name)] = value
        pose, P = slam.marginal(time_s, names, [self._run.beacon_ids[k] for k in placed])
        size = POSE + len(SHARED) + beacons.size
        information = np.zeros((size, size))
        information[np.ix_(rows, rows)] = np.linalg.inv(P)
        # The filter's calibration and known places have priors, which stay where they are.
        assumed, side, own = np.zeros((size, size)), np.zeros(size), np.array(rows[POSE:], dtype=int)
        assumed[own, own] = of_priors(self.assumed, used, self._raised)[1][own - POSE]
        values = np.concatenate([shared, beacons.ravel()])
        side[POSE:] = assumed.diagonal()[POSE:] * values
        if self._places is not None:  # a beacon that was removed is not where it was surveyed
            removed = {str(name) for name, _ in slam.moved}
            self._places = PlacePrior.of_run(self._run, {one for one in slam.beacons if one not in removed})
            assumed[POSE:, POSE:] += self._places.information
            side[POSE:] += self._places.information @ (values - self._places.mean)
        squares, vectors = np.linalg.eigh(information - assumed)
        information = (vectors * np.maximum(squares, 0.0)) @ vectors.T
        state = BatchState(pose[None, :], shared, beacons)
        self._marginal = MarginalPrior.made(state, -1, used, information, side)
        self._begin_s = self._solved_s = time_s
        self._due_s, self._last, self._placed = time_s + SOONEST_S, None, frozenset(map(str, slam.beacons))

    def _hand_over(self, until_s: float) -> None:
        """Keep poses of the last solution, evenly spaced, as the delayed path."""
        last = self._last
        if last is None:
            return
        factored = spread_by_priors(last.factored, last.problem, self._configured.priors)
        for k, time_s in enumerate(last.times_s.tolist()):
            if time_s > until_s:
                return
            if not self._delayed or time_s >= self._delayed[-1][0] + self._spacing_s:
                covariance = factored.covariance_at(k)[:POSE, :POSE]
                self._delayed.append((time_s, last.state.poses[k].copy(), covariance))
