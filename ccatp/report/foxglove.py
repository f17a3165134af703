"""Message types of Foxglove, the mirror as a 3D scene, and JSON schemas that viewers can read.

Field names and numbers are those of Foxglove's schemas; viewers take fields that are left out as empty.

Foxglove and Lichtblick read a channel's schema as a list of fields: the root and every object have ``properties``, each
of a plain type, and arrays hold plain types or objects. They refuse a channel with references, alternatives or arrays
of arrays. Therefore references are resolved, and other properties stand under ``patternProperties``, which validators
use and viewers ignore.

Topics for viewers, named ``view/...``, have at most a tenth of the frame rate. Constant ones (frames, panels) are
latched: a late subscriber gets the last message.
"""

import json
import queue
from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import cos, hypot, sin
from types import GenericAlias
from typing import Any, NamedTuple

import msgspec
import numpy as np
import zmq

from ccatp.config.checks import is_loopback
from ccatp.core import DeckPose, PanelId, PanelPose, PointId, Vector3
from ccatp.errors import UsageError
from ccatp.kinematics import wrap_pi
from ccatp.links import topics
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import FixMessage, Message, TrackMessage, TruthMessage
from ccatp.mirror.mirror import Mirror
from ccatp.missions import MissionKind
from ccatp.records.recorder import RecordedMessage, RobotClock

LOOP = 1  # of LinePrimitive.type
LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "fatal": 5}
_NS = 1_000_000_000


def _message(title: str, doc: str | None = None, /, **fields: Any) -> Any:
    """A message type; a field is a type, a list of one type (an array of it), or a pair of these and its default."""
    rows = []
    for name, field in fields.items():
        kind, *default = field if isinstance(field, tuple) else (field,)
        rows.append((name, GenericAlias(list, tuple(kind)) if isinstance(kind, list) else kind, *default))
    return msgspec.defstruct(title, rows, frozen=True, namespace={"__doc__": doc})


# Lengths in m, colours 0 to 1.
Time = _message("Time", sec=int, nsec=int)
Vector = _message("Vector3", x=float, y=float, z=float)
Quaternion = _message("Quaternion", x=float, y=float, z=float, w=float)
Pose = _message("Pose", position=Vector, orientation=Quaternion)
Color = _message("Color", r=float, g=float, b=float, a=float)
KeyValuePair = _message("KeyValuePair", key=str, value=str)
PoseInFrame = _message("PoseInFrame", timestamp=Time, frame_id=str, pose=Pose)
FrameTransform = _message(
    "FrameTransform",
    timestamp=Time, parent_frame_id=str, child_frame_id=str, translation=Vector, rotation=Quaternion,
)  # fmt: skip
LinePrimitive = _message(
    "LinePrimitive",
    type=int, pose=Pose, thickness=float, scale_invariant=bool, points=[Vector], color=Color,
)  # fmt: skip
SpherePrimitive = _message("SpherePrimitive", pose=Pose, size=Vector, color=Color)
TextPrimitive = _message(
    "TextPrimitive", pose=Pose, billboard=bool, font_size=float, scale_invariant=bool, color=Color, text=str
)
# An entity replaces the older one of the same id, and stays for ever with a lifetime of 0.
SceneEntity = _message(
    "SceneEntity",
    timestamp=Time, frame_id=str, id=str, frame_locked=bool, lifetime=(Time, Time(0, 0)),
    metadata=([KeyValuePair], ()), spheres=([SpherePrimitive], ()), lines=([LinePrimitive], ()),
    texts=([TextPrimitive], ()),
)  # fmt: skip
SceneEntityDeletion = _message("SceneEntityDeletion", timestamp=Time, type=int, id=str)
SceneUpdate = _message("SceneUpdate", deletions=[SceneEntityDeletion], entities=[SceneEntity])
Log = _message("Log", timestamp=Time, level=int, message=str, name=str, file=(str, ""), line=(int, 0))


