"""Reads configurations from the default file, the user's file and the command line; edits single keys."""

import difflib
import json
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Protocol, TypeVar

from pydantic import BaseModel, ValidationError

from ccatp.config.checks import check_config, check_onboard_config, is_file_name
from ccatp.config.files import read_toml
from ccatp.config.messages import (
    ConfigProblem,
    Key,
    choice_hint,
    depth_in,
    faults_of,
    find_line,
    format_key,
    format_value,
    parse_toml,
)
from ccatp.config.mission import CommonConfig
from ccatp.config.models import Config, MirrorConfig, WorldConfig
from ccatp.config.onboard_models import OnboardConfig
from ccatp.config.package import configs_dir
from ccatp.errors import ConfigError
from ccatp.missions import SURVEY, MissionKind, all_kinds, find_kind

Tree = dict[str, Any]
Overrides = Mapping[str, object] | None
M = TypeVar("M", bound=BaseModel)
Check = Callable[[M], Iterable[ConfigProblem]]

DEFAULT_FILE, ONBOARD_FILE = "ccatp.toml", "onboard.toml"
_RUN_FILE = "config.toml"  # of a run directory
# Of a run's file. Its last line has the checksum of all before: what is missing would be taken from the defaults.
_RUN_HEAD = "# The exact configuration of one run, to its last line; ccatp run --config FILE repeats it.\n\n"
_RUN_END = "\n# End of the configuration"
_CHECKSUM = ", checksum {:08x}.\n"
_NO_CHECKSUM = ".\n"  # of older versions, whose first ones have neither head nor end
# Either of them is in the folder of a run before its configuration is.
_RUN_MARKS = ("origin.json", "mission.sqlite")
_SECTIONS: dict[str, tuple[str, type[BaseModel]]] = {
    "mirror": ("mirrors", MirrorConfig),
    "world": ("worlds", WorldConfig),
}
# Keys that have another place or name now: files and recordings of before are read as they were meant.
_MOVED = {
    ("robot", "slip_after_s"): ("robot", "late_after_s"),
    ("health", "grip_slip_m_s"): ("health", "grip_slide_m_s"),
    ("robot", "grip_slip_m_s"): ("robot", "grip_slide_m_s"),  # of the on-board program
} | {
    ("localizer", name): ("localizer", "four_state", name)
    for name in (
        *("jerk_density_m2_s5", "angular_acceleration_density_rad2_s3", "slip_fraction"),
        *("crossing_time_sigma_s", "crossing_max_rate_rad_s", "crossing_min_speed_m_s", "crossing_gate_sigma"),
    )
}
_MOST_PROBLEMS = 10  # that one error lists
# In comments: a stand-in value, and what takes its place.
UNVERIFIED, MEASURED = "UNVERIFIED", "measured by ccatp calibrate"


class NotASurvey(ConfigError):
    """A configuration of another kind of mission where one of a survey is wanted."""


@dataclass(frozen=True, slots=True)
class ConfigSource:
    """One place that values come from: a file, or the command line, which has no text."""

    name: str  # of the file, as the user knows it
    text: str
    tree: Tree  # the section ``root`` of the configuration
    root: Key = ()

    def depth(self, key: Key) -> int:
        """Number of parts of a key that this source contains."""
        inside = len(self.root)
        return inside + depth_in(self.tree, key[inside:]) if key[:inside] == self.root else 0

    def place(self, key: Key) -> str:
        """``file:line`` of a key."""
        line = find_line(self.text, key[len(self.root) :])
        return f"{self.name}:{line}" if line else self.name


def read_source(path: Path, root: Key = ()) -> ConfigSource:
    """A TOML file as the section ``root`` of a configuration; ConfigError: there is no such file, or it is not TOML."""
    text = read_toml(path)
    return ConfigSource(str(path), text, parse_toml(text, str(path)), root)


def nested(dotted: Mapping[str, object]) -> Tree:
    """``{"run.seed": 2}`` as ``{"run": {"seed": 2}}``, without ``None``; ConfigError: a key is value and section."""
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


def layers(base: str, file: Path | None, overrides: Overrides, *, any_ports: bool = False) -> list[ConfigSource]:
    """Command line, the user's file, base: the strongest first, with keys of older versions at their present places."""
    user = read_source(file) if file else ConfigSource("", "", {})
    if file is not None:
        _check_whole(file, user)
    command = ConfigSource("command line", "", nested(overrides or {}))
    below = read_source(configs_dir() / base)
    for server in below.tree["sim"].values() if any_ports else ():
        if isinstance(server, dict) and "port" in server:
            server["port"] = 0
    return [replace(source, tree=_with_moved_keys(source.tree)) for source in (command, user, below)]


