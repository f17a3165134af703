"""What viewers receive: schemas that they can read, views that agree with messages, streams to real subscribers."""

import asyncio
import json
import socket
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import foxglove.messages as sdk
import msgspec
import numpy as np
import pytest
import zmq
from autobahn.asyncio.websocket import WebSocketClientFactory, WebSocketClientProtocol
from scipy.spatial.transform import Rotation

from ccatp.core import PanelId, PanelPose, PointId
from ccatp.daemon.operator.streaming import RUN, serve, streamed_schemas
from ccatp.links.topics import (
    FixMessage,
    LogMessage,
    Message,
    SensorLines,
    TrackMessage,
    TruthMessage,
    topics_of,
)
from ccatp.missions import MissionKind, built_in
from ccatp.records.recorder import RecordedMessage, RobotClock
from ccatp.report.foxglove import (
    POINTS_AGAIN_S,
    VIEWS,
    FoxgloveStream,
    LiveStream,
    PlotJugglerStream,
    StreamError,
    Time,
    Views,
    check_host,
    panel_scene,
    point_scene,
    recorded_schemas,
    repeat_latched,
    view_schemas,
)
from tests.support.scenario import mirror_of

MIRROR = mirror_of()
PLAIN = ("boolean", "string", "number", "integer")


def read_like_a_viewer(schema: dict[str, Any], where: str) -> None:
    """The rules of Lichtblick's reader of schemas: whatever it would refuse fails here."""
    assert schema.get("type") == "object", f"{where}: {schema.get('type')}"
    for name, found in schema["properties"].items():
        field = found["items"] if found.get("type") == "array" else found
        kind = field.get("type")
        assert kind in (*PLAIN, "object"), f"{where}.{name}: {kind}"
        if kind == "object":
            read_like_a_viewer(field, f"{where}.{name}")


@pytest.mark.parametrize("kind", built_in(), ids=lambda kind: kind.title)
def test_viewers_can_read_the_schema_of_every_recorded_topic_and_view(kind: MissionKind) -> None:
    schemas = recorded_schemas(kind)
    recorded = [topic.name for topic in topics_of(kind) if topic.recorded]
    assert [name for name, _ in schemas] == recorded + [view.name for view in VIEWS]
    for name, schema in schemas:
        read_like_a_viewer(schema, name)
        assert schema["title"].startswith(("ccatp.", "foxglove."))
        assert "$ref" not in msgspec.json.encode(schema).decode()
    track = dict(schemas)["track"]  # what viewers do not understand stays in the schema
    assert set(track["properties"]) == {"seq", "t_s"}
    assert track["patternProperties"]["^rows$"]["items"]["minItems"] == 8


SDK_TYPES: dict[str, Any] = {
    "timestamp": sdk.Timestamp, "lifetime": sdk.Duration, "pose": sdk.Pose, "position": sdk.Vector3,
    "orientation": sdk.Quaternion, "rotation": sdk.Quaternion, "translation": sdk.Vector3, "size": sdk.Vector3,
    "color": sdk.Color, "points": sdk.Point3, "entities": sdk.SceneEntity, "lines": sdk.LinePrimitive,
    "spheres": sdk.SpherePrimitive, "texts": sdk.TextPrimitive, "metadata": sdk.KeyValuePair,
    "deletions": sdk.SceneEntityDeletion,
}  # fmt: skip
NUMBERED = {"LinePrimitive": sdk.LinePrimitiveLineType, "Log": sdk.LogLevel}


def as_sdk(kind: Any, fields: dict[str, Any]) -> Any:
    """Foxglove's own object of a message; a field that it does not know is an error."""

    def value(name: str, found: Any) -> Any:
        if isinstance(found, dict):
            return as_sdk(SDK_TYPES[name], found)
        if isinstance(found, list):
            return [as_sdk(SDK_TYPES[name], one) for one in found]
        if name in ("type", "level"):
            # an enumeration of theirs compares equal to its number
            members = (getattr(NUMBERED[kind.__name__], one) for one in dir(NUMBERED[kind.__name__]))
            return next(one for one in members if isinstance(one, NUMBERED[kind.__name__]) and one == found)
        return found

    return kind(**{name: value(name, found) for name, found in fields.items()})


def builtins(message: msgspec.Struct) -> dict[str, Any]:
    found: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(message))
    return found


