"""Glue. The commands ``ccatp config check`` and ``ccatp config schema``."""

import json
from pathlib import Path

import click

from ccatp.commands.frame import SuggestingGroup, complain, example


@click.group(
    cls=SuggestingGroup, epilog=example("ccatp config check telescope.toml", "ccatp config schema > ccatp.schema.json")
)
def config() -> None:
    """Check and describe configurations."""


@config.command("check", epilog=example("ccatp config check telescope.toml"))
@click.argument("file", type=click.Path(path_type=Path))
def config_check(file: Path) -> int:
    """Check a configuration; each problem is one line with file, line and key."""
    from ccatp.config.loader import load_config
    from ccatp.config.radio_loader import is_radio_file, load_radio_config
    from ccatp.errors import ConfigError

    try:
        if is_radio_file(file):
            beacons = load_radio_config(file)
            click.echo(f"{file}: ok: system {beacons.system}, seed {beacons.run.seed}")
            return 0
        cfg = load_config(file)
    except ConfigError as error:
        for problem in error.problems:
            complain(problem, error.exit_status)
        return error.exit_status
    shown = f"mirror {cfg.mirror.name}, {cfg.mirror.panels.count} panels, world {cfg.world.name}, seed {cfg.run.seed}"
    click.echo(f"{file}: ok: {shown}")
    return 0


@config.command("schema", epilog=example("ccatp config schema > ccatp.schema.json"))
def config_schema() -> None:
    """Print the JSON schema of a configuration file."""
    from ccatp.config.loader import json_schema

    click.echo(json.dumps(json_schema(), indent=2))
