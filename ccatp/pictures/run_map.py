"""Edge. The map of a run as a picture: panels, rim, driven path, and each point coloured by its arrival error.

Imports matplotlib, which takes a second, only when something is drawn.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ccatp.config.loader import load_config
from ccatp.drawing.colours import PATH, SMALL_TO_LARGE
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.pictures.deck_map import add_colour_bar, draw_base, new_deck_map, write_title
from ccatp.pictures.figures import BAD, INK, QUIET, PictureError, save_figure
from ccatp.reporting.points import arrival_error_m
from ccatp.run_files.recorder import iter_messages, read_metadata, recordings
from ccatp.samples import FloatArray
from ccatp.storage.store import MissionStore, StoreError

if TYPE_CHECKING:
    from matplotlib.axes import Axes


WIDTH_PX = 1600
DPI = 160
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
        mirror: where it took place.
        path_xy: driven path, deck frame, shape (n, 2), m; rows of NaN part it.
        points: the measurement points.
        out: the file; its suffix tells the format (PNG, PDF, SVG).
        title: first line: mirror, points, time.
        subtitle: second line: seed, world, errors.

    Raises:
        PictureError: the file cannot be written.
    """
    figure, axes = new_deck_map(mirror, WIDTH_PX, DPI)
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