def test_fields_have_foxgloves_names() -> None:
    for view in VIEWS:
        kind: Any = getattr(sdk, view.schema_name.removeprefix("foxglove."), None)
        for name in dict(view_schemas())[view.name]["properties"] if kind else ():
            with pytest.raises(TypeError) as refused:  # of the wrong type it is, but known
                kind(**{name: object()})
            assert "unexpected keyword" not in str(refused.value), name


def test_the_sdk_takes_the_scene_as_it_is() -> None:
    scene = builtins(panel_scene(MIRROR, Time(1, 500_000_000)))
    as_sdk(sdk.SceneUpdate, scene)
    assert scene["entities"][0]["timestamp"] == {"sec": 1, "nsec": 500_000_000}
    assert len(scene["entities"]) == 78  # 77 panels and the rim
    with pytest.raises(TypeError, match="unexpected keyword"):
        as_sdk(sdk.SceneUpdate, {**scene, "entitys": []})


def test_measured_points_carry_their_deviation() -> None:
    points = {PointId(4, 4, 5): 1e-4, PointId(4, 4, 6): -3e-4, PointId(5, 5, 1): 0.0}
    scene = builtins(point_scene(MIRROR, [PanelId(4, 4)], points, Time(0, 0)))
    as_sdk(sdk.SceneUpdate, scene)
    (entity,) = scene["entities"]
    assert [fact["value"] for fact in entity["metadata"]] == ["100.0 um", "-300.0 um"]
    x, y = MIRROR.point_on_deck(PointId(4, 4, 5))
    at = entity["spheres"][0]["pose"]["position"]
    assert (at["x"], at["y"], at["z"]) == pytest.approx(MIRROR.surface_point(x, y), abs=1e-5)  # rounded


# -- views ------------------------------------------------------------------------------------------------------------

PUCK_M = 0.05
NOON_S = 1_800_014_400


def clock_at_noon() -> RobotClock:
    """A clock whose first robot time is at noon."""
    return RobotClock(is_simulation=True, now_ns=lambda: NOON_S * 1_000_000_000)


@pytest.fixture
def views() -> Views:
    made = Views(MIRROR, PUCK_M, clock_at_noon())
    assert [shown.topic for shown in made.begin()] == ["view/frames", "view/panels"]
    return made


def shown(views: Views, message: Message) -> dict[str, list[dict[str, Any]]]:
    found: dict[str, list[dict[str, Any]]] = {}
    for one in views.of(message):
        found.setdefault(one.topic, []).append(json.loads(one.payload))
    return found


def track(*rows: tuple[int, float, int, int, float, float, float, float]) -> TrackMessage:
    return TrackMessage(seq=rows[-1][0], t_s=rows[-1][1], rows=list(rows))


def test_every_tenth_pose_is_shown_on_the_deck(views: Views) -> None:
    found = shown(views, track(*((seq, seq / 100, 3, 4, 0.1, -0.2, 0.5, 0.001) for seq in range(95, 115))))
    robots = found["view/robot"]
    assert [r["seq"] for r in robots] == [100, 110]
    pose = MIRROR.deck_pose(PanelPose(PanelId(3, 4), 0.1, -0.2, 0.5))
    assert [robots[0][k] for k in ("x_m", "y_m", "heading_rad")] == pytest.approx(
        [pose.x_m, pose.y_m, pose.heading_rad]
    )
    assert robots[0]["sigma_m"] == 0.001
    shown_pose = found["view/pose"][0]["pose"]
    where = [shown_pose["position"][k] for k in "xyz"]
    assert where == pytest.approx(MIRROR.surface_point(pose.x_m, pose.y_m))
    turn = Rotation.from_quat([shown_pose["orientation"][k] for k in "xyzw"])
    assert pytest.approx(np.array(MIRROR.robot_axes(pose))) == turn.as_matrix().T
    stamps = [[one["timestamp"] for one in found[name]] for name in ("view/pose", "view/robot_frame")]
    assert stamps == [[{"sec": NOON_S, "nsec": 0}, {"sec": NOON_S, "nsec": 100_000_000}]] * 2  # UTC, as the log times
    frame = found["view/robot_frame"][0]
    assert (frame["parent_frame_id"], frame["child_frame_id"]) == ("deck", "robot")
    assert frame["translation"] == shown_pose["position"]


