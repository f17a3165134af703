"""The TCP server of a robot: sockets around ``RobotServer``, the wall clock or lockstep."""

import asyncio
import socket
from typing import cast

from ccatp.links.robot_link import LineWriter
from ccatp.onboard.rules import LinkedRobot
from ccatp.onboard.sessions import ClientSession, RobotServer, ServerLog

HOUSEKEEPING_S = 0.25
# While more than this is unsent to a client that does not read, further frames for it are dropped.
MAX_UNSENT_BYTES = 1 << 18


class TcpRobotServer(RobotServer):
    """The server of one robot; the clients' answers advance its time in lockstep, the wall clock otherwise."""

    def __init__(
        self, robot: LinkedRobot, *, lockstep: bool, key: bytes | None = None, log: ServerLog | None = None
    ) -> None:
        super().__init__(robot, lockstep=lockstep, key=key, log=log)
        self._listener: asyncio.Server | None = None
        self._timer: asyncio.TimerHandle | None = None
        self.connections: set[Connection] = set()
        self._failure: asyncio.Future[None]

    async def start(self, listener: socket.socket) -> int:
        """Boot and serve the clients of a listening socket; return its port."""
        loop = asyncio.get_running_loop()
        self._failure = loop.create_future()
        self.begin(loop.time())
        self._listener = await loop.create_server(self.connect, sock=listener)
        if not self._is_lockstep:
            self._start_timer()
        return int(listener.getsockname()[1])

    def connect(self) -> "Connection":
        """The protocol of a new connection."""
        return Connection(self)

    async def run(self, stop: asyncio.Event) -> None:
        """Serve until ``stop`` is set; call ``start`` first. Raises the error given to ``fail``."""
        failure = self._failure
        stopped = asyncio.ensure_future(stop.wait())
        try:
            while not (stopped.done() or failure.done()):
                self.check_time(asyncio.get_running_loop().time())
                await asyncio.wait((stopped, failure), timeout=HOUSEKEEPING_S, return_when="FIRST_COMPLETED")
            if failure.done():
                failure.result()
        finally:
            stopped.cancel()
            await self.close()

    async def close(self) -> None:
        """Stop the timer, the listener and all sessions."""
        self._stop_timer()
        if self._listener is None:
            return
        self._listener.close()
        for connection in tuple(self.connections):
            connection.close()
        if self._log is not None:
            counts = {"fan_changes": self.fan_changes, "oldest_ack_frames": self.oldest_ack_frames}
            self._log.info("robot_statistics", **counts, **self.counts)
        await self._listener.wait_closed()
        self._listener = None

    def fail(self, error: Exception) -> None:
        """End ``run`` with an unforeseen error."""
        if not self._failure.done():
            self._failure.set_exception(error)

    def _start_timer(self) -> None:
        self._timer = asyncio.get_running_loop().call_at(self.next_frame_s, self._on_timer)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def _on_timer(self) -> None:
        try:
            self.tick(asyncio.get_running_loop().time())
        except Exception as error:
            self.fail(error)
            return
        self._start_timer()


class Connection(ClientSession, asyncio.Protocol):
    """One client of a ``TcpRobotServer``."""

    _transport: asyncio.Transport

    def __init__(self, owner: TcpRobotServer) -> None:
        super().__init__(owner)
        self._owner = owner
        self._is_paused = False
        self._clock = asyncio.get_running_loop().time

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)  # the type for TCP
        self._transport.set_write_buffer_limits(high=MAX_UNSENT_BYTES)
        self._writer = LineWriter(self._transport)
        peer = self._transport.get_extra_info("socket")
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._owner.connections.add(self)
        self._owner.accept(self, self._clock())

    def data_received(self, data: bytes) -> None:
        try:
            self.receive(data, self._clock())
        except Exception as error:
            self._owner.fail(error)

    def eof_received(self) -> None:
        # The transport closes only after it has sent the remaining bytes; the session ends now.
        self._owner.lost(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self._owner.connections.discard(self)
        self._owner.lost(self)

    def pause_writing(self) -> None:
        self._is_paused = True

    def resume_writing(self) -> None:
        self._is_paused = False

    def write(self, data: bytes) -> None:
        """Send, or drop ``data`` while the client does not read."""
        if not self._is_paused:
            self._writer.write(data)

    def close(self) -> None:
        self._transport.close()
