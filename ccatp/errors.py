"""The errors that end a command: each is one line for the reader and an exit status for scripts."""

from collections.abc import Sequence
from enum import IntEnum


class ExitStatus(IntEnum):
    """The exit status of ``ccatp``."""

    COMPLETE = 0
    REFUSED = 1  # a running daemon refused the command, and said why
    USAGE = 2  # usage or configuration
    ABORTED = 3  # robot at base
    HELD = 4  # held or faulted, robot not at base
    UNREACHABLE = 5  # robot, laser system or daemon does not answer
    INTERRUPTED = 130  # wheels held, state saved


class CcatpError(Exception):
    """An expected end with an ``exit_status``: ``str(error)`` is one line that says what is wrong and what to do."""

    exit_status: int = ExitStatus.HELD

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class ConfigError(CcatpError):
    """An unusable configuration; ``problems``: one line each, ``file:line: key: what is wrong; what to do``."""

    exit_status = ExitStatus.USAGE

    def __init__(self, *problems: str, shows_all: bool = False) -> None:
        self.problems: Sequence[str] = [" ".join(problem.split()) for problem in problems]
        others = "; ".join(self.problems[1:]) if shows_all else "ccatp config check"
        more = f" (and {len(problems) - 1} more: {others})" if len(problems) > 1 else ""
        super().__init__(self.problems[0] + more)


class RefusedError(CcatpError):
    """A running daemon refused a command."""

    exit_status = ExitStatus.REFUSED


class DaemonUnreachableError(CcatpError):
    """A peer that does not answer."""

    exit_status = ExitStatus.UNREACHABLE
