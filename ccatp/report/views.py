"""Topics for viewers, named ``view/...``, and their derivation from the messages of a run.

They have at most a tenth of the frame rate, so that they add little to a recording. Constant ones (frames, the map of
panels) are latched: a late subscriber gets the last message.
"""

from collections.abc import Iterator, Sequence
from math import cos, hypot, sin
from typing import Any, NamedTuple, NotRequired, TypedDict

import msgspec

from ccatp.core import DeckPose, PanelId, PanelPose, PointId, wrap_pi
from ccatp.links.topics import (
    TOPICS,
    EstimateMessage,
    FixMessage,
    LogMessage,
    Message,
    SensorLines,
    TrackMessage,
    TruthMessage,
    schema_of,
)
from ccatp.mirror.mirror import Mirror, deck_poses
from ccatp.report import foxglove
from ccatp.report.foxglove import DECK, panel_scene, plain_schema, point_scene, quaternion, robot_rotation, time_of

WORLD, ROBOT = "world", "robot"
WHEELS, INERTIAL = ("wheel_right_rad_s", "wheel_left_rad_s"), ("acceleration_m_s2", "yaw_rate_rad_s")
EDGES = ("edge_front_left", "edge_front_right", "edge_rear_left", "edge_rear_right")
EVERY_FRAMES = 10
# All points are published again at this period, for viewers that start in the middle of a recording.
POINTS_AGAIN_S = 60.0
_KEPT = 1000


class RobotView(msgspec.Struct, frozen=True):
    """Scalars to plot, of every tenth frame: the estimate on the deck, and the frame's own values."""

    t_s: float
    seq: int
    x_m: float
    y_m: float
    heading_rad: float
    sigma_m: float


class SensorView(TypedDict):
    """Scalars to plot, of every tenth frame: the newest sample of each sensor; ages as the robot echoes them.

    Values that a frame does not hold are left out, because viewers do not plot null.
    """

    t_s: float
    seq: int
    wheel_right_rad_s: NotRequired[float]
    wheel_left_rad_s: NotRequired[float]
    acceleration_m_s2: NotRequired[float]
    yaw_rate_rad_s: NotRequired[float]
    edge_front_left: NotRequired[int]
    edge_front_right: NotRequired[int]
    edge_rear_left: NotRequired[int]
    edge_rear_right: NotRequired[int]
    fan_left: float
    fan_right: float
    battery: float
    drive_age_s: NotRequired[float]
    permit_age_s: NotRequired[float]
    held: bool


class ErrorView(msgspec.Struct, frozen=True):
    """Estimate against the simulated truth, every tenth frame (simulation only); along and across the true heading."""

    t_s: float
    seq: int
    position_mm: float
    along_mm: float
    across_mm: float
    heading_mrad: float


class TopicView(NamedTuple):
    """A row of the table of views; the last message of a latched one holds until the next."""

    name: str
    message: Any
    schema_name: str
    is_latched: bool = False


class ViewMessage(NamedTuple):
    """A message of a view: topic, robot time (s), JSON."""

    topic: str
    t_s: float
    payload: bytes


VIEWS = (
    TopicView("view/frames", foxglove.FrameTransform, "foxglove.FrameTransform", True),
    TopicView("view/panels", foxglove.SceneUpdate, "foxglove.SceneUpdate", True),
    TopicView("view/points", foxglove.SceneUpdate, "foxglove.SceneUpdate"),
    TopicView("view/robot_frame", foxglove.FrameTransform, "foxglove.FrameTransform"),
    TopicView("view/pose", foxglove.PoseInFrame, "foxglove.PoseInFrame"),
    TopicView("view/true_pose", foxglove.PoseInFrame, "foxglove.PoseInFrame"),
    TopicView("view/log", foxglove.Log, "foxglove.Log"),
    TopicView("view/robot", RobotView, "ccatp.Robot"),
    TopicView("view/sensors", SensorView, "ccatp.Sensors"),
    TopicView("view/error", ErrorView, "ccatp.Error"),
)
_encode = msgspec.json.Encoder().encode


