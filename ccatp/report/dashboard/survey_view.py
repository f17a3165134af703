"""The page of a survey: its points, arrival errors by the laser, errors against the simulated truth, the path."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ccatp.config.models import Config
from ccatp.core import Fix, Measured, PointId, Vector3
from ccatp.links.topics import ArrivalMessage, DisplayState, FixMessage, MissionStatus, TrackMessage
from ccatp.mirror.mirror import Mirror, deck_rows
from ccatp.mirror.surface import ConvergenceError
from ccatp.records.store import StoredSurvey
from ccatp.records.summary import measured_error_m
from ccatp.report.dashboard.history import TruthCompare
from ccatp.report.dashboard.network_watch import NetworkWatch
from ccatp.report.dashboard.view import ARRIVED, MEASURED, PLANNED, SKIPPED, RunStateView
from ccatp.survey.events import PURPOSES
from ccatp.survey.planning.route import ORDERS

CODES = ["normal operation", "near the mirror's edge", "operation aborted"]
# Terms of the page, by the id of their element or for its own sentences.
WORDS = {
    "simulation-what": "robot and laser system are simulated",
    "progress-head": "Survey",
    "unit": "points",
    "point-name": "next point",
    "arrival-name": "last arrival",
    "goal": "points",
    "reached": "measured",
}


def point_name(point: PointId) -> str:
    """Name of a point in the mission's status."""
    return f"{point.row}-{point.col}-{point.point}"


def survey_points(mirror: Mirror, cfg: Config) -> list[PointId]:
    """The points of the survey in the order in which they are visited."""
    return ORDERS[cfg.run.order](mirror, cfg.run.panels)


def ground(mirror: Mirror, cfg: Config, *, is_sim: bool) -> dict[str, Any]:
    """Constant data of a run: map and settings of the page; lengths in m, deck frame."""
    base, observation = mirror.base_pose, cfg.observation
    about = {
        "telescope": observation.telescope,
        "survey by": observation.operator,
        "robot": observation.robot_serial_number,
    }
    return {
        "title": mirror.name,
        "is_sim": is_sim,
        "subtitle": f"world {cfg.world.name}, seed {cfg.run.seed}" if is_sim else f"filter {cfg.run.filter}",
        "about": [[name, text] for name, text in about.items() if text],
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
        "states": [str(state) for state in PURPOSES],
        "codes": CODES,
        "plots": {
            "arrival": [[1e3 * cfg.mission.arrival_tolerance_m, "limit"]],
            "error": [[1e3 * cfg.mission.arrival_tolerance_m, "limit"]],
            "jump": [],
            "nis": [[1.0, "expected"], [cfg.etalon.doubt_nis / FIX_DEGREES, "measured again above"]],
        },
        "limits": {
            "charge": cfg.health.battery_reserve,
            "fan_duty": cfg.robot.fan_duty,
            "fan_share": cfg.health.fan_share if mirror.overhang else None,
            "sensors_age_s": cfg.robot.sensors_timeout_s,
            "drive_age_s": cfg.health.latency_pause_s,
            "permit_age_s": cfg.mission.verdict_timeout_s,
            "dop": cfg.etalon.max_dop,
            "residual_um": 1e6 * cfg.etalon.max_residual_m,
            "grip": cfg.robot.thrust_margin,
        },
        "hides": [],
        "words": WORDS,
    }


# Rows of robot time (s) and: arrival error by the laser (mm); change of the estimate by a fix (mm); NIS and degrees of
# freedom; true error and three sigma of the position (mm), without the truth only three sigma.
SERIES, LINES = ("arrival", "jump", "nis", "error"), ("error",)
FIX_DEGREES = 2  # of freedom of a fix


