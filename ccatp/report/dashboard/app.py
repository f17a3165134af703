"""The dashboard over HTTP: page, state, metrics, commands in the shape of the telescope control system; the server.

An answer is ``{"status": "ok"}`` or ``{"status": "error", "message": why}`` with a matching HTTP status: 409 for a
refusal, 405 for a wrong method, 503 for what is not available now. All files of the page are part of the package.
"""

import asyncio
import contextlib
import logging
import os
import platform
import socket
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from math import sqrt
from pathlib import Path
from typing import Any, ClassVar
from uuid import uuid4

import msgspec
import structlog
import uvicorn
import zmq
import zmq.asyncio
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Metric, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

import ccatp
from ccatp.conditions import Actor
from ccatp.config.models import DashboardConfig
from ccatp.links.channels import BadRequest, OperatorCommand, format_request, parse_object, parse_reply
from ccatp.links.liveness import LogRateLimit
from ccatp.links.rpc import MAX_REPLY_BYTES
from ccatp.report.dashboard.access import CommandRefusal, check_command, host_refusal
from ccatp.report.dashboard.hub import StateBroadcaster
from ccatp.report.dashboard.openapi import ACKNOWLEDGE, COMMANDS, ENDPOINTS, PREFIX, description

Samples = Iterable[tuple[tuple[str, ...], float | None]]
# Name, help, part of the state, value; left out while that part is not known.
GAUGES: tuple[tuple[str, str, str, Callable[[Any], float | None]], ...] = (
    ("elapsed_seconds", "Of the mission, by the robot's clock.", "mission", lambda m: m["elapsed_s"]),
    ("remaining_seconds", "Estimated time to the end of the mission.", "mission", lambda m: m["eta_s"]),
    ("frame_lag_seconds", "Lateness of the last late frame.", "mission", lambda m: 1e-3 * m["worst_lateness_ms"]),
    ("late_frames", "Frames that were served late.", "mission", lambda m: m["missed_deadlines"]),
    ("arrival_error_meters", "Distance of the last fix from its point.", "mission", lambda m: 1e-3 * m["error_mm"]),
    ("event_code", "Event code: 0 normal, 1 near the edge, 2 aborted.", "verdict", lambda v: v["code"]),
    ("severity", "Severity of the cause, 0 none to 6 fault.", "verdict", lambda v: v["severity"]),
    ("battery_charge_ratio", "Charge of the robot's battery, 0 to 1.", "robot", lambda r: r["charge"]),
    ("wheels_held", "1 when the robot holds its wheels by its own rules.", "robot", lambda r: r["is_held"]),
    ("drive_age_seconds", "Age of the drive in force, by the robot.", "robot", lambda r: r["drive_age_s"]),
    ("permit_age_seconds", "Age of the permit in force, by the robot.", "robot", lambda r: r["permit_age_s"]),
    ("robot_faults", "Faults that the robot reports.", "robot", lambda r: len(r["faults"])),
    ("position_sigma_meters", "Root of the summed variances of x and y.", "pose",
     lambda p: sqrt(max(p.covariance_m2[0] + p.covariance_m2[2], 0.0))),
    ("nis_per_dof", "Normalised innovation squared of the last update, per degree of freedom.", "pose",
     lambda p: p.nis / p.size if p.size else None),
    ("laser_residual_meters", "Root mean square of the last fix's residuals.", "laser",
     lambda fix: 1e-6 * fix["residual_um"]),
    ("laser_dop", "Dilution of precision of the last fix.", "laser", lambda fix: fix["dop"]),
    ("last_fix_age_seconds", "Since the last fix of the laser system.", "laser", lambda fix: fix["age_s"]),
)  # fmt: skip
COUNTERS = {"late_frames", "process_restarts", "process_cpu_seconds"}
POINT_COUNTS = {"planned": "total", "measured": "done", "skipped": "skipped"}


PROCESS_USE = {
    "process_cpu_seconds": "User and system time of a loop.",
    "process_resident_memory_bytes": "Resident memory of a loop.",
}


