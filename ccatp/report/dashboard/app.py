"""The dashboard over HTTP: the page, its state, and commands in the shape of the telescope control system.

There, an answer is ``{"status": "ok"}`` or ``{"status": "error", "message": why}``, with an HTTP status that says the
same: 409 for a refusal, 405 for a wrong method, 503 for what cannot be had now.

The page's files, read once: the program brings all of them, and nothing is fetched from elsewhere.

Hands the commands of a page to the operator channel, and its answer back.
"""

import asyncio
from collections.abc import Callable, Collection, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import zmq
import zmq.asyncio
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ccatp.links.channels import BadRequest, OperatorCommand, format_request, parse_reply
from ccatp.links.rpc import MAX_REPLY_BYTES
from ccatp.report.dashboard.access import host_refusal, origin_refusal, token_refusal
from ccatp.report.dashboard.hub import EventStream, StateBroadcaster
from ccatp.report.dashboard.metrics import CONTENT_TYPE, metrics_text

FOLDER = Path(__file__).resolve().parent / "static"
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


class StaticFile(NamedTuple):
    """A file as it is sent."""

    body: bytes
    media_type: str
    etag: str


def read_static_files(folder: Path = FOLDER) -> dict[str, StaticFile]:
    """The files by their names; others in the folder, like licences, are not served."""
    files = {}
    for path in sorted(folder.iterdir()):
        if path.suffix in TYPES:
            body = path.read_bytes()
            files[path.name] = StaticFile(body, TYPES[path.suffix], f'"{sha256(body).hexdigest()[:16]}"')
    return files


COMMANDS = (OperatorCommand.PAUSE, OperatorCommand.RESUME, OperatorCommand.ABORT, OperatorCommand.STOP)
# Of all pages together; an operator has one at a time.
MOST = 8


class RouteResponse(NamedTuple):
    """What became of a command: the HTTP status, and the refusal or nothing."""

    http_status: int
    refusal: str


class CommandEndpoint:
    """Asks the main loop.

    Args:
        timeout_s: longest wait for the answer, which comes when the command took effect.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, timeout_s: float) -> None:
        self._context: zmq.asyncio.Context = zmq.asyncio.Context.shadow(context)
        self._endpoint, self._timeout_s = endpoint, timeout_s
        self._asking = 0

    async def ask(self, command: OperatorCommand) -> RouteResponse:
        """Hand on one command; never raises for what the daemon does or does not."""
        if self._asking >= MOST:
            return RouteResponse(503, f"{command}: {MOST} commands wait for their answers already")
        self._asking += 1
        try:
            async with asyncio.timeout(self._timeout_s):
                return await self._exchange(command)
        except TimeoutError:
            return RouteResponse(504, f"{command}: no answer from the main loop within {self._timeout_s:g} s")
        finally:
            self._asking -= 1

    async def _exchange(self, command: OperatorCommand) -> RouteResponse:
        with self._context.socket(zmq.DEALER) as peer:
            peer.setsockopt(zmq.LINGER, 0)
            peer.setsockopt(zmq.MAXMSGSIZE, MAX_REPLY_BYTES)
            peer.connect(self._endpoint)
            await peer.send_multipart([b"", format_request(command)])
            *_, frame = await peer.recv_multipart()
        try:
            reply = parse_reply(frame)
        except BadRequest as error:
            return RouteResponse(502, f"{command}: the main loop answered with {error}")
        return (
            RouteResponse(200, "") if reply["ok"] else RouteResponse(409, f"{command}: {reply.get('error', 'refused')}")
        )


Note = Callable[[str, dict[str, object]], None]

HEADERS = (
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
        b"base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
)
_EVENTS = (
    (b"content-type", b"text/event-stream; charset=utf-8"),
    (b"cache-control", b"no-store"),
    (b"x-accel-buffering", b"no"),
)


class HostCheckMiddleware:
    """Refuses who asks by a wrong name, and puts the page's headers on every answer."""

    def __init__(self, app: ASGIApp, names: Collection[str]) -> None:
        self._app, self._names = app, names

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", ()), *HEADERS]
            await send(message)

        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        host = dict(scope["headers"]).get(b"host")
        refusal = host_refusal(host.decode("latin-1") if host is not None else None, self._names)
        app = self._app if refusal is None else _error(421, refusal)
        await app(scope, receive, send_with_headers)


