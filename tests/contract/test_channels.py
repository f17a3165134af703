"""Contract tests of the observatory and the operator channel: the interface's forms, and the ROUTER on a socket."""

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
import zmq
import zmq.asyncio

from ccatp.core import EmergencyKind
from ccatp.links.auth import KeyPair
from ccatp.links.channels import (
    MAX_REQUEST_BYTES,
    BadRequest,
    ClearRequest,
    EmergencyRequest,
    OperatorCommand,
    PingRequest,
    format_error,
    format_ok,
    format_request,
    parse_observatory,
    parse_operator,
    parse_reply,
)
from ccatp.links.rpc import (
    BUSY,
    HIGH_WATER_MARK,
    MAX_FRAME_BYTES,
    MAX_PENDING,
    NOT_SINGLE,
    Handler,
    RequestFailed,
    Router,
    RouterError,
    request,
    split_envelope,
)
from ccatp.safety.emergency_latch import EmergencyRules, answer_observatory

ID = "3b241101-e2bb-4255-8caf-4136c566a962"
DEADLINE_S = 5.0  # only a broken test waits so long


class Desk(EmergencyRules):
    """Rules that know of emergencies alone, of a robot that is held."""

    at_base_or_held = True
    _frame_seq = -1


def ask(desk: Desk, text: str | bytes, *, at_base_or_held: bool = False) -> dict[str, Any]:
    frame = text.encode() if isinstance(text, str) else text
    reply = answer_observatory(frame, desk, at_base_or_held=at_base_or_held, age_s=0.01)
    value: dict[str, Any] = json.loads(reply)
    return value


# -- observatory ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [kind.value for kind in EmergencyKind])
def test_emergency_and_its_reply_are_as_in_the_interface(kind: str) -> None:
    desk = Desk()
    text = f'{{"cmd":"emergency","kind":"{kind}","id":"{ID}","note":"sensor 4"}}'
    assert parse_observatory(text.encode()) == EmergencyRequest(kind=EmergencyKind(kind), id=ID, note="sensor 4")
    for _ in range(3):  # the same id again is harmless
        assert ask(desk, text) == {"ok": True, "id": ID, "latched": True, "code": 2}
    assert desk.latch.is_latched


def test_golden_bytes() -> None:
    assert format_request("emergency", kind="fire", id=ID, note="") == (
        b'{"cmd":"emergency","kind":"fire","id":"' + ID.encode() + b'","note":""}'
    )
    assert format_request("status") == b'{"cmd":"status"}'
    assert format_ok(code=0, age_s=0.5) == b'{"ok":true,"code":0,"age_s":0.5}'
    assert format_error("why", id=ID) == b'{"ok":false,"id":"' + ID.encode() + b'","error":"why"}'


def test_clear_only_at_base_or_held() -> None:
    desk = Desk()
    ask(desk, format_request("emergency", kind="fire", id=ID, note=""))
    clear = format_request("clear", id=ID)
    assert parse_observatory(clear) == ClearRequest(id=ID)
    assert ask(desk, clear) == {"ok": False, "id": ID, "error": "the robot is neither at base nor held"}
    assert desk.latch.is_latched
    assert ask(desk, clear, at_base_or_held=True) == {"ok": True, "id": ID, "code": 0}
    assert not desk.latch.is_latched


def test_an_id_may_be_written_in_capitals_and_what_was_cleared_is_not_in_force() -> None:
    desk = Desk()
    raised = f'{{"cmd":"emergency","kind":"fire","id":"{ID.upper()}"}}'
    assert ask(desk, raised) == {"ok": True, "id": ID.upper(), "latched": True, "code": 2}
    assert ask(desk, raised.replace(ID.upper(), ID)) == {"ok": True, "id": ID, "latched": True, "code": 2}
    assert desk.latch.raised == 1
    assert ask(desk, f'{{"cmd":"clear","id":"{ID}"}}', at_base_or_held=True) == {"ok": True, "id": ID, "code": 0}
    assert ask(desk, raised) == {"ok": True, "id": ID.upper(), "latched": False, "code": 0}
    assert not desk.latch.is_latched