def test_the_deck_stands_in_the_world() -> None:
    frame = json.loads(next(iter(Views(MIRROR, PUCK_M, clock_at_noon()).begin())).payload)
    turn = Rotation.from_quat([frame["rotation"][k] for k in "xyzw"])
    shift = np.array([frame["translation"][k] for k in "xyz"])
    assert turn.apply([0.3, -0.4, 0.5]) + shift == pytest.approx(MIRROR.world_from_deck((0.3, -0.4, 0.5)))


@pytest.mark.parametrize("truth_first", [True, False])
def test_the_error_is_that_of_the_same_frame(views: Views, truth_first: bool) -> None:
    pose = MIRROR.deck_pose(PanelPose(PanelId(3, 4), 0.0, 0.0, 0.0))
    row = (100, 1.0, pose.x_m, pose.y_m, pose.heading_rad, 0.0, 0.0, 0.0, 0.1, 0, 0)
    truth = TruthMessage(seq=100, t_s=1.0, rows=[row])
    estimate = track((100, 1.0, 3, 4, 0.003, 0.004, 0.01, 0.001))
    first, second = (truth, estimate) if truth_first else (estimate, truth)
    assert "view/error" not in shown(views, first)
    (error,) = shown(views, second)["view/error"]
    assert error["position_mm"] == pytest.approx(5.0, rel=1e-3)  # the deck's plane is inclined to the panel's
    assert error["heading_mrad"] == pytest.approx(10.0, abs=1e-3)
    assert "view/error" not in shown(views, second)  # told once


def test_sensors_hold_what_the_frame_holds(views: Views) -> None:
    line = {
        "type": "sensors", "seq": 7, "t": 0.07, "imu": [], "enc": [[0.06, 1.0, 2.0], [0.07, 3.0, 4.0]],
        "edge": [[0.07, 1, 0, 1, 1]], "gravity": None, "fans": [0.8, 0.7], "soc": 0.5,
        "cmd": {"seq": 6, "age": 0.01, "permit_age": 0.02, "held": True}, "faults": [],
    }  # fmt: skip
    lines = [msgspec.Raw(json.dumps(line).encode()), msgspec.Raw(b'{"type":"sensors"}')]
    (view,) = shown(views, SensorLines(seq=7, t_s=0.07, lines=lines))["view/sensors"]
    assert view == {
        "t_s": 0.07, "seq": 7, "wheel_right_rad_s": 3.0, "wheel_left_rad_s": 4.0, "edge_front_left": 1,
        "edge_front_right": 0, "edge_rear_left": 1, "edge_rear_right": 1, "fan_left": 0.8, "fan_right": 0.7,
        "battery": 0.5, "drive_age_s": 0.01, "permit_age_s": 0.02, "held": True,
    }  # fmt: skip
    silent = json.dumps(line | {"enc": [[0.07, 3.0, None]]}).encode()
    for broken in (b'{"type":"sensors"}', silent):
        assert shown(views, SensorLines(seq=8, t_s=0.08, lines=[msgspec.Raw(broken)])) == {}


def fix(point: PointId, t_s: float, lift_m: float) -> FixMessage:
    x, y = MIRROR.point_on_deck(point)
    normal = MIRROR.surface.normal(x, y)
    on_deck = [a + (PUCK_M + lift_m) * n for a, n in zip(MIRROR.surface_point(x, y), normal, strict=True)]
    return FixMessage(
        seq=1, t_s=t_s, point=(point.row, point.col, point.point), is_fused=True,
        position_m=MIRROR.world_from_deck((on_deck[0], on_deck[1], on_deck[2])),
        covariance_m2=[0.0] * 9, dop=1.0, residual_rms_m=0.0, channels=[1], jump_mm=0.0,
    )  # fmt: skip


def test_a_fix_colours_its_point_and_all_points_come_again(views: Views) -> None:
    (first,) = shown(views, fix(PointId(2, 3, 5), 1.0, 1e-4))["view/points"]
    (entity,) = first["entities"]
    assert entity["id"] == "points 2-3"
    assert entity["metadata"] == [{"key": "point 5", "value": "100.0 um"}]
    (second,) = shown(views, fix(PointId(2, 4, 5), 2.0, 0.0))["view/points"]
    assert [e["id"] for e in second["entities"]] == ["points 2-4"]
    (third,) = shown(views, fix(PointId(2, 5, 5), POINTS_AGAIN_S + 1.0, 0.0))["view/points"]
    assert [e["id"] for e in third["entities"]] == ["points 2-3", "points 2-4", "points 2-5"]
    refused = fix(PointId(2, 3, 5), 3.0, 0.0)
    refused.is_fused = False
    assert shown(views, refused) == {}


