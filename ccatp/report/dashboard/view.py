"""What every page shows, from what came over the bus: links, mission, verdict, pose, messages, the map.

Who is heard of, how long ago, and what is lost.

What grows while a run goes on: samples of plots, the driven path, messages; bounded, and what of it is new.
"""

from collections.abc import Callable, Iterable
from math import hypot
from typing import Any, NamedTuple

import msgspec

from ccatp.core import Verdict, danger_text
from ccatp.links.liveness import Liveness, kind_of
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import BY_NAME, DangerEvent, DisplayState, Heartbeat, LogMessage, Message, MissionStatus, Scene

LOOPS = ("main", "danger")
NAMES = {"main": "main loop", "danger": "danger loop"}
PICTURE_STALE_S = BY_NAME["display_state"].stale_after_s
STATUS_STALE_S = BY_NAME["mission"].stale_after_s


class LinkState(NamedTuple):
    """One end as the page shows it: its name, what it is at, seconds since its last word, and whether that is well."""

    name: str
    phase: str
    age_s: float | None
    is_well: bool


class Loss(NamedTuple):
    """What is lost, and for how long, s."""

    what: str
    for_s: float

    def __str__(self) -> str:
        return f"{self.what} for {self.for_s:.1f} s"


class Links:
    """Dates what comes from each process.

    Times called ``now_s`` are the machine's monotonic clock, by which processes date their presence as well.
    """

    def __init__(self, *, has_laser: bool = True) -> None:
        self._has_laser = has_laser
        self._liveness = Liveness()
        self._presences: dict[str, Heartbeat] = {}
        self._cut_s: dict[str, float] = {}
        self._restarts: dict[str, int] = {}
        self._picture_s: float | None = None
        self.fix_s: float | None = None
        self.is_over = False

    def presence(self, presence: Heartbeat) -> None:
        """A process is there."""
        name = presence.process
        before = self._presences.get(name)
        if before is not None and before.pid != presence.pid:
            self._restarts[name] = self._restarts.get(name, 0) + 1
            self._picture_s = None if name == "main" else self._picture_s
        if name in self._cut_s and (before is None or before.pid != presence.pid or presence.t_s > self._cut_s[name]):
            del self._cut_s[name]
        self._presences[name] = presence
        self._liveness.update(presence)

    def cut(self, name: str, now_s: float) -> None:
        """The connection to a process has ended: it is gone."""
        self._cut_s.setdefault(name, now_s)

    def picture(self, now_s: float) -> None:
        """Main has told its newest."""
        self._picture_s = now_s

    def look_away(self) -> None:
        """Nobody wants pictures any more, so that there are none means nothing."""
        self._picture_s = None

    def status(self, status: MissionStatus) -> None:
        """Main has told where the mission stands."""
        self.is_over = status.exit_status >= 0

    @property
    def restarts(self) -> dict[str, int]:
        """How often a process was started anew, as far as seen from here."""
        return {name: self._restarts.get(name, 0) for name in LOOPS}

    def losses(self, now_s: float) -> list[Loss]:
        """What is lost, the gravest first; empty when all is well, and when the mission is over."""
        if self.is_over:
            return []
        losses = [self._loss(name, now_s) for name in LOOPS]
        return [loss for loss in (*losses, self._robot_loss(now_s)) if loss is not None]

    def trouble(self, now_s: float) -> str:
        """Why the run is not well, or nothing; also while it is starting."""
        if self.is_over:
            return ""
        losses = self.losses(now_s)
        return str(losses[0]) if losses else self._liveness.trouble(now_s)

    def shown(self, now_s: float) -> list[LinkState]:
        """All ends."""
        links = [self._loop(name, now_s) for name in LOOPS]
        links.append(self._robot(now_s))
        return [*links, self._laser(now_s)] if self._has_laser else links

    def as_data(self, now_s: float) -> list[dict[str, Any]]:
        """All ends, for the page."""
        return [
            {**link._asdict(), "age_s": None if link.age_s is None else round(link.age_s, 2)}
            for link in self.shown(now_s)
        ]

    def _loss(self, name: str, now_s: float) -> Loss | None:
        presence = self._presences.get(name)
        if name in self._cut_s:
            return Loss(f"the {NAMES[name]} is gone", now_s - self._cut_s[name])
        if presence is None:
            return None
        age_s = now_s - presence.t_s
        picture_age_s = 0.0 if name != "main" or self._picture_s is None else now_s - self._picture_s
        if age_s > BY_NAME[f"heartbeat.{name}"].stale_after_s or picture_age_s > PICTURE_STALE_S:
            return Loss(f"the {NAMES[name]} has said nothing", max(age_s, picture_age_s))
        return None

    def _robot_loss(self, now_s: float) -> Loss | None:
        main = self._presences.get("main")
        if main is None or self._loss("main", now_s) is not None:
            return None
        age_s = self._frame_age_s(now_s)
        if main.phase == "rejoining":
            return Loss("the robot has been away", age_s or 0.0)
        if main.phase == "joined" and age_s is not None and age_s > STATUS_STALE_S:
            return Loss("the robot has sent no frame", age_s)
        return None

    def _frame_age_s(self, now_s: float) -> float | None:
        main = self._presences.get("main")
        if main is None or main.frame_age_s is None:
            return None
        return main.frame_age_s + now_s - main.t_s

    def _loop(self, name: str, now_s: float) -> LinkState:
        presence = self._presences.get(name)
        if name in self._cut_s:
            return LinkState(NAMES[name], "gone", now_s - self._cut_s[name], False)
        if presence is None:
            return LinkState(NAMES[name], "not heard of", None, False)
        return LinkState(NAMES[name], presence.phase, max(now_s - presence.t_s, 0.0), self._loss(name, now_s) is None)

    def _robot(self, now_s: float) -> LinkState:
        age_s = self._frame_age_s(now_s)
        if age_s is None:
            return LinkState("robot", "no frame yet", None, False)
        is_lost = self._robot_loss(now_s) is not None or self._loss("main", now_s) is not None
        return LinkState("robot", "lost" if is_lost else "frames", max(age_s, 0.0), not is_lost)

    def _laser(self, now_s: float) -> LinkState:
        if self.fix_s is None:
            return LinkState("laser", "no fix yet", None, True)
        return LinkState("laser", "last fix", now_s - self.fix_s, True)


