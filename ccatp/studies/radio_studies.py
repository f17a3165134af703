"""The study `radio-cases`: the three experimental cases of Hevrdejs and Knoll 2017, side by side with ours.

The slides print the errors of three drives in a laboratory and nothing of the drives. Ours are three paths in the same
room, among the same radios with 5 dB of static shadowing and reflected rays, read through the turning reflector.

The study `radio-follow`: a moving radio is mapped and followed, side by side with Auth and Hovey 2018.

The study `radio-slam`: EKF-SLAM among four ZigBee radios, in two rooms, with slip and with shadowing.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ccatp.studies.campaign import Cell, CellResult, Column, Factors, JobOutcome, Study
from ccatp.studies.radio_runs import COLUMNS, TARGET_COLUMNS, combine, run_job
from ccatp.studies.radio_signals_study import draw_cases, draw_errors

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


def case_cells() -> Sequence[Cell]:
    """The three paths."""
    return [Cell({"case": case}, {**RADIO, "workspace.waypoints_m": path}) for case, path in PATHS.items()]


def combine_cases(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """The runs pooled, and what 2017 prints."""
    values, arrays = combine(factors, outcomes)
    return JobOutcome({**values, "printed": dict(zip(NAMES, CASES_PRINTED[str(factors["case"])], strict=True))}, arrays)


def draw_case_figures(results: Sequence[CellResult], out: Path) -> None:
    """Figure ``radio_cases``: printed and our errors of pose and beacons."""
    draw_cases(results, NAMES, out / "radio_cases")


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
    cells=case_cells,
    run_job=run_job,
    combine=combine_cases,
    columns=_columns(),
    draw=draw_case_figures,
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


def follow_cells() -> Sequence[Cell]:
    """How often the target is heard, times conditions."""
    return [
        Cell({"case": case, "condition": condition}, {**keys, "observation.target_every_steps": every})
        for condition, keys in FOLLOW_CONDITIONS.items()
        for case, every in CASES.items()
    ]


def combine_follow(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """The runs pooled, and what 2018 prints."""
    values, arrays = combine(factors, outcomes)
    is_printed = factors["condition"] == "as printed"
    printed: dict[str, Any] = dict(FOLLOW_PRINTED[str(factors["case"])]) if is_printed else {}
    return JobOutcome({**values, "printed": printed}, arrays)


def draw_follow_figures(results: Sequence[CellResult], out: Path) -> None:
    """Figures ``radio_follow_target`` and ``radio_follow_beacons``: errors over time."""
    keys = ("case", "condition")
    draw_errors(results, "target_m", "error of the target, m", keys, out / "radio_follow_target")
    draw_errors(results, "beacons_m", "error of the beacons, m", keys, out / "radio_follow_beacons")


RADIO_FOLLOW = Study(
    name="radio-follow",
    title="A moving radio followed",
    cells=follow_cells,
    run_job=run_job,
    combine=combine_follow,
    columns=(
        Column("2018: target, m", "printed.target_m"),
        *TARGET_COLUMNS,
        Column("2018: beacons, m", "printed.beacons_m"),
        *COLUMNS,
    ),
    draw=draw_follow_figures,
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


def draw_slam_figures(results: Sequence[CellResult], out: Path) -> None:
    """Figure ``radio_slam``: the beacons' error over time."""
    draw_errors(results, "beacons_m", "error of the beacons, m", ("room", "condition", "every"), out / "radio_slam")


RADIO_SLAM = Study(
    name="radio-slam",
    title="EKF-SLAM among ZigBee radios",
    cells=slam_cells,
    run_job=run_job,
    combine=combine,
    columns=COLUMNS,
    draw=draw_slam_figures,
    defaults={"system": "zigbee"},
    mirrors=(),
    runs=50,
    is_radio=True,
)
