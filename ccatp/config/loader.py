"""Edge. Reads the configuration: the default file, the user's, the command line, one mirror and one world."""

import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from ccatp.config.checks import check_config, is_file_name
from ccatp.config.messages import Fault, choice_hint, faults_of
from ccatp.config.models import Config, MirrorConfig, WorldConfig
from ccatp.config.toml_text import Key, find_line, format_key, format_toml, format_value
from ccatp.errors import ConfigError
from ccatp.package import configs_dir

Tree = dict[str, Any]

DEFAULT_FILE = "ccatp.toml"
_SECTIONS: dict[str, tuple[str, type[BaseModel]]] = {
    "mirror": ("mirrors", MirrorConfig),
    "world": ("worlds", WorldConfig),
}


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


def shipped_config_dir() -> Path:
    """The folder of the configurations that come with ccatp."""
    return configs_dir()


def load_config(
    file: Path | None = None, overrides: Mapping[str, object] | None = None, config_dir: Path | None = None
) -> Config:
    """The whole configuration of a run.

    The user's file needs only the keys that differ from the default file. ``mirror`` and ``world`` come from the files
    that ``run.mirror`` and ``run.world`` name, a name or the path of a ``.toml`` file; a file with complete sections
    ``[mirror]`` and ``[world]``, as a run directory holds, is taken as it is, and single keys of these sections are
    laid over the named file.

    Args:
        file: the user's configuration, or ``None``.
        overrides: dotted keys, stronger than the file; ``None`` values are left out.
        config_dir: folder with ``ccatp.toml``, ``mirrors/`` and ``worlds/``; the shipped one if ``None``.

    Raises:
        ConfigError: one line with file, line, key, what is wrong and what to do.
    """
    config_dir = config_dir or shipped_config_dir()
    default = _read(config_dir / DEFAULT_FILE)
    user = _read(file) if file else Source("", "", {})
    command = Source("command line", "", _nested(overrides or {}))
    sources = [command, user, default]
    tree: Tree = {}
    for source in reversed(sources):
        tree = _merged(tree, source.tree)
    for section in _SECTIONS:
        named = _named_section(section, tree, sources, config_dir)
        tree[section] = _merged(named.tree, _overlay(section, tree, sources))
        sources.append(named)
    return _validated(tree, sources)


def dump_config(cfg: Config) -> str:
    """The complete configuration as TOML; ``load_config`` on it gives an equal one."""
    return "# The exact configuration of one run; ccatp run --config FILE repeats it.\n\n" + format_toml(
        cfg.model_dump()
    )


def json_schema() -> dict[str, Any]:
    """JSON schema of a configuration file. Nothing is required: what one leaves out comes from the default file."""
    schema = Config.model_json_schema()
    for model in (schema, *schema["$defs"].values()):
        model.pop("required", None)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "ccatp configuration"}


def available(kind: str, config_dir: Path | None = None) -> list[str]:
    """Names of the shipped ``mirror`` or ``world`` files."""
    folder = (config_dir or shipped_config_dir()) / _SECTIONS[kind][0]
    return sorted(path.stem for path in folder.glob("*.toml"))


def _read(path: Path, root: Key = ()) -> Source:
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


def _nested(dotted: Mapping[str, object]) -> Tree:
    """``{"run.seed": 2}`` as ``{"run": {"seed": 2}}``."""
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


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> Tree:
    """``above`` laid over ``below``, section by section; arrays are replaced whole."""
    tree = dict(below)
    for name, value in above.items():
        both = isinstance(value, Mapping) and isinstance(tree.get(name), Mapping)
        tree[name] = _merged(tree[name], value) if both else value
    return tree


def _is_complete(section: str, value: object) -> bool:
    return isinstance(value, Mapping) and set(_SECTIONS[section][1].model_fields) <= set(value)


def _is_replaced(section: str, user: Source, command: Source) -> bool:
    """Whether the command line names another mirror or world than the one that the user's file holds in full."""
    wanted = _get(command.tree, "run", section)
    return wanted is not None and wanted != _get(user.tree, "run", section)


def _overlay(section: str, tree: Tree, sources: list[Source]) -> Mapping[str, Any]:
    """What file and command line say about the section itself."""
    command, user = sources[:2]
    if _is_complete(section, user.tree.get(section)) and _is_replaced(section, user, command):
        overlay = command.tree.get(section, {})
    else:
        overlay = tree.get(section, {})
    if not isinstance(overlay, Mapping):
        place = _source_of((section,), sources).place((section,))
        raise ConfigError(f"{place}: {section}: must be a section; name a {section} with run.{section}")
    return overlay


def _named_section(section: str, tree: Tree, sources: list[Source], config_dir: Path) -> Source:
    """The file that ``run.mirror`` or ``run.world`` names; an empty source where the user's file holds all of it."""
    command, user = sources[:2]
    if _is_complete(section, user.tree.get(section)) and not _is_replaced(section, user, command):
        return Source("", "", {}, (section,))
    key: Key = ("run", section)
    name = _get(tree, "run", section)
    source = _source_of(key, sources)
    if not isinstance(tree["run"], Mapping):
        raise ConfigError(f"{source.place(key)}: run = {format_value(tree['run'])} must be a section, not a value")
    if not isinstance(name, str) or not name:
        raise ConfigError(f"{source.place(key)}: run.{section} = {format_value(name)} must be the name of a {section}")
    folder = config_dir / _SECTIONS[section][0]
    path = source.folder / name if is_file_name(name) else folder / f"{name}.toml"
    if not path.is_file():
        hint = f"no file {path}" if is_file_name(name) else choice_hint(name, available(section, config_dir))
        raise ConfigError(f"{source.place(key)}: run.{section} = {format_value(name)} is no {section}; {hint}")
    return _read(path, (section,))


def _get(tree: object, *key: str) -> object:
    for part in key:
        tree = tree.get(part) if isinstance(tree, Mapping) else None
    return tree


def _source_of(key: Key, sources: Iterable[Source]) -> Source:
    """The source that says most about a key; of equals the strongest, which stands first."""
    return max(sources, key=lambda source: source.depth(key))


def _validated(tree: Tree, sources: list[Source]) -> Config:
    try:
        # by way of JSON, where strict means what it should for TOML: an array is a tuple, "1" is no number
        cfg = Config.model_validate_json(json.dumps(tree, default=str), strict=True)
    except ValidationError as error:
        faults = faults_of(error.errors())
    else:
        faults = check_config(cfg)
        if not faults:
            return cfg
    raise ConfigError(*(_line(fault, sources) for fault in faults))


def _line(fault: Fault, sources: list[Source]) -> str:
    """The line for the reader. Of keys that contradict each other it points to the one nearest to the user."""
    held = [(sources.index(_source_of(key, sources)), key) for key in (fault.key, *fault.related)]
    strength, key = min(held, key=lambda pair: pair[0])
    return f"{sources[strength].place(key)}: {format_key(fault.key)} {fault.what}"
