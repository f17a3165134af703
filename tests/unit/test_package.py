"""Children run the package of their parent."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import ccatp
from ccatp.config import package


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
