"""The studies of radio beacons.

`radio-signals`: levels against range and bearings of the reflector, beside Hevrdejs and Knoll 2017. A turn of the
reflector is simulated packet by packet and read as on the robot: the level is that next to the strongest reading, the
bearing that of the strongest reading.

`radio-cases`: the three experimental cases of Hevrdejs and Knoll 2017, side by side with ours. The slides print the
errors of three drives in a laboratory and nothing of the drives. Ours are three paths in the same room, among the same
radios with 5 dB of static shadowing and reflected rays, read through the turning reflector.

`radio-follow`: a moving radio is mapped and followed, side by side with Auth and Hovey 2018.

`radio-slam`: EKF-SLAM among four ZigBee radios, in two rooms, with slip and with shadowing.
"""

from collections.abc import Sequence
from math import atan2, degrees, pi
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.beacons.slam.path_loss import PathLoss
from ccatp.beacons.slam.signal_slam import ReflectorScan, ScanResult
from ccatp.config.beacon_models import RadioConfig
from ccatp.core import wrap_pi
from ccatp.report.plots import INK, QUIET
from ccatp.sim.radio import TruePose, TrueRadio
from ccatp.studies.campaign import Cell, CellResult, Column, Factors, Job, JobOutcome, Study
from ccatp.studies.radio_runs import COLUMNS, TARGET_COLUMNS, combine, run_job
from ccatp.studies.results import LIMIT, colour, plot

_POINT_S = 1.0  # between the points of a curve: ten steps of 0.1 s

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
    """Turns of the reflector at one place, with shadowing and reflections of their own for each seed."""
    cfg, place = job.cfg, str(job.factors["place"])
    at_m = CORNERS_M.get(place) or (ROBOT.x_m + float(place.removesuffix(" m")), ROBOT.y_m)
    results = _turns(cfg, at_m)
    dx_m, dy_m = at_m[0] - ROBOT.x_m, at_m[1] - ROBOT.y_m
    true_rad = atan2(dy_m, dx_m) - ROBOT.heading_rad
    loss = cfg.path_loss
    model = PathLoss(loss.reference_dbm, loss.exponent, cfg.sim.radio.white_sigma_db)
    level_dbm = float(np.mean([result.rssi_dbm for result in results]))
    errors = [wrap_pi(result.bearing_rad - true_rad) for result in results if result.bearing_rad is not None]
    values: dict[str, Any] = {
        "range_m": float(np.hypot(dx_m, dy_m)),
        "level_dbm": level_dbm,
        "model_dbm": model.level_dbm(float(np.hypot(dx_m, dy_m))),
        "estimate_m": model.median_range_m(level_dbm),
        "bearing_deg": degrees(true_rad) % 360.0,
        "bearing_errors_deg": [degrees(error) for error in errors],
        "without_bearing": len(results) - len(errors),
    }
    return JobOutcome(values, {})


