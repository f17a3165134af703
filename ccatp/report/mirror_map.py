"""Maps of a mirror for reports and picture files: a driven path with arrival errors, a plan, the surface of the panels.

All are drawn on one ground (panels, rim, base), deck frame, x to the right.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, cos, sin
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ccatp.config.load import load_config
from ccatp.core import FloatArray, StopKind
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.mirror.mirror_alignment import SurveyResult
from ccatp.mirror.panel_alignment import PanelResult, adjuster_places, on_grid_m
from ccatp.records.recorder import iter_messages, read_metadata, recordings
from ccatp.records.store import MissionStore
from ccatp.records.store_rows import StoreError
from ccatp.report.findings import Grade, PointVerdict, arrival_error_m
from ccatp.report.plots import (
    BAD,
    BELOW_TO_ABOVE,
    INK,
    PANEL,
    PAPER,
    PATH,
    PX_PER_IN,
    QUIET,
    SEAM,
    SERIES,
    SMALL_TO_LARGE,
    PictureError,
    add_legend,
    add_tooltips,
    is_wide,
    new_figure,
    save_figure,
    thinned,
)
from ccatp.report.record import WITHIN_MM, RunRecord
from ccatp.survey.composition import SurveyPlan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

MAP_WIDTH_PX, MAP_DPI = 1600, 160
ALIGN_WIDTH_PX, ALIGN_DPI = 2400, 200
_MARGIN_M = 0.22  # around the mirror, for the numbers of rows and columns
_TOLERANCE_PX = 0.5
_MICRO = 1e6
_CELLS_WIDE, _CELLS_NARROW = 12, 6  # along each side of a panel
# A single far point must not make all others look alike.
_USUAL_ERRORS_PERCENT, _USUAL_HEIGHTS_PERCENT = 98.0, 99.0


@dataclass(slots=True)
class MirrorMap:
    """Panels, their rows and columns, and the rim; both axes in metres, to the same scale."""

    figure: "Figure"
    axes: "Axes"
    width_px: float
    pixel_m: float

    @property
    def is_wide(self) -> bool:
        """For a screen or paper, not for a phone."""
        return is_wide(self.width_px)

    def draw_path(self, path_m: FloatArray, label: str, colour: str = PATH, width: float = 0.9) -> None:
        """A path of shape (k, 2), parted by rows of NaN."""
        if len(path_m):
            points = thinned(path_m, _TOLERANCE_PX * self.pixel_m)
            self.axes.plot(*points.T, color=colour, linewidth=width, zorder=3, label=label)

    def draw_base(self, mirror: Mirror) -> None:
        """Where the robot starts, and its heading."""
        base = mirror.base_pose
        ahead = {"dx": 0.18 * cos(base.heading_rad), "dy": 0.18 * sin(base.heading_rad)}
        shape = {"width": 0.035, "head_width": 0.11, "head_length": 0.09, "length_includes_head": True}
        self.axes.arrow(base.x_m, base.y_m, **ahead, **shape, color=INK, linewidth=0, zorder=6)
        size = 7 if self.is_wide else 4
        self.axes.plot(base.x_m, base.y_m, "o", color=INK, markersize=size, zorder=6, linestyle="", label="base")

    def finish(self, drawn: "ScalarMappable | None" = None, label: str = "", **bar_look: Any) -> "Figure":
        """Add the legend and, beside the map or on a phone below it, what the colours of ``drawn`` mean."""
        place, height = self.axes.get_position(), self.figure.get_figheight()
        below = place.y0 - (0.56 if self.is_wide else 0.22) / height
        if drawn is not None:
            if self.is_wide:
                box = (place.x1 + 0.006, place.y0 + 0.2 * place.height, 0.013, 0.6 * place.height)
            else:
                box = (0.08, below - 0.12 / height, 0.84, 0.12 / height)
                below -= 0.55 / height
            bar_axes = self.figure.add_axes(box)
            orientation = "vertical" if self.is_wide else "horizontal"
            bar = self.figure.colorbar(drawn, cax=bar_axes, orientation=orientation, **bar_look)
            bar.outline.set_visible(False)
            bar.ax.tick_params(labelsize=8, color=QUIET, labelcolor=INK)
            bar.set_label(label, fontsize=8.5, color=INK)
            if bar.solids is not None:
                bar.solids.set_rasterized(True)
        add_legend(self.axes, (0.02 if not self.is_wide else place.x0 - 0.01, below))
        return self.figure


def new_mirror_map(mirror: Mirror, width_px: float, title: str, subtitle: str | None = None) -> MirrorMap:
    """The ground of a map.

    Args:
        width_px: of the figure; its height follows.
        title: what it shows; written above the map if there is a subtitle, which may be empty.
    """
    low, high = mirror.rim.vertices.min(axis=0) - _MARGIN_M, mirror.rim.vertices.max(axis=0) + _MARGIN_M
    wide = is_wide(width_px)
    left, beside, below = (0.6, 1.5, 0.9) if wide else (0.06, 0.12, 1.35)
    above = 0.08 if subtitle is None else 0.65
    width = width_px / PX_PER_IN
    map_width = width - beside
    map_height = map_width * float((high[1] - low[1]) / (high[0] - low[0]))
    height = map_height + below + above
    figure = new_figure(width, height, PX_PER_IN, layout=None)
    figure.set_label(title)
    axes = figure.add_axes((left / width, below / height, map_width / width, map_height / height))
    _draw_panels(axes, mirror, wide)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", autoscale_on=False)
    if wide:
        axes.set_xlabel("x, m (deck frame)", fontsize=8.5, color=INK)
        axes.set_ylabel("y, m (deck frame)", fontsize=8.5, color=INK)
        axes.tick_params(labelsize=8, color=QUIET, labelcolor=INK)
    else:
        axes.set(xticks=[], yticks=[])
    for side in axes.spines.values():
        side.set_visible(False)
    if subtitle is not None:
        figure.text(left / width, 1.0 - 0.32 / height, title, fontsize=14, color=INK, parse_math=False)
        figure.text(left / width, 1.0 - 0.56 / height, subtitle, fontsize=9, color=QUIET, parse_math=False)
    return MirrorMap(figure, axes, width_px, float(high[0] - low[0]) / (map_width * PX_PER_IN))


def _draw_panels(axes: "Axes", mirror: Mirror, wide: bool) -> None:
    from matplotlib.collections import PatchCollection  # noqa: PLC0415 - takes a second
    from matplotlib.patches import Polygon, Rectangle  # noqa: PLC0415

    panels = mirror.panels.values()
    tiles = [Rectangle((p.x_m - p.half_x_m, p.y_m - p.half_y_m), 2 * p.half_x_m, 2 * p.half_y_m) for p in panels]
    axes.add_collection(PatchCollection(tiles, facecolor=PANEL, edgecolor=SEAM, linewidth=0.7, zorder=1))
    axes.add_patch(Polygon(mirror.rim.vertices, closed=True, fill=False, edgecolor=INK, linewidth=1.3, zorder=2.5))
    small: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 7.5, "color": QUIET}
    low_x, low_y = mirror.rim.vertices.min(axis=0)
    for col, x in {p.id.col: p.x_m for p in panels}.items():
        axes.text(x, low_y - 0.12, f"column {col}" if wide and col == 1 else f"{col}", **small)
    for row, y in {p.id.row: p.y_m for p in panels}.items():
        axes.text(low_x - 0.12, y, f"row {row}" if wide and row == 1 else f"{row}", rotation=90, **small)


# -- path and arrivals ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class MapPoint:
    """A measurement point on the map.

    Attributes:
        x_m, y_m: deck frame.
        error_mm: arrival error; None where the point was not measured.
        is_skipped: given up, not merely still to come.
        has_failed: measured too far from its place.
        title: what a browser shows over it.
    """

    x_m: float
    y_m: float
    error_mm: float | None = None
    is_skipped: bool = False
    has_failed: bool = False
    title: str = ""


def run_map(
    mirror: Mirror, path_m: FloatArray, points: Sequence[MapPoint], width_px: float, title: str,
    subtitle: str | None = None, path_label: str = "driven path", error_label: str = "arrival error, mm",
) -> "Figure":  # fmt: skip
    """The driven path, and each point coloured by its arrival error.

    Args:
        path_m: deck frame, shape (n, 2); rows of NaN part it.
    """
    frame = new_mirror_map(mirror, width_px, title, subtitle)
    frame.draw_path(path_m, path_label, width=0.9 if frame.is_wide else 0.6)
    frame.draw_base(mirror)
    from matplotlib.colors import LinearSegmentedColormap  # noqa: PLC0415

    measured = [point for point in points if point.error_mm is not None]
    errors = np.array([point.error_mm for point in measured], dtype=np.float64)
    usual, largest = np.percentile(errors, (_USUAL_ERRORS_PERCENT, 100)) if len(errors) else (1.0, 1.0)
    top = min(WITHIN_MM, max(0.1, ceil(usual * 10) / 10))
    size = 34.0 if frame.is_wide else 8.0
    edge: dict[str, Any] = {"edgecolors": PAPER, "linewidths": 0.6 if frame.is_wide else 0.3}
    failed = [point for point in measured if point.has_failed]
    skipped = [point for point in points if point.is_skipped and point.error_mm is None]
    to_come = [point for point in points if not point.is_skipped and point.error_mm is None]
    for some, look in (
        (failed, {"facecolors": PAPER, "edgecolors": BAD, "s": 2.4 * size, "label": f"beyond {WITHIN_MM:.0f} mm"}),
        (skipped, {"marker": "x", "color": BAD, "s": 0.9 * size, "linewidths": 1.4, "label": "skipped"}),
        (to_come, {"facecolors": PAPER, "edgecolors": QUIET, "s": 0.7 * size, "label": "not measured"}),
    ):
        if some:
            marks = frame.axes.scatter(*_places(some), zorder=4.5, **look)  # type: ignore[arg-type]
            if some is not failed:
                _add_titles(frame, marks, some)
    colours = LinearSegmentedColormap.from_list("arrival error", SMALL_TO_LARGE)
    dots = frame.axes.scatter(
        *_places(measured), c=errors, cmap=colours, vmin=0.0, vmax=top, s=size, zorder=5, **edge
    )  # fmt: skip
    _add_titles(frame, dots, measured)
    return frame.finish(dots, error_label, extend="max" if largest > top else "neither")


def _places(points: Sequence[MapPoint]) -> tuple[list[float], list[float]]:
    return [point.x_m for point in points], [point.y_m for point in points]


def _add_titles(frame: MirrorMap, marks: Any, points: Sequence[MapPoint]) -> None:
    if frame.is_wide and points and all(point.title for point in points):
        add_tooltips(marks, [point.title for point in points])


def path_figure(record: RunRecord, verdicts: Sequence[PointVerdict], width_px: float) -> "Figure":
    """The map of a report: the path, and the distance of each first arrival."""
    points = [
        MapPoint(*v.place_m, _shown_mm(v), v.grade is Grade.SKIPPED, v.grade is Grade.FAIL, _title(v)) for v in verdicts
    ]
    label = "true path" if record.has_truth else "estimated path"
    title = f"{record.mirror.name}: path and arrival errors"
    path_m = driven_path_m(record)
    error_label = "distance at first arrival, mm"
    return run_map(record.mirror, path_m, points, width_px, title, path_label=label, error_label=error_label)


def _shown_mm(verdict: PointVerdict) -> float | None:
    if verdict.left_mm is None:
        return None
    return verdict.left_mm if verdict.first_mm is None else verdict.first_mm


def _title(verdict: PointVerdict) -> str:
    parts = [f"{'/'.join(map(str, verdict.point))}: {verdict.grade}"]
    if verdict.first_mm is not None:
        parts.append(f"first {verdict.first_mm:.2f} mm")
    if verdict.left_mm is not None:
        parts.append(f"measured at {verdict.left_mm:.2f} mm")
    return ", ".join(parts)


def driven_path_m(record: RunRecord) -> FloatArray:
    """True path where there is one, else the estimated, deck x, y; shape (k, 2), sessions set apart by NaN."""
    pieces: list[FloatArray] = []
    for session in record.sessions:
        source = session.track.place_m if session.truth is None else session.truth.place_m
        pieces += [source[:, :2], np.full((1, 2), np.nan)]
    return np.concatenate(pieces) if pieces else np.empty((0, 2))


def paths_figure(mirror: Mirror, records: Mapping[str, RunRecord], width_px: float) -> "Figure":
    """The mirror with the paths of two runs, the later one above the earlier one."""
    frame = new_mirror_map(mirror, width_px, f"{mirror.name}: both paths")
    for (name, record), colour, thick in zip(records.items(), SERIES, (2.2, 0.8), strict=False):
        frame.draw_path(driven_path_m(record), name, colour, thick)
    frame.draw_base(mirror)
    return frame.finish()


def draw_run_map(
    mirror: Mirror, path_m: FloatArray, points: Sequence[MapPoint], out: Path, title: str, subtitle: str = ""
) -> None:
    """Draw ``run_map`` into a file, whose suffix tells the format (PNG, PDF, SVG).

    Raises:
        PictureError: the file cannot be written.
    """
    save_figure(run_map(mirror, path_m, points, MAP_WIDTH_PX * PX_PER_IN / MAP_DPI, title, subtitle), out, MAP_DPI)


def draw_from_run_dir(run_dir: Path, out: Path) -> None:
    """Draw the map of a finished run from its run directory.

    The arrival error is the distance from the puck's foot, as the laser system measured it, to the measurement point.

    Raises:
        PictureError: the directory holds no run, or the map cannot be drawn.
        ConfigError: its configuration cannot be read.
    """
    if not (run_dir / "config.toml").is_file():
        raise PictureError(f"{run_dir}: no config.toml there; name the directory of a run")
    cfg = load_config(run_dir / "config.toml")
    mirror = build_mirror(cfg.mirror)
    parts = recordings(run_dir / "telemetry.mcap")
    is_simulation = any(read_metadata(part).get("simulation") == "true" for part in parts)
    points = _stored_points(run_dir / "mission.sqlite", mirror, cfg.robot.puck_height_m)
    errors = [p.error_mm for p in points if p.error_mm is not None]
    title = f"{mirror.name}: {len(errors)} of {len(points)} points"
    time_s = _mission_time_s(run_dir / "summary.json")
    if time_s is not None:
        title += f" in {int(time_s) // 60} min {int(time_s) % 60:02d} s"
    where = [f"simulation, world {cfg.world.name}"] if is_simulation else []
    figures = [f"arrival error: mean {np.mean(errors):.2f} mm, largest {max(errors):.2f} mm"] if errors else []
    subtitle = "  ·  ".join([*where, f"seed {cfg.run.seed}", f"filter {cfg.run.filter}", *figures])
    draw_run_map(mirror, _recorded_path(parts), points, out, title, subtitle)


def _stored_points(database: Path, mirror: Mirror, puck_height_m: float) -> list[MapPoint]:
    if not database.is_file():
        raise PictureError(f"{database.parent}: no {database.name} there, so no points to draw; was the run started?")
    try:
        with MissionStore.open(database, mirror=mirror.name) as store:
            rows, fixes = store.points(), {stored.point: stored.fix for stored in store.fixes()}
    except StoreError as error:
        raise PictureError(str(error)) from error
    points = []
    for row in rows:
        fix = fixes.get(row.point)
        error_mm = None if fix is None else 1e3 * arrival_error_m(mirror, row.point, fix.position_m, puck_height_m)
        points.append(MapPoint(*mirror.point_on_deck(row.point), error_mm, row.status == "skipped"))
    return points


def _recorded_path(parts: Iterable[Path]) -> FloatArray:
    """True path where there is one, else the estimated; shape (n, 2); the parts of a resumed run set apart by NaN."""
    pieces: list[FloatArray] = []
    for part in parts:
        rows: dict[str, list[list[float]]] = {"truth": [], "track": []}
        for message in iter_messages(part):
            if message.topic in rows:
                rows[message.topic] += [row[2:4] for row in json.loads(message.payload)["rows"]]
        pieces += [np.array(rows["truth"] or rows["track"]).reshape(-1, 2), np.full((1, 2), np.nan)]
    return np.concatenate(pieces) if pieces else np.empty((0, 2))


def _mission_time_s(path: Path) -> float | None:
    try:
        return float(json.loads(path.read_text(encoding="utf-8"))["mission_time_s"])
    except (OSError, ValueError, KeyError, TypeError):
        return None  # a run that was killed has no summary; its map is worth the more


# -- plan -------------------------------------------------------------------------------------------------------------


def plan_map(mirror: Mirror, plan: SurveyPlan, width_px: float) -> "Figure":
    """The route of a planned survey, coloured by the time at which the robot is there."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415
    from matplotlib.colors import LinearSegmentedColormap  # noqa: PLC0415

    title = f"{mirror.name}: {len(plan.points) - len(plan.out_of_reach)} of {len(plan.points)} points"
    frame = new_mirror_map(mirror, width_px, title, f"{plan.length_m:.0f} m, {plan.least_s / 60.0:.1f} min at least")
    base = mirror.base_pose
    route = [(base.x_m, base.y_m), *((stop.x_m, stop.y_m) for stop in plan.stops)]
    colours = LinearSegmentedColormap.from_list("time", SMALL_TO_LARGE)
    lines = LineCollection([np.array(leg) for leg in pairwise(route)], cmap=colours, linewidths=1.4, zorder=3)
    lines.set_array(np.array(plan.times_s) / 60.0)
    frame.axes.add_collection(lines)
    frame.draw_base(mirror)
    for places, look in (
        (
            [(stop.x_m, stop.y_m) for stop in plan.stops if stop.kind is StopKind.MEASURE],
            {"s": 14, "color": INK, "label": "measured"},
        ),
        (
            [(stop.x_m, stop.y_m) for stop in plan.stops if stop.kind is StopKind.VIA],
            {"s": 12, "marker": "s", "facecolors": PAPER, "edgecolors": QUIET, "label": "on the way"},
        ),
        (
            [mirror.point_on_deck(point) for point in plan.out_of_reach],
            {"s": 36, "marker": "x", "color": BAD, "label": "out of reach"},
        ),
    ):
        if places:
            frame.axes.scatter(*zip(*places, strict=True), zorder=4, **look)  # type: ignore[arg-type]
    return frame.finish(lines, "time, min")


