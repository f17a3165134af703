"""The studies of radio beacons.

`radio-signals`: level against range, and bearings of the reflector, compared with Hevrdejs and Knoll 2017; every packet
is simulated.

`radio-cases`: the three experimental cases of the same slides. The slides print the errors of three drives in a
laboratory, but not the paths. Ours are three paths in the same room, among the same radios, with 5 dB of static
shadowing and reflected rays, measured with the rotating reflector.

`radio-follow`: a moving radio is mapped and followed, compared with Auth and Hovey 2018. `radio-slam`: EKF-SLAM among
four ZigBee radios, in two rooms, with slip and with shadowing.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import atan2, degrees, pi
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri

from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.estimation.path_loss import PathLoss
from ccatp.beacons.estimation.recording import Reading
from ccatp.beacons.estimation.signal_slam import ReflectorScan
from ccatp.beacons.links.messages import RadioScan
from ccatp.beacons.navigation import BeaconMeasurements, RadioNavigator, odometry_of, packets_of
from ccatp.beacons.pilot import BeaconPilot
from ccatp.beacons.rigid_motion import best_motion, rms_m
from ccatp.beacons.sim.radio import RadioDraws, SimDriveCommand, TruePose, TrueRadio
from ccatp.beacons.sim.radio_world import RadioWorld
from ccatp.beacons.steering import HALT
from ccatp.beacons.studies.radio_bound import RadioBound, TrueStep, radio_bound
from ccatp.core import FloatArray
from ccatp.filters.metrics import rms, wrapped
from ccatp.kinematics import wrap_pi
from ccatp.missions import Part
from ccatp.report.plots import INK
from ccatp.studies.campaign import Cell, CellResult, Factors, Job, JobOutcome, Study
from ccatp.studies.results import LIMIT, FigureRow, Measure, band, chi_square_band, colour, draw_ranges, grouped, plot

# -- a run with truth and estimates ------------------------------------------------------------------------------------


@dataclass(slots=True)
class RadioRun:
    """The result of a run; errors are estimate minus truth.

    ``steps``: true x, y and heading, the estimates of these, x and y by dead reckoning, true and estimated x and y of
    the moving radio (NaN without one), and the distance to the obstacles in the room; shape (k, 13).
    """

    steps: FloatArray
    # By name, from the first estimate on: error of the position, and NEES with 2 degrees of freedom.
    beacon_errors_m: Mapping[str, list[float]]
    beacon_nees: Mapping[str, list[float]]
    nis: list[tuple[float, int]]  # of each reading, and its degrees of freedom
    places: dict[str, tuple[FloatArray, FloatArray]]  # at the end: mean and truth
    joint_nees: tuple[float, int]  # at the end, of pose and static radios on the map; degrees of freedom
    bound: RadioBound | None


def run_radio(cfg: RadioConfig) -> RadioRun:
    """Simulate a run; the result depends only on the configuration and its seed."""
    world, navigator, pilot = RadioWorld(cfg), RadioNavigator(cfg), BeaconPilot(cfg)
    drive, observation, slam, target_name = HALT, cfg.observation, navigator.slam, cfg.follow.target
    truths: dict[str, tuple[float, float]] = {}
    driven, steps = list[TrueStep](), list[tuple[float, ...]]()
    errors_m, squares = defaultdict[str, list[float]](list), defaultdict[str, list[float]](list)
    nis: list[tuple[float, int]] = []
    for step in range(1, cfg.run.steps + 1):
        static, target = step % observation.every_steps == 0, step % observation.target_every_steps == 0
        frame = world.step(SimDriveCommand(*drive), cfg.run.step_s, static=static, target=target)
        t_s = frame.time_s
        wheels = (odometry_of(cfg, t_s, *frame.wheels),)
        navigator.take(BeaconMeasurements(t_s, wheels, frame.extras))
        target_sight, distances_m = navigator.target(t_s), frame.extras.distances
        drive = pilot.drive(t_s, frame.wheels.interval_s, slam.pose, target_sight, distances_m)
        driven.append(TrueStep(world.pose, wheels[0], world.target_m))
        truths = world.beacons_m | ({} if world.target_m is None else {target_name: world.target_m})
        nis += [(learned.nis, learned.size) for learned in slam.learned]
        for name, estimate in slam.beacons.items():
            off = estimate.mean - truths[str(name)]
            errors_m[str(name)].append(float(np.hypot(*off)))
            squares[str(name)].append(_nees(off, estimate.covariance))
        sighted = slam.beacons.get(target_name)
        believed = _NOWHERE if sighted is None else sighted.mean[:2].tolist()
        target_m = world.target_m or _NOWHERE
        steps.append((*world.pose, *slam.pose, *navigator.reckoned_m, *target_m, *believed, world.clearance_m))
    places = {str(name): (estimate.mean, np.array(truths[str(name)])) for name, estimate in slam.beacons.items()}
    bound = radio_bound(cfg, driven, list(world.beacons_m.values()), SETTLED_SHARE)
    # Radios without enough readings to be placed are not on the map.
    placed = [name for name in world.beacons_m if name in slam.engine]
    mean, covariance = slam.joint(placed)
    truth = np.concatenate([world.pose, *(world.beacons_m[name] for name in placed)])
    joint_nees = _nees(mean - truth, covariance), truth.size
    return RadioRun(np.array(steps), errors_m, squares, nis, places, joint_nees, bound)


LOADER = Part("ccatp.beacons.config.load:load_radio_config")
_NOWHERE = (np.nan, np.nan)


def _nees(error: FloatArray, covariance: FloatArray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


SETTLED_SHARE = 0.3  # of a run; errors over time are evaluated after it, when the radios are on the map
_CURVE_EVERY = 10  # steps of 0.1 s between the points of a curve
_POINT_S = 1.0
_HIT = float(chdtri(2, 0.1))

COLUMNS = """
    beacons_m: mean median
    beacons_aligned_m: mean
    beacons_rms_m beacons_bound_m beacons_covered pose_m reckoned_m pose_ratio heading_rad nis nis_band nees nees_band
