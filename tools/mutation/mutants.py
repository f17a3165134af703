"""Small changes of a module's syntax tree, named so that they are found again after the code has moved."""

import ast
import copy
import hashlib
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, NamedTuple

_EXCHANGED: dict[type[ast.AST], list[type[ast.AST]]] = {}
for _a, _b in (
    *((ast.Lt, ast.LtE), (ast.Lt, ast.GtE), (ast.Gt, ast.GtE), (ast.Gt, ast.LtE)),
    *((ast.Eq, ast.NotEq), (ast.Is, ast.IsNot), (ast.In, ast.NotIn), (ast.And, ast.Or)),
    *((ast.Add, ast.Sub), (ast.Mult, ast.Div)),
):
    _EXCHANGED.setdefault(_a, []).append(_b)
    _EXCHANGED.setdefault(_b, []).append(_a)
_CALLS = {"min": "max", "max": "min", "cos": "sin", "sin": "cos", "any": "all", "all": "any"}
# Annotations, default values and decorators are evaluated once, on import.
_SKIPPED = {"annotation", "returns", "decorator_list", "type_params", "bases"}

Place = tuple[tuple[str, int | None], ...]
Scope = tuple[str, str, str]
Key = tuple[str, str, int]


class Name(NamedTuple):
    """What identifies a mutant; neither module nor line, so that it survives a move.

    Attributes:
        owner: class, or empty.
        function: innermost function; empty for a constant of the module.
        statement: first line of the statement, normalised by ``ast.unparse``.
        change: the changed expression and what becomes of it.
        nth: number among those that are equal in all of this.
    """

    owner: str
    function: str
    statement: str
    change: str
    nth: int

    def renamed(self, renames: Mapping[str, str]) -> "Name":
        """The same mutant after identifiers were renamed."""
        owner, function, statement, change = (
            re.sub(r"\w+", lambda word: renames.get(word[0], word[0]), text)
            for text in (self.owner, self.function, self.statement, self.change)
        )
        return Name(owner, function, statement, change, self.nth)

    def short(self) -> tuple[str, str]:
        """Statement and what is changed, without the expression."""
        return self.statement, self.change.rpartition(": ")[2]


class Mutant(NamedTuple):
    """One change: ``node`` replaces what is at ``place`` in the syntax tree of ``path``."""

    name: Name
    path: Path
    line: int
    place: Place
    node: ast.AST


def mutants(paths: Iterable[Path]) -> list[Mutant]:
    """All changes of function bodies and of constants of modules, in the order of the code."""
    found: list[Mutant] = []
    seen: Counter[tuple[str, ...]] = Counter()
    for path in paths:
        for place, node, scope in _walk(ast.parse(path.read_text(encoding="utf-8")), (), ("", "", "")):
            for what, replacement in [*_changes_of_expression(node), *_changes_of_statement(node)]:
                change = f"{_text(node)}: {what}"
                name = Name(*scope, change, seen[*scope, change])
                seen[*scope, change] += 1
                found.append(Mutant(name, path, getattr(node, "lineno", 0), place, replacement))
    return found


def sample(found: list[Mutant], size: int, seed: str) -> list[Mutant]:
    """A part of the mutants that depends on their names alone; all of them for ``size`` 0."""
    drawn = sorted(found, key=lambda one: hashlib.sha256(repr((seed, *one.name)).encode()).digest())
    return sorted(drawn[: size or None])


def locate(names: list[Name], found: list[Mutant]) -> dict[Name, Mutant]:
    """The mutants with these names; those of moved, merged or slightly changed code by parts of their names."""
    keys: list[tuple[Callable[[Name], object], bool]] = [
        (lambda n: n, False),
        (lambda n: (n.function, n.statement, n.change), False),
        (lambda n: (n.statement, n.change), True),
        (lambda n: (n.function, n.change), True),
    ]
    located: dict[Name, Mutant] = {}
    for key, must_be_unique in keys:
        taken = {id(one) for one in located.values()}
        free: defaultdict[object, list[Mutant]] = defaultdict(list)
        for mutant in found:
            if id(mutant) not in taken:
                free[key(mutant.name)].append(mutant)
        for name in names:
            candidates = free[key(name)]
            if name not in located and candidates and not (must_be_unique and len(candidates) > 1):
                located[name] = candidates.pop(0)
    return located


def _walk(node: ast.AST, place: Place, scope: Scope) -> Iterator[tuple[Place, ast.AST, Scope]]:
    owner, function, _ = scope
    if isinstance(node, ast.ClassDef):
        scope = node.name, function, ""
    elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        scope = owner, node.name, ""
    elif isinstance(node, ast.stmt):
        scope = owner, function, _text(node)
    yield place, node, scope
    for field, value in ast.iter_fields(node):
        parts = enumerate(value) if isinstance(value, list) else [(None, value)]
        for k, part in parts:
            if isinstance(part, ast.AST) and field not in _SKIPPED and _is_changeable(node, part):
                yield from _walk(part, (*place, (field, k)), scope)


def _is_changeable(parent: ast.AST, node: ast.AST) -> bool:
    """False for what is evaluated on import, unless it is a constant of the module."""
    if isinstance(node, ast.arguments):
        return False
    if isinstance(parent, ast.Module | ast.ClassDef):
        is_constant = isinstance(parent, ast.Module) and bool(_constant_of(node))
        return is_constant or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
    return True