def test_a_run_begins_with_its_first_message_and_lines_become_a_log() -> None:
    message = LogMessage(seq=1, t_s=2.25, level="warning", process="main", text="held")
    found = shown(Views(MIRROR, PUCK_M, clock_at_noon()), message)
    assert list(found) == ["view/frames", "view/panels", "view/log"]
    (log,) = found["view/log"]
    assert log["timestamp"] == {"sec": NOON_S, "nsec": 0}
    assert (log["level"], log["name"], log["message"]) == (3, "main", "held")


def test_the_sdk_takes_every_view_of_its_types_as_it_is(views: Views) -> None:
    pose = MIRROR.deck_pose(PanelPose(PanelId(3, 4), 0.0, 0.0, 0.0))
    row = (100, 1.0, pose.x_m, pose.y_m, pose.heading_rad, 0.0, 0.0, 0.0, 0.1, 0, 0)
    messages = [
        track((100, 1.0, 3, 4, 0.0, 0.0, 0.0, 0.001)),
        TruthMessage(seq=100, t_s=1.0, rows=[row]),
        fix(PointId(2, 3, 5), 1.0, 1e-4),
        LogMessage(seq=1, t_s=2.25, level="warning", process="main", text="held"),
    ]
    names = {view.name: view.schema_name.removeprefix("foxglove.") for view in VIEWS if "foxglove." in view.schema_name}
    found = [*views.begin(), *(one for message in messages for one in views.of(message))]
    of_theirs = [one for one in found if one.topic in names]
    assert {one.topic for one in of_theirs} == set(names)
    for one in of_theirs:
        as_sdk(getattr(sdk, names[one.topic]), json.loads(one.payload))


# -- real subscribers --------------------------------------------------------------------------------------------------

PANELS = RecordedMessage("view/panels", 0.0, b'{"deletions":[],"entities":[]}')
ROBOT = RecordedMessage("view/robot", 1.25, b'{"t_s":1.25,"seq":125,"x_m":0.5,"y_m":0.0}')


@pytest.fixture
def context() -> Iterator[zmq.Context[zmq.Socket[bytes]]]:
    with zmq.Context() as made:
        yield made


@pytest.fixture
def plotjuggler(context: zmq.Context[zmq.Socket[bytes]]) -> Iterator[PlotJugglerStream]:
    stream = PlotJugglerStream(context, "127.0.0.1", 0)
    yield stream
    stream.close()


@pytest.fixture
def foxglove() -> Iterator[FoxgloveStream]:
    stream = FoxgloveStream("ccatp", "127.0.0.1", 0, streamed_schemas())
    yield stream
    stream.close()


@contextmanager
def tending(stream: LiveStream, *messages: RecordedMessage, latched: Sequence[RecordedMessage] = ()) -> Iterator[None]:
    """Serves a stream in a thread, as the process would; messages are sent meanwhile."""
    is_over = threading.Event()

    def run() -> None:
        while not is_over.wait(0.005):
            repeat_latched(stream, {one.topic: one for one in latched})
            for message in messages:
                stream.send(message)

    thread = threading.Thread(target=run)
    thread.start()
    yield
    is_over.set()
    thread.join()


def subscribed(context: zmq.Context[zmq.Socket[bytes]], where: str, prefix: bytes) -> zmq.Socket[bytes]:
    peer = context.socket(zmq.SUB)
    peer.setsockopt(zmq.LINGER, 0)
    peer.setsockopt(zmq.RCVTIMEO, 10_000)
    peer.setsockopt(zmq.SUBSCRIBE, prefix)
    peer.connect(where)
    return peer


def test_plotjuggler_gets_topic_json_and_seconds(
    context: zmq.Context[zmq.Socket[bytes]], plotjuggler: PlotJugglerStream
) -> None:
    with tending(plotjuggler, ROBOT), subscribed(context, plotjuggler.where, b"") as peer:
        topic, payload, t_s = peer.recv_multipart()
    assert topic == b"view/robot"
    assert json.loads(payload)["x_m"] == 0.5
    assert float(t_s) == 1.25
    assert t_s.decode().isascii()


