"""Pure. What every page shows, from what came over the bus: links, mission, verdict, pose, messages, the map."""

from collections.abc import Callable, Iterable
from typing import Any

import msgspec

from ccatp.danger_text import danger_text
from ccatp.dashboard.links import STATUS_STALE_S, Links
from ccatp.dashboard.series import Growing, Lines, Trail
from ccatp.samples import Verdict
from ccatp.wire.robot_messages import Sensors
from ccatp.wire.topics import DangerEvent, Log, Message, MissionStatus, Picture, Presence, Scene

MAX_PATH, MAX_SAMPLES, MAX_LINES = 12_000, 4_000, 200
_line = msgspec.json.Decoder(Sensors)


class View:
    """Hears the bus, and tells a page what is new. Missions add what is theirs.

    Args:
        is_sim: the robot is a stand-in.
        series: names of the plots.
        has_laser: a laser system measures.

    Attributes:
        links: who is heard of.
        status: where the mission stands, once it is known.
        is_tracking: the path comes as it is driven; else only its stops are known.
    """

    def __init__(self, *, is_sim: bool, series: Iterable[str], has_laser: bool = True) -> None:
        """Nothing heard."""
        self._is_sim = is_sim
        self.links = Links(has_laser=has_laser)
        self.status: MissionStatus | None = None
        self.is_tracking = False
        self._status_s = self._verdict_s = float("-inf")
        self._picture: Picture | None = None
        self._sensors: Sensors | None = None
        self._verdict: Verdict | DangerEvent | None = None
        self._scene: Scene | None = None
        self._is_scene_new = False
        self._trail = Trail(MAX_PATH)
        self._series = {name: Growing(MAX_SAMPLES) for name in series}
        self._lines = Lines(MAX_LINES)
        self._ticks = 0
        self._takers: dict[type, Callable[[Any, float], None]] = {
            Presence: self._take_presence,
            MissionStatus: self._take_status,
            Picture: self._take_picture,
            Verdict: self._take_verdict,
            DangerEvent: self._take_verdict,
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

    def _take_presence(self, presence: Presence, _now_s: float) -> None:
        self.links.presence(presence)

    def _take_status(self, status: MissionStatus, now_s: float) -> None:
        self.status, self._status_s = status, now_s
        self.links.status(status)

    def _take_picture(self, picture: Picture, now_s: float) -> None:
        self.links.picture(now_s)
        self._picture = picture
        try:
            self._sensors = _line.decode(picture.line)
        except msgspec.MsgspecError:
            self._sensors = None  # no frame yet

    def _take_verdict(self, verdict: Verdict | DangerEvent, now_s: float) -> None:
        self._verdict, self._verdict_s = verdict, now_s
        if isinstance(verdict, DangerEvent) and verdict.cause:
            text = danger_text(verdict.cause, verdict.signal, verdict.value, verdict.limit)
            self._lines.add(round(verdict.t_s, 2), "warning", f"danger: {text}")

    def _take_scene(self, scene: Scene, _now_s: float) -> None:
        self._scene, self._is_scene_new = scene, True

    def _take_log(self, log: Log, _now_s: float) -> None:
        self._lines.add(round(log.t_s, 2), log.level, log.text)

    def look_away(self) -> None:
        """Levels will not come any more; old ones are not shown."""
        self.links.look_away()
        self._picture = self._sensors = None

    # -- what goes out --------------------------------------------------------------------------------------------

    def news(self, now_s: float) -> dict[str, Any]:
        """All levels, and of what grows that which is new since the last time."""
        self._ticks += 1
        state = self._levels(now_s) | self._own_news()
        state["path"] = self._trail.points.take_new()
        state["series"] = {name: new for name, series in self._series.items() if (new := series.take_new())}
        state["log"] = self._lines.take_new()
        if self._is_scene_new:
            state["shapes"] = self._shapes()
        self._is_scene_new = False
        return state

    def everything(self, now_s: float) -> dict[str, Any]:
        """All levels and all that has grown, for a page that begins. After ``news``, so that the two fit together."""
        state = self._levels(now_s) | self._own_all()
        state["path"] = self._trail.points.rows
        state["series"] = {name: series.rows for name, series in self._series.items()}
        state["log"] = self._lines.rows
        state["shapes"] = self._shapes()
        return state

    def status_data(self, now_s: float) -> dict[str, Any]:
        """The levels with the run's trouble, for programs that ask."""
        return {**self._levels(now_s), "trouble": self.links.trouble(now_s)}

    def _own_news(self) -> dict[str, Any]:
        """What of this mission's own is new."""
        return {"points": []}

    def _own_all(self) -> dict[str, Any]:
        """All of this mission's own."""
        return {"points": []}

    def _next_point(self) -> str:
        """Where the robot is bound for."""
        return "" if self.status is None else self.status.point

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
        shown["next_point"] = self._next_point()
        shown["not_to_be_measured"] = sum(map(len, self.status.left_out.values()))
        return shown

    def _pose(self) -> dict[str, Any] | None:
        p = self._picture
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
        v = self._verdict
        if v is None:
            return None
        shown: dict[str, Any] = {name: getattr(v, name) for name in ("cause", "signal", "value", "limit", "off")}
        shown["code"], shown["severity"] = int(v.code), int(v.severity)
        shown["text"] = danger_text(v.cause, v.signal, v.value, v.limit)
        if isinstance(v, Verdict):
            shown["permits"] = {"forward": v.forward, "reverse": v.reverse, "turn": v.turn}
            shown["is_stale"] = now_s - self._verdict_s > STATUS_STALE_S and not self.links.is_over
        return shown

    def _robot(self) -> dict[str, Any] | None:
        s = self._sensors
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
