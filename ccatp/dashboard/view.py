"""Pure. The state of the page, from what came over the bus."""

from collections.abc import Callable, Iterable
from math import dist
from typing import Any

import msgspec

from ccatp.config.models import Config
from ccatp.dashboard.against_truth import Second, TruthCompare
from ccatp.dashboard.ground import ARRIVED, MEASURED, SKIPPED, TODO, point_name, survey_points
from ccatp.dashboard.links import STATUS_STALE_S, Links
from ccatp.dashboard.series import Growing, Lines, Trail
from ccatp.mirror.batches import deck_poses
from ccatp.mirror.errors import ConvergenceError
from ccatp.mirror.mirror import Mirror
from ccatp.samples import PanelId, PanelPose, PointId, Vector3, Verdict
from ccatp.wire.robot_messages import Sensors
from ccatp.wire.topics import (
    Arrival,
    DangerEvent,
    FixMessage,
    Log,
    Message,
    MissionStatus,
    Picture,
    Presence,
    Scene,
    Track,
    Truth,
)

MAX_PATH, MAX_SAMPLES, MAX_LINES = 12_000, 4_000, 200
SERIES = ("arrival", "jump", "nis", "error")
"""Rows of robot time (s) and: arrival error by the laser (mm); how far a fix moved the estimate (mm); NIS and degrees
of freedom; true error and three sigma of the position (mm), the latter alone where nobody knows the truth."""

_line = msgspec.json.Decoder(Sensors)