def process_use(pid: int) -> tuple[float, float] | None:
    """Processor time (s) and resident memory (bytes) of a process; None if it has ended or this is not Linux."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    cpu_s = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return cpu_s, float(int(fields[21]) * os.sysconf("SC_PAGE_SIZE"))


class StateCollector(Collector):
    """Collects the state of a run as Prometheus metrics at each request; ``ground``: see ``survey_view.ground``."""

    def __init__(
        self, state: Callable[[], Mapping[str, Any]], pages: Callable[[], int], ground: Mapping[str, Any]
    ) -> None:
        self._state, self._pages, self._ground = state, pages, ground

    def collect(self) -> Iterator[Metric]:
        """All metrics that have a value."""
        for name, text, labels, samples in self._families(self._state()):
            kind = CounterMetricFamily if name in COUNTERS else GaugeMetricFamily
            family = kind(f"ccatp_{name}", text, labels=labels)
            for of_labels, value in samples:
                if value is not None:
                    family.add_metric(of_labels, float(value))
            if family.samples:
                yield family

    def _families(self, state: Mapping[str, Any]) -> Iterator[tuple[str, str, tuple[str, ...], Samples]]:
        """Name, help, labels and samples of each metric."""
        links, mission, robot = state["links"], state["mission"], state["robot"]
        what = (str(self._ground["title"]), str(state["is_sim"]).lower(), ccatp.__version__)
        yield "info", "What runs.", ("mirror", "simulation", "version"), [(what, 1.0)]
        yield "up", "1 when both loops report and the robot sends frames.", (), [((), not state["trouble"])]
        build = (ccatp.__version__, platform.python_version())
        yield "build_info", "The program.", ("version", "python"), [(build, 1.0)]
        uses = {process: process_use(pid) for process, pid in state["pids"].items()}
        for k, (name, text) in enumerate(PROCESS_USE.items()):
            yield name, text, ("process",), [((process,), use[k]) for process, use in uses.items() if use is not None]
        yield "dashboard_pages", "Open pages.", (), [((), self._pages())]
        yield "link_up", "1 when that end reports.", ("link",), [((link.name,), link.is_well) for link in links]
        ages = [((link.name,), link.age_s) for link in links]
        yield "link_age_seconds", "Since the last message of that end.", ("link",), ages
        restarts = [((process,), count) for process, count in state["restarts"].items()]
        yield "process_restarts", "Restarts of a process that the dashboard has seen.", ("process",), restarts
        for name, text, part, value_of in GAUGES:
            if state.get(part) is not None:
                yield name, text, (), [((), value_of(state[part]))]
        active = [alarm for alarm in state["alarms"] if not alarm["ended"]]
        rows = [((alarm["name"], alarm["severity"]), 1.0) for alarm in active]
        yield "alarm", "1 for each active alarm.", ("name", "severity"), rows
        unseen = sum(not alarm["acknowledged_by"] for alarm in state["alarms"])
        yield (
            "alarms_unacknowledged",
            "Alarms that nobody has acknowledged: active, or ended with severity hold or above.",
            (),
            [((), unseen)],
        )
        if mission is not None:
            states = [((known,), known == mission["state"]) for known in self._ground["states"]]
            yield "mission_state", "1 for the state of the mission.", ("state",), states
            actors = [((str(actor),), actor == mission["turn"].get("actor")) for actor in Actor]
            yield "next_actor", "1 for who acts next.", ("actor",), actors
            counts = [((name,), mission[key]) for name, key in POINT_COUNTS.items()]
            yield "points", "Measurement points, or waypoints.", ("state",), counts
        if robot is not None:
            fans = [((side,), duty) for side, duty in zip(("left", "right"), robot["fans"], strict=True)]
            yield "fan_duty_ratio", "Duty of the fans, as the robot echoes it, 0 to 1.", ("side",), fans


STATIC = Path(__file__).resolve().parent / "static"
ANSWERED_BY = {"control": "the main loop", "emergency": "the danger loop"}
# Pending commands of all pages together; an operator has one at a time.
MAX_COMMANDS = 8
HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}
# Unsent bytes of an answer in the kernel; a larger buffer would delay the detection of a client that does not read.
SEND_BUFFER_BYTES = 16_384
# For incomplete answers at the end; event streams end earlier.
GRACE_S = 1
KEEP_ALIVE_S = 5
MAX_HEADER_BYTES = 16_384
MAX_BODY_BYTES = 65_536
TOO_LONG = f"the body of the request is longer than {MAX_BODY_BYTES} bytes"
MAX_UNREAD_BYTES = 4_194_304
# Every client of the port can cause log lines of refusals, so their number is limited.
REFUSAL_LINES, REFUSAL_PERIOD_S = 10, 60.0


class CommandEndpoint:
    """Passes commands of the page to the daemon's channels."""

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], endpoint_of: Callable[[str], str], timeout_s: float
    ) -> None:
        self._context: zmq.asyncio.Context = zmq.asyncio.Context.shadow(context)
        self._endpoint_of, self._timeout_s = endpoint_of, timeout_s
        self._slots = asyncio.Semaphore(MAX_COMMANDS)

    async def ask(self, command: str, frame: bytes) -> dict[str, Any] | CommandRefusal:
        """Send a command and wait for the reply, which comes when it has taken effect; return it or the refusal."""
        if self._slots.locked():
            return CommandRefusal(503, f"{command}: {MAX_COMMANDS} commands wait for their answers already")
        channel = COMMANDS[command]
        who = ANSWERED_BY[channel]
        try:
            async with self._slots, asyncio.timeout(self._timeout_s):
                with self._context.socket(zmq.DEALER) as peer:
                    peer.setsockopt(zmq.LINGER, 0)
                    peer.setsockopt(zmq.MAXMSGSIZE, MAX_REPLY_BYTES)
                    peer.connect(self._endpoint_of(channel))
                    await peer.send_multipart([b"", frame])
                    *_, answer = await peer.recv_multipart()
            reply = parse_reply(answer)
        except TimeoutError:
            return CommandRefusal(504, f"{command}: no answer from {who} within {self._timeout_s:g} s")
        except BadRequest as error:
            return CommandRefusal(502, f"{command}: {who} answered with {error}")
        return reply if reply["ok"] else CommandRefusal(409, f"{command}: {reply.get('error', 'refused')}")


