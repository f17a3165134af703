"""Glue. The command ``ccatp plan``."""

import json
from collections.abc import Mapping
from pathlib import Path

import click

from ccatp.commands.frame import JSON_OPTION, WORLD_OPTIONS, complain, example, figure_option, overrides
from ccatp.errors import ExitStatus


@click.command(
    epilog=example(
        "ccatp plan --mirror fyst-m2",
        "ccatp plan --config telescope.toml --figure plan.png",
        "ccatp plan --set run.order=optimised --set mission.leg_clearance_m=0.12 --json",
    )
)
@WORLD_OPTIONS
@click.option("--panels", type=int, metavar="N", help="Only the first N panels of the traversal; 0 takes all.")
@click.option("--filter", "filter_name", metavar="NAME", help="State estimator: some drive a calibration first.")
@figure_option("Draw the way")
@JSON_OPTION
def plan(
    config_file: Path | None, mirror: str | None, world: str | None, seed: int | None,
    settings: Mapping[str, object], panels: int | None, filter_name: str | None,
    figure_file: Path | None, json_output: bool,
) -> int:  # fmt: skip
    """Tell what a survey would do, without moving anything: order, way, least time, points out of reach.

    The exit status is 2 where points are out of reach: a run would be refused.
    """
    from ccatp.config.loader import load_config
    from ccatp.mirror.mirror import build_mirror
    from ccatp.survey_plan import make_plan, plan_data, plan_lines

    named = {
        "run.mirror": mirror, "run.world": world, "run.seed": seed, "run.panels": panels, "run.filter": filter_name,
    }  # fmt: skip
    cfg = load_config(config_file, overrides(settings, named))
    geometry = build_mirror(cfg.mirror)
    found = make_plan(cfg, geometry)
    if figure_file is not None:
        from ccatp.pictures.plan_map import draw_plan

        draw_plan(geometry, found, figure_file)
    for line in [json.dumps(plan_data(cfg, found))] if json_output else plan_lines(cfg, found):
        click.echo(line)
    if found.out_of_reach:
        count = len(found.out_of_reach)
        return complain(
            f"{count} points are out of reach with mission.leg_clearance_m = {cfg.mission.leg_clearance_m:g} and "
            f"turn_clearance_m = {cfg.mission.turn_clearance_m:g}; a run would be refused",
            ExitStatus.USAGE,
        )
    return 0