class View:
    """Hears the bus, and tells a page what is new.

    Args:
        mirror: where the survey takes place.
        cfg: the run's configuration.
        is_sim: robot and laser system are stand-ins.
    """

    def __init__(self, mirror: Mirror, cfg: Config, *, is_sim: bool) -> None:
        """Nothing heard."""
        self._mirror, self._puck_height_m, self._is_sim = mirror, cfg.robot.puck_height_m, is_sim
        self.points = survey_points(mirror, cfg)
        self._index = {point: k for k, point in enumerate(self.points)}
        self._by_name = {point_name(point): k for k, point in enumerate(self.points)}
        self._states = [TODO] * len(self.points)
        self._errors_mm: list[float | None] = [None] * len(self.points)
        self._changed: set[int] = set()
        self.links = Links()
        self.status: MissionStatus | None = None
        self._status_s = self._verdict_s = float("-inf")
        self.picture: Picture | None = None
        self.sensors: Sensors | None = None
        self.verdict: Verdict | DangerEvent | None = None
        self._scene: Scene | None = None
        self._is_scene_new = False
        self._trail = Trail(MAX_PATH)
        self.is_tracking = False  # the path comes as it is driven; else only the stops are known
        self._series = {name: Growing(MAX_SAMPLES) for name in SERIES}
        self._lines = Lines(MAX_LINES)
        self._truth = TruthCompare()
        self._sigma_second = -1
        self._ticks = 0
        self._takers: dict[type, Callable[[Any, float], None]] = {
            Presence: self._take_presence,
            MissionStatus: self._take_status,
            Picture: self._take_picture,
            Verdict: self._take_verdict,
            DangerEvent: self._take_verdict,
            Arrival: self._take_arrival,
            FixMessage: self._take_fix,
            Track: self._take_track,
            Truth: self._take_truth,
            Scene: self._take_scene,
            Log: self._take_log,
        }

    # -- what comes in --------------------------------------------------------------------------------------------

    def hear(self, message: Message | Verdict, now_s: float) -> None:
        """Take one message.

        Args:
            message: of the topic table; what the page does not show is ignored.
            now_s: time of the machine's monotonic clock.
        """
        taker = self._takers.get(type(message))
        if taker is not None:
            taker(message, now_s)

    def begin_with(self, measured: Iterable[tuple[PointId, float, Vector3]], skipped: Iterable[PointId]) -> None:
        """What was done before this process began.

        Args:
            measured: points with the time (s) and the puck (world frame, m) of their fixes, in any order.
            skipped: points left out.
        """
        for point, t_s, position_m in sorted(measured, key=lambda row: row[1]):
            self._measured(point, t_s, position_m)
        for point in skipped:
            self._mark(self._index.get(point), SKIPPED)

    def _take_presence(self, presence: Presence, _now_s: float) -> None:
        self.links.presence(presence)

    def _take_status(self, status: MissionStatus, now_s: float) -> None:
        self.status, self._status_s = status, now_s
        self.links.status(status)
        for names in status.left_out.values():
            for name in names:
                index = self._by_name.get(name)
                if index is not None and self._states[index] != MEASURED:
                    self._mark(index, SKIPPED)

    def _take_picture(self, picture: Picture, now_s: float) -> None:
        self.links.picture(now_s)
        before, self.picture = self.picture, picture
        if picture.size and (before is None or picture.nis != before.nis):
            self._series["nis"].add(round(picture.t_s, 2), round(picture.nis, 3), picture.size)
        try:
            self.sensors = _line.decode(picture.line)
        except msgspec.MsgspecError:
            self.sensors = None  # no frame yet

    def _take_verdict(self, verdict: Verdict | DangerEvent, now_s: float) -> None:
        self.verdict, self._verdict_s = verdict, now_s
        if isinstance(verdict, DangerEvent) and verdict.cause:
            text = f"danger: {verdict.cause} {verdict.signal} {verdict.value:.4g} (limit {verdict.limit:.4g})"
            self._lines.add(round(verdict.t_s, 2), "warning", text)

    def _take_arrival(self, arrival: Arrival, _now_s: float) -> None:
        index = self._index.get(PointId(*arrival.point))
        if index is not None and self._states[index] != MEASURED:
            self._mark(index, ARRIVED)

    def _take_fix(self, fix: FixMessage, now_s: float) -> None:
        self.links.fix_s = now_s
        if fix.is_fused:
            self._series["jump"].add(round(fix.t_s, 2), round(fix.jump_mm, 4))
        if fix.is_fused and fix.point is not None:
            self._measured(PointId(*fix.point), fix.t_s, fix.position_m)

    def _measured(self, point: PointId, t_s: float, position_m: Vector3) -> None:
        index = self._index.get(point)
        if index is None:
            return
        self._mark(index, MEASURED)
        mirror = self._mirror
        try:
            x_m, y_m, _ = mirror.foot_of_puck(position_m, self._puck_height_m)
        except ConvergenceError:
            return  # whatever it is a fix of, it is not on this mirror
        target = mirror.surface_point(*mirror.point_on_deck(point))
        error_mm = round(1e3 * dist(mirror.surface_point(x_m, y_m), target), 3)
        self._errors_mm[index] = error_mm
        self._series["arrival"].add(round(t_s, 2), error_mm)
        if not self.is_tracking:
            self._trail.add(x_m, y_m)

    def look_away(self) -> None:
        """Levels will not come any more; old ones are not shown."""
        self.links.look_away()
        self.picture = self.sensors = None

    def _take_track(self, track: Track, _now_s: float) -> None:
        rows = [row for row in track.rows if TruthCompare.is_compared(row[0])]
        if not rows:
            return
        poses = deck_poses(self._mirror, [PanelPose(PanelId(r[2], r[3]), r[4], r[5], r[6]) for r in rows])
        for row, (x_m, y_m) in zip(rows, poses[:, :2].tolist(), strict=True):
            self._trail.add(x_m, y_m)
            if self._is_sim:
                self._compared(self._truth.estimate(row[0], x_m, y_m, row[7]))
            elif int(row[1]) != self._sigma_second:
                self._sigma_second = int(row[1])
                self._series["error"].add(round(row[1], 2), None, round(3e3 * row[7], 3))

    def _take_truth(self, truth: Truth, _now_s: float) -> None:
        self._compared(self._truth.truth(row[:4] for row in truth.rows))

    def _compared(self, seconds: Iterable[Second]) -> None:
        for second in seconds:
            self._series["error"].add(round(second.t_s, 2), round(second.error_mm, 3), round(second.three_sigma_mm, 3))

    def _take_scene(self, scene: Scene, _now_s: float) -> None:
        self._scene, self._is_scene_new = scene, True

    def _take_log(self, log: Log, _now_s: float) -> None:
        self._lines.add(round(log.t_s, 2), log.level, log.text)

    def _mark(self, index: int | None, state: int) -> None:
        if index is not None:
            self._states[index] = state
            self._changed.add(index)

    # -- what goes out --------------------------------------------------------------------------------------------

    def news(self, now_s: float) -> dict[str, Any]:
        """All levels, and of what grows that which is new since the last time."""
        self._ticks += 1
        state = self._levels(now_s)
        state["points"] = [[k, self._states[k], self._errors_mm[k]] for k in sorted(self._changed)]
        state["path"] = self._trail.points.take_new()
        state["series"] = {name: new for name, series in self._series.items() if (new := series.take_new())}
        state["log"] = self._lines.take_new()
        if self._is_scene_new:
            state["shapes"] = self._shapes()
        self._changed.clear()
        self._is_scene_new = False
        return state

    def everything(self, now_s: float) -> dict[str, Any]:
        """All levels and all that has grown, for a page that begins. After ``news``, so that the two fit together."""
        state = self._levels(now_s)
        state["points"] = [[k, s, self._errors_mm[k]] for k, s in enumerate(self._states) if s != TODO]
        state["path"] = self._trail.points.rows
        state["series"] = {name: series.rows for name, series in self._series.items()}
        state["log"] = self._lines.rows
        state["shapes"] = self._shapes()
        return state

    def status_data(self, now_s: float) -> dict[str, Any]:
        """The levels with the run's trouble, for programs that ask."""
        return {**self._levels(now_s), "trouble": self.links.trouble(now_s)}

    def _levels(self, now_s: float) -> dict[str, Any]:
        return {
            "tick": self._ticks,
            "is_sim": self._is_sim,
            "is_over": self.links.is_over,
            "losses": [[loss.what, round(loss.for_s, 1)] for loss in self.links.losses(now_s)],
            "links": self.links.as_data(now_s),
            "restarts": self.links.restarts,
            "mission": self._mission(now_s),
            "pose": self._pose(),
            "verdict": self._shown_verdict(now_s),
            "robot": self._robot(),
        }

    def _mission(self, now_s: float) -> dict[str, Any] | None:
        if self.status is None:
            return None
        shown: dict[str, Any] = msgspec.to_builtins(self.status)
        shown["is_stale"] = now_s - self._status_s > STATUS_STALE_S and not self.links.is_over
        shown["next_point"] = self.status.point or self._first_to_do()
        return shown

    def _first_to_do(self) -> str:
        """On the way to a stop that is no point the mission names none."""
        done = (self.status is not None and self.status.outcome != "") or TODO not in self._states
        return "" if done else point_name(self.points[self._states.index(TODO)])

    def _pose(self) -> dict[str, Any] | None:
        p = self.picture
        if p is None:
            return None
        return {
            "t_s": round(p.t_s, 2),
            "x_m": round(p.x_m, 4),
            "y_m": round(p.y_m, 4),
            "heading_rad": round(p.heading_rad, 4),
            "covariance_m2": p.covariance_m2,
            "heading_sigma_rad": p.heading_sigma_rad,
        }

    def _shown_verdict(self, now_s: float) -> dict[str, Any] | None:
        v = self.verdict
        if v is None:
            return None
        shown: dict[str, Any] = {name: getattr(v, name) for name in ("cause", "signal", "value", "limit", "off")}
        shown["code"], shown["severity"] = int(v.code), int(v.severity)
        if isinstance(v, Verdict):
            shown["permits"] = {"forward": v.forward, "reverse": v.reverse, "turn": v.turn}
            shown["is_stale"] = now_s - self._verdict_s > STATUS_STALE_S and not self.links.is_over
        return shown

    def _robot(self) -> dict[str, Any] | None:
        s = self.sensors
        if s is None:
            return None
        return {
            "edges": list(s.edge[-1][1:]) if s.edge else None,
            "fans": s.fans,
            "charge": s.soc,
            "drive_age_s": round(s.cmd.age, 3),
            "permit_age_s": round(s.cmd.permit_age, 3),
            "is_held": s.cmd.held,
            "faults": s.faults,
        }

    def _shapes(self) -> list[Any]:
        shapes: list[Any] = msgspec.to_builtins(self._scene.shapes) if self._scene is not None else []
        return shapes