class RequestCheckMiddleware:
    """Refuses foreign host names with a reason, and bodies that are too long; adds the security headers.

    If a request is answered before its body is read, the rest of the body is discarded, within limits. So a client that
    sends the whole body before it reads also gets the answer. Then the connection is closed.
    """

    def __init__(self, app: ASGIApp, cfg: DashboardConfig) -> None:
        self._app, self._cfg = app, cfg

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        request = Headers(scope=scope)
        length = int(request.get("content-length", 0))
        is_unread, left = length > 0 or "transfer-encoding" in request, MAX_UNREAD_BYTES

        async def receive_body() -> Message:
            nonlocal is_unread, left
            message = await receive()
            left -= len(message.get("body", b""))
            is_unread = bool(message.get("more_body")) and left > 0
            return message if left > 0 else {"type": "http.disconnect"}

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update(HEADERS)
                headers.setdefault("cache-control", "no-cache" if "etag" in headers else "no-store")
                if is_unread:
                    headers["connection"] = "close"
            elif is_unread and not message.get("more_body"):
                await send({**message, "more_body": True})
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(self._cfg.slow_client_s):
                        while (await receive_body()).get("more_body"):
                            pass
                message = {"type": "http.response.body"}
            await send(message)

        app = self._app
        if (refusal := host_refusal(request.get("host"), self._cfg.host_names)) is not None:
            app = _error(421, refusal)
        elif length > MAX_BODY_BYTES:
            app = _error(413, TOO_LONG)
        await app(scope, receive_body, send_with_headers)


