"""The state that every page shows, made from the messages of the bus: links, mission, verdict, pose, messages, map."""

import platform
import time
from collections.abc import Callable, Iterable
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

import ccatp
from ccatp.conditions import danger_text, text_of
from ccatp.conditions.danger import EARTHQUAKE, EMERGENCY
from ccatp.conditions.mission import OPERATOR
from ccatp.core import EmergencyKind, Verdict
from ccatp.links import topics
from ccatp.links.liveness import Liveness
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import BY_NAME, Heartbeat, MissionStatus, TruthBatch
from ccatp.report.dashboard.history import GAP_S, Growing, Lines, RunFollower, Trail, TruthCompare
from ccatp.survey.turn import is_under_way, turn_text

LOOPS = ("main", "danger")
NAMES = {"main": "main loop", "danger": "danger loop"}
PICTURE_STALE_S = BY_NAME["display_state"].stale_after_s
STATUS_STALE_S = BY_NAME["mission"].stale_after_s
LATE_HEARTBEAT_S = 3.0 / BY_NAME["heartbeat.main"].rate_hz


class LinkState(msgspec.Struct, frozen=True):
    """Link to a process or device: its phase, age of its last message (s), and whether the link works."""

    name: str
    phase: str
    age_s: float | None
    is_well: bool


class Loss(NamedTuple):
    """A lost link, and the time since its loss (s)."""

    what: str
    for_s: float

    def __str__(self) -> str:
        return f"{self.what} for {self.for_s:.1f} s"


class Links:
    """Age of the last message of each process; times are the machine's monotonic clock."""

    def __init__(self, *, has_laser: bool = True) -> None:
        self._has_laser = has_laser
        self._liveness = Liveness()
        self._cut_s: dict[str, float] = {}
        self.restarts = dict.fromkeys(LOOPS, 0)  # as far as they were seen from here
        # Of the last display state; None while none is requested: its absence is no loss.
        self.picture_s: float | None = None
        self.fix_s: float | None = None  # of the last fix
        self.is_over = False

    def presence(self, presence: Heartbeat) -> None:
        """Store the heartbeat of a process."""
        name = presence.process
        before = self._liveness.heartbeats.get(name)
        is_new = before is None or before.pid != presence.pid
        if before is not None and is_new:
            self.restarts[name] += 1
            self.picture_s = None if name == "main" else self.picture_s
        if name in self._cut_s and (is_new or presence.t_s > self._cut_s[name]):
            del self._cut_s[name]
        self._liveness.update(presence)

    @property
    def pids(self) -> dict[str, int]:
        """Of each loop that has reported."""
        return {name: beat.pid for name, beat in self._liveness.heartbeats.items() if name in LOOPS}

    def cut(self, name: str, now_s: float) -> None:
        """Store that the connection to a process has ended."""
        self._cut_s.setdefault(name, now_s)

    def sensors_age_s(self, now_s: float) -> float | None:
        """Age of the newest frame by the main loop's last heartbeat, plus the heartbeat's age if that is late (s)."""
        main = self._liveness.heartbeats.get("main")
        if main is None or main.frame_age_s is None:
            return None
        late_s = now_s - main.t_s
        return main.frame_age_s + (late_s if late_s > LATE_HEARTBEAT_S else 0.0)

    def losses(self, now_s: float) -> list[Loss]:
        """Lost links, the most severe first; none when the mission is over."""
        return [] if self.is_over else [loss for _, loss in self._ends(now_s) if loss is not None]

    def trouble(self, now_s: float) -> str:
        """The problem of the run, also while it starts; empty if there is none."""
        if self.is_over:
            return ""
        losses = self.losses(now_s)
        return str(losses[0]) if losses else self._liveness.trouble(now_s)

    def shown(self, now_s: float) -> list[LinkState]:
        """All links."""
        return [link for link, _ in self._ends(now_s)]

    def _ends(self, now_s: float) -> list[tuple[LinkState, Loss | None]]:
        """Each link, and its loss or None."""
        ends = [self._loop(name, now_s) for name in LOOPS]
        ends.append(self._robot(now_s, is_main_lost=ends[0][1] is not None))
        if self._has_laser:
            phase = "no fix yet" if self.fix_s is None else "last fix"
            ends.append((LinkState("laser", phase, _age_s(self.fix_s, now_s), True), None))
        return ends

    def _loop(self, name: str, now_s: float) -> tuple[LinkState, Loss | None]:
        presence, cut_s = self._liveness.heartbeats.get(name), self._cut_s.get(name)
        what, loss = f"the {NAMES[name]}", None
        phase, since_s = ("no heartbeat yet", None) if presence is None else (presence.phase, presence.t_s)
        if cut_s is not None:
            phase, since_s, loss = "gone", cut_s, Loss(f"{what} is gone", now_s - cut_s)
        elif presence is not None:
            age_s = now_s - presence.t_s
            picture_age_s = 0.0 if name != "main" or self.picture_s is None else now_s - self.picture_s
            if age_s > BY_NAME[f"heartbeat.{name}"].stale_after_s or picture_age_s > PICTURE_STALE_S:
                loss = Loss(f"{what} has not reported", max(age_s, picture_age_s))
        is_well = presence is not None and loss is None
        return LinkState(NAMES[name], phase, _age_s(since_s, now_s), is_well), loss

    def _robot(self, now_s: float, *, is_main_lost: bool) -> tuple[LinkState, Loss | None]:
        main, loss = self._liveness.heartbeats.get("main"), None
        frame_s = None if main is None or main.frame_age_s is None else main.t_s - main.frame_age_s
        age_s = 0.0 if frame_s is None else now_s - frame_s
        if main is not None and not is_main_lost and main.phase == "rejoining":
            loss = Loss("the robot has been away", age_s)
        elif main is not None and not is_main_lost and main.phase == "joined" and age_s > STATUS_STALE_S:
            loss = Loss("the robot has sent no frame", age_s)
        is_well = frame_s is not None and loss is None and not is_main_lost
        phase = "frames" if is_well else "no frame yet" if frame_s is None else "lost"
        return LinkState("robot", phase, _age_s(frame_s, now_s), is_well), loss


