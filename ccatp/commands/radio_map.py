"""Glue. The command ``ccatp radio map``."""

import json
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ccatp.commands.frame import JSON_OPTION, OutputFile, complain, example, figure_option, overrides, settings_option

if TYPE_CHECKING:
    from ccatp.config.cricket_models import CricketConfig

METHODS = ("ekf", "batch")


@click.command(
    "map",
    epilog=example(
        "ccatp radio map --config configs/cricket.toml --seeds 20",
        "ccatp radio map --method ekf --set cricket.phase2.pairs=zigzag --figure map.png",
        "ccatp radio map --ranges ranges.csv --offset --out beacons.toml --json",
    ),
)
@click.option("--config", "config_file", type=click.Path(path_type=Path), help="Motes to simulate (TOML).")
@click.option(
    "--ranges", "ranges_file", type=click.Path(path_type=Path), help="Measured ranges (CSV) in place of simulated ones."
)
@click.option("--tags", "tags_file", type=click.Path(path_type=Path), help="Places of tags on their trolley (CSV).")
@click.option("--truth", "truth_file", type=click.Path(path_type=Path), help="True places (CSV) to compare with.")
@click.option(
    "--method", type=click.Choice(METHODS), default="batch", show_default=True, help="Filter, or all ranges at once."
)
@click.option("--seeds", type=click.IntRange(min=1), default=1, show_default=True, metavar="N", help="Simulated runs.")
@click.option("--seed", type=click.IntRange(min=0), metavar="N", help="Seed of the first run.")
@click.option("--offset", is_flag=True, help="Estimate a common offset of the ranges.")
@click.option("--scale", is_flag=True, help="Estimate a common scale of the ranges.")
@click.option(
    "--dimension", type=click.IntRange(2, 3), metavar="D", help="2 for motes in a plane, 3 for motes in space."
)
@settings_option("A key of cricket, as in cricket.phase2.pairs=zigzag.")
@click.option("--out", "out_file", type=OutputFile(), help="Write a beacon file (TOML).")
@figure_option("Draw map and errors")
@JSON_OPTION
def radio_map(
    config_file: Path | None, ranges_file: Path | None, tags_file: Path | None, truth_file: Path | None,
    method: str, seeds: int, seed: int | None, offset: bool, scale: bool, dimension: int | None,
    settings: Mapping[str, object], out_file: Path | None, figure_file: Path | None, json_output: bool,
) -> int:  # fmt: skip
    """Map beacons from the ranges between them."""
    if ranges_file is None and (tags_file is not None or truth_file is not None):
        raise click.UsageError("--tags and --truth go with --ranges; a simulation knows both")
    if ranges_file is not None and seeds > 1:
        raise click.UsageError("--seeds is for simulated ranges; --ranges has been measured once")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small; threads would only fight over them
    from ccatp.config.radio_loader import load_radio_config

    named: dict[str, object] = {
        "run.seed": seed,
        "cricket.dimension": dimension,
        "cricket.batch.estimates_offset": offset or None,
        "cricket.batch.estimates_scale": scale or None,
    }
    if config_file is None:
        named["system"] = "cricket"
    cfg = load_radio_config(config_file, overrides(settings, named), simulates=ranges_file is None)
    if ranges_file is None:
        data = _simulated(cfg.cricket, method, range(cfg.run.seed, cfg.run.seed + seeds), out_file, figure_file)
    else:
        data = _measured(cfg.cricket, method, (ranges_file, tags_file, truth_file), out_file, figure_file)
    for warning in data["warnings"]:
        complain(f"warning: {warning}", 0)
    if json_output:
        click.echo(json.dumps(data))
    else:
        from ccatp.motes.mote_table import report_lines

        for line in report_lines(data):
            click.echo(line)
    return 0


def _simulated(
    cfg: "CricketConfig", method: str, seeds: range, out_file: Path | None, figure_file: Path | None
) -> dict[str, Any]:
    from ccatp.pictures.mote_figure import draw_mote_map
    from ccatp.studies.mote_pictures import pictured
    from ccatp.studies.mote_summary import campaign_data, run_campaign

    campaign = run_campaign(cfg, method, seeds, _progress(len(seeds)))
    if out_file is not None:
        _write(out_file, *campaign.runs[0].whole, cfg.layout)
    if figure_file is not None:
        draw_mote_map(*pictured(campaign, seeds[0]), figure_file)
    return campaign_data(campaign)


def _measured(
    cfg: "CricketConfig",
    method: str,
    files: tuple[Path, Path | None, Path | None],
    out_file: Path | None,
    figure_file: Path | None,
) -> dict[str, Any]:
    import numpy as np

    from ccatp.motes.measured_map import map_measured
    from ccatp.pictures.mote_figure import MapPicture, draw_mote_map
    from ccatp.radio_data.range_csv import read_places, read_ranges

    ranges_file, tags_file, truth_file = files
    found = map_measured(
        cfg,
        method,
        read_ranges(ranges_file, cfg.ranging.sigma_m),
        None if tags_file is None else read_places(tags_file),
        None if truth_file is None else read_places(truth_file),
    )
    if out_file is not None:
        _write(out_file, found.names, found.positions_m, found.covariance_m2, "measured")
    if figure_file is not None:
        error = found.data["rms_m"]["p50"]
        title = f"{method}, {len(found.names)} motes" + (f", error {1e3 * error:.3g} mm" if error is not None else "")
        nothing = np.zeros((0, 2), dtype=np.intp)
        picture = MapPicture(found.names, found.positions_m, found.covariance_m2, found.true_m, nothing, (), title)
        draw_mote_map(picture, None, figure_file)
    return found.data


def _write(path: Path, names: tuple[str, ...], positions_m: Any, covariance_m2: Any, layout: str) -> None:
    from ccatp.radio_data.beacon_file import write_beacons

    frame = "field: as the anchors and surveyed places of the configuration say"
    if layout != "networks":
        frame = "own: first beacon at the origin, second on +x, third at y > 0; covariance of the aligned map"
    write_beacons(path, names, positions_m, covariance_m2, frame)


def _progress(total: int) -> Callable[[int], None]:
    """A counter on a terminal, a line for each tenth elsewhere, on standard error; nothing for a single run."""
    is_live = sys.stderr.isatty()

    def tell(done: int) -> None:
        if total == 1:
            return
        if is_live:
            click.echo(f"\rccatp: {done} of {total} runs", nl=done == total, err=True)
        elif 10 * done // total > 10 * (done - 1) // total:
            complain(f"{done} of {total} runs", 0)

    return tell
