"""Figures of beacons: path loss, fixes by signal strength, the fuzzy speed, maps of motes, recorded runs.

The suffix of a file gives its format (PNG, PDF, SVG). Raises PictureError: the file cannot be written.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from ccatp.beacons.config.models import FuzzyConfig
from ccatp.beacons.estimation.evaluation import TrackEvaluation, aligned_beacons, truth_at
from ccatp.beacons.estimation.level_fix import LevelFix
from ccatp.beacons.estimation.path_loss import LevelPair, PathLossFit
from ccatp.beacons.estimation.recording import EstimatedPath, RecordedRun, dead_reckoned
from ccatp.beacons.estimation.track_review import range_residuals
from ccatp.beacons.steering import Sugeno
from ccatp.core import FloatArray
from ccatp.report.plots import GRID, INK, QUIET, add_legend, dress, ellipse_outline, new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BLUE, _GOLD, _GREEN, _RED = "#0b3c5d", "#d08c00", "#1d9a8a", "#c0392b"
_REGION = 0.9


def draw_path_loss(fit: PathLossFit, pairs: Sequence[LevelPair], name: str, out: Path) -> None:
    """Levels over distance, the fitted line, and the band in which 95 % of new places are expected."""
    figure = new_figure(7.0, 4.4)
    axes = figure.subplots()
    distances, levels = np.array([pair[:2] for pair in pairs]).T
    grid = np.geomspace(distances.min() / 1.2, distances.max() * 1.2, 200)
    mean, scale = fit.predicted(grid)
    half = scale * float(stdtrit(fit.freedom, 0.975))
    reference, exponent = fit.half_widths(0.95)
    line = f"{fit.reference_dbm:.1f} ± {reference:.1f} dBm at 1 m, exponent {fit.exponent:.2f} ± {exponent:.2f}, "
    axes.fill_between(grid, mean - half, mean + half, color=_BLUE, alpha=0.12, linewidth=0, label="95 % of new places")
    axes.plot(grid, mean, color=_BLUE, linewidth=1.6, label=f"{line}spread {fit.sigma_db:.1f} dB")
    axes.plot(distances, levels, "o", color=_GOLD, markersize=4, markeredgecolor="white", label="readings")
    axes.set(xscale="log", xlabel="distance, m", ylabel="level, dBm", title=name)
    axes.xaxis.set_major_formatter("{x:g}")
    dress(axes)
    axes.legend(frameon=False, fontsize=8)
    save_figure(figure, out)


def draw_fixes(
    fixes: Sequence[LevelFix], truths: Sequence[tuple[float, float]], beacons_m: Mapping[str, tuple[float, float]],
    name: str, out: Path,
) -> None:  # fmt: skip
    """A panel for each point (at most twelve): its 90 % region, the fix, and the true position."""
    shown = list(zip(fixes, truths, strict=True))[:12]
    columns = min(5, len(shown))
    rows = -(-len(shown) // columns)
    figure = new_figure(2.3 * columns, 2.3 * rows + 0.5)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    for index, (axes, (fix, truth)) in enumerate(zip(panels, shown, strict=False), 1):
        inside = fix.points_m[fix.region(_REGION)]
        axes.plot(*inside.T, "s", color=_BLUE, alpha=0.18, markersize=2.2, markeredgewidth=0, label="90 % region")
        axes.plot(*np.array(list(beacons_m.values())).T, "^", color=QUIET, markersize=5, label="beacons")
        axes.plot(*truth, "x", color=_RED, markersize=6, markeredgewidth=1.6, label="truth")
        axes.plot(*fix.position_m, "o", color=_GOLD, markersize=5, markeredgecolor="white", label="fix")
        axes.set_title(f"{index}: {float(np.hypot(*(fix.position_m - truth))):.2f} m")
        axes.set_aspect("equal")
        dress(axes)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    figure.suptitle(name, fontsize=10, color=INK)
    save_figure(figure, out)


def draw_fuzzy(cfg: FuzzyConfig, out: Path) -> None:
    """The speed over distance and heading error, and the memberships of both; FuzzyGapError: the rules leave a gap."""
    sugeno = Sugeno(cfg)
    figure = new_figure(10.0, 4.6)
    layout = figure.add_gridspec(2, 2, width_ratios=(1.5, 1.0))
    axes = figure.add_subplot(layout[:, 0])
    x, y = (np.linspace(*_span(cfg, name), 121) for name in sugeno.inputs)
    speed = np.array([[sugeno.evaluate((a, b)) for a in x.tolist()] for b in y.tolist()])
    (shown_x, x_label), (shown_y, y_label) = map(_in_degrees, sugeno.inputs, (x, y))
    drawn = axes.contourf(shown_x, shown_y, speed, levels=np.linspace(speed.min(), speed.max(), 25), cmap="viridis")
    lines = axes.contour(shown_x, shown_y, speed, levels=6, colors="white", linewidths=0.6)
    axes.clabel(lines, fmt="%.2f", fontsize=7)
    axes.set(xlabel=x_label, ylabel=y_label, title="speed, m/s")
    figure.colorbar(drawn, ax=axes, format="%.2f")
    for row, name in enumerate(sugeno.inputs):
        panel = figure.add_subplot(layout[row, 1])
        values = np.linspace(*_span(cfg, name), 200)
        shown, label = _in_degrees(name, values)
        grades = np.array([sugeno.memberships(row, value) for value in values.tolist()])
        for index, term in enumerate(cfg.inputs[name].terms):
            panel.plot(shown, grades[:, index], color=(_BLUE, _GOLD, _GREEN, _RED, QUIET)[index % 5], label=term)
        panel.set(xlabel=label, ylim=(-0.03, 1.08))
        panel.legend(frameon=False, fontsize=8, loc="center right")
        dress(panel)
    axes.tick_params(labelsize=8, color=QUIET, labelcolor=INK)
    save_figure(figure, out)


def _span(cfg: FuzzyConfig, name: str) -> tuple[float, float]:
    """From the smallest corner (at least 0) to 1.25 times the largest left shoulder; others may be very large."""
    terms = cfg.inputs[name].terms.values()
    return max(0.0, min(corner for term in terms for corner in term)), 1.25 * max(term[1] for term in terms)


def _in_degrees(name: str, values: FloatArray) -> tuple[FloatArray, str]:
    """Values of an input in the displayed unit, and the label of their axis."""
    words = name.replace("_", " ")
    if name.endswith("_rad"):
        return np.degrees(values), words.removesuffix(" rad") + ", deg"
    return values, words.removesuffix(" m") + ", m"


_CHI2_90 = 4.605  # 90 % quantile for two degrees of freedom
_LABELLED = 40  # motes up to which each has its name beside it
_VISIBLE = 0.012  # of the width of the map: ellipses that are smaller are drawn larger, and the title says so


class MapPicture(NamedTuple):
    """The drawn parts of one map, in its first two coordinates."""

    names: Sequence[str]
    positions_m: FloatArray
    covariance_m2: FloatArray
    true_m: FloatArray | None  # shape (n, d)
    pairs: NDArray[np.intp]  # measured, indices, shape (e, 2)
    doubtful: Sequence[int]
    title: str


class Traces(NamedTuple):
    """Error after each update, over runs: 10, 50 and 90 %, and what the filter expects (median), shape (k,)."""

    low_m: FloatArray
    middle_m: FloatArray
    high_m: FloatArray
    expected_m: FloatArray
    bound_m: float | None
    runs: int


def draw_mote_map(picture: MapPicture, traces: Traces | None, out: Path) -> None:
    """Draw a map, and next to it the errors if there are any."""
    figure = new_figure(11.0 if traces else 6.5, 6.5)
    panels = figure.subplots(1, 2 if traces else 1, squeeze=False)[0]
    _draw_places(panels[0], picture)
    if traces is not None:
        _draw_traces(panels[1], traces)
    for axes, columns in zip(panels, (3, 2), strict=False):
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=columns, frameon=False, fontsize=8)
    dress(*panels)
    save_figure(figure, out)


def _draw_places(axes: "Axes", picture: MapPicture) -> None:
    """Motes, true places, measured pairs and the 90 % ellipses."""
    d, places = picture.positions_m.shape[1], picture.positions_m[:, :2]
    for i, j in picture.pairs.tolist():
        axes.plot(*places[[i, j]].T, color=GRID, linewidth=0.8, zorder=1)
    blocks = [picture.covariance_m2[row * d : row * d + 2, row * d : row * d + 2] for row in range(len(places))]
    outlines = [ellipse_outline(block, _CHI2_90**0.5) for block in blocks]
    typical = float(np.median([np.hypot(*outline.T).max() for outline in outlines]))
    width, grown = float(np.ptp(places, axis=0).max()), 1.0
    while 0.0 < typical * grown < _VISIBLE * width and grown < 1e6:
        grown *= 10.0
    for place, outline in zip(places, outlines, strict=True):
        axes.fill(*(place + grown * outline).T, facecolor=_BLUE, alpha=0.18, edgecolor=_BLUE, zorder=2)
    if picture.true_m is not None:
        axes.plot(*picture.true_m[:, :2].T, "o", color=_GOLD, markersize=7, fillstyle="none", label="true", zorder=3)
    axes.plot(*places.T, "x", color=_BLUE, markersize=6, label="mapped", zorder=4)
    if len(picture.doubtful):
        doubtful = places[list(picture.doubtful)]
        axes.plot(*doubtful.T, "s", color=_RED, markersize=11, fillstyle="none", label="may be elsewhere")
    if len(picture.names) <= _LABELLED:
        for name, place in zip(picture.names, places, strict=True):
            axes.annotate(name, place, textcoords="offset points", xytext=(6, 5), fontsize=7, color=QUIET)
    larger = f", ellipses {grown:g} times larger" if grown > 1.0 else ", 90 % ellipses"
    axes.set_title(picture.title + larger, fontsize=10, color=INK)
    axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    axes.margins(0.1)


def _draw_traces(axes: "Axes", traces: Traces) -> None:
    """Median and the band from 10 to 90 %, what the filter expects, the bound."""
    updates, expected = np.arange(len(traces.middle_m)), np.arange(len(traces.expected_m))
    axes.fill_between(updates, traces.low_m, traces.high_m, color=_BLUE, alpha=0.18, linewidth=0)
    axes.plot(updates, traces.middle_m, color=_BLUE, linewidth=1.6, label="error, median and 10 to 90 %")
    axes.plot(expected, traces.expected_m, "--", color=_BLUE, linewidth=1.0, label="expected by the filter")
    if traces.bound_m is not None:
        axes.axhline(traces.bound_m, color=QUIET, linewidth=0.9, linestyle=":", label="Cramér-Rao bound, all updates")
    axes.set(xlabel="updates", ylabel="root mean square error, m", yscale="log")
    axes.set_title(f"{traces.runs} runs", fontsize=10, color=INK)


WIDTH_PX, DPI = 1800, 180
SIGMAS = 3.0  # of the ellipses
POSE_ELLIPSES = 24  # along the path
_BEACON_COLOURS = (_BLUE, _GOLD, _GREEN, _RED, "#b5478a", "#6b7785", "#7a3e00", "#4c9be8")
_TRUTH, _PATH, _MAP, _RECKONED = "#8fa3b8", "#1d6fa5", "#d5703f", "#d9c9a8"


def draw_slam(
    run: RecordedRun, track: EstimatedPath, judged: TrackEvaluation, camera_field_rad: float, out: Path, title: str
) -> None:
    """Draw a track, aligned with the truth if there is one."""
    beacons = {
        name: (np.array((fix.x_m, fix.y_m)), ellipse_outline(fix.covariance, SIGMAS))
        for name, fix in aligned_beacons(track, judged.alignment).items()
    }
    surveyed = np.array([run.beacon_truth_m[name] for name in beacons if name in run.beacon_truth_m]).reshape(-1, 2)
    path = judged.alignment.moved(track.poses[:, :2])
    moved = {name: judged.alignment.moved(one.places_m) for name, one in track.tracks.items()}
    # What is shown: path and beacons, wherever dead reckoning went.
    points = np.vstack([path, surveyed, *moved.values(), *(place + outline for place, outline in beacons.values())])
    low, high = points.min(axis=0), points.max(axis=0)
    centre, half = 0.5 * (low + high), 0.5 * (high - low) + 0.06 * float((high - low).max()) + 1e-3
    half[0] = max(half[0], half[1] / 1.1)  # limits the aspect ratio of the picture
    half[1] = max(half[1], half[0] * 0.35)
    known = bool(np.isfinite(judged.errors_m).any())
    residuals_m = range_residuals(run, track, camera_field_rad)
    has_residuals = bool(np.isfinite(residuals_m).any())
    heights = [(WIDTH_PX / DPI - 0.8) * float(half[1] / half[0]), *([1.1] if known else [])]
    heights += [1.6] if has_residuals else []
    figure = new_figure(WIDTH_PX / DPI, sum(heights) + 1.8, DPI)
    figure.suptitle(title, x=0.02, ha="left", fontsize=14, color=INK)
    panels = figure.subplots(len(heights), height_ratios=heights, squeeze=False)[:, 0]
    axes = panels[0]
    rms = {
        "path {:.3f} m rms after one rigid alignment": judged.trajectory_rmse_m,
        "beacons {:.3f} m rms": judged.beacon_rmse_m,
    }
    parts = [text.format(rms_m) for text, rms_m in rms.items() if rms_m is not None]
    axes.set_title("  ·  ".join(parts) or "no truth to compare with", loc="left", color=QUIET)
    _draw_paths(axes, run, track, judged, path)
    if surveyed.size:
        axes.scatter(*surveyed.T, marker="x", s=46, linewidths=1.6, color=INK, zorder=6, label="surveyed beacon")
    for k, (name, (place, outline)) in enumerate(beacons.items()):
        label = "beacon, 3 sigma" if k == 0 else "_"
        axes.plot(*place, "o", color=_MAP, markersize=4.5, zorder=7, label=label)
        axes.plot(*(place + outline).T, color=_MAP, linewidth=1.0, zorder=5)
        axes.annotate(name, place, xytext=(6, 5), textcoords="offset points", fontsize=8, color=INK, zorder=8)
    for name, places in moved.items():  # of a beacon that moves, or its earlier places
        axes.plot(*places.T, ".:", color=_MAP, markersize=3.0, linewidth=0.8, zorder=5)
        axes.annotate(name, places[0], xytext=(6, -11), textcoords="offset points", fontsize=8, color=QUIET, zorder=8)
    axes.set(xlim=(centre[0] - half[0], centre[0] + half[0]), ylim=(centre[1] - half[1], centre[1] + half[1]))
    axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    dress(*panels)
    add_legend(axes)
    if known:
        sigma, t = np.sqrt(np.trace(track.covariances[:, :2, :2], axis1=1, axis2=2)), track.times_s - track.times_s[0]
        panels[1].fill_between(t, 0.0, SIGMAS * sigma, color=GRID, linewidth=0.0, label="3 sigma")
        panels[1].plot(judged.times_s - track.times_s[0], judged.errors_m, color=_PATH, linewidth=0.8, label="error")
        top = 1.15 * max(float(np.nanmax(judged.errors_m)), 1e-6)
        panels[1].set(xlim=(0.0, t[-1]), ylim=(0.0, top), xlabel="time, s", ylabel="error, m")
    if has_residuals:
        _draw_residuals(panels[-1], run, residuals_m, float(track.times_s[0]), float(track.times_s[-1]))
    save_figure(figure, out)


def _draw_residuals(axes: "Axes", run: RecordedRun, residuals_m: FloatArray, begin_s: float, end_s: float) -> None:
    """Range residuals by time, a colour for each beacon; those far off stand at the edge."""
    limit = 1.2 * max(float(np.nanpercentile(np.abs(residuals_m), 99)), 1e-6)
    for k, name in enumerate(run.beacon_ids):
        own = (run.readings.beacon == k) & np.isfinite(residuals_m)
        if own.any():
            shade = _BEACON_COLOURS[k % len(_BEACON_COLOURS)]
            shown = np.clip(residuals_m[own], -limit, limit)
            axes.plot(run.readings.times_s[own] - begin_s, shown, ".", color=shade, markersize=2.5, label=name)
    axes.set(xlim=(0.0, end_s - begin_s), ylim=(-1.02 * limit, 1.02 * limit), xlabel="time, s")
    axes.set_ylabel("range residual, m")
    axes.legend(frameon=False, fontsize=7, ncols=8, markerscale=3.0, loc="upper left", bbox_to_anchor=(0.0, -0.3))


def _draw_paths(
    axes: "Axes", run: RecordedRun, track: EstimatedPath, judged: TrackEvaluation, path: FloatArray
) -> None:
    reckoned = judged.alignment.moved(dead_reckoned(run.steps, run.first_pose)[:, :2])
    axes.plot(*reckoned.T, color=_RECKONED, linewidth=0.8, zorder=1, label="odometry alone")
    if run.truth is not None:
        axes.plot(*truth_at(run.truth, track.times_s)[:, :2].T, color=_TRUTH, linewidth=2.2, zorder=2, label="truth")
    axes.plot(*path.T, color=_PATH, linewidth=0.9, zorder=3, label="path")
    marks = np.unique(np.linspace(0, len(path) - 1, POSE_ELLIPSES).astype(int))
    covariances = judged.alignment.turned(track.covariances[marks, :2, :2])
    for k, (place, covariance) in enumerate(zip(path[marks], covariances, strict=True)):
        outline = place + ellipse_outline(covariance, SIGMAS)
        label = "3 sigma of the path" if k == 0 else "_"
        axes.plot(*outline.T, color=_PATH, linewidth=0.7, alpha=0.6, zorder=4, label=label)