class _Echo(msgspec.Struct):
    age: float | None = None
    permit_age: float | None = None
    held: bool = False


class _Line(msgspec.Struct):
    """The published part of a sensors line; a line without it is skipped."""

    seq: int
    t: float
    imu: list[tuple[float, float, float]]
    enc: list[tuple[float, float, float]]
    edge: list[tuple[float, int, int, int, int]]
    fans: tuple[float, float]
    soc: float
    cmd: _Echo


_line_decoder = msgspec.json.Decoder(_Line)


def recorded_schemas() -> list[tuple[str, dict[str, Any]]]:
    """Name and schema of every channel of a recording: the recorded topics, and the views of them."""
    raw = [(t.name, plain_schema(schema_of(t.name), f"ccatp.{t.message.__name__}")) for t in TOPICS if t.recorded]
    return [*raw, *view_schemas()]


def view_schemas() -> list[tuple[str, dict[str, Any]]]:
    """Name and schema of every view."""
    return [(view.name, plain_schema(msgspec.json.schema(view.message), view.schema_name)) for view in VIEWS]


class Views:
    """Derives the views of one run."""

    def __init__(self, mirror: Mirror, puck_height_m: float) -> None:
        self._mirror, self._puck_height_m = mirror, puck_height_m
        self._deviations_m: dict[PointId, float] = {}
        # Of one frame either may arrive first; at most _KEPT wait for their counterpart.
        self._estimates: dict[int, DeckPose] = {}
        self._truths: dict[int, DeckPose] = {}
        self._points_sent_s = 0.0
        self._has_begun = False

    def begin(self, t_s: float = 0.0) -> Iterator[ViewMessage]:
        """The latched views: frame of the world and map of the panels."""
        self._has_begun = True
        mirror, now = self._mirror, time_of(t_s)
        origin = foxglove.Vector(*mirror.world_from_deck((0.0, 0.0, 0.0)))
        x, y, z = (mirror.rotate_world_from_deck(axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
        yield _shown("view/frames", t_s, foxglove.FrameTransform(now, WORLD, DECK, origin, quaternion((x, y, z))))
        yield _shown("view/panels", t_s, panel_scene(mirror, now))

    def of(self, message: Message) -> Iterator[ViewMessage]:
        """The views of one message."""
        if not self._has_begun:
            yield from self.begin(max(message.t_s, 0.0))
        if isinstance(message, EstimateMessage):
            yield from self._of_estimate(message)
        elif isinstance(message, TrackMessage):
            yield from self._of_track(message)
        elif isinstance(message, SensorLines):
            yield from _of_lines(message.lines)
        elif isinstance(message, TruthMessage):
            yield from self._of_truth(message)
        elif isinstance(message, FixMessage):
            yield from self._of_fix(message)
        elif isinstance(message, LogMessage):
            level = foxglove.LEVELS.get(message.level, 0)
            log = foxglove.Log(time_of(max(message.t_s, 0.0)), level, message.text, message.process)
            yield _shown("view/log", message.t_s, log)

    def all_points(self, t_s: float) -> Iterator[ViewMessage]:
        """All measured points so far."""
        panels = dict.fromkeys(point.panel for point in self._deviations_m)
        if panels:
            yield _shown("view/points", t_s, point_scene(self._mirror, panels, self._deviations_m, time_of(t_s)))

    def _of_estimate(self, estimate: EstimateMessage) -> Iterator[ViewMessage]:
        pose = DeckPose(estimate.x_m, estimate.y_m, estimate.heading_rad)
        yield from self._of_pose(estimate.seq, estimate.t_s, pose, estimate.sigma_m)

    def _of_track(self, track: TrackMessage) -> Iterator[ViewMessage]:
        rows = [row for row in track.rows if row[0] % EVERY_FRAMES == 0]
        if not rows:
            return
        poses = [PanelPose(PanelId(row, col), x, y, heading) for _, _, row, col, x, y, heading, _ in rows]
        for row, place in zip(rows, deck_poses(self._mirror, poses).tolist(), strict=True):
            yield from self._of_pose(row[0], row[1], DeckPose(*place[:3]), row[7])

    def _of_pose(self, seq: int, t_s: float, pose: DeckPose, sigma_m: float) -> Iterator[ViewMessage]:
        if seq % EVERY_FRAMES == 0:
            yield from self._compared(seq, t_s, self._estimates, pose)
        now, shown = time_of(t_s), self._pose_of(pose)
        yield _shown("view/pose", t_s, foxglove.PoseInFrame(now, DECK, shown))
        frame = foxglove.FrameTransform(now, DECK, ROBOT, shown.position, shown.orientation)
        yield _shown("view/robot_frame", t_s, frame)
        yield _shown("view/robot", t_s, RobotView(t_s, seq, pose.x_m, pose.y_m, pose.heading_rad, sigma_m))

    def _of_truth(self, truth: TruthMessage) -> Iterator[ViewMessage]:
        for seq, t_s, x, y, heading, *_ in truth.rows:
            if seq % EVERY_FRAMES:
                continue
            pose = DeckPose(x, y, heading)
            yield _shown("view/true_pose", t_s, foxglove.PoseInFrame(time_of(t_s), DECK, self._pose_of(pose)))
            yield from self._compared(seq, t_s, self._truths, pose)

    def _compared(self, seq: int, t_s: float, own: dict[int, DeckPose], pose: DeckPose) -> Iterator[ViewMessage]:
        """The error of a frame when both its estimate and its truth have arrived."""
        own[seq] = pose
        if seq in self._estimates and seq in self._truths:
            yield _shown("view/error", t_s, _error(seq, t_s, self._estimates.pop(seq), self._truths.pop(seq)))
        elif len(own) > _KEPT:
            del own[next(iter(own))]

    def _of_fix(self, fix: FixMessage) -> Iterator[ViewMessage]:
        if fix.point is None or not fix.is_fused:
            return
        point = PointId(*fix.point)
        *_, self._deviations_m[point] = self._mirror.foot_of_puck(fix.position_m, self._puck_height_m)
        if fix.t_s - self._points_sent_s >= POINTS_AGAIN_S:
            self._points_sent_s = fix.t_s
            yield from self.all_points(fix.t_s)
            return
        scene = point_scene(self._mirror, (point.panel,), self._deviations_m, time_of(fix.t_s))
        yield _shown("view/points", fix.t_s, scene)

    def _pose_of(self, pose: DeckPose) -> Any:
        place = foxglove.Vector(*self._mirror.surface_point(pose.x_m, pose.y_m))
        return foxglove.Pose(place, robot_rotation(self._mirror, pose))


def _of_lines(lines: Sequence[msgspec.Raw]) -> Iterator[ViewMessage]:
    for raw in lines[::EVERY_FRAMES]:
        try:
            line = _line_decoder.decode(raw)
        except msgspec.MsgspecError:
            continue
        left, right = line.fans
        view = {"t_s": line.t, "seq": line.seq, "fan_left": left, "fan_right": right, "battery": line.soc,
                "held": line.cmd.held}  # fmt: skip
        for names, samples in ((WHEELS, line.enc), (INERTIAL, line.imu), (EDGES, line.edge)):
            if samples:
                view |= zip(names, samples[-1][1:], strict=True)
        ages = {"drive_age_s": line.cmd.age, "permit_age_s": line.cmd.permit_age}
        view |= {name: age for name, age in ages.items() if age is not None}
        yield _shown("view/sensors", line.t, view)


def _error(seq: int, t_s: float, estimate: DeckPose, truth: DeckPose) -> ErrorView:
    dx, dy = estimate.x_m - truth.x_m, estimate.y_m - truth.y_m
    c, s = cos(truth.heading_rad), sin(truth.heading_rad)
    turn = wrap_pi(estimate.heading_rad - truth.heading_rad)
    return ErrorView(t_s, seq, 1e3 * hypot(dx, dy), 1e3 * (c * dx + s * dy), 1e3 * (c * dy - s * dx), 1e3 * turn)


def _shown(topic: str, t_s: float, message: object) -> ViewMessage:
    return ViewMessage(topic, max(t_s, 0.0), _encode(message))