def draw_plan(mirror: Mirror, plan: SurveyPlan, out: Path) -> None:
    """Draw ``plan_map`` into a file, whose suffix tells the format (PNG, PDF, SVG).

    Raises:
        PictureError: the file cannot be written.
    """
    save_figure(plan_map(mirror, plan, MAP_WIDTH_PX * PX_PER_IN / MAP_DPI), out, MAP_DPI)


# -- surface ----------------------------------------------------------------------------------------------------------


class PanelCells(NamedTuple):
    """Values in a grid of cells over a panel: edges along deck x and y, shape (c + 1,), values (m), shape (c, c)."""

    x_m: FloatArray
    y_m: FloatArray
    values_m: FloatArray


def surface_figure(
    mirror: Mirror, panels: Sequence[PanelResult], title: str, width_px: float,
    scaled_as: Sequence[PanelResult] | None = None, subtitle: str | None = None, *, with_moves: bool = False,
) -> "Figure":  # fmt: skip
    """The deviation of the surface as fitted; dots show what was measured in the same colours.

    A dot vanishes where the fit agrees with it; a cross is an outlier.

    Args:
        scaled_as: panels that the colours are to span; those shown if not given.
        with_moves: write the move of each vertical adjuster, um, beside it.
    """
    frame = new_mirror_map(mirror, width_px, title, subtitle)
    spanned = panels if scaled_as is None else scaled_as
    count = _CELLS_WIDE if frame.is_wide else _CELLS_NARROW
    cells = [PanelCells(*on_grid_m(mirror, panel, count)) for panel in panels]
    drawn = _draw_cells(frame, cells, [panel.deviations.values_m[panel.is_kept] for panel in spanned])
    size = 20.0 if frame.is_wide else 4.0
    kept = [np.column_stack([p.deviations.deck_m, p.deviations.values_m * _MICRO])[p.is_kept] for p in panels]
    if kept:
        x, y, heights = np.concatenate(kept).T
        colours: dict[str, Any] = {"c": heights, "cmap": drawn.cmap, "norm": drawn.norm}
        look: dict[str, Any] = {"s": size, "edgecolors": QUIET, "linewidths": 0.3, "zorder": 5}
        frame.axes.scatter(x, y, **colours, **look, label="measured point")
    outliers = [panel.deviations.deck_m[~panel.is_kept] for panel in panels if not panel.is_kept.all()]
    if outliers:
        x, y = np.concatenate(outliers).T
        frame.axes.scatter(
            x, y, marker="x", color=BAD, s=1.5 * size, linewidths=1.4, zorder=6, label="outlier, left out"
        )
    if with_moves:
        for panel in panels:
            _write_moves(frame.axes, mirror, panel)
    return frame.finish(drawn, "deviation along the normal, µm (> 0 towards the robot)", extend="both")


