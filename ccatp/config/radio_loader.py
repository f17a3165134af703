"""Edge. Reads the configuration of a robot among radio beacons: base file, the system's, the user's, command line."""

import json
from collections.abc import Mapping
from pathlib import Path

from pydantic import ValidationError

from ccatp.config.loader import shipped_config_dir
from ccatp.config.messages import choice_hint, faults_of
from ccatp.config.radio_checks import check_radio_config
from ccatp.config.radio_models import RadioConfig
from ccatp.config.sources import Source, Tree, fault_line, merged, nested, read_source
from ccatp.config.toml_text import Key, format_toml, format_value
from ccatp.errors import ConfigError

BASE_FILE = "radio.toml"
SYSTEMS = ("zigbee", "follow", "cricket")
# A file that names its own beacons means these and no others; on the command line one may be moved.
_WHOLE: tuple[Key, ...] = (
    ("sim", "beacons"),
    ("path_loss", "reference_dbm_of"),
    ("cricket", "networks"),
    ("cricket", "motes"),
    ("cricket", "anchors"),
)


def load_radio_config(
    file: Path | None = None,
    overrides: Mapping[str, object] | None = None,
    config_dir: Path | None = None,
    *,
    simulates: bool = True,
) -> RadioConfig:
    """The whole configuration of a robot among radio beacons.

    ``system`` of the user's file, else of the base file, says which of ``zigbee.toml``, ``follow.toml`` and
    ``cricket.toml`` lies between the two.

    Args:
        file: the user's configuration, or ``None``.
        overrides: dotted keys, stronger than the file; ``None`` values are left out.
        config_dir: folder with ``radio.toml``; the shipped one if ``None``.
        simulates: whether a field of motes is simulated, or its ranges were measured.

    Raises:
        ConfigError: one line with file, line, key, what is wrong and what to do.
    """
    config_dir = config_dir or shipped_config_dir()
    base = read_source(config_dir / BASE_FILE)
    user = read_source(file) if file else Source("", "", {})
    if file is not None and _is_survey(user.tree):
        raise ConfigError(
            f"{file}: is the configuration of a survey of a mirror; give that of a robot among beacons, as cricket.toml"
        )
    command = Source("command line", "", nested(overrides or {}))
    system = read_source(config_dir / f"{_system([command, user, base])}.toml")
    tree: Tree = {}
    for source in (base, system, user):
        tree = merged(tree, source.tree, _WHOLE)
    return _validated(merged(tree, command.tree), [command, user, system, base], simulates)


def is_radio_file(file: Path) -> bool:
    """Whether a configuration file is one of a robot among radio beacons: it names its ``system``.

    Raises:
        ConfigError: it cannot be read.
    """
    return "system" in read_source(file).tree


def _is_survey(tree: Tree) -> bool:
    """Whether a file without a system names a mirror or a world, which only surveys have."""
    run = tree.get("run")
    named = set(run) if isinstance(run, Mapping) else set()
    return "system" not in tree and bool({"mirror", "world"} & (named | set(tree)))


def dump_radio_config(cfg: RadioConfig) -> str:
    """The complete configuration as TOML; ``load_radio_config`` on it gives an equal one."""
    return "# The exact configuration of one run; ccatp run --config FILE repeats it.\n\n" + format_toml(
        cfg.model_dump()
    )


def _system(sources: list[Source]) -> str:
    for source in sources:
        if "system" in source.tree:
            name = source.tree["system"]
            if name not in SYSTEMS:
                hint = choice_hint(str(name), SYSTEMS)
                raise ConfigError(f"{source.place(('system',))}: system = {format_value(name)} is no system; {hint}")
            return str(name)
    raise ConfigError(f"{sources[-1].name}: system is missing; {choice_hint('', SYSTEMS)}")


def _validated(tree: Tree, sources: list[Source], simulates: bool) -> RadioConfig:
    try:
        # by way of JSON, where strict means what it should for TOML: an array is a tuple, "1" is no number
        cfg = RadioConfig.model_validate_json(json.dumps(tree, default=str), strict=True)
    except ValidationError as error:
        faults = faults_of(error.errors(), RadioConfig)
    else:
        faults = check_radio_config(cfg, simulates=simulates)
        if not faults:
            return cfg
    raise ConfigError(*(fault_line(fault, sources) for fault in faults))
