"""Glue. The command ``ccatp run``."""

from collections.abc import Mapping
from pathlib import Path

import click

from ccatp.commands.frame import FAULTS_OPTION, RUNTIME_DIR_OPTION, WORLD_OPTIONS, example, overrides


@click.command(
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
