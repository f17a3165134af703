"""Edge. The truth of a simulation by ZeroMQ, apart from the robot link: requests, and batches of rows for recorders."""

from typing import Protocol

import zmq
import zmq.asyncio

from ccatp.bus import Publisher
from ccatp.wire.topics import Message

MAX_REQUEST_BYTES = 4096


class TruthSource(Protocol):
    """What there is to give."""

    def add(self) -> bool:
        """Add the row of the newest frame; true when the batch should be taken."""

    def batch(self) -> tuple[str, Message] | None:
        """The pending rows as a topic and its message, or ``None`` without any."""

    def preface(self) -> tuple[str, Message]:
        """What a recorder has to know before the first batch, likewise."""

    def answer(self, request: bytes) -> bytes:
        """The reply to a request."""


class TruthOutlet:
    """Gives the truth away by ZeroMQ.

    Args:
        truth: what there is to give.
        rep: endpoint of the REP socket, if any.
        pub: endpoint of the PUB socket, if any.
    """

    def __init__(self, truth: TruthSource, rep: str | None, pub: str | None) -> None:
        self._truth = truth
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._publisher = Publisher(self._context, pub) if pub else None
        self._has_told = False
        self._rep = zmq.asyncio.Context.shadow(self._context).socket(zmq.REP) if rep else None
        if self._rep is not None and rep:
            self._rep.setsockopt(zmq.LINGER, 0)
            self._rep.setsockopt(zmq.MAXMSGSIZE, MAX_REQUEST_BYTES)
            self._rep.bind(rep)

    def add(self) -> None:
        """Take the row of the newest frame."""
        if self._truth.add():
            self.flush()

    def flush(self) -> None:
        """Publish the pending rows."""
        batch = self._truth.batch()
        if batch is None or self._publisher is None:
            return
        if not self._has_told:  # before the first batch: whoever records one has the other, however the run ends
            self._has_told = True
            self._publisher.send(*self._truth.preface())
        self._publisher.send(*batch)

    async def serve(self) -> None:
        """Answer requests for ever."""
        while self._rep is not None:
            request = await self._rep.recv()
            if request == b"flush":
                self.flush()
            await self._rep.send(self._truth.answer(request))

    def close(self) -> None:
        """Release the sockets."""
        if self._rep is not None:
            self._rep.close()
        if self._publisher is not None:
            self._publisher.close()
        self._context.destroy(linger=0)
