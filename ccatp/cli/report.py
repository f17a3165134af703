"""The commands for recorded runs: ``ccatp report``, ``compare``, ``plot``, ``align`` and ``replay``."""

import json
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from ccatp.cli import common
from ccatp.errors import ConfigError, ExitStatus, UsageError

if TYPE_CHECKING:
    from ccatp.cli.align_points import PointOptions
    from ccatp.config.models import Config
    from ccatp.core import Measured
    from ccatp.mirror.foreign_points import Frame
    from ccatp.mirror.mirror import Mirror
    from ccatp.mirror.mirror_alignment import SurveyResult
    from ccatp.records.run_reader import Recording
    from ccatp.studies.replay import ReplayEvaluation


_FILE = click.Path(path_type=Path, dir_okay=False)
_FOLDER = common.OutputFolder()
_FIGURES = click.option("--figures", type=_FOLDER, metavar="DIR", help="Also write the figures there: SVG, PNG, PDF.")
_JSON = common.json_option("The figures of it as JSON on standard output.")


@common.command("ccatp report runs/tonight", "ccatp report runs/tonight --figures figures --tables tables")
@click.argument("run_dir", type=common.PATH)
@click.option(
    "--out", type=common.OutputFile(), metavar="FILE", help="The page; report.html in the run directory if not given."
)
@_FIGURES
@click.option("--tables", type=_FOLDER, metavar="DIR", help="Also write fixes, panels and moves there: CSV and ECSV.")
@_JSON
def report(run_dir: Path, out: Path | None, figures: Path | None, tables: Path | None, json_output: bool) -> int:
    """Write the report of a run: one page that opens without a network.

    Panel alignment, quality of the measurement, use of the time, events. It takes runs that are
    finished, running, killed or resumed, and says what is missing.
    """
    with common.working(f"reading and drawing {run_dir}"):
        from ccatp.report.run_page import report_run

        data, warnings = report_run(run_dir, out, figures, tables)
    common.warn(warnings)
    click.echo(json.dumps(data) if json_output else data["report"])
    return 0


@common.command(
    "ccatp compare runs/before runs/after",
    "ccatp compare before.json after.json",
    "ccatp compare runs/a runs/b --json",
)
@click.argument("before", type=common.PATH)
@click.argument("after", type=common.PATH)
@click.option(
    "--out",
    type=common.OutputFile(),
    metavar="FILE",
    help="The page; compare.html in AFTER if not given, none if that is no run directory.",
)
@_FIGURES
@_JSON
def compare(before: Path, after: Path, out: Path | None, figures: Path | None, json_output: bool) -> int:
    """Compare two surveys: figures, configuration, time, errors, which panels have moved, and whether as planned.

    BEFORE and AFTER are run directories, or alignments: what ccatp align --json writes, for points of
    other instruments or with --with.
    """
    with common.working(f"reading and drawing {before} and {after}"):
        from ccatp.report.compare import COMPARISON, compare_data, compare_lines, compare_surveys

        path = out if out is not None or after.is_file() else after / COMPARISON
        pair = compare_surveys(before, after, path, figures)
    for _, found in pair.runs:
        common.warn(f"{found.record.name}: {warning}" for warning in found.record.warnings)
    data = {"report": path and str(path), **compare_data(pair)}
    common.print_result(data, [*compare_lines(pair), *([str(path)] if path else [])], json_output)
    return 0


@common.command("ccatp plot runs/20260101T000000Z-fyst-m1-s1 --out map.png")
@click.argument("run_dir", type=common.PATH)
@click.option(
    "--out",
    type=common.OutputFile(".png", ".pdf", ".svg"),
    help="The picture; map.png in the run directory if not given.",
)
def plot(run_dir: Path, out: Path | None) -> int:
    """Draw the map of a run: panels, path, and each point coloured by its arrival error."""
    picture = out or run_dir / "map.png"
    with common.working(f"reading and drawing {run_dir}"):
        from ccatp.report.mirror_map import draw_from_run_dir

        warnings = draw_from_run_dir(run_dir, picture)
    common.warn(warnings)
    click.echo(picture)
    return 0


