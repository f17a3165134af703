"""The study `radio-signals`: levels against range and bearings of the reflector, beside Hevrdejs and Knoll 2017.

A turn of the reflector is simulated packet by packet and read as on the robot: the level is that next to the strongest
reading, the bearing that of the strongest reading.

Figures of the radio studies: errors over time, printed values beside ours.
"""

from collections.abc import Sequence
from math import atan2, degrees, pi
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.beacons.slam.path_loss import PathLoss
from ccatp.beacons.slam.reflector import ScanResult
from ccatp.beacons.slam.settings import scan_of
from ccatp.config.beacon_models import RadioConfig
from ccatp.core import wrap_pi
from ccatp.report.plots import INK, QUIET, dress, new_figure
from ccatp.sim.radio import TruePose, TrueRadio
from ccatp.studies.campaign import Cell, CellResult, Column, Factors, Job, JobOutcome, Study
from ccatp.studies.figures import LIMIT, colour, save

_POINT_S = 1.0  # between the points of a curve: ten steps of 0.1 s


def draw_errors(results: Sequence[CellResult], name: str, label: str, keys: Sequence[str], stem: Path) -> None:
    """Median over the runs of an error over time, with 10 to 90 %; a panel for each level of the first key.

    Args:
        results: cells with the array ``name`` of shape (runs, points).
        keys: factors that tell the cells apart; the first one makes the panels.
    """
    shown = [result for result in results if name in result.arrays]
    if not shown:
        return
    groups = list(dict.fromkeys(result.factors[keys[0]] for result in shown))
    figure = new_figure(5.2 * len(groups) + 0.5, 4.2)
    panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for axes, group in zip(panels, groups, strict=True):
        cells = [result for result in shown if result.factors[keys[0]] == group]
        for index, result in enumerate(cells):
            low, median, high = _quantiles(result.arrays[name])
            time_s = np.arange(median.size) * _POINT_S
            line = {"color": colour(index), "linestyle": "-" if index < 6 else "--"}
            axes.plot(time_s, median, linewidth=1.4, label=_named(result, keys[1:]), **line)
            axes.fill_between(time_s, low, high, color=colour(index), alpha=0.08, linewidth=0)
        axes.set(xlabel="time, s", title=f"{keys[0]}: {group}", ylim=(0.0, None))
        axes.legend(frameon=False, fontsize=7)
    panels[0].set_ylabel(label)
    dress(*panels)
    save(figure, stem)


def draw_cases(results: Sequence[CellResult], names: Sequence[str], stem: Path) -> None:
    """Bars of the printed errors and of ours, for pose and beacons of each case."""
    figure = new_figure(3.4 * len(results) + 0.4, 3.8)
    panels = figure.subplots(1, len(results), sharey=True, squeeze=False)[0]
    shown = [name for name in names if name != "heading_rad"]
    for axes, result in zip(panels, results, strict=True):
        ours = [result.values["pose_m"], *(result.values["beacon_rmse_m"].get(n, np.nan) for n in shown[1:])]
        printed = [result.values["printed"][name] for name in shown]
        at = np.arange(len(shown))
        axes.bar(at - 0.2, printed, 0.38, color=QUIET, label="2017, printed")
        axes.bar(at + 0.2, ours, 0.38, color=colour(0), label="ours, mean of the runs")
        axes.set_xticks(at, ["pose", *(name.replace("beacon", "b") for name in shown[1:])])
        axes.set(title=f"case {result.factors['case']}")
    panels[0].set_ylabel("RMSE, m")
    panels[-1].legend(frameon=False, fontsize=8)
    dress(*panels)
    save(figure, stem)


def draw_signals(results: Sequence[CellResult], ranges_m: Sequence[float], corners: Sequence[str], stem: Path) -> None:
    """Level over range and error of the bearing by beacon: printed, model, ours."""
    figure = new_figure(10.0, 4.0)
    left, right = figure.subplots(1, 2)
    conditions = list(dict.fromkeys(result.factors["condition"] for result in results))
    by_key = {(result.factors["condition"], result.factors["place"]): result.values for result in results}
    for index, condition in enumerate(conditions):
        rows = [by_key.get((condition, f"{range_m:g} m")) for range_m in ranges_m]
        if all(rows):
            _draw_levels(left, [row for row in rows if row], index, str(condition))
        bars = [by_key.get((condition, corner)) for corner in corners]
        if all(bars):
            at = np.arange(len(corners)) + 0.2 * (index - 1)
            heights = [row["bearing_rms_deg"] for row in bars if row]
            right.bar(at, heights, 0.18, color=colour(index), label=f"ours, RMS: {condition}")
    first = [by_key.get((conditions[0], corner)) for corner in corners]
    printed = [row["printed"]["bearing_error_deg"] for row in first if row]
    right.plot(np.arange(len(printed)), printed, "x", color=LIMIT, markersize=8, markeredgewidth=2, label="2017")
    right.set_xticks(np.arange(len(corners)), list(corners))
    right.set(ylabel="error of the bearing, deg", title="bearing of the strongest reading")
    left.set(xlabel="range, m", ylabel="level, dBm", title="mean level of a scan")
    for axes in (left, right):
        axes.legend(frameon=False, fontsize=7)
    dress(left, right)
    save(figure, stem)


