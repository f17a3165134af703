"""Edge. A simulated robot behind the robot link: sockets, the wall clock or lockstep, the end of it."""

import asyncio
import secrets
import socket
from typing import Protocol, cast

from ccatp.sim.sessions import RobotServer, ServedRobot, Session

HOUSEKEEPING_S = 0.25
# A client that does not read gets no more frames once this much waits for it; it finds the newest when it reads on.
MAX_UNSENT_BYTES = 1 << 18


class Log(Protocol):
    """A structlog logger, or whatever has this method."""

    def info(self, event: str, **fields: object) -> object:
        """Take one line, and what belongs to it."""


class LinkServer:
    """The server of one robot.

    Args:
        robot: just booted.
        address: host and port to listen on where no bound socket is given; port 0 = any free port.
        lockstep: simulated time waits for the clients; otherwise the wall clock paces it.
        key: key of the robot link, ``None`` for no authentication.
        log: takes its lines.

    Attributes:
        server: the link without sockets.
    """

    def __init__(
        self, robot: ServedRobot, address: tuple[str, int], *, lockstep: bool, key: bytes | None, log: Log | None
    ) -> None:
        self._served, self._address, self._is_lockstep = robot, address, lockstep
        self._key, self._log = key, log
        self._boot = secrets.randbits(31)
        self._listener: asyncio.Server | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._connections: set[_Connection] = set()
        self._failure: asyncio.Future[None]

    async def start(self, sock: socket.socket | None = None) -> int:
        """Boot and listen on the configured address (port 0 = any free port) or on a bound socket; return the port.

        Raises:
            OSError: the address cannot be had.
        """
        loop = asyncio.get_running_loop()
        self._failure = loop.create_future()
        self.server = RobotServer(
            self._served,
            lockstep=self._is_lockstep,
            boot=self._boot,
            key=self._key,
            make_nonce=lambda: secrets.token_hex(16),
            now_s=loop.time(),
            note=self._note,
            on_frame=self.on_frame,
        )
        if sock is None:
            self._listener = await loop.create_server(self._connection, *self._address)
        else:
            self._listener = await loop.create_server(self._connection, sock=sock)
        if not self._is_lockstep:
            self._timer = loop.call_at(self.server.next_frame_s, self._tick)
        return int(self._listener.sockets[0].getsockname()[1])

    async def run(self, stop: asyncio.Event) -> None:
        """Serve until ``stop`` is set; ``start`` first unless it was called. An unforeseen error is raised here."""
        if self._listener is None:
            await self.start()
        failure = self._failure
        stopped = asyncio.ensure_future(stop.wait())
        try:
            while not (stopped.done() or failure.done()):
                self.server.check_time(asyncio.get_running_loop().time())
                await asyncio.wait((stopped, failure), timeout=HOUSEKEEPING_S, return_when="FIRST_COMPLETED")
            if failure.done():
                failure.result()
        finally:
            stopped.cancel()
            await self.close()

    async def close(self) -> None:
        """Stop: no timer, no listener, no session."""
        if self._timer is not None:
            self._timer.cancel()
        if self._listener is not None:
            self._listener.close()
        for connection in tuple(self._connections):
            connection.close()
        self.on_close()
        if self._listener is not None:
            if self._log is not None:
                counts = {"fan_changes": self.server.fan_changes, "oldest_ack_frames": self.server.oldest_ack_frames}
                self._log.info("robot", **counts, **self.server.counts)
            await self._listener.wait_closed()
            self._listener = None

    def on_frame(self) -> None:
        """A frame has been driven."""

    def on_close(self) -> None:
        """The last frame has been driven."""

    def _connection(self) -> "_Connection":
        return _Connection(self)

    def opened(self, connection: "_Connection") -> Session:
        """A client connected."""
        self._connections.add(connection)
        return self.server.accept(connection, asyncio.get_running_loop().time())

    def closed(self, connection: "_Connection", session: Session) -> None:
        """A client is gone."""
        self._connections.discard(connection)
        self.server.lost(session)

    def fail(self, error: Exception) -> None:
        """End ``run`` with an error that nobody foresaw."""
        if not self._failure.done():
            self._failure.set_exception(error)

    def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            self.server.tick(loop.time())
        except Exception as error:
            self.fail(error)
            return
        self._timer = loop.call_at(self.server.next_frame_s, self._tick)

    def _note(self, text: str) -> None:
        if self._log is not None:
            self._log.info(text)


class _Connection(asyncio.Protocol):
    """Bytes in and out of one connection."""

    def __init__(self, owner: LinkServer) -> None:
        self._owner = owner
        self._transport: asyncio.Transport | None = None
        self._session: Session | None = None
        self._is_paused = False
        self._clock = asyncio.get_running_loop().time

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)  # a TCP connection has no other
        self._transport.set_write_buffer_limits(high=MAX_UNSENT_BYTES)
        peer = self._transport.get_extra_info("socket")
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._session = self._owner.opened(self)

    def data_received(self, data: bytes) -> None:
        if self._session is None:
            return
        try:
            self._session.receive(data, self._clock())
        except Exception as error:
            self._owner.fail(error)

    def eof_received(self) -> None:
        # The transport closes only when the client has taken what waits for it; the session ends here and now.
        if self._session is not None:
            self._owner.server.lost(self._session)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._session is not None:
            self._owner.closed(self, self._session)

    def pause_writing(self) -> None:
        self._is_paused = True

    def resume_writing(self) -> None:
        self._is_paused = False

    def write(self, data: bytes) -> None:
        if not self._is_paused and self._transport is not None:
            self._transport.write(data)

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()
