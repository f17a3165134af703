"""Glue. The commands ``ccatp report`` and ``ccatp compare``."""

import json
import os
from pathlib import Path

import click

from ccatp.commands.frame import complain, example

_FILE = click.Path(path_type=Path, dir_okay=False)
_FOLDER = click.Path(path_type=Path, file_okay=False)
_FIGURES = click.option("--figures", type=_FOLDER, metavar="DIR", help="Also write the figures there: SVG, PNG, PDF.")
_JSON = click.option("--json", "json_output", is_flag=True, help="The figures of it as JSON on standard output.")


@click.command(
    epilog=example("ccatp report runs/tonight", "ccatp report runs/tonight --out tonight.html --figures figs")
)
@click.argument("run_dir", type=click.Path(path_type=Path))
@click.option("--out", type=_FILE, metavar="FILE", help="The page; report.html in the run directory if not given.")
@_FIGURES
@_JSON
def report(run_dir: Path, out: Path | None, figures: Path | None, json_output: bool) -> int:
    """Write the report of a run: one page that opens without a network.

    Map, errors, how the panels lie, where the time went, events. It takes runs that are over, go on, were killed or
    resumed, and says what is missing.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small; threads would only fight over them
    from ccatp.report_writer import report_run

    path, data, warnings = report_run(run_dir, out, figures)
    for warning in warnings:
        complain(f"warning: {warning}", 0)
    click.echo(json.dumps({"report": str(path), **data}) if json_output else path)
    return 0


@click.command(epilog=example("ccatp compare runs/before runs/after", "ccatp compare runs/a runs/b --json"))
@click.argument("run_a", type=click.Path(path_type=Path))
@click.argument("run_b", type=click.Path(path_type=Path))
@click.option("--out", type=_FILE, metavar="FILE", help="The page; compare.html in RUN_B if not given.")
@_FIGURES
@_JSON
def compare(run_a: Path, run_b: Path, out: Path | None, figures: Path | None, json_output: bool) -> int:
    """Put two runs beside each other: figures, configuration, time, errors, and which panels have moved."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from ccatp.report_writer import COMPARISON, compare_runs
    from ccatp.reporting.compare_text import compare_data, compare_lines

    path = out or run_b / COMPARISON
    pair = compare_runs(run_a, run_b, path, figures)
    for found in (pair.a, pair.b):
        for warning in found.record.warnings:
            complain(f"warning: {found.record.name}: {warning}", 0)
    for line in [json.dumps({"report": str(path), **compare_data(pair)})] if json_output else compare_lines(pair):
        click.echo(line)
    if not json_output:
        click.echo(path)
    return 0