def build_app(
    hub: StateBroadcaster, commands: CommandEndpoint, ground: Mapping[str, Any], cfg: DashboardConfig,
    tokens: Mapping[str, str], log: structlog.typing.FilteringBoundLogger,
) -> ASGIApp:  # fmt: skip
    """The application; ``ground``: see ``survey_view.ground``; commands need one of ``tokens``, by name."""
    refusals = LogRateLimit(REFUSAL_LINES, REFUSAL_PERIOD_S)
    static = StaticFiles(directory=STATIC)
    registry = CollectorRegistry()
    registry.register(StateCollector(hub.state, lambda: hub.pages, ground))

    async def file(request: Request) -> Response:
        return await static.get_response(request.path_params.get("path", "index.html"), request.scope)

    async def events(_request: Request) -> Response:
        return StreamingResponse(hub.events(), media_type="text/event-stream", headers={"x-accel-buffering": "no"})

    async def status(_request: Request) -> Response:
        return _json({"status": "ok", **await hub.whole_state()})

    async def alarms(_request: Request) -> Response:
        return _json({"status": "ok", "alarms": hub.state()["alarms"]})

    async def healthz(_request: Request) -> Response:
        trouble = hub.state()["trouble"]
        return _error(503, trouble) if trouble else _json({"status": "ok"})

    async def metrics(_request: Request) -> Response:
        await hub.whole_state()  # so that the pose is known even without an open page
        return Response(generate_latest(registry), media_type=CONTENT_TYPE_LATEST)

    async def operator(request: Request) -> Response:
        by = check_command(request.headers, tokens)
        return _refused(by) if isinstance(by, CommandRefusal) else _json({"status": "ok", "name": by})

    async def command(request: Request) -> Response:
        name = _command(request)
        line = {"command": name, "client": request.client.host if request.client is not None else "?"}
        by = check_command(request.headers, tokens)
        if isinstance(by, CommandRefusal):
            if (left_out := refusals.take(asyncio.get_running_loop().time())) is not None:
                log.info("page_request_refused", **line, why=by.message, left_out=left_out)
            return _refused(by)
        request.state.is_command = True  # its connection must not be closed
        reply = await commands.ask(name, _frame(name, await _body(request, cfg.slow_client_s), by))
        refusal = reply.message if isinstance(reply, CommandRefusal) else ""
        log.info("page_command", **line, by=by, refusal=refusal)
        if isinstance(reply, CommandRefusal):
            return _error(*reply)
        return _json({"status": "ok", **{key: reply[key] for key in ("id", "latched", "code") if key in reply}})

    reads = {"/": file, "/static/{path}": file, "/ground": _constant(ground), "/events": events, "/status": status,
             "/alarms": alarms, "/healthz": healthz, "/metrics": metrics,
             "/openapi.json": _constant(description()), "/operator": operator}  # fmt: skip
    routes = [Route(row.path, reads.get(row.path, command), methods=[row.method]) for row in ENDPOINTS]
    return Starlette(
        routes=[*routes, Mount(PREFIX, routes=routes)],
        middleware=[Middleware(RequestCheckMiddleware, cfg=cfg)],
        exception_handlers={HTTPException: _http_error},
    )


async def _body(request: Request, slow_client_s: float) -> bytes:
    body = b""
    try:
        async with asyncio.timeout(slow_client_s):
            async for part in request.stream():
                body += part
                if len(body) > MAX_BODY_BYTES:
                    raise HTTPException(413, TOO_LONG)
    except TimeoutError as error:
        raise HTTPException(408, f"the body of the request took more than {slow_client_s:g} s") from error
    return body


def _command(request: Request) -> str:
    """The path of a request as in ``COMMANDS``, if it is one of these."""
    return request.url.path.removeprefix(PREFIX).strip("/")


def _frame(command: str, body: bytes, by: str) -> bytes:
    """The request of a channel, with the name of the token; an emergency without an id gets one."""
    try:
        if COMMANDS[command] == "emergency":
            return format_request(**{"id": str(uuid4()), **parse_object(body), "cmd": command})
        if command == ACKNOWLEDGE:
            return format_request(OperatorCommand.ACKNOWLEDGE, name=parse_object(body).get("name", ""), by=by)
    except ValueError as error:
        raise HTTPException(400, f"{command}: {error}") from error
    return format_request(command, by=by)


async def _http_error(request: Request, error: Exception) -> Response:
    code, text = (error.status_code, error.detail) if isinstance(error, HTTPException) else (500, "internal error")
    method = "POST" if _command(request) in COMMANDS else "GET"
    texts = {404: f"bad endpoint: {request.url.path}", 405: f"method not {method}"}
    return _error(code, texts.get(code, text), {"allow": method} if code == 405 else {})


