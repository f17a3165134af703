"""Glue. The command ``ccatp map``."""

from pathlib import Path

import click

from ccatp.commands.frame import OutputFile, example


@click.command("map", epilog=example("ccatp map runs/20260101T000000Z-fyst-m1-s1 --out map.png"))
@click.argument("run_dir", type=click.Path(path_type=Path))
@click.option(
    "--out", type=OutputFile(".png", ".pdf", ".svg"), help="The picture; map.png in the run directory if not given."
)
def draw_map(run_dir: Path, out: Path | None) -> int:
    """Draw the map of a run: panels, path, and each point coloured by its arrival error."""
    from ccatp.pictures.run_map import draw_from_run_dir

    picture = out or run_dir / "map.png"
    draw_from_run_dir(run_dir, picture)
    click.echo(picture)
    return 0