def _check_whole(file: Path, source: ConfigSource) -> None:
    """Refuse the configuration of a run that is not as the run wrote it; another file may hold any few keys."""
    if file.name != _RUN_FILE or not any(file.with_name(name).exists() for name in _RUN_MARKS):
        return
    what = _damage(source.text) if source.tree else "is empty"
    if what:
        advice = "put back a copy; if you edited it on purpose, rename it and name it with --config"
        raise ConfigError(f"{file}: {what}, so the configuration of the run is not known; {advice}")


def _damage(text: str) -> str:
    """How the text of a run's file differs from what the run wrote; empty if it does not, or that is not known."""
    body, end, rest = text.rpartition(_RUN_END)
    is_begun = text.startswith(_RUN_HEAD)
    if not end:
        return "is cut off: its last line is missing" if is_begun else ""
    if rest == _NO_CHECKSUM:
        return "" if is_begun else "is cut off: its first line is missing"
    if rest != _checksum(body):
        return "was changed or cut off after the run wrote it"
    return ""


def _checksum(body: str) -> str:
    return _CHECKSUM.format(zlib.crc32(body.encode()))


def strongest(sources: list[ConfigSource], *keys: Key) -> tuple[ConfigSource, Key]:
    """Of contradicting keys the one from the strongest source, and this source."""
    held: list[tuple[ConfigSource, Key]] = []
    for key in keys:
        depths = [source.depth(key) for source in sources]
        held.append((sources[depths.index(max(depths))], key))
    return min(held, key=lambda pair: sources.index(pair[0]))


def _place(sources: list[ConfigSource], *keys: Key) -> str:
    """``file:line`` of the key from the strongest source."""
    source, key = strongest(sources, *keys)
    return source.place(key)


def _with_moved_keys(tree: Tree) -> Tree:
    """A tree with the keys of older versions at their present places; where both are given, the present one counts."""
    for old, new in _MOVED.items():
        section = _value(tree, *old[:-1])
        if isinstance(section, dict) and old[-1] in section:
            tree = merged(nested({".".join(new): section.pop(old[-1])}), tree)
    return tree


def _value(tree: object, *key: str) -> Any:
    """Value of a key; ``None`` if there is none."""
    for part in key:
        tree = tree.get(part) if isinstance(tree, Mapping) else None
    return tree


def validated(model: type[M], tree: Tree, sources: list[ConfigSource], check: Check[M] = lambda _: ()) -> M:
    """The values of a tree as a model; ConfigError: one line with file, line, key, what is wrong and what to do."""
    try:
        # through JSON, for which strict mode fits TOML: an array is a tuple, "1" is not a number
        cfg = model.model_validate_json(json.dumps(tree, default=str), strict=True)
    except ValidationError as error:
        problems = list(islice(faults_of(error.errors(include_url=False), model), _MOST_PROBLEMS + 1))
    else:
        problems = list(islice(check(cfg), _MOST_PROBLEMS + 1))
        if not problems:
            return cfg
    if len(problems) > _MOST_PROBLEMS:
        problems[-1] = problems[-1]._replace(what="is wrong as well, and maybe others; correct the first ones")
    raise ConfigError(*(f"{_place(sources, key, *others)}: {format_key(key)} {what}" for key, what, others in problems))


# -- surveys of mirrors -----------------------------------------------------------------------------------------------


def load_config(file: Path | None = None, overrides: Overrides = None, *, any_ports: bool = False) -> Config:
    """The whole configuration of a run.

    The user's file needs only the keys that differ from the default file. ``mirror`` and ``world`` come from the files
    that ``run.mirror`` and ``run.world`` name, a name or the path of a ``.toml`` file; a file with complete sections
    ``[mirror]`` and ``[world]``, as a run directory holds, is taken as it is, and single keys of these sections are
    laid over the named file. Dotted keys in ``overrides`` are stronger than the file; ``None`` values are left out.
    ``any_ports``: the simulated servers take any free port unless file or overrides name one. ConfigError: one line
    with file, line, key, what is wrong and what to do; NotASurvey: the file is of another kind of mission.
    """
    command, user, base = sources = layers(DEFAULT_FILE, file, overrides, any_ports=any_ports)
    system = user.tree.pop("system", SURVEY)
    if file is not None and system != SURVEY:
        kind = find_kind(system)
        use = f"ccatp report {file.parent}" if file.name == _RUN_FILE else "ccatp run or ccatp study with it"
        what = f"{file}: is of a {kind.title if kind else 'mission'} (system = {format_value(system)})"
        raise NotASurvey(f"{what}, and this is for surveys of mirrors alone; use {use}")
    tree = merged(merged(base.tree, user.tree), command.tree)
    problems: list[str] = []
    for section in _SECTIONS:
        try:
            tree[section] = _section(section, tree, sources)
        except ConfigError as error:
            problems += error.problems
    if problems:
        raise ConfigError(*problems)
    return validated(Config, tree, sources, check_config)


