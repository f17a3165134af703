"""Errors with their exit status, and causes of the danger loop as an operator reads them."""

import pytest

from ccatp.core import danger_text
from ccatp.errors import CcatpError, ConfigError, DaemonUnreachableError, ExitStatus, RefusedError, RuntimeDirError

# -- errors are one line and know their exit status -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (CcatpError("x"), ExitStatus.HELD),
        (ConfigError("x"), ExitStatus.USAGE),
        (RuntimeDirError("x"), ExitStatus.USAGE),
        (RefusedError("x"), ExitStatus.REFUSED),
        (DaemonUnreachableError("x"), ExitStatus.UNREACHABLE),
    ],
)
def test_each_error_has_its_exit_status(error: CcatpError, status: ExitStatus) -> None:
    assert error.exit_status == status
    assert str(error) == "x"


def test_a_message_is_one_line() -> None:
    assert str(CcatpError("two\n lines ")) == "two lines"


def test_the_first_of_several_problems_is_the_message() -> None:
    error = ConfigError("a: b", "c:\nd")
    assert str(error) == "a: b (and 1 more: ccatp config check)"
    assert error.problems == ["a: b", "c: d"]


# -- causes of the danger loop as an operator reads them --------------------------------------------------------------


@pytest.mark.parametrize(
    ("cause", "signal", "value", "limit", "text"),
    [
        ("no estimate", "estimate", 0.15, 0.15, "no estimate: limit 0.15 s"),
        ("estimate stale", "estimate", 0.31, 0.15, "estimate stale: 0.31 s (limit 0.15 s)"),
        ("edge samples stale", "edge", 0.2, 0.1, "edge samples stale: 0.2 s (limit 0.1 s)"),
        ("lifted or fallen", "edge", 4.0, 3.0, "lifted or fallen (edge): 4 (limit 3)"),
        ("the left wheel runs away", "left_wheel", 0.5, 0.1, "the left wheel runs away: 0.5 (limit 0.1)"),
        ("emergency: fire", "emergency:fire", 1.0, 0.0, "emergency: fire"),
        ("", "", 0.0, 0.0, ""),
    ],
)
def test_what_where_how_much(cause: str, signal: str, value: float, limit: float, text: str) -> None:
    assert danger_text(cause, signal, value, limit) == text
