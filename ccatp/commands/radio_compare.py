"""Glue. The command ``ccatp radio compare``."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from ccatp.commands.frame import CONFIG_OPTION, JSON_OPTION, complain, example, overrides, settings_option
from ccatp.commands.recorded_slam import FORMATS, compared


@click.command(
    epilog=example(
        "ccatp radio compare recordings/Plaza2_.mat recordings/MRCLAM_Dataset7",
        "ccatp radio compare recordings/Plaza2_.mat --peers",
    )
)
@click.argument("paths", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--format", "data_format", type=click.Choice(FORMATS), help="Format of all the data; found out if not given."
)
@click.option(
    "--robot", type=click.IntRange(min=1), metavar="N", help="Robot of an MRCLAM set; else all that are there."
)
@click.option("--peers", is_flag=True, help="GTSAM (iSAM2, batch) on the same input as well; needs ccatp[peers].")
@CONFIG_OPTION
@settings_option("A key of recordings.toml, as in plaza.priors.range_scale=0.1.")
@JSON_OPTION
def compare(
    paths: Sequence[Path], data_format: str | None, robot: int | None, peers: bool, config_file: Path | None,
    settings: Mapping[str, object], json_output: bool,
) -> int:  # fmt: skip
    """Run all estimators over recorded runs: a table of their errors and times, side by side."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small; threads would only fight over them
    from ccatp.config.recording_loader import load_recordings_config
    from ccatp.radio.comparison import markdown, with_means
    from ccatp.radio_data.reader import read_run, robots_of

    assumed = load_recordings_config(config_file, overrides(settings, {}))
    rows: list[dict[str, Any]] = []
    for path in paths:
        found: list[dict[str, Any]] = []
        for one in robots_of(path, data_format) if robot is None else [robot]:
            run = read_run(path, data_format, one)
            complain(f"{run.name} ...", 0)
            found += compared(run, assumed, peers)
        rows += with_means(found, f"{path.resolve().name}, mean")
    if json_output:
        click.echo(json.dumps({"rows": rows}, allow_nan=False))
        return 0
    for line in markdown(rows):
        click.echo(line)
    return 0
