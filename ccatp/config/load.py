"""Reads configurations: the default file, the user's, the command line, laid over each other; edits single keys."""

import difflib
import json
import os
import re
import tempfile
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from ccatp.config.beacon_models import RadioConfig, RecordingsConfig
from ccatp.config.checks import check_config, check_radio_config, is_file_name
from ccatp.config.messages import (
    ConfigProblem,
    Key,
    choice_hint,
    faults_of,
    find_line,
    format_key,
    format_toml,
    format_value,
)
from ccatp.config.models import Config, MirrorConfig, WorldConfig
from ccatp.config.package import configs_dir
from ccatp.errors import ConfigError

Tree = dict[str, Any]
Overrides = Mapping[str, object] | None
M = TypeVar("M", bound=BaseModel)

DEFAULT_FILE, BEACON_FILE, RECORDING_FILE = "ccatp.toml", "radio.toml", "recordings.toml"
SYSTEMS = ("zigbee", "follow", "cricket")
_RUN_FILE = "config.toml"  # of a run directory
_RUN_HEAD = "# The exact configuration of one run; ccatp run --config FILE repeats it.\n\n"
_SECTIONS: dict[str, tuple[str, type[BaseModel]]] = {
    "mirror": ("mirrors", MirrorConfig),
    "world": ("worlds", WorldConfig),
}
# A file that names its own beacons means these and no others; on the command line one may be moved.
_WHOLE: tuple[Key, ...] = (
    ("sim", "beacons"),
    ("path_loss", "reference_dbm_of"),
    ("cricket", "networks"),
    ("cricket", "motes"),
    ("cricket", "anchors"),
)
# In comments: a stand-in value, and what takes its place.
UNVERIFIED, MEASURED = "UNVERIFIED", "measured by ccatp calibrate"


class NotASurvey(ConfigError):
    """A configuration of a mission among beacons where one of a survey is wanted."""


@dataclass(frozen=True, slots=True)
class ConfigSource:
    """One place that values come from: a file, or the command line, which has no text.

    ``name`` is the file's as the user knows it; ``tree`` is the section ``root`` of the configuration.
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


def read_source(path: Path, root: Key = ()) -> ConfigSource:
    """The content of a TOML file, as the section ``root`` of a configuration.

    Raises ConfigError: there is no such file, or it is not TOML.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: {(error.strerror or str(error)).lower()}; name a TOML file that exists") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not UTF-8 text (byte {error.start}); save it as UTF-8") from error
    try:
        return ConfigSource(str(path), text, tomllib.loads(text), root, path.parent)
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, deep nesting
        at = re.search(r" \(at line (\d+), column (\d+)\)", str(error))
        line = int(at[1]) if at else max(1, len(text.splitlines()))
        what = re.sub(r" \(at .*\)$", "", str(error))
        raise ConfigError(f"{path}:{line}: is not TOML: {what[:1].lower()}{what[1:]}") from error


def nested(dotted: Mapping[str, object]) -> Tree:
    """``{"run.seed": 2}`` as ``{"run": {"seed": 2}}``; ``None`` values are left out.

    Raises ConfigError: a key is given both as a value and as a section.
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
    """``above`` laid over ``below``, section by section; arrays and the sections ``whole`` are replaced as a whole."""
    tree = dict(below)
    for name, value in above.items():
        key = (*at, name)
        both = isinstance(value, Mapping) and isinstance(tree.get(name), Mapping) and key not in whole
        tree[name] = merged(tree[name], value, whole, key) if both else value
    return tree


def _layers(base: ConfigSource, file: Path | None, overrides: Overrides) -> list[ConfigSource]:
    """Command line, the user's file, base: the strongest first."""
    user = read_source(file) if file else ConfigSource("", "", {})
    return [ConfigSource("command line", "", nested(overrides or {})), user, base]


def _stacked(sources: Sequence[ConfigSource]) -> Tree:
    tree: Tree = {}
    for source in reversed(sources):
        tree = merged(tree, source.tree)
    return tree


def _source_of(key: Key, sources: Iterable[ConfigSource]) -> ConfigSource:
    """The source that holds most of a key; of equals the strongest, which stands first."""
    return max(sources, key=lambda source: source.depth(key))


def _fault_line(fault: ConfigProblem, sources: list[ConfigSource]) -> str:
    """The line for the reader. Of keys that contradict each other it points to the one nearest to the user."""
    held = [(sources.index(_source_of(key, sources)), key) for key in (fault.key, *fault.related)]
    strength, key = min(held, key=lambda pair: pair[0])
    return f"{sources[strength].place(key)}: {format_key(fault.key)} {fault.what}"


def _validated(
    model: type[M],
    tree: Tree,
    sources: list[ConfigSource],
    check: Callable[[M], list[ConfigProblem]] = lambda _: [],
) -> M:
    try:
        # by way of JSON, where strict means what it should for TOML: an array is a tuple, "1" is no number
        cfg = model.model_validate_json(json.dumps(tree, default=str), strict=True)
    except ValidationError as error:
        faults = faults_of(error.errors(), model)
    else:
        faults = check(cfg)
        if not faults:
            return cfg
    raise ConfigError(*(_fault_line(fault, sources) for fault in faults))


