"""Maps of a mirror (deck frame, x to the right): driven path with arrival errors, plan, surface of the panels."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from math import ceil, cos, sin
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PatchCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

from ccatp.core import FloatArray, PanelId, StopKind
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.mirror_alignment import SurveyResult
from ccatp.mirror.panel_alignment import PanelResult, on_grid_m
from ccatp.mirror.panel_modes import adjuster_places
from ccatp.report import plots
from ccatp.report.findings import Grade, PointVerdict, point_verdicts
from ccatp.report.plots import BAD, INK, PANEL, PAPER, PATH, PX_PER_IN, QUIET, SEAM, PictureError, add_legend, is_wide
from ccatp.report.record import WITHIN_MM, SurveyFiles, read_record

if TYPE_CHECKING:
    from ccatp.survey.survey_plan import SurveyPlan

MAP_WIDTH_PX, MAP_DPI = 1600, 160
ALIGN_WIDTH_PX, ALIGN_DPI = 2400, 200
_MARGIN_M = 0.22  # around the mirror, for the numbers of rows and columns
_MICRO = 1e6
_CELLS_WIDE, _CELLS_NARROW = 12, 6  # along each side of a panel
# One distant point must not give all others the same colour.
_USUAL_ERRORS_PERCENT, _USUAL_HEIGHTS_PERCENT = 98.0, 99.0
_ERROR_COLOURS, _TIME_COLOURS, _HEIGHT_COLOURS = (
    LinearSegmentedColormap.from_list(name, colours)
    for name, colours in (
        ("arrival error", plots.SMALL_TO_LARGE),
        ("time", plots.SMALL_TO_LARGE),
        ("deviation", plots.BELOW_TO_ABOVE),
    )
)


def new_mirror_map(mirror: Mirror, width_px: float, title: str, subtitle: str | None = None) -> Axes:
    """A map with the panels, their rows and columns, and the rim; both axes in metres, with the same scale.

    The title is written above the map if there is a subtitle, which may be empty.
    """
    low, high = mirror.rim.vertices.min(axis=0) - _MARGIN_M, mirror.rim.vertices.max(axis=0) + _MARGIN_M
    wide, width = is_wide(width_px), width_px / PX_PER_IN
    beside, below = (1.6, 0.9) if wide else (0.1, 1.3)
    map_height = (width - beside) * float((high[1] - low[1]) / (high[0] - low[0]))
    figure = plots.new_figure(width, map_height + below + (0.0 if subtitle is None else 0.6), PX_PER_IN)
    figure.set_label(title)
    axes = figure.subplots()
    panels = mirror.panels.values()
    tiles = [Rectangle((p.x_m - p.half_x_m, p.y_m - p.half_y_m), 2 * p.half_x_m, 2 * p.half_y_m) for p in panels]
    axes.add_collection(PatchCollection(tiles, facecolor=PANEL, edgecolor=SEAM, linewidth=0.7, zorder=1))
    axes.add_patch(Polygon(mirror.rim.vertices, closed=True, fill=False, edgecolor=INK, linewidth=1.3, zorder=2.5))
    small: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 7.5, "color": QUIET}
    for col, x in {p.id.col: p.x_m for p in panels}.items():
        axes.text(x, low[1] + 0.1, f"column {col}" if wide and col == 1 else f"{col}", **small)
    for row, y in {p.id.row: p.y_m for p in panels}.items():
        axes.text(low[0] + 0.1, y, f"row {row}" if wide and row == 1 else f"{row}", rotation=90, **small)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", autoscale_on=False, frame_on=False)
    if wide:
        axes.set_xlabel("x, m (deck frame)", fontsize=8.5, color=INK)
        axes.set_ylabel("y, m (deck frame)", fontsize=8.5, color=INK)
        axes.tick_params(labelsize=8, color=QUIET, labelcolor=INK)
    else:
        axes.set(xticks=[], yticks=[])
    if subtitle is not None:
        figure.suptitle(title, x=0.02, ha="left", fontsize=14, color=INK, parse_math=False)
        axes.set_title(subtitle, loc="left", fontsize=9, color=QUIET, parse_math=False)
    return axes


def _draw_base(axes: Axes, mirror: Mirror, width_px: float) -> None:
    """Draw the start pose of the robot."""
    base = mirror.base_pose
    ahead = {"dx": 0.18 * cos(base.heading_rad), "dy": 0.18 * sin(base.heading_rad)}
    shape = {"width": 0.035, "head_width": 0.11, "head_length": 0.09, "length_includes_head": True}
    axes.arrow(base.x_m, base.y_m, **ahead, **shape, color=INK, linewidth=0, zorder=6)
    size = 7 if is_wide(width_px) else 4
    axes.plot(base.x_m, base.y_m, "o", color=INK, markersize=size, zorder=6, linestyle="", label="base")


def _finished(axes: Axes, drawn: ScalarMappable, label: str, width_px: float, extend: str = "neither") -> Figure:
    """Add the legend and the colour bar, beside the map or (on a phone) below it."""
    place: dict[str, Any] = {"location": "bottom", "aspect": 30}
    if is_wide(width_px):
        place = {"location": "right", "shrink": 0.6, "aspect": 40}
    bar = axes.figure.colorbar(drawn, ax=axes, pad=0.01, extend=extend, **place)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8, color=QUIET, labelcolor=INK)
    bar.set_label(label, fontsize=8.5, color=INK)
    if bar.solids is not None:
        bar.solids.set_rasterized(True)
    return add_legend(axes)


# -- path and arrivals ------------------------------------------------------------------------------------------------


def run_map(
    mirror: Mirror, path_m: FloatArray, verdicts: Sequence[PointVerdict], width_px: float, title: str,
    subtitle: str | None = None, path_label: str = "driven path", *, is_first: bool = False,
) -> Figure:  # fmt: skip
    """The driven path (deck frame, shape (n, 2), parts separated by NaN), and each point coloured by its arrival error.

    The error is the distance at the measurement by the laser; with ``is_first`` the distance at the first arrival.
    """
    wide = is_wide(width_px)
    axes = new_mirror_map(mirror, width_px, title, subtitle)
    if len(path_m):
        axes.plot(*path_m.T, color=PATH, linewidth=0.9 if wide else 0.6, zorder=3, label=path_label)
    _draw_base(axes, mirror, width_px)
    measured = [one for one in verdicts if one.left_mm is not None]
    errors = np.array([one.shown_mm if is_first else one.left_mm for one in measured], dtype=np.float64)
    usual, largest = np.percentile(errors, (_USUAL_ERRORS_PERCENT, 100)) if len(errors) else (1.0, 1.0)
    top = min(WITHIN_MM, max(0.1, ceil(usual * 10) / 10))
    size = 34.0 if wide else 8.0
    looks: list[tuple[str, dict[str, Any]]] = [
        (Grade.FAIL, {"facecolors": PAPER, "edgecolors": BAD, "s": 2.4 * size, "label": f"beyond {WITHIN_MM:.0f} mm"}),
        (Grade.SKIPPED, {"marker": "x", "color": BAD, "s": 0.9 * size, "linewidths": 1.4, "label": "skipped"}),
        (Grade.OPEN, {"facecolors": PAPER, "edgecolors": QUIET, "s": 0.7 * size, "label": "not measured"}),
        ("measured", {"c": errors, "cmap": _ERROR_COLOURS, "vmin": 0.0, "vmax": top, "s": size, "edgecolors": PAPER,
                      "linewidths": 0.6 if wide else 0.3, "zorder": 5}),
    ]  # fmt: skip
    for grade, look in looks:
        some = measured if grade == "measured" else [one for one in verdicts if one.grade == grade]
        if some:
            dots = axes.scatter(*np.array([one.place_m for one in some]).T, **{"zorder": 4.5, **look})
            if wide and grade != Grade.FAIL:
                plots.add_tooltips(dots, [str(one) for one in some])
    scale = ScalarMappable(Normalize(0.0, top), _ERROR_COLOURS)
    label = "distance at first arrival, mm" if is_first else "arrival error, mm"
    return _finished(axes, scale, label, width_px, extend="max" if largest > top else "neither")


def path_figure(record: SurveyFiles, verdicts: Sequence[PointVerdict], width_px: float) -> Figure:
    """The map of a report: the path, and the distance of each first arrival."""
    label = "true path" if record.has_truth else "estimated path"
    title = f"{record.mirror.name}: path and arrival errors"
    path_m = driven_path_m(record)
    return run_map(record.mirror, path_m, verdicts, width_px, title, path_label=label, is_first=True)


def driven_path_m(record: SurveyFiles) -> FloatArray:
    """True path, or else estimated path; deck x, y in m, shape (k, 2), sessions separated by NaN."""
    pieces: list[FloatArray] = [np.empty((0, 2))]
    for session in record.sessions:
        driven = session.track if session.truth is None else session.truth
        pieces += [driven.pose[:, :2], np.full((1, 2), np.nan)]
    return np.concatenate(pieces)


def paths_figure(mirror: Mirror, records: Mapping[str, SurveyFiles], width_px: float) -> Figure:
    """The mirror with the paths of two runs; the later one is drawn over the earlier one."""
    axes = new_mirror_map(mirror, width_px, f"{mirror.name}: both paths")
    for (name, record), colour, width in zip(records.items(), plots.SERIES, (2.2, 0.8), strict=False):
        axes.plot(*driven_path_m(record).T, color=colour, linewidth=width, zorder=3, label=name)
    _draw_base(axes, mirror, width_px)
    return add_legend(axes)


def draw_from_run_dir(run_dir: Path, out: Path) -> tuple[str, ...]:
    """Draw the map of a run into a file, with the distances that the laser system measured.

    Returns what the recording lacks, and what a reader has to know about its times, one line each.

    Raises PictureError: the run has no points, or the map cannot be drawn; otherwise as ``read_record``.
    """
    record = read_record(run_dir)
    if record.points is None:
        reason = "; ".join(record.warnings) or "no mission.sqlite there, so no points to draw; was the run started?"
        raise PictureError(f"{run_dir}: {reason}")
    plots.save_figure(record_map(record, MAP_WIDTH_PX * PX_PER_IN / MAP_DPI), out, MAP_DPI)
    return record.warnings


def record_map(record: SurveyFiles, width_px: float) -> Figure:
    """The map of a run with its result in the title."""
    cfg, verdicts = record.cfg, point_verdicts(record)
    errors = [one.left_mm for one in verdicts if one.left_mm is not None]
    title = f"{record.mirror.name}: {len(errors)} of {len(verdicts)} points"
    # A run that was killed has no summary.
    time_s = (record.summary or {}).get("mission_time_s")
    if time_s is not None:
        title += f" in {int(time_s) // 60} min {int(time_s) % 60:02d} s"
    where = [f"simulation, world {cfg.world.name}"] if record.is_simulation else []
    figures = [f"arrival error: mean {np.mean(errors):.2f} mm, largest {max(errors):.2f} mm"] if errors else []
    subtitle = "  ·  ".join([*where, f"seed {cfg.run.seed}", f"filter {cfg.run.filter}", *figures])
    return run_map(record.mirror, driven_path_m(record), verdicts, width_px, title, subtitle)


def draw_plan(mirror: Mirror, plan: "SurveyPlan", out: Path) -> None:
    """Draw the route of a planned survey, coloured by the planned time. Raises PictureError: it cannot be drawn."""
    width_px = MAP_WIDTH_PX * PX_PER_IN / MAP_DPI
    title = f"{mirror.name}: {len(plan.points) - len(plan.out_of_reach)} of {len(plan.points)} points"
    axes = new_mirror_map(mirror, width_px, title, f"{plan.length_m:.0f} m, {plan.least_s / 60.0:.1f} min at least")
    base = mirror.base_pose
    route = [(base.x_m, base.y_m), *((stop.x_m, stop.y_m) for stop in plan.stops)]
    lines = LineCollection([np.array(leg) for leg in pairwise(route)], cmap=_TIME_COLOURS, linewidths=1.4, zorder=3)
    lines.set_array(np.array(plan.times_s) / 60.0)
    axes.add_collection(lines)
    _draw_base(axes, mirror, width_px)
    stops = {kind: [(s.x_m, s.y_m) for s in plan.stops if s.kind is kind] for kind in StopKind}
    out_of_reach = [mirror.point_on_deck(point) for point in plan.out_of_reach]
    looks: tuple[tuple[list[tuple[float, float]], dict[str, Any]], ...] = (
        (stops[StopKind.MEASURE], {"s": 14, "color": INK, "label": "measured"}),
        (
            stops[StopKind.VIA],
            {"s": 12, "marker": "s", "facecolors": PAPER, "edgecolors": QUIET, "label": "on the way"},
        ),
        (out_of_reach, {"s": 36, "marker": "x", "color": BAD, "label": "out of reach"}),
    )
    for places, look in looks:
        if places:
            axes.scatter(*zip(*places, strict=True), zorder=4, **look)
    plots.save_figure(_finished(axes, lines, "time, min", width_px), out, MAP_DPI)


# -- surface ----------------------------------------------------------------------------------------------------------


# Edges of the cells of a panel along deck x and y (m), shape (c + 1,), and their values (m), shape (c, c).
PanelCells = tuple[FloatArray, FloatArray, FloatArray]


def surface_figure(
    mirror: Mirror, panels: Sequence[PanelResult], title: str, width_px: float,
    scaled_as: Sequence[PanelResult] | None = None, subtitle: str | None = None, *, with_moves: bool = False,
) -> Figure:  # fmt: skip
    """The fitted deviation of the surface, and the measured deviations as dots with the same colours.

    The colour range is that of the panels ``scaled_as``; ``with_moves`` writes the move of each vertical adjuster, um.
    """
    wide = is_wide(width_px)
    axes = new_mirror_map(mirror, width_px, title, subtitle)
    spanned = panels if scaled_as is None else scaled_as
    cells = [on_grid_m(mirror, panel, _CELLS_WIDE if wide else _CELLS_NARROW) for panel in panels]
    drawn = _draw_cells(axes, cells, [panel.deviations.values_m[panel.is_kept] for panel in spanned])
    size = 20.0 if wide else 4.0
    rows = [np.column_stack([p.deviations.deck_m, p.deviations.values_m * _MICRO, p.is_kept]) for p in panels]
    points = np.concatenate(rows or [np.empty((0, 4))])
    kept, outliers = points[points[:, 3] > 0.0], points[points[:, 3] == 0.0]
    look: dict[str, Any] = {"cmap": drawn.cmap, "norm": drawn.norm, "edgecolors": QUIET, "linewidths": 0.3}
    if len(kept):
        axes.scatter(kept[:, 0], kept[:, 1], s=size, c=kept[:, 2], zorder=5, label="measured point", **look)
    if len(outliers):
        look = {"linewidths": 1.4, "zorder": 6, "label": "outlier, not used"}
        axes.scatter(outliers[:, 0], outliers[:, 1], marker="x", color=BAD, s=1.5 * size, **look)
    small: dict[str, Any] = {"ha": "center", "va": "top", "fontsize": 5.5, "color": INK, "zorder": 6}
    for panel in panels if with_moves else ():
        names, adjusters = adjuster_places(mirror, panel.panel)
        for name, place, move in zip(names, adjusters.tolist(), panel.rigid.moves.values_m, strict=True):
            deck_x, deck_y, _ = mirror.panel(panel.panel).to_deck((*place, 0.0))
            axes.text(deck_x, deck_y - 0.025, f"{name} {_MICRO * move:+.0f}", **small)
    return _finished(axes, drawn, "deviation along the normal, µm (> 0 towards the robot)", width_px, extend="both")


def change_figure(
    mirror: Mirror,
    before: Sequence[PanelResult],
    after: Sequence[PanelResult],
    common: Mapping[PanelId, FloatArray],
    width_px: float,
) -> Figure:
    """The later survey minus the earlier one, without what panels have in ``common``: piston (m), tip, tilt (rad)."""
    axes = new_mirror_map(mirror, width_px, f"{mirror.name}: change of the surface")
    earlier = {panel.panel: panel for panel in before}
    cells = []
    for panel in after:
        if panel.panel in earlier:
            shifted = replace(panel, fit=panel.fit._replace(values=panel.fit.values - common[panel.panel]))
            x, y, later = on_grid_m(mirror, shifted, _CELLS_NARROW)
            cells.append((x, y, later - on_grid_m(mirror, earlier[panel.panel], _CELLS_NARROW)[2]))
    drawn = _draw_cells(axes, cells, [values_m.ravel() for _, _, values_m in cells])
    return _finished(axes, drawn, "change along the normal, µm (> 0 towards the robot)", width_px, extend="both")


def _draw_cells(axes: Axes, cells: Sequence[PanelCells], spanned_m: Sequence[FloatArray]) -> ScalarMappable:
    usual = float(np.percentile(np.abs(np.concatenate(spanned_m)), _USUAL_HEIGHTS_PERCENT)) * _MICRO if spanned_m else 1
    top = max(1.0, float(ceil(usual)))
    corners, values = [np.empty((0, 4, 2))], [np.empty(0)]
    for x, y, found in cells:
        (left, low), (right, high) = np.meshgrid(x[:-1], y[:-1]), np.meshgrid(x[1:], y[1:])
        around = ((left, low), (right, low), (right, high), (left, high))
        corners.append(np.stack([np.column_stack([a.ravel(), b.ravel()]) for a, b in around], axis=1))
        values.append(found.ravel() * _MICRO)
    drawn = PolyCollection(
        list(np.concatenate(corners)), array=np.concatenate(values), cmap=_HEIGHT_COLOURS, norm=Normalize(-top, top),
        edgecolors="none", antialiased=False, rasterized=True, zorder=2,
    )  # fmt: skip
    axes.add_collection(drawn)
    seams = [np.array([(x[0], y[0]), (x[-1], y[0]), (x[-1], y[-1]), (x[0], y[-1])]) for x, y, _ in cells]
    axes.add_collection(PolyCollection(seams, facecolors="none", edgecolors=QUIET, linewidths=0.6, zorder=3))
    return drawn


def draw_alignment(mirror: Mirror, result: SurveyResult, out: Path, title: str, subtitle: str = "") -> None:
    """Draw ``surface_figure`` with the adjuster moves into a file. Raises PictureError: it cannot be drawn."""
    if result.wavefront is not None:
        before, after = result.wavefront.before_m * _MICRO, result.wavefront.after_m * _MICRO
        title += f", half-wavefront error {before:.1f} um rms, {after:.1f} after the moves"
    moves = "numbers: moves of the vertical adjusters, µm, > 0 towards the robot"
    note = "  ·  ".join(filter(None, (subtitle, moves)))
    width_px = ALIGN_WIDTH_PX * PX_PER_IN / ALIGN_DPI
    figure = surface_figure(mirror, result.panels, title, width_px, subtitle=note, with_moves=True)
    plots.save_figure(figure, out, ALIGN_DPI)
