"""Edge. Reads the configuration: the default file, the user's, the command line, one mirror and one world."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from ccatp.config.checks import check_config, is_file_name
from ccatp.config.messages import choice_hint, faults_of
from ccatp.config.models import Config, MirrorConfig, WorldConfig
from ccatp.config.sources import Source, Tree, fault_line, merged, nested, read_source, source_of
from ccatp.config.toml_text import Key, format_toml, format_value
from ccatp.errors import ConfigError
from ccatp.package import configs_dir

DEFAULT_FILE = "ccatp.toml"
_RUN_FILE = "config.toml"  # of a run directory
_SECTIONS: dict[str, tuple[str, type[BaseModel]]] = {
    "mirror": ("mirrors", MirrorConfig),
    "world": ("worlds", WorldConfig),
}


class NotASurvey(ConfigError):
    """A configuration of a mission among beacons where one of a survey is wanted."""


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
        NotASurvey: the file is of a mission among beacons.
    """
    config_dir = config_dir or shipped_config_dir()
    default = read_source(config_dir / DEFAULT_FILE)
    user = read_source(file) if file else Source("", "", {})
    _refuse_beacons(user, file)
    command = Source("command line", "", nested(overrides or {}))
    sources = [command, user, default]
    tree: Tree = {}
    for source in reversed(sources):
        tree = merged(tree, source.tree)
    for section in _SECTIONS:
        named = _named_section(section, tree, sources, config_dir)
        tree[section] = merged(named.tree, _overlay(section, tree, sources))
        sources.append(named)
    return _validated(tree, sources)


def _refuse_beacons(user: Source, file: Path | None) -> None:
    if file is None or "system" not in user.tree:
        return
    name = f"{file}: is of a mission among beacons (system = {format_value(user.tree['system'])})"
    if file.name == _RUN_FILE:
        raise NotASurvey(f"{name}, and this is for surveys of mirrors alone; use ccatp report {file.parent}")
    raise NotASurvey(f"{name}, and this is for surveys of mirrors alone; use ccatp run or ccatp study with it")


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
        place = source_of((section,), sources).place((section,))
        raise ConfigError(f"{place}: {section}: must be a section; name a {section} with run.{section}")
    return overlay


def _named_section(section: str, tree: Tree, sources: list[Source], config_dir: Path) -> Source:
    """The file that ``run.mirror`` or ``run.world`` names; an empty source where the user's file holds all of it."""
    command, user = sources[:2]
    if _is_complete(section, user.tree.get(section)) and not _is_replaced(section, user, command):
        return Source("", "", {}, (section,))
    key: Key = ("run", section)
    name = _get(tree, "run", section)
    source = source_of(key, sources)
    if not isinstance(tree["run"], Mapping):
        raise ConfigError(f"{source.place(key)}: run = {format_value(tree['run'])} must be a section, not a value")
    if not isinstance(name, str) or not name:
        raise ConfigError(f"{source.place(key)}: run.{section} = {format_value(name)} must be the name of a {section}")
    folder = config_dir / _SECTIONS[section][0]
    path = source.folder / name if is_file_name(name) else folder / f"{name}.toml"
    if not _is_file(path):
        hint = f"no file {path}" if is_file_name(name) else choice_hint(name, available(section, config_dir))
        raise ConfigError(f"{source.place(key)}: run.{section} = {format_value(name)} is no {section}; {hint}")
    try:
        return read_source(path, (section,))
    except ConfigError as error:
        raise ConfigError(f"{source.place(key)}: run.{section} = {format_value(name)}: {error}") from error


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # no name that a file may have, or in a folder that is not ours
        return False


def _get(tree: object, *key: str) -> object:
    for part in key:
        tree = tree.get(part) if isinstance(tree, Mapping) else None
    return tree


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
    raise ConfigError(*(fault_line(fault, sources) for fault in faults))
