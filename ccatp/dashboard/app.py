"""Edge. The dashboard over HTTP: the page, its state, and commands in the shape of the telescope control system.

There, an answer is ``{"status": "ok"}`` or ``{"status": "error", "message": why}``, with an HTTP status that says the
same: 409 for a refusal, 405 for a wrong method, 503 for what cannot be had now.
"""

import asyncio
from collections.abc import Awaitable, Callable, Collection, Mapping
from typing import Any

import msgspec
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ccatp.dashboard.access import host_refusal, origin_refusal, token_refusal
from ccatp.dashboard.commands import COMMANDS, CommandDesk
from ccatp.dashboard.hub import Hub, Stream
from ccatp.dashboard.metrics import CONTENT_TYPE, metrics_text
from ccatp.dashboard.static_files import StaticFile, read_static_files
from ccatp.wire.channels import OperatorCommand

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


class Door:
    """Refuses who asks by a wrong name, and puts the page's headers on every answer.

    Args:
        app: what is behind it.
        names: under which this machine may be asked.
    """

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

    def __init__(self, hub: Hub) -> None:
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


async def _wait_for_end(receive: Receive, stream: Stream) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
    stream.end(b"")


def build_app(
    hub: Hub,
    desk: CommandDesk,
    ground: Mapping[str, Any],
    *,
    host_names: Collection[str],
    token: str | None,
    note: Note,
) -> ASGIApp:
    """The application.

    Args:
        hub: the state.
        desk: takes commands.
        ground: what does not change, ``ccatp.dashboard.ground``.
        host_names: under which the page may be asked for, besides localhost and addresses.
        token: that commands have to carry, or ``None``.
        note: a line for the log, with its fields.
    """
    files = read_static_files()
    ground_json = msgspec.json.encode(ground)

    async def page(_request: Request) -> Response:
        return _file(_request, files["index.html"])

    async def static(request: Request) -> Response:
        found = files.get(request.path_params["name"])
        return _error(404, f"bad endpoint: {request.url.path}") if found is None else _file(request, found)

    async def the_ground(_request: Request) -> Response:
        return _json_bytes(ground_json)

    async def status(_request: Request) -> Response:
        return _json({"status": "ok", **hub.state()})

    async def healthz(_request: Request) -> Response:
        trouble = hub.state()["trouble"]
        return _error(503, trouble) if trouble else _json({"status": "ok"})

    async def metrics(_request: Request) -> Response:
        text = metrics_text(hub.state(), ground, hub.pages)
        return Response(text, headers={"content-type": CONTENT_TYPE, "cache-control": "no-store"})

    def command(name: OperatorCommand) -> Callable[[Request], Awaitable[Response]]:
        async def obey(request: Request) -> Response:
            headers = request.headers
            client = request.client.host if request.client is not None else "?"
            refusal = origin_refusal(headers.get("origin"), headers.get("sec-fetch-site"), headers["host"])
            if refusal is not None:
                note("refused", {"command": str(name), "client": client, "why": refusal})
                return _error(403, refusal)
            refusal = token_refusal(headers.get("authorization"), token)
            if refusal is not None:
                note("refused", {"command": str(name), "client": client, "why": refusal})
                return _error(401, refusal, {"www-authenticate": "Bearer"})
            answer = await desk.ask(name)
            note("command", {"command": str(name), "client": client, "refusal": answer.refusal})
            return _error(answer.http_status, answer.refusal) if answer.refusal else _json({"status": "ok"})

        return obey

    async def refused(request: Request, error: Exception) -> Response:
        code = error.status_code if isinstance(error, HTTPException) else 500
        wanted = "POST" if request.url.path.strip("/") in COMMANDS else "GET"
        texts = {404: f"bad endpoint: {request.url.path}", 405: f"method not {wanted}"}
        headers = {"allow": wanted} if code == 405 else {}
        return _error(code, texts.get(code, "internal error"), headers)

    routes = [
        Route("/", page),
        Route("/static/{name}", static),
        Route("/ground", the_ground),
        Route("/events", Events(hub)),
        Route("/status", status),
        Route("/healthz", healthz),
        Route("/metrics", metrics),
        *(Route(f"/{name}", command(name), methods=["POST"]) for name in COMMANDS),
    ]
    door = Middleware(Door, names=host_names)
    return Starlette(routes=routes, middleware=[door], exception_handlers={HTTPException: refused})


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
