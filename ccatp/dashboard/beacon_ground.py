"""Pure. What does not change while a mission among beacons goes on: the room, the waypoints, the words of the page."""

from typing import Any

from ccatp.beacon_mission.states import State
from ccatp.config.radio_models import RadioConfig

CODES = ["normal operation", "near something", "operation aborted"]
TITLES = {"zigbee": "ZigBee beacons", "follow": "Following a radio", "cricket": "Ultrasonic motes"}
# What a robot of a survey has and this one has not.
HIDDEN = ["edges", "fans-row", "skipped-row", "eta-row"]


def waypoint_name(number: int) -> str:
    """A waypoint as the mission's status names it; its number is from 0."""
    return f"waypoint {number + 1}"


def beacon_waypoints(cfg: RadioConfig) -> list[tuple[float, float]]:
    """Those of one lap; a robot that follows a radio has none."""
    return [] if cfg.follow.is_active else list(cfg.workspace.waypoints_m)


def beacon_ground(cfg: RadioConfig, *, is_sim: bool, needs_token: bool) -> dict[str, Any]:
    """The ground for the page, lengths in m, in the frame of the room.

    Args:
        cfg: the run's configuration.
        is_sim: the robot is a stand-in.
        needs_token: commands must carry a token.
    """
    width_m, depth_m = cfg.workspace.size_m
    is_following = cfg.follow.is_active
    goals = "seconds" if is_following else "waypoints"
    return {
        "title": TITLES[cfg.system],
        "is_sim": is_sim,
        "subtitle": f"{cfg.system}.toml, seed {cfg.run.seed}" if is_sim else f"{cfg.system}.toml",
        "needs_token": needs_token,
        "panels": [],
        "rim": [[0.0, 0.0], [width_m, 0.0], [width_m, depth_m], [0.0, depth_m]],
        "points": [[waypoint_name(at), *place] for at, place in enumerate(beacon_waypoints(cfg))],
        "base": [cfg.start.x_m, cfg.start.y_m, cfg.start.heading_rad],
        "edge_sensors_m": [],
        "wheel_base_m": cfg.vehicle.track_m,
        "arrival_tolerance_mm": 1e3 * cfg.control.arrival_radius_m,
        "rate_hz": cfg.dashboard.rate_hz,
        "states": [str(state) for state in State],
        "codes": CODES,
        "plots": _plots(cfg),
        "hides": HIDDEN,
        "words": {
            "simulation-what": "robot, radios and motes are simulated",
            "progress-head": "Following" if is_following else "Waypoints",
            "unit": goals,
            "point-name": "driving to",
            "arrival-name": "position \u03c3",
            "goal": goals,
            "reached": "followed" if is_following else "reached",
        },
    }


def _plots(cfg: RadioConfig) -> list[str]:
    last = ["target"] if cfg.follow.is_active else ["clearance"] if cfg.avoidance.is_active else []
    return ["error", "map", "nis", *last]
