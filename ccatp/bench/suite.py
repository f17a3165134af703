"""The benchmarks one after the other, as one result."""

from collections.abc import Callable, Iterator, Sequence
from math import sqrt
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from ccatp.bench.contenders import Contender, Result, our_filter, played_back, printed_filter
from ccatp.bench.exact import exact_filter
from ccatp.bench.machine import machine
from ccatp.bench.missions import BenchError, lockstep_case, rehearsal_case
from ccatp.bench.peers import filterpy_extended, filterpy_linear, filterpy_unscented, stonesoup
from ccatp.bench.problems import (
    LINEAR_ROWS,
    POSE_ROWS,
    STEPS,
    FilterProblem,
    RangeProblem,
    linear_problem,
    mild,
    pose_problem,
    range_problem,
    survey_problem,
)
from ccatp.bench.race import Difference, Times, largest_difference, race
from ccatp.bench.slam_race import BEACONS, DENSE_BEACONS, dense_slam, our_slam, slam_problem
from ccatp.config.models import Config
from ccatp.core import FloatArray
from ccatp.filters.unscented import ALPHA, BETA, KURTOSIS
from ccatp.mirror.multilateration import multilaterate

EQUAL_WITHIN = 1e-10  # every entry of mean and covariance, SI units
ROUNDS, QUICK_ROUNDS = 40, 4
PANELS, QUICK_PANELS = 4, 1
SEED = 1
_PRINTED = "eq. 2.13 in numpy"
_WHOLE = "whole matrices in numpy"
MOST_DENSE_ROUNDS = 10
INSTALL = "pip install 'ccatp[peers]'"

Peers = tuple[tuple[str, Callable[[FilterProblem], Contender]], ...]


def run_bench(cfg: Config, *, quick: bool, run_args: Sequence[str] = (), missions: bool = True) -> dict[str, Any]:
    """Run every benchmark.

    Args:
        cfg: the robot's measures and noise, the mirror, and the mission that is timed.
        quick: a tenth of the repeats and a mission of one panel.
        run_args: what else ``ccatp run`` needs to work on the same configuration.
        missions: time missions as well as steps.

    Returns:
        ``{"machine", "cases"}``. A case holds name, us_p50, us_p99, peer, peer_us_p50 and ratio = ours / peer, None
        without a peer; and what else is known of it: that both computed the same, or how to install the peer.

    Raises:
        BenchError: a peer's result differs, or a mission failed.
    """
    rounds, panels = (QUICK_ROUNDS, QUICK_PANELS) if quick else (ROUNDS, PANELS)
    cases = []
    if missions:
        cases += [rehearsal_case(cfg, panels), lockstep_case(cfg, panels, run_args)]
    cases = [*filter_cases(cfg, rounds), *slam_cases(rounds), multilateration_case(cfg, rounds), *cases]
    return {"machine": machine(), "equal_within": EQUAL_WITHIN, "cases": cases}


def filter_cases(cfg: Config, rounds: int) -> Iterator[dict[str, Any]]:
    """Predict and update of each filter against each peer."""
    for rows in LINEAR_ROWS:
        linear = linear_problem(cfg.robot, cfg.localizer, rows, SEED)
        yield from _against("kf", linear, _LINEAR_PEERS, rounds)
    for rows in POSE_ROWS:
        pose = pose_problem(cfg.robot, cfg.localizer, rows, SEED)
        yield from _against("ekf", pose, _EXTENDED_PEERS, rounds)
        yield from _against("ukf", pose, _UNSCENTED_PEERS, rounds)
    survey = survey_problem(cfg, SEED)
    yield from _against("ekf", survey, _EXTENDED_PEERS, rounds)
    yield from _against("ukf", survey, _UNSCENTED_PEERS, rounds)


def multilateration_case(cfg: Config, rounds: int) -> dict[str, Any]:
    """A puck's position out of its lengths, against SciPy's Levenberg-Marquardt with the same Jacobian."""
    problem = range_problem(cfg, SEED)
    ours, peer = _our_position(problem), _scipy_position(problem)
    name = f"multilaterate, {problem.anchors_m.shape[0]} lengths"
    difference = _checked(name, "scipy.optimize.least_squares", largest_difference(ours, peer, STEPS))
    return case(name, race(ours, peer, STEPS, rounds), "scipy.optimize.least_squares", difference)


def slam_cases(rounds: int) -> Iterator[dict[str, Any]]:
    """Range SLAM, a prediction and a scalar update a step, against whole matrices where that is bearable."""
    for beacons in BEACONS:
        problem = slam_problem(beacons, STEPS, SEED)
        name, ours = f"ekf-slam, {beacons} beacons, n = {problem.mean.size}", our_slam(problem)
        if beacons > DENSE_BEACONS:
            note = f"ekf-slam: whole matrices take n^3, too long to race against beyond {DENSE_BEACONS} beacons"
            yield {**case(name, race(ours, None, STEPS, rounds), None), "note": note}
            continue
        dense = dense_slam(problem)
        difference = _checked(name, _WHOLE, largest_difference(ours, dense, STEPS))
        yield case(name, race(ours, dense, STEPS, min(rounds, MOST_DENSE_ROUNDS)), _WHOLE, difference)


