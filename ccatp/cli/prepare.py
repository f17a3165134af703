"""The commands before a mission: ``ccatp plan``, ``ccatp check`` and ``ccatp calibrate``."""

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ccatp.cli import common
from ccatp.errors import ConfigError, ExitStatus, printable

if TYPE_CHECKING:
    from ccatp.commissioning.calibration import CalibrationRow
    from ccatp.config.models import Config


@common.command(
    "ccatp plan --mirror fyst-m2",
    "ccatp plan --config telescope.toml --figure plan.png",
    "ccatp plan --set run.order=optimised --set mission.leg_clearance_m=0.12 --json",
)
@common.WORLD_OPTIONS
@common.PANELS_OPTION
@common.key_option("--filter", "run.filter", metavar="NAME", help="State estimator: some drive a calibration first.")
@common.figure_option("Draw the way")
@common.JSON_OPTION
def plan(config_file: Path | None, settings: Mapping[str, object], figure_file: Path | None, json_output: bool) -> int:
    """Show what a survey would do, without moving anything: order, way, least time, points out of reach.

    The exit status is 2 where points are out of reach or the thrust is too little: a run would be refused.
    """
    from ccatp.config.load import load_config
    from ccatp.mirror.mirror import build_mirror
    from ccatp.survey.survey_plan import make_plan, plan_data, plan_lines

    cfg = load_config(config_file, settings)
    geometry = build_mirror(cfg.mirror)
    found = make_plan(cfg, geometry)
    if figure_file is not None:
        from ccatp.report.mirror_map import draw_plan

        draw_plan(geometry, found, figure_file)
    common.print_result(plan_data(cfg, found), plan_lines(cfg, found), json_output)
    if found.out_of_reach:
        return common.complain(
            f"{len(found.out_of_reach)} points are out of reach with mission.leg_clearance_m = "
            f"{cfg.mission.leg_clearance_m:g} and turn_clearance_m = {cfg.mission.turn_clearance_m:g}; "
            "a run would be refused",
            ExitStatus.USAGE,
        )
    if not found.grip.is_held:
        return common.complain(f"{found.grip.text}; a run would be refused", ExitStatus.USAGE)
    if found.forecast.warning:
        common.warn((found.forecast.warning,))
    return 0


COLOURS = {"pass": "green", "warn": "yellow", "fail": "bright_red", "skip": "bright_black"}


@common.command("ccatp check --config telescope.toml", "ccatp check --sim", "ccatp check --sim --json")
@click.option("--sim", is_flag=True, help="Start the simulators of robot and laser system, and check those.")
@common.WORLD_OPTIONS
@click.option("--runs-dir", type=common.PATH, default="runs", show_default=True, help="Of the recordings.")
@common.json_option("As JSON on standard output, nothing else there.")
@common.RUNTIME_DIR_OPTION
def check(
    sim: bool, config_file: Path | None, settings: Mapping[str, object], runs_dir: Path, json_output: bool,
    runtime_dir: Path | None,
) -> int:  # fmt: skip
    """Check everything that a mission needs: robot, laser system, sensors, clock, disk, keys.

    The robot stands at base. Nothing moves. The status is 1 where something fails, with what to do beside it.
    """
    if not sim and config_file is None:
        raise click.UsageError("name the robot's configuration with --config FILE, or add --sim")
    from ccatp.commissioning.preflight import as_json, failed, has_failed, lines, named
    from ccatp.commissioning.probes import probe_all
    from ccatp.config.load import NotASurvey, load_config

    try:
        found = probe_all(load_config(config_file, settings), config_file, runs_dir, runtime_dir, sim=sim)
    except NotASurvey:
        raise
    except ConfigError as error:
        todo = "correct it; ccatp config check FILE lists all that is wrong"
        found = named(configuration=failed(str(error), todo))
    if json_output:
        click.echo(json.dumps(as_json(found)))
    else:
        for line in map(printable, lines(found)):
            outcome = line[:4]  # a terminal shows it in colour
            click.echo(click.style(outcome, COLOURS[outcome]) + line[4:] if outcome in COLOURS else line)
    return int(ExitStatus.REFUSED if has_failed(found) else ExitStatus.COMPLETE)


