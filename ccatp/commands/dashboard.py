"""Glue. The command ``ccatp dashboard``."""

from collections.abc import Mapping
from pathlib import Path

import click

from ccatp.commands.frame import ADDRESS_OPTIONS, RUNTIME_DIR_OPTION, example, overrides, settings_option


@click.command(
    epilog=example(
        "ccatp dashboard", "ccatp dashboard --port 8080", "ccatp dashboard --host 0.0.0.0 --token-file page.token"
    )
)
@ADDRESS_OPTIONS
@click.option("--token-file", type=click.Path(path_type=Path), help="File with the token that commands have to carry.")
@RUNTIME_DIR_OPTION
@settings_option("A key of dashboard, as in dashboard.rate_hz=5.")
def dashboard(
    host: str | None,
    port: int | None,
    token_file: Path | None,
    runtime_dir: Path | None,
    settings: Mapping[str, object],
) -> int:
    """Show a running daemon on a web page, and command it from there; Ctrl-C ends the page and nothing else.

    A run has a page of its own unless dashboard.enabled is false.
    """
    from ccatp.processes.attaching import attach

    named = {
        "dashboard.host": host,
        "dashboard.port": port,
        "dashboard.token_file": None if token_file is None else str(token_file),
    }
    return attach(runtime_dir, overrides(settings, named), click.echo)
