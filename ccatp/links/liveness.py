"""Liveness of a run (both loops publish, have joined the robot, and get its frames), and rate limits of log lines."""

import re

from ccatp.links.topics import BY_NAME, Heartbeat

LOOPS = ("main", "danger")
STALE_AFTER_S = min(BY_NAME[f"heartbeat.{name}"].stale_after_s for name in LOOPS)


class Liveness:
    """The newest heartbeat of each loop. A heartbeat or frame older than ``stale_after_s`` does not count."""

    def __init__(self, stale_after_s: float = STALE_AFTER_S) -> None:
        self._stale_after_s = stale_after_s
        self.heartbeats: dict[str, Heartbeat] = {}

    def update(self, heartbeat: Heartbeat) -> None:
        """Take a heartbeat. Its age is that by its own time stamp, so the time in a queue counts."""
        self.heartbeats[heartbeat.process] = heartbeat

    @property
    def has_joined(self) -> bool:
        """Whether both loops have joined the robot."""
        return all(name in self.heartbeats and self.heartbeats[name].phase in ("joined", "done") for name in LOOPS)

    def trouble(self, now_s: float) -> str:
        """What is wrong, or an empty text."""
        for name in LOOPS:
            heartbeat = self.heartbeats.get(name)
            if heartbeat is None:
                return f"{name} has sent no heartbeat"
            age_s = now_s - heartbeat.t_s
            if age_s > self._stale_after_s:
                return f"{name} sent its last heartbeat {age_s:.1f} s ago"
            if heartbeat.phase == "joined":
                if heartbeat.frame_age_s is None:
                    return f"{name} has had no frame from the robot yet"
                if heartbeat.frame_age_s + age_s > self._stale_after_s:
                    return f"{name} had its last frame from the robot {heartbeat.frame_age_s + age_s:.1f} s ago"
        return ""


# Not those in the names of points and addresses, which distinguish lines.
_NUMBER = re.compile(r"(?<![\w./:-])\d+(?:\.\d+)?(?![\w/:-]|\.\d)")


def kind_of(text: str) -> str:
    """The text without its numbers. Lines with equal texts are of one kind."""
    return _NUMBER.sub("#", text)


class LogRateLimit:
    """Allows a number of lines in a period, and counts the lines that it suppressed."""

    def __init__(self, lines: int, period_s: float) -> None:
        self._lines, self._period_s = lines, period_s
        self._begun_s, self._used, self._left_out = float("-inf"), 0, 0

    def take(self, now_s: float) -> int | None:
        """The number of lines suppressed since the last allowed one; ``None`` if this line is suppressed, too."""
        if now_s - self._begun_s >= self._period_s:
            self._begun_s, self._used = now_s, 0
        if self._used >= self._lines:
            self._left_out += 1
            return None
        self._used += 1
        left_out, self._left_out = self._left_out, 0
        return left_out


class RateLimitedLog:
    """Lines for a terminal: a few of each kind in a period, with the number of suppressed lines of that kind."""

    def __init__(self, lines: int, period_s: float) -> None:
        self._lines, self._period_s = lines, period_s
        self._budgets: dict[str, LogRateLimit] = {}

    def take(self, level: str, text: str, now_s: float) -> str | None:
        """The line to print at a monotonic time; ``None`` if it is suppressed. Errors are never suppressed."""
        if level == "error":
            return text
        budget = self._budgets.setdefault(f"{level} {kind_of(text)}", LogRateLimit(self._lines, self._period_s))
        left_out = budget.take(now_s)
        if left_out is None:
            return None
        return f"{text} ({left_out} more times)" if left_out else text
