"""Glue. The command ``ccatp calibrate``."""

import json
import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ccatp.commands.frame import JSON_OPTION, RUNTIME_DIR_OPTION, WORLD_OPTIONS, complain, example, overrides
from ccatp.errors import CcatpError

if TYPE_CHECKING:
    from ccatp.calibrating.report import Row
    from ccatp.config.models import Config


class DriveFailed(CcatpError):
    """The drive did not come to its end."""

    def __init__(self, status: int, run_dir: Path) -> None:
        super().__init__(f"the drive did not come to its end, so nothing is calibrated; see {run_dir / 'log.jsonl'}")
        self.exit_status = status


@click.command(
    epilog=example(
        "ccatp calibrate --config telescope.toml --dry-run",
        "ccatp calibrate --config telescope.toml --rounds 5",
        "ccatp calibrate --sim --world hard",
        "ccatp calibrate --from runs/tonight --config telescope.toml",
    )
)
@click.option("--sim", is_flag=True, help="Simulate robot and laser system on this machine.")
@WORLD_OPTIONS
@click.option("--rounds", type=click.IntRange(2, 5), default=3, show_default=True, help="Rounds of four legs.")
@click.option(
    "--length", "length_m", type=click.FloatRange(0.08, 0.5), default=0.2, show_default=True, help="Of a leg, m."
)
@click.option("--from", "from_dir", type=click.Path(path_type=Path), help="Do not drive: take the drive of this run.")
@click.option("--run-dir", type=click.Path(path_type=Path), help="Where to record the drive.")
@click.option("--dry-run", is_flag=True, help="Drive and tell, but write nothing into the configuration.")
@JSON_OPTION
@RUNTIME_DIR_OPTION
def calibrate(
    sim: bool, config_file: Path | None, mirror: str | None, world: str | None, seed: int | None,
    settings: Mapping[str, object], rounds: int, length_m: float, from_dir: Path | None, run_dir: Path | None,
    dry_run: bool, json_output: bool, runtime_dir: Path | None,
) -> int:  # fmt: skip
    """Find wheel radius, wheel base and gyroscope bias by a short drive at base, and write them into --config.

    The robot goes back and forth at its base and is measured at each end, under the same rules as in a survey.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if not sim and config_file is None and from_dir is None:
        raise click.UsageError("name the robot's configuration with --config FILE, or add --sim")
    named = {"run.mirror": mirror, "run.world": world, "run.seed": seed}
    changes = {**overrides(settings, named), **_drive_settings(rounds, length_m)}
    if from_dir is None:
        from_dir = _drive(sim, config_file, changes, run_dir, runtime_dir)
    from ccatp.calibrating.estimate import Priors
    from ccatp.calibrating.estimate import calibrate as estimate
    from ccatp.calibrating.report import as_json, check_usable, lines, rows
    from ccatp.run_files.drive_reader import read_drive

    drive, on_mirror, cfg = read_drive(from_dir)
    full = cfg.localizer.full_state
    priors = Priors(cfg.robot.wheel_radius_m, cfg.robot.wheel_base_m, full.gyroscope_scale_sigma, full.creep_sigma)
    found = estimate(on_mirror, drive, priors)
    table = rows(_replaced(config_file, cfg), found)
    if not json_output:
        for line in lines(table, found):
            click.echo(line)
    check_usable(table)
    written, difference = _write(config_file, table, dry_run=dry_run)
    if json_output:
        result = {"run_dir": str(from_dir), **as_json(table, found), "written": written, "diff": difference}
        click.echo(json.dumps(result))
    else:
        click.echo(difference or "nothing to change", nl=not difference)
        if config_file is None:
            complain("nothing written: name the configuration with --config FILE", 0)
        elif written is None:
            complain(f"nothing written into {config_file} (--dry-run)", 0)
    return 0


def _replaced(config_file: Path | None, driven: "Config") -> "Config":
    """The configuration whose values are replaced: that of the file, else that of the drive."""
    if config_file is None:
        return driven
    from ccatp.config.loader import load_config

    cfg = load_config(config_file)
    if cfg.mirror.name != driven.mirror.name:
        complain(
            f"warning: the drive was on {driven.mirror.name}, {config_file} is for {cfg.mirror.name}: "
            "the same robot must drive on both",
            0,
        )
    return cfg


def _drive_settings(rounds: int, length_m: float) -> dict[str, object]:
    return {
        "run.order": "calibration",
        "run.filter": "ekf",  # the four states have no use for the drive and plan none
        "mission.fix_at_start": True,
        "mission.calibration_rounds": rounds,
        "mission.calibration_length_m": length_m,
    }


def _drive(
    sim: bool, config_file: Path | None, changes: Mapping[str, object], run_dir: Path | None, runtime_dir: Path | None
) -> Path:
    from ccatp.run_options import RunOptions
    from ccatp.supervisor import run_survey

    folder = run_dir or Path("runs") / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-calibration"
    status = run_survey(
        RunOptions(
            sim=sim,
            config_file=config_file,
            overrides=changes,
            run_dir=folder,
            runtime_dir=runtime_dir,
            shows_summary=False,
        )
    )
    if status:
        raise DriveFailed(status, folder)
    return folder


def _write(config_file: Path | None, table: "tuple[Row, ...]", *, dry_run: bool) -> tuple[str | None, str]:
    """The file written, if one was, and what changes in it."""
    from ccatp.config.loader import load_config
    from ccatp.config_edit import difference, with_values, write_in_place

    values: dict[str, Any] = {row.key: row.rounded for row in table}
    if config_file is None:
        return None, "".join(f"{key} = {value}\n" for key, value in values.items())
    load_config(config_file, values)  # what would be refused later is refused now
    before = config_file.read_text(encoding="utf-8")
    after = with_values(before, values, config_file)
    changed = difference(before, after, config_file)
    if dry_run or not changed:
        return None, changed
    write_in_place(config_file, after)
    return str(config_file), changed
