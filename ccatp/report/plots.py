"""Figures by matplotlib: made without a window, dressed alike, saved, with one clear error where that cannot be.

Imports matplotlib, which takes a second, only when something is drawn.

Pictures as files: SVG by our own writer, PNG and PDF by matplotlib, shape by shape the same.

Imports matplotlib, which takes a second, only when something is drawn.

The mirror as the ground of a figure, deck frame: panels, rim, base, a colour bar beside it.

The map of a run as a picture: panels, rim, driven path, and each point coloured by its arrival error.

Imports matplotlib, which takes a second, only when something is drawn.

The way of a planned survey as a picture, coloured by the time at which the robot is there.

Imports matplotlib, which takes a second, only when something is drawn.

The alignment of a mirror as a picture: deviations in colour, and the moves of the adjusters in figures.

Imports matplotlib, which takes a second, only when something is drawn.
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, cos, sin
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ccatp.config.load import load_config
from ccatp.core import FloatArray, StopKind
from ccatp.errors import CcatpError, ExitStatus
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.mirror.mirror_alignment import SurveyResult
from ccatp.mirror.panel_alignment import PanelResult, adjuster_places, on_grid_m
from ccatp.records.recorder import iter_messages, read_metadata, recordings
from ccatp.records.store import MissionStore
from ccatp.records.store_rows import StoreError
from ccatp.report.drawing import (
    BAD,
    INK,
    PANEL,
    PATH,
    QUIET,
    SEAM,
    SMALL_TO_LARGE,
    Area,
    Boxes,
    Dots,
    Drawing,
    PolyLine,
    Shape,
    TextShape,
    svg_of,
)
from ccatp.report.findings import arrival_error_m
from ccatp.survey.composition import SurveyPlan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import Collection, LineCollection
    from matplotlib.colorbar import Colorbar
    from matplotlib.colors import Colormap, Normalize
    from matplotlib.figure import Figure


GRID = "#e3e8ed"


class PictureError(CcatpError):
    """A picture that cannot be drawn or written."""

    exit_status = ExitStatus.USAGE


def new_figure(
    width_in: float, height_in: float, dpi: float = 160.0, layout: Literal["constrained"] | None = "constrained"
) -> "Figure":
    """A figure that no window shows.

    Args:
        layout: how matplotlib places what is in it; None where every place is given.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - takes a second

    return Figure(figsize=(width_in, height_in), dpi=dpi, facecolor="white", layout=layout)


def dress(*panels: "Axes", grid: Literal["major", "both"] = "major") -> None:
    """Grid behind the data, quiet frames, small labels."""
    for axes in panels:
        axes.grid(True, which=grid, color=GRID, linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(which="both", labelsize=8, color=QUIET, labelcolor=INK)
        axes.title.set_fontsize(9)
        for label in (axes.xaxis.label, axes.yaxis.label):
            label.set_fontsize(9)
        for side in axes.spines.values():
            side.set_color(GRID)


def save_figure(figure: "Figure", path: Path, dpi: float | None = None) -> None:
    """Write a figure; the same figure gives the same bytes on every day.

    Args:
        path: its suffix tells the format (PNG, PDF, SVG).
        dpi: pixels an inch, if not the figure's own.

    Raises:
        PictureError: the file cannot be written, or no such format is known.
    """
    undated: dict[str, dict[str, Any]] = {
        ".png": {"Software": None},
        ".pdf": {"CreationDate": None},
        ".svg": {"Date": None},
    }
    try:
        figure.savefig(path, dpi=dpi or "figure", metadata=undated.get(path.suffix.lower()))
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise PictureError(f"{path}: cannot be written: {why}") from error


PICTURE_DPI = 96.0  # a CSS pixel is a 96th of an inch
_PNG_SCALE = 2.0
_POINTS = 72.0 / PICTURE_DPI
_ANCHORS = {"start": "left", "middle": "center", "end": "right"}


def write_svg(picture: Drawing, path: Path) -> None:
    """Write a picture as SVG.

    Raises:
        PictureError: the file cannot be written.
    """
    try:
        path.write_text(svg_of(picture, is_file=True) + "\n", encoding="utf-8")
    except OSError as error:
        raise PictureError(f"{path}: cannot be written: {error.strerror or error}") from error


def write_figures(picture: Drawing, stem: Path) -> list[Path]:
    """Write a picture as ``stem.png``, at twice its size, and as ``stem.pdf``; returns the files.

    Raises:
        PictureError: a file cannot be written.
    """
    figure = _figure(picture)
    paths = [stem.with_name(stem.name + suffix) for suffix in (".png", ".pdf")]
    for path in paths:
        save_figure(figure, path, PICTURE_DPI * _PNG_SCALE)
    return paths


def _figure(picture: Drawing) -> "Figure":
    figure = new_figure(picture.width / PICTURE_DPI, picture.height / PICTURE_DPI, PICTURE_DPI, layout=None)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, picture.width), ylim=(picture.height, 0.0))
    axes.axis("off")
    for order, shape in enumerate(picture.shapes):
        if isinstance(shape, TextShape):
            _add_text(axes, shape, order)
        elif isinstance(shape, PolyLine):
            _add_line(axes, shape, order)
        else:
            for collection in _collections(axes, shape):
                collection.set_zorder(order)
                axes.add_collection(collection, autolim=False)
    return figure


