"""The commands ``ccatp radio``: estimators on recorded runs, maps of motes from their ranges, signal levels."""

import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ccatp.beacons.cli.radio_levels import calibrate, coordinates, fix, fuzzy
from ccatp.cli import common

if TYPE_CHECKING:
    from ccatp.beacons.config.models import CricketConfig
    from ccatp.beacons.cricket.measured_map import MeasuredRanges
    from ccatp.beacons.estimation.recording import EstimatedPath, Known, RecordedRun

FILTERS = ("ekf-slam", "fixed-lag", "smoother")


@common.command(
    "ccatp radio slam recordings/Plaza2_.mat",
    "ccatp radio slam recordings/MRCLAM_Dataset7 --robot 2 --filter smoother --json",
    "ccatp radio slam mine.csv --map anchors.csv --start 0.5,2,1.57",
    "ccatp radio slam mine.csv --set csv.radio.range_sigma_m=0.3 --figure map.png",
)
@click.argument("path", type=common.PATH)
@click.option(
    "--format", "data_format", type=click.Choice(("plaza", "mrclam", "labyrinth", "csv", "columns", "pyfg", "bag")),
    help="Format of the data; detected if not given.",
)  # fmt: skip
@click.option(
    "--robot", type=click.IntRange(min=1), metavar="N",
    help="Robot of an MRCLAM set; by default that of the named file, or the first.",
)  # fmt: skip
@click.option(
    "--filter", "filter_name", type=click.Choice(FILTERS), default="fixed-lag", show_default=True,
    help="ekf-slam: a filter, which linearises each reading once; fixed-lag: readings of the last minutes are "
    "linearised again, and the path is also estimated some seconds later; smoother: from all readings of the run.",
)  # fmt: skip
@common.CONFIG_OPTION
@common.settings_option("A key of recordings.toml, as in plaza.priors.range_scale=0.1.")
@click.option(
    "--keep-heading", is_flag=True, help="Do not correct a heading of the truth that is turned against its course."
)
@click.option(
    "--map", "map_file", type=common.PATH, help="Known places of beacons: the vehicle is localized among them."
)
@click.option("--start", metavar="X,Y,HEADING", help="First pose, in place of that of the truth: m, m, rad.")
@click.option(
    "--tag",
    default="",
    metavar="NAME",
    help="Only radio of the vehicle that is used; by default all whose place is given.",
)
@click.option(
    "--moving",
    multiple=True,
    metavar="NAME",
    help="Beacon that moves, by filter.beacon_walk_m_sqrt_s. May be repeated.",
)
@click.option("--topics", "topics_file", type=common.PATH, help="TOML file that names the topics of a ROS bag.")
@common.figure_option("Draw map, path and residuals")
@click.option(
    "--tum",
    "tum_file",
    type=common.OutputFile(second="_truth"),
    help="Write the path in the TUM format of evo, and the truth to NAME_truth beside it.",
)
@click.option(
    "--out",
    "out_dir",
    type=common.OutputFolder("path.csv", "path_delayed.csv", "readings.csv", "moving.csv", "graph.pyfg", "map.toml"),
    metavar="DIR",
    help="Write path, map, readings with innovations, and a factor graph.",
)
@click.option("--peers", is_flag=True, help="Compare all our estimators with those of GTSAM; needs ccatp[peers].")
@common.JSON_OPTION
def slam(
    path: Path, data_format: str | None, robot: int | None, filter_name: str, config_file: Path | None,
    settings: Mapping[str, object], keep_heading: bool, map_file: Path | None, start: str | None,
    moving: tuple[str, ...], tag: str, topics_file: Path | None, figure_file: Path | None, tum_file: Path | None,
    out_dir: Path | None, peers: bool, json_output: bool,
) -> None:  # fmt: skip
    """Map the beacons of a recorded run and find the vehicle's path on that map, or on a known one.

    PATH is a file or folder of the formats Plaza, MRCLAM, Labyrinth, a CSV of events, tables with headers, a factor
    graph (pyfg), or a ROS bag (docs/radio_data.md).
    """
    from ccatp.beacons.config.effects import recording_keys_without_effect
    from ccatp.beacons.config.load import load_recordings_config
    from ccatp.beacons.datasets.reader import read_run
    from ccatp.beacons.estimation.evaluation import judge, result_data, table_lines
    from ccatp.beacons.estimation.track_review import review_lines, reviewed
    from ccatp.beacons.studies.recordings import COMPARED, compared, estimate, settings_of
    from ccatp.studies.results import markdown_table

    assumed = load_recordings_config(config_file, settings)
    known = _known(map_file, start)._replace(moving=moving)
    run = read_run(path, data_format, robot, topics_file, tag=tag, turns_heading=not keep_heading, known=known)
    if known.map is not None and known.first_pose is None and run.truth is None:
        raise click.UsageError("--map: the run has no truth of its first pose; give it with --start X,Y,HEADING")
    shipped = load_recordings_config()
    unused = recording_keys_without_effect(assumed, shipped, run.kind, filter_name, moves=bool(moving))
    run = replace(run, warnings=(*unused, *run.warnings))
    common.warn(run.warnings)
    track = estimate(run, assumed, filter_name)
    common.warn(track.warnings)
    judged = judge(track, run)
    used = settings_of(run, assumed)
    data: dict[str, Any] = result_data(run, filter_name, track, judged) | reviewed(run, track, used.radio)
    if tum_file is not None:
        _write_tum(tum_file, run, track)
    if out_dir is not None:
        from ccatp.beacons.report.slam_files import write_slam

        write_slam(out_dir, run, track, used)
        if run.tags:
            common.warn(["graph.pyfg is not written: the format has no places of several tags on the vehicle"])
    if figure_file is not None:
        from ccatp.beacons.report.plots import draw_slam

        draw_slam(run, track, judged, used.radio.camera_field_rad, figure_file, f"{run.name}, {filter_name}")
    if peers:
        data["peers"] = compared(run, assumed, common.warn, partial(_progress, what="instants of GTSAM"))
    if json_output:
        click.echo(json.dumps(data, allow_nan=False))
        return
    common.print_lines((*table_lines(run, data), *review_lines(data)))
    if peers:
        rows = ([one[key] for key in COMPARED] for one in data["peers"])
        common.print_lines(("", markdown_table(COMPARED, rows).rstrip()))