def case(name: str, times: Times, peer: str | None, difference: Difference | None = None) -> dict[str, Any]:
    """The figures of one race."""
    p50, p99 = np.percentile(times.ours_us, (50, 99))
    found: dict[str, Any] = {"name": name, "us_p50": float(p50), "us_p99": float(p99), "peer": peer}
    if times.peer_us is None:
        return {**found, "peer_us_p50": None, "peer_us_p99": None, "ratio": None}
    peer_p50, peer_p99 = np.percentile(times.peer_us, (50, 99))
    found |= {"peer_us_p50": float(peer_p50), "peer_us_p99": float(peer_p99), "ratio": float(p50 / peer_p50)}
    if difference is not None:
        found |= {"largest_difference": difference.absolute, "rounding_sigmas": difference.sigmas}
    return found


def _against(filter_name: str, problem: FilterProblem, peers: Peers, rounds: int) -> Iterator[dict[str, Any]]:
    name = f"{filter_name} predict + update, n = {problem.mean.size}, m = {problem.variances.size}"
    exact = played_back(exact_filter(problem, unscented=filter_name == "ukf"), STEPS)
    for peer_name, build in peers:
        ours = our_filter(filter_name, problem)
        try:
            peer = build(problem)
        except ImportError:
            note = f"{peer_name} is not installed: {INSTALL}"
            yield {**case(name, race(ours, None, STEPS, rounds), None), "note": note}
            continue
        found = case(name, race(ours, peer, STEPS, rounds), peer_name, largest_difference(ours, peer, STEPS))
        found["error"] = largest_difference(ours, exact, STEPS).absolute
        found["peer_error"] = largest_difference(peer, exact, STEPS).absolute
        _check_equal(found)
        if found["largest_difference"] > EQUAL_WITHIN:
            mildly = largest_difference(our_filter(filter_name, mild(problem)), build(mild(problem)), STEPS)
            _checked(name + ", milder", peer_name, mildly)
        yield found


def _check_equal(found: dict[str, Any]) -> None:
    """Refuse results that differ, unless ours is the exact one: then what differs is the peer's rounding."""
    difference, error = found["largest_difference"], found["error"]
    if not (difference <= EQUAL_WITHIN or error <= EQUAL_WITHIN < found["peer_error"]):
        _checked(found["name"], found["peer"], Difference(difference, found["rounding_sigmas"]))


def _checked(name: str, peer: str, difference: Difference) -> Difference:
    if not difference.absolute <= EQUAL_WITHIN:
        raise BenchError(
            f"{name}: results differ from those of {peer} by {difference.absolute:.2g}, more than {EQUAL_WITHIN:g}: "
            "times of different computations cannot be compared"
        )
    return difference


def _unscented(problem: FilterProblem) -> dict[str, float]:
    """The parameters of our sigma points."""
    return {"alpha": ALPHA, "beta": BETA, "kappa": max(KURTOSIS - problem.mean.size, 0.0)}


_LINEAR_PEERS: Peers = (
    (_PRINTED, printed_filter),
    ("filterpy", filterpy_linear),
    ("Stone Soup", lambda problem: stonesoup("Kalman", problem)),
)
_EXTENDED_PEERS: Peers = (
    (_PRINTED, printed_filter),
    ("filterpy", filterpy_extended),
    ("Stone Soup", lambda problem: stonesoup("ExtendedKalman", problem)),
)
_UNSCENTED_PEERS: Peers = (
    ("filterpy", lambda problem: filterpy_unscented(problem, **_unscented(problem))),
    ("Stone Soup", lambda problem: stonesoup("UnscentedKalman", problem, **_unscented(problem))),
)


def _our_position(problem: RangeProblem) -> Contender:
    solution: Result = (np.zeros(3), np.eye(3))

    def step(i: int) -> None:
        nonlocal solution
        found = multilaterate(problem.anchors_m, problem.ranges_m[i], problem.sigmas_m[i], problem.expected_m[i])
        solution = found.position_m, found.covariance_m2

    return Contender(lambda: None, step, lambda: solution)


def _scipy_position(problem: RangeProblem) -> Contender:
    """The same weighted least squares, and the covariance out of its Jacobian."""
    solution: Result = (np.zeros(3), np.eye(3))
    tolerance = sqrt(np.finfo(np.float64).eps)  # quadratic convergence squares it

    def step(i: int) -> None:
        nonlocal solution
        ranges, sigmas = problem.ranges_m[i], problem.sigmas_m[i]

        def residuals(x: FloatArray) -> FloatArray:
            offsets = x - problem.anchors_m
            seen: FloatArray = (np.sqrt((offsets * offsets).sum(axis=1)) - ranges) / sigmas
            return seen

        def jacobian(x: FloatArray) -> FloatArray:
            offsets = x - problem.anchors_m
            slopes: FloatArray = offsets / (np.sqrt((offsets * offsets).sum(axis=1)) * sigmas)[:, None]
            return slopes

        found = least_squares(
            residuals, problem.expected_m[i], jac=jacobian, method="lm",
            xtol=tolerance, ftol=tolerance, gtol=tolerance,
        )  # fmt: skip
        slopes = np.asarray(found.jac, dtype=np.float64)
        covariance = np.linalg.inv(slopes.T @ slopes).astype(np.float64)
        solution = np.asarray(found.x), covariance

    return Contender(lambda: None, step, lambda: solution)
