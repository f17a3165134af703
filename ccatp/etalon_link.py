"""Edge. One connection to a MultiLine server: a line asked for at a time, or the lines of its push stream."""

import asyncio
from typing import cast

from ccatp.wire import multiline
from ccatp.wire.multiline import Request

PushQueue = asyncio.Queue[bytes | None]  # lines of the push stream; None: the connection is gone

_STREAM_LINES = 64  # lines of the push stream kept for a slow reader; older ones are dropped


class EtalonLink(asyncio.Protocol):
    """One connection.

    Attributes:
        fault: why it must not be used again; empty while it may.
    """

    def __init__(self) -> None:
        self.fault = ""
        self._unasked = False
        self._stream: PushQueue | None = None
        self._lines = multiline.LineSplitter()
        self._waiting: asyncio.Future[bytes] | None = None
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Called by asyncio."""
        self._transport = cast(asyncio.Transport, transport)  # a TCP connection has no other

    def data_received(self, data: bytes) -> None:
        """Called by asyncio: deliver whole lines."""
        self._lines.feed(data)
        try:
            while not self.fault and (line := self._lines.next_line()) is not None:
                self._deliver(line)
        except multiline.LineTooLong as error:
            self._fail(error)

    def connection_lost(self, exc: Exception | None) -> None:
        """Called by asyncio."""
        self._fail(ConnectionError(f"connection lost: {exc}" if exc else "server closed the connection"))

    def _deliver(self, line: bytes) -> None:
        if self._stream is not None:
            self._push(self._stream, line)
        elif self._waiting is not None and not self._waiting.done():
            self._waiting.set_result(line)
        else:
            self._unasked = True
            self._fail(ConnectionError("server sent a line unasked"))

    def _fail(self, error: Exception) -> None:
        self.fault = self.fault or str(error)
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_exception(error)
        if self._stream is not None:
            self._push(self._stream, None)
        self.abort()

    @staticmethod
    def _push(stream: PushQueue, line: bytes | None) -> None:
        if stream.full():
            stream.get_nowait()
        stream.put_nowait(line)

    @property
    def is_clean(self) -> bool:
        """Free of faults and leftovers: fit for the next request."""
        return not self.fault and not self.has_leftovers

    @property
    def has_leftovers(self) -> bool:
        """More came than was asked for, so no line can be trusted to answer what it seems to."""
        return self._unasked or self._lines.pending

    async def ask(self, request: Request) -> bytes:
        """Send and wait for one line; the deadline is the caller's.

        Raises:
            ConnectionError: the connection is lost.
            LineTooLong: the reply never ends.
        """
        self._waiting = asyncio.get_running_loop().create_future()
        self.send(request)
        return await self._waiting

    def start_stream(self) -> PushQueue:
        """From now on, lines go into the queue returned."""
        self._stream = asyncio.Queue(_STREAM_LINES)
        return self._stream

    def send(self, request: Request) -> None:
        """Send without waiting for anything.

        Raises:
            ConnectionError: the connection is lost.
        """
        if self._transport is None or self.fault:
            raise ConnectionError(self.fault or "not connected")
        self._transport.write(multiline.format_request(request))

    def abort(self) -> None:
        """Close at once; the other end's bytes, sent or to come, are lost."""
        self.fault = self.fault or "closed"
        if self._transport is not None:
            self._transport.abort()
