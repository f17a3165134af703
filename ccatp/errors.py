"""The errors that end a command: each has one line of text and an exit status for scripts."""

import re
from collections.abc import Sequence
from enum import IntEnum

# Control characters, and surrogates, which cannot be encoded.
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
LONGEST_LINE = 300  # characters of one message


class ExitStatus(IntEnum):
    """The exit status of ``ccatp``."""

    COMPLETE = 0
    REFUSED = 1  # a running daemon refused the command, and said why
    USAGE = 2  # usage or configuration
    ABORTED = 3  # robot at base
    HELD = 4  # held or faulted, robot not at base
    UNREACHABLE = 5  # robot, laser system or daemon does not answer
    INTERRUPTED = 130  # wheels held, state saved


def printable(text: str) -> str:
    """A text with backslash escapes instead of control characters, except tabs and line feeds."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def one_line(text: str, longest: int = LONGEST_LINE) -> str:
    """A text as one printable line. A long one loses its middle, because a message ends with the advice."""
    line = printable(" ".join(text.split()))
    begin, end = 2 * longest // 3, longest // 3 - 3
    return line if len(line) <= longest else f"{line[:begin]}...{line[-end:]}"


def listed(names: Sequence[str], most: int = 8) -> str:
    """``6, 7, 8``, shortened if there are more than ``most``."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def counted(what: str, names: Sequence[str], most: int = 8) -> str:
    """``panel 6``, or ``panels 6, 7, 8``."""
    return f"{what}{'s' if len(names) > 1 else ''} {listed(names, most)}"


class CcatpError(Exception):
    """Base of the expected errors: ``str(error)`` is one line that says what is wrong and what to do."""

    exit_status: int = ExitStatus.HELD

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


class UsageError(CcatpError):
    """The arguments of a command cannot be used."""

    exit_status = ExitStatus.USAGE


class ConfigError(UsageError):
    """An invalid configuration; ``problems``: one line each, ``file:line: key: what is wrong; what to do``."""

    def __init__(self, *problems: str, shows_all: bool = False) -> None:
        self.problems: Sequence[str] = [one_line(problem) for problem in problems]
        others = "; ".join(self.problems[1:]) if shows_all else "ccatp config check"
        more = f" (and {len(problems) - 1} more: {others})" if len(problems) > 1 else ""
        Exception.__init__(self, self.problems[0] + more)


class RefusedError(CcatpError):
    """A running daemon refused a command."""

    exit_status = ExitStatus.REFUSED


class DaemonUnreachableError(CcatpError):
    """A peer does not answer."""

    exit_status = ExitStatus.UNREACHABLE
