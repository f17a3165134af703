"""One direction of a connection through the fault proxy: reader, queue, writer, and the faults switched on in it."""

import asyncio
import contextlib
import random
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

FloodLines = Literal["garbage", "copies"]

_LF = b"\n"
_GARBAGE_LINE_BYTES = 64


@dataclass(slots=True)
class NetworkFaults:
    """What is switched on in one direction, for the connections that are and for those to come.

    Attributes:
        delay_s, jitter_s: everything is late by so much, and by up to so much more.
        reorder_every, duplicate_every, corrupt_every: the n-th lines that are hit; 0: none.
        garbage_every, garbage_bytes: the n-th lines before which there is a line of so many random bytes.
        write_bytes: size of a write; 0: whatever there is.
        bytes_per_s: rate of single bytes; 0: no limit.
        flood_hz, flood_lines: rate and kind of further lines; 0: none.
    """

    is_black_hole: bool = False
    is_stalled: bool = False
    delay_s: float = 0.0
    jitter_s: float = 0.0
    reorder_every: int = 0
    duplicate_every: int = 0
    corrupt_every: int = 0
    garbage_every: int = 0
    garbage_bytes: int = 0
    write_bytes: int = 0
    bytes_per_s: float = 0.0
    flood_hz: float = 0.0
    flood_lines: FloodLines = "garbage"

    @property
    def acts_on_lines(self) -> bool:
        """Whether the stream has to be cut into lines."""
        return bool(
            self.reorder_every or self.duplicate_every or self.corrupt_every or self.garbage_every or self.flood_hz
        )


class LineStage:
    """Cuts a stream into lines where a fault acts on lines, and applies the faults."""

    def __init__(self, faults: NetworkFaults, counts: "Counter[str]", rng: random.Random) -> None:
        self._faults, self._counts, self._rng = faults, counts, rng
        self._rest = self._withheld = b""
        self._seen: Counter[str] = Counter()
        self._last = b""

    def feed(self, data: bytes) -> list[bytes]:
        """What goes on when ``data`` came in, in pieces; between two of them a line ends."""
        if not self._faults.acts_on_lines:
            found, self._rest, self._withheld = self._rest + data + self._withheld, b"", b""
            return [found]
        lines = _split(self._rest + data)
        self._rest = b"" if not lines or lines[-1].endswith(_LF) else lines.pop()
        return [piece for line in lines for piece in self._treat(line)]

    def finish(self) -> bytes:
        """What is left at the end of the stream."""
        found, self._rest, self._withheld = self._rest + self._withheld, b"", b""
        return found

    def flood_line(self) -> bytes:
        """One further line."""
        if self._faults.flood_lines == "copies" and self._last:
            return self._last
        return self._garbage(_GARBAGE_LINE_BYTES)

    def _treat(self, line: bytes) -> list[bytes]:
        faults = self._faults
        self._last = line
        found: list[bytes] = []
        if self._is_hit("garbage", faults.garbage_every):
            found.append(self._garbage(faults.garbage_bytes))
        if self._is_hit("corrupt", faults.corrupt_every):
            line = self._corrupt(line)
        if self._withheld:
            found += [line, self._withheld]
            self._withheld = b""
        elif self._is_hit("reorder", faults.reorder_every):
            self._withheld = line
            return found
        else:
            found.append(line)
        if self._is_hit("duplicate", faults.duplicate_every):
            found.append(line)
        return found

    def _is_hit(self, name: str, every: int) -> bool:
        """Whether this line is an n-th one; counts it then."""
        if not every:
            return False
        self._seen[name] += 1
        if self._seen[name] % every:
            return False
        self._counts[name] += 1
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


def _split(data: bytes) -> list[bytes]:
    """Lines that end in LF alone; ``splitlines`` would cut at CR, too."""
    lines = [line + _LF for line in data.split(_LF)]
    lines[-1] = lines[-1][:-1]
    return lines if lines[-1] else lines[:-1]


READ_BYTES = 65536
# While nothing goes out, no more than this is taken in: then the sender feels it.
MAX_WAITING_BYTES = 8 << 20


class Pipe:
    """One direction.

    Args:
        may_write: returns the part of a write that may go out; the rest is dropped.
    """

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        faults: NetworkFaults,
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
        faults, now_s = self._faults, asyncio.get_running_loop().time()
        late_s = faults.delay_s + faults.jitter_s * self._rng.random() if faults.jitter_s else faults.delay_s
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

    def flood(self, lines: int) -> None:
        """Let further lines wait, after what waits already."""
        self._counts["flood"] += lines
        self.put(b"".join(self._stage.flood_line() for _ in range(lines)))

    async def receive(self) -> None:
        """Take in until the sender ends or is gone."""
        while data := await self._read():
            if self._faults.is_black_hole:
                self._counts["black_hole"] += len(data)
                continue
            for piece in self._stage.feed(data):
                self.put(piece)
            while self._waiting_bytes > MAX_WAITING_BYTES:
                await self._change()
        while self._faults.is_black_hole and not self._writer.is_closing():
            await self._change()
        self.put(self._stage.finish())
        self._is_at_end = True
        self.wake()

    async def send(self) -> None:
        """Give out until the end."""
        while True:
            data = await self._next()
            if data is None:
                break
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
            if self._faults.is_stalled or not self._waiting:
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
            faults = self._faults
            size = 1 if faults.bytes_per_s else faults.write_bytes or len(data)
            part = self._may_write(data[:size])
            try:
                self._writer.write(part)
                await self._writer.drain()
            except ConnectionError:
                return
            if len(part) < len(data[:size]):  # the rest never goes out: see ``FaultProxy.reset_after``
                return
            data = data[size:]
            if faults.bytes_per_s:
                self._counts["slowloris"] += 1
                await asyncio.sleep(1.0 / faults.bytes_per_s)
            elif faults.write_bytes:
                self._counts["fragment"] += 1
                await asyncio.sleep(0)
