"""Request and reply over ZeroMQ: a ROUTER in the event loop, and a client with a deadline.

Request and reply over TCP: a ROUTER with CURVE keys, and the ZAP handler that decides who gets in.

It fails closed. libzmq lets anybody in who knows the server's key while no ZAP handler is bound, unless
``ZAP_ENFORCE_DOMAIN`` is set; with it, no handler and a handler that does not answer both mean that nobody gets in.
"""

import asyncio
import contextlib
import os
import socket
from collections.abc import Awaitable, Callable
from types import TracebackType
from typing import Any, NamedTuple, Self

import zmq
import zmq.asyncio
from zmq.utils.monitor import parse_monitor_message

from ccatp.errors import CcatpError, DaemonUnreachableError, ExitStatus
from ccatp.links.auth import Clients, KeyPair, answer_zap
from ccatp.links.channels import BadRequest, format_error, parse_reply

Handler = Callable[[bytes], bytes | Awaitable[bytes]]

# libzmq cuts off a peer whose frame is longer than this; what lies between it and the limit of a request is answered.
MAX_FRAME_BYTES = 1 << 13
MAX_REPLY_BYTES = 1 << 20
HIGH_WATER_MARK = 64
MAX_PENDING = 32
# Peers at a time; newcomers beyond are turned away, those who are in stay.
MAX_CONNECTIONS = 32
BACKLOG = 16
# Who has not shown by then that they speak the protocol, with their key where one is wanted, loses the connection.
HANDSHAKE_MS = 2000
# An emergency is told again this often: where every other message is lost, fourteen times leave 1 in 10,000 unheard.
REPEAT_S = 0.05
BUSY = "too many requests are waiting for their answer"
NOT_SINGLE = "a request is one frame"


class RouterError(CcatpError):
    """The endpoint cannot be served."""

    exit_status = ExitStatus.USAGE


class RequestFailed(DaemonUnreachableError):
    """No usable answer within the deadline."""


