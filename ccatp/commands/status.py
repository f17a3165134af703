"""Glue. The command ``ccatp status``."""

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from ccatp.commands.frame import (
    CONFIG_OPTION,
    RUNTIME_DIR_OPTION,
    TIMEOUT_OPTION,
    ask_daemon,
    configured_folder,
    example,
    tell_status,
)
from ccatp.errors import UnreachableError

# Without a terminal a line is told at a change, and at least this often.
QUIET_S = 10.0


@click.command(
    epilog=example("ccatp status", "ccatp status --watch", "ccatp status --watch --json | jq -c .status.done")
)
@CONFIG_OPTION
@RUNTIME_DIR_OPTION
@TIMEOUT_OPTION
@click.option("--watch", is_flag=True, help="Go on until the run is over.")
@click.option(
    "--every", "period_s", type=click.FloatRange(0.1, 3600.0), default=1.0, show_default=True, metavar="SECONDS",
    help="With --watch: look this often.",
)  # fmt: skip
@click.option("--json", "json_output", is_flag=True, help="The daemon's answer as JSON; with --watch one a line.")
def status(
    config_file: Path | None, runtime_dir: Path | None, timeout_s: float, watch: bool, period_s: float,
    json_output: bool,
) -> int:  # fmt: skip
    """Show what the running daemon is doing."""
    folder = configured_folder(config_file, runtime_dir)
    if not watch:
        tell_status(ask_daemon(folder, "control", {"cmd": "status"}, timeout_s), json_output)
        return 0
    answers = _answers(folder, timeout_s, period_s)
    if json_output:
        for answer in answers:
            click.echo(json.dumps(answer))
            sys.stdout.flush()
    elif sys.stdout.isatty():
        _watch_terminal(answers)
    else:
        _watch_lines(answers)
    return 0


def _answers(folder: Path | None, timeout_s: float, period_s: float) -> Iterator[dict[str, Any]]:
    """One after the other, until the run is over or its daemon, which was there, is gone."""
    is_seen = False
    while True:
        try:
            answer = ask_daemon(folder, "control", {"cmd": "status"}, timeout_s)
        except UnreachableError:
            if not is_seen:
                raise
            return
        is_seen = True
        yield answer
        if answer.get("status", {}).get("exit_status", -1) >= 0:
            return
        time.sleep(period_s)


def _watch_lines(answers: Iterator[dict[str, Any]]) -> None:
    from ccatp.status_table import status_line

    told: tuple[object, ...] = ()
    told_s = 0.0
    for answer in answers:
        found = answer.get("status", {})
        news = (found.get("state"), found.get("done"), found.get("cause"))
        if news != told or time.monotonic() - told_s >= QUIET_S:
            told, told_s = news, time.monotonic()
            click.echo(status_line(found))
            sys.stdout.flush()


def _watch_terminal(answers: Iterator[dict[str, Any]]) -> None:
    from rich.live import Live
    from rich.table import Table

    from ccatp.status_table import status_rows

    with Live(auto_refresh=False) as live:
        for answer in answers:
            table = Table(box=None, show_header=False, pad_edge=False)
            table.add_column(style="bold")
            table.add_column(overflow="fold")
            for name, value in status_rows(answer.get("status", {})):
                style = "red" if name in ("cause", "danger") and value not in ("", "0 normal") else ""
                table.add_row(name, value.replace("[", "\\["), style=style)
            live.update(table, refresh=True)
