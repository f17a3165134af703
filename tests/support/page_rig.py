"""The real dashboard at a free port, and a simulated daemon: publishers, and an operator channel."""

import asyncio
import json
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import structlog
import zmq
import zmq.asyncio
from structlog.testing import LogCapture
from structlog.typing import FilteringBoundLogger

from ccatp.config.models import Config
from ccatp.daemon.operator.dashboard import serve_page
from ccatp.daemon.supervision.process import Endpoints, RunContext
from ccatp.links.bus import Publisher
from ccatp.links.channels import format_ok
from ccatp.links.rpc import Router
from ccatp.links.topics import DisplayState, Heartbeat, MissionStatus
from ccatp.report.dashboard.access import make_token

DEADLINE_S = 20.0
Handler = Callable[[bytes], Awaitable[bytes]]


@dataclass
class Reply:
    """An answer over HTTP."""

    code: int
    headers: dict[str, str]
    body: bytes

    @property
    def data(self) -> Any:
        return json.loads(self.body)


@dataclass
class Rig:
    """What a test has in hand: publishers of the played daemon, what ends the dashboard and what it logged.

    ``asked``: requests that came over the daemon's channels; ``answer``: what answers them.
    """

    port: int
    token: str
    main: Publisher
    danger: Publisher
    truth: Publisher
    stop: asyncio.Event
    lines: Sequence[Mapping[str, Any]]
    asked: list[dict[str, Any]] = field(default_factory=list)
    answer: Handler | None = None
    _seq: int = 0

    async def handle(self, frame: bytes) -> bytes:
        self.asked.append(json.loads(frame))
        return format_ok() if self.answer is None else await self.answer(frame)

    def tell_alive(self, phase: str = "joined", line: bytes = b"null", **status: Any) -> None:
        """Both loops speak, and the mission drives, or is as ``status`` has it."""
        self._seq += 1
        now_s = time.monotonic()
        for publisher, name in ((self.main, "main"), (self.danger, "danger")):
            known = Heartbeat(seq=self._seq, t_s=now_s, process=name, pid=1, phase=phase, frame_age_s=0.01)
            publisher.send(f"heartbeat.{name}", known)
        self.main.send("mission", mission(seq=self._seq, **status))
        self.main.send("display_state", picture(self._seq, line))

    async def ask(self, method: str, path: str, host: str = "", body: bytes = b"", **headers: str) -> Reply:
        """One request on a connection of its own, a command with the token; header names with _ for -."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
        lines = [f"{method} {path} HTTP/1.1", f"host: {host or f'127.0.0.1:{self.port}'}", "connection: close"]
        if method == "POST":
            headers = {"authorization": f"Bearer {self.token}", **headers}
        if body and "transfer_encoding" not in headers:
            headers = {"content_length": str(len(body)), **headers}
        lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
        writer.write(("\r\n".join(lines) + "\r\n\r\n").encode() + body)
        try:
            async with asyncio.timeout(DEADLINE_S):
                head, _, body = (await reader.read()).partition(b"\r\n\r\n")
        finally:
            writer.close()
            await writer.wait_closed()
        first, *rest = head.decode("latin-1").split("\r\n")
        return Reply(int(first.split()[1]), {k.lower(): v for k, _, v in (line.partition(": ") for line in rest)}, body)

    async def until(self, path: str, is_there: Callable[[Reply], bool]) -> Reply:
        """Ask until the answer is as wanted; the played daemon lives meanwhile."""
        async with asyncio.timeout(DEADLINE_S):
            while True:
                self.tell_alive()
                reply = await self.ask("GET", path)
                if is_there(reply):
                    return reply

    @asynccontextmanager
    async def page(self, address: str = "127.0.0.1") -> AsyncIterator["Page"]:
        """An open page of a client at this address."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port, local_addr=(address, 0))
        writer.write(f"GET /events HTTP/1.1\r\nhost: 127.0.0.1:{self.port}\r\n\r\n".encode())
        async with asyncio.timeout(DEADLINE_S):
            head = await reader.readuntil(b"\r\n\r\n")
        try:
            yield Page(reader, head)
        finally:
            writer.close()
            await writer.wait_closed()


class Page:
    """The events of an open page."""

    def __init__(self, reader: asyncio.StreamReader, head: bytes) -> None:
        self._reader, self.head = reader, head
        self._text = b""

    async def event(self) -> tuple[str, dict[str, Any]]:
        """The next one."""
        async with asyncio.timeout(DEADLINE_S):
            while b"\n\n" not in self._text:
                size = int(await self._reader.readuntil(b"\r\n"), 16)
                if size == 0:
                    raise EOFError("the stream is over")
                self._text += (await self._reader.readexactly(size + 2))[:-2]
        text, _, self._text = self._text.partition(b"\n\n")
        name, data = (line.partition(b": ")[2] for line in text.split(b"\n"))
        return name.decode(), json.loads(data)

    async def until(self, is_there: Callable[[str, dict[str, Any]], bool]) -> tuple[str, dict[str, Any]]:
        """The first one that is as wanted."""
        while True:
            event = await self.event()
            if is_there(*event):
                return event


def mission(**fields: Any) -> MissionStatus:
    known: dict[str, Any] = {"seq": 1, "t_s": 1.0, "state": "driving", "done": 3, "total": 9}
    return MissionStatus(**(known | fields))


def picture(seq: int, line: bytes = b"null") -> DisplayState:
    return DisplayState(
        seq=seq, t_s=0.1 * seq, x_m=1.0, y_m=-2.0, heading_rad=0.5, covariance_m2=(1e-6, 0.0, 1e-6),
        heading_sigma_rad=0.01, nis=2.0, size=2, line=msgspec.Raw(line),
    )  # fmt: skip


@asynccontextmanager
async def page_rig(cfg: Config, folder: Path, *, has_daemon: bool = True) -> AsyncIterator[Rig]:
    """The dashboard with this configuration at a free port; ``has_daemon``: somebody answers the operator channel.

    ``folder`` is its runtime and run directory, a short path, empty.
    """
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    endpoints = Endpoints(folder)
    listener = socket.create_server(("127.0.0.1", 0))
    capture, stop = LogCapture(), asyncio.Event()
    log: FilteringBoundLogger = structlog.wrap_logger(None, processors=[capture])
    main, danger, truth = (Publisher(context, endpoints.of(name)) for name in ("main", "danger", "truth"))
    rig = Rig(listener.getsockname()[1], make_token(folder), main, danger, truth, stop, capture.entries)
    run = RunContext(cfg, folder, endpoints, is_sim=True)
    page = serve_page(run, listener, stop, log, has_heartbeat=True)
    try:
        async with asyncio.TaskGroup() as tasks:
            served = tasks.create_task(page)
            if has_daemon:
                of_loops = zmq.asyncio.Context.shadow(context)
                async with (
                    Router(endpoints.of("control"), rig.handle, of_loops) as control,
                    Router(endpoints.of("emergency"), rig.handle, of_loops) as emergency,
                ):
                    answering = [tasks.create_task(router.serve()) for router in (control, emergency)]
                    yield rig
                    for task in answering:
                        task.cancel()
                    await asyncio.wait(answering)
            else:
                yield rig
            stop.set()
            await served
    finally:
        for publisher in (main, danger, truth):
            publisher.close()
        context.destroy(linger=0)
