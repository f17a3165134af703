"""Glue. The command ``ccatp radio slam``."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from ccatp.commands.frame import (
    CONFIG_OPTION,
    JSON_OPTION,
    complain,
    example,
    figure_option,
    overrides,
    settings_option,
)
from ccatp.commands.recorded_slam import FILTERS, FORMATS, compared, estimate


@click.command(
    epilog=example(
        "ccatp radio slam recordings/Plaza2_.mat",
        "ccatp radio slam recordings/MRCLAM_Dataset7 --robot 2 --filter smoother --json",
        "ccatp radio slam mine.csv --set csv.radio.range_sigma_m=0.3 --figure map.png",
    )
)
@click.argument("path", type=click.Path(path_type=Path))
@click.option("--format", "data_format", type=click.Choice(FORMATS), help="Format of the data; found out if not given.")
@click.option("--robot", type=click.IntRange(min=1), metavar="N", help="Robot of an MRCLAM set; else the first there.")
@click.option(
    "--filter", "filter_name", type=click.Choice(FILTERS), default=FILTERS[0], show_default=True,
    help="ekf-slam: at each instant from readings up to it; smoother: from all of them.",
)  # fmt: skip
@CONFIG_OPTION
@settings_option("A key of recordings.toml, as in plaza.priors.range_scale=0.1.")
@figure_option("Draw map and path")
@click.option("--peers", is_flag=True, help="All our estimators and GTSAM's side by side; needs ccatp[peers].")
@JSON_OPTION
def slam(
    path: Path, data_format: str | None, robot: int | None, filter_name: str, config_file: Path | None,
    settings: Mapping[str, object], figure_file: Path | None, peers: bool, json_output: bool,
) -> int:  # fmt: skip
    """Map the beacons of a recorded run and find the vehicle's path on that map.

    PATH is a file or folder of the formats Plaza, MRCLAM, Labyrinth, or a CSV of events (docs/radio_data.md).
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small; threads would only fight over them
    from ccatp.config.recording_loader import load_recordings_config
    from ccatp.radio.judged import judge
    from ccatp.radio.slam_report import result_data, table_lines
    from ccatp.radio_data.reader import read_run

    assumed = load_recordings_config(config_file, overrides(settings, {}))
    run = read_run(path, data_format, robot)
    for warning in run.warnings:
        complain(f"warning: {warning}", 0)
    track = estimate(run, assumed, filter_name)
    for warning in track.warnings:
        complain(f"warning: {warning}", 0)
    judged = judge(track, run)
    data: dict[str, Any] = result_data(run, filter_name, track, judged)
    if figure_file is not None:
        from ccatp.pictures.slam_map import draw_slam

        draw_slam(run, track, judged, figure_file, f"{run.name}, {filter_name}")
    if peers:
        data["peers"] = compared(run, assumed, peers=True)
    if json_output:
        click.echo(json.dumps(data, allow_nan=False))
        return 0
    for line in table_lines(run, data):
        click.echo(line)
    if peers:
        from ccatp.radio.comparison import markdown

        for line in ("", *markdown(data["peers"])):
            click.echo(line)
    return 0
