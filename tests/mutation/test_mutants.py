"""The tests of the last gate and of the edge rule notice every small change of their code."""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
EQUIVALENT = Path(__file__).with_name("equivalent.toml")
# A story of a minute; the episodes' own tests hold what it shows.
LONG = "--deselect=tests/unit/test_danger.py::test_standing_over_a_gap_is_no_edge_however_long"
STORIES = ["--then", "tests/unit/test_danger.py", LONG]
PARTS = 2
HUNTS = [
    pytest.param("ccatp.control.gate", ["tests/unit/control/test_gate.py"], part, id=f"gate {part}")
    for part in range(PARTS)
]
HUNTS += [
    pytest.param(f"ccatp.hazards.{name}", [f"tests/unit/hazards/test_{name}.py", *STORIES], part, id=f"{name} {part}")
    for name in ("edge_episode", "edge_rule")
    for part in range(PARTS)
]


def hunt(module: str, tests: list[str], part: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "tests.mutation.hunt", part, module, *tests]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def equivalents() -> set[tuple[str, str]]:
    listed = tomllib.loads(EQUIVALENT.read_text())["mutant"]
    assert all(one["reason"] for one in listed)
    return {(one["text"], one["what"]) for one in listed}


@pytest.mark.slow
@pytest.mark.parametrize(("module", "tests", "part"), HUNTS)
def test_every_mutant_is_noticed(module: str, tests: list[str], part: int) -> None:
    found = hunt(module, tests, f"{part}/{PARTS}")
    print(f"{module}: {found['mutants']} mutants, {len(found['alive'])} of them equivalent")
    assert found["mutants"] > 50
    known = equivalents()
    assert not [one for one in found["alive"] if (one[1], one[2]) not in known]


def test_what_is_listed_as_equivalent_is_there() -> None:
    """A line that has changed needs a new look."""
    source = "".join(
        (ROOT / "ccatp" / path).read_text()
        for path in ("control/gate.py", "safety/edge_detector.py", "safety/edge_rule.py")
    )
    assert all(text in source for text, _ in equivalents())


@pytest.mark.slow
def test_a_mutant_lives_without_a_test_and_dies_with_one(tmp_path: Path) -> None:
    """The hunt on three mutants of the gate, once with tests that look and once with one that does not."""
    blind = tmp_path / "test_blind.py"
    blind.write_text("def test_nothing() -> None:\n    assert True\n")
    alive = hunt("ccatp.control.gate", [str(blind)], "0/40")
    assert alive["mutants"] == len(alive["alive"]) >= 3
    seen = hunt("ccatp.control.gate", ["tests/unit/control/test_gate.py"], "0/40")
    assert seen["mutants"] == alive["mutants"]
    assert len(seen["alive"]) < len(alive["alive"])