def change_figure(
    mirror: Mirror, before: Sequence[PanelResult], after: Sequence[PanelResult], width_px: float
) -> "Figure":
    """What the later survey shows less the earlier one."""
    frame = new_mirror_map(mirror, width_px, f"{mirror.name}: change of the surface")
    earlier = {panel.panel: panel for panel in before}
    cells = []
    for panel in after:
        if panel.panel in earlier:
            x, y, later = on_grid_m(mirror, panel, _CELLS_NARROW)
            cells.append(PanelCells(x, y, later - on_grid_m(mirror, earlier[panel.panel], _CELLS_NARROW)[2]))
    drawn = _draw_cells(frame, cells, [one.values_m.ravel() for one in cells])
    return frame.finish(drawn, "change along the normal, µm (> 0 towards the robot)", extend="both")


def _draw_cells(frame: MirrorMap, cells: Sequence[PanelCells], spanned_m: Sequence[FloatArray]) -> "ScalarMappable":
    from matplotlib.collections import PolyCollection  # noqa: PLC0415
    from matplotlib.colors import LinearSegmentedColormap, Normalize  # noqa: PLC0415

    usual = float(np.percentile(np.abs(np.concatenate(spanned_m)), _USUAL_HEIGHTS_PERCENT)) * _MICRO if spanned_m else 1
    top = max(1.0, float(ceil(usual)))
    corners, values = [np.empty((0, 4, 2))], [np.empty(0)]
    for x, y, found in cells:
        (left, low), (right, high) = np.meshgrid(x[:-1], y[:-1]), np.meshgrid(x[1:], y[1:])
        around = ((left, low), (right, low), (right, high), (left, high))
        corners.append(np.stack([np.column_stack([a.ravel(), b.ravel()]) for a, b in around], axis=1))
        values.append(found.ravel() * _MICRO)
    colours = LinearSegmentedColormap.from_list("deviation", BELOW_TO_ABOVE)
    drawn = PolyCollection(
        list(np.concatenate(corners)), array=np.concatenate(values), cmap=colours, norm=Normalize(-top, top),
        edgecolors="none", antialiased=False, rasterized=True, zorder=2,
    )  # fmt: skip
    frame.axes.add_collection(drawn)
    seams = [np.array([(x[0], y[0]), (x[-1], y[0]), (x[-1], y[-1]), (x[0], y[-1])]) for x, y, _ in cells]
    frame.axes.add_collection(PolyCollection(seams, facecolors="none", edgecolors=QUIET, linewidths=0.6, zorder=3))
    return drawn