def _known(map_file: Path | None, start: str | None) -> "Known":
    from ccatp.beacons.datasets.known_map import read_known_map
    from ccatp.beacons.estimation.recording import Known

    known_map = None if map_file is None else read_known_map(map_file)
    if start is None:
        return Known(known_map)
    x_m, y_m, heading_rad = coordinates(f"--start {start}", start, "X,Y,HEADING", "m, m, rad")
    return Known(known_map, (x_m, y_m, heading_rad))


def _write_tum(file: Path, run: "RecordedRun", track: "EstimatedPath") -> None:
    import numpy as np

    from ccatp.beacons.estimation.track_review import tum_lines

    antenna_m, paths = run.antenna_m, {file: (track.times_s, track.poses)}
    if (truth := run.truth) is not None:
        truth_file = file.with_stem(f"{file.stem}_truth")
        headings = np.nan_to_num(truth.heading_rad)
        paths[truth_file] = truth.times_s, np.column_stack([truth.x_m, truth.y_m, headings])
        if not np.isfinite(truth.heading_rad).all():
            whose = f", and {file.name} and it are of the antenna" if any(antenna_m) else ""
            common.warn([f"{truth_file.name}: the truth has no headings: they are written as 0{whose}"])
            antenna_m = (0.0, 0.0)
    for one, (times_s, poses) in paths.items():
        one.write_text("\n".join(tum_lines(times_s, poses, antenna_m)) + "\n", encoding="utf-8")


_flag = partial(common.key_option, is_flag=True, flag_value=True, default=None)


