"""The commands ``ccatp radio``: recorded runs through estimators, maps of motes from their ranges, signal levels."""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ccatp.cli.common import (
    CONFIG_OPTION,
    JSON_OPTION,
    PATH,
    CommandGroup,
    OutputFile,
    complain,
    example,
    figure_option,
    overrides,
    print_lines,
    settings_option,
    warn,
)
from ccatp.cli.radio_levels import calibrate, fix, fuzzy
from ccatp.errors import CcatpError, ExitStatus

if TYPE_CHECKING:
    from ccatp.beacons.slam.recording import EstimatedPath, RecordedRun
    from ccatp.config.beacon_models import CricketConfig, RecordingsConfig

FILTERS = ("ekf-slam", "smoother")
FORMAT_OPTION = click.option(
    "--format", "data_format", type=click.Choice(("plaza", "mrclam", "labyrinth", "csv")),
    help="Format of the data; found out if not given.",
)  # fmt: skip
ASSUMED_OPTION = settings_option("A key of recordings.toml, as in plaza.priors.range_scale=0.1.")


class SlamCommandError(CcatpError):
    """A part that is not installed, or data of which an estimator makes nothing."""

    exit_status = ExitStatus.USAGE


def estimate(run: "RecordedRun", assumed: "RecordingsConfig", filter_name: str) -> "EstimatedPath":
    """A run through one of ``FILTERS``.

    Raises SlamCommandError: the data drove the estimator beyond finite numbers, or leave it without an answer.
    """
    from time import perf_counter

    from numpy.linalg import LinAlgError

    from ccatp.beacons.datasets.checks import survey_doubts
    from ccatp.beacons.slam.batch_smoother import smooth
    from ccatp.beacons.slam.causal import filter_run
    from ccatp.filters.base import FilterError

    cfg = getattr(assumed, run.kind)
    try:
        find = smooth if filter_name == "smoother" else filter_run
        track = find(run, cfg, assumed.filter, perf_counter)
        if run.truth is not None:
            return track
        places_m = {name: (fix.x_m, fix.y_m) for name, fix in track.beacons.items()}
        return track._replace(warnings=(*track.warnings, *survey_doubts(places_m, run.beacon_truth_m)))
    except (FilterError, LinAlgError) as error:
        raise SlamCommandError(
            f"{run.name}: {filter_name} finds no finite map for these data ({str(error)[:80]}); look at its warnings"
        ) from error


def compared(run: "RecordedRun", assumed: "RecordingsConfig", peers: bool) -> list[dict[str, Any]]:
    """A row for each of our estimators, and for GTSAM's if asked for; without figures where GTSAM gave up."""
    from time import perf_counter

    from ccatp.beacons.slam.evaluation import row, row_without
    from ccatp.studies.gtsam_peer import PeerGaveUp, import_gtsam, run_gtsam

    if peers:
        import_gtsam()  # before the work
    rows = []
    for name in FILTERS:
        begin_s = perf_counter()
        track = estimate(run, assumed, name)
        rows.append(row(run, name, track, perf_counter() - begin_s))
    if peers:
        try:
            found = run_gtsam(run, getattr(assumed, run.kind), perf_counter)
        except PeerGaveUp as error:
            warn([str(error)])
            return [*rows, *(row_without(run.name, f"GTSAM {name}", gave_up=True) for name in ("iSAM2", "batch"))]
        rows.append(row(run, "GTSAM iSAM2", found.isam2, float(found.isam2.update_s.sum()), peer=True))
        # it starts from what iSAM2 ended with, so that its time is not a run's
        rows.append(row(run, "GTSAM batch", found.batch, None, peer=True))
    return rows