class SurveyView(RunStateView):
    """The state of a survey."""

    def __init__(self, mirror: Mirror, cfg: Config, *, is_sim: bool, run_dir: Path | None = None) -> None:
        self.points = survey_points(mirror, cfg)
        super().__init__(points=len(self.points), is_sim=is_sim, series=SERIES, lines=LINES, run_dir=run_dir)
        self._laser: FixMessage | None = None
        self._network = NetworkWatch(mirror, cfg)
        self._nis = (0.0, 0)  # and degrees of freedom, the last that was drawn
        self._mirror, self._puck_height_m = mirror, cfg.robot.puck_height_m
        self._index = {point: k for k, point in enumerate(self.points)}
        self._by_name = {point_name(point): k for k, point in enumerate(self.points)}
        self._handlers |= {
            ArrivalMessage: self._take_arrival,
            FixMessage: self._take_fix,
            TrackMessage: self._take_track,
        }

    def begin_with(self, survey: StoredSurvey) -> None:
        """Take what was measured and skipped before; when, the recording says."""
        for point, fix in survey.fixes:
            self._measured(point, fix.position_m)
            self._network.add(Measured(point, fix))
        for row in survey.points:
            if row.status == "skipped" and row.point in self._index:
                self._mark(self._index[row.point], SKIPPED)

    def _take_status(self, status: MissionStatus, now_s: float) -> None:
        super()._take_status(status, now_s)
        for names in status.left_out.values():
            for name in names:
                index = self._by_name.get(name)
                if index is not None and self._states[index] != MEASURED:
                    self._mark(index, SKIPPED)

    def _take_picture(self, picture: DisplayState, now_s: float) -> None:
        super()._take_picture(picture, now_s)
        if picture.size and (picture.nis, picture.size) != self._nis:
            self._nis = picture.nis, picture.size
            self._series["nis"].add(self._mission_s(picture.t_s), round(picture.nis, 3), picture.size)

    def _take_arrival(self, arrival: ArrivalMessage, _now_s: float) -> None:
        index = self._index.get(PointId(*arrival.point))
        if index is not None and self._states[index] != MEASURED:
            self._mark(index, ARRIVED)

    def _take_fix(self, fix: FixMessage, now_s: float) -> None:
        self.links.fix_s, self._laser = now_s, fix
        if fix.is_fused:
            self._series["jump"].add(self._mission_s(fix.t_s), round(fix.jump_mm, 4))
        if fix.is_fused and fix.point is not None:
            point = PointId(*fix.point)
            error_mm = self._measured(point, fix.position_m)
            self._network.add(Measured(point, msgspec.convert(fix, Fix, from_attributes=True)))
            if error_mm is not None:
                self._series["arrival"].add(self._mission_s(fix.t_s), error_mm)

    def _measured(self, point: PointId, position_m: Vector3) -> float | None:
        """Mark the point, and return its arrival error, mm."""
        index = self._index.get(point)
        if index is None:
            return None
        self._mark(index, MEASURED)
        try:
            error_m = measured_error_m(self._mirror, point, position_m, self._puck_height_m)
        except ConvergenceError:
            return None  # not on this mirror
        self._errors_mm[index] = error_mm = round(1e3 * error_m, 3)
        return error_mm

    def _take_track(self, track: TrackMessage, _now_s: float) -> None:
        rows = [row for row in track.rows if TruthCompare.is_compared(row[0])]
        if not rows:
            return
        deck = deck_rows(self._mirror, [row[2:4] for row in rows], np.array([row[4:7] for row in rows]))
        for row, (x_m, y_m) in zip(rows, deck[:, :2].tolist(), strict=True):
            self._trail.add(self._mission_s(row[1]), round(x_m, 3), round(y_m, 3))
            self._take_estimate(row[0], row[1], x_m, y_m, row[7])

    def _next_point(self, status: MissionStatus) -> str:
        # On the way to a stop that is not a point the mission has none; then it is the first planned one.
        if status.point or PLANNED not in self._states:
            return status.point
        return point_name(self.points[self._states.index(PLANNED)])

    def _levels(self, now_s: float) -> dict[str, Any]:
        fix, laser = self._laser, None
        if fix is not None:
            residual_um = round(1e6 * fix.residual_rms_m, 2)
            age_s = round(max(now_s - (self.links.fix_s or now_s), 0.0), 2)
            laser = {"dop": fix.dop, "residual_um": residual_um, "channels": fix.channels, "is_used": fix.is_fused}
            laser |= {"age_s": age_s}
        levels = super()._levels(now_s)
        # The adjustment takes time, which nobody asks for while no page is open.
        network = self._network.sentence(is_over=self.links.is_over) if self.is_watched else ""
        return {**levels, "laser": laser, "facts": [("laser network", network)] if network else []}