DECK = "deck"
UPRIGHT = Quaternion(0.0, 0.0, 0.0, 1.0)
ORIGIN = Pose(Vector(0.0, 0.0, 0.0), UPRIGHT)
GREY, DARK, RED = Color(0.62, 0.68, 0.74, 1.0), Color(0.25, 0.3, 0.36, 1.0), Color(0.84, 0.27, 0.27, 1.0)
LOW, EVEN, HIGH = (0.07, 0.25, 0.65), (0.95, 0.95, 0.9), (0.75, 0.1, 0.1)
FULL_SCALE_M = 2e-4  # deviations beyond it have the colour of the scale's end
POINT_M, LABEL_M = 0.04, 0.12
EDGE_PIXELS, RIM_PIXELS = 1.5, 3.0
# A panel's edge is a curve on the surface; eight chords of 90 mm stay within tenths of a millimetre of it.
CHORDS = 8


def panel_scene(mirror: Mirror, timestamp: Any) -> Any:
    """Outline and label of every panel, and the rim, deck frame."""

    def outline(places: Iterable[Sequence[float]], pixels: float, colour: Any) -> Any:
        return LinePrimitive(LOOP, ORIGIN, pixels, True, [_on_surface(mirror, x, y) for x, y in places], colour)

    entities = []
    for panel, own in mirror.panels.items():
        name = f"{panel.row}-{panel.col}"
        sides = ((-1, -1), (1, -1), (1, 1), (-1, 1))
        corners = np.array([(own.x_m + sx * own.half_x_m, own.y_m + sy * own.half_y_m) for sx, sy in sides])
        ends = zip(corners, np.roll(corners, -1, axis=0), strict=True)
        edge = outline([(a + i / CHORDS * (b - a)).tolist() for a, b in ends for i in range(CHORDS)], EDGE_PIXELS, GREY)
        label = TextPrimitive(Pose(Vector(*own.origin), UPRIGHT), True, LABEL_M, False, DARK, name)
        entities.append(SceneEntity(timestamp, DECK, f"panel {name}", False, lines=(edge,), texts=(label,)))
    rim = outline(mirror.rim.vertices.tolist(), RIM_PIXELS, RED)
    return SceneUpdate((), (*entities, SceneEntity(timestamp, DECK, "rim", False, lines=(rim,))))


def point_scene(mirror: Mirror, panels: Iterable[PanelId], deviations_m: dict[PointId, float], timestamp: Any) -> Any:
    """The measured points of some panels, an entity for each; deviations from the surface along the normal, m."""
    entities = []
    for panel in panels:
        spheres, facts = [], []
        for point in mirror.point_ids(panel):
            if point in deviations_m:
                pose = Pose(_on_surface(mirror, *mirror.point_on_deck(point)), UPRIGHT)
                share = max(-1.0, min(1.0, deviations_m[point] / FULL_SCALE_M))
                ends = zip(EVEN, HIGH if share > 0.0 else LOW, strict=True)  # from blue (low) by way of white to red
                colour = Color(*(even + abs(share) * (most - even) for even, most in ends), 1.0)
                spheres.append(SpherePrimitive(pose, Vector(POINT_M, POINT_M, POINT_M), colour))
                facts.append(KeyValuePair(f"point {point.point}", f"{1e6 * deviations_m[point]:.1f} um"))
        name = f"points {panel.row}-{panel.col}"
        entities.append(SceneEntity(timestamp, DECK, name, False, metadata=facts, spheres=spheres))
    return SceneUpdate((), entities)


def _on_surface(mirror: Mirror, x_m: float, y_m: float) -> Any:
    return Vector(*(round(c, 5) for c in mirror.surface_point(x_m, y_m)))


