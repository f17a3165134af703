"""Reads the configurations of robots among radio beacons, and of recorded radio data."""

from collections.abc import Mapping
from pathlib import Path

from ccatp.beacons.config.checks import check_mission, check_radio_config
from ccatp.beacons.config.models import RadioConfig, RecordingsConfig
from ccatp.config.checks import Problems
from ccatp.config.load import Overrides, layers, merged, read_source, strongest, validated
from ccatp.config.messages import Key, choice_hint, format_value
from ccatp.config.package import configs_dir
from ccatp.errors import ConfigError

BEACON_FILE, RECORDING_FILE = "radio.toml", "recordings.toml"
SYSTEMS = ("zigbee", "follow", "cricket")
# A file that names its own beacons means these and no others; on the command line one may be moved.
WHOLE: tuple[Key, ...] = (
    ("sim", "beacons"),
    ("path_loss", "reference_dbm_of"),
    ("cricket", "networks"),
    ("cricket", "motes"),
    ("cricket", "anchors"),
)


def load_radio_config(
    file: Path | None = None, overrides: Overrides = None, *, simulates: bool = True, drives: bool = False,
    any_ports: bool = False,
) -> RadioConfig:  # fmt: skip
    """The whole configuration of a robot among radio beacons; arguments as in ``load_config``.

    ``system`` of the user's file, else of the base file ``radio.toml``, says which of ``zigbee.toml``, ``follow.toml``
    and ``cricket.toml`` lies between the two. ``simulates`` says whether a field of motes is simulated, or its ranges
    were measured; ``drives``, whether a mission is to be possible with it.
    """
    command, user, base = sources = layers(BEACON_FILE, file, overrides, any_ports=any_ports)
    run = user.tree.get("run")
    named = set(user.tree) | (set(run) if isinstance(run, Mapping) else set())
    if "system" not in user.tree and {"mirror", "world"} & named:  # which only surveys have
        raise ConfigError(
            f"{file}: is the configuration of a survey of a mirror; give that of a robot among beacons, as cricket.toml"
        )
    source, key = strongest(sources, ("system",))
    name = source.tree.get("system")
    if name is None:
        raise ConfigError(f"{base.name}: system is missing; {choice_hint('', SYSTEMS)}")
    if name not in SYSTEMS:
        hint = choice_hint(str(name), SYSTEMS)
        raise ConfigError(f"{source.place(key)}: system = {format_value(name)} is no system; {hint}")
    system = read_source(configs_dir() / f"{name}.toml")
    tree = merged(merged(base.tree, system.tree, WHOLE), user.tree, WHOLE)
    sources = [command, user, system, base]

    def check(cfg: RadioConfig) -> Problems:
        yield from check_radio_config(cfg, simulates=simulates)
        if drives:
            yield from check_mission(cfg)

    return validated(RadioConfig, merged(tree, command.tree), sources, check)


def load_beacon_mission(
    file: Path | None = None, overrides: Overrides = None, *, any_ports: bool = False
) -> RadioConfig:
    """The configuration of a mission; as ``load_radio_config``, and a mission with it can end."""
    return load_radio_config(file, overrides, drives=True, any_ports=any_ports)


def load_recordings_config(file: Path | None = None, overrides: Overrides = None) -> RecordingsConfig:
    """What is assumed of recorded radio data, by format, as in ``plaza.priors.range_scale``; errors as above."""
    command, user, base = sources = layers(RECORDING_FILE, file, overrides)
    return validated(RecordingsConfig, merged(merged(base.tree, user.tree), command.tree), sources)
