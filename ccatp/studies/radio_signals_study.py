"""Pure. The study `radio-signals`: levels against range and bearings of the reflector, beside Hevrdejs and Knoll 2017.

A turn of the reflector is simulated packet by packet and read as on the robot: the level is that next to the strongest
reading, the bearing that of the strongest reading.
"""

from collections.abc import Sequence
from math import atan2, degrees, pi
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.angles import wrap_pi
from ccatp.config.radio_models import RadioConfig
from ccatp.radio.path_loss import PathLoss
from ccatp.radio.reflector import ScanResult
from ccatp.radio.signal_settings import scan_of
from ccatp.sim.radio.frame import TruePose
from ccatp.sim.radio.propagation import TrueRadio
from ccatp.studies.campaign import Cell, CellResult, Column, Factors, Job, Outcome, Study
from ccatp.studies.radio_figures import draw_signals

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


def run_job(job: Job) -> Outcome:
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
    return Outcome(values, {})


def combine(factors: Factors, outcomes: Sequence[Outcome]) -> Outcome:
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
    return Outcome(values)


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
