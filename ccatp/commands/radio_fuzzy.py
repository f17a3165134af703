"""Glue. The command ``ccatp radio fuzzy``."""

import json
from collections.abc import Sequence
from math import isfinite
from pathlib import Path

import click

from ccatp.commands.frame import JSON_OPTION, SETTINGS_OPTION, example, figure_option
from ccatp.commands.radio_calibrate import CalibrateError


@click.command(epilog=example("ccatp radio fuzzy --figure speed.png", "ccatp radio fuzzy --at 0.3 0.5"))
@click.option("--config", "config_file", type=click.Path(path_type=Path), help="Configuration (TOML).")
@SETTINGS_OPTION
@click.option(
    "--at", nargs=2, type=float, multiple=True, metavar="M RAD", help="Speed at a distance and a heading error."
)
@figure_option("Draw it")
@JSON_OPTION
def fuzzy(
    config_file: Path | None, settings: dict[str, object], at: Sequence[tuple[float, float]], figure_file: Path | None,
    json_output: bool,
) -> int:  # fmt: skip
    """Show the fuzzy speed controller: its table, its surface, its value at a point."""
    from ccatp.config.radio_loader import load_radio_config
    from ccatp.control.fuzzy import FuzzyGapError, Sugeno

    for distance_m, error_rad in at:
        if not (isfinite(distance_m) and isfinite(error_rad) and distance_m >= 0.0):
            raise CalibrateError(f"--at {distance_m:g} {error_rad:g}: wants a distance >= 0 m and a finite angle, rad")
    cfg = load_radio_config(config_file, settings).control.fuzzy
    try:
        sugeno = Sugeno(cfg)
    except FuzzyGapError as error:
        raise CalibrateError(f"control.fuzzy: {error}") from error
    distances, errors = (0.05, 0.25, 0.5, 0.8, 1.5), (0.0, 0.3, 0.6, 1.0, 1.6)
    points = list(at) or [(distance_m, error_rad) for error_rad in errors for distance_m in distances]
    values = []
    for distance_m, error_rad in points:
        named = {"distance_m": distance_m, "heading_error_rad": abs(error_rad)}
        values.append({**named, "speed_m_s": round(sugeno.evaluate([named[name] for name in sugeno.inputs]), 5)})
    if figure_file is not None:
        from ccatp.pictures.level_figures import draw_fuzzy

        draw_fuzzy(cfg, figure_file)
    if json_output:
        click.echo(json.dumps({"rules": len(cfg.rules), "points": values}))
        return 0
    click.echo("distance, m   heading error, rad   speed, m/s")
    for value in values:
        click.echo(f"{value['distance_m']:11.2f} {value['heading_error_rad']:20.2f} {value['speed_m_s']:12.3f}")
    return 0