# Keys with an effect on the alignment, and on a replay. All others had their effect during the run.
ALIGN_KEYS = ("align.", "robot.puck_height_m", "mirror.")
# Keys of the laser by which its lengths are weighted.
ETALON_KEYS = ("length_sigma_m", "length_sigma_per_m", "collimator_sigma_m", "offset_sigma_m", "refraction_sigma")
REPLAY_KEYS = ("localizer.", "robot.", "mirror.", "run.filter")
PROGRESS_S = 50.0


class ReplayError(UsageError):
    """A run that cannot be replayed."""


class Files(NamedTuple):
    """Files that ``ccatp align`` writes."""

    csv: Path | None
    work: Path | None
    figure: Path | None


def _check_effect(settings: Mapping[str, object], keys: tuple[str, ...], what: str) -> None:
    if idle := [key for key in settings if not key.startswith(keys)]:
        raise ConfigError(f"command line: {idle[0]}: has no effect on {what}; what has: {', '.join(keys)}")


@common.command(
    "ccatp align runs/tonight",
    "ccatp align runs/tonight --csv moves.csv --figure panels.png",
    "ccatp align runs/tonight --with runs/evening",
    "ccatp align --points tracker.csv --mirror fyst-m1 --offset-mm 19.05 --sigma-um 15",
    "ccatp align --points tracker.csv --mirror fyst-m1 --sigma-um 15 --work-list work.csv --json > before.json",
    "ccatp align runs/tonight --json --set align.point_floor_m=2e-6",
)
@click.argument("run_dir", type=common.PATH, required=False)
@click.option(
    "--points",
    type=_FILE,
    metavar="FILE",
    help="Points of another instrument instead of fixes: label, x, y, z, sx, sy, sz.",
)
@click.option(
    "--frame",
    type=click.Choice(["world", "mirror", "telescope", "own"]),
    default="world",
    help="Frame of --points; own: fitted to --references. Default: world.",
)
@click.option(
    "--references", type=_FILE, metavar="FILE", help="World coordinates of labels in --points, for --frame own."
)
@click.option(
    "--unit", type=click.Choice(["mm", "m", "um"]), help="Of --points, if its header does not say; mm otherwise."
)
@click.option(
    "--offset-mm",
    type=common.FiniteNumber(),
    default=0.0,
    help="Centre of the target over the surface, along the normal.",
)
@click.option(
    "--sigma-um", type=click.FloatRange(min=0.0, min_open=True), help="Of each coordinate, instead of the file's."
)
@common.key_option("--mirror", "run.mirror", metavar="NAME", help="Of --points without a run directory.")
@click.option(
    "--with",
    "earlier",
    type=common.PATH,
    multiple=True,
    metavar="RUN_DIR",
    help="An earlier survey of the same night, several in the order of measuring: the laser network is adjusted to the "
    "lengths of all.",
)
@common.settings_option("A key of align or mirror, or robot.puck_height_m, as in align.point_floor_m=2e-6.")
@click.option("--csv", "csv_file", type=common.OutputFile(), help="Write a line a panel (CSV).")
@click.option("--work-list", type=common.OutputFile(), help="Write the moves as steps of work, a line each (CSV).")
@common.figure_option("Draw deviations and moves")
@common.JSON_OPTION
def align(
    run_dir: Path | None,
    points: Path | None,
    frame: "Frame",
    references: Path | None,
    unit: str | None,
    offset_mm: float,
    sigma_um: float | None,
    earlier: tuple[Path, ...],
    settings: Mapping[str, object],
    csv_file: Path | None,
    work_list: Path | None,
    figure_file: Path | None,
    json_output: bool,
) -> int:
    """Show the alignment of the panels and the moves of their adjusters, from the fixes of a run.

    The laser network is adjusted to all lengths of the run first, and the panels are computed
    with it. With --points the points come from a file, and from no run.
    """
    if points is not None:
        from ccatp.cli.align_points import PointOptions

        options = PointOptions(points, references, frame, unit, 1e-3 * offset_mm, sigma_um and 1e-6 * sigma_um)
        return _align_points(run_dir, settings, options, Files(csv_file, work_list, figure_file), json_output)
    if run_dir is None:
        raise UsageError("name the directory of a run, or --points FILE")
    from ccatp.mirror.mirror import build_mirror
    from ccatp.mirror.mirror_alignment import align_survey, compare
    from ccatp.records.run_reader import read_run
    from ccatp.report.alignment import config_data, result_data, table_lines, undetermined_warnings
    from ccatp.report.network import network_data, network_lines, remarks

    _check_effect(settings, ALIGN_KEYS, "the alignment")
    survey = read_run(run_dir, settings)
    cfg = survey.cfg
    mirror = build_mirror(cfg.mirror)
    planned = {point.panel for point in survey.planned}
    before = [_measured_with(one, cfg, settings) for one in earlier]
    _check_order([*earlier, run_dir])
    _check_copies([*earlier, run_dir], [*before, survey.measured])
    result, network = align_survey(cfg, mirror, survey.measured, planned, before)
    comparison = None if survey.injected is None else compare(result.panels, survey.injected)
    outliers = sum(len(panel.outliers) for panel in result.panels)
    facts = {
        "run_dir": str(run_dir),
        "mirror": cfg.mirror.name,
        "world": cfg.world.name if survey.is_simulation else None,
        "seed": cfg.run.seed,
        "points": {"total": len(survey.planned), "measured": len(survey.measured), "outliers": outliers},
        **_adjuster_facts(mirror, result),
        "puck_height_sigma_um": round(cfg.align.puck_height_sigma_m * 1e6, 4),
    }
    warnings = [*survey.warnings, *remarks(network), *result.warnings, *undetermined_warnings(result)]
    warnings += _write_files(cfg, mirror, result, Files(csv_file, work_list, figure_file), str(run_dir))
    common.warn(warnings)
    lines = [*table_lines(facts, result, comparison, cfg.align.puck_height_sigma_m), *network_lines(network)]
    data = {**facts, **result_data(result, comparison), "network": network_data(network), "warnings": warnings}
    data["config"] = config_data(cfg)
    common.print_result(data, lines, json_output)
    return 0


