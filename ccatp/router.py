"""Edge. Request and reply over ZeroMQ: a ROUTER in the event loop, and a client with a deadline."""

import asyncio
from collections.abc import Awaitable, Callable
from types import TracebackType
from typing import Any, Self

import zmq
import zmq.asyncio

from ccatp.errors import CcatpError, ExitStatus, UnreachableError
from ccatp.wire.channels import BadRequest, format_error, parse_reply

Handler = Callable[[bytes], bytes | Awaitable[bytes]]

# libzmq cuts off a peer whose frame is longer than this; what lies between it and the limit of a request is answered.
MAX_FRAME_BYTES = 1 << 16
MAX_REPLY_BYTES = 1 << 20
HIGH_WATER_MARK = 64
MAX_PENDING = 32
BUSY = "too many requests are waiting for their answer"
NOT_SINGLE = "a request is one frame"


class RouterError(CcatpError):
    """The endpoint cannot be served."""

    exit_status = ExitStatus.USAGE


class RequestFailed(UnreachableError):
    """No usable answer within the deadline."""


class Router:
    """Serves single-frame requests of REQ and DEALER peers.

    Use as an async context manager around ``serve``, which runs until it is cancelled. The handler gets the frame and
    returns the reply, or an awaitable of it for an answer that comes later; meanwhile others are served.

    Args:
        endpoint: where to bind, ``ipc://`` or ``inproc://``. Plain ``tcp://`` is refused: it has no keys.
        handler: what answers. An exception that it raises ends ``serve``.
        context: ZeroMQ context of the process.
    """

    def __init__(self, endpoint: str, handler: Handler, context: zmq.asyncio.Context) -> None:
        self._endpoint, self._handler, self._context = endpoint, handler, context
        self._socket: zmq.asyncio.Socket | None = None
        self._pending: set[asyncio.Task[None]] = set()
        self.refused = 0

    async def __aenter__(self) -> Self:
        """Bind.

        Raises:
            RouterError: if the endpoint may not or cannot be bound.
        """
        if not self._endpoint.startswith(("ipc://", "inproc://")):
            raise RouterError(f"{self._endpoint}: only ipc:// and inproc:// are served without keys")
        socket = self._context.socket(zmq.ROUTER)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVHWM, HIGH_WATER_MARK)
        socket.setsockopt(zmq.SNDHWM, HIGH_WATER_MARK)
        socket.setsockopt(zmq.MAXMSGSIZE, MAX_FRAME_BYTES)
        try:
            socket.bind(self._endpoint)
        except zmq.ZMQError as error:
            socket.close()
            raise RouterError(f"{self._endpoint}: {error.strerror}") from error
        self._socket = socket
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close; what was not delivered is dropped."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    async def serve(self) -> None:
        """Answer requests until cancelled."""
        if self._socket is None:
            raise RouterError(f"{self._endpoint}: not bound")
        async with asyncio.TaskGroup() as later:
            while True:
                frames = await self._socket.recv_multipart()
                envelope, payload = split_envelope(frames)
                if payload is None:
                    await self._refuse(envelope, NOT_SINGLE)
                elif len(self._pending) >= MAX_PENDING:
                    await self._refuse(envelope, BUSY)
                else:
                    answer = self._handler(payload)
                    if isinstance(answer, bytes):
                        await self._send(envelope, answer)
                    else:
                        task = later.create_task(self._answer_later(envelope, answer))
                        self._pending.add(task)
                        task.add_done_callback(self._pending.discard)

    async def _answer_later(self, envelope: list[bytes], answer: Awaitable[bytes]) -> None:
        await self._send(envelope, await answer)

    async def _refuse(self, envelope: list[bytes], why: str) -> None:
        self.refused += 1
        await self._send(envelope, format_error(why))

    async def _send(self, envelope: list[bytes], reply: bytes) -> None:
        # A ROUTER never waits for a peer: what a peer that is gone or too slow does not take is dropped.
        if self._socket is not None:
            await self._socket.send_multipart([*envelope, reply])


def split_envelope(frames: list[bytes]) -> tuple[list[bytes], bytes | None]:
    """Part a message of a ROUTER into the envelope that its reply needs and the request.

    A REQ peer's request comes as identity, empty frame, request; a DEALER's as identity, request (or like a REQ's).

    Args:
        frames: as received, identity first.

    Returns:
        The envelope, and the request or ``None`` where it is not a single frame.
    """
    identity, *rest = frames
    envelope = [identity]
    if len(rest) > 1 and rest[0] == b"":
        envelope.append(rest.pop(0))
    return envelope, rest[0] if len(rest) == 1 else None


def request(endpoint: str, payload: bytes, timeout_s: float) -> dict[str, Any]:
    """Ask once and wait for the answer.

    Args:
        endpoint: where a ``Router`` serves.
        payload: the request.
        timeout_s: how long to wait in all, s.

    Returns:
        The reply.

    Raises:
        RequestFailed: no answer in time, an endpoint that cannot be, or an answer that is no reply.
    """
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.MAXMSGSIZE, MAX_REPLY_BYTES)
        try:
            socket.connect(endpoint)
        except zmq.ZMQError as error:
            raise RequestFailed(f"{endpoint}: {error.strerror}") from error
        socket.send_multipart([b"", payload])
        if not socket.poll(max(1, round(timeout_s * 1000.0))):
            raise RequestFailed(f"no answer from {endpoint} within {timeout_s:g} s: is ccatp running?")
        *_, reply = socket.recv_multipart()
    try:
        return parse_reply(reply)
    except BadRequest as error:
        raise RequestFailed(f"{endpoint}: {error}") from error
