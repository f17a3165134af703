"""Edge. Where the values of a configuration come from: files and the command line, laid over each other."""

import re
import tomllib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ccatp.config.messages import Fault
from ccatp.config.toml_text import Key, find_line, format_key
from ccatp.errors import ConfigError

Tree = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Source:
    """One place that values come from.

    Attributes:
        name: file name as the user knows it, or ``command line``.
        text: the file's text; empty for the command line.
        tree: what it says.
        root: the section of the configuration that ``tree`` is.
        folder: what relative file names in it refer to.
    """

    name: str
    text: str
    tree: Tree
    root: Key = ()
    folder: Path = Path()

    def depth(self, key: Key) -> int:
        """How many parts of a key this source holds; all of them where it holds a value in place of a section."""
        if key[: len(self.root)] != self.root:
            return 0
        node: object = self.tree
        for depth, part in enumerate(key[len(self.root) :], start=len(self.root)):
            if not isinstance(node, Mapping):
                break
            if part not in node:
                return depth
            node = node[part]
        return len(key)

    def place(self, key: Key) -> str:
        """``file:line`` of a key."""
        line = find_line(self.text, key[len(self.root) :])
        return f"{self.name}:{line}" if line else self.name


def read_source(path: Path, root: Key = ()) -> Source:
    """What a TOML file says, as the section ``root`` of a configuration.

    Raises:
        ConfigError: there is no such file, or it is not TOML.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: {(error.strerror or str(error)).lower()}; name a TOML file that exists") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not UTF-8 text (byte {error.start}); save it as UTF-8") from error
    try:
        return Source(str(path), text, tomllib.loads(text), root, path.parent)
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, deep nesting
        at = re.search(r" \(at line (\d+), column (\d+)\)", str(error))
        line = int(at[1]) if at else max(1, len(text.splitlines()))
        what = re.sub(r" \(at .*\)$", "", str(error))
        raise ConfigError(f"{path}:{line}: is not TOML: {what[:1].lower()}{what[1:]}") from error


def nested(dotted: Mapping[str, object]) -> Tree:
    """``{"run.seed": 2}`` as ``{"run": {"seed": 2}}``.

    Raises:
        ConfigError: a key is given both as a value and as a section.
    """
    tree: Tree = {}
    for key, value in dotted.items():
        if value is None:
            continue
        *sections, name = key.split(".")
        node = tree
        for section in sections:
            node = node.setdefault(section, {})
            if not isinstance(node, dict):
                raise ConfigError(f"command line: {key}: {section} is given as a value already; give one of them")
        node[name] = value
    return tree


def merged(
    below: Mapping[str, Any], above: Mapping[str, Any], whole: Collection[Key] = (), at: tuple[str, ...] = ()
) -> Tree:
    """``above`` laid over ``below``, section by section; arrays are replaced whole.

    Args:
        below: what the weaker source says.
        above: what the stronger one says.
        whole: sections that are lists by name: they are replaced whole, too.
        at: where in the configuration the two stand.
    """
    tree = dict(below)
    for name, value in above.items():
        key = (*at, name)
        both = isinstance(value, Mapping) and isinstance(tree.get(name), Mapping) and key not in whole
        tree[name] = merged(tree[name], value, whole, key) if both else value
    return tree


def source_of(key: Key, sources: Iterable[Source]) -> Source:
    """The source that says most about a key; of equals the strongest, which stands first."""
    return max(sources, key=lambda source: source.depth(key))


def fault_line(fault: Fault, sources: list[Source]) -> str:
    """The line for the reader. Of keys that contradict each other it points to the one nearest to the user."""
    held = [(sources.index(source_of(key, sources)), key) for key in (fault.key, *fault.related)]
    strength, key = min(held, key=lambda pair: pair[0])
    return f"{sources[strength].place(key)}: {format_key(fault.key)} {fault.what}"