# -- surveys of mirrors -----------------------------------------------------------------------------------------------


def load_config(file: Path | None = None, overrides: Overrides = None, config_dir: Path | None = None) -> Config:
    """The whole configuration of a run.

    The user's file needs only the keys that differ from the default file. ``mirror`` and ``world`` come from the files
    that ``run.mirror`` and ``run.world`` name, a name or the path of a ``.toml`` file; a file with complete sections
    ``[mirror]`` and ``[world]``, as a run directory holds, is taken as it is, and single keys of these sections are
    laid over the named file. Dotted keys in ``overrides`` are stronger than the file; ``None`` values are left out.
    ``config_dir`` (the shipped one by default) has ``ccatp.toml``, ``mirrors/`` and ``worlds/``. Raises ConfigError:
    one line with file, line, key, what is wrong and what to do. Raises NotASurvey: the file is of a mission among
    beacons.
    """
    config_dir = config_dir or configs_dir()
    sources = _layers(read_source(config_dir / DEFAULT_FILE), file, overrides)
    system = sources[1].tree.get("system")
    if file is not None and system is not None:
        use = f"ccatp report {file.parent}" if file.name == _RUN_FILE else "ccatp run or ccatp study with it"
        what = f"{file}: is of a mission among beacons (system = {format_value(system)})"
        raise NotASurvey(f"{what}, and this is for surveys of mirrors alone; use {use}")
    tree = _stacked(sources)
    for section in _SECTIONS:
        _add_section(section, tree, sources, config_dir)
    return _validated(Config, tree, sources, check_config)


def dump_config(cfg: Config | RadioConfig) -> str:
    """The complete configuration as TOML; the loader of its kind gives an equal one."""
    return _RUN_HEAD + format_toml(cfg.model_dump())


def json_schema() -> dict[str, Any]:
    """JSON schema of a configuration file. Nothing is required: what one leaves out comes from the default file."""
    schema = Config.model_json_schema()
    for model in (schema, *schema["$defs"].values()):
        model.pop("required", None)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "ccatp configuration"}


def available(kind: str, config_dir: Path | None = None) -> list[str]:
    """Names of the shipped ``mirror`` or ``world`` files."""
    folder = (config_dir or configs_dir()) / _SECTIONS[kind][0]
    return sorted(path.stem for path in folder.glob("*.toml"))


def _add_section(section: str, tree: Tree, sources: list[ConfigSource], config_dir: Path) -> None:
    """Put mirror or world into the tree: the file that ``run`` names, and over it what file and command line say.

    Where the user's file holds all of it, this is taken, unless the command line names another one.
    """
    command, user = sources[:2]
    held = user.tree.get(section)
    is_complete = isinstance(held, Mapping) and set(_SECTIONS[section][1].model_fields) <= set(held)
    runs = [source.tree.get("run") for source in (command, user)]
    wanted, before = (run.get(section) if isinstance(run, Mapping) else None for run in runs)
    is_replaced = wanted is not None and wanted != before
    if is_complete and not is_replaced:
        named = ConfigSource("", "", {}, (section,))
    else:
        named = _read_named(section, tree["run"], sources, config_dir)
    overlay = (command.tree if is_complete and is_replaced else tree).get(section, {})
    if not isinstance(overlay, Mapping):
        place = _source_of((section,), sources).place((section,))
        raise ConfigError(f"{place}: {section}: must be a section; name a {section} with run.{section}")
    tree[section] = merged(named.tree, overlay)
    sources.append(named)


def _read_named(section: str, run: object, sources: list[ConfigSource], config_dir: Path) -> ConfigSource:
    """The file that ``run.mirror`` or ``run.world`` names."""
    key: Key = ("run", section)
    source = _source_of(key, sources)
    place = source.place(key)
    if not isinstance(run, Mapping):
        raise ConfigError(f"{place}: run = {format_value(run)} must be a section, not a value")
    name = run.get(section)
    if not isinstance(name, str) or not name:
        raise ConfigError(f"{place}: run.{section} = {format_value(name)} must be the name of a {section}")
    shown = f"{place}: run.{section} = {format_value(name)}"
    folder = config_dir / _SECTIONS[section][0]
    path = source.folder / name if is_file_name(name) else folder / f"{name}.toml"
    if not _is_file(path):
        hint = f"no file {path}" if is_file_name(name) else choice_hint(name, available(section, config_dir))
        raise ConfigError(f"{shown} is no {section}; {hint}")
    try:
        return read_source(path, (section,))
    except ConfigError as error:
        raise ConfigError(f"{shown}: {error}") from error


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # no name that a file may have, or in a folder that is not ours
        return False


