"""The commands ``ccatp sim robot``, ``ccatp sim etalon`` and ``ccatp conformance``."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import click

from ccatp.cli import common
from ccatp.errors import ConfigError

# Limit of a coordinate of the puck; larger than the range of the laser.
FARTHEST_PUCK_M = 1000.0
FAILED = 1
Place = tuple[float, float, float]


def _finite(_ctx: click.Context, _param: click.Parameter, place: Place | None) -> Place | None:
    if place is not None and not all(abs(value) <= FARTHEST_PUCK_M for value in place):
        raise click.BadParameter(f"each of X Y Z is a number of metres, at most {FARTHEST_PUCK_M:g} from the origin")
    return place


def _endpoint(_ctx: click.Context, _param: click.Parameter, endpoint: str | None) -> str | None:
    if endpoint is not None and not re.fullmatch(r"ipc://.+|tcp://[^\s/:]+:\d{1,5}", endpoint):
        raise click.BadParameter(f"{endpoint!r} is no endpoint; give ipc://PATH, as ccatp sim robot prints it")
    return endpoint


@click.group(cls=common.CommandGroup, epilog=common.example("ccatp sim robot --port 7010"))
def sim() -> None:
    """Run only the simulators of robot and laser system."""


@sim.command(
    "robot",
    epilog=common.example("ccatp sim robot --port 7010 --mirror fyst-m2", "ccatp sim robot --lockstep --seed 3"),
)
@common.address_options("sim.robot")
@common.WORLD_OPTIONS
@click.option("--realtime/--lockstep", default=True, show_default=True, help="Wall clock, or wait for each command.")
@common.FAULTS_OPTION
@common.RUNTIME_DIR_OPTION
def sim_robot(
    config_file: Path | None, settings: Mapping[str, object], realtime: bool, faults_file: Path | None,
    runtime_dir: Path | None,
) -> int:  # fmt: skip
    """Run the simulated robot behind the robot link, for any controller.

    Standard error says if it fell, and why; then the exit status is 4.
    """
    from ccatp.config.load import load_mission
    from ccatp.daemon.loops.sim_robot import run_alone
    from ccatp.daemon.supervision.run_dir import check_takes_faults
    from ccatp.missions import kind_of
    from ccatp.sim.fault_plan import read_plan

    cfg = load_mission(config_file, settings)
    check_takes_faults(kind_of(cfg), faults_file)
    plan = None if faults_file is None else read_plan(faults_file, lockstep=not realtime)
    return int(run_alone(cfg, lockstep=not realtime, faults=plan, runtime_dir=runtime_dir))


@sim.command("etalon", epilog=common.example("ccatp sim etalon --port 2001 --puck 0.1 -0.5 3.4"))
@common.address_options("sim.etalon")
@common.WORLD_OPTIONS
@click.option(
    "--puck", "puck_world_m", type=(float, float, float), callback=_finite, metavar="X Y Z",
    help="Where the puck stands: world frame, metres.",
)  # fmt: skip
@click.option(
    "--truth", callback=_endpoint, metavar="ENDPOINT",
    help="Follow the true puck that a simulated robot publishes there.",
)  # fmt: skip
@click.option(
    "--runtime-dir", type=common.PATH, help="Follow the true puck of the simulated robot that has this folder."
)
def sim_etalon(
    config_file: Path | None, settings: Mapping[str, object], puck_world_m: Place | None, truth: str | None,
    runtime_dir: Path | None,
) -> int:  # fmt: skip
    """Run the simulated MultiLine server; the puck stands at the base unless set otherwise."""
    from ccatp.config.load import load_config
    from ccatp.daemon.loops.sim_etalon import run_alone

    if puck_world_m is not None and truth is not None:
        raise click.UsageError("--puck and --truth exclude each other")
    if runtime_dir is not None:
        if puck_world_m is not None or truth is not None:
            raise click.UsageError("--runtime-dir gives the place of the puck: leave out --puck and --truth")
        from ccatp.links.runtime_dir import runtime_dir_path

        truth = f"ipc://{runtime_dir_path(str(runtime_dir), {})}/puck"
    return int(run_alone(load_config(config_file, settings), puck_world_m, truth))


@common.command(
    "ccatp conformance 192.168.1.20:7010 --no-motion",
    "ccatp conformance 127.0.0.1:7010 --key robot.key --json",
    "ccatp conformance 127.0.0.1:7010 --only ttl-drive --only ttl-permit",
)
@click.argument("server", metavar="HOST:PORT")
@click.option(
    "--key", "key_file", type=click.Path(dir_okay=False), metavar="FILE",
    help="Key of the robot link, as in robot.key_file.",
)  # fmt: skip
@click.option("--mirror", metavar="NAME", help="The robot stands at the base of this mirror: check its slope.")
@click.option("--no-motion", is_flag=True, help="Leave out the checks that turn wheels.")
@click.option("--on-stands", is_flag=True, help="Only the wheels turn: leave out the checks of the body's motion.")
@click.option("--only", multiple=True, metavar="ID", help="Run only this check. May be repeated.")
@click.option(
    "--timeout", "timeout_s", type=common.WaitingTime(), metavar="SECONDS", default=3.0, show_default=True,
    help="Seconds to wait for an answer.",
)  # fmt: skip
@common.JSON_OPTION
def conformance(
    server: str, key_file: str | None, mirror: str | None, no_motion: bool, on_stands: bool, only: Sequence[str],
    timeout_s: float, json_output: bool,
) -> int:  # fmt: skip
    """Check a robot-link server, firmware or simulator, against the interface control document.

    Wheels turn slowly and for a moment, unless --no-motion. In the end the robot is held, its fans as they were.
    Exit status: 0 if no check failed, 1 if one failed or cannot be evaluated, 2 for wrong usage or a missing key, 5
    without a robot.
    """
    from ccatp.commissioning.conformance.motion_checks import notice
    from ccatp.commissioning.conformance.runner import (
        CHECKS,
        UNPROVEN,
        Conformance,
        as_json,
        check_ids,
        last_line,
        table_line,
    )
    from ccatp.config.files import read_key
    from ccatp.config.load import load_config
    from ccatp.config.messages import choice_hint
    from ccatp.mirror.mirror import build_mirror

    host, _, port = server.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise click.UsageError(f"{server!r} is not HOST:PORT, as in 127.0.0.1:7010")
    if unknown := [name for name in only if name not in check_ids()]:
        raise click.UsageError(f"--only: no check {unknown[0]!r}; {choice_hint(unknown[0], check_ids())}")
    try:
        key = read_key(key_file or "")
    except ConfigError as error:
        raise ConfigError(str(error).replace("robot.key_file", "--key", 1)) from error
    base = None if mirror is None else build_mirror(load_config(overrides={"run.mirror": mirror}).mirror)
    checks = Conformance((host, int(port)), key, timeout_s, base)
    moving = [check for check in CHECKS if "motion" in check.needs and (not only or check.check_id in only)]
    if moving and not no_motion and checks.facts is not None:
        common.complain(notice(checks.facts, len(moving)), 0)
    results = checks.run(
        motion=not no_motion,
        on_stands=on_stands,
        only=only,
        report=lambda result: None if json_output else click.echo(table_line(result)),
    )
    click.echo(json.dumps(as_json(server, results)) if json_output else last_line(results))
    return FAILED if any(result.outcome in UNPROVEN for result in results) else 0
