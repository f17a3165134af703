"""Glue. The command ``ccatp align``."""

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ccatp.commands.frame import JSON_OPTION, OutputFile, complain, example, figure_option, overrides, settings_option
from ccatp.errors import CcatpError, ConfigError, ExitStatus

if TYPE_CHECKING:
    from ccatp.aligning.survey_result import SurveyResult
    from ccatp.run_files.survey_reader import Survey

# What the fixes are judged by; everything else has acted on the run already.
ACTING = ("align.", "robot.puck_height_m", "mirror.")


class AlignError(CcatpError):
    """A result that cannot be written."""

    exit_status = ExitStatus.USAGE


@click.command(
    epilog=example(
        "ccatp align runs/tonight",
        "ccatp align runs/tonight --csv moves.csv --figure panels.png",
        "ccatp align runs/tonight --json --set align.point_floor_m=2e-6",
    )
)
@click.argument("run_dir", type=click.Path(path_type=Path))
@settings_option("A key of align or mirror, or robot.puck_height_m, as in align.point_floor_m=2e-6.")
@click.option("--csv", "csv_file", type=OutputFile(), help="Write a line a panel (CSV).")
@figure_option("Draw deviations and moves")
@JSON_OPTION
def align(
    run_dir: Path, settings: Mapping[str, object], csv_file: Path | None, figure_file: Path | None, json_output: bool
) -> int:
    """Tell how the panels lie and how to turn their adjusters, from the fixes of a run."""
    # Matrices are small; threads would only fight over them.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from ccatp.aligning.comparison import compare
    from ccatp.aligning.report import csv_lines, result_data
    from ccatp.aligning.survey_result import survey_result
    from ccatp.aligning.table import head_lines, table_lines
    from ccatp.mirror.mirror import build_mirror
    from ccatp.run_files.survey_reader import read_run

    changes = overrides(settings, {})
    if idle := [key for key in changes if not key.startswith(ACTING)]:
        raise ConfigError(f"command line: {idle[0]}: has no effect on the alignment; what has: {', '.join(ACTING)}")
    survey = read_run(run_dir, changes)
    cfg = survey.cfg
    mirror = build_mirror(cfg.mirror)
    planned = {point.panel for point in survey.planned}
    result = survey_result(mirror, cfg.align, cfg.robot.puck_height_m, survey.measured, planned)
    comparison = None if survey.injected is None else compare(result.panels, survey.injected)
    facts = _facts(run_dir, survey, result)
    warnings = [*survey.warnings, *result.warnings]
    for warning in warnings:
        complain(f"warning: {warning}", 0)
    if csv_file is not None:
        _write(csv_file, csv_lines(result))
    if figure_file is not None:
        from ccatp.pictures.align_map import draw_alignment

        draw_alignment(mirror, result, figure_file, f"{mirror.name}: {len(result.panels)} panels", str(run_dir))
    if json_output:
        click.echo(json.dumps({**facts, **result_data(result, comparison), "warnings": warnings}))
        return 0
    for line in (*head_lines(facts), *table_lines(result, comparison, cfg.align.puck_height_sigma_m)):
        click.echo(line)
    return 0


def _facts(run_dir: Path, survey: "Survey", result: "SurveyResult") -> dict[str, Any]:
    cfg = survey.cfg
    return {
        "run_dir": str(run_dir),
        "mirror": cfg.mirror.name,
        "world": cfg.world.name if survey.is_simulation else None,
        "seed": cfg.run.seed,
        "points": {
            "total": len(survey.planned),
            "measured": len(survey.measured),
            "outliers": sum(len(panel.outliers) for panel in result.panels),
        },
        "adjusters": list(result.panels[0].adjusters) if result.panels else [],
        "puck_height_sigma_um": round(cfg.align.puck_height_sigma_m * 1e6, 4),
    }


def _write(path: Path, lines: Iterable[str]) -> None:
    try:
        with path.open("w", encoding="utf-8") as file:
            file.writelines(line + "\n" for line in lines)
    except OSError as error:
        raise AlignError(f"--csv: cannot write {path}: {error.strerror or error}") from error