def quaternion(axes: tuple[Sequence[float], Sequence[float], Sequence[float]]) -> Any:
    """The rotation that takes x, y, z to three right-handed unit vectors."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = axes
    # Each row is the quaternion times four of its components; the row of the largest component has the least rounding.
    rows = (
        (1.0 + xx - yy - zz, xy + yx, zx + xz, yz - zy),
        (xy + yx, 1.0 - xx + yy - zz, yz + zy, zx - xz),
        (zx + xz, yz + zy, 1.0 - xx - yy + zz, xy - yx),
        (yz - zy, zx - xz, xy - yx, 1.0 + xx + yy + zz),
    )
    row = rows[max(range(4), key=lambda i: rows[i][i])]
    length = hypot(*row)
    return Quaternion(*(c / length for c in row))


def deck_in_world(mirror: Mirror) -> tuple[Vector3, Any]:
    """Origin of the deck frame in the world frame, m, and its rotation."""
    x, y, z = (mirror.rotate_world_from_deck(axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    return mirror.world_from_deck((0.0, 0.0, 0.0)), quaternion((x, y, z))


_PLAIN = ("boolean", "string", "number", "integer")


def plain_schema(schema: Mapping[str, Any], title: str) -> dict[str, Any]:
    """A schema of ``msgspec.json.schema`` in the form for viewers; a type within itself is any object there."""
    return {**_resolved(schema, schema.get("$defs", {})), "title": title}


def _resolved(node: Any, definitions: Mapping[str, Any], within: frozenset[str] = frozenset()) -> Any:
    """``within``: the definitions of which the node is a part."""
    if isinstance(node, list):
        return [_resolved(one, definitions, within) for one in node]
    if not isinstance(node, Mapping):
        return node
    if "$ref" in node:
        name = str(node["$ref"]).rpartition("/")[2]
        return {"type": "object"} if name in within else _resolved(definitions[name], definitions, within | {name})
    found = {key: _resolved(value, definitions, within) for key, value in node.items() if key not in ("$defs", "title")}
    if found.get("type") == "object" and "properties" in found:
        fields = found["properties"]
        found["properties"] = {name: value for name, value in fields.items() if _is_plain(value)}
        if others := {f"^{name}$": value for name, value in fields.items() if not _is_plain(value)}:
            found["patternProperties"] = others
    return found


def _is_plain(schema: Mapping[str, Any]) -> bool:
    kind = schema.get("type")
    if kind == "array":
        items = schema.get("items")
        return isinstance(items, Mapping) and items.get("type") != "array" and _is_plain(items)
    return kind in _PLAIN or (kind == "object" and "properties" in schema)


WORLD, ROBOT = "world", "robot"
WHEELS, INERTIAL = ("wheel_right_rad_s", "wheel_left_rad_s"), ("acceleration_m_s2", "yaw_rate_rad_s")
EDGES = ("edge_front_left", "edge_front_right", "edge_rear_left", "edge_rear_right")
EVERY_FRAMES = 10
# All points are published again at this period, for viewers that start in the middle of a recording.
POINTS_AGAIN_S = 60.0
_KEPT = 1000
_NUMBER, _INT = (float | msgspec.UnsetType, msgspec.UNSET), (int | msgspec.UnsetType, msgspec.UNSET)
RobotView = _message(
    "Robot",
    "Scalars to plot, of every tenth frame: the estimate on the deck, and the frame's own values.",
    t_s=float, seq=int, x_m=float, y_m=float, heading_rad=float, sigma_m=float,
)  # fmt: skip
SensorView = _message(
    "Sensors",
    "Scalars to plot, of every tenth frame: the newest sample of each sensor; unknown values are omitted.",
    t_s=float, seq=int, fan_left=float, fan_right=float, battery=float, held=bool,
    **dict.fromkeys((*WHEELS, *INERTIAL), _NUMBER), **dict.fromkeys(EDGES, _INT),
    drive_age_s=_NUMBER, permit_age_s=_NUMBER,
)  # fmt: skip
ErrorView = _message(
    "Error",
    "Estimate against the simulated truth, every tenth frame (simulation only); along and across the true heading.",
    t_s=float, seq=int, position_mm=float, along_mm=float, across_mm=float, heading_mrad=float,
)  # fmt: skip


class TopicView(NamedTuple):
    """A row of the table of views; the last message of a latched view is valid until the next one."""

    name: str
    message: Any
    schema_name: str
    is_latched: bool = False


VIEWS = (
    TopicView("view/frames", FrameTransform, "foxglove.FrameTransform", True),
    TopicView("view/panels", SceneUpdate, "foxglove.SceneUpdate", True),
    TopicView("view/points", SceneUpdate, "foxglove.SceneUpdate"),
    TopicView("view/robot_frame", FrameTransform, "foxglove.FrameTransform"),
    TopicView("view/pose", PoseInFrame, "foxglove.PoseInFrame"),
    TopicView("view/true_pose", PoseInFrame, "foxglove.PoseInFrame"),
    TopicView("view/log", Log, "foxglove.Log"),
    TopicView("view/robot", RobotView, "ccatp.Robot"),
    TopicView("view/sensors", SensorView, "ccatp.Sensors"),
    TopicView("view/error", ErrorView, "ccatp.Error"),
)
_encode = msgspec.json.Encoder().encode
_sensors = msgspec.json.Decoder(Sensors)


def recorded_schemas(kind: MissionKind) -> list[tuple[str, dict[str, Any]]]:
    """Name and schema of every channel of a recording: the recorded topics, and the views of them."""
    recorded = [topic for topic in topics.topics_of(kind) if topic.recorded]
    raw = [(one.name, plain_schema(topics.schema_of(one.name), f"ccatp.{one.message.__name__}")) for one in recorded]
    return [*raw, *view_schemas()]


def view_schemas() -> list[tuple[str, dict[str, Any]]]:
    """Name and schema of every view."""
    return [(view.name, plain_schema(msgspec.json.schema(view.message), view.schema_name)) for view in VIEWS]


class Views:
    """Derives the views of one run; their time stamps are UTC by ``clock``."""

    def __init__(self, mirror: Mirror, puck_height_m: float, clock: RobotClock) -> None:
        self._mirror, self._puck_height_m, self._utc_ns = mirror, puck_height_m, clock.utc_ns
        self._deviations_m: dict[PointId, float] = {}
        # Estimate and truth of a frame arrive in any order; at most _KEPT wait for their counterpart.
        self._estimates: dict[int, DeckPose] = {}
        self._truths: dict[int, DeckPose] = {}
        self._points_sent_s = 0.0
        self._has_begun = False

    def begin(self, t_s: float = 0.0) -> Iterator[RecordedMessage]:
        """The latched views: frame of the world and map of the panels."""
        self._has_begun = True
        now, (origin, turn) = self._stamp(t_s), deck_in_world(self._mirror)
        yield _shown("view/frames", t_s, FrameTransform(now, WORLD, DECK, Vector(*origin), turn))
        yield _shown("view/panels", t_s, panel_scene(self._mirror, now))

    def of(self, message: Message) -> Iterator[RecordedMessage]:
        """The views of one message."""
        if not self._has_begun:
            yield from self.begin(max(message.t_s, 0.0))
        if isinstance(message, topics.EstimateMessage):
            pose = DeckPose(message.x_m, message.y_m, message.heading_rad)
            yield from self._of_pose(message.seq, message.t_s, pose, message.sigma_m)
        elif isinstance(message, TrackMessage):
            yield from self._of_track(message)
        elif isinstance(message, topics.SensorLines):
            yield from _of_lines(message.lines)
        elif isinstance(message, TruthMessage):
            yield from self._of_truth(message)
        elif isinstance(message, FixMessage):
            yield from self._of_fix(message)
        elif isinstance(message, topics.LogMessage):
            level = LEVELS.get(message.level, 0)
            log = Log(self._stamp(max(message.t_s, 0.0)), level, message.text, message.process)
            yield _shown("view/log", message.t_s, log)

    def all_points(self, t_s: float) -> Iterator[RecordedMessage]:
        """All measured points so far."""
        panels = dict.fromkeys(point.panel for point in self._deviations_m)
        if panels:
            yield _shown("view/points", t_s, point_scene(self._mirror, panels, self._deviations_m, self._stamp(t_s)))

    def _stamp(self, t_s: float) -> Any:
        return Time(*divmod(self._utc_ns(t_s), _NS))

    def _of_track(self, track: TrackMessage) -> Iterator[RecordedMessage]:
        for seq, t_s, row, col, x, y, heading, sigma_m in track.rows:
            if seq % EVERY_FRAMES == 0:
                pose = self._mirror.deck_pose(PanelPose(PanelId(row, col), x, y, heading))
                yield from self._of_pose(seq, t_s, pose, sigma_m)

    def _of_pose(self, seq: int, t_s: float, pose: DeckPose, sigma_m: float) -> Iterator[RecordedMessage]:
        if seq % EVERY_FRAMES == 0:
            yield from self._compared(seq, t_s, self._estimates, pose)
        now, shown = self._stamp(t_s), self._pose_of(pose)
        yield _shown("view/pose", t_s, PoseInFrame(now, DECK, shown))
        frame = FrameTransform(now, DECK, ROBOT, shown.position, shown.orientation)
        yield _shown("view/robot_frame", t_s, frame)
        yield _shown("view/robot", t_s, RobotView(t_s, seq, pose.x_m, pose.y_m, pose.heading_rad, sigma_m))

    def _of_truth(self, truth: TruthMessage) -> Iterator[RecordedMessage]:
        for seq, t_s, x, y, heading, *_ in truth.rows:
            if seq % EVERY_FRAMES:
                continue
            pose = DeckPose(x, y, heading)
            yield _shown("view/true_pose", t_s, PoseInFrame(self._stamp(t_s), DECK, self._pose_of(pose)))
            yield from self._compared(seq, t_s, self._truths, pose)

    def _compared(self, seq: int, t_s: float, own: dict[int, DeckPose], pose: DeckPose) -> Iterator[RecordedMessage]:
        """The error of a frame when both its estimate and its truth have arrived."""
        own[seq] = pose
        if seq in self._estimates and seq in self._truths:
            estimate, truth = self._estimates.pop(seq), self._truths.pop(seq)
            dx, dy = estimate.x_m - truth.x_m, estimate.y_m - truth.y_m
            c, s = cos(truth.heading_rad), sin(truth.heading_rad)
            off = (1e3 * hypot(dx, dy), 1e3 * (c * dx + s * dy), 1e3 * (c * dy - s * dx))
            turn = wrap_pi(estimate.heading_rad - truth.heading_rad)
            yield _shown("view/error", t_s, ErrorView(t_s, seq, *off, 1e3 * turn))
        elif len(own) > _KEPT:
            del own[next(iter(own))]

    def _of_fix(self, fix: FixMessage) -> Iterator[RecordedMessage]:
        if fix.point is None or not fix.is_fused:
            return
        point = PointId(*fix.point)
        *_, self._deviations_m[point] = self._mirror.foot_of_puck(fix.position_m, self._puck_height_m)
        if abs(fix.t_s - self._points_sent_s) >= POINTS_AGAIN_S:
            self._points_sent_s = fix.t_s
            yield from self.all_points(fix.t_s)
            return
        scene = point_scene(self._mirror, (point.panel,), self._deviations_m, self._stamp(fix.t_s))
        yield _shown("view/points", fix.t_s, scene)

    def _pose_of(self, pose: DeckPose) -> Any:
        place = Vector(*self._mirror.surface_point(pose.x_m, pose.y_m))
        return Pose(place, quaternion(self._mirror.robot_axes(pose)))


def _of_lines(lines: Sequence[msgspec.Raw]) -> Iterator[RecordedMessage]:
    for raw in lines[::EVERY_FRAMES]:
        try:
            line = _sensors.decode(raw)
        except msgspec.MsgspecError:
            continue
        if any(None in sample for sample in (*line.enc, *line.imu)):
            continue  # a sensor that gave no value
        pairs = ((WHEELS, line.enc), (INERTIAL, line.imu), (EDGES, line.edge))
        newest = {name: v for names, found in pairs if found for name, v in zip(names, found[-1][1:], strict=True)}
        yield _shown("view/sensors", line.t, SensorView(
            t_s=line.t, seq=line.seq, **newest, fan_left=line.fans[0], fan_right=line.fans[1], battery=line.soc,
            drive_age_s=line.cmd.age, permit_age_s=line.cmd.permit_age, held=line.cmd.held,
        ))  # fmt: skip


def _shown(topic: str, t_s: float, message: object) -> RecordedMessage:
    return RecordedMessage(topic, max(t_s, 0.0), _encode(message))


# -- live streams: PlotJuggler's framing over ZeroMQ, Foxglove's WebSocket; times of their messages are UTC ------------

# Enough for some seconds of a run; a slower viewer loses the newest messages.
HIGH_WATER_MARK = 5000
LINGER_MS = 200


class StreamError(UsageError):
    """A stream cannot be served."""


def check_host(host: str, *, is_open: bool) -> None:
    """StreamError: the host is not this machine, and ``is_open`` is not given; every client may watch."""
    if not (is_open or is_loopback(host)):
        raise StreamError(
            f"--host {host}: any host there could watch; permit it with --open-to-network, or use ssh -L and 127.0.0.1"
        )


class PlotJugglerStream:
    """Messages of three frames: topic, JSON, time as ASCII seconds; port 0 is any free one, StreamError: in use."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], host: str, port: int) -> None:
        self._socket = context.socket(zmq.XPUB)
        self._socket.setsockopt(zmq.SNDHWM, HIGH_WATER_MARK)
        self._socket.setsockopt(zmq.LINGER, LINGER_MS)
        # Report also subscriptions to a topic that another peer has subscribed already.
        self._socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        try:
            self._socket.bind(f"tcp://{host}:{port or '*'}")
        except (zmq.ZMQError, UnicodeError) as error:
            self._socket.close()
            why = error.strerror if isinstance(error, zmq.ZMQError) else "is no host name"
            raise StreamError(f"PlotJuggler: cannot listen on {host}:{port}: {why}; choose another port") from error
        self.where = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def send(self, shown: RecordedMessage) -> None:
        """Send to all subscribers; never blocks."""
        self._socket.send_multipart((shown.topic.encode(), shown.payload, f"{shown.t_s:.6f}".encode()))

    def new_subscriptions(self) -> tuple[str, ...]:
        """Beginnings of topics that have a new subscriber."""
        found = []
        while self._socket.poll(0, zmq.POLLIN):
            change = self._socket.recv()
            if change[:1] == b"\x01":
                found.append(change[1:].decode("utf-8", "replace"))
        return tuple(found)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class FoxgloveStream:
    """A WebSocket server for Foxglove and Lichtblick; ``StreamError`` also where the extra ``foxglove`` is missing."""

    def __init__(self, name: str, host: str, port: int, schemas: Iterable[tuple[str, Mapping[str, Any]]]) -> None:
        try:
            import foxglove  # noqa: PLC0415 - belongs to an extra
            from foxglove.websocket import ServerListener  # noqa: PLC0415
        except ImportError as error:
            raise StreamError("Foxglove needs its SDK: install ccatp with its extra, ccatp[foxglove]") from error
        # The server calls this from its own thread.
        subscribed: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._subscribed = subscribed

        class Listener(ServerListener):
            def on_subscribe(self, client: Any, channel: Any) -> None:
                subscribed.put(channel.topic)

        # Kept, because channels close with it.
        self._context = context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name=name, host=host, port=port, server_listener=Listener(), context=context
            )
        except (RuntimeError, OSError) as error:
            raise StreamError(f"Foxglove: cannot listen on {host}:{port}: {error}; choose another port") from error
        self._channels = {}
        for topic, schema in schemas:
            data = foxglove.Schema(name=schema["title"], encoding="jsonschema", data=json.dumps(schema).encode())
            self._channels[topic] = foxglove.Channel(topic, schema=data, message_encoding="json", context=context)
        self.where = f"ws://{host}:{self._server.port}"

    def send(self, shown: RecordedMessage) -> None:
        """Send to all subscribers; never blocks."""
        channel = self._channels.get(shown.topic)
        if channel is not None:
            channel.log(shown.payload, log_time=round(shown.t_s * _NS))

    def new_subscriptions(self) -> tuple[str, ...]:
        """Topics that have a new subscriber."""
        return tuple(self._subscribed.get() for _ in range(self._subscribed.qsize()))

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()
        for channel in self._channels.values():
            channel.close()


LiveStream = PlotJugglerStream | FoxgloveStream


def repeat_latched(stream: LiveStream, latched: Mapping[str, RecordedMessage]) -> None:
    """Send the last message of each latched topic to new subscribers; to be called several times a second."""
    new = stream.new_subscriptions()
    for topic, shown in latched.items():
        if topic.startswith(new):
            stream.send(shown)
