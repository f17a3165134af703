"""Edge. How one direction of the proxy treats what passes: what is switched on, and what it does to lines."""

import random
from collections import Counter
from dataclasses import dataclass
from typing import Literal

FloodLines = Literal["garbage", "copies"]

_LF = b"\n"
_GARBAGE_LINE_BYTES = 64


@dataclass(slots=True)
class Conduct:
    """What is switched on in one direction, for the connections that are and for those to come.

    Attributes:
        is_black_hole: what comes in disappears.
        is_stalled: nothing goes out.
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
    """Cuts a stream into lines where the conduct asks for it, and does to them what it says.

    Args:
        conduct: what is switched on.
        counts: of what was done, by the names of the methods of the proxy.
        rng: draws bytes and places.
    """

    def __init__(self, conduct: Conduct, counts: "Counter[str]", rng: random.Random) -> None:
        self._conduct, self._counts, self._rng = conduct, counts, rng
        self._rest = self._withheld = b""
        self._seen: Counter[str] = Counter()
        self._last = b""

    def feed(self, data: bytes) -> list[bytes]:
        """What goes on when ``data`` came in, in pieces; between two of them a line ends."""
        if not self._conduct.acts_on_lines:
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
        if self._conduct.flood_lines == "copies" and self._last:
            return self._last
        return self._garbage(_GARBAGE_LINE_BYTES)

    def _treat(self, line: bytes) -> list[bytes]:
        conduct = self._conduct
        self._last = line
        found: list[bytes] = []
        if self._is_hit("garbage", conduct.garbage_every):
            found.append(self._garbage(conduct.garbage_bytes))
        if self._is_hit("corrupt", conduct.corrupt_every):
            line = self._corrupt(line)
        if self._withheld:
            found += [line, self._withheld]
            self._withheld = b""
        elif self._is_hit("reorder", conduct.reorder_every):
            self._withheld = line
            return found
        else:
            found.append(line)
        if self._is_hit("duplicate", conduct.duplicate_every):
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
