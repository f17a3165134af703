"""The page of a mission among beacons: waypoints, the map of the beacons, errors against the simulated truth."""

from collections.abc import Mapping
from math import dist
from pathlib import Path
from typing import Any

from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.links.messages import worst_sigma_m
from ccatp.beacons.links.topics import BeaconArrival, BeaconMapMessage, BeaconPlaces, BeaconTrack
from ccatp.beacons.mission import MODES
from ccatp.beacons.report.record import expected_rms_m, standing_beacons, true_rms_m
from ccatp.report.dashboard.history import TruthCompare
from ccatp.report.dashboard.hub import Page, Wants
from ccatp.report.dashboard.view import MEASURED, PLANNED, RunStateView

CODES = ["normal operation", "near something", "operation aborted"]
TITLES = {"zigbee": "ZigBee beacons", "follow": "Following a radio", "cricket": "Ultrasonic motes"}
# Sign, ink and words of the points on the map.
LEGEND = [["\u25cb", "todo", "waypoint"], ["\u25cf", "good", "reached"], ["\u25b2", "estimate", "beacon"]]
# Elements of the page that only a survey has.
HIDDEN = ["edges", "skipped-row", "eta-row", "finish-row"]


def waypoint_name(number: int) -> str:
    """Name of a waypoint in the mission's status; ``number`` counts from 0."""
    return f"waypoint {number + 1}"


def beacon_waypoints(cfg: RadioConfig) -> list[tuple[float, float]]:
    """Waypoints of one lap, m; none for a robot that follows a radio."""
    return [] if cfg.follow.is_active else list(cfg.workspace.waypoints_m)