"""
_MEANS = ("pose_m", "reckoned_m", "pose_aligned_m", "reckoned_aligned_m", "heading_rad", "target_covered")


def run_job(job: Job) -> JobOutcome:
    """Run one job: its statistics and its errors over time."""
    run, target = run_radio(job.cfg), job.cfg.follow.target
    truth, estimates, reckoned, targets, believed = (run.steps[:, k : k + 2].copy() for k in (0, 3, 6, 8, 10))
    motion, reckoned_motion = best_motion(estimates, truth), best_motion(reckoned, truth)
    finals = {name: place for name, place in run.places.items() if name != target}
    values: dict[str, Any] = {
        "beacons_m": {name: float(np.hypot(*(mean - true))) for name, (mean, true) in finals.items()},
        "beacons_aligned_m": {
            name: float(np.hypot(*(motion.moved(mean) - true))) for name, (mean, true) in finals.items()
        },
        "beacons_rmse_m": {name: rms(np.array(run.beacon_errors_m[name])) for name in finals},
        "beacons_hit": {name: run.beacon_nees[name][-1] < _HIT for name in finals},
        "pose_m": rms_m(estimates, truth),
        "pose_aligned_m": rms_m(motion.moved(estimates), truth),
        "reckoned_m": rms_m(reckoned, truth),
        "reckoned_aligned_m": rms_m(reckoned_motion.moved(reckoned), truth),
        "heading_rad": rms(wrapped(run.steps[:, 5] - run.steps[:, 2])),
        "nis": [sum(nis for nis, _ in run.nis), sum(size for _, size in run.nis)],
        "nees": list(run.joint_nees),
        "collided": bool(run.steps[:, 12].min() < 0.0),
        "beacons_rms_m": rms(np.array([np.hypot(*(mean - true)) for mean, true in finals.values()])),
    }
    if run.bound is not None:
        values |= {"beacons_bound_m": run.bound.beacons_m, "target_bound_m": run.bound.target_m}
    arrays = {"beacons_m": _curve([run.beacon_errors_m[name] for name in finals], len(truth))}
    if np.isfinite(targets[0, 0]):
        nearest_m = float(np.hypot(*(targets - truth).T).min())
        targets, believed = (places[round(SETTLED_SHARE * len(truth)) :] for places in (targets, believed))
        known = np.isfinite(believed[:, 0])
        covered = np.array(run.beacon_nees.get(target, [np.inf]))[-len(targets) :] < _HIT
        values |= {
            "target_m": rms_m(believed[known], targets[known]),
            "target_aligned_m": rms_m(motion.moved(believed)[known], targets[known]),
            "target_covered": float(np.mean(covered)),
            "nearest_m": nearest_m,
        }
        arrays["target_m"] = _curve([run.beacon_errors_m.get(target, [])], len(truth))
    return JobOutcome(values, arrays)


def combine(_: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Pool the runs of a cell: errors, coverage, and consistency with the 95 % bands of the chi-squared sums."""
    runs = [outcome.values for outcome in outcomes]

    def each(key: str) -> list[Any]:
        return [value for run in runs for value in run[key].values()]

    values: dict[str, Any] = {key: float(np.mean([run[key] for run in runs])) for key in _MEANS if key in runs[0]}
    values |= {
        "beacons_m": _spread(each("beacons_m")),
        "beacons_aligned_m": _spread(each("beacons_aligned_m")),
        "beacons_covered": float(np.mean(each("beacons_hit"))),
        "beacon_rmse_m": {
            name: float(np.mean([run["beacons_rmse_m"][name] for run in runs if name in run["beacons_rmse_m"]]))
            for name in runs[0]["beacons_rmse_m"]
        },
        "pose_ratio": values["pose_m"] / values["reckoned_m"],
        "collisions": sum(run["collided"] for run in runs),
    }
    for name in ("nis", "nees"):
        total, freedom = (float(sum(run[name][k] for run in runs)) for k in (0, 1))
        values[name], values[f"{name}_band"] = total / max(freedom, 1.0), _band(freedom)
    for name in ("beacons_rms_m", "beacons_bound_m", "target_bound_m"):
        if squares := [run[name] ** 2 for run in runs if run.get(name) is not None]:
            values[name] = float(np.sqrt(np.mean(squares)))
    if "target_m" in runs[0]:
        values |= {name: _spread([run[name] for run in runs]) for name in ("target_m", "target_aligned_m")}
        values["nearest_m"] = min(run["nearest_m"] for run in runs)
    arrays = {name: np.stack([o.arrays[name] for o in outcomes if name in o.arrays]) for name in outcomes[0].arrays}
    return JobOutcome(values, arrays)