@common.command(
    "ccatp radio map --config cricket --seeds 20",
    "ccatp radio map --method ekf --set cricket.phase2.pairs=zigzag --figure map.png",
    "ccatp radio map --ranges ranges.csv --offset --out beacons.toml --json",
    "ccatp radio map --cricket N1=n1.log --cricket N2=n2.log --cricket N3=/dev/ttyUSB0",
    name="map",
)
@common.CONFIG_OPTION
@click.option(
    "--ranges", "ranges_file", type=common.PATH, help="Measured ranges (CSV or .xlsx) in place of simulated ones."
)
@click.option(
    "--cricket", "crickets", multiple=True, metavar="[NAME=]PATH",
    help="Serial line of a listening Cricket mote, recorded in a file or live from its device; one for each listener.",
)  # fmt: skip
@click.option(
    "--seconds", type=click.FloatRange(min=0.1, max=86_400.0), default=60.0, show_default=True, metavar="S",
    help="How long a device of --cricket is read.",
)  # fmt: skip
@click.option("--tags", "tags_file", type=common.PATH, help="Places of tags on their trolley (CSV or .xlsx).")
@click.option("--truth", "truth_file", type=common.PATH, help="True places (CSV or .xlsx) to compare with.")
@click.option(
    "--method", type=click.Choice(("ekf", "batch")), default="batch", show_default=True,
    help="ekf: a filter over the ranges; batch: all ranges at once.",
)  # fmt: skip
@click.option(
    "--seeds", type=click.IntRange(min=1), default=1, show_default=True, metavar="N", help="Number of simulated runs."
)
@common.key_option("--seed", "run.seed", type=click.IntRange(min=0), metavar="N", help="Seed of the first run.")
@_flag("--offset", "cricket.batch.estimates_offset", help="Estimate a common offset of the ranges.")
@_flag("--scale", "cricket.batch.estimates_scale", help="Estimate a common scale of the ranges.")
@common.key_option(
    "--dimension", "cricket.dimension", type=click.IntRange(2, 3), metavar="D",
    help="2 for motes in a plane, 3 for motes in space.",
)  # fmt: skip
@common.settings_option("A key of cricket, as in cricket.phase2.pairs=zigzag.")
@click.option("--out", "out_file", type=common.OutputFile(), help="Write a beacon file (TOML).")
@common.figure_option("Draw map and errors")
@common.JSON_OPTION
def radio_map(
    config_file: Path | None, ranges_file: Path | None, tags_file: Path | None, truth_file: Path | None,
    method: str, seeds: int, settings: Mapping[str, object], out_file: Path | None, figure_file: Path | None,
    json_output: bool, crickets: tuple[str, ...], seconds: float,
) -> None:  # fmt: skip
    """Map beacons from the ranges between them."""
    is_measured = ranges_file is not None or bool(crickets)
    if ranges_file is not None and crickets:
        raise click.UsageError("--cricket and --ranges are two sources of ranges; give one of them")
    if not is_measured and (tags_file is not None or truth_file is not None):
        raise click.UsageError(
            "--tags and --truth go with --ranges, --truth also with --cricket; not with a simulation"
        )
    if is_measured and seeds > 1:
        raise click.UsageError("--seeds is for simulated ranges; measured ones are mapped once")
    from ccatp.beacons.config.load import load_radio_config
    from ccatp.beacons.cricket.measured_map import report_lines

    system = {"system": "cricket"} if config_file is None else {}
    cfg = load_radio_config(config_file, {**system, **settings}, simulates=not is_measured)
    if not is_measured:
        data = _simulated(cfg.cricket, method, range(cfg.run.seed, cfg.run.seed + seeds), out_file, figure_file)
    else:
        ranges, warnings = _ranges(cfg.cricket, ranges_file, crickets, seconds)
        data = _measured(cfg.cricket, method, ranges, (tags_file, truth_file), out_file, figure_file)
        data["warnings"] = [*warnings, *data["warnings"]]
    common.warn(data["warnings"])
    common.print_result(data, report_lines(data), json_output)


def _simulated(
    cfg: "CricketConfig", method: str, seeds: range, out_file: Path | None, figure_file: Path | None
) -> dict[str, Any]:
    from ccatp.beacons.report.plots import draw_mote_map
    from ccatp.beacons.studies.mote_runs import campaign_data, pictured, run_campaign

    campaign = run_campaign(cfg, method, seeds, _progress(len(seeds)))
    if out_file is not None:
        run = campaign.runs[0]
        _write(out_file, run.whole or (run.names, run.positions_m, run.covariance_m2), cfg.layout)
    if figure_file is not None:
        draw_mote_map(*pictured(campaign, seeds[0]), figure_file)
    return campaign_data(campaign)


def _ranges(
    cfg: "CricketConfig", ranges_file: Path | None, crickets: tuple[str, ...], seconds: float
) -> tuple["MeasuredRanges", list[str]]:
    if ranges_file is not None:
        from ccatp.beacons.datasets.sheets import read_ranges

        return read_ranges(ranges_file, cfg.ranging.sigma_m), []
    from ccatp.beacons.datasets.cricket_logs import listen, ranges_of

    return ranges_of(cfg, [listen(source, seconds) for source in crickets])


def _measured(
    cfg: "CricketConfig", method: str, ranges: "MeasuredRanges", files: tuple[Path | None, Path | None],
    out_file: Path | None, figure_file: Path | None,
) -> dict[str, Any]:  # fmt: skip
    import numpy as np

    from ccatp.beacons.cricket.measured_map import map_measured
    from ccatp.beacons.datasets.sheets import read_places
    from ccatp.beacons.report.plots import MapPicture, draw_mote_map

    tags_m, truth_m = (None if file is None else read_places(file) for file in files)
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


def _progress(total: int, what: str = "runs") -> Callable[[int], None]:
    is_live = sys.stderr.isatty()

    def show(done: int) -> None:
        if total == 1:
            return
        if is_live:
            click.echo(f"\rccatp: {done} of {total} {what}", nl=done == total, err=True)
        elif 10 * done // total > 10 * (done - 1) // total:
            common.complain(f"{done} of {total} {what}", 0)

    return show


@click.group(cls=common.CommandGroup, epilog=common.example("ccatp radio slam recordings/Plaza2_.mat"))
def radio() -> None:
    """Robots among radio beacons: recorded runs, maps of motes, signal levels."""


for command in (slam, calibrate, fix, fuzzy, radio_map):
    radio.add_command(command)