class Router:
    """Serves single-frame requests of REQ and DEALER peers.

    Use as an async context manager around ``serve``, which runs until it is cancelled. The handler gets the frame and
    returns the reply, or an awaitable of it for an answer that comes later; meanwhile others are served.

    Args:
        endpoint: where to bind, ``ipc://`` or ``inproc://``. Plain ``tcp://`` is refused: it has no keys.
        handler: what answers. An exception that it raises ends ``serve``.

    Attributes:
        refused: requests that never reached the handler.
    """

    def __init__(self, endpoint: str, handler: Handler, context: zmq.asyncio.Context) -> None:
        self._endpoint, self._handler, self._context = endpoint, handler, context
        self._socket: zmq.asyncio.Socket | None = None
        self._monitor: zmq.asyncio.Socket | None = None
        self._bound = ""
        self._pending: set[asyncio.Task[None]] = set()
        self._connections: set[int] = set()
        self.refused = self.turned_away = 0

    @property
    def bound(self) -> str:
        """The endpoint as bound, with its port."""
        return self._bound

    async def __aenter__(self) -> Self:
        """Bind.

        Raises:
            RouterError: if the endpoint may not or cannot be bound.
        """
        self._check_endpoint()
        router = self._context.socket(zmq.ROUTER)
        self._configure(router)
        self._socket = router
        self._monitor = router.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED)
        try:
            router.bind(self._endpoint)
        except zmq.ZMQError as error:
            self._close()
            raise RouterError(f"{self._endpoint}: {error.strerror}") from error
        self._bound = router.getsockopt_string(zmq.LAST_ENDPOINT)
        return self

    def _check_endpoint(self) -> None:
        if not self._endpoint.startswith(("ipc://", "inproc://")):
            raise RouterError(f"{self._endpoint}: only ipc:// and inproc:// are served without keys")

    def _configure(self, router: zmq.asyncio.Socket) -> None:
        """Limits, before binding."""
        router.setsockopt(zmq.LINGER, 0)
        router.setsockopt(zmq.RCVHWM, HIGH_WATER_MARK)
        router.setsockopt(zmq.SNDHWM, HIGH_WATER_MARK)
        router.setsockopt(zmq.MAXMSGSIZE, MAX_FRAME_BYTES)
        router.setsockopt(zmq.BACKLOG, BACKLOG)
        router.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close; what was not delivered is dropped."""
        self._close()

    def _close(self) -> None:
        if self._socket is not None and self._monitor is not None:
            self._socket.disable_monitor()
            self._monitor.close()
            self._socket.close()
            self._socket = self._monitor = None

    async def serve(self) -> None:
        """Answer requests until cancelled."""
        if self._socket is None:
            raise RouterError(f"{self._endpoint}: not bound")
        async with asyncio.TaskGroup() as later:
            later.create_task(self._limit_connections())
            while (router := self._socket) is not None:
                frames, user_id = await self._receive(router)
                envelope, payload = split_envelope(frames)
                if payload is None:
                    await self._refuse(envelope, NOT_SINGLE)
                elif len(self._pending) >= MAX_PENDING:
                    await self._refuse(envelope, BUSY)
                else:
                    answer = self._ask(payload, user_id)
                    if isinstance(answer, bytes):
                        await self._send(envelope, answer)
                    else:
                        task = later.create_task(self._answer_later(envelope, answer))
                        self._pending.add(task)
                        task.add_done_callback(self._pending.discard)
                # Where requests wait already, receiving never gives way: others have their turn here.
                await asyncio.sleep(0)

    async def _receive(self, router: zmq.asyncio.Socket) -> tuple[list[bytes], str]:
        """The frames of the next message, and who sent it where that is known."""
        return await router.recv_multipart(), ""

    def _ask(self, payload: bytes, user_id: str) -> bytes | Awaitable[bytes]:
        del user_id  # whoever reaches a socket in the runtime directory is its owner
        return self._handler(payload)

    async def _limit_connections(self) -> None:
        """Count the peers, and turn away those that are too many."""
        while (monitor := self._monitor) is not None:
            event = parse_monitor_message(await monitor.recv_multipart())
            if event["event"] == zmq.EVENT_DISCONNECTED:
                self._connections.discard(event["value"])
            elif len(self._connections) < MAX_CONNECTIONS:
                self._connections.add(event["value"])
            elif turn_away(event["value"], self._bound):
                self.turned_away += 1
            await asyncio.sleep(0)

    async def _answer_later(self, envelope: list[bytes], answer: Awaitable[bytes]) -> None:
        await self._send(envelope, await answer)

    async def _refuse(self, envelope: list[bytes], why: str) -> None:
        self.refused += 1
        await self._send(envelope, format_error(why))

    async def _send(self, envelope: list[bytes], reply: bytes) -> None:
        # A ROUTER never waits for a peer: what a peer that is gone or too slow does not take is dropped.
        if self._socket is not None:
            await self._socket.send_multipart([*envelope, reply])


def turn_away(descriptor: int, endpoint: str) -> bool:
    """End a connection that libzmq has accepted; libzmq takes it as one that the peer has ended.

    Args:
        descriptor: its number, as the monitor told it. It may stand for something else by now, or for nothing.
        endpoint: where it was accepted; what was not is left alone.
    """
    with contextlib.suppress(OSError):  # it is gone, or no socket
        own = os.dup(descriptor)  # this one stays the same thing until it is closed
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
    """Part a message of a ROUTER into the envelope that its reply needs and the request.

    A REQ peer's request comes as identity, empty frame, request; a DEALER's as identity, request (or like a REQ's).

    Returns:
        The envelope, and the request or ``None`` where it is not a single frame.
    """
    identity, *rest = frames
    envelope = [identity]
    if len(rest) > 1 and rest[0] == b"":
        envelope.append(rest.pop(0))
    return envelope, rest[0] if len(rest) == 1 else None


class CurveClient(NamedTuple):
    """Keys of a client, each 40 characters of Z85."""

    server: bytes
    public: bytes
    secret: bytes


def request(
    endpoint: str, payload: bytes, timeout_s: float, curve: CurveClient | None = None, *, repeats: bool = False
) -> dict[str, Any]:
    """Ask, and wait for the answer.

    Args:
        endpoint: where a ``Router`` serves.
        curve: the keys, where the endpoint is ``tcp://``.
        repeats: ask again and again until there is an answer; only for what may be asked twice.

    Returns:
        The reply.

    Raises:
        RequestFailed: no answer in time, an endpoint that cannot be, or an answer that is no reply.
    """
    with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
        peer.setsockopt(zmq.LINGER, 0)
        peer.setsockopt(zmq.MAXMSGSIZE, MAX_REPLY_BYTES)
        if curve is not None:
            peer.setsockopt(zmq.CURVE_SERVERKEY, curve.server)
            peer.setsockopt(zmq.CURVE_PUBLICKEY, curve.public)
            peer.setsockopt(zmq.CURVE_SECRETKEY, curve.secret)
        try:
            peer.connect(endpoint)
        except zmq.ZMQError as error:
            raise RequestFailed(f"{endpoint}: {error.strerror}") from error
        period_s = min(REPEAT_S, timeout_s) if repeats else timeout_s
        for _ in range(max(1, round(timeout_s / period_s))):
            # What a full queue does not take has been sent often enough already.
            with contextlib.suppress(zmq.Again):
                peer.send_multipart([b"", payload], zmq.DONTWAIT)
            if peer.poll(max(1, round(period_s * 1000.0))):
                break
        else:
            hint = (
                "is ccatp running?" if curve is None else "is ccatp running there, with this server key and you listed?"
            )
            raise RequestFailed(f"no answer from {endpoint} within {timeout_s:g} s: {hint}")
        *_, reply = peer.recv_multipart()
    try:
        return parse_reply(reply)
    except BadRequest as error:
        raise RequestFailed(f"{endpoint}: {error}") from error


ZAP_ENDPOINT = "inproc://zeromq.zap.01"
DOMAIN = "ccatp.observatory"
# A peer that is gone without a word gives its place back.
HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS = 5000, 15000

NamedHandler = Callable[[bytes, str], bytes | Awaitable[bytes]]


class ZapHandler:
    """Decides which CURVE keys get in.

    Use as an async context manager around ``serve``, and enter it before the ``CurveRouter`` of the same context.

    Args:
        context: ZeroMQ context of the process; there can be one handler in it.
        on_refused: told why somebody was not let in.
    """

    def __init__(
        self, context: zmq.asyncio.Context, clients: Callable[[], Clients], on_refused: Callable[[str], None]
    ) -> None:
        self._context, self._clients, self._on_refused = context, clients, on_refused
        self._socket: zmq.asyncio.Socket | None = None

    async def __aenter__(self) -> Self:
        """Bind."""
        socket = self._context.socket(zmq.REP)
        socket.setsockopt(zmq.LINGER, 0)
        socket.bind(ZAP_ENDPOINT)
        self._socket = socket
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close: from here on nobody gets in."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    async def serve(self) -> None:
        """Answer libzmq until cancelled."""
        while self._socket is not None:
            reply, refusal = answer_zap(await self._socket.recv_multipart(), DOMAIN, self._clients())
            if refusal:
                self._on_refused(refusal)
            await self._socket.send_multipart(reply)


class CurveRouter(Router):
    """As ``Router``, on ``tcp://`` for CURVE clients that a ``ZapHandler`` admits.

    Args:
        endpoint: ``tcp://ADDRESS:PORT``.
        handler: what answers; called with the request and the client's key in hexadecimal.
    """

    def __init__(self, endpoint: str, handler: NamedHandler, context: zmq.asyncio.Context, keys: KeyPair) -> None:
        super().__init__(endpoint, lambda _: b"", context)
        self._named_handler, self._keys = handler, keys

    def _check_endpoint(self) -> None:
        if not self._endpoint.startswith("tcp://"):
            raise RouterError(f"{self._endpoint}: CURVE keys are for tcp://")

    def _configure(self, router: zmq.asyncio.Socket) -> None:
        super()._configure(router)
        router.setsockopt(zmq.ZAP_DOMAIN, DOMAIN.encode())
        router.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
        router.setsockopt(zmq.CURVE_SERVER, 1)
        router.setsockopt(zmq.CURVE_PUBLICKEY, self._keys.public)
        router.setsockopt(zmq.CURVE_SECRETKEY, self._keys.secret)
        router.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_MS)
        router.setsockopt(zmq.HEARTBEAT_TIMEOUT, HEARTBEAT_TIMEOUT_MS)
        router.setsockopt(zmq.TCP_KEEPALIVE, 1)

    async def _receive(self, router: zmq.asyncio.Socket) -> tuple[list[bytes], str]:
        frames = await router.recv_multipart(copy=False)
        return [frame.bytes for frame in frames], str(frames[-1].get("User-Id"))

    def _ask(self, payload: bytes, user_id: str) -> bytes | Awaitable[bytes]:
        return self._named_handler(payload, user_id)
