"""Figures of a mission among beacons: the room, errors over time, consistency, the target."""

from collections.abc import Sequence
from math import ceil, floor, log10
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from ccatp.beacons.links.topics import BeaconEllipse
from ccatp.beacons.report import record as beacon_record
from ccatp.beacons.report.record import BeaconRecord
from ccatp.core import FloatArray
from ccatp.report import plots
from ccatp.report.figures import over_time
from ccatp.report.plots import BAD, INK, PX_PER_IN, QUIET, SERIES, add_legend, ellipse_outline, envelope, is_wide

SIGMAS = 3.0
_POSE_STATES = 3
_TOP = 6.0  # of the figure of consistency; larger values are drawn at its edge
_HEIGHTS_PX = (340.0, 300.0)
_MARGIN_M, _BEYOND_M = 0.25, 1.5  # around the room; largest distance outside the room that is shown
_ELLIPSES = 14  # along the path
_TALL = 0.95  # largest ratio of height to width
_TARGET = BAD


class Curve(NamedTuple):
    """One series of a figure, shapes (k,)."""

    name: str
    t_s: FloatArray
    values: FloatArray
    colour: str
    style: str = "-"


def beacon_error_figure(record: BeaconRecord, width_px: float) -> Figure:
    """Error of the position, its three sigma, and the error of dead reckoning alone; mm, logarithmic."""
    track, errors = record.track, beacon_record.pose_errors_m(record)
    curves = [Curve("3 \u03c3 of the estimate", track.t_s, SIGMAS * 1e3 * track.sigma_m, SERIES[1], "--")]
    if errors is not None and record.truth is not None:
        off = np.hypot(*(track.reckoned_m - record.truth.place_m).T)
        curves.insert(0, Curve("dead reckoning alone", track.t_s, 1e3 * off, SERIES[4], ":"))
        curves.append(Curve("true error", track.t_s, 1e3 * errors, SERIES[0]))
    return _logarithmic(curves, "mm", width_px, "localization error over time")


def standing_maps(record: BeaconRecord) -> list[tuple[float, dict[str, BeaconEllipse]]]:
    """Robot time (s) and beacons of each map that has beacons."""
    return [(one.t_s, beacons) for one in record.maps if (beacons := beacon_record.standing_beacons(record.cfg, one))]


def map_error_figure(record: BeaconRecord, width_px: float) -> Figure:
    """Root mean square error of the beacons, expected and true, against time."""
    maps = standing_maps(record)
    rows = [
        (t_s, beacon_record.expected_rms_m(beacons), beacon_record.true_rms_m(beacons, record.places))
        for t_s, beacons in maps
    ]
    t_s, expected, true = np.array(rows, dtype=np.float64).T
    curves = [Curve("expected", t_s, 1e3 * expected, SERIES[1], "--")]
    if np.isfinite(true).any():
        curves.append(Curve("true error", t_s, 1e3 * true, SERIES[0]))
    return _logarithmic(curves, "mm, rms of a place", width_px, "error of the map over time")


def consistency_figure(record: BeaconRecord, width_px: float) -> Figure:
    """NIS of the readings and NEES of the pose, each divided by its degrees of freedom: 1 is expected."""
    readings, nees = beacon_record.readings_of(record), beacon_record.pose_nees(record)
    axes = plots.new_plot(width_px, "consistency over time", _HEIGHTS_PX)
    axes.axhline(1.0, color=QUIET, linewidth=1.0, linestyle="--")
    if readings:
        t_s, nis, sizes = np.array(readings).T
        dots = plots.distinct(t_s / 60.0, np.minimum(nis / sizes, _TOP), width_px)
        axes.plot(*dots, "o", color=SERIES[2], markersize=2.6, label="NIS of the readings", clip_on=False)
        mean = np.cumsum(nis) / np.cumsum(sizes)
        axes.plot(t_s / 60.0, mean, color=SERIES[0], linewidth=1.4, label="mean NIS so far")
    if nees is not None:
        known = np.isfinite(nees) & (record.track.t_s >= record.settled_s)
        thin = envelope(record.track.t_s[known] / 60.0, nees[known] / _POSE_STATES, int(width_px))
        axes.plot(thin.x, np.minimum(thin.mean, _TOP), color=SERIES[1], linewidth=1.0, label="NEES of the pose")
    axes.set(ylabel="for each degree of freedom", ylim=(0.0, _TOP))
    return over_time(axes, record.track.t_s)