def _spread(values: Sequence[float]) -> dict[str, float]:
    low, median, high = np.quantile(values, (0.1, 0.5, 0.9)).tolist()
    return {"mean": float(np.mean(values)), "median": median, "p10": low, "p90": high}


def _band(freedom: float) -> str:
    """The 95 % interval of the mean of ``freedom`` normalised squares."""
    if freedom < 1.0:
        return "-"
    low, high = chi_square_band(freedom)
    return f"{low:.3f} to {high:.3f}"


def _curve(errors_m: Sequence[Sequence[float]], steps: int) -> FloatArray:
    """Mean over series that end with the run, at every tenth of ``steps``; NaN before the first series begins."""
    rows = np.full((len(errors_m), steps), np.nan)
    for row, errors in zip(rows, errors_m, strict=True):
        row[steps - len(errors) :] = errors
    picked = rows[:, ::_CURVE_EVERY]
    count = np.isfinite(picked).sum(axis=0)
    return np.asarray(np.where(count > 0, np.nansum(picked, axis=0) / np.maximum(count, 1), np.nan))


def _draw_errors(results: Sequence[CellResult], name: str, label: str, keys: Sequence[str], stem: Path) -> None:
    """Median and 10 to 90 % over the runs of an array (runs, points); a panel for each level of the first key."""
    groups = grouped([result for result in results if name in result.arrays], keys[0])
    if not groups:
        return
    with plot(stem, 5.2 * len(groups) + 0.5, 4.2, 1, len(groups), sharey=True) as panels:
        for axes, ((group,), cells) in zip(panels, groups.items(), strict=True):
            for index, result in enumerate(cells):
                runs = result.arrays[name]
                ends = np.full((3, runs.shape[1]), np.nan)
                known = np.isfinite(runs).any(axis=0)  # some run has an estimate
                ends[:, known] = np.nanquantile(runs[:, known], (0.1, 0.5, 0.9), axis=0)
                names = (f"every {result.factors[k]}" if k == "every" else str(result.factors[k]) for k in keys[1:])
                time_s = np.arange(runs.shape[1]) * _POINT_S
                band(axes, time_s, ends, colour(index), "-" if index < 6 else "--", ", ".join(names))
            axes.set(xlabel="time, s", title=f"{keys[0]}: {group}", ylim=(0.0, None))
            axes.legend(frameon=False, fontsize=7)
        panels[0].set_ylabel(label)


