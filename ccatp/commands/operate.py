"""Glue. The commands of the operator: ``ccatp pause``, ``resume``, ``abort`` and ``stop``."""

from pathlib import Path
from typing import Any

import click

from ccatp.commands.frame import DAEMON_OPTIONS, ask_daemon, configured_folder, example, tell_status


@click.command(epilog=example("ccatp pause"))
@DAEMON_OPTIONS
def pause(config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool) -> None:
    """Stop the robot where it is, until resume."""
    tell_status(_ask("pause", config_file, runtime_dir, timeout_s), json_output)


@click.command(epilog=example("ccatp resume"))
@DAEMON_OPTIONS
def resume(config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool) -> None:
    """Carry on after pause."""
    tell_status(_ask("resume", config_file, runtime_dir, timeout_s), json_output)


@click.command(epilog=example("ccatp abort"))
@DAEMON_OPTIONS
def abort(config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool) -> None:
    """Give up the survey and drive the robot to its base."""
    tell_status(_ask("abort", config_file, runtime_dir, timeout_s), json_output)


@click.command(epilog=example("ccatp stop"))
@DAEMON_OPTIONS
def stop(config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool) -> None:
    """Hold the wheels where the robot is, save, and end the daemon."""
    tell_status(_ask("stop", config_file, runtime_dir, timeout_s), json_output)


def _ask(command: str, config_file: Path | None, runtime_dir: Path | None, timeout_s: float) -> dict[str, Any]:
    return ask_daemon(configured_folder(config_file, runtime_dir), "control", {"cmd": command}, timeout_s)
