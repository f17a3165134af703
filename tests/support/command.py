"""The command line, called in process."""

import json
from typing import Any

import pytest

from ccatp.cli import main


def answered(capsys: pytest.CaptureFixture[str], *argv: object, status: int = 0) -> Any:
    """What a command prints as JSON."""
    assert main([*map(str, argv), "--json"]) == status
    return json.loads(capsys.readouterr().out)


def printed(capsys: pytest.CaptureFixture[str], *argv: object, status: int = 0) -> str:
    """What a command prints on standard output."""
    assert main([*map(str, argv)]) == status
    return capsys.readouterr().out


def refused(capsys: pytest.CaptureFixture[str], *argv: object, status: int = 2) -> str:
    """The one line that a command prints in place of an answer."""
    assert main([*map(str, argv)]) == status
    out, err = capsys.readouterr()
    assert (out, err.count("\n"), err[:7]) == ("", 1, "ccatp: ")
    return err
