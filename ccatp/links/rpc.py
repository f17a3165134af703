"""Request and reply over ZeroMQ: a ROUTER in the event loop, on a unix socket or on TCP with CURVE, and a client.

TCP fails closed. libzmq admits every client that knows the server's key while no ZAP handler is bound, unless
``ZAP_ENFORCE_DOMAIN`` is set; with it, a missing handler and a handler that does not answer both admit no client.
"""

import asyncio
import contextlib
import os
import socket
from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple, Self

import zmq
import zmq.asyncio
from zmq.auth.base import Authenticator
from zmq.utils.monitor import parse_monitor_message

from ccatp.errors import DaemonUnreachableError, UsageError
from ccatp.links.auth import Clients, KeyPair
from ccatp.links.channels import BadRequest, format_error, parse_reply

Handler = Callable[..., bytes | Awaitable[bytes]]
"""Takes the request, and on TCP the client's public key (Z85); returns the reply or an awaitable of it."""

# libzmq disconnects a peer whose frame is longer than this; a shorter one over the limit of a request gets an answer.
MAX_FRAME_BYTES = 1 << 13
MAX_REPLY_BYTES = 1 << 20
HIGH_WATER_MARK = 64
MAX_PENDING = 32
# Connections at a time; one more is closed, the others stay.
MAX_CONNECTIONS = 32
BACKLOG = 16
# A connection whose ZeroMQ handshake, with its key where one is required, takes longer is closed.
HANDSHAKE_MS = 2000
# Detects a peer that vanished without closing its connection, to end its connection.
HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS = 5000, 15000
# An emergency is sent again at this period: where every other message is lost, fourteen leave 1 in 10,000 unreported.
REPEAT_S = 0.05
BUSY = "too many requests are waiting for their answer"
NOT_SINGLE = "a request is one frame"
DOMAIN = "ccatp.observatory"


class RouterError(UsageError):
    """The endpoint cannot be served."""


class RequestFailed(DaemonUnreachableError):
    """No usable answer within the deadline."""


