"""Pure. Lines that are said again and again: which are of one kind, and how many of them are told."""

import re

# Not those in the names of points and addresses: another point is another matter.
_NUMBER = re.compile(r"(?<![\w./:-])\d+(?:\.\d+)?(?![\w/:-]|\.\d)")


def kind_of(text: str) -> str:
    """The text without its numbers: lines with the same are of one kind."""
    return _NUMBER.sub("#", text)


class LineBudget:
    """So many lines in a period, and a count of those that were left out.

    Args:
        lines: at most so many ...
        period_s: ... in this time.
    """

    def __init__(self, lines: int, period_s: float) -> None:
        self._lines, self._period_s = lines, period_s
        self._begun_s, self._used, self._left_out = float("-inf"), 0, 0

    def take(self, now_s: float) -> int | None:
        """Ask for a line: how many were left out since the last one, or ``None`` when this one is left out, too."""
        if now_s - self._begun_s >= self._period_s:
            self._begun_s, self._used = now_s, 0
        if self._used >= self._lines:
            self._left_out += 1
            return None
        self._used += 1
        left_out, self._left_out = self._left_out, 0
        return left_out


class Sparing:
    """Lines for a terminal: a few of each kind in a period, and how many like it were left out before.

    Args:
        lines: of each kind ...
        period_s: ... in this time.
    """

    def __init__(self, lines: int, period_s: float) -> None:
        """Nothing said."""
        self._lines, self._period_s = lines, period_s
        self._budgets: dict[str, LineBudget] = {}

    def take(self, level: str, text: str, now_s: float) -> str | None:
        """The line as it is told; ``None`` where it is left out. Errors are all told.

        Args:
            level: of the line.
            text: what it says.
            now_s: time of any clock that only goes forward.
        """
        if level == "error":
            return text
        budget = self._budgets.setdefault(f"{level} {kind_of(text)}", LineBudget(self._lines, self._period_s))
        left_out = budget.take(now_s)
        if left_out is None:
            return None
        return f"{text} ({left_out} more times)" if left_out else text