def target_figure(record: BeaconRecord, width_px: float) -> Figure:
    """Distance to the followed radio, estimated and true."""
    curves, safe_m = target_curves(record), record.cfg.follow.safe_distance_m
    axes = plots.new_plot(width_px, "distance to the target over time", _HEIGHTS_PX)
    _draw_curves(axes, curves, width_px)
    axes.axhline(safe_m, color=BAD, linewidth=1.0, linestyle="--", label="to be kept")
    top = max(1.5 * safe_m, *(float(np.nanmax(curve.values)) for curve in curves))
    axes.set(ylabel="m", ylim=(0.0, 1.05 * top))
    return over_time(axes, record.track.t_s)


def target_curves(record: BeaconRecord) -> list[Curve]:
    """Distance to the followed radio; empty if no radio is followed."""
    curves = []
    if record.cfg.follow.is_active and record.truth is not None:
        off = np.hypot(*(record.truth.target_m - record.truth.place_m).T)
        curves.append(Curve("true distance", record.track.t_s, off, SERIES[0]))
    maps = [one for one in record.maps if record.cfg.follow.is_active and one.target]
    if maps:
        off = np.hypot(*np.array([np.subtract(one.target[:2], one.pose[:2]) for one in maps if one.target]).T)
        curves.append(Curve("estimated distance", np.array([one.t_s for one in maps]), off, SERIES[1], "--"))
    return [curve for curve in curves if np.isfinite(curve.values).any()]


def _logarithmic(curves: Sequence[Curve], label: str, width_px: float, title: str) -> Figure:
    values = np.concatenate([curve.values for curve in curves])
    values = values[np.isfinite(values) & (values > 0.0)]
    low, high = (float(np.percentile(values, 1)), float(values.max())) if len(values) else (1.0, 10.0)
    ends = 10.0 ** floor(log10(low)), 10.0 ** ceil(log10(high * 1.05))
    axes = plots.new_plot(width_px, title, _HEIGHTS_PX, log="y")
    _draw_curves(axes, curves, width_px, ends[0])
    axes.set(ylabel=label, ylim=ends)
    return over_time(axes, np.concatenate([curve.t_s for curve in curves]))


def _draw_curves(axes: Axes, curves: Sequence[Curve], width_px: float, least: float = -np.inf) -> None:
    for curve in curves:
        seen = envelope(curve.t_s / 60.0, np.maximum(curve.values, least), int(width_px))
        axes.plot(seen.x, seen.mean, curve.style, color=curve.colour, linewidth=1.2, label=curve.name)


def beacon_map_figure(record: BeaconRecord, width_px: float) -> Figure:
    """The room: estimated and true path, dead reckoning, beacons with their ellipses, waypoints."""
    size, wide, width = np.array(record.cfg.workspace.size_m), is_wide(width_px), width_px / PX_PER_IN
    places = [np.zeros((1, 2)), size[None], *(_beacon_outline(ellipse) for ellipse in record.beacons.values())]
    places += [np.array([place]) for place in record.places.values()]
    if record.truth is not None:
        places += [record.truth.place_m, record.truth.target_m]
    points = np.concatenate(places)
    points = points[np.isfinite(points).all(axis=1)]
    low = np.maximum(points.min(axis=0), -_BEYOND_M) - _MARGIN_M
    high = np.minimum(points.max(axis=0), size + _BEYOND_M) + _MARGIN_M
    height = min((width - 0.75) * float((high[1] - low[1]) / (high[0] - low[0])), _TALL * width)
    figure = plots.new_figure(width, height + (0.4 if wide else 1.0) + 0.6, PX_PER_IN)
    figure.set_label(f"{record.cfg.system}: path and map of beacons")
    axes = figure.subplots()
    plots.dress(axes)
    axes.add_patch(Rectangle((0.0, 0.0), *size.tolist(), facecolor=plots.PANEL, edgecolor=plots.SEAM, zorder=0.5))
    for index, obstacle in enumerate(record.cfg.sim.obstacles if record.is_simulation else ()):
        centre, label = (obstacle.x_m, obstacle.y_m), "_" if index else "obstacle"
        look: dict[str, Any] = {"facecolor": plots.SEAM, "edgecolor": QUIET, "zorder": 1, "label": label}
        axes.add_patch(Circle(centre, obstacle.radius_m, **look))
    _draw_paths(axes, record, 1.2 if wide else 0.8)
    if not record.cfg.follow.is_active:
        _draw_waypoints(axes, record, has_tooltips=wide)
    _draw_beacons(axes, record, high[0] - 60.0 / width_px * float(high[0] - low[0]))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x, m", ylabel="y, m")
    return add_legend(axes)


