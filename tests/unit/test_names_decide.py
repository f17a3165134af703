"""What is wrong is decided by the name of its condition; the text for people is never read back."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import ccatp

PACKAGE = Path(ccatp.__file__).parent
# Values that are text for people, or name the source of a value for them.
TEXTS = frozenset(("cause", "abort_cause", "hold_cause", "wait_cause", "signal", "why", "refusal"))
READING = frozenset(
    ("startswith", "endswith", "find", "index", "match", "fullmatch", "search", "split", "partition", "removeprefix")
)
# Expressions that read such a value, and no condition of the robot is decided by them.
ALLOWED = {
    "named in cause": "the text does not repeat the name of the sensor",
    "v.cause != s.finding": "whole causes are compared: names and numbers",
    "state.abort_cause != self._in_force[0]": "likewise",
    "cause != verdict.cause": "likewise",
    "cause not in [one.cause for one in found]": "likewise",
    "after.abort_cause != s.abort_cause": "likewise: whether a request would change the cause",
    "turn.bars == turn.why": "likewise: whether what bars the resume is what holds, or something else",
    "cause in texts": "an alarm does not repeat the same text",
    "fault.signal == 'laser'": "a fault plan names the simulated signal",
    "fault.signal not in SIGNALS": "likewise",
    "fault.signal in _BODY_SIGNALS": "likewise",
    "fault.signal not in _ALWAYS": "likewise",
    "fault.signal == 'fans'": "likewise",
    "fault.signal.partition('_')": "likewise",
    "message.signal != self.signal": "the summary counts changes of the signal",
    "verdict.signal != self._signal": "likewise",
    "signal.startswith('edge')": "a study draws simulated faults",
}


def name_of(node: ast.expr) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def is_text(node: ast.expr) -> bool:
    """Whether it is such a value, or one that was made by ``text_of``."""
    called = isinstance(node, ast.Call) and name_of(node.func) == "text_of"
    return called or name_of(node) in TEXTS


def readings(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            is_read = any(isinstance(op, ast.Eq | ast.NotEq | ast.In | ast.NotIn) for op in node.ops)
            if is_read and any(map(is_text, sides)):
                yield ast.unparse(node)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in READING:
            of_pattern = name_of(node.func.value) in ("re", "pattern") or name_of(node.func.value).isupper()
            if is_text(node.func.value) or (of_pattern and any(map(is_text, node.args))):
                yield ast.unparse(node)


@cache
def readings_in(path: Path) -> frozenset[str]:
    return frozenset(readings(ast.parse(path.read_text(encoding="utf-8"))))


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_text_of_a_cause_is_read_back(path: Path) -> None:
    assert [text for text in readings_in(path) if text not in ALLOWED] == []


def test_each_exception_is_still_in_use() -> None:
    found = {text for path in PACKAGE.rglob("*.py") for text in readings_in(path)}
    assert found == set(ALLOWED)


@pytest.mark.parametrize(
    "line",
    [
        "verdict.cause.startswith('rim ahead')",
        "v.signal in CORNERS",
        "state.cause != s.finding.text",
        "'stale' in cause",
        "re.fullmatch('no way.*', status.cause)",
        "why.startswith('refused')",
        "text_of(state.cause) == 'operator'",
    ],
)
def test_a_text_that_is_read_back_is_found(line: str) -> None:
    assert list(readings(ast.parse(line))) == [line]