@click.command(
    epilog=example(
        "ccatp radio slam recordings/Plaza2_.mat",
        "ccatp radio slam recordings/MRCLAM_Dataset7 --robot 2 --filter smoother --json",
        "ccatp radio slam mine.csv --set csv.radio.range_sigma_m=0.3 --figure map.png",
    )
)
@click.argument("path", type=PATH)
@FORMAT_OPTION
@click.option("--robot", type=click.IntRange(min=1), metavar="N", help="Robot of an MRCLAM set; else the first there.")
@click.option(
    "--filter", "filter_name", type=click.Choice(FILTERS), default=FILTERS[0], show_default=True,
    help="ekf-slam: at each instant from readings up to it; smoother: from all of them.",
)  # fmt: skip
@CONFIG_OPTION
@ASSUMED_OPTION
@figure_option("Draw map and path")
@click.option("--peers", is_flag=True, help="All our estimators and GTSAM's side by side; needs ccatp[peers].")
@JSON_OPTION
def slam(
    path: Path, data_format: str | None, robot: int | None, filter_name: str, config_file: Path | None,
    settings: Mapping[str, object], figure_file: Path | None, peers: bool, json_output: bool,
) -> None:  # fmt: skip
    """Map the beacons of a recorded run and find the vehicle's path on that map.

    PATH is a file or folder of the formats Plaza, MRCLAM, Labyrinth, or a CSV of events (docs/radio_data.md).
    """
    from ccatp.beacons.datasets.reader import read_run
    from ccatp.beacons.slam.evaluation import judge, markdown, result_data, table_lines
    from ccatp.config.load import load_recordings_config

    assumed = load_recordings_config(config_file, settings)
    run = read_run(path, data_format, robot)
    warn(run.warnings)
    track = estimate(run, assumed, filter_name)
    warn(track.warnings)
    judged = judge(track, run)
    data: dict[str, Any] = result_data(run, filter_name, track, judged)
    if figure_file is not None:
        from ccatp.report.beacon_plots import draw_slam

        draw_slam(run, track, judged, figure_file, f"{run.name}, {filter_name}")
    if peers:
        data["peers"] = compared(run, assumed, peers=True)
    if json_output:
        click.echo(json.dumps(data, allow_nan=False))
        return
    print_lines(table_lines(run, data))
    if peers:
        print_lines(("", *markdown(data["peers"])))


@click.command(
    epilog=example(
        "ccatp radio compare recordings/Plaza2_.mat recordings/MRCLAM_Dataset7",
        "ccatp radio compare recordings/Plaza2_.mat --peers",
    )
)
@click.argument("paths", nargs=-1, required=True, type=PATH)
@FORMAT_OPTION
@click.option("--robot", type=click.IntRange(min=1), metavar="N", help="Robot of MRCLAM sets; else all there.")
@click.option("--peers", is_flag=True, help="GTSAM (iSAM2, batch) on the same input as well; needs ccatp[peers].")
@CONFIG_OPTION
@ASSUMED_OPTION
@JSON_OPTION
def compare(
    paths: Sequence[Path], data_format: str | None, robot: int | None, peers: bool, config_file: Path | None,
    settings: Mapping[str, object], json_output: bool,
) -> None:  # fmt: skip
    """Run all estimators over recorded runs: a table of their errors and times, side by side."""
    from ccatp.beacons.datasets.reader import read_run, robots_of
    from ccatp.beacons.slam.evaluation import markdown, with_means
    from ccatp.config.load import load_recordings_config

    assumed = load_recordings_config(config_file, settings)
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
    else:
        print_lines(markdown(rows))


