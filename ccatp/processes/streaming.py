"""Glue. Streams the runs of a runtime directory live, one after the other, beside whatever else goes on there.

It only listens, and it subscribes once the loops have joined the robot: nobody waits for it or counts on it.
"""

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import msgspec
import zmq

from ccatp.bus import Subscriber
from ccatp.config.loader import load_config
from ccatp.errors import ConfigError
from ccatp.live_streams import Stream
from ccatp.mirror.mirror import build_mirror
from ccatp.processes.common import RUN_DIR_FILE, Endpoints
from ccatp.run_files.recorder import read_metadata
from ccatp.run_files.recording_tools import TELEMETRY
from ccatp.viewing.plain_schema import plain_schema
from ccatp.viewing.views import VIEWS, Shown, Views, view_schemas
from ccatp.wire.topics import BY_NAME, Message, Presence, schema_of

# What is shown of the topics themselves; batches are shown as their views.
PASSED_ON = ("mission", "arrival", "rest", "treatment", "fix", "danger_event")
TURNED_INTO_VIEWS = ("estimate", "sensors", "fix", "truth", "log")
LATCHED = frozenset(view.name for view in VIEWS if view.is_latched)
RUN = "run"
PERIOD_MS = 20


class RunFact(msgspec.Struct):
    """What runs: the first thing that a viewer wants to know."""

    mirror: str
    world: str
    simulation: bool
    seed: int
    filter: str
    run_dir: str


def streamed_schemas() -> list[tuple[str, dict[str, object]]]:
    """Name and schema of every topic that is streamed."""
    raw = [(name, plain_schema(schema_of(name), f"ccatp.{BY_NAME[name].message.__name__}")) for name in PASSED_ON]
    return [(RUN, plain_schema(msgspec.json.schema(RunFact), "ccatp.Run")), *raw, *view_schemas()]


class Streamer:
    """Listens to the runs of a runtime directory.

    Args:
        context: ZeroMQ context of the process.
        runtime_dir: where the runs are.
        streams: where they are streamed to.
        say: tells the user.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        runtime_dir: Path,
        streams: Sequence[Stream],
        say: Callable[[str], None],
    ) -> None:
        """Listen for a run."""
        self._context, self._streams, self._say = context, streams, say
        self._runtime_dir, self._endpoints = runtime_dir, Endpoints(runtime_dir)
        self._ear = Subscriber(context, [self._endpoints.of("main")], ["presence.main"])
        self._run: Subscriber | None = None
        self._views: Views | None = None
        self._pid = -1

    def step(self) -> None:
        """Wait for a moment and pass on what came."""
        sockets = [self._ear.socket, *([] if self._run is None else [self._run.socket])]
        poller = zmq.Poller()
        for socket in sockets:
            poller.register(socket, zmq.POLLIN)
        poller.poll(PERIOD_MS)
        while (received := self._ear.receive()) is not None:
            if isinstance(received[1], Presence):
                self._heed(received[1])
        while self._run is not None and (raw := self._run.receive_raw()) is not None:
            if isinstance(raw[2], Message):
                self._pass_on(raw[0], raw[1], raw[2])
        for stream in self._streams:
            stream.tend()

    def close(self) -> None:
        """Stop listening."""
        self._ear.close()
        self._forget()

    def _heed(self, presence: Presence) -> None:
        if presence.pid == self._pid or presence.phase != "joined":
            return
        self._forget()
        try:
            run_dir = Path((self._runtime_dir / RUN_DIR_FILE).read_text(encoding="utf-8").strip())
            cfg = load_config(run_dir / "config.toml")
            is_simulation = read_metadata(run_dir / TELEMETRY).get("simulation") == "true"
        except (OSError, ConfigError) as error:
            self._say(f"a run whose configuration cannot be read is not streamed: {error}")
            return
        finally:
            self._pid = presence.pid
        self._views = Views(build_mirror(cfg.mirror), cfg.robot.puck_height_m)
        fact = RunFact(
            cfg.mirror.name, cfg.world.name if is_simulation else "", is_simulation, cfg.run.seed, cfg.run.filter,
            str(run_dir),
        )  # fmt: skip
        self._send((Shown(RUN, 0.0, json.dumps(msgspec.to_builtins(fact)).encode()), *self._views.begin()))
        names = ("main", "danger", "truth") if is_simulation else ("main", "danger")
        topics = dict.fromkeys((*PASSED_ON, *TURNED_INTO_VIEWS))
        self._run = Subscriber(self._context, [self._endpoints.of(name) for name in names], topics)
        self._say(f"streaming {'SIMULATION of ' if is_simulation else ''}{cfg.mirror.name}, {run_dir}")

    def _pass_on(self, name: str, body: bytes, message: Message) -> None:
        if name in PASSED_ON:
            self._send([Shown(name, max(message.t_s, 0.0), body)])
        if name in TURNED_INTO_VIEWS and self._views is not None:
            self._send(self._views.of(message))

    def _send(self, messages: Iterable[Shown]) -> None:
        for shown in messages:
            for stream in self._streams:
                stream.send(shown, is_latched=shown.topic == RUN or shown.topic in LATCHED)

    def _forget(self) -> None:
        if self._run is not None:
            self._run.close()
            self._run = None
