"""A TCP proxy that passes all data on between clients and a server until a fault is switched on.

The link faults of a fault plan are switched on and off by the robot's clock, and recorded.
"""

import asyncio
import contextlib
import random
import socket
import struct
from collections import Counter, deque
from math import inf
from typing import Any, Literal, Self, cast

from ccatp.sim.fault_plan import Direction, Injected, LinkFault

OneWay = Literal["to_client", "to_robot"]
OneWayFaults = dict[str, Any]
"""The active faults in one direction by type, at most one of each type."""

# With more unsent bytes than this the proxy stops reading, so that TCP stops the sender.
MAX_WAITING_BYTES = 8 << 20
_LF = b"\n"
_GARBAGE_LINE_BYTES = 64
_LINE_FAULTS = ("reorder", "duplicate", "corrupt", "garbage", "flood")
_AT_ONCE = ("reset", "close")
_BOTH: tuple[OneWay, OneWay] = ("to_client", "to_robot")
_FLOOD_PERIOD_S = 0.005
_RST_ON_CLOSE = struct.pack("ii", 1, 0)  # SO_LINGER: on, for 0 s


class LineStage:
    """Cuts a stream into lines while a fault acts on lines, and applies the faults."""

    def __init__(self, faults: OneWayFaults, counts: "Counter[str]", rng: random.Random) -> None:
        self._faults, self._counts, self._rng = faults, counts, rng
        self._rest = self._withheld = b""
        self._seen: Counter[str] = Counter()
        self._last = b""

    def feed(self, data: bytes) -> list[bytes]:
        """The pieces to pass on after the receipt of ``data``; a line ends between two pieces."""
        if self._faults.keys().isdisjoint(_LINE_FAULTS):
            found, self._rest, self._withheld = self._rest + data + self._withheld, b"", b""
            return [found]
        *lines, self._rest = (self._rest + data).split(_LF)  # ``splitlines`` would cut at CR, too
        return [piece for line in lines for piece in self._treat(line + _LF)]

    def finish(self) -> bytes:
        """The remaining bytes at the end of the stream."""
        found, self._rest, self._withheld = self._rest + self._withheld, b"", b""
        return found

    def flood_line(self) -> bytes:
        """One additional line of the fault ``flood``."""
        is_copy = self._faults["flood"].lines == "copies" and self._last
        return self._last if is_copy else self._garbage(_GARBAGE_LINE_BYTES)

    def _treat(self, line: bytes) -> list[bytes]:
        self._last = line
        found: list[bytes] = []
        if self._is_hit("garbage"):
            found.append(self._garbage(self._faults["garbage"].garbage_bytes))
        if self._is_hit("corrupt"):
            line = self._corrupt(line)
        if self._withheld:
            found += [line, self._withheld]
            self._withheld = b""
        elif self._is_hit("reorder"):
            self._withheld = line
            return found
        else:
            found.append(line)
        if self._is_hit("duplicate"):
            found.append(line)
        return found

    def _is_hit(self, kind: str) -> bool:
        """Count this line for a fault; return whether it is an n-th one, on which the fault acts."""
        fault = self._faults.get(kind)
        if fault is None:
            return False
        self._seen[kind] += 1
        if self._seen[kind] % fault.every:
            return False
        self._counts[kind] += 1
        return True

    def _garbage(self, count: int) -> bytes:
        return self._rng.randbytes(count).replace(_LF, b"\x00") + _LF

    def _corrupt(self, line: bytes) -> bytes:
        """Change one byte of the line, which stays one line."""
        if line == _LF:
            return line
        at = self._rng.randrange(len(line) - 1)
        other = [byte for byte in range(256) if byte not in {line[at], _LF[0]}]
        return line[:at] + bytes((self._rng.choice(other),)) + line[at + 1 :]