def _add_text(axes: "Axes", text: TextShape, order: int) -> None:
    axes.text(
        text.x,
        text.y,
        text.text.replace("$", r"\$"),
        fontsize=text.size * _POINTS,
        color=text.colour,
        ha=_ANCHORS[text.anchor],
        va="baseline",
        fontweight="semibold" if text.is_bold else "normal",
        rotation=text.turn_deg,
        rotation_mode="anchor",
        zorder=order,
    )


def _add_line(axes: "Axes", line: PolyLine, order: int) -> None:
    width = line.width * _POINTS
    # Matplotlib counts dashes in line widths.
    dash: Any = (0.0, [length / line.width for length in line.dash]) if line.dash else "solid"
    axes.plot(*line.points.T, color=line.colour, linewidth=width, linestyle=dash, alpha=line.opacity, zorder=order)


def _collections(axes: "Axes", shape: Shape) -> "Iterator[Collection]":
    from matplotlib.collections import CircleCollection, LineCollection, PolyCollection  # noqa: PLC0415 - see above

    if isinstance(shape, Area):
        edge = shape.colour if shape.width else "none"
        look: dict[str, Any] = {"facecolor": shape.fill or "none", "edgecolor": edge, "alpha": shape.opacity}
        yield PolyCollection([shape.points], linewidth=shape.width * _POINTS, **look)
    elif isinstance(shape, Boxes):
        x, y, w, h = shape.corners.T
        outlines = np.stack([np.column_stack(p) for p in ((x, y), (x + w, y), (x + w, y + h), (x, y + h))], axis=1)
        is_plain = shape.outline is None
        look = {"facecolor": shape.fill or "none", "edgecolor": shape.outline or "none", "antialiased": not is_plain}
        yield PolyCollection(list(outlines), linewidth=shape.width * _POINTS, **look)
    elif isinstance(shape, Dots) and shape.mark == "cross":
        r = shape.radius
        arms = [np.array([(x - r, y + s * r), (x + r, y - s * r)]) for x, y in shape.places for s in (1.0, -1.0)]
        yield LineCollection(arms, colors=shape.colour, linewidths=1.4 * _POINTS)
    elif isinstance(shape, Dots):
        is_disc = shape.mark == "disc"
        area = np.pi * (shape.radius * _POINTS) ** 2
        yield CircleCollection(
            [area],
            offsets=shape.places,
            offset_transform=axes.transData,
            facecolor=shape.colour if is_disc else "white",
            edgecolor=(shape.edge or "none") if is_disc else shape.colour,
            linewidth=(0.7 if is_disc else 1.4) * _POINTS,
        )