# -- robots among radio beacons ---------------------------------------------------------------------------------------


def load_radio_config(
    file: Path | None = None, overrides: Overrides = None, config_dir: Path | None = None, *, simulates: bool = True
) -> RadioConfig:
    """The whole configuration of a robot among radio beacons; arguments as in ``load_config``.

    ``system`` of the user's file, else of the base file ``radio.toml``, says which of ``zigbee.toml``, ``follow.toml``
    and ``cricket.toml`` lies between the two. ``simulates`` says whether a field of motes is simulated, or its ranges
    were measured. Raises ConfigError: one line with file, line, key, what is wrong and what to do.
    """
    config_dir = config_dir or configs_dir()
    command, user, base = sources = _layers(read_source(config_dir / BEACON_FILE), file, overrides)
    run = user.tree.get("run")
    named = set(user.tree) | (set(run) if isinstance(run, Mapping) else set())
    if "system" not in user.tree and {"mirror", "world"} & named:  # which only surveys have
        raise ConfigError(
            f"{file}: is the configuration of a survey of a mirror; give that of a robot among beacons, as cricket.toml"
        )
    system = read_source(config_dir / f"{_system(sources)}.toml")
    tree: Tree = {}
    for source in (base, system, user):
        tree = merged(tree, source.tree, _WHOLE)
    tree = merged(tree, command.tree)
    return _validated(
        RadioConfig, tree, [command, user, system, base], lambda cfg: check_radio_config(cfg, simulates=simulates)
    )


def is_radio_file(file: Path) -> bool:
    """Whether a configuration file is one of a robot among radio beacons: it names its ``system``.

    Raises ConfigError: it cannot be read.
    """
    return "system" in read_source(file).tree


def _system(sources: list[ConfigSource]) -> str:
    for source in sources:
        if (name := source.tree.get("system")) is not None:
            if name not in SYSTEMS:
                hint = choice_hint(str(name), SYSTEMS)
                raise ConfigError(f"{source.place(('system',))}: system = {format_value(name)} is no system; {hint}")
            return str(name)
    raise ConfigError(f"{sources[-1].name}: system is missing; {choice_hint('', SYSTEMS)}")


def load_recordings_config(file: Path | None = None, overrides: Overrides = None) -> RecordingsConfig:
    """What is assumed of recorded radio data, by format, as in ``plaza.priors.range_scale``.

    Raises ConfigError: one line with file, line, key, what is wrong and what to do.
    """
    sources = _layers(read_source(configs_dir() / RECORDING_FILE), file, overrides)
    return _validated(RecordingsConfig, _stacked(sources), sources)


# -- changing a file --------------------------------------------------------------------------------------------------


def with_values(text: str, values: Mapping[str, float], file: Path) -> str:
    """The text with other values of some keys, ``section.key``; everything else, comments included, stays.

    A key that is there keeps its comment, but for the mark of unmeasured values; one that is not is added to its
    section. Raises ConfigError: the text is not TOML, or a key stands where no key can be.
    """
    # Imported late: only a command that edits a file needs it, and every process reads one.
    import tomlkit  # noqa: PLC0415
    from tomlkit.exceptions import TOMLKitError  # noqa: PLC0415

    try:
        document = tomlkit.parse(text)
        for dotted, value in values.items():
            section, _, key = dotted.rpartition(".")
            if section not in document:
                if document.as_string().strip():
                    document.add(tomlkit.nl())
                document.add(section, tomlkit.table())
            table = document[section]
            if not isinstance(table, dict):
                raise ConfigError(f"{file}: {section} is a value, not a section; {dotted} cannot be set there")
            table[key] = value
            trivia = table[key].trivia
            trivia.comment = trivia.comment.replace(UNVERIFIED, MEASURED)
        return tomlkit.dumps(document)
    except TOMLKitError as error:
        raise ConfigError(f"{file}: is not TOML: {error}") from error


def difference(before: str, after: str, file: Path) -> str:
    """What would change, as a unified diff; empty where nothing does."""
    old, new = before.splitlines(keepends=True), after.splitlines(keepends=True)
    return "".join(difflib.unified_diff(old, new, fromfile=str(file), tofile=f"{file} (new)"))


def write_in_place(file: Path, text: str) -> None:
    """Replace a file's contents at once: a reader finds the old ones or the new ones, also after a power cut.

    Its mode stays as it is; where it is a link, what it points to is replaced. Raises ConfigError: it cannot be
    written.
    """
    file = file.resolve()
    name: str | None = None
    try:
        handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.")
        with os.fdopen(handle, "w", encoding="utf-8") as out:
            out.write(text)
            out.flush()
            os.fchmod(out.fileno(), file.stat().st_mode & 0o7777)
            os.fsync(out.fileno())
        Path(name).replace(file)
        folder = os.open(file.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        if name is not None:
            Path(name).unlink(missing_ok=True)
        raise ConfigError(f"{file}: cannot be written: {error.strerror or error}") from error