class Pipe(asyncio.Protocol):
    """One end of a connection: passes data of its peer on to the other end, with the faults of this direction."""

    transport: asyncio.Transport

    def __init__(self, proxy: "FaultProxy", way: OneWay, other: "Pipe | None" = None) -> None:
        self.way, self.other, self._proxy = way, other, proxy
        self._faults, self._counts, self._rng = proxy.faults[way], proxy.counts, random.Random(proxy.rng.random())
        self._stage = LineStage(self._faults, self._counts, self._rng)
        self._waiting: deque[tuple[float, bytes]] = deque()  # time when it is due, data
        self._waiting_bytes = 0
        self._due_s = self._next_write_s = 0.0
        self._is_at_end = self._is_shut = self._is_full = self._is_done = False
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.Handle | None = None
        self._flood_timer: asyncio.Handle | None = None
        self._owed_lines = 0.0
        if other is not None:
            other.other = self

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)  # the type for TCP
        self.transport.set_write_buffer_limits(0)  # pause until the kernel has all data
        self.transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if self.other is None:
            self.transport.pause_reading()
            self._proxy.connect(self)

    def data_received(self, data: bytes) -> None:
        if "black_hole" in self._faults:
            self._counts["black_hole"] += len(data)
            return
        for piece in self._stage.feed(data):
            self._put(piece)
        self.send()

    def eof_received(self) -> bool:
        self._is_at_end = True
        self.send()
        return True  # the other direction stays open

    def connection_lost(self, exc: Exception | None) -> None:
        self.eof_received()
        self.resume_writing()  # discard what waits for this end

    def pause_writing(self) -> None:
        self._is_full = True

    def resume_writing(self) -> None:
        self._is_full = False
        if self.other is not None:
            self.other.send()

    def _put(self, data: bytes) -> None:
        """Queue data until they are due; data over the limit are lost."""
        if not data or self._is_shut or self._waiting_bytes + len(data) > 2 * MAX_WAITING_BYTES:
            return
        late_s = 0.0
        if (delay := self._faults.get("delay")) is not None:
            late_s = delay.delay_s + (delay.jitter_s * self._rng.random() if delay.jitter_s else 0.0)
            self._counts["delay"] += late_s > 0.0
        self._due_s = max(self._due_s, self._loop.time() + late_s)
        self._waiting.append((self._due_s, data))
        self._waiting_bytes += len(data)
        if self._waiting_bytes > MAX_WAITING_BYTES:
            self.transport.pause_reading()

    def flood(self, since_s: float | None = None) -> None:
        """Queue additional lines at the rate of the fault, while it lasts."""
        now_s, flood = self._loop.time(), self._faults.get("flood")
        if since_s is None and self._flood_timer is not None:
            self._flood_timer.cancel()
        if flood is None or self._is_done:
            return
        owed = self._owed_lines + (now_s - (now_s if since_s is None else since_s)) * flood.rate_hz
        lines, self._owed_lines = int(owed), owed % 1.0
        if lines:
            self._counts["flood"] += lines
            self._put(b"".join(self._stage.flood_line() for _ in range(lines)))
            self.send()
        self._flood_timer = self._loop.call_later(_FLOOD_PERIOD_S, self.flood, now_s)

    def send(self) -> None:
        """Send the data that are due, or the end; call it whenever this may have changed."""
        if self._timer is not None:
            self._timer.cancel()
        other = self.other
        if other is None or self._is_done:
            return
        is_lost = other.transport.is_closing()
        is_ending = self._is_at_end and (is_lost or "black_hole" not in self._faults)
        if is_ending:
            self._put(self._stage.finish())
        if is_lost:
            self._forget()
        if not self._waiting:
            if is_ending:
                self._finish(other)
        elif "stall" in self._faults:
            self._counts["stall"] += 1
        elif not other._is_full:
            early_s = max(self._waiting[0][0], self._next_write_s) - self._loop.time()
            if early_s <= 0.0:
                self._write(other)
            self._timer = self._loop.call_later(max(early_s, 0.0), self.send)

    def _write(self, other: "Pipe") -> None:
        """Write the data that are due in one piece, or a part of them if a fault requires this."""
        now_s, data = self._loop.time(), b""
        while self._waiting and self._waiting[0][0] <= now_s:
            data += self._waiting.popleft()[1]
        slow, fragment = self._faults.get("slowloris"), self._faults.get("fragment")
        size = 1 if slow is not None else len(data) if fragment is None else fragment.write_bytes
        piece, rest = data[:size], data[size:]
        if rest:
            self._waiting.appendleft((0.0, rest))
        self._waiting_bytes -= len(piece)
        if self._waiting_bytes <= MAX_WAITING_BYTES:
            self.transport.resume_reading()
        if slow is not None:
            self._counts["slowloris"] += 1
            self._next_write_s = now_s + 1.0 / slow.bytes_per_s
        elif fragment is not None:
            self._counts["fragment"] += 1
        if self.way == "to_client":
            self._proxy.pass_on(piece, other.transport)
        else:
            other.transport.write(piece)

    def _finish(self, other: "Pipe") -> None:
        self._is_done = True
        other.send_end()
        if other._is_done:
            self._proxy.forget(self)
            self.transport.close()
            other.transport.close()

    def _forget(self) -> None:
        self._waiting.clear()
        self._waiting_bytes = 0

    def shut(self) -> None:
        """Discard the queue and send the end now; no data follow."""
        self._forget()
        self._is_shut = True
        if self.other is not None:
            self.other.send_end()

    def send_end(self) -> None:
        """Send FIN to the peer."""
        with contextlib.suppress(OSError):  # the peer may be gone already
            if not self.transport.is_closing():
                self.transport.write_eof()

    def reset(self) -> None:
        """End the connection to the peer by RST, now."""
        if not self.transport.is_closing():
            peer = self.transport.get_extra_info("socket")
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RST_ON_CLOSE)
            self.transport.abort()