RadioStudy = partial(
    Study,
    run_job=run_job,
    combine=combine,
    columns=COLUMNS,
    mirrors=(),
    runs=50,
    loader=LOADER,
)

# -- radio-signals ----------------------------------------------------------------------------------------------------

# Slide "Initial Experimental Results": mean RSSI, and the range from it with P_ref = -33 dBm and an exponent of 2.
RANGES_M = (0.5, 1.0, 2.0, 3.0)
_RANGE_NAMES = [f"{range_m:g} m" for range_m in RANGES_M]
PRINTED_DBM = (-23.0, -33.103, -38.308, -41.974)
PRINTED_M = (0.3162, 1.0119, 1.8425, 2.81)
# The same slide: beacons in the corners of the room, robot at (1, 1) m; printed errors of the bearings, degrees.
CORNERS_M = {"b1": (0.0, 0.0), "b2": (0.0, 3.0), "b3": (3.0, 0.0), "b4": (3.0, 3.0)}
PRINTED_DEG = {"b1": 18.0, "b2": 21.0, "b3": 3.0, "b4": 0.0}
ROBOT = TruePose(1.0, 1.0, 0.0)
TURNS = 20  # of the reflector, at one place, in a run
CONDITIONS: dict[str, dict[str, object]] = {
    "white 2 dB": {},
    "shadowing 5 dB": {"sim.radio.shadowing_sigma_db": 5.0},
    "shadowing 5 dB, reflections": {"sim.radio.shadowing_sigma_db": 5.0, "sim.radio.multipath_paths": 3},
}


def run_signals(job: Job) -> JobOutcome:
    """Turns of the reflector at one place; shadowing and reflections are drawn for each seed."""
    cfg, place = job.cfg, str(job.factors["place"])
    at_m = CORNERS_M.get(place) or (ROBOT.x_m + float(place.removesuffix(" m")), ROBOT.y_m)
    results = _turns(cfg, at_m)
    dx_m, dy_m = at_m[0] - ROBOT.x_m, at_m[1] - ROBOT.y_m
    true_rad, range_m = atan2(dy_m, dx_m) - ROBOT.heading_rad, float(np.hypot(dx_m, dy_m))
    model = PathLoss(cfg.path_loss.reference_dbm, cfg.path_loss.exponent, cfg.sim.radio.white_sigma_db)
    level_dbm = float(np.mean([result.rssi_dbm for result in results]))
    errors = [wrap_pi(result.bearing_rad - true_rad) for result in results if result.bearing_rad is not None]
    values: dict[str, Any] = {
        "range_m": range_m,
        "level_dbm": level_dbm,
        "model_dbm": model.level_dbm(range_m),
        "estimate_m": model.median_range_m(level_dbm),
        "bearing_deg": degrees(true_rad) % 360.0,
        "bearing_errors_deg": [degrees(error) for error in errors],
    }
    return JobOutcome(values)