def test_ping_tells_code_and_age() -> None:
    desk = Desk()
    assert parse_observatory(b'{"cmd":"ping"}') == PingRequest()
    assert ask(desk, '{"cmd":"ping"}') == {"ok": True, "code": 0, "age_s": 0.01}
    ask(desk, format_request("emergency", kind="power", id=ID))
    assert ask(desk, '{"cmd":"ping"}')["code"] == 2
    assert json.loads(answer_observatory(b'{"cmd":"ping"}', desk, at_base_or_held=True, age_s=None))["age_s"] is None


def test_unknown_keys_are_ignored_and_the_note_may_be_absent() -> None:
    parsed = parse_observatory(f'{{"cmd":"emergency","kind":"fire","id":"{ID}","from":"dome"}}'.encode())
    assert parsed == EmergencyRequest(kind=EmergencyKind.FIRE, id=ID, note="")


def test_an_emergency_is_taken_whatever_the_length_of_its_note_in_a_request_of_the_largest_size() -> None:
    desk = Desk()
    rest = f'{{"cmd":"emergency","kind":"fire","id":"{ID}","note":""}}'
    text = rest.replace('""', f'"{"x" * (MAX_REQUEST_BYTES - len(rest))}"')
    assert len(text) == MAX_REQUEST_BYTES
    assert ask(desk, text) == {"ok": True, "id": ID, "latched": True, "code": 2}