@common.command(
    "ccatp calibrate --config telescope.toml --dry-run",
    "ccatp calibrate --config telescope.toml --rounds 5",
    "ccatp calibrate --sim --world hard",
    "ccatp calibrate --from runs/tonight --config telescope.toml",
)
@click.option("--sim", is_flag=True, help="Simulate robot and laser system on this machine.")
@common.WORLD_OPTIONS
@click.option("--rounds", type=click.IntRange(2, 5), default=3, show_default=True, help="Rounds of four legs.")
@click.option(
    "--length", "length_m", type=click.FloatRange(0.08, 0.5), default=0.2, show_default=True, help="Of a leg, m."
)
@click.option("--from", "from_dir", type=common.PATH, help="Do not drive: take the drive of this run.")
@click.option("--run-dir", type=common.PATH, help="Where to record the drive.")
@click.option("--dry-run", is_flag=True, help="Drive and report, but write nothing into the configuration.")
@common.JSON_OPTION
@common.RUNTIME_DIR_OPTION
def calibrate(
    sim: bool, config_file: Path | None, settings: Mapping[str, object], rounds: int, length_m: float,
    from_dir: Path | None, run_dir: Path | None, dry_run: bool, json_output: bool, runtime_dir: Path | None,
) -> int:  # fmt: skip
    """Find wheel radius, wheel base and gyroscope bias by a short drive at base, and write them into --config.

    The robot goes back and forth at its base and is measured at each end, under the same rules as in a survey.
    """
    if not sim and config_file is None and from_dir is None:
        raise click.UsageError("name the robot's configuration with --config FILE, or add --sim")
    if from_dir is None:
        from ccatp.daemon.supervision.run_dir import RunOptions
        from ccatp.daemon.supervision.supervisor import run_survey

        changes = {
            **settings,
            "run.order": "calibration",
            "run.filter": "ekf",  # the four-state filter has no use for the calibration drive and does not plan it
            "mission.fix_at_start": True,
            "mission.calibration_rounds": rounds,
            "mission.calibration_length_m": length_m,
        }
        from_dir = run_dir or Path("runs") / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-calibration"
        options = RunOptions(
            sim=sim, config_file=config_file, overrides=changes, run_dir=from_dir, runtime_dir=runtime_dir,
            shows_summary=False,
        )  # fmt: skip
        if status := run_survey(options):
            log = from_dir / "log.jsonl"
            return common.complain(f"the drive did not come to its end, so nothing is calibrated; see {log}", status)
    from ccatp.commissioning.calibration import as_json, check_usable, lines, rows
    from ccatp.commissioning.calibration import calibrate as estimate
    from ccatp.commissioning.calibration_drive import read_drive

    drive, on_mirror, cfg, warnings = read_drive(from_dir)
    common.warn(warnings)
    found = estimate(on_mirror, drive, cfg)
    table = rows(_replaced(config_file, cfg), found)
    if not json_output:
        common.print_lines(lines(table, found))
    check_usable(table)
    written, difference = _write(config_file, table, dry_run=dry_run)
    if json_output:
        result = {"run_dir": str(from_dir), **as_json(table, found), "written": written, "diff": difference}
        click.echo(json.dumps(result))
    else:
        click.echo(difference or "nothing to change", nl=not difference)
        if config_file is None:
            common.complain("nothing written: name the configuration with --config FILE", 0)
        elif written is None:
            common.complain(f"nothing written into {config_file} (--dry-run)", 0)
    return 0


def _replaced(config_file: Path | None, driven: "Config") -> "Config":
    """The configuration whose values are replaced: that of the file if given, otherwise that of the drive."""
    if config_file is None:
        return driven
    from ccatp.config.load import load_config

    cfg = load_config(config_file)
    if cfg.mirror.name != driven.mirror.name:
        common.complain(
            f"warning: the drive was on {driven.mirror.name}, {config_file} is for {cfg.mirror.name}: "
            "the same robot must drive on both",
            0,
        )
    return cfg


def _write(config_file: Path | None, table: "tuple[CalibrationRow, ...]", *, dry_run: bool) -> tuple[str | None, str]:
    """Write the values; return the name of the written file, or None, and the changes as text."""
    from ccatp.config.files import read_toml, write_file
    from ccatp.config.load import difference, load_config, with_values

    values = {row.key: row.rounded for row in table}
    if config_file is None:
        return None, "".join(f"{key} = {value}\n" for key, value in values.items())
    load_config(config_file, values)  # refuse invalid values before the file is written
    before = read_toml(config_file)
    after = with_values(before, values, config_file)
    changed = difference(before, after, config_file)
    if dry_run or not changed:
        return None, changed
    write_file(config_file, after)
    return str(config_file), changed