def combine_signals(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Means and spreads over the seeds, and what 2017 prints."""
    place = str(factors["place"])
    runs = [outcome.values for outcome in outcomes]
    errors = np.array([error for run in runs for error in run["bearing_errors_deg"]])
    ranges = np.array([run["estimate_m"] for run in runs])
    printed: dict[str, float] = {}
    if place in CORNERS_M:
        printed["bearing_error_deg"] = PRINTED_DEG[place]
    else:
        index = _RANGE_NAMES.index(place)
        printed = {"level_dbm": PRINTED_DBM[index], "estimate_m": PRINTED_M[index]}
        printed["error_m"] = RANGES_M[index] - PRINTED_M[index]
    values: dict[str, Any] = {
        "range_m": runs[0]["range_m"],
        "level_dbm": float(np.mean([run["level_dbm"] for run in runs])),
        "level_sigma_db": float(np.std([run["level_dbm"] for run in runs])),
        "model_dbm": runs[0]["model_dbm"],
        "estimate_m": float(np.mean(ranges)),
        "range_rms_m": float(np.sqrt(np.mean((ranges - runs[0]["range_m"]) ** 2))),
        "bearing_deg": runs[0]["bearing_deg"],
        "bearing_rms_deg": float(np.sqrt(np.mean(errors**2))),
        "bearing_median_deg": float(np.median(np.abs(errors))),
        "printed": printed,
    }
    return JobOutcome(values)


def draw_signals(results: Sequence[CellResult], out: Path) -> None:
    """Figure ``radio_signals``: level over range and error of the bearing by beacon: printed, model, ours."""
    by_key = {(result.factors["condition"], result.factors["place"]): result.values for result in results}
    at = np.arange(len(CORNERS_M))
    with plot(out / "radio_signals", 10.0, 4.0, 1, 2) as (_, (left, right)):
        for index, condition in enumerate(dict.fromkeys(result.factors["condition"] for result in results)):
            rows = [by_key[condition, place] for place in _RANGE_NAMES if (condition, place) in by_key]
            if len(rows) == len(RANGES_M):
                ranges = np.array(RANGES_M)
                if index == 0:
                    printed = [row["printed"]["level_dbm"] for row in rows]
                    left.plot(ranges, [row["model_dbm"] for row in rows], color=INK, linewidth=1.2, label="model")
                    left.plot(ranges, printed, "x", color=LIMIT, markersize=8, markeredgewidth=2, label="2017")
                levels, sigmas = ([row[key] for row in rows] for key in ("level_dbm", "level_sigma_db"))
                look: dict[str, Any] = {"fmt": "o", "color": colour(index), "markersize": 4, "capsize": 2}
                left.errorbar(ranges + 0.03 * (index - 1), levels, sigmas, label=f"ours: {condition}", **look)
            rows = [by_key[condition, corner] for corner in CORNERS_M if (condition, corner) in by_key]
            if len(rows) == len(CORNERS_M):
                heights = [row["bearing_rms_deg"] for row in rows]
                right.bar(at + 0.2 * (index - 1), heights, 0.18, color=colour(index), label=f"ours, RMS: {condition}")
            if index == 0:
                printed = [row["printed"]["bearing_error_deg"] for row in rows]
                right.plot(at[: len(rows)], printed, "x", color=LIMIT, markersize=8, markeredgewidth=2, label="2017")
        right.set_xticks(at, list(CORNERS_M))
        right.set(ylabel="error of the bearing, deg", title="bearing of the strongest reading")
        left.set(xlabel="range, m", ylabel="level, dBm", title="mean level of a scan")
        for axes in (left, right):
            axes.legend(frameon=False, fontsize=7)


def _turns(cfg: RadioConfig, sender_m: tuple[float, float]) -> list[ScanResult]:
    places, noise = (np.random.default_rng([cfg.run.seed, stream]) for stream in (0, 1))
    radio = TrueRadio(
        "radio", cfg.path_loss.reference_dbm, cfg.sim.radio, cfg.workspace.size_m, (), cfg.scan.readings, places, noise
    )
    scan = ReflectorScan(cfg.scan)
    headings = np.random.default_rng([cfg.run.seed, 2]).uniform(-pi, pi, TURNS) / cfg.scan.readings
    found = []
    for offset_rad in headings.tolist():  # the robot never stands quite straight: steps and beacon are not in line
        for result in scan.results(radio.scan(ROBOT._replace(heading_rad=offset_rad), sender_m)):
            straight = None if result.bearing_rad is None else result.bearing_rad + offset_rad
            found.append(result._replace(bearing_rad=straight))
    return found


RADIO_SIGNALS = Study(
    name="radio-signals",
    title="Levels and bearings of ZigBee radios",
    cells=lambda: [
        Cell({"place": place, "condition": condition}, dict(keys))
        for condition, keys in CONDITIONS.items()
        for place in (*_RANGE_NAMES, *CORNERS_M)
    ],
    run_job=run_signals,
    combine=combine_signals,
    columns=(
        Column("range, m", "range_m", ".2f"),
        Column("2017: level, dBm", "printed.level_dbm", ".1f"),
        Column("model, dBm", "model_dbm", ".1f"),
        Column("ours, dBm", "level_dbm", ".1f"),
        Column("±, dB", "level_sigma_db", ".1f"),
        Column("2017: range, m", "printed.estimate_m", ".2f"),
        Column("ours, m", "estimate_m", ".2f"),
        Column("2017: error, m", "printed.error_m", ".2f"),
        Column("ours RMS, m", "range_rms_m", ".2f"),
        Column("bearing, deg", "bearing_deg", ".0f"),
        Column("2017: error, deg", "printed.bearing_error_deg", ".0f"),
        Column("ours RMS, deg", "bearing_rms_deg", ".1f"),
        Column("ours median, deg", "bearing_median_deg", ".1f"),
    ),
    draw=draw_signals,
    defaults={"system": "zigbee"},
    mirrors=(),
    runs=40,
    is_radio=True,
)

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
RADIO: dict[str, object] = {
    "sim.radio.scan": "reflector",
    "sim.radio.shadowing_sigma_db": 5.0,
    "sim.radio.multipath_paths": 3,
    "path_loss.shadowing_sigma_db": 5.0,
    "estimator.shadowing": "map",
}
NAMES = ("pose_m", "heading_rad", "beacon1", "beacon2", "beacon3", "beacon4")


def combine_cases(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """The runs pooled, and what 2017 prints."""
    values, arrays = combine(factors, outcomes)
    return JobOutcome({**values, "printed": dict(zip(NAMES, CASES_PRINTED[str(factors["case"])], strict=True))}, arrays)


def draw_cases(results: Sequence[CellResult], out: Path) -> None:
    """Figure ``radio_cases``: bars of the printed errors and of ours, for pose and beacons of each case."""
    shown = [name for name in NAMES if name != "heading_rad"]
    at = np.arange(len(shown))
    with plot(out / "radio_cases", 3.4 * len(results) + 0.4, 3.8, 1, len(results), sharey=True) as (_, panels):
        for axes, result in zip(panels, results, strict=True):
            ours = [result.values["pose_m"], *(result.values["beacon_rmse_m"].get(n, np.nan) for n in shown[1:])]
            printed = [result.values["printed"][name] for name in shown]
            axes.bar(at - 0.2, printed, 0.38, color=QUIET, label="2017, printed")
            axes.bar(at + 0.2, ours, 0.38, color=colour(0), label="ours, mean of the runs")
            axes.set_xticks(at, ["pose", *(name.replace("beacon", "b") for name in shown[1:])])
            axes.set_title(f"case {result.factors['case']}")
        panels[0].set_ylabel("RMSE, m")
        panels[-1].legend(frameon=False, fontsize=8)


def _columns() -> list[Column]:
    columns = [
        Column("2017: RMSE, m", "printed.pose_m", ".2f"),
        Column("ours", "pose_m", ".3f"),
        Column("2017: RMSE heading, rad", "printed.heading_rad", ".2f"),
        Column("ours", "heading_rad", ".3f"),
    ]
    for name in NAMES[2:]:
        columns += [
            Column(f"2017: {name}, m", f"printed.{name}", ".2f"),
            Column("ours", f"beacon_rmse_m.{name}", ".2f"),
        ]
    return columns + [column for column in COLUMNS if column.key not in {"pose_m", "heading_rad"}]


RADIO_CASES = Study(
    name="radio-cases",
    title="Cases I to III of 2017",
    cells=lambda: [Cell({"case": case}, {**RADIO, "workspace.waypoints_m": path}) for case, path in PATHS.items()],
    run_job=run_job,
    combine=combine_cases,
    columns=_columns(),
    draw=draw_cases,
    defaults={"system": "zigbee"},
    mirrors=(),
    runs=50,
    is_radio=True,
)

# Figures 3.2 to 3.5 of 2018, as its text sums them up.
FOLLOW_PRINTED: dict[str, dict[str, str]] = {
    "ideal": {"target_m": "0.20", "beacons_m": "0.20 to 0.30"},
    "restrictive": {"target_m": "about 0.35", "beacons_m": "0.20 to 0.30"},
}
CASES = {"ideal": 1, "restrictive": 30}
FOLLOW_SHADOW: dict[str, object] = {
    "sim.radio.shadowing_sigma_db": 5.0,
    "path_loss.shadowing_sigma_db": 5.0,
    "estimator.shadowing": "map",
}
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
    "shadowing 5 dB": FOLLOW_SHADOW,
}


def combine_follow(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """The runs pooled, and what 2018 prints."""
    values, arrays = combine(factors, outcomes)
    is_printed = factors["condition"] == "as printed"
    printed: dict[str, Any] = dict(FOLLOW_PRINTED[str(factors["case"])]) if is_printed else {}
    return JobOutcome({**values, "printed": printed}, arrays)


def draw_follow(results: Sequence[CellResult], out: Path) -> None:
    """Figures ``radio_follow_target`` and ``radio_follow_beacons``: errors over time."""
    keys = ("case", "condition")
    _draw_errors(results, "target_m", "error of the target, m", keys, out / "radio_follow_target")
    _draw_errors(results, "beacons_m", "error of the beacons, m", keys, out / "radio_follow_beacons")


RADIO_FOLLOW = Study(
    name="radio-follow",
    title="A moving radio followed",
    cells=lambda: [
        Cell({"case": case, "condition": condition}, {**keys, "observation.target_every_steps": every})
        for condition, keys in FOLLOW_CONDITIONS.items()
        for case, every in CASES.items()
    ],
    run_job=run_job,
    combine=combine_follow,
    columns=(
        Column("2018: target, m", "printed.target_m"),
        *TARGET_COLUMNS,
        Column("2018: beacons, m", "printed.beacons_m"),
        *COLUMNS,
    ),
    draw=draw_follow,
    defaults={"system": "follow"},
    mirrors=(),
    runs=50,
    is_radio=True,
)

SLIP: dict[str, object] = {"sim.vehicle.slip": 0.05, "odometry.slip_sigma": 0.05}
DRIFT: dict[str, object] = {"sim.vehicle.heading_drift_rad_s": 0.0087, "odometry.heading_drift_sigma_rad_s": 0.01}
SLAM_SHADOW: dict[str, object] = {"sim.radio.shadowing_sigma_db": 5.0, "path_loss.shadowing_sigma_db": 5.0}
SLAM_CONDITIONS: dict[str, dict[str, object]] = {
    "white": {},
    "slip 5 %": SLIP,
    "slip 5 %, drift 0.5 deg/s": {**SLIP, **DRIFT},
    "shadowing 5 dB, mapped": {**SLAM_SHADOW, "estimator.shadowing": "map"},
    "shadowing 5 dB, as white": {**SLAM_SHADOW, "estimator.shadowing": "white"},
    "shadowing 5 dB, ignored": {**SLAM_SHADOW, "estimator.shadowing": "none"},
}
EVERY = (30, 1)


def room_of(size_m: float, margin_m: float) -> dict[str, object]:
    """Overrides for a square room: beacons in its corners, a square loop that keeps so far from the walls."""
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
    """Rooms times conditions at every 30 steps; in the small room at every step, too."""
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


def _draw_errors(results: Sequence[CellResult], name: str, label: str, keys: Sequence[str], stem: Path) -> None:
    """Median over the runs of an error over time, with 10 to 90 %; a panel for each level of the first key.

    Args:
        results: cells with the array ``name`` of shape (runs, points).
        keys: factors that distinguish the cells; the first one makes the panels.
    """
    shown = [result for result in results if name in result.arrays]
    if not shown:
        return
    groups = list(dict.fromkeys(result.factors[keys[0]] for result in shown))
    with plot(stem, 5.2 * len(groups) + 0.5, 4.2, 1, len(groups), sharey=True) as (_, panels):
        for axes, group in zip(panels, groups, strict=True):
            cells = [result for result in shown if result.factors[keys[0]] == group]
            for index, result in enumerate(cells):
                runs = result.arrays[name]
                low, median, high = np.full((3, runs.shape[1]), np.nan)
                known = np.isfinite(runs).any(axis=0)  # some run has an estimate
                low[known], median[known], high[known] = np.nanquantile(runs[:, known], (0.1, 0.5, 0.9), axis=0)
                time_s = np.arange(median.size) * _POINT_S
                names = (f"every {result.factors[k]}" if k == "every" else str(result.factors[k]) for k in keys[1:])
                shade, style = colour(index), "-" if index < 6 else "--"
                axes.plot(time_s, median, color=shade, linestyle=style, linewidth=1.4, label=", ".join(names))
                axes.fill_between(time_s, low, high, color=shade, alpha=0.08, linewidth=0)
            axes.set(xlabel="time, s", title=f"{keys[0]}: {group}", ylim=(0.0, None))
            axes.legend(frameon=False, fontsize=7)
        panels[0].set_ylabel(label)


RADIO_SLAM = Study(
    name="radio-slam",
    title="EKF-SLAM among ZigBee radios",
    cells=slam_cells,
    run_job=run_job,
    combine=combine,
    columns=COLUMNS,
    draw=draw_slam,
    defaults={"system": "zigbee"},
    mirrors=(),
    runs=50,
    is_radio=True,
)