def test_a_late_subscriber_gets_what_is_latched(
    context: zmq.Context[zmq.Socket[bytes]], plotjuggler: PlotJugglerStream
) -> None:
    with tending(plotjuggler, latched=[PANELS]):
        for prefix in (b"view/panels", b"", b""):
            with subscribed(context, plotjuggler.where, prefix) as peer:
                assert peer.recv_multipart()[0] == b"view/panels"


def test_a_port_that_is_taken_is_reported(context: zmq.Context[zmq.Socket[bytes]]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(
            StreamError, match=f"PlotJuggler: cannot listen on 127.0.0.1:{port}: Address already in use"
        ):
            PlotJugglerStream(context, "127.0.0.1", port)
        with pytest.raises(StreamError, match=rf"Foxglove: cannot listen on .*:{port}: .*choose another"):
            FoxgloveStream("ccatp", "127.0.0.1", port, [])


class Peer(WebSocketClientProtocol):
    """A client; messages are JSON as text, and binary."""

    def __init__(self) -> None:
        super().__init__()
        self.messages: asyncio.Queue[Any] = asyncio.Queue()

    def onMessage(self, payload: bytes, isBinary: bool) -> None:
        self.messages.put_nowait(payload if isBinary else json.loads(payload))

    async def next_of(self, operation: str) -> dict[str, Any]:
        async with asyncio.timeout(10.0):
            while True:
                message = await self.messages.get()
                if isinstance(message, dict) and message["op"] == operation:
                    return message


async def test_foxglove_gets_channels_schemas_and_messages(foxglove: FoxgloveStream) -> None:
    schemas = dict(streamed_schemas())
    assert next(iter(schemas)) == RUN
    port = int(foxglove.where.rpartition(":")[2])
    url, protocols = f"ws://127.0.0.1:{port}", ["foxglove.sdk.v1"]
    factory = WebSocketClientFactory(url, protocols=protocols)  # type: ignore[no-untyped-call]
    factory.protocol = Peer
    transport, peer = await asyncio.get_running_loop().create_connection(factory, "127.0.0.1", port)
    assert (await peer.next_of("serverInfo"))["name"] == "ccatp"
    channels: dict[str, dict[str, Any]] = {}
    while len(channels) < len(schemas):
        channels |= {channel["topic"]: channel for channel in (await peer.next_of("advertise"))["channels"]}
    assert channels.keys() == schemas.keys()
    panels = channels["view/panels"]
    assert (panels["schemaName"], panels["encoding"]) == ("foxglove.SceneUpdate", "json")
    assert json.loads(panels["schema"]) == json.loads(json.dumps(schemas["view/panels"]))
    wanted = {7: channels["view/panels"]["id"], 8: channels["view/robot"]["id"]}
    subscriptions = [{"id": k, "channelId": v} for k, v in wanted.items()]
    peer.sendMessage(json.dumps({"op": "subscribe", "subscriptions": subscriptions}).encode())
    found: dict[int, tuple[int, bytes]] = {}
    with tending(foxglove, ROBOT, latched=[PANELS]):
        while len(found) < 2:
            message = await asyncio.wait_for(peer.messages.get(), 10.0)
            if isinstance(message, bytes):
                opcode, subscription, log_time = struct.unpack_from("<BIQ", message)
                assert opcode == 1
                found[subscription] = (log_time, message[13:])
    transport.abort()
    # The map was latched before anybody was there.
    assert found == {7: (0, PANELS.payload), 8: (1_250_000_000, ROBOT.payload)}


def test_a_network_is_served_only_when_configured() -> None:
    check_host("127.0.0.1", is_open=False)
    check_host("localhost", is_open=False)
    check_host("0.0.0.0", is_open=True)
    for host in ("0.0.0.0", "192.0.2.1", "telescope"):
        with pytest.raises(StreamError, match="any host there could watch; permit it with --open-to-network"):
            check_host(host, is_open=False)


def test_a_host_that_is_no_name_ends_the_command(tmp_path: Path) -> None:
    with pytest.raises(StreamError, match="is no host name; choose another"):
        serve(tmp_path, "telescope\udcff", 0, None, is_open=True, report=print)


def test_a_missing_extra_ends_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "foxglove", None)
    with pytest.raises(StreamError, match=r"ccatp\[foxglove\]"):
        serve(tmp_path, "127.0.0.1", 0, 0, is_open=False, report=print)