def dump_config(cfg: CommonConfig) -> str:
    """The complete configuration as TOML; the loader of its kind gives an equal one."""
    import tomlkit  # noqa: PLC0415 - only a command that writes a file needs it, and every process reads one

    body = _RUN_HEAD + tomlkit.dumps(cfg.model_dump())
    return body + _RUN_END + _checksum(body)


def available(kind: str) -> list[str]:
    """Names of the shipped ``mirror`` or ``world`` files."""
    return sorted(path.stem for path in (configs_dir() / _SECTIONS[kind][0]).glob("*.toml"))


def _section(section: str, tree: Tree, sources: list[ConfigSource]) -> Tree:
    """Mirror or world: the file that ``run`` names, which joins the sources, under what file and command line say.

    Where the user's file holds all of it, this is taken, unless the command line names another one.
    """
    command, user = sources[:2]
    held, wanted = _value(user.tree, section), _value(command.tree, "run", section)
    is_complete = isinstance(held, Mapping) and set(_SECTIONS[section][1].model_fields) <= set(held)
    is_replaced = wanted not in (None, _value(user.tree, "run", section))
    overlay = (command.tree if is_complete and is_replaced else tree).get(section, {})
    if not isinstance(overlay, Mapping):
        place = _place(sources, (section,))
        raise ConfigError(f"{place}: {section}: must be a section; name a {section} with run.{section}")
    if is_complete and not is_replaced:
        return dict(overlay)
    named = _read_named(section, tree["run"], sources)
    sources.append(named)
    return merged(named.tree, overlay)


def _read_named(section: str, run: object, sources: list[ConfigSource]) -> ConfigSource:
    """The file that ``run.mirror`` or ``run.world`` names."""
    source, key = strongest(sources, ("run", section))
    if not isinstance(run, Mapping):
        raise ConfigError(f"{source.place(key)}: run = {format_value(run)} must be a section, not a value")
    name = run.get(section)

    def refusal(why: str) -> ConfigError:
        return ConfigError(f"{source.place(key)}: run.{section} = {format_value(name)}{why}")

    if not isinstance(name, str) or not name:
        raise refusal(f" must be the name of a {section}")
    if is_file_name(name):
        path = Path(source.name).parent / name
    elif name in (names := available(section)):
        path = configs_dir() / _SECTIONS[section][0] / f"{name}.toml"
    else:
        raise refusal(f" is no {section}; {choice_hint(name, names)}")
    try:
        return read_source(path, (section,))
    except ConfigError as error:
        raise refusal(f": {error}") from error


# -- any kind of mission -----------------------------------------------------------------------------------------------


class LoadConfig(Protocol):
    """Loads a configuration of one kind, as ``load_config``."""

    def __call__(self, file: Path | None = None, overrides: Overrides = None, *, any_ports: bool = False) -> Any:
        """The configuration; ConfigError: one line with file, line, key, what is wrong and what to do."""


def kind_in(file: Path | None, overrides: Overrides = None) -> MissionKind:
    """The kind of mission of a configuration: that of ``system`` on the command line, else in the file.

    Raises ConfigError: there is no such kind, or the file cannot be read.
    """
    command = ConfigSource("command line", "", nested(overrides or {}))
    sources = [command] if file is None else [command, read_source(file)]
    source, key = strongest(sources, ("system",))
    system = source.tree.get("system", SURVEY)
    kind = find_kind(system)
    if kind is None:
        names = [name for one in all_kinds() for name in one.systems]
        shown = format_value(system)
        raise ConfigError(f"{source.place(key)}: system = {shown} is no system; {choice_hint(str(system), names)}")
    return kind


def load_mission(file: Path | None = None, overrides: Overrides = None, *, any_ports: bool = False) -> CommonConfig:
    """The configuration of any kind of mission; arguments and errors as of ``load_config`` and ``kind_in``."""
    load: LoadConfig = kind_in(file, overrides).load.get()
    cfg: CommonConfig = load(file, overrides, any_ports=any_ports)
    return cfg


# -- the on-board program ----------------------------------------------------------------------------------------------


def load_onboard_config(file: Path | None = None, overrides: Overrides = None) -> OnboardConfig:
    """The configuration of the on-board program; errors as of ``load_config``."""
    command, user, base = sources = layers(ONBOARD_FILE, file, overrides)
    tree = merged(merged(base.tree, user.tree), command.tree)
    return validated(OnboardConfig, tree, sources, check_onboard_config)


# -- changing a file --------------------------------------------------------------------------------------------------


def with_values(text: str, values: Mapping[str, float], file: Path) -> str:
    """The text with other values of some keys, ``section.key``; everything else, comments included, stays.

    A key that is there keeps its comment, but for the mark of unmeasured values; one that is not is added to its
    section. Raises ConfigError: the text is not TOML, or a key stands where no key can be.
    """
    import tomlkit  # noqa: PLC0415 - as in dump_config
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