_MARGIN_M = 0.25  # around the mirror
_LEFT_IN, _BOTTOM_IN, _BESIDE_IN, _ABOVE_AND_BELOW_IN = 0.75, 0.85, 1.6, 1.6  # for labels, legend and colour bar


def new_deck_map(mirror: Mirror, width_px: float, dpi: float) -> "tuple[Figure, Axes]":
    """A figure with the panels, their columns and rows, and the rim; both axes in metres, to the same scale.

    Args:
        width_px: of the picture; its height follows.
    """
    low, high = mirror.rim.vertices.min(axis=0) - _MARGIN_M, mirror.rim.vertices.max(axis=0) + _MARGIN_M
    width = width_px / dpi
    map_width = width - _BESIDE_IN
    map_height = map_width * float((high[1] - low[1]) / (high[0] - low[0]))
    height = map_height + _ABOVE_AND_BELOW_IN
    figure = new_figure(width, height, dpi, layout=None)
    axes = figure.add_axes((_LEFT_IN / width, _BOTTOM_IN / height, map_width / width, map_height / height))
    _draw_panels(axes, mirror)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", autoscale_on=False)
    axes.set(xlabel="x, m (deck frame)", ylabel="y, m (deck frame)")
    axes.tick_params(labelsize=8, color=QUIET, labelcolor=INK)
    for side in axes.spines.values():
        side.set_visible(False)
    return figure, axes


def draw_base(axes: "Axes", mirror: Mirror) -> None:
    """Draw where the robot starts, and its heading."""
    base = mirror.base_pose
    ahead = {"dx": 0.18 * cos(base.heading_rad), "dy": 0.18 * sin(base.heading_rad)}
    shape = {"width": 0.035, "head_width": 0.11, "head_length": 0.09, "length_includes_head": True}
    axes.arrow(base.x_m, base.y_m, **ahead, **shape, color=INK, linewidth=0, zorder=6)
    axes.plot(base.x_m, base.y_m, "o", color=INK, markersize=9, zorder=6, linestyle="", label="base")


def write_title(axes: "Axes", title: str, subtitle: str) -> None:
    """Two lines above the map."""
    axes.text(0.0, 1.045, title, transform=axes.transAxes, fontsize=15, color=INK)
    axes.text(0.0, 1.018, subtitle, transform=axes.transAxes, fontsize=9, color=QUIET)


def add_colour_bar(axes: "Axes", drawn: "ScalarMappable", label: str, **look: Any) -> "Colorbar":
    """What the colours of ``drawn`` mean, to the right of the map; ``look`` goes to matplotlib."""
    figure, place = axes.figure, axes.get_position()
    bar_axes = figure.add_axes((place.x1 + 0.006, place.y0 + 0.2 * place.height, 0.013, 0.6 * place.height))
    bar = figure.colorbar(drawn, cax=bar_axes, **look)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8, color=QUIET, labelcolor=INK)
    bar.set_label(label, fontsize=9, color=INK)
    return bar


def _draw_panels(axes: "Axes", mirror: Mirror) -> None:
    from matplotlib.collections import PatchCollection  # noqa: PLC0415 - see above
    from matplotlib.patches import Polygon, Rectangle  # noqa: PLC0415

    tiles = [
        Rectangle((p.x_m - p.half_x_m, p.y_m - p.half_y_m), 2 * p.half_x_m, 2 * p.half_y_m)
        for p in mirror.panels.values()
    ]
    axes.add_collection(PatchCollection(tiles, facecolor=PANEL, edgecolor=SEAM, linewidth=0.7, zorder=1))
    axes.add_patch(Polygon(mirror.rim.vertices, closed=True, fill=False, edgecolor=INK, linewidth=1.5, zorder=2))
    small: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 7.5, "color": QUIET}
    (low_x, low_y) = mirror.rim.vertices.min(axis=0)
    for col, x in {p.id.col: p.x_m for p in mirror.panels.values()}.items():
        axes.text(x, low_y - 0.12, f"column {col}" if col == 1 else f"{col}", **small)
    for row, y in {p.id.row: p.y_m for p in mirror.panels.values()}.items():
        axes.text(low_x - 0.12, y, f"row {row}" if row == 1 else f"{row}", rotation=90, **small)


