"""Sizes of a source tree: lines, classes and functions, and which module imports which."""

import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

SMALL_FILE_LINES = 60
_LOOP = re.compile(r"ccatp\.daemon\.(loops\.)?(main_loop|danger_loop)")
_NAMED = (ast.Name, ast.Attribute)
_LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


class Source(NamedTuple):
    """One Python file. ``code_lines`` bear a token that is neither comment nor docstring."""

    module: str
    lines: int
    code_lines: int
    docstring_lines: int
    classes: tuple[str, ...]
    functions: int
    imports: frozenset[str]  # candidates: every dotted name that an import statement may mean
    parts: frozenset[str]  # modules of the parts of a kind of mission that move the robot, named by a string
    config_checks: int  # isinstance of a configuration
    bare_tuples: int  # functions that return a tuple of three or more values without a name
    attributes: Mapping[str, int]  # by class: attributes that its methods set on self


def read_sources(root: Path, package: str) -> list[Source]:
    """Every Python file of the package or folder ``package`` below ``root``, but for hidden folders and caches."""
    return [read_source(path, _module_name(path, root)) for path in sorted((root / package).rglob("*.py"))]


def read_source(path: Path, module: str) -> Source:
    """One file, measured."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    docstrings = {line for first, last in _docstrings(tree) for line in range(first, last + 1)}
    nodes = list(ast.walk(tree))
    return Source(
        module,
        len(text.splitlines()),
        len(_token_lines(text) - docstrings),
        len(docstrings),
        tuple(node.name for node in nodes if isinstance(node, ast.ClassDef)),
        sum(isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) for node in nodes),
        frozenset(name for node in nodes for name in _imported(node)),
        frozenset(name for node in nodes for name in _parts(node)),
        sum(_is_config_check(node) for node in nodes),
        sum(_returns_bare_tuple(node) for node in nodes),
        {node.name: len(_attributes(node)) for node in nodes if isinstance(node, ast.ClassDef)},
    )


def moving_sources(sources: Iterable[Source]) -> list[Source]:
    """What can move the robot of a survey: all that main loop and danger loop import, without the indoor robots."""
    known = {source.module: source for source in sources if ".beacons" not in source.module}
    parts = {name for source in known.values() for name in source.parts}
    waiting = [name for name in known if _LOOP.fullmatch(name)] + sorted(parts & known.keys())
    found: set[str] = set()
    while waiting:
        if (name := waiting.pop()) in found:
            continue
        found.add(name)
        parents = {name.rpartition(".")[0]} if "." in name else set()
        waiting += ((known[name].imports | parents) & known.keys()) - found
    return [known[name] for name in sorted(found)]


def largest_classes(sources: Iterable[Source], count: int) -> list[tuple[str, int]]:
    """Classes with the most attributes, and how many they have."""
    every = [(f"{source.module}.{name}", size) for source in sources for name, size in source.attributes.items()]
    return sorted(every, key=lambda one: (-one[1], one[0]))[:count]


def duplicate_classes(sources: Iterable[Source]) -> list[str]:
    """Names of classes that are defined more than once, sorted."""
    count = Counter(name for source in sources for name in source.classes)
    return sorted(name for name, times in count.items() if times > 1)


def single_importer_modules(sources: Iterable[Source]) -> list[str]:
    """Modules that exactly one other module of ``sources`` imports, sorted. A package is its ``__init__``."""
    sources = list(sources)
    modules = {source.module for source in sources}
    importers = Counter(name for source in sources for name in source.imports & modules if name != source.module)
    return sorted(name for name, times in importers.items() if times == 1)


def _module_name(path: Path, root: Path) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _token_lines(text: str) -> set[int]:
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return {line for token in tokens if token.type not in _LAYOUT for line in range(token.start[0], token.end[0] + 1)}


def _docstrings(tree: ast.Module) -> Iterator[tuple[int, int]]:
    """First and last line of every string that stands alone, also of one that describes an attribute."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.end_lineno or node.lineno


def _imported(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module is not None and not node.level:
        yield node.module
        yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _parts(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.keyword) and node.arg in ("runner", "rules") and isinstance(node.value, ast.Call):
        places = [one.value for one in node.value.args if isinstance(one, ast.Constant) and isinstance(one.value, str)]
        yield from (place.partition(":")[0] for place in places)


def _is_config_check(node: ast.AST) -> bool:
    if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "isinstance"):
        return False
    names = [
        one.id if isinstance(one, ast.Name) else one.attr for one in ast.walk(node.args[1]) if isinstance(one, _NAMED)
    ]
    return any(name.endswith("Config") for name in names)


def _returns_bare_tuple(node: ast.AST) -> bool:
    returned = node.returns if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) else None
    if not (isinstance(returned, ast.Subscript) and isinstance(returned.slice, ast.Tuple)):
        return False
    values = returned.slice.elts
    is_tuple = isinstance(returned.value, ast.Name) and returned.value.id == "tuple"
    is_open = any(isinstance(one, ast.Constant) and one.value is Ellipsis for one in values)
    return is_tuple and not is_open and len(values) > 2


def _attributes(node: ast.ClassDef) -> set[str]:
    targets = [one for one in ast.walk(node) if isinstance(one, ast.Attribute) and isinstance(one.ctx, ast.Store)]
    return {one.attr for one in targets if isinstance(one.value, ast.Name) and one.value.id == "self"}