def _align_points(
    run_dir: Path | None,
    settings: Mapping[str, object],
    options: "PointOptions",
    files: Files,
    json_output: bool,
) -> int:
    from ccatp.cli.align_points import align_points
    from ccatp.report.alignment import config_data, result_data, table_lines, undetermined_warnings

    _check_effect(settings, (*ALIGN_KEYS, "run.mirror"), "the alignment of points")
    found = align_points(run_dir, settings, options)
    measured = len(found.assigned.labels)
    facts = {
        "run_dir": str(options.points),
        "points_file": str(options.points),
        "mirror": found.mirror.name,
        "world": None,
        "seed": 0,
        "points": {
            "total": measured,
            "measured": measured,
            "outliers": sum(len(panel.outliers) for panel in found.result.panels),
        },
        **_adjuster_facts(found.mirror, found.result),
        "puck_height_sigma_um": 0.0,
    }
    warnings = [*found.lines[1:], *found.result.warnings, *undetermined_warnings(found.result)]
    warnings += _write_files(found.cfg, found.mirror, found.result, files, str(options.points))
    common.warn(warnings)
    lines = [*table_lines(facts, found.result, None, 0.0), *found.lines]
    data = {**facts, **result_data(found.result, None), "instrument": found.data, "warnings": warnings}
    data["config"] = config_data(found.cfg)
    common.print_result(data, lines, json_output)
    return 0


def _adjuster_facts(mirror: "Mirror", result: "SurveyResult") -> dict[str, Any]:
    """Names and places of the adjusters, and the axes of the places."""
    from ccatp.report.alignment import places_of

    places = places_of(mirror, [panel.panel for panel in result.panels])
    return {
        "adjusters": list(places.names) if places else [],
        "adjuster_places_mm": [list(place) for place in places.places_mm] if places else [],
        "adjuster_axes": places.axes if places else "",
    }


def _write_files(cfg: "Config", mirror: "Mirror", result: "SurveyResult", files: Files, name: str) -> tuple[str, ...]:
    """Write the files that are asked for; what the work list does not contain."""
    from ccatp.mirror.adjuster_work import work_list
    from ccatp.report.tables import csv_lines, panel_table, work_table

    warnings: tuple[str, ...] = ()
    if files.csv is not None:
        common.write_lines("--csv", files.csv, csv_lines(panel_table(mirror, result.panels)))
    if files.work is not None:
        steps, warnings = work_list(mirror, cfg.mirror.adjusters, result.panels)
        common.write_lines("--work-list", files.work, csv_lines(work_table(steps)))
    if files.figure is not None:
        from ccatp.report.mirror_map import draw_alignment

        draw_alignment(mirror, result, files.figure, f"{mirror.name}: {len(result.panels)} panels", name)
    return warnings


