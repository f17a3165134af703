"""The topic table: all messages of the processes over ZeroMQ; ``ccatp.links.bus_codec`` is its codec.

Liveness, recording and displays use the table; a new topic needs one row. Levels are repeated at their rate.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import msgspec

from ccatp.core import NO_CAUSE, Cause, Verdict
from ccatp.missions import SEARCHED, MissionKind, all_kinds


class Message(msgspec.Struct, kw_only=True):
    """Base of all messages: every one carries a sequence number and a time."""

    seq: int
    t_s: float


class TrackBatch(Message):
    """Base of batches of estimates: a row for each frame, which begins with its number and time."""

    rows: list[Any]


class TruthBatch(Message):
    """Base of batches of the simulated truth, likewise."""

    rows: list[Any]


class Reached(Message):
    """Base of messages that a goal was reached; ``seq`` is the number that main recorded for the frame."""


class Heartbeat(Message):
    """Shows that a process is alive, with and without frames.

    ``phase``: starting, ready (the other loop may join), joined, rejoining (the link is lost), done. ``frame_age_s``:
    wall time since the process served its newest sensors frame, ``None`` before the first. ``t_s`` is of the machine's
    monotonic clock.
    """

    process: str
    pid: int
    phase: str
    frame_age_s: float | None = None


class EstimateMessage(Message):
    """The localizer's pose after frame ``seq``, deck frame, and the set points that main sent to the wheels.

    ``commanded``: lowest and highest set point of the right wheel, then of the left one, rad/s, over the drives sent
    since the last estimate. ``drive_seq``: number of the newest of them. ``grip``: full thrust over the least that
    holds the robot on all of the mirror, by the creep of turns; 0 where that is not measured.
    """

    x_m: float
    y_m: float
    heading_rad: float
    sigma_m: float
    state: str
    commanded: tuple[float, float, float, float] | None = None
    drive_seq: int = -1
    grip: float = 0.0

    def following(self, missed: "EstimateMessage") -> "EstimateMessage":
        """This estimate for a receiver that has not used the one before: ``commanded`` includes the drives of both."""
        mine, its = self.commanded, missed.commanded
        if mine is None or its is None:
            return self  # an unknown span stays unknown
        span = min(its[0], mine[0]), max(its[1], mine[1]), min(its[2], mine[2]), max(its[3], mine[3])
        return msgspec.structs.replace(self, commanded=span)


SeverityName = Literal["inform", "slow", "pause", "hold", "return", "fault"]


class Alarm(msgspec.Struct, kw_only=True):
    """One row of the list of alarms; times are UTC, empty where it has not happened."""

    name: str  # of the condition, see docs/alarms.md
    severity: SeverityName  # the highest so far
    cause: str
    advice: str
    since: str
    since_s: float  # robot time at which it began
    count: int = 1  # how often it began since it was in the list
    ended: str = ""
    acknowledged: str = ""
    acknowledged_by: str = ""


class Turn(msgspec.Struct, frozen=True, omit_defaults=True):
    """Whose turn it is, in names; ``ccatp.survey.turn`` makes it, and its words.

    ``kind``: of the phase. ``actor``: who acts next. ``next``: the next action. ``bars``: why resume is refused.
    ``offers``: the requests that the daemon would accept now. ``resumes``: another daemon can continue the mission.
    """

    kind: str = ""
    actor: str = ""
    next: str = ""
    why: Cause = NO_CAUSE
    bars: Cause = NO_CAUSE
    offers: tuple[str, ...] = ()
    resumes: bool = True


class MissionStatus(Message):
    """Mission state for operators."""

    state: str
    cause: str = ""  # for people
    condition: str = ""  # name of the cause, see docs/alarms.md; empty in older recordings
    done: int = 0
    skipped: int = 0
    total: int = 0
    point: str = ""
    elapsed_s: float = 0.0
    eta_s: float = 0.0
    error_mm: float = 0.0
    code: int = 0
    severity: int = 0  # of the newest verdict
    since_s: float = 0.0  # robot time at which the state began
    outcome: str = ""
    lower_bound_s: float = 0.0
    exit_status: int = -1  # of the run; -1 until it ends
    missed_deadlines: int = 0  # frames that were served late, in real time
    worst_lateness_ms: float = 0.0
    bad_lines: int = 0  # lines of the robot that are not valid, in the present session of the main loop
    bad_line: str = ""  # the field and the reason of the first of them
    left_out: dict[str, list[str]] = {}  # points skipped, or not measured any more, by the reason
    friction: float = 0.0  # of the tyres, by the creep of turns; 0: not measured
    grip: float = 0.0  # full thrust over the least that holds the robot on all of the mirror with it
    alarms: list[Alarm] = []  # the highest severity first, ended ones last
    turn: Turn = Turn()  # empty in older recordings
    stopped_by: str = ""  # the operator who stopped the run
    summary_state: str = ""  # offline, standby, disabled, enabled or fault; empty in older recordings


class DisplayState(Message):
    """The newest values for a display (pose: deck frame), published while there is a subscriber."""

    x_m: float
    y_m: float
    heading_rad: float
    covariance_m2: tuple[float, float, float]
    heading_sigma_rad: float
    nis: float  # normalised innovation squared of the filter's last update
    size: int  # its degrees of freedom; 0 for none
    line: msgspec.Raw  # the newest line of the robot


class RobotShape(msgspec.Struct, omit_defaults=True):
    """An object on the map, in the plane of the pose; its ``id`` is the same in all messages."""

    id: str
    kind: str  # for its symbol, as obstacle, target, robot, trail; others get a default symbol
    x_m: float
    y_m: float
    covariance_m2: tuple[float, float, float] | None = None  # of x and y: xx, xy, yy; drawn as its ellipse
    heading_rad: float | None = None
    radius_m: float | None = None
    outline_m: list[tuple[float, float]] = []  # a line; closed if the last point is the first one
    label: str = ""


class Scene(Message):
    """All objects on the map besides the mirror and the robot."""

    shapes: list[RobotShape]


class TrackMessage(TrackBatch):
    """A batch of estimates.

    Rows: seq, t_s, row and column of the panel, x_m, y_m, heading_rad (panel frame), sigma_m.
    """

    rows: list[tuple[int, float, int, int, float, float, float, float]]


class SensorLines(Message):
    """A batch of sensors lines as they came from the robot, each a JSON object of the robot link."""

    lines: list[msgspec.Raw]


class ArrivalMessage(Reached):
    """The robot came to rest at a measurement point for the first time; ``error_mm`` is the estimated distance."""

    point: tuple[int, int, int]
    error_mm: float


class FixMessage(Message):
    """A fix taken after frame ``seq``, world frame; without a point it only localizes the robot."""

    point: tuple[int, int, int] | None
    is_fused: bool  # false: refused, because it is doubted and measured again or cannot be used
    position_m: tuple[float, float, float]
    covariance_m2: list[float]
    dop: float
    residual_rms_m: float
    channels: list[int]
    jump_mm: float
    is_set_aside: bool = False  # doubted before the localizer saw it
    # Not in recordings of older versions; as in ``core.Fix``.
    left_out: list[int] = []
    lengths_m: list[float] = []
    metrology: str = ""
    suspects: list[int] = []
    detectable_m: float | None = None
    protection_m: float | None = None
    warnings: list[str] = []


class Rest(Message):
    """For the mission the robot is at rest from frame ``seq`` on."""


TreatmentKind = Literal["begun", "coasted", "doubted", "odometry_off", "odometry_on"]


class Treatment(Message):
    """An input of the localizer besides samples and fixes, from frame ``seq`` on.

    ``begun``: it starts again before this frame; values: x (m), y (m), heading (rad), deck frame, and the standard
    deviations of position (m) and heading (rad). ``coasted``: encoders are silent; values: predicted turns of the right
    and the left wheel in this frame, rad, growth of their variances and of their covariance, rad^2. ``doubted``: after
    the samples of this frame its covariance is inflated; values: standard deviations, m and rad. ``odometry_off``:
    wheels and inertial unit are not used, the robot stands; ``odometry_on``: they are used again.
    """

    kind: TreatmentKind
    values: tuple[float, ...] = ()


class SessionMessage(Message):
    """Main joined the robot: frames recorded from here on are of this boot and session of the robot.

    ``frames_before``: the number of a frame in ``track`` and ``arrival`` is the robot's ``seq`` plus this.
    """

    boot: int
    session: int
    frames_before: int


class DangerEvent(Message):
    """The verdict's code, cause or severity changed; without a cause nothing is found any more.

    ``cause``: for people. ``condition``: its name, empty in older recordings. ``active``: all findings of danger, that
    of the verdict included: name of the condition, cause, severity.
    """

    code: int
    cause: str
    signal: str
    value: float
    limit: float
    off: tuple[bool, bool, bool, bool]
    severity: int = 0
    condition: str = ""
    active: list[tuple[str, str, int]] = []


# Event of log lines that are also shown to the operator; their field ``text`` is shown.
LEVELS = {"info": 20, "warning": 30, "error": 40}
OPERATOR_MESSAGE = "operator_message"


class LogMessage(Message):
    """One line for the operator's terminal."""

    level: str
    process: str
    text: str


