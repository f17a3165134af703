"""Errors are one line and know their exit status."""

import pytest

from ccatp.errors import CcatpError, ConfigError, DaemonUnreachableError, ExitStatus, RefusedError, RuntimeDirError


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
