"""A TCP proxy that passes everything on between clients and a server until a fault is switched on.

The faults of the link in a fault plan switch it by the robot's clock, and are recorded.
"""

import asyncio
import contextlib
import random
import socket
import struct
from collections import Counter, deque
from collections.abc import Callable
from math import inf
from typing import Any, Literal, Self, cast

from ccatp.sim.fault_plan import LINK_TYPES, Direction, Injected, InjectionRecord, LinkFault

OneWay = Literal["to_client", "to_robot"]
OneWayFaults = dict[str, Any]
"""What is switched on in one direction, one fault of each type."""

READ_BYTES = 65536
# While nothing goes out, no more than this is taken in: then the sender feels it.
MAX_WAITING_BYTES = 8 << 20
_LF = b"\n"
_GARBAGE_LINE_BYTES = 64
_LINE_FAULTS = ("reorder", "duplicate", "corrupt", "garbage", "flood")
_AT_ONCE = ("reset", "close")
_BOTH: tuple[OneWay, OneWay] = ("to_client", "to_robot")
_FLOOD_PERIOD_S = 0.005
_RST_ON_CLOSE = struct.pack("ii", 1, 0)  # SO_LINGER: on, for 0 s


class LineStage:
    """Cuts a stream into lines where a fault acts on lines, and applies the faults."""

    def __init__(self, faults: OneWayFaults, counts: "Counter[str]", rng: random.Random) -> None:
        self._faults, self._counts, self._rng = faults, counts, rng
        self._rest = self._withheld = b""
        self._seen: Counter[str] = Counter()
        self._last = b""

    def feed(self, data: bytes) -> list[bytes]:
        """What goes on when ``data`` came in, in pieces; between two of them a line ends."""
        if self._faults.keys().isdisjoint(_LINE_FAULTS):
            found, self._rest, self._withheld = self._rest + data + self._withheld, b"", b""
            return [found]
        *lines, self._rest = (self._rest + data).split(_LF)  # ``splitlines`` would cut at CR, too
        return [piece for line in lines for piece in self._treat(line + _LF)]

    def finish(self) -> bytes:
        """What is left at the end of the stream."""
        found, self._rest, self._withheld = self._rest + self._withheld, b"", b""
        return found

    def flood_line(self) -> bytes:
        """One further line."""
        if self._faults["flood"].lines == "copies" and self._last:
            return self._last
        return self._garbage(_GARBAGE_LINE_BYTES)

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
        """Whether this line is an n-th one; counts it then."""
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
        """Another byte in one place of the line, which stays one line."""
        if line == _LF:
            return line
        at = self._rng.randrange(len(line) - 1)
        other = [byte for byte in range(256) if byte not in {line[at], _LF[0]}]
        return line[:at] + bytes((self._rng.choice(other),)) + line[at + 1 :]