Row = tuple[Any, ...]

# Nobody sees less than this on a map of six metres.
PATH_STEP_M = 0.02


class Growing:
    """Rows in the order in which they came.

    Args:
        limit: when there are more, every second one of the older half is dropped.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._rows: list[Row] = []
        self._new: list[Row] = []

    def add(self, *row: Any) -> None:
        """One more row."""
        self._rows.append(row)
        self._new.append(row)
        if len(self._rows) > self._limit:
            half = self._limit // 2
            self._rows[:half] = self._rows[:half:2]

    @property
    def rows(self) -> list[Row]:
        """All that are kept."""
        return self._rows

    @property
    def newest(self) -> Row | None:
        """The last one."""
        return self._rows[-1] if self._rows else None

    def take_new(self) -> list[Row]:
        """Those since the last time; nobody who has no page is told, so they are bounded as well."""
        new, self._new = self._new[-self._limit :], []
        return new


class Trail:
    """The driven path, as far as anybody looked; straight from stop to stop where nobody did."""

    def __init__(self, limit: int) -> None:
        self.points = Growing(limit)

    def add(self, x_m: float, y_m: float) -> None:
        """The robot is, or was, here; what is nearer to the last point than anybody sees is left out."""
        last = self.points.newest
        if last is None or hypot(x_m - last[0], y_m - last[1]) >= PATH_STEP_M:
            self.points.add(round(x_m, 3), round(y_m, 3))


class Lines:
    """The last lines told to the operator: of each kind the newest, and how often it was said.

    A row is the robot's time (s), the level, the text, how often lines of its kind were said, and the kind's number.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._rows: dict[tuple[str, str], Row] = {}
        self._new: dict[tuple[str, str], Row] = {}
        self._kinds = 0

    def add(self, t_s: float, level: str, text: str) -> None:
        """One more line."""
        key = level, kind_of(text)
        before = self._rows.pop(key, None)
        self._new.pop(key, None)
        self._kinds += before is None
        times, kind = (1, self._kinds) if before is None else (before[3] + 1, before[4])
        self._rows[key] = self._new[key] = (t_s, level, text, times, kind)
        for rows in (self._rows, self._new):
            if len(rows) > self._limit:
                del rows[next(iter(rows))]

    @property
    def rows(self) -> list[Row]:
        """All that are kept, the newest last."""
        return list(self._rows.values())

    def take_new(self) -> list[Row]:
        """Those since the last time."""
        new, self._new = list(self._new.values()), {}
        return new


MAX_PATH, MAX_SAMPLES, MAX_LINES = 12_000, 4_000, 200
_line = msgspec.json.Decoder(Sensors)


class RunStateView:
    """Hears the bus, and tells a page what is new. Missions add what is theirs.

    Attributes:
        is_tracking: the path comes as it is driven; else only its stops are known.
    """

    def __init__(self, *, is_sim: bool, series: Iterable[str], has_laser: bool = True) -> None:
        self._is_sim = is_sim
        self.links = Links(has_laser=has_laser)
        self.status: MissionStatus | None = None
        self.is_tracking = False
        self._status_s = self._verdict_s = float("-inf")
        self._picture: DisplayState | None = None
        self._sensors: Sensors | None = None
        self._verdict: Verdict | DangerEvent | None = None
        self._scene: Scene | None = None
        self._is_scene_new = False
        self._trail = Trail(MAX_PATH)
        self._series = {name: Growing(MAX_SAMPLES) for name in series}
        self._lines = Lines(MAX_LINES)
        self._ticks = 0
        self._takers: dict[type, Callable[[Any, float], None]] = {
            Heartbeat: self._take_presence,
            MissionStatus: self._take_status,
            DisplayState: self._take_picture,
            Verdict: self._take_verdict,
            DangerEvent: self._take_verdict,
            Scene: self._take_scene,
            LogMessage: self._take_log,
        }

    # -- what comes in --------------------------------------------------------------------------------------------

    def hear(self, message: Message | Verdict, now_s: float) -> None:
        """Take one message.

        Args:
            message: of the topic table; what the page does not show is ignored.
        """
        taker = self._takers.get(type(message))
        if taker is not None:
            taker(message, now_s)

    def _take_presence(self, presence: Heartbeat, _now_s: float) -> None:
        self.links.presence(presence)

    def _take_status(self, status: MissionStatus, now_s: float) -> None:
        self.status, self._status_s = status, now_s
        self.links.status(status)

    def _take_picture(self, picture: DisplayState, now_s: float) -> None:
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

    def _take_log(self, log: LogMessage, _now_s: float) -> None:
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
        return {"points": []}

    def _own_all(self) -> dict[str, Any]:
        return {"points": []}

    def _next_point(self) -> str:
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