MAP_WIDTH_PX = 1600
MAP_DPI = 160
LIMIT_MM = 10.0  # arrivals beyond it miss the requirement; the colours end there at the latest
MAXPATH_POINTS = 40_000


@dataclass(frozen=True, slots=True)
class MapPoint:
    """A measurement point on the map.

    Attributes:
        x_m, y_m: deck frame.
        error_mm: arrival error; None where the point was not measured.
        is_skipped: given up, not merely still to come.
    """

    x_m: float
    y_m: float
    error_mm: float | None = None
    is_skipped: bool = False


def draw_run_map(
    mirror: Mirror, path_xy: FloatArray, points: Sequence[MapPoint], out: Path, title: str, subtitle: str = ""
) -> None:
    """Draw the map of a run into an image file.

    Args:
        path_xy: driven path, deck frame, shape (n, 2), m; rows of NaN part it.
        out: the file; its suffix tells the format (PNG, PDF, SVG).
        subtitle: second line: seed, world, errors.

    Raises:
        PictureError: the file cannot be written.
    """
    figure, axes = new_deck_map(mirror, MAP_WIDTH_PX, MAP_DPI)
    step = max(1, len(path_xy) // MAXPATH_POINTS)
    axes.plot(path_xy[::step, 0], path_xy[::step, 1], color=PATH, linewidth=0.9, zorder=3, label="driven path")
    draw_base(axes, mirror)
    _draw_points(axes, points)
    write_title(axes, title, subtitle)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.045), ncols=4, frameon=False, fontsize=8.5, labelcolor=INK)
    save_figure(figure, out)


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
    points = _points(run_dir / "mission.sqlite", mirror, cfg.robot.puck_height_m)
    errors = [p.error_mm for p in points if p.error_mm is not None]
    title = f"{mirror.name}: {len(errors)} of {len(points)} points"
    time_s = _mission_time_s(run_dir / "summary.json")
    if time_s is not None:
        title += f" in {int(time_s) // 60} min {int(time_s) % 60:02d} s"
    where = [f"simulation, world {cfg.world.name}"] if is_simulation else []
    figures = [f"arrival error: mean {np.mean(errors):.2f} mm, largest {max(errors):.2f} mm"] if errors else []
    subtitle = "  ·  ".join([*where, f"seed {cfg.run.seed}", f"filter {cfg.run.filter}", *figures])
    draw_run_map(mirror, _driven_path(parts), points, out, title, subtitle)


def _points(database: Path, mirror: Mirror, puck_height_m: float) -> list[MapPoint]:
    if not database.is_file():
        raise PictureError(
            f"{database.parent}: no {database.name} there, so no points to draw; was the run ever under way?"
        )
    try:
        with MissionStore.open(database, mirror=mirror.name) as store:
            rows, fixes = store.points(), {stored.point: stored.fix for stored in store.fixes()}
    except StoreError as error:
        raise PictureError(str(error)) from error
    points = []
    for row in rows:
        fix = fixes.get(row.point)
        error_mm = None if fix is None else 1e3 * arrival_error_m(mirror, row.point, fix, puck_height_m)
        points.append(MapPoint(*mirror.point_on_deck(row.point), error_mm, row.status == "skipped"))
    return points


def _driven_path(parts: Iterable[Path]) -> FloatArray:
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