class Events:
    """The stream of the state, until the page goes or the dashboard ends."""

    def __init__(self, hub: StateBroadcaster) -> None:
        self._hub = hub

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one page."""
        if scope["method"] != "GET":
            await _error(405, "method not GET")(scope, receive, send)
            return
        await send({"type": "http.response.start", "status": 200, "headers": list(_EVENTS)})
        with self._hub.open() as stream:
            async with asyncio.TaskGroup() as tasks:
                gone = tasks.create_task(_wait_for_end(receive, stream))
                async for payload in stream:
                    await send({"type": "http.response.body", "body": payload, "more_body": True})
                gone.cancel()
        await send({"type": "http.response.body", "body": b"", "more_body": False})


async def _wait_for_end(receive: Receive, stream: EventStream) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
    stream.end(b"")


class ReadRoutes:
    """What is answered to each question.

    Args:
        ground: what does not change, ``ccatp.report.dashboard.survey_view``.
    """

    def __init__(self, hub: StateBroadcaster, ground: Mapping[str, Any]) -> None:
        self._hub, self._ground = hub, ground
        self._ground_json, self._files = msgspec.json.encode(ground), read_static_files()

    async def page(self, request: Request) -> Response:
        """The page itself."""
        return _file(request, self._files["index.html"])

    async def static(self, request: Request) -> Response:
        """What the page is made of."""
        found = self._files.get(request.path_params["name"])
        return _error(404, f"bad endpoint: {request.url.path}") if found is None else _file(request, found)

    async def ground(self, _request: Request) -> Response:
        """What does not change."""
        return _json_bytes(self._ground_json)

    async def status(self, _request: Request) -> Response:
        """The state as a whole."""
        return _json({"status": "ok", **await self._hub.whole_state()})

    async def healthz(self, _request: Request) -> Response:
        """Whether all is well."""
        trouble = self._hub.state()["trouble"]
        return _error(503, trouble) if trouble else _json({"status": "ok"})

    async def metrics(self, _request: Request) -> Response:
        """The state in the text format of Prometheus."""
        text = metrics_text(self._hub.state(), self._ground, self._hub.pages)
        return Response(text, headers={"content-type": CONTENT_TYPE, "cache-control": "no-store"})


class CommandRoutes:
    """Where commands are taken: from our own page, and with the token if there is one.

    Args:
        token: that commands have to carry, or ``None``.
    """

    def __init__(self, desk: CommandEndpoint, token: str | None, note: Note) -> None:
        self._desk, self._token, self._note = desk, token, note

    async def obey(self, name: OperatorCommand, request: Request) -> Response:
        """Pass a command on, or say why not."""
        headers, told = request.headers, {"command": str(name)}
        told["client"] = request.client.host if request.client is not None else "?"
        refusal = origin_refusal(headers.get("origin"), headers.get("sec-fetch-site"), headers["host"])
        if refusal is not None:
            self._note("page_request_refused", {**told, "why": refusal})
            return _error(403, refusal)
        refusal = token_refusal(headers.get("authorization"), self._token)
        if refusal is not None:
            self._note("page_request_refused", {**told, "why": refusal})
            return _error(401, refusal, {"www-authenticate": "Bearer"})
        answer = await self._desk.ask(name)
        self._note("page_command", {**told, "refusal": answer.refusal})
        return _error(answer.http_status, answer.refusal) if answer.refusal else _json({"status": "ok"})

    def route(self, name: OperatorCommand) -> Route:
        """The way to it for one command."""

        async def obey(request: Request) -> Response:
            return await self.obey(name, request)

        return Route(f"/{name}", obey, methods=["POST"])


def build_app(
    hub: StateBroadcaster,
    desk: CommandEndpoint,
    ground: Mapping[str, Any],
    *,
    host_names: Collection[str],
    token: str | None,
    note: Note,
) -> ASGIApp:
    """The application.

    Args:
        ground: what does not change, ``ccatp.report.dashboard.survey_view``.
        host_names: under which the page may be asked for, besides localhost and addresses.
        token: that commands have to carry, or ``None``.
    """
    answers, counter = ReadRoutes(hub, ground), CommandRoutes(desk, token, note)
    routes = [
        Route("/", answers.page),
        Route("/static/{name}", answers.static),
        Route("/ground", answers.ground),
        Route("/events", Events(hub)),
        Route("/status", answers.status),
        Route("/healthz", answers.healthz),
        Route("/metrics", answers.metrics),
        *(counter.route(name) for name in COMMANDS),
    ]
    door = Middleware(HostCheckMiddleware, names=host_names)
    return Starlette(routes=routes, middleware=[door], exception_handlers={HTTPException: _refused})


async def _refused(request: Request, error: Exception) -> Response:
    code = error.status_code if isinstance(error, HTTPException) else 500
    wanted = "POST" if request.url.path.strip("/") in COMMANDS else "GET"
    texts = {404: f"bad endpoint: {request.url.path}", 405: f"method not {wanted}"}
    headers = {"allow": wanted} if code == 405 else {}
    return _error(code, texts.get(code, "internal error"), headers)


def _json(data: Mapping[str, Any], code: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    return _json_bytes(msgspec.json.encode(data) + b"\n", code, headers)


def _json_bytes(body: bytes, code: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    return Response(body, code, {"content-type": "application/json", "cache-control": "no-store", **(headers or {})})


def _error(code: int, message: str, headers: Mapping[str, str] | None = None) -> Response:
    return _json({"status": "error", "message": message}, code, headers)


def _file(request: Request, file: StaticFile) -> Response:
    headers = {"content-type": file.media_type, "cache-control": "no-cache", "etag": file.etag}
    if request.headers.get("if-none-match") == file.etag:
        return Response(status_code=304, headers={"etag": file.etag, "cache-control": "no-cache"})
    return Response(file.body, headers=headers)
