"""The tests of the gate and of the edge rule notice every small change; the tool that says so finds moved mutants."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from tools.mutation.mutants import mutants

ROOT = Path(__file__).parents[2]
TABLES = ROOT / "tools" / "mutation"
STRICT = ["gate", "edge"]


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tools.mutation", *arguments]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(folder)])}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("target", STRICT)
def test_every_mutant_is_noticed(target: str) -> None:
    done = run(ROOT, "--strict", target)
    assert done.returncode == 0, done.stderr
    print(done.stderr)


def test_what_the_table_names_is_there() -> None:
    targets = tomllib.loads((TABLES / "targets.toml").read_text()).values()
    patterns = [pattern for target in targets for pattern in target["modules"] + target["tests"]]
    assert not [pattern for pattern in patterns if not list(ROOT.glob(pattern))]


def test_what_is_listed_as_equivalent_is_there() -> None:
    """A line that has changed needs a new look."""
    targets = tomllib.loads((TABLES / "targets.toml").read_text())
    listed = tomllib.loads((TABLES / "equivalent.toml").read_text())["mutant"]
    names = [one.name for one in mutants(ROOT / module for target in STRICT for module in targets[target]["modules"])]
    assert all(one["reason"] for one in listed)
    assert {(one["text"], one["what"]) for one in listed} <= {name.short() for name in names}


TABLE = """
[it]
modules = ["{module}.py"]
tests = ["test_it.py"]
sample = 0
renames = {{ Ear = "{name}" }}
"""
MODULE = """
LIMIT = 3

class {name}:
    def is_in(self, value):
        if value < 0:
            raise ValueError("{message}")
        return value <= LIMIT
"""
TESTS = """
import pytest
from {module} import {name}

def test_is_in():
    assert {name}().is_in({value}) and not {name}().is_in(4) and {name}().is_in(0)
    with pytest.raises(ValueError):
        {name}().is_in(-1)
"""


def project(folder: Path, **words: Any) -> None:
    """A class with a test, as the tool sees it."""
    for name, text in ((f"{words['module']}.py", MODULE), ("test_it.py", TESTS), ("targets.toml", TABLE)):
        (folder / name).write_text(text.format(**words))


def test_mutants_are_found_after_a_move_and_a_lost_one_is_an_error(tmp_path: Path) -> None:
    project(tmp_path, module="old", name="Ear", message="a message", value=3)
    written = run(tmp_path, "--tables", ".", "--write")
    assert "9 mutants; 9 of 9 killed" in written.stderr, written.stderr
    moved = {"module": "new", "name": "Subscriber", "message": "another message"}
    project(tmp_path, **moved, value=3)
    same = run(tmp_path, "--tables", ".")
    assert "9 of them found: 9 killed before, 9 now" in same.stderr, same.stderr
    assert same.returncode == 0
    project(tmp_path, **moved, value=2)
    (tmp_path / "new.py").write_text(MODULE.format(**moved).replace("value < 0", "not value >= 0"))
    weaker = run(tmp_path, "--tables", ".")
    assert weaker.returncode == 1
    assert "not found: Subscriber.is_in: value < 0: Lt -> LtE [0]" in weaker.stderr
    assert "LIVES AND MUST NOT: new.py:8: value <= LIMIT: LtE -> Lt [0]" in weaker.stderr