class Timing(Message):
    """Wall time of main-loop ticks, microseconds."""

    tick_us: list[float]


class TruthMessage(TruthBatch):
    """A batch of simulated truth (simulation only).

    Rows: seq, t_s, x_m, y_m, heading_rad (deck), X, Y, Z (surface point, deck, m), clearance of the worst edge sensor
    to the rim (m), fallen (0 or 1), mask of the edge sensors beyond the rim (bit 0 = front left). ``boots``: ``seq``
    before the first frame of each boot of the robot; the truth counts on over them. Empty in older recordings.
    """

    rows: list[tuple[int, float, float, float, float, float, float, float, float, int, int]]
    boots: list[int] = []


class Misalignment(Message):
    """True misalignment of the simulated panels (simulation only): row, column, piston_m, tip_rad, tilt_rad."""

    panels: list[tuple[int, int, float, float, float]]


@dataclass(frozen=True, slots=True)
class Topic:
    """One row of the table."""

    name: str  # prefix of the JSON
    message: type[Message] | type[Verdict]
    publisher: str
    rate_hz: float  # nominal; 0 for an event
    stale_after_s: float  # a level older than this must not be used; 0 for events and batches
    recorded: bool  # goes to ``telemetry.mcap``


TOPICS: tuple[Topic, ...] = (
    Topic("heartbeat.main", Heartbeat, "main", 10.0, 1.0, False),
    Topic("heartbeat.danger", Heartbeat, "danger", 10.0, 1.0, False),
    Topic("heartbeat.dashboard", Heartbeat, "dashboard", 2.0, 5.0, False),
    Topic("display_state", DisplayState, "main", 10.0, 0.8, False),
    Topic("scene", Scene, "main", 2.0, 5.0, False),
    Topic("estimate", EstimateMessage, "main", 20.0, 0.15, False),
    Topic("verdict", Verdict, "danger", 100.0, 0.15, False),
    Topic("mission", MissionStatus, "main", 10.0, 1.0, True),
    Topic("track", TrackMessage, "main", 1.0, 0.0, True),
    Topic("sensors", SensorLines, "main", 1.0, 0.0, True),
    Topic("session", SessionMessage, "main", 0.0, 0.0, True),
    Topic("arrival", ArrivalMessage, "main", 0.0, 0.0, True),
    Topic("rest", Rest, "main", 0.0, 0.0, True),
    Topic("treatment", Treatment, "main", 0.0, 0.0, True),
    Topic("fix", FixMessage, "main", 0.0, 0.0, True),
    Topic("danger_event", DangerEvent, "danger", 0.0, 0.0, True),
    Topic("log", LogMessage, "main", 0.0, 0.0, True),
    Topic("timing", Timing, "main", 1.0, 0.0, False),
    Topic("misalignment", Misalignment, "dataloop", 0.0, 0.0, True),
    Topic("truth", TruthMessage, "dataloop", 1.0, 0.0, True),
)
BY_NAME = {topic.name: topic for topic in TOPICS}


