"""Pure. Whether a process that died, or hangs, is started anew: what it ended with, and how often it has happened."""

from collections import defaultdict, deque
from enum import Enum
from typing import NamedTuple

from ccatp.errors import ExitStatus

# It has said why, and would say so again.
FINAL = (ExitStatus.USAGE, ExitStatus.UNREACHABLE)
# As POSIX and Linux number them; what kills processes here.
_SIGNALS = {2: "SIGINT", 3: "SIGQUIT", 6: "SIGABRT", 7: "SIGBUS", 9: "SIGKILL", 11: "SIGSEGV", 15: "SIGTERM"}
# A supervisor that was itself held up for longer than this between two looks has not listened meanwhile.
LONGEST_LOOK_S = 0.2


class Fate(Enum):
    """What becomes of the run."""

    RESTART = "restart"
    END = "end"  # with the status of the process
    HELD = "held"  # with status 4
    WITHOUT = "without"  # it goes on without the process


class Decision(NamedTuple):
    """What becomes of the run, and a line for people."""

    fate: Fate
    text: str


class RestartPolicy:
    """Decides over the processes of one run.

    Args:
        limit: each may be started anew so many times ...
        window_s: ... in this time.
    """

    def __init__(self, limit: int, window_s: float) -> None:
        """Nothing has died."""
        self._limit, self._window_s = limit, window_s
        self._restarts_s: defaultdict[str, deque[float]] = defaultdict(deque)

    def died(
        self, name: str, code: int, now_s: float, *, is_replaceable: bool = True, is_needed: bool = True, why: str = ""
    ) -> Decision:
        """A process has died.

        Args:
            name: of the process.
            code: exit status, or minus the number of the signal that killed it.
            now_s: time of any monotonic clock.
            is_replaceable: another one can take its place.
            is_needed: a run without it is none.
            why: why we killed it, if we did.
        """
        how = why or (f"was killed by {_signal(-code)}" if code < 0 else f"ended with status {code}")
        if code in FINAL:
            if not is_needed:
                return Decision(Fate.WITHOUT, f"process {name} {how}: the survey goes on without it")
            return Decision(Fate.END, f"process {name} {how}")
        if not is_replaceable:
            return Decision(Fate.HELD, f"process {name} {how}: run ended, wheels held")
        restarts_s = self._restarts_s[name]
        while restarts_s and now_s - restarts_s[0] > self._window_s:
            restarts_s.popleft()
        if len(restarts_s) >= self._limit:
            often = f"more than {self._limit} times within {self._window_s:g} s"
            if not is_needed:
                return Decision(Fate.WITHOUT, f"process {name} {how}, {often}: the survey goes on without it")
            return Decision(Fate.HELD, f"process {name} {how}, {often}: run ended, wheels held")
        restarts_s.append(now_s)
        meanwhile = "wheels held meanwhile" if is_needed else "the survey goes on"
        return Decision(Fate.RESTART, f"process {name} {how}: starting it anew, {meanwhile}")


def _signal(number: int) -> str:
    return _SIGNALS.get(number, f"signal {number}")


class SilenceWatch:
    """For how long a process has said nothing while somebody listened.

    Args:
        start_timeout_s: until its first word.
        hang_timeout_s: from word to word.
    """

    def __init__(self, start_timeout_s: float, hang_timeout_s: float) -> None:
        """It was started just now."""
        self._limit_s, self._hang_timeout_s = start_timeout_s, hang_timeout_s
        self._silent_s = 0.0
        self._looked_s: float | None = None

    def heard(self) -> None:
        """It has said something."""
        self._limit_s, self._silent_s = self._hang_timeout_s, 0.0

    def is_hung(self, now_s: float) -> bool:
        """Look once more. Time in which the listener itself stood still does not count."""
        if self._looked_s is not None:
            self._silent_s += min(max(now_s - self._looked_s, 0.0), LONGEST_LOOK_S)
        self._looked_s = now_s
        return self._silent_s > self._limit_s

    @property
    def text(self) -> str:
        """What is said of one that hangs."""
        return f"has said nothing for {self._limit_s:g} s and was killed"
