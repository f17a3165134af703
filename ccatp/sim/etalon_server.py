"""The simulated MultiLine server: the same grammar with simulated lengths, by TCP.

Known limitations (the sources of the grammar do not describe them):

* An invalid request is answered ``error_unknown-request``, ``error_bad-arguments`` or ``error_bad-channel`` (not 1 to
  32, or twice); ``measurelengthwithrawdata`` is unknown. The connection stays open.
* A channel that is not installed gives a record of length 0 with ``daq_error``.
* If the position of the puck is not available, each record has length 0 and ``daq_error``, and the server error is 1.
* While a client receives the push stream, all its requests except ``stopmeasnogui`` are answered ``error_busy``, and so
  is another client's ``startmeasnogui``. Other clients' queries are answered, so that a second client cannot stop a
  survey; the real server may refuse them. The stream uses the wall clock, also in lockstep.
* ``stopmeasnogui`` without a stream is answered ``measstopped``.
* Channel groups, the measurement window, ``defanadata`` and ``measurementfinished`` are not simulated.

The true position of the puck is fixed, or requested from the simulated robot.
"""

import asyncio
import socket
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, cast

import msgspec
import numpy as np
import zmq
import zmq.asyncio

from ccatp.config.models import SimEtalonConfig
from ccatp.core import FloatArray, Vector3
from ccatp.links import multiline
from ccatp.links.multiline import ChannelData, Command, Connected, LaserReady, Notice, Remark, Reply
from ccatp.links.robot_codec import LineBuffer, LineTooLong
from ccatp.sim.laser import EtalonModel, PuckTruth

_MAX_REPLY_BYTES = 4096


class TruthUnavailable(Exception):
    """The position of the puck is not available."""


class PuckSource(Protocol):
    """Source of the true position of the puck."""

    async def puck(self) -> PuckTruth:
        """The puck now. Raises ``TruthUnavailable``."""


@dataclass(slots=True)
class FixedPuck:
    """A puck at rest, world frame; each query advances the time by ``step_s``, for new noise."""

    position_m: Vector3
    t_s: float = 0.0
    moved_m: float = 0.0
    step_s: float = 0.0

    async def puck(self) -> PuckTruth:
        """The puck at the time of this query."""
        truth = PuckTruth(self.t_s, self.position_m, self.moved_m)
        self.t_s += self.step_s
        return truth


class ZmqPuck:
    """Asks the simulated robot: request ``b"puck"``, reply ``{"t", "puck": [x, y, z], "moved_m"}``, SI, world frame."""

    def __init__(self, endpoint: str, timeout_s: float = 1.0) -> None:
        self._endpoint, self._timeout_s = endpoint, timeout_s
        self._context = zmq.asyncio.Context()

    async def puck(self) -> PuckTruth:
        """The puck now, with a new socket: a REQ socket without its reply takes no further request."""
        try:
            async with asyncio.timeout(self._timeout_s):
                with self._context.socket(zmq.REQ) as peer:
                    peer.setsockopt(zmq.LINGER, 0)
                    peer.setsockopt(zmq.MAXMSGSIZE, _MAX_REPLY_BYTES)
                    peer.connect(self._endpoint)
                    await peer.send(b"puck")
                    # Strict JSON: it has no NaN, and numbers past the range of a float are refused.
                    return msgspec.json.decode(await peer.recv(), type=PuckTruth)
        except TimeoutError:
            raise TruthUnavailable(f"no puck from {self._endpoint} within {self._timeout_s} s") from None
        except (zmq.ZMQError, msgspec.MsgspecError) as error:
            raise TruthUnavailable(f"no puck from {self._endpoint}: {error}") from None

    def close(self) -> None:
        """Release the context."""
        self._context.term()


_READ_BYTES = 65536
_SEND_TIMEOUT_S = 5.0  # a client that does not read for this long is dropped
_MAX_CLIENTS = 64
_BUSY = Remark("error", "busy")