def beacon_ground(cfg: RadioConfig, *, is_sim: bool) -> dict[str, Any]:
    """Constant data of a mission, like ``survey_view.ground``; lengths in m, frame of the room."""
    width_m, depth_m = cfg.workspace.size_m
    is_following = cfg.follow.is_active
    goals = "seconds" if is_following else "waypoints"
    last = ["target"] if is_following else ["clearance"] if cfg.avoidance.is_active else []
    return {
        "title": TITLES[cfg.system],
        "is_sim": is_sim,
        "subtitle": f"{cfg.system}.toml, seed {cfg.run.seed}" if is_sim else f"{cfg.system}.toml",
        "about": [],
        "panels": [],
        "rim": [[0.0, 0.0], [width_m, 0.0], [width_m, depth_m], [0.0, depth_m]],
        "points": [[waypoint_name(at), *place] for at, place in enumerate(beacon_waypoints(cfg))],
        "base": [cfg.start.x_m, cfg.start.y_m, cfg.start.heading_rad],
        "edge_sensors_m": [],
        "wheel_base_m": cfg.vehicle.track_m,
        "arrival_tolerance_mm": 1e3 * cfg.control.arrival_radius_m,
        "rate_hz": cfg.dashboard.rate_hz,
        "states": [str(state) for state in MODES],
        "codes": CODES,
        "plots": {name: [] for name in ("error", "map", *last)} | {"nis": [[1.0, "expected"]]},
        "limits": {"sensors_age_s": cfg.robot.sensors_timeout_s, "permit_age_s": cfg.danger.stale_after_s},
        "hides": HIDDEN,
        "legend": LEGEND,
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


# Rows of robot time (s) and: true error and three sigma of the position (mm), without the truth only three sigma; true
# error of the beacons and its expected standard deviation (both root mean square, mm); NIS and degrees of freedom of
# the readings since the row before; distance to the target and its set point (m); the smallest distance that a distance
# sensor measures (m).
LINES = ("error", "map", "target", "clearance")
SERIES = (*LINES, "nis")
# The page draws these from more frequent messages.
_DRAWN = frozenset(("robot", "trail", "waypoint"))


class BeaconView(RunStateView):
    """The state of a mission among beacons."""

    def __init__(self, cfg: RadioConfig, *, is_sim: bool, run_dir: Path | None = None) -> None:
        points = len(beacon_waypoints(cfg))
        super().__init__(points=points, is_sim=is_sim, series=SERIES, lines=LINES, run_dir=run_dir, has_laser=False)
        self._cfg = cfg
        self._lap = 0
        self._map: BeaconMapMessage | None = None
        self._places: Mapping[str, tuple[float, float]] = {}
        self._handlers |= {
            BeaconArrival: self._take_arrival,
            BeaconMapMessage: self._take_map,
            BeaconPlaces: self._take_places,
            BeaconTrack: self._take_track,
        }

    def _take_arrival(self, arrival: BeaconArrival, _now_s: float) -> None:
        if arrival.lap > self._lap:  # a new lap
            self._lap = arrival.lap
            self._states = [PLANNED] * len(self._states)
            self._changed.update(range(len(self._states)))
        if 0 <= arrival.waypoint < len(self._states):
            self._mark(arrival.waypoint, MEASURED)

    def _take_places(self, places: BeaconPlaces, _now_s: float) -> None:
        self._places = places.places

    def _take_map(self, message: BeaconMapMessage, _now_s: float) -> None:
        before, self._map = self._map, message
        t_s = self._mission_s(message.t_s)
        self._trail.add(t_s, round(message.pose[0], 3), round(message.pose[1], 3))
        if before is None or message.nis_size < before.nis_size:  # the first, or of a restarted main loop
            return
        if message.nis_size > before.nis_size:
            nis = round(message.nis_sum - before.nis_sum, 3)
            self._series["nis"].add(t_s, nis, message.nis_size - before.nis_size)
        static = standing_beacons(self._cfg, message)
        if (sigma_m := expected_rms_m(static)) is not None:
            error_m = true_rms_m(static, self._places)
            error_mm = None if error_m is None else round(1e3 * error_m, 2)
            self._series["map"].add(t_s, error_mm, round(1e3 * sigma_m, 2))
        if message.target is not None:
            distance_m = dist(message.target[:2], message.pose[:2])
            self._series["target"].add(t_s, round(distance_m, 3), self._cfg.follow.safe_distance_m)
        if message.distances:
            self._series["clearance"].add(t_s, round(min(message.distances), 3))

    def _take_track(self, track: BeaconTrack, _now_s: float) -> None:
        for seq, t_s, x_m, y_m, _, xx, xy, yy, *_ in track.rows:
            if TruthCompare.is_compared(seq):
                self._take_estimate(seq, t_s, x_m, y_m, worst_sigma_m(xx, xy, yy))

    def _levels(self, now_s: float) -> dict[str, Any]:
        facts = {} if self._map is None else self._facts(self._map)
        return {**super()._levels(now_s), "facts": [(name, text) for name, text in facts.items() if text]}

    def _facts(self, message: BeaconMapMessage) -> dict[str, str | None]:
        """Texts by their names; None if not known."""
        static, size = standing_beacons(self._cfg, message), message.nis_size
        errors_m = expected_rms_m(static), true_rms_m(static, self._places)
        expected, true = (None if error_m is None else f"{1e3 * error_m:.1f} mm" for error_m in errors_m)
        facts = {
            "beacons on the map": str(len(static)),
            "error of the map, expected": expected,
            "error of the map, true": true,
            "readings used, refused": f"{message.used}, {message.refused}" if message.used else None,
            "mean NIS": f"{message.nis_sum / size:.2f}" if size else None,
        }
        if message.target is not None:
            facts["distance to the target"] = f"{dist(message.target[:2], message.pose[:2]):.2f} m"
            facts["to be kept"] = f"{self._cfg.follow.safe_distance_m:.2f} m"
        elif message.waypoints and message.next_waypoint >= 0:
            facts["to the waypoint"] = f"{dist(message.waypoints[message.next_waypoint], message.pose[:2]):.2f} m"
        if self._cfg.mission.laps > 1 and message.waypoints:
            facts["lap"] = f"{self._lap + 1} of {self._cfg.mission.laps}"
        return facts

    def _shapes(self) -> list[Any]:
        shapes = [shape for shape in super()._shapes() if shape["kind"] not in _DRAWN]
        true = [
            {"id": f"true {name}", "kind": "true", "x_m": x_m, "y_m": y_m} for name, (x_m, y_m) in self._places.items()
        ]
        return [*true, *shapes]


WANTS = Wants(("beacon_arrival", "beacon_map", "scene"), "beacon_track", "beacon_truth", ("beacon_places",))


def beacon_page(cfg: RadioConfig, run_dir: Path, is_sim: bool) -> Page:
    """The page of a run."""
    view = BeaconView(cfg, is_sim=is_sim, run_dir=run_dir)
    return Page(view, BeaconView(cfg, is_sim=is_sim), beacon_ground(cfg, is_sim=is_sim), WANTS)
