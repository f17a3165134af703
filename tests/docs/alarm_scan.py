"""What the code can say when it holds the robot: every cause, found in the source, so that no list of them goes stale.

A cause is the text given to one of ``CAUSES``. Where that is a name its assignments in the same function are followed,
where it is a parameter the calls of that function in the same file. What varies in a text is shown as an ellipsis.
"""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
# By the name that is called: position of the cause among the arguments, and what the mission makes of it; a finding
# has its severity with it.
CAUSES = {
    "MonitorFinding": (1, ""),
    "FixFinding": (1, ""),
    "_lacking": (1, "pause"),
    "fault": (0, "fault"),
    "hold": (0, "hold"),
    "interrupt": (0, "pause"),
    "abort": (0, "return"),
    "_request_hold": (0, "hold"),
    "recover": (0, "hold"),
}
# Causes that stand in tables or in verdicts: file, name, reaction.
EDGES, CENTRE = ("ccatp/safety/edge_detector.py", "Cause"), ("ccatp/danger.py", "CENTRE")
OWN = "ccatp/safety/sensor_monitors.py", "_OWN"
LITERAL = (
    ("ccatp/danger.py", "lifted or fallen", "hold"),
    ("ccatp/danger.py", "emergency: \u2026", "return"),
    ("ccatp/safety/sensor_monitors.py", "the robot reports a fault that is not known here", "inform"),
)
SOURCES = ("ccatp/danger.py", "ccatp/safety", "ccatp/survey", "ccatp/estimation", "ccatp/daemon")
VARIES = "\u2026"


class Cause(NamedTuple):
    """A cause as the code forms it, the file that does, and what follows: severities, or what the mission does."""

    text: str
    where: str
    reactions: frozenset[str]


def files() -> Iterator[Path]:
    for source in SOURCES:
        path = ROOT / source
        yield from sorted(path.rglob("*.py")) if path.is_dir() else [path]


@cache
def causes() -> dict[str, Cause]:
    """Every cause that the code can form."""
    found: dict[str, Cause] = {}
    for path in files():
        for cause in _in_file(path):
            known = found.get(cause.text)
            reactions = cause.reactions if known is None else known.reactions | cause.reactions
            found[cause.text] = Cause(cause.text, cause.where if known is None else known.where, reactions)
    for where, name in (EDGES, CENTRE):
        found |= {text: Cause(text, where, frozenset(("back off",))) for text in _strings(where, name)}
    found |= {text: Cause(text, OWN[0], frozenset((severity,))) for text, severity in _with_severity(*OWN)}
    for where, text, reaction in LITERAL:
        source = (ROOT / where).read_text(encoding="utf-8")
        assert text.rstrip(VARIES) in source, f"{where} does not say {text!r} any more"
        found[text] = Cause(text, where, frozenset((reaction,)))
    return found


def _in_file(path: Path) -> Iterator[Cause]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    where = str(path.relative_to(ROOT))
    for function in _functions(tree):
        for call in _calls(function):
            name = _called(call)
            place, reaction = CAUSES.get(name, (-1, ""))
            if 0 <= place < len(call.args):
                at = _Place(call, function, tree)
                reactions = {reaction} if reaction else set(at.severities(call.args[0]))
                if name == "_lacking" and getattr(call.args[0], "value", "") == "enc":
                    reactions = {"hold"}  # as ``DangerMonitor._own_findings`` has it
                for text in at.texts(call.args[place]):
                    yield Cause(text, where, frozenset(reactions))


def _functions(tree: ast.AST) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def _calls(node: ast.AST) -> Iterator[ast.Call]:
    return (one for one in ast.walk(node) if isinstance(one, ast.Call))


def _called(call: ast.Call) -> str:
    return call.func.id if isinstance(call.func, ast.Name) else getattr(call.func, "attr", "")


class _Place(NamedTuple):
    """A call in a function of a module: what names mean there."""

    call: ast.Call
    function: ast.FunctionDef | ast.AsyncFunctionDef
    tree: ast.AST

    def texts(self, node: ast.expr) -> Iterator[str]:
        """The texts that an expression may be; nothing where nobody can tell from the source."""
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
        elif isinstance(node, ast.JoinedStr):
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else VARIES for part in node.values)
        elif isinstance(node, ast.IfExp):
            yield from (*self.texts(node.body), *self.texts(node.orelse))
        elif isinstance(node, ast.Name):
            for value in self.assigned(node.id):
                yield from self.texts(value)
            yield from self._from_callers(node.id)

    def severities(self, node: ast.expr) -> Iterator[str]:
        """``Severity.HOLD``, ``HOLD``, or a name that is one of them."""
        if isinstance(node, ast.Attribute):
            yield node.attr.lower()
        elif isinstance(node, ast.IfExp):
            yield from (*self.severities(node.body), *self.severities(node.orelse))
        elif isinstance(node, ast.Name) and node.id.isupper():
            yield node.id.lower()
        elif isinstance(node, ast.Name):
            for value in self.assigned(node.id):
                yield from self.severities(value)

    def assigned(self, name: str) -> list[ast.expr]:
        """What a name was given last before the call, on each way to it."""
        for block in self._blocks():
            for statement in reversed([one for one in block if one.lineno < self.call.lineno]):
                if values := [value for value in _given(statement, name) if value is not self.call]:
                    return values
        return []

    def _blocks(self) -> Iterator[list[ast.stmt]]:
        """Lists of statements around the call, the innermost first."""
        around = [
            block
            for node in ast.walk(self.function)
            for block in (getattr(node, field, None) for field in ("body", "orelse", "finalbody"))
            if isinstance(block, list) and any(self.call in ast.walk(statement) for statement in block)
        ]
        return reversed(around)

    def _from_callers(self, name: str) -> Iterator[str]:
        """The texts given for a parameter of the function, in its own file."""
        parameters = [argument.arg for argument in self.function.args.args if argument.arg != "self"]
        if name not in parameters:
            return
        place = parameters.index(name)
        for function in _functions(self.tree):
            for call in _calls(function):
                if _called(call) == self.function.name and place < len(call.args):
                    yield from _Place(call, function, self.tree).texts(call.args[place])


def _given(statement: ast.AST, name: str) -> Iterator[ast.expr]:
    for node in ast.walk(statement):
        if isinstance(node, ast.Assign):
            for target in node.targets:
                yield from _matched(target, node.value, name)


def _matched(target: ast.expr, value: ast.expr, name: str) -> Iterator[ast.expr]:
    if isinstance(target, ast.Name) and target.id == name:
        yield value
    elif isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        for one, other in zip(target.elts, value.elts, strict=False):
            yield from _matched(one, other, name)


def _table(path: str, name: str) -> list[ast.expr]:
    """The values in a table of a module: of an assignment, or of the assignments in a class."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and node.name == name:
            return [one.value for one in node.body if isinstance(one, ast.Assign)]
        if isinstance(node, ast.Assign) and any(getattr(target, "id", "") == name for target in node.targets):
            return [node.value]
    raise AssertionError(f"{path} has no table {name} any more")


def _strings(path: str, name: str) -> list[str]:
    parts = (part for value in _table(path, name) for part in ast.walk(value))
    return [part.value for part in parts if isinstance(part, ast.Constant) and isinstance(part.value, str)]


def _with_severity(path: str, name: str) -> Iterator[tuple[str, str]]:
    for part in (part for value in _table(path, name) for part in ast.walk(value)):
        if isinstance(part, ast.Tuple) and isinstance(part.elts[0], ast.Attribute):
            text = part.elts[1]
            assert isinstance(text, ast.Constant)
            yield str(text.value), part.elts[0].attr.lower()
