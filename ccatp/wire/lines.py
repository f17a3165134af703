"""Pure. Lines out of a byte stream with a hard limit, and the count of bad ones."""

from collections import deque

MAX_LINE_BYTES = 8192


class LineTooLong(ValueError):
    """A line over the limit; the session that sent it is of no further use.

    Attributes:
        lines: the whole lines that came before it, without their LF.
    """

    def __init__(self, limit: int, lines: list[bytes]) -> None:
        super().__init__(f"line of more than {limit} bytes")
        self.lines = lines


class LineBuffer:
    """Cuts a byte stream into lines, however it was chopped on its way.

    Args:
        limit: most bytes of a line, its LF not counted. No more than this is ever kept between two calls.
    """

    __slots__ = ("_limit", "_rest")

    def __init__(self, limit: int = MAX_LINE_BYTES) -> None:
        self._limit = limit
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Whole lines, without their LF, after ``data`` was appended.

        Raises:
            LineTooLong: a line, finished or not, is over the limit; it carries the lines before it.
        """
        if self._rest:
            data = self._rest + data
        lines = data.split(b"\n")
        self._rest = lines.pop()
        limit = self._limit
        if len(data) > limit:  # else no line in it can be longer
            for k, line in enumerate((*lines, self._rest)):
                if len(line) > limit:
                    self._rest = b""
                    raise LineTooLong(limit, lines[:k])
        return lines


class LineBudget:
    """So many lines at once, so many a second in the long run; more is a flood.

    Args:
        lines: taken at once.
        rate_hz: at which lines may come in the long run.
    """

    __slots__ = ("_left", "_lines", "_rate_hz", "_then_s")

    def __init__(self, lines: float, rate_hz: float) -> None:
        self._lines = self._left = lines
        self._rate_hz = rate_hz
        self._then_s = 0.0

    def take(self, lines: int, now_s: float) -> bool:
        """Take lines at ``now_s``; false when there are not so many left."""
        self._left = min(self._lines, self._left + self._rate_hz * (now_s - self._then_s)) - lines
        self._then_s = now_s
        return self._left >= 0.0


class BadLineCounter:
    """Counts bad lines and tells when there are too many of them in a window of time.

    Args:
        limit: this many within the window are tolerated.
        window_s: length of the window, s.
    """

    __slots__ = ("_limit", "_times_s", "_window_s", "total")

    def __init__(self, limit: int = 20, window_s: float = 1.0) -> None:
        self._limit, self._window_s = limit, window_s
        self._times_s: deque[float] = deque(maxlen=limit + 1)
        self.total = 0

    def add(self, now_s: float) -> bool:
        """Count one bad line at ``now_s``; true when the session has to be closed."""
        self.total += 1
        self._times_s.append(now_s)
        return len(self._times_s) > self._limit and now_s - self._times_s[0] <= self._window_s
