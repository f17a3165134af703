"""Small mutations of a module's syntax tree, put into the running module and taken out again."""

import ast
import copy
import importlib
import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import NamedTuple

_COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
}
_CALLS = {"min": "max", "max": "min", "cos": "sin", "sin": "cos", "any": "all", "all": "any"}


class Mutant(NamedTuple):
    """One change.

    Attributes:
        line: where, in the module's file.
        text: the source line, without its indentation.
        what: what became of it.
        source_tree: the module with the change.
    """

    line: int
    text: str
    what: str
    source_tree: ast.Module


Change = tuple[str, Callable[[ast.AST], ast.AST]]


def mutants(path: Path) -> Iterator[Mutant]:
    """All changes of a file, in the order of its lines. What is only said (docstrings, annotations) stays."""
    source = path.read_text(encoding="utf-8")
    lines, tree = source.splitlines(), ast.parse(source)
    sites = [(place, node) for place, node in _walk(tree, ())]
    sites.sort(key=lambda site: getattr(site[1], "lineno", 0))
    for place, node in sites:
        for what, change in _changes(node):
            changed = copy.deepcopy(tree)
            _put(changed, place, change)
            ast.fix_missing_locations(changed)
            line = getattr(node, "lineno", 0)
            yield Mutant(line, lines[line - 1].strip(), what, changed)


_Place = tuple[tuple[str, int | None], ...]


def _walk(node: ast.AST, place: _Place) -> Iterator[tuple[_Place, ast.AST]]:
    yield place, node
    for name, value in ast.iter_fields(node):
        if name in {"annotation", "returns", "decorator_list", "type_params", "bases"}:
            continue
        if isinstance(value, ast.AST):
            yield from _walk(value, (*place, (name, None)))
        elif isinstance(value, list):
            for k, part in enumerate(value):
                if isinstance(part, ast.AST):
                    yield from _walk(part, (*place, (name, k)))


def _put(tree: ast.Module, place: _Place, change: Callable[[ast.AST], ast.AST]) -> None:
    node: ast.AST = tree
    for name, k in place[:-1]:
        value = getattr(node, name)
        node = value if k is None else value[k]
    name, k = place[-1]
    if k is None:
        setattr(node, name, change(getattr(node, name)))
    else:
        getattr(node, name)[k] = change(getattr(node, name)[k])


def _changes(node: ast.AST) -> Iterator[Change]:
    if isinstance(node, ast.Compare | ast.BoolOp):
        yield from _logical(node)
    elif isinstance(node, ast.Constant):
        yield from _constant(node)
    else:
        yield from _other(node)


def _logical(node: ast.Compare | ast.BoolOp) -> Iterator[Change]:
    if isinstance(node, ast.Compare):
        for k, op in enumerate(node.ops):
            for other in _COMPARISONS[type(op)]:
                yield f"{type(op).__name__} -> {other.__name__} [{k}]", _comparison(k, other)
        return
    other_bool = ast.Or if isinstance(node.op, ast.And) else ast.And
    yield f"{type(node.op).__name__} -> {other_bool.__name__}", _field("op", other_bool)
    for k in range(len(node.values)):
        yield f"operand {k} dropped", _dropped(k)


def _constant(node: ast.Constant) -> Iterator[Change]:
    value = node.value
    if isinstance(value, bool):
        yield "constant flipped", lambda _: ast.Constant(not value)
    elif isinstance(value, int | float):
        yield "constant + 1", lambda _: ast.Constant(value + 1)
        if value:
            yield "constant halved", lambda _: ast.Constant(value / 2)


def _other(node: ast.AST) -> Iterator[Change]:
    match node:
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            yield f"{type(node.op).__name__} dropped", lambda n: n.operand  # type: ignore[attr-defined]
        case ast.BinOp() | ast.AugAssign() if type(node.op) in _OPERATORS:
            other_op = _OPERATORS[type(node.op)]
            yield f"{type(node.op).__name__} -> {other_op.__name__}", _field("op", other_op)
        case ast.Return(value=ast.expr()) if not _is_falsy(node.value):
            yield "returns None", lambda _: ast.Return(ast.Constant(None))
        case ast.Call(func=ast.Name(id=name)) if name in _CALLS:
            yield f"{name} -> {_CALLS[name]}", _field("func", lambda: ast.Name(_CALLS[name], ast.Load()))
        case ast.IfExp():
            yield "branches exchanged", lambda n: ast.IfExp(n.test, n.orelse, n.body)  # type: ignore[attr-defined]
        case _:
            pass


def _is_falsy(node: ast.expr | None) -> bool:
    return isinstance(node, ast.Constant) and not node.value


def _comparison(k: int, other: type[ast.cmpop]) -> Callable[[ast.AST], ast.AST]:
    def change(node: ast.AST) -> ast.AST:
        assert isinstance(node, ast.Compare)
        node.ops[k] = other()
        return node

    return change


def _dropped(k: int) -> Callable[[ast.AST], ast.AST]:
    def change(node: ast.AST) -> ast.AST:
        assert isinstance(node, ast.BoolOp)
        del node.values[k]
        return node.values[0] if len(node.values) == 1 else node

    return change


def _field(name: str, make: Callable[[], ast.AST]) -> Callable[[ast.AST], ast.AST]:
    def change(node: ast.AST) -> ast.AST:
        setattr(node, name, make())
        return node

    return change


# -- in the running program -------------------------------------------------------------------------------------------


@contextmanager
def applied(module: ModuleType, mutant: Mutant) -> Iterator[bool]:
    """Give the module's functions the mutant's code, and its constants its values; yields whether anything changed."""
    path = inspect.getsourcefile(module) or "?"
    namespace: dict[str, object] = {"__name__": module.__name__, "__file__": path}
    exec(compile(mutant.source_tree, path, "exec"), namespace)
    codes: list[tuple[FunctionType, CodeType]] = []
    values: dict[str, object] = {}
    changed = dict(_functions(namespace, module.__name__))
    for name, function in _functions(vars(module), module.__name__):
        if changed[name].__code__ != function.__code__:
            codes.append((function, function.__code__))
            function.__code__ = changed[name].__code__
    for name, value in list(vars(module).items()):
        if isinstance(value, int | float | tuple | frozenset) and namespace.get(name, value) != value:
            values[name] = value
            setattr(module, name, namespace[name])
    try:
        yield bool(codes or values)
    finally:
        for function, code in codes:
            function.__code__ = code
        for name, value in values.items():
            setattr(module, name, value)


def _functions(namespace: dict[str, object], module: str) -> Iterator[tuple[str, FunctionType]]:
    for name, value in namespace.items():
        if isinstance(value, FunctionType) and value.__module__ == module:
            yield name, value
        elif inspect.isclass(value) and value.__module__ == module:
            for key, member in vars(value).items():
                found = member.fget if isinstance(member, property) else member
                if isinstance(found, FunctionType) and found.__module__ == module:
                    yield f"{name}.{key}", found


def module_of(name: str) -> tuple[ModuleType, Path]:
    """A module and its file."""
    module = importlib.import_module(name)
    path = inspect.getsourcefile(module)
    assert path is not None
    return module, Path(path)
