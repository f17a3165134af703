"""A TCP proxy that passes everything on between clients and a server until a fault is switched on.

The faults of the link in a fault plan switch it by the robot's clock, and are recorded.
"""

import asyncio
import random
import socket
import struct
from collections import Counter
from collections.abc import Iterator
from math import inf
from typing import Literal, Self, cast

from ccatp.sim.fault_models import Injected, LastingLinkFault, LinkFault, Reset
from ccatp.sim.network_faults import FloodLines, NetworkFaults, Pipe

Direction = Literal["to_client", "to_server", "both"]
OneWay = Literal["to_client", "to_server"]

_BOTH: tuple[OneWay, OneWay] = ("to_client", "to_server")
_FLOOD_PERIOD_S = 0.005
_RST_ON_CLOSE = struct.pack("ii", 1, 0)  # SO_LINGER: on, for 0 s


class _Connection:
    """A client, its connection to the server, and the two pipes between them."""

    def __init__(self, client: asyncio.StreamWriter, server: asyncio.StreamWriter, pipes: dict[OneWay, Pipe]) -> None:
        self.client, self.server, self.pipes = client, server, pipes

    def reset(self) -> None:
        for writer in (self.client, self.server):
            peer = writer.get_extra_info("socket")
            if not writer.is_closing() and peer is not None:
                peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RST_ON_CLOSE)
            writer.transport.abort()
        self.wake()

    def shut(self) -> None:
        """FIN to both. What they still send is read and forgotten: a socket closed over unread bytes sends RST."""
        for pipe in self.pipes.values():
            pipe.shut()

    def close(self) -> None:
        for writer in (self.client, self.server):
            writer.close()

    def wake(self) -> None:
        for pipe in self.pipes.values():
            pipe.wake()