class FaultProxy:
    """A proxy for one server; an asynchronous context manager.

    A lasting fault acts on present and new connections from ``switch_on`` to ``heal``; ``reset`` and ``close`` act at
    once. ``listener`` is a bound socket; by default a free port of 127.0.0.1. ``counts``: actual effects, by type of
    fault: affected lines, writes, lost bytes, ended connections; also accepted ``connections`` and connections
    ``refused`` because the server could not be reached.
    """

    def __init__(self, host: str, port: int, *, seed: int, listener: socket.socket | None = None) -> None:
        self._address, self._listener = (host, port), listener
        self.rng = random.Random(seed)
        self.faults: dict[OneWay, OneWayFaults] = {way: {} for way in _BOTH}  # active ones
        self.connections: list[tuple[Pipe, Pipe]] = []  # both ends of each present connection
        self._tasks: set[asyncio.Task[None]] = set()
        self._reset_after_bytes: int | None = None
        self.port = 0
        self.counts: Counter[str] = Counter()
        self.passed_bytes = self.passed_lines = 0

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        listener = self._listener or socket.create_server(("127.0.0.1", 0))
        self._server = await loop.create_server(lambda: Pipe(self, "to_robot"), sock=listener)
        self.port = int(listener.getsockname()[1])
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        tasks = [*self._tasks]
        for task in tasks:
            task.cancel()
        for pipe in self._pipes():
            pipe.transport.abort()
        await asyncio.gather(*tasks, return_exceptions=True)
        await asyncio.sleep(0)  # the transports close
        await self._server.wait_closed()

    def _pipes(self) -> list[Pipe]:
        return [pipe for pipes in self.connections for pipe in pipes]

    def connect(self, client: Pipe) -> None:
        """Connect a new client to the server."""
        task = asyncio.get_running_loop().create_task(self._connect(client))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _connect(self, client: Pipe) -> None:
        try:
            _, server = await asyncio.get_running_loop().create_connection(
                lambda: Pipe(self, "to_client", client), *self._address
            )
        except OSError:
            self.counts["refused"] += 1
            client.transport.abort()
            return
        self.connections.append((client, server))
        self.counts["connections"] += 1
        client.transport.resume_reading()
        client.send()
        client.flood()
        server.flood()

    def forget(self, pipe: Pipe) -> None:
        """Remove a connection of which both ends have ended."""
        self.connections = [pipes for pipes in self.connections if pipe not in pipes]

    def pass_on(self, data: bytes, client: asyncio.Transport) -> None:
        """Write to a client and count it; at the limit of ``reset_after`` only up to the limit, then reset."""
        limit = self._reset_after_bytes
        is_last = limit is not None and self.passed_bytes + len(data) >= limit
        if limit is not None and is_last:
            data = data[: limit - self.passed_bytes]
            self._reset_after_bytes = None
        self.passed_bytes += len(data)
        self.passed_lines += data.count(b"\n")
        client.write(data)
        if is_last:
            self.reset()

    def reset(self) -> None:
        """Break every connection by RST, on both sides."""
        self.counts["reset"] += len(self.connections)
        for pipe in self._pipes():
            pipe.reset()

    def reset_after(self, passed_bytes: int) -> None:
        """Call ``reset`` after exactly so many bytes to the clients, counted over all connections."""
        self._reset_after_bytes = passed_bytes

    def close(self) -> None:
        """End every connection by FIN, on both sides; data in the queues of the proxy are lost.

        Later data are read and discarded, because a socket that is closed with unread bytes sends RST.
        """
        self.counts["close"] += len(self.connections)
        for pipe in self._pipes():
            pipe.shut()

    def switch_on(self, fault: Any) -> None:
        """Switch on a fault of a plan, of any type."""
        if fault.type in _AT_ONCE:
            (self.reset if fault.type == "reset" else self.close)()
            return
        for way in _BOTH:
            if fault.direction in {way, "both"}:
                self.faults[way][fault.type] = fault
        if fault.type == "flood":
            for pipe in self._pipes():
                pipe.flood()

    def heal(self, direction: Direction = "both", name: str | None = None) -> None:
        """End all lasting faults, or those of one type; stalled data are sent in one burst."""
        for way in _BOTH:
            if direction in {way, "both"}:
                for kind in [kind for kind in self.faults[way] if name in {None, kind}]:
                    del self.faults[way][kind]
        for pipe in self._pipes():
            pipe.send()


