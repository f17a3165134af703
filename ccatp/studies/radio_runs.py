"""One run of a robot among radio beacons, with the truth beside the estimates; the runs of a cell put together."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import chdtri

from ccatp.beacons.navigation import BeaconMeasurements, RadioNavigator, odometry_of
from ccatp.beacons.pilot import BeaconPilot
from ccatp.beacons.steering import HALT
from ccatp.config.beacon_models import RadioConfig
from ccatp.core import FloatArray, wrap_pi
from ccatp.sim.radio import SimDriveCommand
from ccatp.sim.radio_world import RadioWorld
from ccatp.studies.campaign import Column, Factors, Job, JobOutcome


@dataclass(slots=True)
class RadioRun:
    """What a run leaves, one entry a step where nothing else is said.

    Attributes:
        pose_errors: x_m, y_m and heading_rad, estimate minus truth.
        pose_nees: with 3 degrees of freedom.
        reckoned_errors: x_m and y_m of dead reckoning by the same odometry.
        beacon_errors_m: by name, from the first estimate on: distance of estimate and truth.
        beacon_nees: the same, with 2 degrees of freedom.
        nis: of each reading, and its degrees of freedom.
        truth, estimates, targets, believed: paths of the vehicle and of the target, x_m and y_m.
        places: by name at the end: mean, covariance and truth.
        joint_nees: at the end, of the pose and all static radios on the map, and its degrees of freedom.
    """

    pose_errors: list[tuple[float, float, float]] = field(default_factory=list)
    pose_nees: list[float] = field(default_factory=list)
    reckoned_errors: list[tuple[float, float]] = field(default_factory=list)
    beacon_errors_m: dict[str, list[float]] = field(default_factory=dict)
    beacon_nees: dict[str, list[float]] = field(default_factory=dict)
    nis: list[tuple[float, int]] = field(default_factory=list)
    distances_m: list[float] = field(default_factory=list)
    clearances_m: list[float] = field(default_factory=list)
    truth: list[tuple[float, float]] = field(default_factory=list)
    estimates: list[tuple[float, float]] = field(default_factory=list)
    targets: list[tuple[float, float]] = field(default_factory=list)
    believed: list[tuple[float, float]] = field(default_factory=list)
    places: dict[str, tuple[FloatArray, FloatArray, FloatArray]] = field(default_factory=dict)
    joint_nees: tuple[float, int] = (0.0, 0)


def run_radio(cfg: RadioConfig) -> RadioRun:
    """A whole run; a function of the configuration and its seed."""
    world, navigator, pilot, run = RadioWorld(cfg), RadioNavigator(cfg), BeaconPilot(cfg), RadioRun()
    drive, observation = HALT, cfg.observation
    for step in range(1, cfg.run.steps + 1):
        static, target = step % observation.every_steps == 0, step % observation.target_every_steps == 0
        frame = world.step(SimDriveCommand(*drive), cfg.run.step_s, static=static, target=target)
        t_s, distances_m = frame.time_s, frame.distances_m
        wheels = (odometry_of(cfg, t_s, *frame.wheels),)
        navigator.take(BeaconMeasurements(t_s, wheels, frame.packets, frame.sightings, distances_m))
        pose = navigator.slam.pose
        drive = pilot.drive(t_s, frame.wheels.interval_s, pose, navigator.target(t_s), distances_m)
        _note(run, world, navigator, cfg.follow.target)
    truths = _true_places(world, cfg.follow.target)
    for name, estimate in navigator.slam.beacons.items():
        run.places[str(name)] = (estimate.mean, estimate.covariance, np.array(truths[str(name)]))
    # Radios whose readings still wait are not on the map.
    placed = [name for name in world.beacons_m if name in navigator.slam.engine]
    mean, covariance = navigator.slam.joint(placed)
    truth = np.concatenate([world.pose, *(world.beacons_m[name] for name in placed)])
    run.joint_nees = _nees(mean - truth, covariance), truth.size
    return run


def _note(run: RadioRun, world: RadioWorld, navigator: RadioNavigator, target: str) -> None:
    true, slam = world.pose, navigator.slam
    pose, (reckoned_x_m, reckoned_y_m) = slam.pose, navigator.reckoned_m
    error = (pose.x_m - true.x_m, pose.y_m - true.y_m, wrap_pi(pose.heading_rad - true.heading_rad))
    run.pose_errors.append(error)
    run.pose_nees.append(_nees(np.array(error), slam.pose_covariance))
    run.reckoned_errors.append((reckoned_x_m - true.x_m, reckoned_y_m - true.y_m))
    run.nis += [(learned.nis, learned.size) for learned in slam.learned]
    run.clearances_m.append(world.clearance_m)
    run.truth.append(true[:2])
    run.estimates.append(pose[:2])
    truths = _true_places(world, target)
    for name, estimate in slam.beacons.items():
        off = estimate.mean - truths[str(name)]
        run.beacon_errors_m.setdefault(str(name), []).append(float(np.hypot(*off)))
        run.beacon_nees.setdefault(str(name), []).append(_nees(off, estimate.covariance))
    if world.target_m is not None:
        run.targets.append(world.target_m)
        run.distances_m.append(float(np.hypot(world.target_m[0] - true.x_m, world.target_m[1] - true.y_m)))
        believed = slam.beacons.get(target)
        run.believed.append((np.nan, np.nan) if believed is None else (believed.mean[0], believed.mean[1]))


def _true_places(world: RadioWorld, target: str) -> dict[str, tuple[float, float]]:
    moving = world.target_m
    return world.beacons_m if moving is None else {**world.beacons_m, target: moving}


def _nees(error: FloatArray, covariance: FloatArray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


SETTLED_SHARE = 0.3  # of a run: errors over time are counted after it, when radios have been found
_CURVE_EVERY = 10  # steps between the points of a curve
_HIT = float(chdtri(2, 0.1))
_BAND = 0.95

COLUMNS = (
    Column("beacons mean, m", "beacons_m.mean", ".3f"),
    Column("median", "beacons_m.median", ".3f"),
    Column("aligned mean, m", "beacons_aligned_m.mean", ".3f"),
    Column("in 90 % ellipses", "beacons_covered", ".3f"),
    Column("pose RMSE, m", "pose_m", ".3f"),
    Column("dead reckoning, m", "reckoned_m", ".3f"),
    Column("ratio", "pose_ratio", ".2f"),
    Column("heading RMSE, rad", "heading_rad", ".3f"),
    Column("NIS / rows", "nis", ".3f"),
    Column("95 % band", "nis_band"),
    Column("NEES / states", "nees", ".2f"),
    Column("95 % band", "nees_band"),
)
TARGET_COLUMNS = (
    Column("target RMSE, m", "target_m.mean", ".3f"),
    Column("median", "target_m.median", ".3f"),
    Column("aligned, m", "target_aligned_m.mean", ".3f"),
    Column("in 90 % ellipses", "target_covered", ".3f"),
    Column("nearest to it, m", "nearest_m", ".2f"),
    Column("runs with a collision", "collisions"),
)


def run_job(job: Job) -> JobOutcome:
    """One run."""
    return outcome_of(job.cfg, run_radio(job.cfg))


def outcome_of(cfg: RadioConfig, run: RadioRun) -> JobOutcome:
    """Figures of a run, and its errors over time."""
    truth, estimates = np.array(run.truth), np.array(run.estimates)
    reckoned = truth + np.array(run.reckoned_errors)
    (turn, shift), (reckoned_turn, reckoned_shift) = rigid(estimates, truth), rigid(reckoned, truth)
    finals = {name: place for name, place in run.places.items() if name != cfg.follow.target}
    names = list(finals)
    values: dict[str, Any] = {
        "beacons_m": {name: float(np.hypot(*(mean - true))) for name, (mean, _, true) in finals.items()},
        "beacons_aligned_m": {
            name: float(np.hypot(*(turn @ mean + shift - true))) for name, (mean, _, true) in finals.items()
        },
        "beacons_rmse_m": {name: _rms(np.array(run.beacon_errors_m[name])) for name in names},
        "beacons_hit": {name: run.beacon_nees[name][-1] < _HIT for name in names},
        "pose_m": _rms(estimates - truth),
        "pose_aligned_m": _rms(estimates @ turn.T + shift - truth),
        "reckoned_m": _rms(reckoned - truth),
        "reckoned_aligned_m": _rms(reckoned @ reckoned_turn.T + reckoned_shift - truth),
        "heading_rad": _rms(np.array(run.pose_errors)[:, 2]),
        "nis": [sum(nis for nis, _ in run.nis), sum(size for _, size in run.nis)],
        "nees": list(run.joint_nees),
        "collided": min(run.clearances_m) < 0.0,
    }
    arrays = {"beacons_m": _curve(np.array([_from_first(run.beacon_errors_m[name], len(truth)) for name in names]))}
    if run.targets:
        values |= _target_figures(cfg, run, turn, shift)
        arrays["target_m"] = _curve(_from_first(run.beacon_errors_m.get(cfg.follow.target, []), len(truth))[None])
    return JobOutcome(values, arrays)


def combine(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """The runs of a cell pooled: errors, coverage, consistency with the 95 % bands of their chi-squared sums."""
    del factors
    runs = [outcome.values for outcome in outcomes]

    def mean(key: str) -> float:
        return float(np.mean([run[key] for run in runs]))

    nis, rows = (float(sum(run["nis"][k] for run in runs)) for k in (0, 1))
    nees, states = (float(sum(run["nees"][k] for run in runs)) for k in (0, 1))
    values: dict[str, Any] = {
        "beacons_m": _spread([e for run in runs for e in run["beacons_m"].values()]),
        "beacons_aligned_m": _spread([e for run in runs for e in run["beacons_aligned_m"].values()]),
        "beacons_covered": float(np.mean([hit for run in runs for hit in run["beacons_hit"].values()])),
        "beacon_rmse_m": {
            name: float(np.mean([run["beacons_rmse_m"][name] for run in runs if name in run["beacons_rmse_m"]]))
            for name in runs[0]["beacons_rmse_m"]
        },
        "pose_m": mean("pose_m"),
        "reckoned_m": mean("reckoned_m"),
        "pose_ratio": mean("pose_m") / mean("reckoned_m"),
        "pose_aligned_m": mean("pose_aligned_m"),
        "reckoned_aligned_m": mean("reckoned_aligned_m"),
        "heading_rad": mean("heading_rad"),
        "nis": nis / max(rows, 1.0),
        "nis_band": _band(rows),
        "nees": nees / max(states, 1.0),
        "nees_band": _band(states),
        "collisions": sum(run["collided"] for run in runs),
    }
    if "target_m" in runs[0]:
        values |= {
            "target_m": _spread([run["target_m"] for run in runs]),
            "target_aligned_m": _spread([run["target_aligned_m"] for run in runs]),
            "target_covered": mean("target_covered"),
            "nearest_m": min(run["nearest_m"] for run in runs),
        }
    arrays = {name: np.stack([o.arrays[name] for o in outcomes if name in o.arrays]) for name in outcomes[0].arrays}
    return JobOutcome(values, arrays)


def rigid(points: FloatArray, onto: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation (2, 2) and shift (2,) that bring points (n, 2) onto others, by least squares (Umeyama 1991)."""
    centre, goal = points.mean(axis=0), onto.mean(axis=0)
    u, _, vt = np.linalg.svd((points - centre).T @ (onto - goal))
    sign = np.sign(np.linalg.det(vt.T @ u.T))
    rotation = np.asarray(vt.T @ np.diag((1.0, sign)) @ u.T)
    return rotation, goal - rotation @ centre