@click.command(
    "map",
    epilog=example(
        "ccatp radio map --config cricket --seeds 20",
        "ccatp radio map --method ekf --set cricket.phase2.pairs=zigzag --figure map.png",
        "ccatp radio map --ranges ranges.csv --offset --out beacons.toml --json",
    ),
)
@CONFIG_OPTION
@click.option("--ranges", "ranges_file", type=PATH, help="Measured ranges (CSV) in place of simulated ones.")
@click.option("--tags", "tags_file", type=PATH, help="Places of tags on their trolley (CSV).")
@click.option("--truth", "truth_file", type=PATH, help="True places (CSV) to compare with.")
@click.option(
    "--method",
    type=click.Choice(("ekf", "batch")),
    default="batch",
    show_default=True,
    help="Filter, or all ranges at once.",
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
) -> None:  # fmt: skip
    """Map beacons from the ranges between them."""
    if ranges_file is None and (tags_file is not None or truth_file is not None):
        raise click.UsageError("--tags and --truth go with --ranges; a simulation knows both")
    if ranges_file is not None and seeds > 1:
        raise click.UsageError("--seeds is for simulated ranges; --ranges has been measured once")
    from ccatp.beacons.cricket.measured_map import report_lines
    from ccatp.config.load import load_radio_config

    named: dict[str, object] = {
        "run.seed": seed,
        "cricket.dimension": dimension,
        "cricket.batch.estimates_offset": offset or None,
        "cricket.batch.estimates_scale": scale or None,
        "system": "cricket" if config_file is None else None,
    }
    cfg = load_radio_config(config_file, overrides(settings, named), simulates=ranges_file is None)
    if ranges_file is None:
        data = _simulated(cfg.cricket, method, range(cfg.run.seed, cfg.run.seed + seeds), out_file, figure_file)
    else:
        data = _measured(cfg.cricket, method, (ranges_file, tags_file, truth_file), out_file, figure_file)
    warn(data["warnings"])
    print_lines([json.dumps(data)] if json_output else report_lines(data))


def _simulated(
    cfg: "CricketConfig", method: str, seeds: range, out_file: Path | None, figure_file: Path | None
) -> dict[str, Any]:
    from ccatp.report.beacon_plots import draw_mote_map
    from ccatp.studies.mote_runs import campaign_data, pictured, run_campaign

    campaign = run_campaign(cfg, method, seeds, _progress(len(seeds)))
    if out_file is not None:
        run = campaign.runs[0]
        _write(out_file, run.whole or (run.names, run.positions_m, run.covariance_m2), cfg.layout)
    if figure_file is not None:
        draw_mote_map(*pictured(campaign, seeds[0]), figure_file)
    return campaign_data(campaign)


def _measured(
    cfg: "CricketConfig", method: str, files: tuple[Path, Path | None, Path | None], out_file: Path | None,
    figure_file: Path | None,
) -> dict[str, Any]:  # fmt: skip
    import numpy as np

    from ccatp.beacons.cricket.measured_map import map_measured
    from ccatp.beacons.datasets.sheets import read_places, read_ranges
    from ccatp.report.beacon_plots import MapPicture, draw_mote_map

    ranges = read_ranges(files[0], cfg.ranging.sigma_m)
    tags_m, truth_m = (None if file is None else read_places(file) for file in files[1:])
    found = map_measured(cfg, method, ranges, tags_m, truth_m)
    if out_file is not None:
        _write(out_file, found[:3], "measured")
    if figure_file is not None:
        error = found.data["rms_m"]["p50"]
        title = f"{method}, {len(found.names)} motes" + (f", error {1e3 * error:.3g} mm" if error is not None else "")
        nothing = np.zeros((0, 2), dtype=np.intp)
        picture = MapPicture(found.names, found.positions_m, found.covariance_m2, found.true_m, nothing, (), title)
        draw_mote_map(picture, None, figure_file)
    return found.data


def _write(path: Path, found: tuple[Any, Any, Any], layout: str) -> None:
    from ccatp.beacons.datasets.sheets import write_beacons

    frame = "field: as the anchors and surveyed places of the configuration say"
    if layout != "networks":
        frame = "own: first beacon at the origin, second on +x, third at y > 0; covariance of the aligned map"
    write_beacons(path, *found, frame)


def _progress(total: int) -> Callable[[int], None]:
    is_live = sys.stderr.isatty()

    def show(done: int) -> None:
        if total == 1:
            return
        if is_live:
            click.echo(f"\rccatp: {done} of {total} runs", nl=done == total, err=True)
        elif 10 * done // total > 10 * (done - 1) // total:
            complain(f"{done} of {total} runs", 0)

    return show


@click.group(cls=CommandGroup, epilog=example("ccatp radio slam recordings/Plaza2_.mat"))
def radio() -> None:
    """Robots among radio beacons: mapping them, finding the way by them."""


for command in (slam, calibrate, fix, fuzzy, radio_map, compare):
    radio.add_command(command)