class LinkFaults:
    """Faults of the link, switched by the robot's clock."""

    def __init__(self, plan: tuple[LinkFault, ...], proxy: FaultProxy) -> None:
        self._proxy = proxy
        self._records = tuple(map(Injected, plan))
        self._counts_before = dict.fromkeys(self._records, 0)
        for record in self._records:
            if _is_armed(record.fault):
                proxy.reset_after(record.fault.after_bytes)

    @property
    def injected(self) -> tuple[Injected, ...]:
        """The record of each fault, in the order of the plan."""
        for record in self._records:
            if record.from_s is not None and record.until_s is None:
                self._count(record)
        return self._records

    def changes(self, t_s: float) -> list[tuple[str, Injected]]:
        """Begin and end the faults that are due at a robot time; return those that began (``begins``) or ``ended``."""
        news = []
        for record in self._records:
            fault = record.fault
            if record.from_s is None and self._is_due(fault, t_s):
                record.from_s = t_s
                if not _is_armed(fault):
                    self._counts_before[record] = self._proxy.counts[fault.type]
                    self._proxy.switch_on(fault)
                if fault.type in _AT_ONCE:
                    record.until_s = t_s
                self._count(record)
                news.append(("begins", record))
            elif record.from_s is not None and record.until_s is None and t_s >= record.from_s + (fault.for_s or inf):
                self._count(record)
                record.until_s = t_s
                self._proxy.heal(fault.direction, fault.type)
                news.append(("ended", record))
        return news

    def _is_due(self, fault: LinkFault, t_s: float) -> bool:
        if fault.at_s is not None:
            return t_s >= fault.at_s
        if fault.after_lines is not None:
            return self._proxy.passed_lines >= fault.after_lines
        return fault.after_bytes is not None and self._proxy.passed_bytes >= fault.after_bytes

    def _count(self, record: Injected) -> None:
        record.samples = record.changed = self._proxy.counts[record.fault.type] - self._counts_before[record]


def _is_armed(fault: LinkFault) -> bool:
    """Whether it is a reset after so many bytes, which the proxy itself does at the exact byte."""
    return fault.type == "reset" and fault.after_bytes is not None