def combine_signals(_: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Means and spreads over the seeds."""
    runs = [outcome.values for outcome in outcomes]
    errors = np.array([error for run in runs for error in run["bearing_errors_deg"]])
    ranges, levels_dbm = (np.array([run[key] for run in runs]) for key in ("estimate_m", "level_dbm"))
    values: dict[str, Any] = {
        **{key: runs[0][key] for key in ("range_m", "model_dbm", "bearing_deg")},
        "level_dbm": float(np.mean(levels_dbm)),
        "level_sigma_db": float(np.std(levels_dbm)),
        "estimate_m": float(np.mean(ranges)),
        "range_rms_m": rms(ranges - runs[0]["range_m"]),
        "bearing_rms_deg": rms(errors),
        "bearing_median_deg": float(np.median(np.abs(errors))),
    }
    return JobOutcome(values)


def printed_signals(factors: Factors) -> Mapping[str, Any]:
    """The values that 2017 prints for a place."""
    place = str(factors["place"])
    if place in CORNERS_M:
        return {"bearing_error_deg": PRINTED_DEG[place]}
    index = _RANGE_NAMES.index(place)
    error_m = RANGES_M[index] - PRINTED_M[index]
    return {"level_dbm": PRINTED_DBM[index], "estimate_m": PRINTED_M[index], "error_m": error_m}


def draw_signals(results: Sequence[CellResult], out: Path) -> None:
    """Figure ``radio_signals``: level against range, and bearing error by beacon: printed, model, ours."""
    at, ranges = np.arange(len(CORNERS_M)), np.array(RANGES_M)
    mark: dict[str, Any] = {"color": LIMIT, "markersize": 8, "markeredgewidth": 2, "label": "2017"}
    with plot(out / "radio_signals", 10.0, 4.0, 1, 2) as (left, right):
        for index, ((condition,), cells) in enumerate(grouped(results, "condition").items()):
            found = {cell.factors["place"]: cell.values for cell in cells}
            if found.keys() >= set(_RANGE_NAMES):
                rows = [found[place] for place in _RANGE_NAMES]
                if index == 0:
                    left.plot(ranges, [row["model_dbm"] for row in rows], color=INK, linewidth=1.2, label="model")
                    left.plot(ranges, PRINTED_DBM, "x", **mark)
                levels_dbm, sigmas = ([row[key] for row in rows] for key in ("level_dbm", "level_sigma_db"))
                look: dict[str, Any] = {"fmt": "o", "color": colour(index), "markersize": 4, "capsize": 2}
                left.errorbar(ranges + 0.03 * (index - 1), levels_dbm, sigmas, label=f"ours: {condition}", **look)
            if found.keys() >= CORNERS_M.keys():
                heights = [found[place]["bearing_rms_deg"] for place in CORNERS_M]
                right.bar(at + 0.2 * (index - 1), heights, 0.18, color=colour(index), label=f"ours, RMS: {condition}")
                if index == 0:
                    right.plot(at, list(PRINTED_DEG.values()), "x", **mark)
        right.set_xticks(at, list(CORNERS_M))
        right.set(ylabel="error of the bearing, deg", title="bearing of the strongest reading")
        left.set(xlabel="range, m", ylabel="level, dBm", title="mean level of a scan")
        for axes in (left, right):
            axes.legend(frameon=False, fontsize=7)


def _turns(cfg: RadioConfig, sender_m: tuple[float, float]) -> list[Reading]:
    draws = RadioDraws(*(np.random.default_rng([cfg.run.seed, stream]) for stream in (0, 1)))
    size_m = cfg.workspace.size_m
    radio = TrueRadio(cfg.path_loss.reference_dbm, cfg.sim.radio, size_m, (), cfg.scan.readings, draws)
    scan = ReflectorScan(cfg.scan)
    headings = np.random.default_rng([cfg.run.seed, 2]).uniform(-pi, pi, TURNS) / cfg.scan.readings
    found = []
    for offset_rad in headings.tolist():  # random headings, so that the beacon is not aligned with a reflector step
        levels_dbm = radio.scan(ROBOT._replace(heading_rad=offset_rad), sender_m)
        for result in scan.results(0.0, packets_of(RadioScan(0.0, scan.step_rad, {"radio": levels_dbm}))):
            straight = None if result.bearing_rad is None else result.bearing_rad + offset_rad
            found.append(result._replace(bearing_rad=straight))
    return found


RADIO_SIGNALS = RadioStudy(
    cells=lambda: [
        Cell({"place": place, "condition": condition}, dict(keys))
        for condition, keys in CONDITIONS.items()
        for place in (*_RANGE_NAMES, *CORNERS_M)
    ],
    run_job=run_signals,
    combine=combine_signals,
    columns="""
        range_m printed.level_dbm model_dbm level_dbm level_sigma_db
        printed.estimate_m estimate_m printed.error_m range_rms_m
        bearing_deg printed.bearing_error_deg bearing_rms_deg bearing_median_deg
    """,
    draw=draw_signals,
    defaults={"system": "zigbee"},
    runs=40,
    published=printed_signals,
)

# -- radio-cases ------------------------------------------------------------------------------------------------------

# RMSE, RMSE of the heading, RMSE of the beacons 1 to 4: table of the slide "Discussion".
CASES_PRINTED = {
    "I": (0.04, 0.03, 0.28, 0.67, 0.39, 0.53),
    "II": (0.05, 0.04, 1.03, 0.88, 0.53, 0.33),
    "III": (0.06, 0.04, 0.41, 0.36, 0.34, 0.66),
}
PATHS: dict[str, list[list[float]]] = {
    "I": [[0.8, 0.8], [2.2, 0.8], [2.2, 2.2], [0.8, 2.2]],
    "II": [[0.8, 0.8], [2.2, 2.2], [0.8, 2.2], [2.2, 0.8]],
    "III": [[2.2, 0.8], [1.5, 2.2], [0.8, 0.8]],
}
SHADOW: dict[str, object] = {"sim.radio.shadowing_sigma_db": 5.0, "path_loss.shadowing_sigma_db": 5.0}
RADIO: dict[str, object] = {
    **SHADOW,
    "sim.radio.scan": "reflector",
    "sim.radio.multipath_paths": 3,
    "estimator.shadowing": "map",
}
NAMES = ("pose_m", "heading_rad", "beacon1", "beacon2", "beacon3", "beacon4")


def draw_cases(results: Sequence[CellResult], out: Path) -> None:
    """Figure ``radio_cases``: the errors of pose and beacons of each case, ours (dot) and printed (mark)."""
    shown = {"pose_m": "pose_m", **{name: f"beacon_rmse_m.{name}" for name in NAMES[2:]}}
    measures = [
        Measure(f"{name}, RMSE, m", (key, key), key, f"printed.{name}", is_log=False) for name, key in shown.items()
    ]
    rows = [FigureRow(f"case {result.factors['case']}", result) for result in results]
    draw_ranges(rows, measures, "Mean of the runs (dot), 2017 (mark)", out / "radio_cases")


RADIO_CASES = RadioStudy(
    cells=lambda: [Cell({"case": case}, {**RADIO, "workspace.waypoints_m": path}) for case, path in PATHS.items()],
    columns=f"""
        printed: {" ".join(NAMES)}
        beacon_rmse_m: {" ".join(NAMES[2:])}
        {COLUMNS.strip()}
    """,
    draw=draw_cases,
    defaults={"system": "zigbee"},
    published=lambda factors: dict(zip(NAMES, CASES_PRINTED[str(factors["case"])], strict=True)),
)

# -- radio-follow -----------------------------------------------------------------------------------------------------

# Figures 3.2 to 3.5 of 2018, as summarized in its text.
FOLLOW_PRINTED: dict[str, dict[str, str]] = {
    "ideal": {"target_m": "0.20", "beacons_m": "0.20 to 0.30"},
    "restrictive": {"target_m": "about 0.35", "beacons_m": "0.20 to 0.30"},
}
CASES = {"ideal": 1, "restrictive": 30}
FOLLOW_CONDITIONS: dict[str, dict[str, object]] = {
    "as printed": {},
    "target stays": {"sim.target.speed_m_s": 0.0},
    "PI speed": {"control.speed_mode": "pi"},
    "constant speed": {"control.speed_mode": "constant"},
    "obstacle in the waves": {
        "sim.radio.obstacle_loss_db": 6.0,
        "path_loss.shadowing_sigma_db": 3.0,
        "path_loss.shadowing_length_m": 0.5,
        "estimator.shadowing": "map",
    },
    "shadowing 5 dB": {**SHADOW, "estimator.shadowing": "map"},
}


def draw_follow(results: Sequence[CellResult], out: Path) -> None:
    """Figures ``radio_follow_target`` and ``radio_follow_beacons``: errors over time."""
    keys = ("case", "condition")
    _draw_errors(results, "target_m", "error of the target, m", keys, out / "radio_follow_target")
    _draw_errors(results, "beacons_m", "error of the beacons, m", keys, out / "radio_follow_beacons")


RADIO_FOLLOW = RadioStudy(
    cells=lambda: [
        Cell({"case": case, "condition": condition}, {**keys, "observation.target_every_steps": every})
        for condition, keys in FOLLOW_CONDITIONS.items()
        for case, every in CASES.items()
    ],
    columns=f"""
        printed: target_m beacons_m
        target_m: mean median
        target_aligned_m: mean
        target_bound_m target_covered nearest_m collisions
        {COLUMNS.strip()}
    """,
    draw=draw_follow,
    defaults={"system": "follow"},
    published=lambda factors: FOLLOW_PRINTED[str(factors["case"])] if factors["condition"] == "as printed" else {},
)

# -- radio-slam -------------------------------------------------------------------------------------------------------

SLIP: dict[str, object] = {"sim.vehicle.slip": 0.05, "odometry.slip_sigma": 0.05}
DRIFT: dict[str, object] = {"sim.vehicle.heading_drift_rad_s": 0.0087, "odometry.heading_drift_sigma_rad_s": 0.01}
SLAM_CONDITIONS: dict[str, dict[str, object]] = {
    "white": {},
    "slip 5 %": SLIP,
    "slip 5 %, drift 0.5 deg/s": {**SLIP, **DRIFT},
    "shadowing 5 dB, mapped": {**SHADOW, "estimator.shadowing": "map"},
    "shadowing 5 dB, as white": {**SHADOW, "estimator.shadowing": "white"},
    "shadowing 5 dB, ignored": {**SHADOW, "estimator.shadowing": "none"},
}
EVERY = (30, 1)


def room_of(size_m: float, margin_m: float) -> dict[str, object]:
    """Overrides for a square room: beacons in its corners, and a square loop ``margin_m`` from the walls."""
    far_m = size_m - margin_m
    corners = {"beacon2": (0.0, size_m), "beacon3": (size_m, 0.0), "beacon4": (size_m, size_m)}
    return {
        "workspace.size_m": [size_m, size_m],
        "workspace.waypoints_m": [[margin_m, margin_m], [far_m, margin_m], [far_m, far_m], [margin_m, far_m]],
        "start.x_m": margin_m,
        "start.y_m": margin_m,
        **{f"sim.beacons.{name}.x_m": x_m for name, (x_m, _) in corners.items()},
        **{f"sim.beacons.{name}.y_m": y_m for name, (_, y_m) in corners.items()},
    }


ROOMS = {"3 m": room_of(3.0, 0.8), "5 m": room_of(5.0, 0.8)}


def slam_cells() -> Sequence[Cell]:
    """All conditions in the small room, with readings every 30 steps and every step; two of them in the large room."""
    return [
        Cell(
            {"room": room, "condition": condition, "every": every},
            {**keys, **ROOMS[room], "observation.every_steps": every},
        )
        for room in ROOMS
        for every in EVERY
        for condition, keys in SLAM_CONDITIONS.items()
        if room == "3 m" or (every == EVERY[0] and condition in {"white", "shadowing 5 dB, mapped"})
    ]


def draw_slam(results: Sequence[CellResult], out: Path) -> None:
    """Figure ``radio_slam``: the beacons' error over time."""
    _draw_errors(results, "beacons_m", "error of the beacons, m", ("room", "condition", "every"), out / "radio_slam")


RADIO_SLAM = RadioStudy(
    cells=slam_cells,
    draw=draw_slam,
    defaults={"system": "zigbee"},
)
