"""Edge. The true position of the puck for the Etalon stand-in: held fixed, or asked from the robot's stand-in."""

import asyncio
from typing import Protocol

import msgspec
import zmq
import zmq.asyncio

from ccatp.samples import Vector3
from ccatp.sim.etalon import PuckTruth

_MAX_REPLY_BYTES = 4096


class TruthUnavailable(Exception):
    """The position of the puck could not be had."""


class TruthSource(Protocol):
    """Where the stand-in learns the position of the puck."""

    async def puck(self) -> PuckTruth:
        """The puck now.

        Raises:
            TruthUnavailable: it cannot be had.
        """


class FixedPuck:
    """A puck that stands still; attributes may be changed. ``step_s`` passes between two queries, for fresh noise."""

    def __init__(self, position_m: Vector3, *, t_s: float = 0.0, moved_m: float = 0.0, step_s: float = 0.0) -> None:
        """``position_m`` is in the world frame."""
        self.position_m = position_m
        self.t_s = t_s
        self.moved_m = moved_m
        self.step_s = step_s

    async def puck(self) -> PuckTruth:
        """The puck where it was put."""
        truth = PuckTruth(self.t_s, self.position_m, self.moved_m)
        self.t_s += self.step_s
        return truth


class _TruthReply(msgspec.Struct):
    t: float
    puck: Vector3
    moved_m: float


class ZmqPuck:
    """Asks the robot's stand-in: request ``b"puck"``, reply ``{"t", "puck": [x, y, z], "moved_m"}``, SI, world."""

    def __init__(self, endpoint: str, timeout_s: float = 1.0) -> None:
        """``timeout_s`` is the deadline of one request, waiting for a turn included."""
        self._endpoint = endpoint
        self._timeout_s = timeout_s
        self._context = zmq.asyncio.Context()
        self._socket: zmq.asyncio.Socket | None = None
        self._turn = asyncio.Lock()

    async def puck(self) -> PuckTruth:
        """The puck now; after a failure the socket is made anew, as a REQ socket that lost its reply is stuck.

        Raises:
            TruthUnavailable: no reply in time, or one that is not of the form above.
        """
        try:
            async with asyncio.timeout(self._timeout_s), self._turn:
                return await self._ask()
        except TimeoutError:
            raise TruthUnavailable(f"no puck from {self._endpoint} within {self._timeout_s} s") from None
        except (zmq.ZMQError, msgspec.MsgspecError) as error:
            raise TruthUnavailable(f"no puck from {self._endpoint}: {error}") from None

    async def _ask(self) -> PuckTruth:
        try:
            peer = self._socket or self._connect()
            await peer.send(b"puck")
            # Strict JSON: it has no NaN, and numbers past the range of a float are refused.
            reply = msgspec.json.decode(await peer.recv(), type=_TruthReply)
        except BaseException:
            self.close_socket()
            raise
        return PuckTruth(reply.t, reply.puck, reply.moved_m)

    def _connect(self) -> zmq.asyncio.Socket:
        peer = self._context.socket(zmq.REQ)
        self._socket = peer
        peer.setsockopt(zmq.LINGER, 0)
        peer.setsockopt(zmq.MAXMSGSIZE, _MAX_REPLY_BYTES)
        peer.connect(self._endpoint)
        return peer

    def close_socket(self) -> None:
        """Forget the socket; the next request makes another."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def close(self) -> None:
        """Release socket and context."""
        self.close_socket()
        self._context.term()