class EtalonSimulator:
    """The server of k channels with collimators in the world frame, shape (k, 3).

    ``moved_m`` of ``truth`` must refer to the time over which a length is averaged. ``blocked``, ``flags`` and
    ``laser_ready`` of ``model`` may be changed at any time. ``counts``: requests, bad_requests, oversized_lines,
    truth_failures, refused_clients, lost_clients.
    """

    def __init__(
        self, cfg: SimEtalonConfig, channels: Sequence[int], collimators_m: FloatArray, truth: PuckSource,
        rng: np.random.Generator,
    ) -> None:  # fmt: skip
        self.model = EtalonModel(cfg, channels, collimators_m, rng)
        self.connected = True  # answer to ``isconnected``
        self.push_hz = 5.0
        self.counts: Counter[str] = Counter()
        self._truth = truth
        self._server: asyncio.Server | None = None
        self._sessions: set[asyncio.Task[None]] = set()
        self._streaming: asyncio.StreamWriter | None = None  # the client that has the push stream
        self._push: asyncio.Task[None] | None = None
        self._end: asyncio.Future[None] | None = None

    async def start(self, listener: socket.socket) -> int:
        """Serve the clients of a bound socket; return its port."""
        self._end = asyncio.get_running_loop().create_future()
        self._server = await asyncio.start_server(self._accept, sock=listener)
        return int(listener.getsockname()[1])

    async def serve(self) -> None:
        """Wait until ``close``. Raises an unexpected error of a session."""
        if self._end is None:
            raise RuntimeError("simulated MultiLine server not started: call start first")
        await asyncio.shield(self._end)

    async def close(self) -> None:
        """Stop listening and end all sessions."""
        if self._server is None or self._end is None:
            return
        self._server.close()
        sessions = tuple(self._sessions)
        for session in sessions:
            session.cancel()
        await asyncio.gather(*sessions, return_exceptions=True)
        await self._server.wait_closed()
        self._server = None
        if not self._end.done():
            self._end.set_result(None)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = cast("asyncio.Task[None]", asyncio.current_task())
        if len(self._sessions) >= _MAX_CLIENTS:
            self.counts["refused_clients"] += 1
            writer.transport.abort()
            return
        self._sessions.add(task)
        try:
            await self._converse(reader, writer)
        except* asyncio.CancelledError:
            pass  # by close(); asyncio logs a connection's task that ends cancelled as an error
        except* LineTooLong:
            self.counts["oversized_lines"] += 1
        except* (ConnectionError, TimeoutError):
            self.counts["lost_clients"] += 1
        except* Exception as error:
            if self._end is not None and not self._end.done():
                self._end.set_exception(error)
        finally:
            self._sessions.discard(task)
            writer.transport.abort()

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one client until it closes its side."""
        buffer = LineBuffer(multiline.MAX_LINE_BYTES)
        async with asyncio.TaskGroup() as group:
            try:
                while data := await reader.read(_READ_BYTES):
                    for line in buffer.feed(data):
                        reply = await self._answer(line.rstrip(b"\r"), writer)
                        await _send(writer, reply)
                        if reply is Notice.STARTED:
                            self._push = group.create_task(self._stream(writer))
                    if buffer.error is not None:
                        raise buffer.error
            finally:
                self._stop_stream(writer)
        writer.close()
        async with asyncio.timeout(_SEND_TIMEOUT_S):
            await writer.wait_closed()

    async def _answer(self, line: bytes, writer: asyncio.StreamWriter) -> Reply:
        try:
            request = multiline.parse_request(line)
        except multiline.BadMultilineRequest as error:
            self.counts["bad_requests"] += 1
            return Remark("error", error.reason)
        self.counts["requests"] += 1
        is_streaming = writer is self._streaming
        match request.command:
            case Command.STOP_MEASUREMENT:
                self._stop_stream(writer)
                return Notice.STOPPED
            case Command.LATEST_LENGTH_VALID if not is_streaming:
                return await self._lengths(request.channels)
            case Command.IS_CONNECTED if not is_streaming:
                return Connected(self.connected)
            case Command.LASER_READY if not is_streaming:
                return LaserReady(self.model.laser_ready)
            case Command.ENVIRONMENT_DATA if not is_streaming:
                return self.model.environment
        if self._streaming is not None:
            return _BUSY
        self._streaming = writer
        return Notice.STARTED

    async def _lengths(self, channels: Sequence[int]) -> ChannelData:
        """Measure once."""
        try:
            puck = await self._truth.puck()
        except TruthUnavailable:
            self.counts["truth_failures"] += 1
            return ChannelData(self.model.records(channels, None), server_error=1)
        return ChannelData(self.model.records(channels, puck))

    async def _stream(self, writer: asyncio.StreamWriter) -> None:
        while True:
            await _send(writer, await self._lengths(self.model.channels))
            await asyncio.sleep(1.0 / self.push_hz)

    def _stop_stream(self, writer: asyncio.StreamWriter) -> None:
        """End the stream; a record is written in one piece, so no part of one follows."""
        if self._streaming is writer:
            self._streaming = None
            if self._push is not None:
                self._push.cancel()


async def _send(writer: asyncio.StreamWriter, reply: Reply) -> None:
    writer.write(multiline.format_reply(reply))
    async with asyncio.timeout(_SEND_TIMEOUT_S):
        await writer.drain()