class Pipe:
    """One direction of a connection: reader, queue, writer, and the faults switched on in it.

    ``may_write`` returns the part of a write that may go out; the rest is dropped.
    """

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        faults: OneWayFaults,
        counts: "Counter[str]",
        rng: random.Random,
        may_write: Callable[[bytes], bytes],
    ) -> None:
        self._reader, self._writer, self._faults, self._counts, self._rng = reader, writer, faults, counts, rng
        self._may_write = may_write
        self._stage = LineStage(faults, counts, rng)
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._waiting_bytes = 0
        self._due_s = 0.0
        self._is_at_end = self._is_shut = False
        self._changed = asyncio.Event()

    def wake(self) -> None:
        """The faults have changed."""
        self._changed.set()

    def put(self, data: bytes) -> None:
        """Let something wait for its time to go out; what is over the limit is lost."""
        if not data or self._is_shut or self._waiting_bytes + len(data) > 2 * MAX_WAITING_BYTES:
            return
        now_s, late_s = asyncio.get_running_loop().time(), 0.0
        delay = self._faults.get("delay")
        if delay is not None:
            late_s = delay.delay_s + (delay.jitter_s * self._rng.random() if delay.jitter_s else 0.0)
        if late_s:
            self._counts["delay"] += 1
        self._due_s = max(self._due_s, now_s + late_s)
        self._waiting.append((self._due_s, data))
        self._waiting_bytes += len(data)
        self.wake()

    def shut(self) -> None:
        """Send the end now; nothing goes out any more."""
        self._is_shut = True
        self._waiting.clear()
        self._waiting_bytes = 0
        self._send_end()
        self.wake()

    def abort(self) -> None:
        """End the connection to whom it sends, now."""
        self._writer.transport.abort()

    def reset(self) -> None:
        """The same by RST."""
        peer = self._writer.get_extra_info("socket")
        if not self._writer.is_closing() and peer is not None:
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RST_ON_CLOSE)
        self.abort()
        self.wake()

    def flood(self, lines: int) -> None:
        """Let further lines wait, after what waits already."""
        self._counts["flood"] += lines
        self.put(b"".join(self._stage.flood_line() for _ in range(lines)))

    async def receive(self) -> None:
        """Take in until the sender ends or is gone."""
        while data := await self._read():
            if "black_hole" in self._faults:
                self._counts["black_hole"] += len(data)
                continue
            for piece in self._stage.feed(data):
                self.put(piece)
            while self._waiting_bytes > MAX_WAITING_BYTES:
                await self._change()
        while "black_hole" in self._faults and not self._writer.is_closing():
            await self._change()
        self.put(self._stage.finish())
        self._is_at_end = True
        self.wake()

    async def send(self) -> None:
        """Give out until the end."""
        while (data := await self._next()) is not None:
            await self._write(data)
        if not self._is_shut:
            self._send_end()

    def _send_end(self) -> None:
        if self._writer.can_write_eof() and not self._writer.is_closing():
            with contextlib.suppress(OSError):  # the peer may be gone already
                self._writer.write_eof()

    async def _read(self) -> bytes:
        try:
            return await self._reader.read(READ_BYTES)
        except ConnectionError:
            return b""

    async def _change(self) -> None:
        self._changed.clear()
        await self._changed.wait()

    async def _next(self) -> bytes | None:
        """What is due, all of it in one piece; ``None`` at the end."""
        loop = asyncio.get_running_loop()
        while True:
            if "stall" in self._faults or not self._waiting:
                if self._is_at_end and not self._waiting:
                    return None
                if self._waiting:
                    self._counts["stall"] += 1
                await self._change()
                continue
            early_s = self._waiting[0][0] - loop.time()
            if early_s <= 0.0:
                break
            await asyncio.sleep(early_s)
        now_s, found = loop.time(), b""
        while self._waiting and self._waiting[0][0] <= now_s:
            found += self._waiting.popleft()[1]
        self._waiting_bytes -= len(found)
        self.wake()  # there is room again
        return found

    async def _write(self, data: bytes) -> None:
        while data and not self._is_shut:
            slow, fragment = self._faults.get("slowloris"), self._faults.get("fragment")
            size = len(data) if fragment is None else fragment.write_bytes
            piece = data[: size if slow is None else 1]
            part = self._may_write(piece)
            try:
                self._writer.write(part)
                await self._writer.drain()
            except ConnectionError:
                return
            if len(part) < len(piece):  # the rest never goes out: see ``FaultProxy.reset_after``
                return
            data = data[len(piece) :]
            if slow is not None:
                self._counts["slowloris"] += 1
                await asyncio.sleep(1.0 / slow.bytes_per_s)
            elif fragment is not None:
                self._counts["fragment"] += 1
                await asyncio.sleep(0)


