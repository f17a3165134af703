"""Children run the package of their parent; errors are one line and have their exit status."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import ccatp
from ccatp.config import package
from ccatp.errors import CcatpError, ConfigError, DaemonUnreachableError, ExitStatus, RefusedError, RuntimeDirError


@pytest.mark.parametrize("is_installed", [True, False])
def test_a_child_does_not_take_the_package_of_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_installed: bool
) -> None:
    other = tmp_path / "ccatp"
    other.mkdir()
    (other / "__init__.py").write_text("raise SystemExit('the wrong one')\n", encoding="utf-8")
    above = str(package.ROOT.parent)
    monkeypatch.setattr(sys, "path", ["", above] if is_installed else [above])
    environment = package.child_environment({**os.environ, "PYTHONPATH": above} if is_installed else os.environ)
    command = [sys.executable, "-m", "ccatp", "--version"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert done.stdout.startswith(f"ccatp {ccatp.__version__}")


def test_the_paths_of_the_parent_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [str(package.ROOT.parent)])
    found = package.child_environment({"PYTHONPATH": "/one", "HOME": "/home"})
    assert found["PYTHONPATH"] == os.pathsep.join((str(package.ROOT.parent), "/one"))
    assert found["HOME"] == "/home"


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