class FaultProxy:
    """A proxy for one server; an asynchronous context manager.

    Every fault is switched on by the method of its name, for the connections that are and for those to come, and off by
    ``heal``. ``reset`` and ``close`` act at once.

    Args:
        listener: a bound socket to listen on; any free port of 127.0.0.1 if not given.

    Attributes:
        counts: what was really done, by the names of the methods: lines hit, writes, bytes swallowed, connections
            ended; ``connections`` taken, ``refused`` because the server could not be reached.
    """

    def __init__(self, host: str, port: int, *, seed: int, listener: socket.socket | None = None) -> None:
        self._address, self._own_listener = (host, port), listener
        self._rng = random.Random(seed)
        self._faults: dict[OneWay, NetworkFaults] = {way: NetworkFaults() for way in _BOTH}
        self._connections: set[_Connection] = set()
        self._handlers: set[asyncio.Task[None]] = set()
        self._flooding: asyncio.Task[None] | None = None
        self._server: asyncio.Server | None = None
        self._reset_after_bytes: int | None = None
        self.port = 0
        self.counts: Counter[str] = Counter()
        self.passed_bytes = self.passed_lines = 0

    async def __aenter__(self) -> Self:
        if self._own_listener is None:
            self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        else:
            self._server = await asyncio.start_server(self._serve, sock=self._own_listener)
        self.port = int(self._server.sockets[0].getsockname()[1])
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop()

    @property
    def connections(self) -> int:
        """How many there are."""
        return len(self._connections)

    async def stop(self) -> None:
        """End everything."""
        if self._server is not None:
            self._server.close()
        tasks = [*self._handlers, *([self._flooding] if self._flooding else [])]
        for task in tasks:
            task.cancel()
        for connection in tuple(self._connections):
            connection.client.transport.abort()
            connection.server.transport.abort()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._server is not None:
            await self._server.wait_closed()
            self._server = None

    # -- faults of an instant -------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Break every connection by RST, on both sides."""
        self.counts["reset"] += len(self._connections)
        for connection in tuple(self._connections):
            connection.reset()

    def reset_after(self, passed_bytes: int) -> None:
        """The same as soon as exactly so many bytes have gone to the clients, counted over all connections."""
        self._reset_after_bytes = passed_bytes

    def close(self) -> None:
        """End every connection by FIN, on both sides, after what is on its way out of the proxy."""
        self.counts["close"] += len(self._connections)
        for connection in tuple(self._connections):
            connection.shut()

    # -- faults that last -----------------------------------------------------------------------------------------

    def black_hole(self, direction: Direction) -> None:
        """What is sent disappears, and so does the end of the connection: a half-open connection."""
        self._set(direction, is_black_hole=True)

    def stall(self, direction: Direction) -> None:
        """Pass nothing on; ``heal`` lets everything go in one burst."""
        self._set(direction, is_stalled=True)

    def delay(self, direction: Direction, delay_s: float, jitter_s: float = 0.0) -> None:
        """Be late by ``delay_s`` and up to ``jitter_s`` more, drawn for each piece; the order stays."""
        self._set(direction, delay_s=delay_s, jitter_s=jitter_s)

    def reorder(self, direction: Direction, every: int) -> None:
        """Pass every n-th line on after the one that follows it."""
        self._set(direction, reorder_every=every)

    def duplicate(self, direction: Direction, every: int) -> None:
        """Pass every n-th line on twice."""
        self._set(direction, duplicate_every=every)

    def corrupt(self, direction: Direction, every: int) -> None:
        """Change one byte of every n-th line."""
        self._set(direction, corrupt_every=every)

    def garbage(self, direction: Direction, garbage_bytes: int, every: int) -> None:
        """Put a line of so many random bytes before every n-th line."""
        self._set(direction, garbage_every=every, garbage_bytes=garbage_bytes)

    def fragment(self, direction: Direction, write_bytes: int) -> None:
        """Write so many bytes at a time."""
        self._set(direction, write_bytes=write_bytes)

    def slowloris(self, direction: Direction, bytes_per_s: float) -> None:
        """Write single bytes at this rate."""
        self._set(direction, bytes_per_s=bytes_per_s)

    def flood(self, direction: Direction, rate_hz: float, lines: FloodLines) -> None:
        """Add further lines at this rate: random bytes, or copies of the last line that passed."""
        self._set(direction, flood_hz=rate_hz, flood_lines=lines)
        if self._flooding is None or self._flooding.done():
            self._flooding = asyncio.get_running_loop().create_task(self._flood())

    def heal(self, direction: Direction = "both", fault: str | None = None) -> None:
        """End every fault that lasts, or one, named as its method."""
        sound = NetworkFaults()
        for way in _ways(direction):
            for name in _FIELDS[fault] if fault else [name for names in _FIELDS.values() for name in names]:
                setattr(self._faults[way], name, getattr(sound, name))
        self._wake()

    # -- connections ----------------------------------------------------------------------------------------------

    def _set(self, direction: Direction, **values: object) -> None:
        for way in _ways(direction):
            for name, value in values.items():
                setattr(self._faults[way], name, value)
        self._wake()

    def _wake(self) -> None:
        for connection in self._connections:
            connection.wake()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = cast(asyncio.Task[None], asyncio.current_task())  # asyncio runs this as a task of its own
        self._handlers.add(task)
        try:
            await self._connect(reader, writer)
        except asyncio.CancelledError:
            pass  # ``stop``; a task of asyncio's own must not end cancelled
        finally:
            self._handlers.discard(task)
            writer.transport.abort()

    async def _connect(self, reader: asyncio.StreamReader, client: asyncio.StreamWriter) -> None:
        try:
            server_reader, server = await asyncio.open_connection(*self._address)
        except OSError:
            self.counts["refused"] += 1
            return
        for writer in (client, server):
            writer.transport.set_write_buffer_limits(0)  # written means: given to the kernel
            writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        pipes = {
            "to_server": self._pipe("to_server", reader, server),
            "to_client": self._pipe("to_client", server_reader, client),
        }
        connection = _Connection(client, server, {way: pipes[way] for way in _BOTH})
        self._connections.add(connection)
        self.counts["connections"] += 1
        try:
            async with asyncio.TaskGroup() as tasks:
                for pipe in pipes.values():
                    tasks.create_task(pipe.receive())
                    tasks.create_task(pipe.send())
        finally:
            self._connections.discard(connection)
            connection.close()

    def _pipe(self, way: OneWay, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> Pipe:
        may_write = self._passing if way == "to_client" else _everything
        return Pipe(reader, writer, self._faults[way], self.counts, random.Random(self._rng.random()), may_write)

    def _passing(self, data: bytes) -> bytes:
        """What of ``data`` may go to a client, and is counted as gone."""
        limit = self._reset_after_bytes
        if limit is not None and self.passed_bytes + len(data) >= limit:
            data = data[: limit - self.passed_bytes]
            self._reset_after_bytes = None
            # After the write that follows, which the kernel takes at once on a loopback.
            asyncio.get_running_loop().call_soon(self.reset)
        self.passed_bytes += len(data)
        self.passed_lines += data.count(b"\n")
        return data

    async def _flood(self) -> None:
        owed = dict.fromkeys(_BOTH, 0.0)
        clock = asyncio.get_running_loop().time
        before_s = clock()
        while any(faults.flood_hz for faults in self._faults.values()):
            await asyncio.sleep(_FLOOD_PERIOD_S)
            now_s = clock()
            for way in _BOTH:
                owed[way] += (now_s - before_s) * self._faults[way].flood_hz
                lines, owed[way] = int(owed[way]), owed[way] % 1.0
                for connection in self._connections if lines else ():
                    connection.pipes[way].flood(lines)
            before_s = now_s


_FIELDS: dict[str, tuple[str, ...]] = {
    "black_hole": ("is_black_hole",),
    "stall": ("is_stalled",),
    "delay": ("delay_s", "jitter_s"),
    "reorder": ("reorder_every",),
    "duplicate": ("duplicate_every",),
    "corrupt": ("corrupt_every",),
    "garbage": ("garbage_every", "garbage_bytes"),
    "fragment": ("write_bytes",),
    "slowloris": ("bytes_per_s",),
    "flood": ("flood_hz",),
}


def _ways(direction: Direction) -> Iterator[OneWay]:
    return (way for way in _BOTH if direction in {way, "both"})


def _everything(data: bytes) -> bytes:
    return data


class _Watched:
    """One fault of the plan and what became of it."""

    def __init__(self, fault: LinkFault) -> None:
        self.fault = fault
        self.from_s: float | None = None
        self.until_s: float | None = None
        self.count_before = self.count = 0

    @property
    def injected(self) -> Injected:
        return Injected("link", self.fault.type, self.fault.at_s, self.from_s, self.until_s, self.count, self.count)


class LinkFaults:
    """Faults of the link, ruled by the robot's clock."""

    def __init__(self, plan: tuple[LinkFault, ...], proxy: FaultProxy) -> None:
        self._proxy = proxy
        self._watched = [_Watched(fault) for fault in plan]
        for fault in plan:
            if fault.after_bytes is not None and _is_armed(fault):
                proxy.reset_after(fault.after_bytes)

    @property
    def injected(self) -> tuple[Injected, ...]:
        """The record of each fault, in the order of the plan."""
        for one in self._watched:
            if one.from_s is not None and one.until_s is None:
                self._count(one)
        return tuple(one.injected for one in self._watched)

    def tick(self, t_s: float) -> list[tuple[str, Injected]]:
        """Begin and end what is due at a robot time; what began (``begins``) and ended (``ended``)."""
        news = []
        for one in self._watched:
            if one.from_s is None and self._is_due(one.fault, t_s):
                one.from_s = t_s
                if not _is_armed(one.fault):
                    one.count_before = self._proxy.counts[one.fault.type]
                    begin(one.fault, self._proxy)
                if not isinstance(one.fault, LastingLinkFault):
                    one.until_s = t_s
                self._count(one)
                news.append(("begins", one.injected))
            elif one.from_s is not None and one.until_s is None and t_s >= one.from_s + _length_s(one.fault):
                self._count(one)
                one.until_s = t_s
                end(one.fault, self._proxy)
                news.append(("ended", one.injected))
        return news

    def _is_due(self, fault: LinkFault, t_s: float) -> bool:
        proxy = self._proxy
        if fault.at_s is not None:
            return t_s >= fault.at_s
        if fault.after_lines is not None:
            return proxy.passed_lines >= fault.after_lines
        return fault.after_bytes is not None and proxy.passed_bytes >= fault.after_bytes

    def _count(self, one: _Watched) -> None:
        one.count = self._proxy.counts[one.fault.type] - one.count_before


def begin(fault: LinkFault, proxy: FaultProxy) -> None:
    """Let the proxy do what a fault says: the method of its type takes the keys that the type has for itself."""
    values = fault.model_dump(exclude=set(LastingLinkFault.model_fields))
    start = getattr(proxy, fault.type)
    if isinstance(fault, LastingLinkFault):
        start(_way(fault), **values)
    else:
        start()


def end(fault: LinkFault, proxy: FaultProxy) -> None:
    """End it."""
    proxy.heal(_way(fault), fault.type)


def _is_armed(fault: LinkFault) -> bool:
    """Whether the proxy itself waits for the moment, to the byte."""
    return isinstance(fault, Reset) and fault.after_bytes is not None


def _way(fault: LinkFault) -> Direction:
    direction = fault.direction if isinstance(fault, LastingLinkFault) else "both"
    return "to_server" if direction == "to_robot" else direction


def _length_s(fault: LinkFault) -> float:
    for_s = fault.for_s if isinstance(fault, LastingLinkFault) else None
    return inf if for_s is None else for_s
