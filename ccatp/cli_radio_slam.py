"""Glue. The command ``ccatp radio slam``."""

from pathlib import Path

import click

from ccatp.cli_frame import example

FORMATS = ("plaza", "mrclam", "labyrinth", "csv")


@click.command(
    epilog=example(
        "ccatp radio slam recordings/Plaza2_.mat",
        "ccatp radio slam recordings/MRCLAM_Dataset7 --robot 2 --filter smoother --json",
    )
)
@click.argument("path", type=click.Path(path_type=Path))
@click.option("--format", "data_format", type=click.Choice(FORMATS), help="Format of the data; found out if not given.")
@click.option(
    "--robot", type=click.IntRange(min=1), metavar="N", help="Which robot of a set of several; 1 if not given."
)
def slam(path: Path, data_format: str | None, robot: int | None) -> int:
    """Map the beacons of a recorded run and find the vehicle's path on that map."""
    from ccatp.radio_data.reader import read_run

    run = read_run(path, data_format, robot)
    click.echo(f"{run.name}: {len(run.steps.distance_m)} odometry steps, {len(run.readings.times_s)} readings")
    return 0
