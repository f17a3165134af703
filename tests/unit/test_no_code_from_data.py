"""Nothing that is read, from a file or from a peer, may become code."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import ccatp

PACKAGE = Path(ccatp.__file__).parent
MODULES = {"pickle", "cPickle", "_pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "yaml"}
CALLS = {"eval", "exec", "compile", "__import__"}
SWITCHES = {"allow_pickle", "shell"}
METHODS = {"send_pyobj", "recv_pyobj", "read_pickle", "to_pickle"}
# Studies hand jobs to processes of their own machine, or to a dask cluster that the user names: both pickle.
POOLS = {"multiprocessing", "ProcessPoolExecutor", "distributed", "dask"}
WITH_POOLS = {"studies/engine.py"}


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


def test_the_exceptions_are_needed() -> None:
    for name in WITH_POOLS:
        assert any(fault.split(".")[0] in POOLS for fault in faults(ast.parse((PACKAGE / name).read_text())))


@pytest.mark.parametrize(
    "code",
    [
        "import multiprocessing.pool",
        "import pickle", "import os, marshal", "from pickle import loads",
        "from concurrent.futures import ProcessPoolExecutor",
        "eval('1')", "exec(text)", "s.recv_pyobj()", "np.load(f, allow_pickle=True)", "run(c, shell=True)",
    ],
)  # fmt: skip
def test_each_fault_is_seen(code: str) -> None:
    assert list(faults(ast.parse(code)))
