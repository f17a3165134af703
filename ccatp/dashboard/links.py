"""Pure. Who is heard of, how long ago, and what is lost."""

from typing import Any, NamedTuple

from ccatp.liveness import Liveness
from ccatp.wire.topics import BY_NAME, MissionStatus, Presence

LOOPS = ("main", "danger")
NAMES = {"main": "main loop", "danger": "danger loop"}
PICTURE_STALE_S = BY_NAME["picture"].stale_after_s
STATUS_STALE_S = BY_NAME["mission"].stale_after_s


class Link(NamedTuple):
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

    Args:
        has_laser: a laser system measures.
    """

    def __init__(self, *, has_laser: bool = True) -> None:
        """Nothing heard."""
        self._has_laser = has_laser
        self._liveness = Liveness()
        self._presences: dict[str, Presence] = {}
        self._cut_s: dict[str, float] = {}
        self._restarts: dict[str, int] = {}
        self._picture_s: float | None = None
        self.fix_s: float | None = None
        self.is_over = False

    def presence(self, presence: Presence) -> None:
        """A process is there."""
        name = presence.process
        before = self._presences.get(name)
        if before is not None and before.pid != presence.pid:
            self._restarts[name] = self._restarts.get(name, 0) + 1
            self._picture_s = None if name == "main" else self._picture_s
        if name in self._cut_s and (before is None or before.pid != presence.pid or presence.t_s > self._cut_s[name]):
            del self._cut_s[name]
        self._presences[name] = presence
        self._liveness.heard(presence)

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

    def shown(self, now_s: float) -> list[Link]:
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
        if age_s > BY_NAME[f"presence.{name}"].stale_after_s or picture_age_s > PICTURE_STALE_S:
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

    def _loop(self, name: str, now_s: float) -> Link:
        presence = self._presences.get(name)
        if name in self._cut_s:
            return Link(NAMES[name], "gone", now_s - self._cut_s[name], False)
        if presence is None:
            return Link(NAMES[name], "not heard of", None, False)
        return Link(NAMES[name], presence.phase, max(now_s - presence.t_s, 0.0), self._loss(name, now_s) is None)

    def _robot(self, now_s: float) -> Link:
        age_s = self._frame_age_s(now_s)
        if age_s is None:
            return Link("robot", "no frame yet", None, False)
        is_lost = self._robot_loss(now_s) is not None or self._loss("main", now_s) is not None
        return Link("robot", "lost" if is_lost else "frames", max(age_s, 0.0), not is_lost)

    def _laser(self, now_s: float) -> Link:
        if self.fix_s is None:
            return Link("laser", "no fix yet", None, True)
        return Link("laser", "last fix", now_s - self.fix_s, True)
