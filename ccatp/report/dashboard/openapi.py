"""The table of the HTTP interface: the application's routes and ``GET /openapi.json`` are made from it."""

from http import HTTPStatus
from typing import Any, NamedTuple

import msgspec

import ccatp
from ccatp.core import EmergencyKind, Verdict
from ccatp.links.topics import Alarm, DisplayState, MissionStatus

PREFIX = "/api/v1"  # every path exists with it and without
ACKNOWLEDGE = "alarms/ack"
Schema = dict[str, Any]

JSON = "application/json"


def _ref(name: str) -> Schema:
    return {"$ref": f"#/components/schemas/{name}"}


def _object(*required: str, **properties: Schema) -> Schema:
    return {"type": "object", "properties": properties, "required": list(required)}


_TEXT: Schema = {"type": "string"}
_OK: Schema = {"const": "ok"}
_ID = {"type": "string", "format": "uuid"}
_CODE = {"type": "integer", "minimum": 0, "maximum": 2}
_KIND = {"enum": [str(kind) for kind in EmergencyKind]}
_DONE = _object("status", status=_OK)


class Endpoint(NamedTuple):
    """One row: path, purpose and answer; a row with a ``channel`` is a command and needs a token."""

    path: str
    summary: str
    schema: Schema
    content: str = JSON
    channel: str = ""  # ``control`` is answered by the main loop, ``emergency`` by the danger loop, ``token`` here
    body: Schema | None = None
    errors: tuple[int, ...] = ()

    @property
    def method(self) -> str:
        """Of HTTP."""
        return "POST" if self.channel in ("control", "emergency") else "GET"


ENDPOINTS = (
    Endpoint("/", "The page.", _TEXT, "text/html"),
    Endpoint("/static/{path}", "A file of the page.", _TEXT, "*/*", errors=(404,)),
    Endpoint("/ground", "Constant data of a run: map, points, limits, names.", {"type": "object"}),
    Endpoint("/events", "Server-sent events: all once, news ten times a second, end.", _TEXT, "text/event-stream"),
    Endpoint("/status", "All levels of the page, and the trouble.", _ref("Status")),
    Endpoint(
        "/alarms", "The list of alarms, the most severe first.",
        _object("status", "alarms", status=_OK, alarms={"type": "array", "items": _ref("Alarm")}),
    ),
    Endpoint("/healthz", "Whether both loops report and the robot sends frames.", _DONE, errors=(503,)),
    Endpoint("/metrics", "Metrics of Prometheus.", _TEXT, "text/plain"),
    Endpoint("/openapi.json", "This description.", {"type": "object"}),
    Endpoint("/operator", "The name of the token.", _object("status", "name", status=_OK, name=_TEXT), channel="token"),
    Endpoint("/pause", "Hold the robot where it is.", _DONE, channel="control"),
    Endpoint("/resume", "Continue after a pause, or after a fault whose cause is gone.", _DONE, channel="control"),
    Endpoint("/abort", "End the survey and drive the robot to its base.", _DONE, channel="control"),
    Endpoint("/stop", "Hold the wheels, save, and end the daemon.", _DONE, channel="control"),
    Endpoint(
        f"/{ACKNOWLEDGE}", "Acknowledge an alarm.", _DONE, channel="control", body=_object("name", name=_TEXT),
        errors=(400,),
    ),
    Endpoint(
        "/emergency", "Report an emergency; without an id it gets one.",
        _object("status", "id", "latched", "code", status=_OK, id=_ID, latched={"type": "boolean"}, code=_CODE),
        channel="emergency", body=_object("kind", kind=_KIND, id=_ID, note=_TEXT), errors=(400,),
    ),
    Endpoint(
        "/clear", "Clear an emergency whose cause is gone.",
        _object("status", "id", "code", status=_OK, id=_ID, code=_CODE),
        channel="emergency", body=_object("id", id=_ID), errors=(400,),
    ),
)  # fmt: skip
# Path of each command without its slash, and the channel that answers it.
COMMANDS = {row.path[1:]: row.channel for row in ENDPOINTS if row.method == "POST"}
# Possible answers to a command other than success.
_OF_TOKENS, _OF_COMMANDS = (401, 403), (408, 409, 413, 502, 503, 504)
_LEVELS: dict[str, Schema] = {
    "mission": {"anyOf": [_ref("MissionStatus"), {"type": "null"}]},
    "pose": {"anyOf": [_ref("DisplayState"), {"type": "null"}]},
    "verdict": {"anyOf": [_ref("Verdict"), {"type": "null"}]},
    "alarms": {"type": "array", "items": _ref("Alarm")},
    "trouble": _TEXT,
}


def description() -> Schema:
    """The interface as OpenAPI 3.1."""
    _, schemas = msgspec.json.schema_components(
        (MissionStatus, DisplayState, Verdict, Alarm), ref_template="#/components/schemas/{name}"
    )
    schemas["Verdict"]["properties"] |= {"cause": _TEXT, "condition": _TEXT}
    schemas["Error"] = _object("status", "message", status={"const": "error"}, message=_TEXT)
    schemas["Status"] = _object("status", *_LEVELS, status=_OK, **_LEVELS)
    paths: Schema = {}
    for row in ENDPOINTS:
        paths.setdefault(row.path, {})[row.method.lower()] = _operation(row)
    return {
        "openapi": "3.1.0",
        "info": {"title": "ccatp", "version": ccatp.__version__, "summary": "The dashboard of a survey over HTTP."},
        "servers": [{"url": "/"}, {"url": PREFIX}],
        "paths": paths,
        "components": {"schemas": schemas, "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}}},
    }


def _operation(row: Endpoint) -> Schema:
    errors = {421, *row.errors, *(_OF_TOKENS if row.channel else ()), *(_OF_COMMANDS if row.method == "POST" else ())}
    found: Schema = {
        "operationId": row.path.strip("/").replace("/", "_").replace("{path}", "file").replace(".", "_") or "page",
        "summary": row.summary,
        "responses": {
            "200": {"description": row.summary, "content": {row.content: {"schema": row.schema}}},
            **{str(code): _error(HTTPStatus(code).phrase) for code in sorted(errors)},
        },
    }
    if row.channel:
        found["security"] = [{"token": []}]
    if row.body is not None:
        found["requestBody"] = {"required": True, "content": {JSON: {"schema": row.body}}}
    if "{path}" in row.path:
        found["parameters"] = [{"name": "path", "in": "path", "required": True, "schema": _TEXT}]
    return found


def _error(text: str) -> Schema:
    return {"description": text, "content": {JSON: {"schema": _ref("Error")}}}