def _measured_with(run_dir: Path, cfg: "Config", settings: Mapping[str, object]) -> "Sequence[Measured]":
    """The fixes of another survey by the same collimators."""
    from ccatp.records.run_reader import read_run

    other = read_run(run_dir, settings)
    if other.cfg.mirror != cfg.mirror:
        raise UsageError(f"--with {run_dir}: its mirror is not that of the first run")
    for name in ETALON_KEYS:
        if getattr(other.cfg.etalon, name) != getattr(cfg.etalon, name):
            raise UsageError(f"--with {run_dir}: its etalon.{name} is not that of the first run")
    return other.measured


def _check_copies(run_dirs: Sequence[Path], surveys: "Sequence[Sequence[Measured]]") -> None:
    """Refuse a survey that is given twice, or a copy of another: the same lengths would count as independent ones."""
    for (first, some), (second, others) in combinations(zip(run_dirs, surveys, strict=True), 2):
        seen = {one.fix.lengths_m for one in some if one.fix.lengths_m}
        if number := sum(one.fix.lengths_m in seen for one in others):
            raise UsageError(
                f"--with: {first} and {second} have the same lengths at {number} points: they are one survey; "
                "give each survey once"
            )


def _check_order(run_dirs: Sequence[Path]) -> None:
    """Refuse surveys that were not measured in this order, as far as their recordings show it."""
    from ccatp.records.run_reader import begun_utc_ns

    begun = [(at_ns, run_dir) for run_dir in run_dirs if (at_ns := begun_utc_ns(run_dir)) is not None]
    for (before_ns, before), (after_ns, after) in pairwise(begun):
        if before_ns > after_ns:
            raise UsageError(
                f"--with: {before} was measured after {after}; name the latest survey first, before --with"
            )


@common.command(
    "ccatp replay runs/tonight",
    "ccatp replay runs/tonight --filter ukf --smooth",
    "ccatp replay runs/tonight --set localizer.full_state.fix_gate_nis=20 --out track.csv",
)
@click.argument("run_dir", type=common.PATH)
@common.key_option(
    "--filter", "run.filter", metavar="NAME", help="State estimator, if not that of the run: kf, ekf, ukf."
)
@common.settings_option("A key of localizer, robot or mirror, as in localizer.full_state.fix_gate_nis=20.")
@click.option("--smooth", is_flag=True, help="Go back over the run with the smoother, too (not with kf).")
@click.option("--out", type=common.OutputFile(), help="Write the estimates of all frames (CSV).")
@common.JSON_OPTION
def replay(run_dir: Path, settings: Mapping[str, object], smooth: bool, out: Path | None, json_output: bool) -> int:
    """Run an estimator again over the recorded samples of a run, as it was or with other settings."""
    from ccatp.records.run_reader import open_recordings
    from ccatp.studies.replay import csv_lines, has_smoother, judge, table_lines

    recordings = open_recordings(run_dir)
    configs = [recording.config(settings) for recording in recordings]
    _check_effect(settings, REPLAY_KEYS, "a replay")
    if smooth and not all(map(has_smoother, configs)):
        raise ConfigError(
            f"--smooth: the pose is no state of filter {configs[-1].run.filter}; choose --filter ekf or ukf"
        )
    started = time.monotonic()
    parts = [_replayed(recording, cfg, smooth) for recording, cfg in zip(recordings, configs, strict=True)]
    result = {
        "run_dir": str(run_dir),
        **_replay_facts(configs[-1], parts, settings, is_simulation=recordings[-1].is_simulation),
        **judge(parts),
        "warnings": [warning for recording in recordings for warning in (*recording.notes, *recording.warnings)],
        "wall": {"time_s": round(time.monotonic() - started, 3)},
    }
    common.warn(result["warnings"])
    if out is not None:
        common.write_lines("--out", out, csv_lines(parts))
    is_as_it_was = result["difference"]["reproduced"]
    may_differ = bool(settings or any(recording.warnings for recording in recordings))
    lines = [*_head(result), *table_lines(result)]
    if is_as_it_was or may_differ:
        lines.append(f"the replay {'reproduces' if is_as_it_was else 'differs from'} the recorded estimates")
    common.print_result(result, lines, json_output)
    if is_as_it_was or may_differ:
        return ExitStatus.COMPLETE
    why = "was the run made by another version, or on another CPU?"
    return common.complain(
        f"{run_dir}: the replay does not reproduce the recorded estimates: {why}", ExitStatus.REFUSED
    )


