"""Sizes of a source tree: lines, classes and functions, and which module imports which."""

import ast
import io
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

SMALL_FILE_LINES = 60
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
    )


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