def _alarm_of(kind: object) -> str:
    """The name of the alarm about an emergency of a kind."""
    return EARTHQUAKE.name if kind == EmergencyKind.EARTHQUAKE else EMERGENCY.name


def _age_s(since_s: float | None, now_s: float) -> float | None:
    return None if since_s is None else round(max(now_s - since_s, 0.0), 2)


# State of a point; arrived: the robot is at rest there.
PLANNED, ARRIVED, MEASURED, SKIPPED = range(4)
MAX_PATH, MAX_SAMPLES, MAX_LINES = 12_000, 4_000, 200
# After less time the rate of mission time to real time is not known, and the finish is predicted in real time.
PACE_AFTER_S = 10.0
NO_LINE = msgspec.Raw(b"null")
_line = msgspec.json.Decoder(Sensors)


class RunStateView:
    """Keeps the state of a run up to date, and returns what is new; a subclass adds that of its kind of mission.

    ``lines``: series that are drawn as lines; the others are single events, between which nothing is missing.
    """

    def __init__(
        self, *, points: int, is_sim: bool, series: Iterable[str], lines: Iterable[str], run_dir: Path | None = None,
        has_laser: bool = True,
    ) -> None:  # fmt: skip
        self._is_sim = is_sim
        self.links = Links(has_laser=has_laser)
        self.status: MissionStatus | None = None
        self.is_watched = False  # display states come ten times a second, otherwise once
        self._offset_s: float | None = None  # from the robot's time to that of the mission
        self._began: tuple[float, float] | None = None  # our and the mission's time when that began to pass here
        self._status_s = self._verdict_s = float("-inf")
        self._picture: topics.DisplayState | None = None
        self._sensors: Sensors | None = None
        self._verdict: Verdict | topics.DangerEvent | None = None
        self._scene: topics.Scene | None = None
        self._is_scene_new = False
        self._trail = Trail(MAX_PATH, GAP_S)
        self._series = {name: Growing(MAX_SAMPLES, GAP_S if name in set(lines) else inf) for name in series}
        self._lines = Lines(MAX_LINES)
        self._files = RunFollower(run_dir, self._lines)
        self.read_files, self.close = self._files.read, self._files.close
        self._states = [PLANNED] * points
        self._errors_mm: list[float | None] = [None] * points
        self._changed: set[int] = set()
        self._truth = TruthCompare(self._series["error"])
        self._sigma_second = -1
        self._ticks = 0
        self._handlers: dict[type, Callable[[Any, float], None]] = {
            Heartbeat: lambda heartbeat, _: self.links.presence(heartbeat),
            MissionStatus: self._take_status,
            topics.DisplayState: self._take_picture,
            Verdict: self._take_verdict,
            topics.DangerEvent: self._take_verdict,
            topics.Scene: self._take_scene,
        }

    def receive(self, message: topics.Message | Verdict, now_s: float) -> None:
        """Process a message of the bus; messages that the page does not show are ignored."""
        if isinstance(message, TruthBatch):
            self._take_truth(message, now_s)
        handler = self._handlers.get(type(message))
        if handler is not None:
            handler(message, now_s)

    def prepend(self, past: "RunStateView") -> None:
        """Insert the earlier data of another view before the data of this one."""
        self._trail.prepend(past._trail.rows)
        for name, series in self._series.items():
            series.prepend(past._series[name].rows)

    def _mission_s(self, t_s: float) -> float | None:
        """Convert robot time to mission time, which continues when a robot boots or a run is resumed."""
        return None if self._offset_s is None else round(t_s + self._offset_s, 2)

    def _take_status(self, status: MissionStatus, now_s: float) -> None:
        self.status, self._status_s = status, now_s
        offset_s = status.elapsed_s - status.t_s
        if self._offset_s is None or abs(offset_s - self._offset_s) > STATUS_STALE_S:
            self._offset_s = offset_s
        if self._began is None and status.elapsed_s > 0.0:
            self._began = now_s, status.elapsed_s
        self.links.is_over = status.exit_status >= 0

    def _take_picture(self, picture: topics.DisplayState, now_s: float) -> None:
        if not self.is_watched:
            return
        self.links.picture_s = now_s
        self._picture = msgspec.structs.replace(picture, line=NO_LINE)
        try:
            self._sensors = _line.decode(picture.line)
        except msgspec.MsgspecError:
            self._sensors = None  # no frame yet

    def _take_verdict(self, verdict: Verdict | topics.DangerEvent, now_s: float) -> None:
        self._verdict, self._verdict_s = verdict, now_s

    def _take_scene(self, scene: topics.Scene, _now_s: float) -> None:
        self._scene, self._is_scene_new = scene, True

    def discard_picture(self) -> None:
        """Discard the last display state: no new ones are requested."""
        self.links.picture_s = self._picture = self._sensors = None

    def news(self, now_s: float) -> dict[str, Any]:
        """The levels, and the new rows of the growing data."""
        self._ticks += 1
        state = self._levels(now_s) | {
            "points": [[k, self._states[k], self._errors_mm[k]] for k in sorted(self._changed)],
            "path": self._trail.take_new(),
            "series": {name: new for name, series in self._series.items() if (new := series.take_new())},
            "log": self._lines.take_new(),
            **({"shapes": self._shapes()} if self._is_scene_new else {}),
        }
        self._changed.clear()
        self._is_scene_new = False
        return state

    def everything(self, now_s: float) -> dict[str, Any]:
        """The levels and all rows, for a new page; to be called after ``news``, so that no row is sent twice."""
        return self._levels(now_s) | {
            "points": [[k, s, self._errors_mm[k]] for k, s in enumerate(self._states) if s != PLANNED],
            "path": self._trail.rows,
            "series": {name: series.rows for name, series in self._series.items()},
            "log": self._lines.rows,
            "shapes": self._shapes(),
        }

    def status_data(self, now_s: float) -> dict[str, Any]:
        """The levels with the run's problem, for ``/status``."""
        return {**self._levels(now_s), "trouble": self.links.trouble(now_s)}

    def _mark(self, index: int, state: int) -> None:
        self._states[index] = state
        self._changed.add(index)

    def _take_estimate(self, seq: int, t_s: float, x_m: float, y_m: float, sigma_m: float) -> None:
        if self._is_sim:
            self._truth.estimate(seq, x_m, y_m, sigma_m)
        elif int(t_s) != self._sigma_second:
            self._sigma_second = int(t_s)
            self._series["error"].add(self._mission_s(t_s), None, round(3e3 * sigma_m, 3))

    def _take_truth(self, truth: TruthBatch, _now_s: float) -> None:
        for seq, t_s, x_m, y_m, *_ in truth.rows:
            if (mission_s := self._mission_s(t_s)) is not None:
                self._truth.truth(seq, mission_s, x_m, y_m)

    def _next_point(self, status: MissionStatus) -> str:
        return status.point

    def _finish_in_s(self, status: MissionStatus, now_s: float) -> float | None:
        """Real time until the expected end (s); in lockstep mission time does not run at the rate of real time."""
        if not is_under_way(status) or self._began is None or status.eta_s <= 0.0:
            return None
        began_s, elapsed_s = self._began
        if (watched_s := now_s - began_s) < PACE_AFTER_S or status.elapsed_s <= elapsed_s:
            return status.eta_s
        return status.eta_s * watched_s / (status.elapsed_s - elapsed_s)

    def _levels(self, now_s: float) -> dict[str, Any]:
        """The data that are sent whole each time; pose, mission and verdict have the fields of their messages."""

        def is_stale(since_s: float) -> bool:
            return now_s - since_s > STATUS_STALE_S and not self.links.is_over

        mission: dict[str, Any] | None = None
        if (status := self.status) is not None:
            mission = msgspec.to_builtins(status) | {
                "is_stale": is_stale(self._status_s),
                "next_point": "" if status.outcome or status.exit_status >= 0 else self._next_point(status),
                "not_to_be_measured": sum(map(len, status.left_out.values())),
                "finish_in_s": self._finish_in_s(status, now_s),
                "age_s": round(max(now_s - self._status_s, 0.0), 2),
                "turn_text": {**turn_text(status)._asdict(), "line": turn_text(status).line},
                "is_by_operator": status.condition == OPERATOR.name,
            }
        verdict: dict[str, Any] | None = None
        if (v := self._verdict) is not None:
            verdict = msgspec.to_builtins(v)
            if isinstance(v, Verdict):
                verdict |= {"cause": text_of(v.cause), "condition": v.cause.condition}
                verdict["is_stale"] = is_stale(self._verdict_s)
            cause = verdict["condition"], verdict["cause"]
            verdict["text"] = danger_text(*cause, v.signal, v.value, v.limit)
        return {
            "tick": self._ticks,
            "is_sim": self._is_sim,
            "is_over": self.links.is_over,
            "losses": self.links.losses(now_s),
            "links": self.links.shown(now_s),
            "restarts": self.links.restarts,
            "pids": self.links.pids,
            "mission": mission,
            "pose": self._picture,
            "verdict": verdict,
            "robot": self._robot(),
            "sensors_age_s": self.links.sensors_age_s(now_s),
            "utc_s": time.time(),
            "started": self._files.started,
            "emergencies": [{**one, "alarm": _alarm_of(one.get("kind"))} for one in self._files.emergencies],
            "messages_left_out": self._lines.left_out,
            "alarms": [] if mission is None else mission.pop("alarms"),
        }

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
        return [] if self._scene is None else [*msgspec.to_builtins(self._scene.shapes)]


def run_ground(folder: Path) -> dict[str, Any]:
    """What the page says of each run."""
    return {
        "run": folder.name,
        "version": ccatp.__version__,
        "host": platform.node(),
        "emergency_kinds": [str(kind) for kind in EmergencyKind],
        "stale_after_s": {name: BY_NAME[f"heartbeat.{loop}"].stale_after_s for loop, name in NAMES.items()},
    }
