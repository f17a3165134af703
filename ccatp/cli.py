"""Glue. The commands. Only click is imported here: ``--help`` and completion must be quick, so commands import late."""

import json
import re
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

import ccatp
from ccatp.commands.align import align
from ccatp.commands.bench import bench
from ccatp.commands.calibrate import calibrate
from ccatp.commands.check import check
from ccatp.commands.completion import completion
from ccatp.commands.conformance import conformance
from ccatp.commands.dashboard import dashboard
from ccatp.commands.frame import (
    ADDRESS_OPTIONS,
    CONFIG_OPTION,
    FAULTS_OPTION,
    RUNTIME_DIR_OPTION,
    TIMEOUT_OPTION,
    WORLD_OPTIONS,
    NearestChoice,
    SuggestingGroup,
    ask_daemon,
    ask_over_tcp,
    complain,
    configured_folder,
    example,
    options,
    overrides,
    run_command_line,
    tell,
)
from ccatp.commands.keys import keys
from ccatp.commands.log import log
from ccatp.commands.plan import plan
from ccatp.commands.radio import radio
from ccatp.commands.replay import replay
from ccatp.commands.report import compare, report
from ccatp.commands.status import status
from ccatp.commands.stream import stream
from ccatp.commands.study import study
from ccatp.package import COMPILED, build

# No laser reaches farther.
FARTHEST_PUCK_M = 1000.0
EMERGENCY_KINDS = ("fire", "earthquake", "power", "weather", "operator")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return run_command_line(cli, argv)


@click.group(
    cls=SuggestingGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog=example("ccatp run --sim", "ccatp run --sim --mirror fyst-m2 --seed 2", "ccatp status --json"),
)
@click.version_option(ccatp.__version__, message="ccatp %(version)s" + (" compiled" if build() == COMPILED else ""))
def cli() -> None:
    """Survey telescope mirrors with a laser-tracked robot."""


@cli.command(
    epilog=example(
        "ccatp run --sim --mirror fyst-m2 --panels 4", "ccatp run --config telescope.toml --run-dir runs/tonight"
    )
)
@click.option("--sim", is_flag=True, help="Simulate robot and laser system on this machine.")
@WORLD_OPTIONS
@click.option("--panels", type=int, metavar="N", help="Only the first N panels of the traversal; 0 takes all.")
@click.option("--filter", "filter_name", metavar="NAME", help="State estimator: kf, ekf or ukf.")
@click.option("--realtime", is_flag=True, help="Pace the simulation on the wall clock.")
@click.option(
    "--run-dir", type=click.Path(path_type=Path), help="Where to write; runs/<time>-<mirror>-s<seed> if not given."
)
@click.option("--resume", is_flag=True, help="Carry on with the mission in --run-dir.")
@click.option("--held", is_flag=True, help="With --resume: nothing moves until ccatp resume.")
@click.option("--recover", is_flag=True, help="For services: carry on, held, with the run that did not finish, if any.")
@click.option("--json", "json_output", is_flag=True, help="Summary as JSON on standard output, nothing else there.")
@FAULTS_OPTION
@RUNTIME_DIR_OPTION
def run(
    sim: bool, config_file: Path | None, mirror: str | None, world: str | None, seed: int | None,
    settings: Mapping[str, object], panels: int | None, filter_name: str | None, realtime: bool,
    run_dir: Path | None, resume: bool, held: bool, recover: bool, json_output: bool,
    faults_file: Path | None, runtime_dir: Path | None,
) -> int:  # fmt: skip
    """Survey the mirror of the configuration and end with a summary."""
    if faults_file is not None and not sim:
        raise click.UsageError(
            "--faults goes with --sim alone: faults are for the simulated robot, never for a real one"
        )
    if held and not resume:
        raise click.UsageError("--held goes with --resume; --recover holds by itself")
    if recover and (resume or run_dir is not None):
        raise click.UsageError("--recover finds the run by itself: leave out --resume and --run-dir")
    if resume and run_dir is None:
        raise click.UsageError("--resume carries on in a run directory; name it with --run-dir")
    if resume and config_file is None and run_dir is not None:
        config_file = run_dir / "config.toml"
    if not sim and config_file is None:
        raise click.UsageError("name the robot's configuration with --config FILE, or add --sim")
    from ccatp.run_options import RunOptions
    from ccatp.supervisor import run as run_to_the_end

    if faults_file is not None:
        from ccatp.stand_ins.fault_plan import read_plan

        read_plan(faults_file, lockstep=not realtime)  # its mistakes are told before anything is started
    named = {
        "run.mirror": mirror,
        "run.world": world,
        "run.seed": seed,
        "run.panels": panels,
        "run.filter": filter_name,
    }
    return int(
        run_to_the_end(
            RunOptions(
                sim=sim,
                config_file=config_file,
                overrides=overrides(settings, named),
                realtime=realtime,
                run_dir=run_dir,
                resume=resume,
                held=held,
                recover=recover,
                json_output=json_output,
                runtime_dir=runtime_dir,
                faults_file=faults_file,
            )
        )
    )


def _daemon_options(command: Any) -> Any:
    return options(
        CONFIG_OPTION,
        RUNTIME_DIR_OPTION,
        TIMEOUT_OPTION,
        click.option("--json", "json_output", is_flag=True, help="The daemon's answer as JSON on standard output."),
    )(command)


@cli.command(epilog=example("ccatp pause"))
@_daemon_options
def pause(config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool) -> None:
    """Stop the robot where it is, until resume."""
    tell(_ask("pause", config_file, runtime_dir, timeout_s), json_output)


