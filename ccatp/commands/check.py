"""Glue. The command ``ccatp check``."""

import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ccatp.commands.frame import RUNTIME_DIR_OPTION, WORLD_OPTIONS, example, overrides
from ccatp.errors import ConfigError, ExitStatus

if TYPE_CHECKING:
    from ccatp.checking.finding import Finding
    from ccatp.config.models import Config

STYLES = {"pass": "green", "warn": "yellow", "fail": "bold red", "skip": "dim"}


@click.command(epilog=example("ccatp check --config telescope.toml", "ccatp check --sim", "ccatp check --sim --json"))
@click.option("--sim", is_flag=True, help="Start the stand-ins of robot and laser system, and check those.")
@WORLD_OPTIONS
@click.option(
    "--runs-dir", type=click.Path(path_type=Path), default="runs", show_default=True, help="Of the recordings."
)
@click.option("--json", "json_output", is_flag=True, help="As JSON on standard output, nothing else there.")
@RUNTIME_DIR_OPTION
def check(
    sim: bool, config_file: Path | None, mirror: str | None, world: str | None, seed: int | None,
    settings: Mapping[str, object], runs_dir: Path, json_output: bool, runtime_dir: Path | None,
) -> int:  # fmt: skip
    """Look at everything a mission needs before it begins: robot, laser system, sensors, clock, disk, keys.

    The robot stands at base. Nothing moves. The status is 1 where something fails, with what to do beside it.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if not sim and config_file is None:
        raise click.UsageError("name the robot's configuration with --config FILE, or add --sim")
    from ccatp.checking.finding import as_json, failed, has_failed
    from ccatp.config.loader import NotASurvey, load_config

    named = {"run.mirror": mirror, "run.world": world, "run.seed": seed}
    try:
        cfg = load_config(config_file, overrides(settings, named))
        found = _findings(cfg, config_file, runs_dir, runtime_dir, sim=sim)
    except NotASurvey:
        raise
    except ConfigError as error:
        found = [failed("configuration", str(error), "correct it; ccatp config check FILE lists all that is wrong")]
    if json_output:
        click.echo(json.dumps(as_json(found)))
    else:
        _show(found)
    return int(ExitStatus.REFUSED if has_failed(found) else ExitStatus.COMPLETE)


def _findings(
    cfg: "Config", config_file: Path | None, runs_dir: Path, runtime_dir: Path | None, *, sim: bool
) -> "list[Finding]":
    import asyncio
    import logging
    from contextlib import ExitStack

    import structlog

    from ccatp.check_probes import probe_keys, probe_laser, probe_machine, probe_robot
    from ccatp.checking.finding import passed
    from ccatp.commands.stand_ins import stand_ins
    from ccatp.mirror.mirror import build_mirror

    mirror = build_mirror(cfg.mirror)
    where = config_file or "the default one"
    found = [passed("configuration", f"{where}: mirror {mirror.name}, {len(mirror.panels)} panels")]
    found += [*probe_machine(cfg, runs_dir, runtime_dir, os.environ), probe_keys(cfg, sim=sim), _observatory(cfg)]

    async def probe() -> "list[Finding]":
        robot, laser = await asyncio.gather(probe_robot(cfg, mirror), probe_laser(cfg, mirror))
        return [*robot, *laser]

    with ExitStack() as stack:
        # What the clients would log belongs to a daemon; here it would stand in the way of the result.
        stack.callback(lambda before: structlog.configure(**before), structlog.get_config())
        structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
        if sim:
            cfg = stack.enter_context(stand_ins(cfg))
        return [*found, *asyncio.run(probe())]


def _observatory(cfg: "Config") -> "Finding":
    from ccatp.checking.finding import failed, passed
    from ccatp.processes.observing import check_observatory

    name = "observatory keys"
    try:
        keys = check_observatory(cfg.observatory)
    except ConfigError as error:
        return failed(name, str(error), "make them with ccatp keys generate")
    if keys is None:
        return passed(name, "served at the unix socket alone")
    return passed(name, f"{cfg.observatory.endpoint}, listed in {cfg.observatory.clients_file}")


def _show(found: "Sequence[Finding]") -> None:
    from ccatp.checking.finding import lines

    if not sys.stdout.isatty():
        for line in lines(found):
            click.echo(line)
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for title in ("check", "", "found", "what to do"):
        table.add_column(title, overflow="fold")
    for one in found:
        style = STYLES[one.outcome]
        table.add_row(one.name, f"[{style}]{one.outcome}[/{style}]", one.found, one.todo)
    console = Console()
    console.print(table)
    console.print(lines(found)[-1])
