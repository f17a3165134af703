"""Glue. The commands ``ccatp sim robot`` and ``ccatp sim etalon``."""

import re
from collections.abc import Mapping
from pathlib import Path

import click

from ccatp.commands.frame import (
    ADDRESS_OPTIONS,
    FAULTS_OPTION,
    RUNTIME_DIR_OPTION,
    WORLD_OPTIONS,
    SuggestingGroup,
    example,
    overrides,
)

# No laser reaches farther.
FARTHEST_PUCK_M = 1000.0


def _finite(
    _ctx: click.Context, _param: click.Parameter, place: tuple[float, float, float] | None
) -> tuple[float, float, float] | None:
    if place is not None and not all(abs(value) <= FARTHEST_PUCK_M for value in place):
        raise click.BadParameter(f"each of X Y Z is a number of metres, at most {FARTHEST_PUCK_M:g} from the origin")
    return place


def _endpoint(_ctx: click.Context, _param: click.Parameter, endpoint: str | None) -> str | None:
    if endpoint is not None and not re.fullmatch(r"ipc://.+|tcp://[^\s/:]+:\d{1,5}", endpoint):
        raise click.BadParameter(f"{endpoint!r} is no endpoint; give ipc://PATH, as ccatp sim robot tells it")
    return endpoint


@click.group(cls=SuggestingGroup, epilog=example("ccatp sim robot --port 7010"))
def sim() -> None:
    """Stand-ins of robot and laser system, alone."""


@sim.command(
    "robot", epilog=example("ccatp sim robot --port 7010 --mirror fyst-m2", "ccatp sim robot --lockstep --seed 3")
)
@ADDRESS_OPTIONS
@WORLD_OPTIONS
@click.option("--realtime/--lockstep", default=True, show_default=True, help="Wall clock, or wait for each command.")
@FAULTS_OPTION
@RUNTIME_DIR_OPTION
def sim_robot(
    host: str | None, port: int | None, config_file: Path | None, mirror: str | None, world: str | None,
    seed: int | None, settings: Mapping[str, object], realtime: bool, faults_file: Path | None,
    runtime_dir: Path | None,
) -> int:  # fmt: skip
    """Run the simulated robot behind the robot link, for any controller."""
    from ccatp.config.loader import load_config
    from ccatp.config.radio_loader import is_radio_file, load_radio_config
    from ccatp.processes.dataloop import run_alone
    from ccatp.stand_ins.fault_plan import read_plan

    named = {"sim.robot.host": host, "sim.robot.port": port, "run.mirror": mirror, "run.world": world, "run.seed": seed}
    if config_file is not None and is_radio_file(config_file):
        from ccatp.processes.dataloop import run_beacons_alone

        among_beacons = load_radio_config(config_file, overrides(settings, named))
        return int(run_beacons_alone(among_beacons, lockstep=not realtime, runtime_dir=runtime_dir))
    cfg = load_config(config_file, overrides(settings, named))
    plan = None if faults_file is None else read_plan(faults_file, lockstep=not realtime)
    return int(run_alone(cfg, lockstep=not realtime, faults=plan, runtime_dir=runtime_dir))


@sim.command("etalon", epilog=example("ccatp sim etalon --port 2001 --puck 0.1 -0.5 3.4"))
@ADDRESS_OPTIONS
@WORLD_OPTIONS
@click.option(
    "--puck",
    "puck_world_m",
    type=(float, float, float),
    callback=_finite,
    metavar="X Y Z",
    help="Where the puck stands: world frame, metres.",
)
@click.option(
    "--truth",
    callback=_endpoint,
    metavar="ENDPOINT",
    help="Follow the true puck that a simulated robot publishes there.",
)
@click.option(
    "--runtime-dir",
    type=click.Path(path_type=Path),
    help="Follow the true puck of the simulated robot that has this folder.",
)
def sim_etalon(
    host: str | None, port: int | None, config_file: Path | None, mirror: str | None, world: str | None,
    seed: int | None, settings: Mapping[str, object],
    puck_world_m: tuple[float, float, float] | None, truth: str | None, runtime_dir: Path | None,
) -> int:  # fmt: skip
    """Run the simulated MultiLine server; the puck stands at the base unless told otherwise."""
    from ccatp.config.loader import load_config
    from ccatp.processes.etalon import run_alone

    if puck_world_m is not None and truth is not None:
        raise click.UsageError("--puck and --truth exclude each other")
    if runtime_dir is not None:
        if puck_world_m is not None or truth is not None:
            raise click.UsageError("--runtime-dir tells where the puck is: leave out --puck and --truth")
        from ccatp.runtime_dir import runtime_dir_path

        truth = f"ipc://{runtime_dir_path(str(runtime_dir), {})}/puck"
    named = {
        "sim.etalon.host": host,
        "sim.etalon.port": port,
        "run.mirror": mirror,
        "run.world": world,
        "run.seed": seed,
    }
    return int(run_alone(load_config(config_file, overrides(settings, named)), puck_world_m, truth))
