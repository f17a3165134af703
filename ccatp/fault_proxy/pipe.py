"""Edge. One direction of one connection through the proxy: a reader, what waits, and a writer."""

import asyncio
import contextlib
import random
from collections import Counter, deque
from collections.abc import Callable

from ccatp.fault_proxy.conduct import Conduct, LineStage

READ_BYTES = 65536
# While nothing goes out, no more than this is taken in: then the sender feels it.
MAX_WAITING_BYTES = 8 << 20


class Pipe:
    """One direction.

    Args:
        reader: where bytes come from.
        writer: where they go to.
        conduct: how they are treated.
        counts: of what was done.
        rng: draws delays, bytes, places.
        may_write: is asked at every write what of it may go out; the rest never does.
    """

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        conduct: Conduct,
        counts: "Counter[str]",
        rng: random.Random,
        may_write: Callable[[bytes], bytes],
    ) -> None:
        self._reader, self._writer, self._conduct, self._counts, self._rng = reader, writer, conduct, counts, rng
        self._may_write = may_write
        self._stage = LineStage(conduct, counts, rng)
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._waiting_bytes = 0
        self._due_s = 0.0
        self._is_at_end = self._is_shut = False
        self._changed = asyncio.Event()

    def wake(self) -> None:
        """The conduct has changed."""
        self._changed.set()

    def put(self, data: bytes) -> None:
        """Let something wait for its time to go out; what is over the limit is lost."""
        if not data or self._is_shut or self._waiting_bytes + len(data) > 2 * MAX_WAITING_BYTES:
            return
        conduct, now_s = self._conduct, asyncio.get_running_loop().time()
        late_s = conduct.delay_s + conduct.jitter_s * self._rng.random() if conduct.jitter_s else conduct.delay_s
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
            if self._conduct.is_black_hole:
                self._counts["black_hole"] += len(data)
                continue
            for piece in self._stage.feed(data):
                self.put(piece)
            while self._waiting_bytes > MAX_WAITING_BYTES:
                await self._change()
        while self._conduct.is_black_hole and not self._writer.is_closing():
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
            with contextlib.suppress(OSError):  # it may be gone without us having heard
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
            if self._conduct.is_stalled or not self._waiting:
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
            conduct = self._conduct
            size = 1 if conduct.bytes_per_s else conduct.write_bytes or len(data)
            part = self._may_write(data[:size])
            try:
                self._writer.write(part)
                await self._writer.drain()
            except ConnectionError:
                return
            if len(part) < len(data[:size]):  # the rest never goes out: see ``FaultProxy.reset_after``
                return
            data = data[size:]
            if conduct.bytes_per_s:
                self._counts["slowloris"] += 1
                await asyncio.sleep(1.0 / conduct.bytes_per_s)
            elif conduct.write_bytes:
                self._counts["fragment"] += 1
                await asyncio.sleep(0)