def _draw_points(axes: "Axes", points: Sequence[MapPoint]) -> None:
    from matplotlib.colors import LinearSegmentedColormap  # noqa: PLC0415 - see above

    measured = [p for p in points if p.error_mm is not None]
    errors = np.array([p.error_mm for p in measured], dtype=np.float64)
    # A single far one must not make all others look alike.
    usual, largest = np.percentile(errors, (98, 100)) if len(errors) else (1.0, 1.0)
    top = min(LIMIT_MM, max(0.1, ceil(usual * 10) / 10))
    colours = LinearSegmentedColormap.from_list("arrival error", SMALL_TO_LARGE)
    dots = axes.scatter(
        [p.x_m for p in measured], [p.y_m for p in measured], c=errors, cmap=colours, vmin=0.0, vmax=top,
        s=40, edgecolors="white", linewidths=0.7, zorder=5,
    )  # fmt: skip
    skipped = [p for p in points if p.is_skipped and p.error_mm is None]
    to_come = [p for p in points if not p.is_skipped and p.error_mm is None]
    crosses: dict[str, Any] = {"marker": "x", "color": BAD, "s": 36, "linewidths": 1.6, "label": "skipped"}
    rings: dict[str, Any] = {"facecolors": "white", "edgecolors": QUIET, "s": 26, "label": "not measured"}
    for some, look in ((skipped, crosses), (to_come, rings)):
        if some:
            axes.scatter([p.x_m for p in some], [p.y_m for p in some], zorder=5, **look)
    add_colour_bar(axes, dots, "arrival error, mm", extend="max" if largest > top else "neither")


PLAN_WIDTH_PX = 1600
PLAN_DPI = 160


def draw_plan(mirror: Mirror, plan: SurveyPlan, out: Path) -> None:
    """Draw a plan into an image file.

    Args:
        out: the file; its suffix tells the format (PNG, PDF, SVG).

    Raises:
        PictureError: the file cannot be written.
    """
    figure, axes = new_deck_map(mirror, PLAN_WIDTH_PX, PLAN_DPI)
    draw_base(axes, mirror)
    add_colour_bar(axes, _draw_way(axes, mirror, plan), "time, min")
    _draw_stops(axes, mirror, plan)
    title = f"{mirror.name}: {len(plan.points) - len(plan.out_of_reach)} of {len(plan.points)} points, "
    axes.set_title(title + f"{plan.length_m:.0f} m, {plan.least_s / 60.0:.1f} min at least", color=INK)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=4, frameon=False, fontsize=8.5)
    save_figure(figure, out)


def _draw_way(axes: "Axes", mirror: Mirror, plan: SurveyPlan) -> "LineCollection":
    from matplotlib.collections import LineCollection  # noqa: PLC0415 - see above
    from matplotlib.colors import LinearSegmentedColormap  # noqa: PLC0415

    base = mirror.base_pose
    way = [(base.x_m, base.y_m), *((stop.x_m, stop.y_m) for stop in plan.stops)]
    colours = LinearSegmentedColormap.from_list("time", SMALL_TO_LARGE)
    lines = LineCollection([np.array(leg) for leg in pairwise(way)], cmap=colours, linewidths=1.4, zorder=3)
    lines.set_array(np.array(plan.times_s) / 60.0)
    axes.add_collection(lines)
    return lines


def _draw_stops(axes: "Axes", mirror: Mirror, plan: SurveyPlan) -> None:
    dots: dict[str, Any] = {"s": 14, "color": INK, "label": "measured"}
    squares: dict[str, Any] = {
        "s": 12, "marker": "s", "facecolors": "white", "edgecolors": QUIET, "label": "on the way",
    }  # fmt: skip
    crosses: dict[str, Any] = {"s": 36, "marker": "x", "color": BAD, "label": "out of reach"}
    measured = [(stop.x_m, stop.y_m) for stop in plan.stops if stop.kind is StopKind.MEASURE]
    passed = [(stop.x_m, stop.y_m) for stop in plan.stops if stop.kind is StopKind.VIA]
    lost = [mirror.point_on_deck(point) for point in plan.out_of_reach]
    for places, look in ((measured, dots), (passed, squares), (lost, crosses)):
        if places:
            axes.scatter([x for x, _ in places], [y for _, y in places], zorder=4, **look)


if TYPE_CHECKING:
    Colours = tuple[Colormap, Normalize]

