"""What stands and what is at rest is defined in one module."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import ccatp
from ccatp import rest

PACKAGE = Path(ccatp.__file__).parent
# Ground truth and studies must not use the definitions of the code under test; robots among beacons have other wheels.
OUTSIDE = {"sim", "studies", "beacons"}
LIMIT = re.compile(r"(?:STILL|STAND|REST|MOTION|MOVING|MOVES)[A-Z_]*_(?:M|RAD)(?:_S)?$")


def limits_in(source: str) -> Iterator[str]:
    """Names of the module's constants that look like limits of standstill, with a number as value."""
    for node in ast.parse(source).body:
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        names = [one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]
        yield from (name for name in names if LIMIT.search(name))


def modules() -> Iterator[Path]:
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.relative_to(PACKAGE).parts[0] not in OUTSIDE:
            yield path


def test_no_other_module_has_a_limit_of_standstill() -> None:
    found = {str(path.relative_to(PACKAGE)): list(limits_in(path.read_text())) for path in modules()}
    assert {path for path, names in found.items() if names} == {"rest.py"}


def test_such_a_limit_is_found() -> None:
    source = "_STILL_M_S, other = 0.002, 1\nMOVING_RAD_S: float = 0.02\n_STANDS_AFTER_S = 0.4\nSTILL = (0.0, 0.0)\n"
    assert list(limits_in(source)) == ["_STILL_M_S", "MOVING_RAD_S"]


def test_each_definition_is_used() -> None:
    text = "\n".join(path.read_text() for path in modules() if path.name != "rest.py")
    names = [name for name in vars(rest) if name.isupper()]
    assert len(names) == 8
    assert [name for name in names if not re.search(rf"\b{name}\b", text)] == []