class Router:
    """Serves single-frame requests of REQ and DEALER peers.

    Use as an async context manager around ``serve``; ``RouterError``: the endpoint may not or cannot be bound. Requests
    are served while the awaitable of another one is pending. An exception of the handler ends ``serve``. Without
    ``keys`` the endpoint is ``ipc://`` or ``inproc://``; with them it is ``tcp://ADDRESS:PORT`` for CURVE clients that
    a ``ZapHandler`` admits. ``bound``: the endpoint as bound, with its port. ``refused``: requests that never reached
    the handler. ``turned_away``: connections beyond ``MAX_CONNECTIONS``.
    """

    def __init__(
        self, endpoint: str, handler: Handler, context: zmq.asyncio.Context, keys: KeyPair | None = None
    ) -> None:
        self._endpoint, self._handler, self._context, self._keys = endpoint, handler, context, keys
        self._socket: zmq.asyncio.Socket
        self._monitor: zmq.asyncio.Socket
        self.bound = ""
        self._pending: set[asyncio.Task[None]] = set()
        self._connections: set[int] = set()
        self.refused = self.turned_away = 0

    async def __aenter__(self) -> Self:
        if self._endpoint.startswith(("ipc://", "inproc://")) is not (self._keys is None):
            raise RouterError(f"{self._endpoint}: ipc:// and inproc:// are served without keys, tcp:// with keys alone")
        self._socket = router = self._context.socket(zmq.ROUTER)
        router.setsockopt(zmq.LINGER, 0)
        router.setsockopt(zmq.RCVHWM, HIGH_WATER_MARK)
        router.setsockopt(zmq.SNDHWM, HIGH_WATER_MARK)
        router.setsockopt(zmq.MAXMSGSIZE, MAX_FRAME_BYTES)
        router.setsockopt(zmq.BACKLOG, BACKLOG)
        router.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        if self._keys is not None:
            router.setsockopt(zmq.ZAP_DOMAIN, DOMAIN.encode())
            router.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
            router.setsockopt(zmq.CURVE_SERVER, 1)
            router.setsockopt(zmq.CURVE_PUBLICKEY, self._keys.public)
            router.setsockopt(zmq.CURVE_SECRETKEY, self._keys.secret)
            router.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_MS)
            router.setsockopt(zmq.HEARTBEAT_TIMEOUT, HEARTBEAT_TIMEOUT_MS)
            router.setsockopt(zmq.TCP_KEEPALIVE, 1)
        self._monitor = router.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED)
        try:
            router.bind(self._endpoint)
        except zmq.ZMQError as error:
            await self.__aexit__()
            raise RouterError(f"{self._endpoint}: {error.strerror}") from error
        self.bound = router.getsockopt_string(zmq.LAST_ENDPOINT)
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close; undelivered replies are dropped."""
        self._socket.disable_monitor()
        self._monitor.close()
        self._socket.close()

    async def serve(self) -> None:
        """Answer requests until cancelled."""
        async with asyncio.TaskGroup() as later:
            later.create_task(self._limit_connections())
            while True:
                frames = await self._socket.recv_multipart(copy=False)
                envelope, payload = split_envelope([frame.bytes for frame in frames])
                if payload is None:
                    await self._refuse(envelope, NOT_SINGLE)
                elif len(self._pending) >= MAX_PENDING:
                    await self._refuse(envelope, BUSY)
                else:
                    # Without keys there is no client id: only the owner can connect in the runtime directory.
                    client = () if self._keys is None else (str(frames[-1].get("User-Id")),)
                    answer = self._handler(payload, *client)
                    if isinstance(answer, bytes):
                        await self._send(envelope, answer)
                    else:
                        task = later.create_task(self._answer_later(envelope, answer))
                        self._pending.add(task)
                        task.add_done_callback(self._pending.discard)
                # Receiving never yields while requests are queued: other tasks run here.
                await asyncio.sleep(0)

    async def _limit_connections(self) -> None:
        while True:
            event = parse_monitor_message(await self._monitor.recv_multipart())
            if event["event"] == zmq.EVENT_DISCONNECTED:
                self._connections.discard(event["value"])
            elif len(self._connections) < MAX_CONNECTIONS:
                self._connections.add(event["value"])
            elif turn_away(event["value"], self.bound):
                self.turned_away += 1
            await asyncio.sleep(0)

    async def _answer_later(self, envelope: list[bytes], answer: Awaitable[bytes]) -> None:
        await self._send(envelope, await answer)

    async def _refuse(self, envelope: list[bytes], why: str) -> None:
        self.refused += 1
        await self._send(envelope, format_error(why))

    async def _send(self, envelope: list[bytes], reply: bytes) -> None:
        # A ROUTER never blocks: a reply to a peer that is gone or too slow is dropped.
        await self._socket.send_multipart([*envelope, reply])


def turn_away(descriptor: int, endpoint: str) -> bool:
    """End a connection that libzmq has accepted at an endpoint, as if the peer had closed it; returns whether it did.

    ``descriptor`` is from the socket monitor. It may be closed or reused by now; one of another endpoint is not closed.
    """
    with contextlib.suppress(OSError):  # closed, or not a socket
        own = os.dup(descriptor)  # cannot be reused before it is closed
        try:
            connection = socket.socket(fileno=own)
        except OSError:
            os.close(own)
            raise
        with connection:
            name = connection.getsockname()
            is_ours = f"ipc://{name}" == endpoint if isinstance(name, str) else endpoint.endswith(f":{name[1]}")
            if is_ours:
                connection.shutdown(socket.SHUT_RDWR)
                return True
    return False


def split_envelope(frames: list[bytes]) -> tuple[list[bytes], bytes | None]:
    """Split a message of a ROUTER into the envelope of its reply and the request, ``None`` if not a single frame.

    A REQ peer's request arrives as identity, empty frame, request; a DEALER's as identity, request (or like a REQ's).
    """
    identity, *rest = frames
    envelope = [identity]
    if len(rest) > 1 and rest[0] == b"":
        envelope.append(rest.pop(0))
    return envelope, rest[0] if len(rest) == 1 else None


class CurveClient(NamedTuple):
    """Keys of a client: the server's public one, 40 characters of Z85, and its own."""

    server: bytes
    own: KeyPair


def request(
    endpoint: str, payload: bytes, timeout_s: float, curve: CurveClient | None = None, *, repeats: bool = False,
    has_ended: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:  # fmt: skip
    """Send a request to a ``Router`` and wait for its reply.

    ``curve`` holds the keys for a ``tcp://`` endpoint. ``repeats``: send it every ``REPEAT_S`` until a reply arrives;
    only for idempotent requests. ``has_ended``: nobody can answer any more. ``RequestFailed``: no reply in time, an
    invalid endpoint, or a malformed reply.
    """
    with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
        peer.setsockopt(zmq.LINGER, 0)
        peer.setsockopt(zmq.MAXMSGSIZE, MAX_REPLY_BYTES)
        if curve is not None:
            peer.setsockopt(zmq.CURVE_SERVERKEY, curve.server)
            peer.setsockopt(zmq.CURVE_PUBLICKEY, curve.own.public)
            peer.setsockopt(zmq.CURVE_SECRETKEY, curve.own.secret)
        try:
            peer.connect(endpoint)
        except zmq.ZMQError as error:
            raise RequestFailed(f"{endpoint}: {error.strerror}") from error
        period_s = min(REPEAT_S, timeout_s)
        for count in range(max(1, round(timeout_s / period_s))):
            # A full queue holds enough copies already.
            with contextlib.suppress(zmq.Again):
                if repeats or not count:
                    peer.send_multipart([b"", payload], zmq.DONTWAIT)
            if peer.poll(max(1, round(period_s * 1000.0))):
                break
            if has_ended() and not peer.poll(0):
                raise RequestFailed(f"{endpoint}: ccatp ended before it answered; see ccatp runs show")
        else:
            there = "" if curve is None else " there, with this server key and you listed"
            raise RequestFailed(f"no answer from {endpoint} within {timeout_s:g} s: is ccatp running{there}?")
        *_, reply = peer.recv_multipart()
    try:
        return parse_reply(reply)
    except BadRequest as error:
        raise RequestFailed(f"{endpoint}: {error}") from error


class ZapHandler(Authenticator):
    """Decides which CURVE keys are admitted (ZAP, ZeroMQ RFC 27); a context can have one handler.

    Use as an async context manager around ``serve``, and enter it before the ``Router`` of the same context; after it
    no client is admitted. pyzmq's ``AsyncioAuthenticator`` is not used: its own task would hide an exception, and
    refuse all clients afterwards.
    """

    def __init__(
        self, context: zmq.asyncio.Context, clients: Callable[[], Clients], on_refused: Callable[[str], None]
    ) -> None:
        super().__init__(context)
        self._clients, self._on_refused, self._address = clients, on_refused, ""
        self.configure_curve_callback(DOMAIN, credentials_provider=self)

    async def __aenter__(self) -> Self:
        self.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        self.stop()

    async def serve(self) -> None:
        """Answer libzmq until cancelled; an exception of the list of clients ends it."""
        poller = zmq.asyncio.Poller()
        poller.register(self.zap_socket, zmq.POLLIN)
        while True:
            await poller.poll()
            frames = self.zap_socket.recv_multipart()
            self._address = frames[3].decode("ascii", "replace")
            await self.handle_zap_message(frames)

    def callback(self, _domain: str, key: bytes) -> bool:
        """Whether a client with this public key (Z85) is admitted."""
        if key.decode() in self._clients():
            return True
        self._on_refused(f"{self._address}: key {key.decode()} is not on the list")
        return False