class FaultProxy:
    """A proxy for one server; an asynchronous context manager.

    A fault that lasts acts on the connections that are and on those to come, from ``begin`` to ``heal``; ``reset`` and
    ``close`` act at once. ``listener`` is a bound socket; any free port of 127.0.0.1 if not given.

    Attributes:
        counts: what was really done, by the types of the faults: lines hit, writes, bytes swallowed, connections
            ended; ``connections`` taken, ``refused`` because the server could not be reached.
        connections: the two pipes of each that there is now.
    """

    def __init__(self, host: str, port: int, *, seed: int, listener: socket.socket | None = None) -> None:
        self._address, self._own_listener = (host, port), listener
        self._rng = random.Random(seed)
        self._faults: dict[OneWay, OneWayFaults] = {way: {} for way in _BOTH}
        self.connections: list[dict[OneWay, Pipe]] = []
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

    def _pipes(self) -> list[Pipe]:
        return [pipe for pipes in self.connections for pipe in pipes.values()]

    async def stop(self) -> None:
        """End everything."""
        if self._server is not None:
            self._server.close()
        tasks = [*self._handlers, *([self._flooding] if self._flooding else [])]
        for task in tasks:
            task.cancel()
        for pipe in self._pipes():
            pipe.abort()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._server is not None:
            await self._server.wait_closed()
            self._server = None

    def reset(self) -> None:
        """Break every connection by RST, on both sides."""
        self.counts["reset"] += len(self.connections)
        for pipe in self._pipes():
            pipe.reset()

    def reset_after(self, passed_bytes: int) -> None:
        """The same as soon as exactly so many bytes have gone to the clients, counted over all connections."""
        self._reset_after_bytes = passed_bytes

    def close(self) -> None:
        """End every connection by FIN, on both sides, after what is on its way out of the proxy.

        What they still send is read and forgotten: a socket closed over unread bytes sends RST.
        """
        self.counts["close"] += len(self.connections)
        for pipe in self._pipes():
            pipe.shut()

    def begin(self, name: str, direction: Direction = "both", **values: Any) -> None:
        """Switch on a fault that lasts: a type of the fault plan and its keys."""
        self.switch_on(LINK_TYPES[name].model_validate({"type": name, "direction": direction, **values}))

    def switch_on(self, fault: Any) -> None:
        """The same with the fault of a plan, whatever its type."""
        if fault.type in _AT_ONCE:
            (self.reset if fault.type == "reset" else self.close)()
            return
        for way in _BOTH:
            if fault.direction in {way, "both"}:
                self._faults[way][fault.type] = fault
        self._wake()
        if fault.type == "flood" and (self._flooding is None or self._flooding.done()):
            self._flooding = asyncio.get_running_loop().create_task(self._flood())

    def heal(self, direction: Direction = "both", name: str | None = None) -> None:
        """End every fault that lasts, or that of one type; what was stalled goes in one burst."""
        for way in _BOTH:
            if direction in {way, "both"}:
                for kind in [kind for kind in self._faults[way] if name in {None, kind}]:
                    del self._faults[way][kind]
        self._wake()

    def _wake(self) -> None:
        for pipe in self._pipes():
            pipe.wake()

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
        pipes: dict[OneWay, Pipe] = {
            "to_robot": self._pipe("to_robot", reader, server),
            "to_client": self._pipe("to_client", server_reader, client),
        }
        self.connections.append(pipes)
        self.counts["connections"] += 1
        try:
            async with asyncio.TaskGroup() as tasks:
                for pipe in pipes.values():
                    tasks.create_task(pipe.receive())
                    tasks.create_task(pipe.send())
        finally:
            self.connections.remove(pipes)
            client.close()
            server.close()

    def _pipe(self, way: OneWay, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> Pipe:
        may_write = self._passing if way == "to_client" else bytes
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
        while any("flood" in faults for faults in self._faults.values()):
            await asyncio.sleep(_FLOOD_PERIOD_S)
            now_s = clock()
            for way in _BOTH:
                flood = self._faults[way].get("flood")
                if flood is None:
                    continue
                owed[way] += (now_s - before_s) * flood.rate_hz
                lines, owed[way] = int(owed[way]), owed[way] % 1.0
                for pipes in self.connections if lines else ():
                    pipes[way].flood(lines)
            before_s = now_s


class LinkFaults:
    """Faults of the link, ruled by the robot's clock."""

    def __init__(self, plan: tuple[LinkFault, ...], proxy: FaultProxy) -> None:
        self._proxy = proxy
        self._records = [InjectionRecord(fault) for fault in plan]
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
        return tuple(record.injected for record in self._records)

    def changes(self, t_s: float) -> list[tuple[str, Injected]]:
        """Begin and end what is due at a robot time; what began (``begins``) and ended (``ended``)."""
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
                news.append(("begins", record.injected))
            elif record.from_s is not None and record.until_s is None and t_s >= record.from_s + (fault.for_s or inf):
                self._count(record)
                record.until_s = t_s
                self._proxy.heal(fault.direction, fault.type)
                news.append(("ended", record.injected))
        return news

    def _is_due(self, fault: LinkFault, t_s: float) -> bool:
        if fault.at_s is not None:
            return t_s >= fault.at_s
        if fault.after_lines is not None:
            return self._proxy.passed_lines >= fault.after_lines
        return fault.after_bytes is not None and self._proxy.passed_bytes >= fault.after_bytes

    def _count(self, record: InjectionRecord) -> None:
        record.samples = record.changed = self._proxy.counts[record.fault.type] - self._counts_before[record]


def _is_armed(fault: LinkFault) -> bool:
    """A reset after so many bytes: the proxy itself waits for the moment, to the byte."""
    return fault.type == "reset" and fault.after_bytes is not None