ALIGN_WIDTH_PX = 2400
ALIGN_DPI = 200
_CELLS = 12  # along each side of a panel
_COLOURS = ("#5a8fc4", "#a9cbe3", "#f7f7f5", "#f3c08c", "#d5703f")  # below, ideal, above; figures stay legible on each
_MICRO = 1e6


def draw_alignment(mirror: Mirror, result: SurveyResult, out: Path, title: str, subtitle: str = "") -> None:
    """Draw the alignment into an image file.

    Each panel shows its fitted displacement, with its curvatures where they are significant; a dot shows what was
    measured at its place in the same colours, so that it vanishes where the fit agrees with it; a cross is an outlier.

    Args:
        out: the file; its suffix tells the format (PNG, PDF, SVG).

    Raises:
        PictureError: the file cannot be written.
    """
    figure, axes = new_deck_map(mirror, ALIGN_WIDTH_PX, ALIGN_DPI)
    colours = _colours(result)
    for panel in result.panels:
        _draw_panel(axes, mirror, panel, colours)
    _draw_bar(axes, colours)
    legend = "figures: moves of the vertical adjusters, um, > 0 towards the robot; dots: measured points"
    write_title(axes, title + _half_wavefront(result), "  ·  ".join(filter(None, (subtitle, legend))))
    save_figure(figure, out)


def _half_wavefront(result: SurveyResult) -> str:
    if result.wavefront is None:
        return ""
    before, after = result.wavefront.before_m * _MICRO, result.wavefront.after_m * _MICRO
    return f", half-wavefront error {before:.1f} um rms, {after:.1f} after the moves"


def _colours(result: SurveyResult) -> "Colours":
    from matplotlib.colors import LinearSegmentedColormap, Normalize  # noqa: PLC0415 - see above

    values = [np.abs(p.deviations.values_m[p.is_kept]) for p in result.panels]
    # A single far point must not make all others look alike.
    usual = float(np.percentile(np.concatenate(values), 99)) * _MICRO if values else 1.0
    top = max(1.0, float(ceil(usual)))
    return LinearSegmentedColormap.from_list("deviation", _COLOURS), Normalize(-top, top)


def _draw_panel(axes: "Axes", mirror: Mirror, panel: PanelResult, colours: "Colours") -> None:
    from matplotlib.patches import Rectangle  # noqa: PLC0415 - see above

    body, found, (cmap, norm) = mirror.panel(panel.panel), panel.deviations, colours
    x, y, values = on_grid_m(mirror, panel, _CELLS)
    axes.pcolormesh(x, y, values * _MICRO, cmap=cmap, norm=norm, zorder=2, rasterized=True)
    size = 2.0 * body.half_x_m, 2.0 * body.half_y_m
    axes.add_patch(Rectangle((x[0], y[0]), *size, fill=False, edgecolor=QUIET, linewidth=0.7, zorder=3))
    (dots_x, dots_y), heights = found.deck_m[panel.is_kept].T, found.values_m[panel.is_kept] * _MICRO
    axes.scatter(dots_x, dots_y, c=heights, cmap=cmap, norm=norm, s=22, edgecolors=QUIET, linewidths=0.3, zorder=5)
    crosses_x, crosses_y = found.deck_m[~panel.is_kept].T
    axes.scatter(crosses_x, crosses_y, marker="x", color=BAD, s=36, linewidths=1.6, zorder=6)
    small: dict[str, Any] = {"ha": "center", "va": "top", "fontsize": 5.5, "color": INK, "zorder": 6}
    names, adjusters = adjuster_places(mirror, panel.panel)
    for name, place, move in zip(names, adjusters.tolist(), panel.rigid.moves.values_m, strict=True):
        deck_x, deck_y, _ = body.to_deck((*place, 0.0))
        axes.text(deck_x, deck_y - 0.025, f"{name} {_MICRO * move:+.0f}", **small)


def _draw_bar(axes: "Axes", colours: "Colours") -> None:
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415 - see above

    cmap, norm = colours
    label = "deviation along the normal, um, > 0 towards the robot"
    add_colour_bar(axes, ScalarMappable(norm, cmap), label, extend="both")