def _beacon_outline(ellipse: Sequence[float]) -> FloatArray:
    x, y, xx, xy, yy = ellipse
    return np.array((x, y)) + ellipse_outline(np.array(((xx, xy), (xy, yy))), SIGMAS)


def _draw_paths(axes: Axes, record: BeaconRecord, thick: float) -> None:
    track = record.track
    lines = [("dead reckoning alone", track.reckoned_m, SERIES[4], 0.8 * thick, ":")]
    if record.truth is not None:
        lines.append(("true path", record.truth.place_m, plots.PATH, 1.6 * thick, "-"))
        lines.append(("true path of the target", record.truth.target_m, _TARGET, 0.7 * thick, "--"))
    lines.append(("estimated path", track.place_m, SERIES[1], thick, "-"))
    for name, points_m, colour, width, style in lines:
        if np.isfinite(points_m).all(axis=1).sum() >= 2:
            axes.plot(*points_m.T, style, color=colour, linewidth=width, label=name, zorder=2)
    for row in range(0, len(track.seq), max(1, ceil(len(track.seq) / _ELLIPSES))):
        outline = track.place_m[row] + ellipse_outline(track.covariance[row, :2, :2], SIGMAS)
        axes.plot(*outline.T, color=SERIES[1], linewidth=0.7, alpha=0.8, zorder=3)
    start = record.cfg.start
    axes.plot(start.x_m, start.y_m, "o", color=INK, markersize=6, zorder=4, label="start")


def _draw_waypoints(axes: Axes, record: BeaconRecord, *, has_tooltips: bool) -> None:
    waypoints = np.array(record.cfg.workspace.waypoints_m)
    reached = {arrival.waypoint for arrival in record.arrivals}
    look: dict[str, Any] = {"markersize": 9, "fillstyle": "none", "markeredgewidth": 1.3, "zorder": 4}
    for name, colour, is_reached in (("waypoint reached", plots.GOOD, True), ("waypoint, not reached", BAD, False)):
        some = [at for at in range(len(waypoints)) if (at in reached) is is_reached]
        if some:
            (rings,) = axes.plot(*waypoints[some].T, "o", color=colour, label=name, **look)
            if has_tooltips:
                plots.add_tooltips(rings, [f"waypoint {at + 1}" for at in some])
    for at, place in enumerate(waypoints):
        axes.annotate(f"{at + 1}", place, xytext=(6, -12), textcoords="offset points", fontsize=8, color=QUIET)


def _draw_beacons(axes: Axes, record: BeaconRecord, right_m: float) -> None:
    beacons, target = record.beacons, record.maps[-1].target if record.maps else None
    for ellipse in beacons.values():
        axes.plot(*_beacon_outline(ellipse).T, color=SERIES[0], linewidth=0.9, zorder=5)
    if record.places:
        look: dict[str, Any] = {"color": INK, "markersize": 7, "zorder": 6, "label": "true place of a beacon"}
        axes.plot(*np.array(list(record.places.values())).T, "x", **look)
    look = {"markersize": 5, "markeredgecolor": plots.PAPER, "markeredgewidth": 0.4, "zorder": 7}
    for index, (name, (x, y, *_)) in enumerate(beacons.items()):
        label = "_" if index else "beacon as mapped, 3 \u03c3"
        (dot,) = axes.plot(x, y, "o", color=SERIES[0], label=label, **look)
        plots.add_tooltips(dot, [name])
    small: dict[str, Any] = {"textcoords": "offset points", "fontsize": 8, "color": INK, "zorder": 8}
    for name, (x, y, *_) in beacons.items():
        xytext, side = ((-6, 5), "right") if x > right_m else ((6, 5), "left")
        axes.annotate(name, (x, y), xytext=xytext, ha=side, parse_math=False, **small)
    if target is not None:
        axes.plot(*_beacon_outline(target).T, color=_TARGET, linewidth=0.9, zorder=5)
        axes.plot(target[0], target[1], "o", color=_TARGET, markersize=6, zorder=7, label="target at the end, 3 \u03c3")
