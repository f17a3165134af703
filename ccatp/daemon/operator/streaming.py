"""``ccatp stream``: streams the runs of a runtime directory live, one after the other.

It subscribes after the loops have joined the robot, and no other process depends on it.
"""

import json
import os
import signal
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import FrameType

import msgspec
import zmq

from ccatp.config.load import load_config
from ccatp.daemon.supervision.process import RUN_DIR_FILE, Endpoints, run_dir_in
from ccatp.errors import ConfigError
from ccatp.links.bus import Subscriber
from ccatp.links.runtime_dir import runtime_dir_path
from ccatp.links.topics import BY_NAME, Heartbeat, Message, schema_of
from ccatp.mirror.mirror import build_mirror
from ccatp.records.recorder import TELEMETRY, RecordedMessage, RobotClock, read_metadata
from ccatp.report.foxglove import (
    VIEWS,
    FoxgloveStream,
    LiveStream,
    PlotJugglerStream,
    Views,
    check_host,
    plain_schema,
    repeat_latched,
    view_schemas,
)

# Topics that are streamed as they are; batches are streamed as their views.
PASSED_ON = ("mission", "arrival", "rest", "treatment", "fix", "danger_event")
TURNED_INTO_VIEWS = ("estimate", "sensors", "fix", "truth", "log")
RUN = "run"
# Topics whose last message a late subscriber receives.
LATCHED = {RUN, *(view.name for view in VIEWS if view.is_latched)}
PERIOD_MS = 20
NICENESS = 10


class RunFact(msgspec.Struct):
    """The streamed run; the first message of a stream."""

    mirror: str
    world: str
    simulation: bool
    seed: int
    filter: str
    run_dir: str


def streamed_schemas() -> list[tuple[str, dict[str, object]]]:
    """Name and schema of every streamed topic."""
    raw = [(name, plain_schema(schema_of(name), f"ccatp.{BY_NAME[name].message.__name__}")) for name in PASSED_ON]
    return [(RUN, plain_schema(msgspec.json.schema(RunFact), "ccatp.Run")), *raw, *view_schemas()]


class Streamer:
    """Forwards the messages of the runs of a runtime directory to the streams."""

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        runtime_dir: Path,
        streams: Sequence[LiveStream],
        report: Callable[[str], None],
    ) -> None:
        self._context = context
        self._streams = streams
        self._report = report
        self._runtime_dir, self._endpoints = runtime_dir, Endpoints(runtime_dir)
        self._heartbeats = Subscriber(context, [self._endpoints.of("main")], ["heartbeat.main"])
        self._run: Subscriber | None = None
        self._views: Views | None = None
        self._clock = RobotClock(is_simulation=True)  # another for each run
        self._latched: dict[str, RecordedMessage] = {}
        self._pid = -1

    def step(self) -> None:
        """Wait for ``PERIOD_MS`` at most, and forward the messages that have arrived."""
        sockets = [self._heartbeats.socket, *([] if self._run is None else [self._run.socket])]
        poller = zmq.Poller()
        for socket in sockets:
            poller.register(socket, zmq.POLLIN)
        poller.poll(PERIOD_MS)
        while (received := self._heartbeats.receive()) is not None:
            if isinstance(received[2], Heartbeat):
                self._on_heartbeat(received[2])
        while self._run is not None and (raw := self._run.receive()) is not None:
            if isinstance(raw[2], Message):
                self._pass_on(raw[0], raw[1], raw[2])
        for stream in self._streams:
            repeat_latched(stream, self._latched)

    def close(self) -> None:
        """Close the sockets."""
        self._heartbeats.close()
        self._close_run()

    def _on_heartbeat(self, presence: Heartbeat) -> None:
        if presence.pid == self._pid or presence.phase != "joined":
            return
        self._pid = presence.pid
        self._close_run()
        run_dir = run_dir_in(self._runtime_dir)
        try:
            if run_dir is None:
                raise ConfigError(f"{self._runtime_dir / RUN_DIR_FILE}: cannot be read")
            cfg = load_config(run_dir / "config.toml")
            is_sim = read_metadata(run_dir / TELEMETRY).get("simulation") == "true"
        except (OSError, ConfigError) as error:
            self._report(f"a run whose configuration cannot be read is not streamed: {error}")
            return
        self._clock = RobotClock(is_simulation=is_sim)
        self._views = Views(build_mirror(cfg.mirror), cfg.robot.puck_height_m, self._clock)
        mirror, world, run = cfg.mirror.name, cfg.world.name if is_sim else "", cfg.run
        fact = RunFact(mirror, world, is_sim, run.seed, filter=run.filter, run_dir=str(run_dir))
        self._send((RecordedMessage(RUN, 0.0, json.dumps(msgspec.to_builtins(fact)).encode()), *self._views.begin()))
        names = ("main", "danger", "truth") if is_sim else ("main", "danger")
        topics = dict.fromkeys((*PASSED_ON, *TURNED_INTO_VIEWS))
        self._run = Subscriber(self._context, [self._endpoints.of(name) for name in names], topics)
        self._report(f"streaming {'SIMULATION of ' if is_sim else ''}{mirror}, {run_dir}")

    def _pass_on(self, name: str, body: bytes, message: Message) -> None:
        if name in PASSED_ON:
            self._send([RecordedMessage(name, max(message.t_s, 0.0), body)])
        if name in TURNED_INTO_VIEWS and self._views is not None:
            self._send(self._views.of(message))

    def _send(self, messages: Iterable[RecordedMessage]) -> None:
        for message in messages:
            shown = message._replace(t_s=self._clock.utc_ns(message.t_s) / 1e9)
            if shown.topic in LATCHED:
                self._latched[shown.topic] = shown
            for stream in self._streams:
                stream.send(shown)

    def _close_run(self) -> None:
        if self._run is not None:
            self._run.close()
            self._run = None


def serve(
    runtime_dir: Path | None,
    host: str,
    plotjuggler_port: int | None,
    foxglove_port: int | None,
    *,
    is_open: bool,
    report: Callable[[str], None],
) -> int:
    """Stream until SIGINT or SIGTERM.

    ``plotjuggler_port``, ``foxglove_port``: 0 takes any free port, ``None`` disables the stream. ``is_open``: permits
    a host address that is not local. StreamError: a stream cannot be served.
    """
    check_host(host, is_open=is_open)
    folder = runtime_dir_path(str(runtime_dir or ""), os.environ)
    is_over = False

    def end(_number: int, _frame: FrameType | None) -> None:
        nonlocal is_over
        is_over = True

    with ExitStack() as stack:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.destroy, 0)  # term would wait forever for a socket that an error left open
        streams: list[LiveStream] = []
        if plotjuggler_port is not None:
            streams.append(PlotJugglerStream(context, host, plotjuggler_port))
            stack.callback(streams[-1].close)
        if foxglove_port is not None:
            streams.append(FoxgloveStream("ccatp", host, foxglove_port, streamed_schemas()))
            stack.callback(streams[-1].close)
        for stream in streams:
            report(f"serving at {stream.where}")
        streamer = Streamer(context, folder, streams, report)
        stack.callback(streamer.close)
        for number in (signal.SIGINT, signal.SIGTERM):
            stack.callback(signal.signal, number, signal.signal(number, end))
        os.nice(NICENESS)
        report(f"waiting for a run in {folder}")
        while not is_over:
            streamer.step()
    return 0