@cache
def topics_of(kind: MissionKind) -> tuple[Topic, ...]:
    """The topics of a run of one kind of mission: those of every run, and its own."""
    return TOPICS if kind.topics is None else (*TOPICS, *kind.topics.get())


@cache
def _add_topics(kinds: Callable[[], Iterable[MissionKind]]) -> None:
    BY_NAME.update((topic.name, topic) for kind in kinds() for topic in topics_of(kind))


def all_topics() -> tuple[Topic, ...]:
    """The topics of every kind of mission."""
    return tuple(dict.fromkeys(topic for kind in all_kinds() for topic in topics_of(kind)))


def find_topic(name: str) -> Topic | None:
    """The row of a topic; ``None``: no kind of mission has it."""
    for kinds in SEARCHED:
        if name in BY_NAME:
            break
        _add_topics(kinds)
    return BY_NAME.get(name)


# Danger advances the pose by the wheels itself, so a pose in every fifth frame is enough.
ESTIMATE_FRAMES = 5


def is_estimate_due(seq: int) -> bool:
    """Whether main publishes its estimate after frame ``seq``."""
    return seq % ESTIMATE_FRAMES == 0


def last_estimate_before(seq: int) -> int:
    """The frame of the newest estimate that the verdict on frame ``seq`` is based on, < 0 for none."""
    return (seq - 1) // ESTIMATE_FRAMES * ESTIMATE_FRAMES if seq > 0 else -1


def schema_of(name: str) -> dict[str, Any]:
    """JSON schema of a topic's messages."""
    topic = find_topic(name)
    if topic is None:
        raise KeyError(name)
    return msgspec.json.schema(topic.message)