def _write_moves(axes: "Axes", mirror: Mirror, panel: PanelResult) -> None:
    body = mirror.panel(panel.panel)
    small: dict[str, Any] = {"ha": "center", "va": "top", "fontsize": 5.5, "color": INK, "zorder": 6}
    names, adjusters = adjuster_places(mirror, panel.panel)
    for name, place, move in zip(names, adjusters.tolist(), panel.rigid.moves.values_m, strict=True):
        deck_x, deck_y, _ = body.to_deck((*place, 0.0))
        axes.text(deck_x, deck_y - 0.025, f"{name} {_MICRO * move:+.0f}", **small)


def draw_alignment(mirror: Mirror, result: SurveyResult, out: Path, title: str, subtitle: str = "") -> None:
    """Draw ``surface_figure`` with the adjuster moves into a file, whose suffix tells the format (PNG, PDF, SVG).

    Raises:
        PictureError: the file cannot be written.
    """
    if result.wavefront is not None:
        before, after = result.wavefront.before_m * _MICRO, result.wavefront.after_m * _MICRO
        title += f", half-wavefront error {before:.1f} um rms, {after:.1f} after the moves"
    moves = "numbers: moves of the vertical adjusters, µm, > 0 towards the robot"
    note = "  ·  ".join(filter(None, (subtitle, moves)))
    width_px = ALIGN_WIDTH_PX * PX_PER_IN / ALIGN_DPI
    figure = surface_figure(mirror, result.panels, title, width_px, subtitle=note, with_moves=True)
    save_figure(figure, out, ALIGN_DPI)
