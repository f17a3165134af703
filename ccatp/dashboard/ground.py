"""Pure. What does not change while a run goes on: the map on which things are drawn, and what the page may do."""

from typing import Any

from ccatp.config.models import Config
from ccatp.mirror.mirror import Mirror
from ccatp.planning.traversal import ORDERS
from ccatp.samples import PointId
from ccatp.surveying.states import State

CODES = ["normal operation", "near the mirror's edge", "operation aborted"]
WORDS = {
    "simulation-what": "robot and laser system are simulated",
    "progress-head": "Survey",
    "unit": "points",
    "point-name": "next point",
    "arrival-name": "last arrival",
    "goal": "points",
    "reached": "measured",
}
"""What the page calls things: by the id of their place on it, and for its own sentences."""
PLANNED, ARRIVED, MEASURED, SKIPPED = range(4)
"""State of a point: planned, the robot came to rest there, measured, left out."""


def point_name(point: PointId) -> str:
    """A point as the mission's status names it."""
    return f"{point.row}-{point.col}-{point.point}"


def survey_points(mirror: Mirror, cfg: Config) -> list[PointId]:
    """The points of the survey in the order in which they are visited."""
    return ORDERS[cfg.run.order](mirror, cfg.run.panels)


def ground(mirror: Mirror, cfg: Config, *, is_sim: bool, needs_token: bool) -> dict[str, Any]:
    """The ground for the page, lengths in m, deck frame.

    Args:
        mirror: where the survey takes place.
        cfg: the run's configuration.
        is_sim: robot and laser system are stand-ins.
        needs_token: commands must carry a token.
    """
    base = mirror.base_pose
    return {
        "title": mirror.name,
        "is_sim": is_sim,
        "subtitle": f"world {cfg.world.name}, seed {cfg.run.seed}" if is_sim else f"filter {cfg.run.filter}",
        "needs_token": needs_token,
        "panels": [
            [p.id.row, p.id.col, *(round(v, 4) for v in (p.x_m, p.y_m, p.half_x_m, p.half_y_m))]
            for p in mirror.panels.values()
        ],
        "rim": [[round(float(x), 4), round(float(y), 4)] for x, y in mirror.rim.vertices],
        "points": [
            [point_name(p), *(round(v, 4) for v in mirror.point_on_deck(p))] for p in survey_points(mirror, cfg)
        ],
        "base": [round(base.x_m, 4), round(base.y_m, 4), round(base.heading_rad, 4)],
        "edge_sensors_m": cfg.robot.edge_sensors_m,
        "wheel_base_m": cfg.robot.wheel_base_m,
        "arrival_tolerance_mm": 1e3 * cfg.mission.arrival_tolerance_m,
        "rate_hz": cfg.dashboard.rate_hz,
        "states": [str(state) for state in State],
        "codes": CODES,
        "plots": ["arrival", "error", "jump", "nis"],
        "hides": [],
        "words": WORDS,
    }
