"""Edge. Map and path of a recorded run as a picture: beacons with their ellipses, the path on the truth, the error.

Imports matplotlib, which takes a second, only when something is drawn.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ccatp.pictures.figures import GRID, INK, QUIET, dress, new_figure, save_figure
from ccatp.radio.judged import Judgement, aligned_beacons, truth_at
from ccatp.radio.recording import RecordedRun, dead_reckoned
from ccatp.radio.track import BeaconFix, Track
from ccatp.samples import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH_PX = 1800
DPI = 180
SIGMAS = 3.0  # of the ellipses
POSE_ELLIPSES = 24  # along the path
_TRUTH, _PATH, _MAP, _RECKONED = "#8fa3b8", "#1d6fa5", "#d5703f", "#d9c9a8"


def draw_slam(run: RecordedRun, track: Track, judged: Judgement, out: Path, title: str) -> None:
    """Draw a track, laid on the truth if there is one, into an image file.

    Args:
        run: the recording.
        track: what was estimated.
        judged: its errors and its alignment.
        out: the file; its suffix tells the format (PNG, PDF, SVG).
        title: first line.

    Raises:
        PictureError: the file cannot be written.
    """
    beacons = aligned_beacons(track, judged.alignment)
    path = judged.alignment.moved(track.poses[:, :2])
    centre, half = _frame(run, path, beacons)
    width = WIDTH_PX / DPI
    known = bool(np.isfinite(judged.errors_m).any())
    map_height = (width - 1.3) * float(half[1] / half[0])
    below = 1.9 if known else 0.6
    height = map_height + below + 1.3
    figure = new_figure(width, height, DPI, layout=None)
    axes = figure.add_axes((0.75 / width, (below + 0.3) / height, (width - 1.3) / width, map_height / height))
    _draw_paths(axes, run, track, judged, path)
    _draw_beacons(axes, run, beacons)
    axes.set(xlim=(centre[0] - half[0], centre[0] + half[0]), ylim=(centre[1] - half[1], centre[1] + half[1]))
    axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    dress(axes)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="upper left", bbox_to_anchor=(0.68 / width, 1.0 - 0.62 / height), ncols=len(labels),
        fontsize=8, frameon=False, labelcolor=INK, columnspacing=1.4, handletextpad=0.5,
    )  # fmt: skip
    figure.text(0.75 / width, 1.0 - 0.32 / height, title, fontsize=14, color=INK)
    figure.text(0.75 / width, 1.0 - 0.58 / height, _figures(judged), fontsize=9, color=QUIET)
    if known:
        error_axes = figure.add_axes((0.75 / width, 0.55 / height, (width - 1.3) / width, 1.1 / height))
        _draw_error(error_axes, track, judged)
    save_figure(figure, out)


def ellipse(covariance: FloatArray, sigmas: float) -> FloatArray:
    """Outline of the region within ``sigmas`` standard deviations of the origin, shape (61, 2)."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, 61)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    outline: FloatArray = sigmas * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return outline


def _frame(run: RecordedRun, path: FloatArray, beacons: dict[str, BeaconFix]) -> tuple[FloatArray, FloatArray]:
    """Centre and half size of what is shown: path and beacons, wherever dead reckoning went."""
    places = [(fix.x_m, fix.y_m) for fix in beacons.values()]
    places += [run.beacon_truth_m[name] for name in beacons if name in run.beacon_truth_m]
    outlines = [np.array((fix.x_m, fix.y_m)) + ellipse(fix.covariance, SIGMAS) for fix in beacons.values()]
    points = np.vstack([path, np.array(places).reshape(-1, 2), *outlines])
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.5 * (high - low) + 0.06 * float((high - low).max()) + 1e-3
    half[0] = max(half[0], half[1] / 1.1)  # no picture is much taller than wide,
    half[1] = max(half[1], half[0] * 0.35)  # nor a stripe
    return 0.5 * (low + high), half


def _draw_paths(axes: "Axes", run: RecordedRun, track: Track, judged: Judgement, path: FloatArray) -> None:
    reckoned = judged.alignment.moved(dead_reckoned(run.steps, run.first_pose)[:, :2])
    axes.plot(*reckoned.T, color=_RECKONED, linewidth=0.8, zorder=1, label="odometry alone")
    if run.truth is not None:
        axes.plot(*truth_at(run.truth, track.times_s)[:, :2].T, color=_TRUTH, linewidth=2.2, zorder=2, label="truth")
    axes.plot(*path.T, color=_PATH, linewidth=0.9, zorder=3, label="path")
    marks = np.unique(np.linspace(0, len(path) - 1, POSE_ELLIPSES).astype(int))
    covariances = judged.alignment.turned(track.covariances[marks, :2, :2])
    for k, (place, covariance) in enumerate(zip(path[marks], covariances, strict=True)):
        outline = place + ellipse(covariance, SIGMAS)
        label = "3 sigma of the path" if k == 0 else "_"
        axes.plot(*outline.T, color=_PATH, linewidth=0.7, alpha=0.6, zorder=4, label=label)


def _draw_beacons(axes: "Axes", run: RecordedRun, beacons: dict[str, BeaconFix]) -> None:
    surveyed = np.array([run.beacon_truth_m[name] for name in beacons if name in run.beacon_truth_m]).reshape(-1, 2)
    if surveyed.size:
        axes.scatter(
            surveyed[:, 0],
            surveyed[:, 1],
            marker="x",
            s=46,
            linewidths=1.6,
            color=INK,
            zorder=6,
            label="surveyed beacon",
        )
    for k, (name, fix) in enumerate(beacons.items()):
        label = "beacon, 3 sigma" if k == 0 else "_"
        axes.plot(fix.x_m, fix.y_m, "o", color=_MAP, markersize=4.5, zorder=7, label=label)
        outline = np.array((fix.x_m, fix.y_m)) + ellipse(fix.covariance, SIGMAS)
        axes.plot(*outline.T, color=_MAP, linewidth=1.0, zorder=5)
        axes.annotate(
            name, (fix.x_m, fix.y_m), xytext=(6, 5), textcoords="offset points", fontsize=8, color=INK, zorder=8
        )


def _draw_error(axes: "Axes", track: Track, judged: Judgement) -> None:
    sigma = np.sqrt(np.trace(track.covariances[:, :2, :2], axis1=1, axis2=2))
    t = track.times_s - track.times_s[0]
    axes.fill_between(t, 0.0, SIGMAS * sigma, color=GRID, linewidth=0.0, label="3 sigma")
    axes.plot(t, judged.errors_m, color=_PATH, linewidth=0.8, label="error")
    top = float(np.nanmax(judged.errors_m))
    axes.set(xlim=(0.0, t[-1]), ylim=(0.0, 1.15 * max(top, 1e-6)), xlabel="time, s", ylabel="error, m")
    dress(axes)


def _figures(judged: Judgement) -> str:
    parts = []
    if judged.trajectory_rmse_m is not None:
        parts.append(f"path {judged.trajectory_rmse_m:.3f} m rms after one rigid alignment")
    if judged.beacon_rmse_m is not None:
        parts.append(f"beacons {judged.beacon_rmse_m:.3f} m rms")
    return "  ·  ".join(parts) or "no truth to compare with"