def _json(data: Mapping[str, Any], code: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    return Response(msgspec.json.encode(data) + b"\n", code, headers, media_type="application/json")


def _constant(data: Mapping[str, Any]) -> Callable[[Request], Awaitable[Response]]:
    async def answer(_request: Request) -> Response:
        return _json(data)

    return answer


def _refused(refusal: CommandRefusal) -> Response:
    return _error(*refusal, {"www-authenticate": "Bearer"} if refusal.http_status == 401 else {})


def _error(code: int, message: str, headers: Mapping[str, str] | None = None) -> Response:
    return _json({"status": "error", "message": message}, code, headers)


class LimitedProtocol(H11Protocol):
    """A connection with limits of number, time and size.

    At most ``max_connections`` are open, and half as many of one address. A new connection above a limit closes the
    oldest connection of its own address, or of the addresses with the most connections; one without a request is closed
    first. A connection with a command is not closed; if there are only these, the new connection is closed.
    A connection is also closed if for ``slow_client_s`` it sends no complete request or accepts no part of an answer.
    uvicorn's ``limit_concurrency`` is not used: at the limit it answers 503 on the open connections as well.
    """

    max_connections: ClassVar[int]
    slow_client_s: ClassVar[float]
    _timeout: asyncio.TimerHandle | None = None
    _opened_s = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Close a connection if a limit is exceeded."""
        super().connection_made(transport)
        self._opened_s = self.loop.time()
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        transport.set_write_buffer_limits(0)
        self._limit(True)
        if (surplus := self._find_surplus()) is not None:
            self.connections.discard(surplus)
            surplus.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection was closed by the client or by a limit."""
        self._limit(False)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Receive a part of a request; the time limit applies until the request is complete."""
        super().data_received(data)
        if self._is_serving:
            if not self.flow.write_paused:
                self._limit(False)
        elif self._timeout is None:
            self._limit(True)

    def pause_writing(self) -> None:
        """The client accepts no data: start the time limit."""
        super().pause_writing()
        self._limit(True)

    def resume_writing(self) -> None:
        """The client has accepted data: end the time limit."""
        super().resume_writing()
        self._limit(False)

    @property
    def _is_serving(self) -> bool:
        return bool(self.headers) and not self.cycle.response_complete

    def _find_surplus(self) -> "LimitedProtocol | None":
        """The connection to close if a limit is exceeded; this one if all others have commands."""
        address_of = {one: one.client and one.client[0] for one in self.connections if isinstance(one, LimitedProtocol)}
        number_at = Counter(address_of.values())
        if number_at[address_of[self]] > self.max_connections // 2:
            addresses = {address_of[self]}
        elif len(address_of) > self.max_connections:
            most = max(number_at.values())
            addresses = {address for address, number in number_at.items() if number == most}
        else:
            return None
        others = [one for one, address in address_of.items() if address in addresses and one is not self]
        return min(
            (one for one in others if not (one._is_serving and "is_command" in one.scope["state"])),
            key=lambda one: (one._is_serving and not one.flow.write_paused, one._opened_s),
            default=self,
        )

    def _limit(self, is_limited: bool) -> None:
        if self._timeout is not None:
            self._timeout.cancel()
        self._timeout = self.loop.call_later(self.slow_client_s, self.transport.abort) if is_limited else None


class _Server(uvicorn.Server):
    """A server without signal handlers: the process has its own."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


async def serve(app: ASGIApp, listener: socket.socket, cfg: DashboardConfig, stop: asyncio.Event) -> None:
    """Serve at a listening socket until ``stop`` is set, then end within ``GRACE_S`` and close the socket."""

    class Protocol(LimitedProtocol):
        max_connections, slow_client_s = cfg.max_connections, cfg.slow_client_s

    logging.getLogger("uvicorn.access").disabled = True
    config = uvicorn.Config(
        app, http=Protocol, ws="none", loop="none", lifespan="off", log_config=None, access_log=False,
        proxy_headers=False, server_header=False, timeout_keep_alive=KEEP_ALIVE_S, timeout_graceful_shutdown=GRACE_S,
        h11_max_incomplete_event_size=MAX_HEADER_BYTES,
    )  # fmt: skip
    server = _Server(config)

    async def end() -> None:
        await stop.wait()
        server.should_exit = True

    async with asyncio.TaskGroup() as tasks:
        ending = tasks.create_task(end())
        await server.serve(sockets=[listener])
        ending.cancel()
