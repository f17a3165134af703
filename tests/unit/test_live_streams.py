"""Tests of the live streams with real subscribers: ZeroMQ as PlotJuggler's plugin, a WebSocket as Foxglove."""

import asyncio
import json
import socket
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zmq
from autobahn.asyncio.websocket import WebSocketClientFactory, WebSocketClientProtocol

from ccatp.cli import main
from ccatp.daemon.streaming import RUN, serve, streamed_schemas
from ccatp.records.recorder import RecordedMessage
from ccatp.report.foxglove import (
    FoxgloveStream,
    LiveStream,
    PlotJugglerStream,
    StreamError,
    check_host,
    repeat_latched,
)

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


def test_a_port_that_is_taken_is_told(context: zmq.Context[zmq.Socket[bytes]]) -> None:
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


def test_a_network_is_served_only_when_told_to() -> None:
    check_host("127.0.0.1", is_open=False)
    check_host("localhost", is_open=False)
    check_host("0.0.0.0", is_open=True)
    for host in ("0.0.0.0", "192.0.2.1", "telescope"):
        with pytest.raises(StreamError, match="any host there could watch; permit it with --open-to-network"):
            check_host(host, is_open=False)


def test_misuse(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stream", "--no-plotjuggler"]) == 2
    assert "nothing to serve" in capsys.readouterr().err
    assert main(["stream", "--host", "0.0.0.0"]) == 2
    assert "--open-to-network" in capsys.readouterr().err


def test_a_host_that_is_no_name_ends_the_command(tmp_path: Path) -> None:
    with pytest.raises(StreamError, match="is no host name; choose another"):
        serve(tmp_path, "telescope\udcff", 0, None, is_open=True, report=print)


def test_a_missing_extra_ends_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "foxglove", None)
    with pytest.raises(StreamError, match=r"ccatp\[foxglove\]"):
        serve(tmp_path, "127.0.0.1", 0, 0, is_open=False, report=print)
