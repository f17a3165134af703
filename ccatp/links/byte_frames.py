"""Finds frames with a fixed start, a length and a check sum in bytes that arrive in pieces of any size."""

from abc import ABC, abstractmethod
from collections import Counter


class FrameFinder(ABC):
    """What a protocol adds: how long a frame is, and whether its check sum is right. It stores less than one frame.

    Attributes:
        counts: ``frames``, ``bad_sums``, ``noise`` (bytes).
    """

    START: bytes

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.counts: Counter[str] = Counter()

    @abstractmethod
    def _size(self, data: bytearray) -> int:
        """Bytes of the frame that these begin; 0: not known yet, negative: no frame can begin so."""

    @abstractmethod
    def _is_right(self, frame: bytes) -> bool:
        """Whether the check sum is right."""

    def find(self, data: bytes) -> list[bytes]:
        """Each frame that is complete now."""
        buffer, frames = self._buffer, list[bytes]()
        buffer += data
        while (start := buffer.find(self.START)) >= 0:
            self.drop(start)
            size = self._size(buffer)
            if size < 0:
                self.drop_start()
                continue
            if not size or len(buffer) < size:
                return frames
            frame = bytes(buffer[:size])
            if not self._is_right(frame):
                self.counts["bad_sums"] += 1
                self.drop_start()
                continue
            del buffer[:size]
            self.counts["frames"] += 1
            frames.append(frame)
        self.drop(len(buffer) - buffer.endswith(self.START[:1]))
        return frames

    def drop_start(self) -> None:
        """No frame begins here; the next one may begin within what follows."""
        self.drop(1)

    def drop(self, count: int) -> None:
        """Count bytes as noise."""
        self.counts["noise"] += count
        del self._buffer[:count]
