"""The command ``ccatp dashboard``, where there is nothing to attach to."""

import tempfile
from pathlib import Path

import pytest

from ccatp.cli import main


def test_no_daemon(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with tempfile.TemporaryDirectory(prefix="ccatp-") as folder:
        assert main(["dashboard", "--runtime-dir", folder]) == 5
        assert capsys.readouterr().err == (
            f"ccatp: no daemon in {folder}; start one with ccatp run, or name its folder with --runtime-dir\n"
        )


def test_a_key_of_the_daemon_is_not_the_pages(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dashboard", "--set", "run.seed=2"]) == 2
    assert "run.seed is no key of the page; the daemon runs with what it has" in capsys.readouterr().err