def _target_figures(cfg: RadioConfig, run: RadioRun, turn: FloatArray, shift: FloatArray) -> dict[str, Any]:
    first = round(SETTLED_SHARE * len(run.targets))
    truth, believed = np.array(run.targets)[first:], np.array(run.believed)[first:]
    known = np.isfinite(believed[:, 0])
    covered = np.array(run.beacon_nees.get(cfg.follow.target, [np.inf]))[-len(truth) :] < _HIT
    return {
        "target_m": _rms((believed - truth)[known]),
        "target_aligned_m": _rms((believed @ turn.T + shift - truth)[known]),
        "target_covered": float(np.mean(covered)),
        "nearest_m": min(run.distances_m),
    }


def _rms(errors: FloatArray) -> float:
    squares = errors**2 if errors.ndim == 1 else np.sum(errors**2, axis=1)
    return float(np.sqrt(np.mean(squares)))


def _spread(values: Sequence[float]) -> dict[str, float]:
    low, median, high = np.quantile(values, (0.1, 0.5, 0.9)).tolist()
    return {"mean": float(np.mean(values)), "median": median, "p10": low, "p90": high}


def _band(freedom: float) -> str:
    """Where the mean of so many normalised squares lies with 95 % probability."""
    if freedom < 1.0:
        return "-"
    low, high = (float(chdtri(freedom, share)) / freedom for share in (0.5 + 0.5 * _BAND, 0.5 - 0.5 * _BAND))
    return f"{low:.3f} to {high:.3f}"


def _from_first(errors: Sequence[float], steps: int) -> FloatArray:
    """Errors of all steps; NaN before the first estimate."""
    return np.concatenate([np.full(steps - len(errors), np.nan), np.asarray(errors, dtype=np.float64)])


def _curve(errors: FloatArray) -> FloatArray:
    """Mean over rows at every tenth step; NaN where none has a value."""
    picked = errors[:, ::_CURVE_EVERY]
    count = np.isfinite(picked).sum(axis=0)
    return np.asarray(np.where(count > 0, np.nansum(picked, axis=0) / np.maximum(count, 1), np.nan))