def _replayed(recording: "Recording", cfg: "Config", smooth: bool) -> "ReplayEvaluation":
    from ccatp.filters.base import FilterError
    from ccatp.mirror.mirror import build_mirror
    from ccatp.mirror.surface import MirrorError
    from ccatp.records.run_reader import in_order
    from ccatp.studies.replay import ReplayEvaluation
    from ccatp.studies.replay import replay as play

    shown_s = float("-inf")

    def show(t_s: float) -> None:
        nonlocal shown_s
        if t_s - shown_s >= PROGRESS_S:
            shown_s = t_s
            click.echo(f"\rreplayed {t_s:.0f} s \r", nl=False, err=True)

    mirror = build_mirror(cfg.mirror)
    on_frame = show if sys.stderr.isatty() else None
    try:
        replayed = play(cfg, mirror, in_order(recording.messages()), smooth=smooth, on_frame=on_frame)
    except (FilterError, MirrorError) as error:
        raise ReplayError(f"{recording.path}: the estimator gave up: {error}; try other settings") from error
    if not len(replayed.trace.seq):
        why = f" ({recording.warnings[-1]})" if recording.warnings else ""
        raise ReplayError(f"{recording.path}: no sensors frames in it{why}")
    return ReplayEvaluation(replayed, recording.recorded(mirror), recording.truth(), recording.arrivals, mirror)


def _replay_facts(
    cfg: "Config", parts: Sequence["ReplayEvaluation"], settings: Mapping[str, object], *, is_simulation: bool
) -> dict[str, Any]:
    outcomes = [part.replayed for part in parts]
    counts = Counter[str]()
    for outcome in outcomes:
        counts.update(outcome.counts)
    times_s = [outcome.trace.t_s for outcome in outcomes]
    first = next((outcome.first_difference for outcome in outcomes if outcome.first_difference), None)
    return {
        "mirror": cfg.mirror.name,
        "world": cfg.world.name if is_simulation else None,
        "seed": cfg.run.seed,
        "recordings": len(parts),
        "frames": sum(map(len, times_s)),
        "span_s": round(sum(float(t_s[-1] - t_s[0]) for t_s in times_s), 3),
        "filter": cfg.run.filter,
        "settings": dict(settings),
        "fixes": {
            "given": sum(outcome.fixes for outcome in outcomes),
            "refused": sum(outcome.refused for outcome in outcomes),
            "set_aside": sum(outcome.set_aside for outcome in outcomes),
            "first_difference": first and {"t_s": first[0], "said": first[1]},
        },
        "counts": dict(counts),
    }


def _head(result: Mapping[str, Any]) -> list[str]:
    where = "real robot" if result["world"] is None else f"simulation, world {result['world']}, seed {result['seed']}"
    fixes = result["fixes"]
    per_frame_us = 1e6 * result["wall"]["time_s"] / result["frames"]
    changes = ", ".join(f"{key}={value}" for key, value in result["settings"].items()) or "as recorded"
    lines = [
        f"{result['run_dir']}: {result['mirror']}, {where}",
        f"{result['frames']} frames, {result['span_s']:.1f} s; filter {result['filter']}, settings: {changes}",
        f"{fixes['given']} fixes, {fixes['set_aside']} of them set aside in the run, {fixes['refused']} refused here; "
        f"{per_frame_us:.0f} us a frame",
    ]
    if (first := fixes["first_difference"]) is not None:
        what = f"is refused here: {first['said']}" if first["said"] else "is taken here and was refused in the run"
        lines.append(f"the fix of {first['t_s']:.2f} s {what}")
    return [*lines, ""]
