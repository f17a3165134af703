"""Pure. The study `radio-slam`: EKF-SLAM among four ZigBee radios, in two rooms, with slip and with shadowing."""

from collections.abc import Sequence
from pathlib import Path

from ccatp.studies.campaign import Cell, CellResult, Study
from ccatp.studies.radio_cell import COLUMNS, combine, run_job
from ccatp.studies.radio_figures import draw_errors

SLIP: dict[str, object] = {"sim.vehicle.slip": 0.05, "odometry.slip_sigma": 0.05}
DRIFT: dict[str, object] = {"sim.vehicle.heading_drift_rad_s": 0.0087, "odometry.heading_drift_sigma_rad_s": 0.01}
SHADOW: dict[str, object] = {"sim.radio.shadowing_sigma_db": 5.0, "path_loss.shadowing_sigma_db": 5.0}
CONDITIONS: dict[str, dict[str, object]] = {
    "white": {},
    "slip 5 %": SLIP,
    "slip 5 %, drift 0.5 deg/s": {**SLIP, **DRIFT},
    "shadowing 5 dB, mapped": {**SHADOW, "estimator.shadowing": "map"},
    "shadowing 5 dB, as white": {**SHADOW, "estimator.shadowing": "white"},
    "shadowing 5 dB, ignored": {**SHADOW, "estimator.shadowing": "none"},
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


def cells() -> Sequence[Cell]:
    """Rooms times conditions at every 30 steps; in the small room at every step, too."""
    return [
        Cell(
            {"room": room, "condition": condition, "every": every},
            {**keys, **ROOMS[room], "observation.every_steps": every},
        )
        for room in ROOMS
        for every in EVERY
        for condition, keys in CONDITIONS.items()
        if room == "3 m" or (every == EVERY[0] and condition in {"white", "shadowing 5 dB, mapped"})
    ]


def draw(results: Sequence[CellResult], out: Path) -> None:
    """Figure ``radio_slam``: the beacons' error over time."""
    draw_errors(results, "beacons_m", "error of the beacons, m", ("room", "condition", "every"), out / "radio_slam")


STUDY = Study(
    name="radio-slam",
    title="EKF-SLAM among ZigBee radios",
    cells=cells,
    run_job=run_job,
    combine=combine,
    columns=COLUMNS,
    draw=draw,
    defaults={"system": "zigbee"},
    mirrors=(),
    runs=50,
    is_radio=True,
)