BAD = {
    "empty": (b"", "not UTF-8 JSON"),
    "not json": (b"fire!", "not UTF-8 JSON"),
    "cut off": (b'{"cmd":"ping"', "not UTF-8 JSON"),
    "two objects": (b'{"cmd":"ping"}{"cmd":"ping"}', "not UTF-8 JSON"),
    "not utf-8": (b'{"cmd":"\xff"}', "not UTF-8 JSON"),
    "deep": (b"[" * 4000, "not UTF-8 JSON"),
    "array": (b"[]", "not a JSON object"),
    "number": (b"1", "not a JSON object"),
    "huge number": (b'{"cmd":"ping","x":' + b"9" * 4050 + b"}", None),
    "key twice": (b'{"cmd":"ping","cmd":"ping"}', "a key stands twice"),
    "not finite": (b'{"cmd":"ping","x":NaN}', "NaN is no number"),
    "no cmd": (b"{}", "missing required field `cmd`"),
    "unknown cmd": (b'{"cmd":"reboot"}', "Invalid value 'reboot'"),
    "cmd of another type": (b'{"cmd":1}', "$.cmd"),
    "cmd is an object": (b'{"cmd":{}}', "$.cmd"),
    "unknown kind": (f'{{"cmd":"emergency","kind":"flood","id":"{ID}","note":""}}'.encode(), "$.kind"),
    "no kind": (f'{{"cmd":"emergency","id":"{ID}","note":""}}'.encode(), "missing required field `kind`"),
    "no id": (b'{"cmd":"emergency","kind":"fire","note":""}', "missing required field `id`"),
    "id is a number": (b'{"cmd":"emergency","kind":"fire","id":5,"note":""}', "$.id"),
    "id is no uuid": (b'{"cmd":"emergency","kind":"fire","id":"five","note":""}', "UUID"),
    "note is a number": (f'{{"cmd":"emergency","kind":"fire","id":"{ID}","note":1}}'.encode(), "$.note"),
    "clear without id": (b'{"cmd":"clear"}', "missing required field `id`"),
    "too long": (b'{"cmd":"ping"' + b" " * MAX_REQUEST_BYTES + b"}", "request of 4110 bytes; at most 4096"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_not_of_the_form_is_answered_and_changes_nothing(name: str) -> None:
    frame, error = BAD[name]
    desk = Desk()
    reply = ask(desk, frame)
    if error is None:  # an unknown key with a number of 4050 digits is still only an unknown key, or no JSON
        assert reply["ok"] in (True, False)
    else:
        assert reply["ok"] is False
        assert error in reply["error"]
    assert not desk.latch.is_latched
    desk.emergency("fire", ID)
    ask(desk, frame)
    assert desk.latch.is_latched


def test_a_request_of_the_largest_size_is_served() -> None:
    head = f'{{"cmd":"emergency","kind":"fire","id":"{ID}","note":"'.encode()
    padding = b" " * (MAX_REQUEST_BYTES - len(head) - 3)
    assert ask(Desk(), head + b'"' + padding + b"} ")["ok"] is True


# -- operator ---------------------------------------------------------------------------------------------------------


def test_operator_commands() -> None:
    for command in OperatorCommand:
        assert parse_operator(format_request(command)).cmd is command
    for frame in (b"{}", b'{"cmd":"go"}', b'{"cmd":null}', b'{"cmd":["stop"]}', b'{"cmd":"STOP"}'):
        with pytest.raises(BadRequest, match="cmd: "):
            parse_operator(frame)
    with pytest.raises(BadRequest, match="not a JSON object"):
        parse_operator(b"[1]")
    with pytest.raises(BadRequest, match='a reply without "ok"'):
        parse_reply(b'{"ok":1}')


# -- the router -------------------------------------------------------------------------------------------------------


def test_envelopes() -> None:
    assert split_envelope([b"me", b"x"]) == ([b"me"], b"x")
    assert split_envelope([b"me", b"", b"x"]) == ([b"me", b""], b"x")
    assert split_envelope([b"me", b""]) == ([b"me"], b"")
    assert split_envelope([b"me", b"", b"x", b"y"]) == ([b"me", b""], None)
    assert split_envelope([b"me", b"x", b"y"]) == ([b"me"], None)
    assert split_envelope([b"me"]) == ([b"me"], None)


def echo(frame: bytes) -> bytes:
    return format_ok(size=len(frame), text=frame[:20].decode("latin-1"))


@asynccontextmanager
async def served(endpoint: str, handler: Handler) -> AsyncIterator[tuple[Router, zmq.asyncio.Context]]:
    context = zmq.asyncio.Context()
    try:
        async with (
            asyncio.timeout(DEADLINE_S),
            Router(endpoint, handler, context) as router,
            asyncio.TaskGroup() as tasks,
        ):
            task = tasks.create_task(router.serve())
            try:
                yield router, context
            finally:
                task.cancel()
    finally:
        context.destroy(linger=0)


def peer(context: zmq.asyncio.Context, kind: int, endpoint: str) -> zmq.asyncio.Socket:
    socket = context.socket(kind)
    socket.setsockopt(zmq.LINGER, 0)
    socket.connect(endpoint)
    return socket


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/r"


async def test_req_and_dealer_are_served(endpoint: str) -> None:
    async with served(endpoint, echo) as (_, context):
        req = peer(context, zmq.REQ, endpoint)
        await req.send(b"one")
        assert parse_reply(await req.recv())["text"] == "one"
        dealer = peer(context, zmq.DEALER, endpoint)
        await dealer.send(b"two")
        assert parse_reply(await dealer.recv())["text"] == "two"
        await dealer.send_multipart([b"", b"three"])
        delimiter, reply = await dealer.recv_multipart()
        assert delimiter == b""
        assert parse_reply(reply)["text"] == "three"
        assert (await asyncio.to_thread(request, endpoint, b"four", DEADLINE_S))["text"] == "four"


async def test_multi_frame_requests_are_refused_and_the_peer_stays(endpoint: str) -> None:
    async with served(endpoint, echo) as (router, context):
        req = peer(context, zmq.REQ, endpoint)
        await req.send_multipart([b"one", b"two"])
        assert parse_reply(await req.recv()) == {"ok": False, "error": NOT_SINGLE}
        await req.send(b"again")
        assert parse_reply(await req.recv())["text"] == "again"
        dealer = peer(context, zmq.DEALER, endpoint)
        await dealer.send_multipart([b"a", b"b", b"c"])
        assert parse_reply(await dealer.recv()) == {"ok": False, "error": NOT_SINGLE}
        assert router.refused == 2


async def test_a_frame_beyond_every_limit_is_dropped_and_others_are_served(endpoint: str) -> None:
    async with served(endpoint, echo) as (_, context):
        flood = peer(context, zmq.DEALER, endpoint)
        await flood.send(b"x" * (MAX_FRAME_BYTES + 1))
        other = peer(context, zmq.REQ, endpoint)
        await other.send(b"fine")
        assert parse_reply(await other.recv())["text"] == "fine"
        await flood.send(b"x" * MAX_FRAME_BYTES)  # libzmq cut the peer off, it connects again
        assert parse_reply(await flood.recv())["size"] == MAX_FRAME_BYTES


async def test_an_answer_that_comes_later_does_not_hold_up_others(endpoint: str) -> None:
    gate = asyncio.Event()

    async def later() -> bytes:
        await gate.wait()
        return format_ok(late=True)

    def handler(frame: bytes) -> bytes | Awaitable[bytes]:
        return later() if frame == b"later" else format_ok(late=False)

    async with served(endpoint, handler) as (_, context):
        slow, quick = peer(context, zmq.REQ, endpoint), peer(context, zmq.REQ, endpoint)
        await slow.send(b"later")
        await quick.send(b"now")
        assert parse_reply(await quick.recv())["late"] is False
        gate.set()
        assert parse_reply(await slow.recv())["late"] is True


async def test_too_many_waiting_requests_are_refused(endpoint: str) -> None:
    gate = asyncio.Event()

    async def handler(frame: bytes) -> bytes:
        await gate.wait()
        return format_ok(frame=frame.decode())

    async with served(endpoint, handler) as (router, context):
        dealer = peer(context, zmq.DEALER, endpoint)
        for number in range(MAX_PENDING + 1):
            await dealer.send(str(number).encode())
        assert parse_reply(await dealer.recv()) == {"ok": False, "error": BUSY}
        assert router.refused == 1
        gate.set()
        answered = [parse_reply(await dealer.recv())["frame"] for _ in range(MAX_PENDING)]
        assert sorted(answered, key=int) == [str(number) for number in range(MAX_PENDING)]


async def test_a_peer_that_never_reads_does_not_hold_up_others(endpoint: str) -> None:
    async with served(endpoint, echo) as (_, context):
        deaf = peer(context, zmq.DEALER, endpoint)
        for _ in range(4 * HIGH_WATER_MARK):
            await deaf.send(b"x")
        other = peer(context, zmq.REQ, endpoint)
        await other.send(b"fine")
        assert parse_reply(await other.recv())["text"] == "fine"


async def test_an_exception_of_the_handler_ends_the_service(endpoint: str) -> None:
    def handler(_: bytes) -> bytes:
        raise LookupError("surprise")

    async def provoke() -> None:
        async with served(endpoint, handler) as (_, context):
            dealer = peer(context, zmq.DEALER, endpoint)
            await dealer.send(b"x")
            await asyncio.Event().wait()

    with pytest.raises(ExceptionGroup) as caught:
        await provoke()
    assert caught.group_contains(LookupError, match="surprise")


@pytest.mark.parametrize(
    ("endpoint", "keys", "why"),
    [
        *((endpoint, None, "are served without keys") for endpoint in ("tcp://127.0.0.1:0", "udp://127.0.0.1:1", "x")),
        ("ipc:///x", KeyPair(b"", b""), "tcp:// with keys alone"),
        ("ipc:///missing/r", None, "No such file or directory"),
    ],
)
async def test_endpoints_that_cannot_be_served(endpoint: str, keys: KeyPair | None, why: str) -> None:
    with zmq.asyncio.Context() as context, pytest.raises(RouterError, match=why):
        await Router(endpoint, echo, context, keys).__aenter__()


def test_a_request_has_a_deadline(endpoint: str) -> None:
    with pytest.raises(RequestFailed, match=r"no answer from ipc://.* within 0\.01 s"):
        request(endpoint, b"x", 0.01)
    with pytest.raises(RequestFailed, match="nowhere: Invalid argument"):
        request("nowhere", b"x", 0.01)


async def test_an_answer_that_is_no_reply_is_an_error(endpoint: str) -> None:
    async with served(endpoint, lambda _: b"[]"):
        with pytest.raises(RequestFailed, match="not a JSON object"):
            await asyncio.to_thread(request, endpoint, b"x", DEADLINE_S)
