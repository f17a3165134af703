"""Constructors have few parameters: what travels together is a value with a name."""

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "ccatp"
MOST = 6
# Each with its reason.
EXCEPTIONS = {
    "BatchProblem": "the terms of one least-squares problem, which its only two callers make from one run",
    "BeaconSlam": "the parts of one filter, which one factory makes from a configuration",
}


def constructors(source: str) -> Iterator[tuple[str, int]]:
    """Name of each class with an ``__init__`` of its own, and the number of its parameters without ``self``."""
    classes = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef))
    for one in classes:
        for member in one.body:
            if isinstance(member, ast.FunctionDef) and member.name == "__init__":
                given = member.args
                yield one.name, len([*given.posonlyargs, *given.args, *given.kwonlyargs]) - 1


def test_no_constructor_has_more_than_six_parameters() -> None:
    found = dict[str, int]()
    for path in PACKAGE.rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        if "def __init__(" in source:  # to parse every module takes seconds
            found |= {name: count for name, count in constructors(source) if count > MOST}
    assert set(found) == set(EXCEPTIONS), "give what travels together a value of its own"


def test_all_kinds_of_parameters_count() -> None:
    source = "class A:\n    def __init__(self, a, /, b, c=1, *, d, e=2):\n        pass\n"
    assert list(constructors(source)) == [("A", 5)]