def _draw_levels(axes: Any, rows: Sequence[Any], index: int, condition: str) -> None:
    ranges = [row["range_m"] for row in rows]
    if index == 0:
        axes.plot(ranges, [row["model_dbm"] for row in rows], color=INK, linewidth=1.2, label="model")
        printed = [row["printed"]["level_dbm"] for row in rows]
        axes.plot(ranges, printed, "x", color=LIMIT, markersize=8, markeredgewidth=2, label="2017")
    levels, sigmas = ([row[key] for row in rows] for key in ("level_dbm", "level_sigma_db"))
    shifted = [range_m + 0.03 * (index - 1) for range_m in ranges]
    axes.errorbar(
        shifted, levels, sigmas, fmt="o", color=colour(index), markersize=4, capsize=2, label=f"ours: {condition}"
    )


def _quantiles(runs: Any) -> tuple[Any, Any, Any]:
    """10, 50 and 90 % over the runs; NaN where none has an estimate yet."""
    known = np.isfinite(runs).any(axis=0)
    found = np.full((3, runs.shape[1]), np.nan)
    found[:, known] = np.nanquantile(runs[:, known], (0.1, 0.5, 0.9), axis=0)
    return found[0], found[1], found[2]


def _named(result: CellResult, keys: Sequence[str]) -> str:
    return ", ".join(f"every {result.factors[k]}" if k == "every" else str(result.factors[k]) for k in keys)


# Slide "Initial Experimental Results": mean RSSI, and the range from it with P_ref = -33 dBm and an exponent of 2.
RANGES_M = (0.5, 1.0, 2.0, 3.0)
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


def cells() -> Sequence[Cell]:
    """Ranges and corners, times conditions."""
    places = [*(f"{range_m:g} m" for range_m in RANGES_M), *CORNERS_M]
    return [
        Cell({"place": place, "condition": condition}, dict(keys))
        for condition, keys in CONDITIONS.items()
        for place in places
    ]


def run_job(job: Job) -> JobOutcome:
    """So many turns of the reflector at one place, with shadowing and reflections of their own for each seed."""
    cfg, place = job.radio, str(job.factors["place"])
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


def combine(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Means and spreads over the seeds, and what 2017 prints."""
    place = str(factors["place"])
    runs = [outcome.values for outcome in outcomes]
    errors = np.array([error for run in runs for error in run["bearing_errors_deg"]])
    ranges = np.array([run["estimate_m"] for run in runs])
    printed: dict[str, float] = {}
    if place in CORNERS_M:
        printed["bearing_error_deg"] = PRINTED_DEG[place]
    else:
        index = [f"{range_m:g} m" for range_m in RANGES_M].index(place)
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


def draw(results: Sequence[CellResult], out: Path) -> None:
    """Figure ``radio_signals``: level over range, and errors of the bearings."""
    draw_signals(results, RANGES_M, tuple(CORNERS_M), out / "radio_signals")


def _turns(cfg: RadioConfig, sender_m: tuple[float, float]) -> list[ScanResult]:
    places, noise = (np.random.default_rng([cfg.run.seed, stream]) for stream in (0, 1))
    radio = TrueRadio(
        "radio", cfg.path_loss.reference_dbm, cfg.sim.radio, cfg.workspace.size_m, (), cfg.scan.readings, places, noise
    )
    scan = scan_of(cfg)
    headings = np.random.default_rng([cfg.run.seed, 2]).uniform(-pi, pi, TURNS) / cfg.scan.readings
    found = []
    for offset_rad in headings.tolist():  # the robot never stands quite straight: steps and beacon are not in line
        turned = scan.results(radio.scan(ROBOT._replace(heading_rad=offset_rad), sender_m))
        for result in turned:
            straight = None if result.bearing_rad is None else result.bearing_rad + offset_rad
            found.append(result._replace(bearing_rad=straight))
    return found


STUDY = Study(
    name="radio-signals",
    title="Levels and bearings of ZigBee radios",
    cells=cells,
    run_job=run_job,
    combine=combine,
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
    draw=draw,
    defaults={"system": "zigbee"},
    mirrors=(),
    runs=40,
    is_radio=True,
)
