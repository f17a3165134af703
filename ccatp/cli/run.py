"""The commands that run until they are stopped: ``ccatp run``, ``dashboard`` and ``stream``."""

from collections.abc import Mapping
from pathlib import Path

import click

from ccatp.cli import common
from ccatp.errors import ConfigError

PLOTJUGGLER_PORT = 9872
FOXGLOVE_PORT = 8765


@common.command(
    "ccatp run --sim --mirror fyst-m2 --panels 4", "ccatp run --config telescope.toml --run-dir runs/tonight"
)
@click.option("--sim", is_flag=True, help="Simulate robot and laser system on this machine.")
@common.WORLD_OPTIONS
@common.PANELS_OPTION
@common.key_option("--filter", "run.filter", metavar="NAME", help="State estimator: kf, ekf or ukf.")
@click.option("--realtime", is_flag=True, help="Pace the simulation on the wall clock; --resume keeps it.")
@common.key_option(
    "--physics",
    "sim.robot.physics",
    metavar="NAME",
    help="Simulated robot: lag, motors or mujoco (extra ccatp[physics]).",
)
@click.option("--run-dir", type=common.PATH, help="Where to write; runs/<time>-<mirror>-s<seed> if not given.")
@click.option(
    "--resume", is_flag=True, help="Resume the mission in --run-dir, or the only one in ./runs that is not complete."
)
@click.option("--start-held", "held", is_flag=True, help="With --resume: nothing moves until ccatp resume.")
@click.option(
    "--resume-last", "recover", is_flag=True, help="For services: resume, held, the run that did not finish, if any."
)
@click.option("-q", "--quiet", is_flag=True, help="Only warnings, errors and the summary.")
@click.option("-v", "--verbose", is_flag=True, help="Also each change of the mission's state.")
@common.renamed_flag("--held", "--start-held")
@common.renamed_flag("--recover", "--resume-last")
@common.json_option("Summary as JSON on standard output, nothing else there.")
@common.FAULTS_OPTION
@common.RUNTIME_DIR_OPTION
def run(
    sim: bool, config_file: Path | None, settings: Mapping[str, object], realtime: bool, run_dir: Path | None,
    resume: bool, held: bool, recover: bool, json_output: bool, faults_file: Path | None, runtime_dir: Path | None,
    quiet: bool, verbose: bool,
) -> int:  # fmt: skip
    """Survey the mirror of the configuration and end with a summary."""
    if faults_file is not None and not sim:
        raise click.UsageError("--faults needs --sim: faults are for the simulated robot, never for a real one")
    if quiet and verbose:
        raise click.UsageError("--quiet and --verbose contradict each other; give one of them")
    if held and not resume:
        raise click.UsageError("--start-held needs --resume; --resume-last always starts held")
    if recover and (resume or run_dir is not None):
        raise click.UsageError("--resume-last finds the run itself: leave out --resume and --run-dir")
    if not sim and config_file is None and not resume:
        raise click.UsageError("name the robot's configuration with --config FILE, or add --sim")
    from ccatp.daemon.supervision.fork_server import ForkServer
    from ccatp.daemon.supervision.open_files import permit_open_files

    permit_open_files()
    # From here on it imports at the same time as this process.
    fork_server = click.get_current_context().with_resource(ForkServer())
    from ccatp.daemon.supervision.run_dir import RunOptions, find_unfinished, with_origin

    if resume and run_dir is None:
        run_dir = find_unfinished()
    if resume and config_file is None and run_dir is not None:
        config_file = run_dir / "config.toml"
        if not config_file.is_file():
            raise ConfigError(f"--resume: {run_dir}: no config.toml there; name the directory of a run with --run-dir")
    from ccatp.daemon.supervision.supervisor import run as run_to_the_end

    options = RunOptions(
        sim=sim, config_file=config_file, overrides=settings, realtime=realtime, run_dir=run_dir, resume=resume,
        held=held, recover=recover, json_output=json_output, runtime_dir=runtime_dir, faults_file=faults_file,
        verbosity=verbose - quiet,
    )  # fmt: skip
    if faults_file is not None:
        from ccatp.sim.fault_plan import read_plan

        # Mistakes are reported before anything is started.
        read_plan(faults_file, lockstep=not with_origin(options).realtime)
    return int(run_to_the_end(options, fork_server))


@common.command(
    "ccatp dashboard", "ccatp dashboard --port 8080", "ccatp dashboard --host 0.0.0.0 --token-file page.token"
)
@common.address_options("dashboard")
@common.key_option("--token-file", "dashboard.token_file", type=click.Path(), help="File with the tokens of commands.")
@common.RUNTIME_DIR_OPTION
@common.settings_option("A key of dashboard, as in dashboard.rate_hz=5.")
def dashboard(runtime_dir: Path | None, settings: Mapping[str, object]) -> int:
    """Show a running daemon on a web page, and command it from there; Ctrl-C ends the page and nothing else.

    A run has a page of its own unless dashboard.enabled is false.
    """
    from ccatp.daemon.operator.dashboard import attach

    return attach(common.configured_folder(None, runtime_dir), settings, click.echo)


@common.command("ccatp stream", "ccatp stream --foxglove", "ccatp stream --no-plotjuggler --foxglove-port 8800")
@common.CONFIG_OPTION
@common.RUNTIME_DIR_OPTION
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option("--plotjuggler/--no-plotjuggler", default=True, show_default=True, help="Serve PlotJuggler's ZMQ plugin.")
@click.option("--port", type=click.IntRange(0, 65535), default=PLOTJUGGLER_PORT, show_default=True, help="Its port.")
@click.option("--foxglove", is_flag=True, help="Serve Foxglove and Lichtblick by WebSocket (extra foxglove).")
@click.option(
    "--foxglove-port", type=click.IntRange(0, 65535), help=f"Its port, else {FOXGLOVE_PORT}; implies --foxglove."
)
@click.option("--open-to-network", is_flag=True, help="Let --host be another address than this machine's own.")
def stream(
    config_file: Path | None, runtime_dir: Path | None, host: str, plotjuggler: bool, port: int,
    foxglove: bool, foxglove_port: int | None, open_to_network: bool,
) -> int:  # fmt: skip
    """Stream the runs on this machine live to PlotJuggler and Foxglove, until interrupted.

    It may be started and ended at any time; runs do not notice. A viewer that comes late gets the panels' map at once.
    """
    from ccatp.daemon.operator.streaming import serve

    foxglove_port = FOXGLOVE_PORT if foxglove and foxglove_port is None else foxglove_port
    if not plotjuggler and foxglove_port is None:
        raise click.UsageError("nothing to serve: leave out --no-plotjuggler, or add --foxglove")
    return serve(
        common.configured_folder(config_file, runtime_dir),
        host,
        port if plotjuggler else None,
        foxglove_port,
        is_open=open_to_network,
        report=lambda text: click.echo(f"ccatp stream: {text}", err=True),
    )