def _constant_of(node: ast.AST) -> str:
    """The name that a module's statement gives a value, or empty."""
    match node:
        case ast.Assign([ast.Name(name)], ast.expr() as value) | ast.AnnAssign(
            ast.Name(name), value=ast.expr() as value
        ):
            # What is called or made of types has taken the number into another object.
            is_plain = not any(isinstance(part, ast.Call | ast.Subscript) for part in ast.walk(value))
            return name if is_plain else ""
    return ""


class _WithoutProse(ast.NodeTransformer):
    """Messages may be reworded without a change of the mutant's name."""

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.Constant:
        return ast.Constant("...")

    def visit_Constant(self, node: ast.Constant) -> ast.Constant:
        return ast.Constant("...") if isinstance(node.value, str) and " " in node.value else node


def _text(node: ast.AST) -> str:
    """The first line of a node's normalised source."""
    shown: ast.AST = _WithoutProse().visit(copy.deepcopy(node))
    return ast.unparse(shown).splitlines()[0]


def _changes_of_expression(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    match node:
        case ast.Compare(left, ops, comparators):
            for k, op in enumerate(ops):
                for what, other in _exchanged(op):
                    yield f"{what} [{k}]", ast.Compare(left, [*ops[:k], other, *ops[k + 1 :]], comparators)
        case ast.BoolOp(op, values):
            for k in range(len(values)):
                rest = [*values[:k], *values[k + 1 :]]
                yield f"operand {k} dropped", rest[0] if len(rest) == 1 else ast.BoolOp(op, rest)
        case ast.Constant(bool(value)):
            yield "constant flipped", ast.Constant(not value)
        case ast.Constant(int(value) | float(value)):
            yield "constant + 1", ast.Constant(value + 1)
            if value:
                yield "constant halved", ast.Constant(value / 2)
        case ast.UnaryOp(ast.Not() | ast.USub() as op, operand):
            yield f"{type(op).__name__} dropped", operand
        case ast.Call(ast.Name(name), arguments, keywords) if name in _CALLS:
            yield f"{name} -> {_CALLS[name]}", ast.Call(ast.Name(_CALLS[name], ast.Load()), arguments, keywords)
        case ast.IfExp(test, body, orelse):
            yield "branches exchanged", ast.IfExp(test, orelse, body)


def _changes_of_statement(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    match node:
        case ast.BinOp(op=op) | ast.AugAssign(op=op) | ast.BoolOp(op=op):
            for what, other in _exchanged(op):
                changed = copy.copy(node)
                changed.op = other
                yield what, changed
        case ast.Return(ast.expr() as value) if not (isinstance(value, ast.Constant) and not value.value):
            yield "returns None", ast.Return(ast.Constant(None))
        case ast.If(ast.Name() | ast.Attribute() | ast.Call() | ast.NamedExpr() as test, body, orelse):
            yield "condition negated", ast.If(ast.UnaryOp(ast.Not(), test), body, orelse)
        case ast.Raise() | ast.Expr(ast.Call() | ast.Await()):
            yield "statement dropped", ast.Pass()


def _exchanged(operator: ast.AST) -> Iterator[tuple[str, Any]]:
    for other in _EXCHANGED.get(type(operator), ()):
        yield f"{type(operator).__name__} -> {other.__name__}", other()


# -- in the running program -------------------------------------------------------------------------------------------


def key_of(code: CodeType) -> Key:
    """A function's code: file, qualified name, line."""
    return code.co_filename, code.co_qualname, code.co_firstlineno


def _changed_tree(mutant: Mutant) -> ast.Module:
    tree = ast.parse(mutant.path.read_text(encoding="utf-8"))
    parent: ast.AST = tree
    for field, k in mutant.place[:-1]:
        value = getattr(parent, field)
        parent = value if k is None else value[k]
    field, k = mutant.place[-1]
    if k is None:
        setattr(parent, field, mutant.node)
    else:
        getattr(parent, field)[k] = mutant.node
    return ast.fix_missing_locations(tree)


def changed_functions(mutant: Mutant, functions: Iterable[FunctionType]) -> list[tuple[FunctionType, CodeType]]:
    """Live functions that the change concerns, with their code after it."""
    codes = {key_of(code): code for code in _codes(compile(_changed_tree(mutant), str(mutant.path), "exec"))}
    found = [(function, codes.get(key_of(function.__code__))) for function in functions]
    return [(function, code) for function, code in found if code is not None and code != function.__code__]


def users_of(mutant: Mutant, functions: Iterable[FunctionType]) -> list[FunctionType]:
    """Functions that read the module's constant that is changed."""
    name = _constant_of(_changed_tree(mutant).body[mutant.place[0][1] or 0])
    return [one for one in functions if any(name in code.co_names for code in _codes(one.__code__))]


def _codes(code: CodeType) -> list[CodeType]:
    """A code and those inside it."""
    inner = [one for one in code.co_consts if isinstance(one, CodeType)]
    return [code, *(deeper for one in inner for deeper in _codes(one))]


def apply(mutant: Mutant, changed: list[tuple[FunctionType, CodeType]]) -> None:
    """Give the functions their code, or a module's constant its value wherever it was imported to."""
    for function, code in changed:
        function.__code__ = code
    statement = _changed_tree(mutant).body[mutant.place[0][1] or 0]
    if isinstance(statement, ast.Assign | ast.AnnAssign) and statement.value is not None:
        name = _constant_of(statement)
        namespaces = [vars(module) for module in list(sys.modules.values())]
        own = next(one for one in namespaces if one.get("__file__") == str(mutant.path))
        before, after = own[name], eval(compile(ast.Expression(statement.value), name, "eval"), own)
        for namespace in namespaces:
            if namespace.get(name) is before:
                namespace[name] = after
