"""The package as a whole: children run that of their parent, errors and their exit status, no code made of data."""

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import ccatp
from ccatp.config import package
from ccatp.core import danger_text
from ccatp.errors import CcatpError, ConfigError, DaemonUnreachableError, ExitStatus, RefusedError


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
        (RefusedError("x"), ExitStatus.REFUSED),
        (DaemonUnreachableError("x"), ExitStatus.UNREACHABLE),
    ],
)
def test_each_error_has_its_exit_status(error: CcatpError, status: ExitStatus) -> None:
    assert error.exit_status == status
    assert str(error) == "x"


def test_a_message_is_one_line_and_that_of_the_first_problem() -> None:
    assert str(CcatpError("two\n lines ")) == "two lines"
    error = ConfigError("a: b", "c:\nd")
    assert str(error) == "a: b (and 1 more: ccatp config check)"
    assert error.problems == ["a: b", "c: d"]


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


# -- nothing that is read, from a file or from a peer, may become code -------------------------------------------------

PACKAGE = Path(ccatp.__file__).parent
MODULES = {"pickle", "cPickle", "_pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "yaml"}
CALLS = {"eval", "exec", "compile", "__import__"}
SWITCHES = {"allow_pickle", "shell"}
METHODS = {"send_pyobj", "recv_pyobj", "read_pickle", "to_pickle"}
# Studies hand jobs to processes of their own machine, or to a dask cluster that the user names: both pickle.
POOLS = {"multiprocessing", "ProcessPoolExecutor", "distributed", "dask"}
WITH_POOLS = {"studies/engine.py", "studies/calibrator.py"}  # pickles pass between this package's own processes only


def is_false(value: ast.expr) -> bool:
    return isinstance(value, ast.Constant) and value.value is False


def faults(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.split(".")[0] in MODULES | POOLS)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = (node.module.split(".")[0], *(alias.name for alias in node.names))
            yield from (name for name in names if name in MODULES | POOLS)
        elif isinstance(node, ast.Call):
            name = node.func.id if isinstance(node.func, ast.Name) else ""
            method = node.func.attr if isinstance(node.func, ast.Attribute) else ""
            if name in CALLS:
                yield f"{name}()"
            if method in METHODS:
                yield f".{method}()"
            yield from (k.arg for k in node.keywords if k.arg in SWITCHES and not is_false(k.value))


def test_no_module_makes_code_of_data() -> None:
    found = {}
    for path in PACKAGE.rglob("*.py"):
        name = path.relative_to(PACKAGE).as_posix()
        names = set(faults(ast.parse(path.read_text(encoding="utf-8"))))
        if name in WITH_POOLS:
            names = {fault for fault in names if fault.split(".")[0] not in POOLS}
        if names:
            found[name] = names
    assert found == {}