@cli.command(epilog=example("ccatp resume"))
@_daemon_options
def resume(config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool) -> None:
    """Carry on after pause."""
    tell(_ask("resume", config_file, runtime_dir, timeout_s), json_output)


@cli.command(epilog=example("ccatp abort"))
@_daemon_options
def abort(config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool) -> None:
    """Give up the survey and drive the robot to its base."""
    tell(_ask("abort", config_file, runtime_dir, timeout_s), json_output)


@cli.command(epilog=example("ccatp stop"))
@_daemon_options
def stop(config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool) -> None:
    """Hold the wheels where the robot is, save, and end the daemon."""
    tell(_ask("stop", config_file, runtime_dir, timeout_s), json_output)


def _observatory_options(command: Any) -> Any:
    return options(
        click.option("--endpoint", metavar="tcp://HOST:PORT", help="A daemon on another machine, by its TCP endpoint."),
        click.option("--server-key", type=click.Path(path_type=Path), help="With --endpoint: the daemon's NAME.key."),
        click.option(
            "--key", "key_file", type=click.Path(path_type=Path), help="With --endpoint: our NAME.key_secret."
        ),
        _daemon_options,
    )(command)


@cli.command(
    epilog=example(
        "ccatp emergency fire --note 'smoke in the receiver cabin'",
        "ccatp emergency fire --endpoint tcp://m1:7020 --server-key ccatp.key --key observatory.key_secret",
    )
)
@click.argument("kind", type=NearestChoice(EMERGENCY_KINDS), metavar="KIND")
@click.option("--note", default="", help="What happened, for the log.")
@click.option(
    "--id", "emergency_id", type=click.UUID, help="Identity of the emergency; sending the same one again is harmless."
)
@_observatory_options
def emergency(
    kind: str, note: str, emergency_id: uuid.UUID | None,
    endpoint: str | None, server_key: Path | None, key_file: Path | None,
    config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool,
) -> None:  # fmt: skip
    """Report an emergency: the robot goes to its base.

    KIND is fire, earthquake, power, weather or operator.
    """
    payload: dict[str, object] = {
        "cmd": "emergency",
        "kind": kind,
        "id": str(emergency_id or uuid.uuid4()),
        "note": note,
    }
    folder = configured_folder(config_file, runtime_dir)
    tell(_ask_observatory(endpoint, server_key, key_file, folder, payload, timeout_s), json_output)


@cli.command(epilog=example("ccatp clear 6f1c3c1e-5a0f-4d0e-9f2b-0c8f5b6a7d11"))
@click.argument("emergency_id", type=click.UUID, metavar="ID")
@_observatory_options
def clear(
    emergency_id: uuid.UUID, endpoint: str | None, server_key: Path | None, key_file: Path | None,
    config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool,
) -> None:  # fmt: skip
    """End the emergency ID, whose cause is gone.

    ID is what ccatp emergency told. The robot must be at base or held; over TCP, our key needs the role clear.
    """
    payload: dict[str, object] = {"cmd": "clear", "id": str(emergency_id)}
    folder = configured_folder(config_file, runtime_dir)
    tell(_ask_observatory(endpoint, server_key, key_file, folder, payload, timeout_s), json_output)


def _ask_observatory(
    endpoint: str | None, server_key: Path | None, key_file: Path | None,
    folder: Path | None, payload: dict[str, object], timeout_s: float,
) -> dict[str, Any]:  # fmt: skip
    if endpoint is None:
        if server_key is not None or key_file is not None:
            raise click.UsageError("--server-key and --key go with --endpoint tcp://HOST:PORT")
        return ask_daemon(folder, "emergency", payload, timeout_s)
    if not endpoint.startswith("tcp://"):
        raise click.UsageError(f"--endpoint {endpoint!r} is not tcp://HOST:PORT; a daemon here has --runtime-dir")
    if server_key is None or key_file is None:
        raise click.UsageError("--endpoint needs --server-key and --key; make keys with ccatp keys generate")
    return ask_over_tcp(endpoint, server_key, key_file, payload, timeout_s)


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


@cli.group(cls=SuggestingGroup, epilog=example("ccatp sim robot --port 7010"))
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


cli.add_command(align)
cli.add_command(bench)
cli.add_command(dashboard)
cli.add_command(keys)
cli.add_command(calibrate)
cli.add_command(completion)
cli.add_command(check)
cli.add_command(log)
cli.add_command(status)
cli.add_command(stream)
cli.add_command(plan)
cli.add_command(radio)
cli.add_command(study)
cli.add_command(replay)
cli.add_command(report)
cli.add_command(compare)
cli.add_command(conformance)


@cli.command("map", epilog=example("ccatp map runs/20260101T000000Z-fyst-m1-s1 --out map.png"))
@click.argument("run_dir", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="The picture; map.png in the run directory if not given.")
def draw_map(run_dir: Path, out: Path | None) -> int:
    """Draw the map of a run: panels, path, and each point coloured by its arrival error (needs matplotlib)."""
    from ccatp.pictures.run_map import draw_from_run_dir

    picture = out or run_dir / "map.png"
    draw_from_run_dir(run_dir, picture)
    click.echo(picture)
    return 0


@cli.group(
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


def _ask(command: str, config_file: Path | None, runtime_dir: Path | None, timeout_s: float) -> dict[str, Any]:
    return ask_daemon(configured_folder(config_file, runtime_dir), "control", {"cmd": command}, timeout_s)
