"""Figures over time: localization errors, time budget, consistency; the room of a beacon mission."""

from collections.abc import Mapping, Sequence
from math import ceil, floor, log10
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ccatp.core import FloatArray
from ccatp.links.topics import BeaconEllipse
from ccatp.report.beacon_record import (
    BeaconRecord,
    expected_rms_m,
    pose_errors_m,
    pose_nees,
    readings_of,
    standing_beacons,
    true_rms_m,
)
from ccatp.report.findings import KINDS, ErrorSeries, TimeBreakdown
from ccatp.report.plots import (
    BAD,
    GOOD,
    INK,
    PANEL,
    PAPER,
    PATH,
    PX_PER_IN,
    QUIET,
    SEAM,
    SERIES,
    Envelope,
    add_legend,
    add_tooltips,
    distinct,
    dress,
    ellipse_outline,
    envelope,
    is_wide,
    new_figure,
    new_plot,
    set_log_axis,
)
from ccatp.report.record import WITHIN_MM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ERROR, _SIGMA, _FIX = SERIES[0], SERIES[1], SERIES[2]
_LEAST_MM = 1e-3  # a micrometre: less is of no interest, and of the noise of the laser
_PX_PER_INTERVAL = 2.0
_OF_THE_BUDGET = 0.4  # a few panels are no matter of an hour
_KIND_COLOURS = dict(
    zip(KINDS, (SERIES[1], SERIES[0], SERIES[5], SERIES[2], SERIES[4], SERIES[3], "#6b5b95", QUIET), strict=True)
)


def error_figure(series: ErrorSeries, width_px: float) -> "Figure":
    """Localization error, if known, three sigma, and how far each fix moved the estimate, over time; mm."""
    figure, axes = new_plot(width_px, "localization error over time")
    set_log_axis(axes, "y")
    low_mm, high_mm = _ends_mm(series)
    begin_s, end_s = float(series.t_s[0]), max(float(series.t_s[-1]), float(series.t_s[0]) + 1.0)
    axes.set(xlabel="robot time, min", ylabel="mm", xlim=(begin_s / 60.0, end_s / 60.0), ylim=(low_mm, high_mm))
    intervals = max(1, int(width_px / _PX_PER_INTERVAL))
    errors = envelope(series.t_s / 60.0, series.error_mm, intervals)
    if len(errors.x):
        _draw_band(axes, errors, _ERROR, "true error, least to largest", low_mm)
    sigma = envelope(series.t_s / 60.0, series.sigma3_mm, intervals)
    _draw_band(axes, sigma, _SIGMA, "3 \u03c3 of the estimate", low_mm)
    for is_fused, colour, name in ((True, _FIX, "fix: correction"), (False, BAD, "fix, not taken")):
        chosen = series.fix_fused == is_fused
        if chosen.any():
            places = distinct(series.fix_t_s[chosen] / 60.0, np.maximum(series.fix_mm[chosen], low_mm), width_px)
            axes.plot(*places, "o", color=colour, markersize=2.6 if is_wide(width_px) else 1.8, label=name)
    for at_s in series.breaks_s:
        axes.axvline(at_s / 60.0, color=INK, linewidth=0.9, linestyle=":")
    if high_mm >= WITHIN_MM:
        axes.axhline(WITHIN_MM, color=BAD, linewidth=1.0, linestyle="--", label=f"{WITHIN_MM:.0f} mm")
    add_legend(axes)
    return figure


def _ends_mm(series: ErrorSeries) -> tuple[float, float]:
    errors = series.error_mm[np.isfinite(series.error_mm)]
    largest = max(float(np.concatenate([series.sigma3_mm, errors, series.fix_mm]).max()), 0.1)
    usual = float(np.percentile(errors, 2)) if len(errors) else 0.1
    return 10.0 ** floor(log10(max(min(usual, float(series.sigma3_mm.min())), _LEAST_MM))), largest * 1.5


def _draw_band(axes: "Axes", found: Envelope, colour: str, label: str, low: float) -> None:
    """From the least to the largest of each interval; parted where there is nothing for a long time."""
    steps = np.diff(found.x)
    gaps = 1 + np.flatnonzero(steps > 10.0 * np.median(steps)) if len(steps) else np.empty(0, dtype=np.int64)
    x, least, largest = (np.insert(values, gaps, np.nan) for values in found[:3])
    axes.fill_between(x, np.maximum(least, low), np.maximum(largest, low), color=colour, alpha=0.28, linewidth=0.0)
    axes.plot(x, largest, color=colour, linewidth=1.0, label=label)


def time_figure(budgets: Sequence[tuple[str, TimeBreakdown]], budget_s: float, width_px: float) -> "Figure":
    """Where the time of runs went, each above the least that its way takes; marked is what a mission may take."""
    bars: list[tuple[str, dict[str, float]]] = []
    for name, found in budgets:
        bars += [(name, found.spent_s), *([("least", found.least_s)] if found.least_s is not None else [])]
    height_px = 100.0 + 34.0 * len(bars)
    figure, axes = new_plot(width_px, "where the time went", (height_px, height_px + 40.0))
    totals_s = [sum(parts.values()) for _, parts in bars]
    end_s = max(*totals_s, budget_s) if max(totals_s) > _OF_THE_BUDGET * budget_s else max(totals_s)
    left_s = np.zeros(len(bars))
    for kind in KINDS:
        if not any(kind in parts for _, parts in bars):
            continue
        lengths_s = np.array([parts.get(kind, 0.0) for _, parts in bars])
        drawn = axes.barh(range(len(bars)), lengths_s, 0.75, left_s, color=_KIND_COLOURS[kind], label=kind)
        least_px = 9.0 * (end_s / width_px)  # a digit
        texts = [f"{length:.0f}" if length > least_px * (len(f"{length:.0f}") + 1) else "" for length in lengths_s]
        axes.bar_label(drawn, texts, label_type="center", color=PAPER, fontsize=8)
        left_s += lengths_s
    for place, total_s in enumerate(totals_s):
        axes.annotate(
            f"{total_s:.0f} s", (total_s, place), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8,
            color=QUIET,
        )  # fmt: skip
    if end_s >= budget_s:
        axes.axvline(budget_s, color=BAD, linewidth=1.1, linestyle="--", label="budget")
    axes.set_yticks(range(len(bars)), [name for name, _ in bars])
    axes.set(xlabel="time, s", xlim=(0.0, end_s * (1.08 if is_wide(width_px) else 1.2)), ylim=(len(bars) - 0.5, -0.5))
    axes.grid(visible=False, axis="y")
    add_legend(axes)
    return figure


def distribution_figure(values: Mapping[str, FloatArray], label: str, width_px: float) -> "Figure":
    """Share of the values of each run below each number, logarithmic; ``label`` names them with their unit."""
    figure, axes = new_plot(width_px, f"distribution of {label}", (330.0, 300.0))
    set_log_axis(axes, "x")
    everything = np.maximum(np.concatenate(list(values.values())), _LEAST_MM)
    low, high = 10.0 ** np.floor(np.log10(everything.min())), 10.0 ** np.ceil(np.log10(everything.max() * 1.001))
    for (name, some), colour in zip(values.items(), SERIES, strict=False):
        ordered = np.sort(np.maximum(some, _LEAST_MM))
        share = 100.0 * np.arange(1, len(ordered) + 1) / len(ordered)
        axes.step(ordered, share, where="post", color=colour, linewidth=1.4, label=name)
    axes.set(xlabel=label, ylabel="% of them below", xlim=(low, high), ylim=(0.0, 101.0))
    add_legend(axes)
    return figure


def errors_figure(series: Mapping[str, ErrorSeries], width_px: float) -> "Figure":
    """The largest localization error of each time, for each run, and three sigma of the estimate, dashed."""
    figure, axes = new_plot(width_px, "largest localization error over time")
    set_log_axis(axes, "y")
    intervals = max(1, int(width_px / _PX_PER_INTERVAL))
    largest, end_s = 0.01, 6.0
    for (name, found), colour in zip(series.items(), SERIES, strict=False):
        is_known = bool(np.isfinite(found.error_mm).any())
        values = found.error_mm if is_known else found.sigma3_mm
        sigma = envelope(found.t_s / 60.0, found.sigma3_mm, intervals)
        errors = envelope(found.t_s / 60.0, values, intervals)
        axes.plot(sigma.x, sigma.high, color=colour, linewidth=0.8, linestyle="--", alpha=0.7)
        axes.plot(errors.x, errors.high, color=colour, linewidth=1.1, label=name if is_known else f"{name} (3 \u03c3)")
        largest = max(largest, float(sigma.high.max()), float(errors.high.max()))
        end_s = max(end_s, float(found.t_s[-1]))
    limits = {"xlim": (0.0, end_s / 60.0), "ylim": (_LEAST_MM, 1.5 * largest)}
    axes.set(xlabel="robot time, min", ylabel="mm", **limits)
    add_legend(axes)
    return figure


SIGMAS = 3.0
_POSE_STATES = 3
_MILLI = 1e3
_TOP = 6.0  # of the figure of consistency: what lies above is drawn at its edge
_HEIGHTS_PX = (340.0, 300.0)
_MARGIN_M, _BEYOND_M = 0.25, 1.5  # around the room; of it what stands outside is still shown
_ELLIPSES = 14  # along the path
_TALL = 0.95  # most height for the width
_BEACON, _TARGET, _ESTIMATE, _RECKONED = SERIES[0], BAD, SERIES[1], SERIES[4]


class Curve(NamedTuple):
    """One series of a figure, shapes (k,)."""

    name: str
    t_s: FloatArray
    values: FloatArray
    colour: str
    style: str = "-"


def beacon_error_figure(record: BeaconRecord, width_px: float) -> "Figure":
    """Error of the position, its three sigma, and the error of dead reckoning alone; mm, logarithmic."""
    track = record.track
    curves = []
    errors = pose_errors_m(record)
    if errors is not None and record.truth is not None:
        off = np.hypot(*(track.reckoned_m - record.truth.place_m).T)
        curves.append(Curve("dead reckoning alone", track.t_s, _MILLI * off, SERIES[4], ":"))
    curves.append(Curve("3 \u03c3 of the estimate", track.t_s, SIGMAS * _MILLI * track.sigma_m, SERIES[1], "--"))
    if errors is not None:
        curves.append(Curve("true error", track.t_s, _MILLI * errors, SERIES[0]))
    return _logarithmic(curves, "mm", width_px, "localization error over time")


def standing_maps(record: BeaconRecord) -> list[tuple[float, dict[str, BeaconEllipse]]]:
    """Robot time (s) and beacons of each map that holds any."""
    return [(one.t_s, beacons) for one in record.maps if (beacons := standing_beacons(record.cfg, one))]


def map_error_figure(record: BeaconRecord, width_px: float) -> "Figure":
    """Root of the mean square error of the beacons, expected and true, against time."""
    maps = standing_maps(record)
    expected = [expected_rms_m(beacons) for _, beacons in maps]
    true = np.array([true_rms_m(beacons, record.places) for _, beacons in maps], dtype=np.float64)
    t_s = np.array([t_s for t_s, _ in maps])
    curves = [Curve("expected", t_s, _MILLI * np.array(expected, dtype=np.float64), SERIES[1], "--")]
    if np.isfinite(true).any():
        curves.append(Curve("true error", t_s, _MILLI * true, SERIES[0]))
    return _logarithmic(curves, "mm, rms of a place", width_px, "error of the map over time")


def consistency_figure(record: BeaconRecord, width_px: float) -> "Figure":
    """NIS of the readings and NEES of the pose, each by its degrees of freedom: 1 is expected."""
    readings, nees = readings_of(record), pose_nees(record)
    figure, axes = new_plot(width_px, "consistency over time", _HEIGHTS_PX)
    axes.axhline(1.0, color=QUIET, linewidth=1.0, linestyle="--")
    if readings:
        t_min = np.array([reading.t_s for reading in readings]) / 60.0
        nis = np.array([reading.nis for reading in readings])
        sizes = np.array([reading.size for reading in readings])
        dots = distinct(t_min, np.minimum(nis / sizes, _TOP), width_px)
        axes.plot(*dots, "o", color=SERIES[2], markersize=2.6, label="NIS of the readings", clip_on=False)
        axes.plot(t_min, np.cumsum(nis) / np.cumsum(sizes), color=SERIES[0], linewidth=1.4, label="mean NIS so far")
    if nees is not None:
        known = np.isfinite(nees) & (record.track.t_s >= record.settled_s)
        thin = envelope(record.track.t_s[known] / 60.0, nees[known] / _POSE_STATES, int(width_px))
        axes.plot(thin.x, np.minimum(thin.mean, _TOP), color=SERIES[1], linewidth=1.0, label="NEES of the pose")
    _set_time(axes, record.track.t_s)
    axes.set(ylabel="for each degree of freedom", ylim=(0.0, _TOP))
    add_legend(axes)
    return figure


def target_figure(record: BeaconRecord, width_px: float) -> "Figure":
    """Distance to the followed radio, by the estimate and in truth."""
    curves = target_curves(record)
    figure, axes = new_plot(width_px, "distance to the target over time", _HEIGHTS_PX)
    safe_m = record.cfg.follow.safe_distance_m
    top = max(1.5 * safe_m, *(float(np.nanmax(curve.values)) for curve in curves))
    for curve in curves:
        seen = envelope(curve.t_s / 60.0, curve.values, int(width_px))
        axes.plot(seen.x, seen.mean, curve.style, color=curve.colour, linewidth=1.2, label=curve.name)
    axes.axhline(safe_m, color=BAD, linewidth=1.0, linestyle="--", label="to be kept")
    _set_time(axes, record.track.t_s)
    axes.set(ylabel="m", ylim=(0.0, 1.05 * top))
    add_legend(axes)
    return figure


def target_curves(record: BeaconRecord) -> list[Curve]:
    """Distance to the followed radio; empty where none is followed."""
    if not record.cfg.follow.is_active:
        return []
    curves = []
    if record.truth is not None:
        off = np.hypot(*(record.truth.target_m - record.truth.place_m).T)
        curves.append(Curve("true distance", record.track.t_s, off, SERIES[0]))
    found = [
        (one.t_s, np.hypot(one.target[0] - one.pose[0], one.target[1] - one.pose[1]))
        for one in record.maps
        if one.target
    ]
    if found:
        t_s, off = np.array(found).T
        curves.append(Curve("estimated distance", t_s, off, SERIES[1], "--"))
    return [curve for curve in curves if np.isfinite(curve.values).any()]


def _logarithmic(curves: Sequence[Curve], label: str, width_px: float, title: str) -> "Figure":
    values = np.concatenate([curve.values for curve in curves])
    values = values[np.isfinite(values) & (values > 0.0)]
    low, high = (float(np.percentile(values, 1)), float(values.max())) if len(values) else (1.0, 10.0)
    ends = 10.0 ** floor(log10(low)), 10.0 ** ceil(log10(high * 1.05))
    figure, axes = new_plot(width_px, title, _HEIGHTS_PX)
    set_log_axis(axes, "y")
    for curve in curves:
        seen = envelope(curve.t_s / 60.0, np.maximum(curve.values, ends[0]), int(width_px))
        axes.plot(seen.x, seen.mean, curve.style, color=curve.colour, linewidth=1.2, label=curve.name)
    _set_time(axes, np.concatenate([curve.t_s for curve in curves]))
    axes.set(ylabel=label, ylim=ends)
    add_legend(axes)
    return figure


def _set_time(axes: "Axes", t_s: FloatArray) -> None:
    begin_s, end_s = (float(t_s.min()), float(t_s.max())) if len(t_s) else (0.0, 60.0)
    axes.set(xlabel="robot time, min", xlim=(begin_s / 60.0, max(end_s, begin_s + 1.0) / 60.0))


# -- the room ---------------------------------------------------------------------------------------------------------


def beacon_map_figure(record: BeaconRecord, width_px: float) -> "Figure":
    """The room: estimated and true path, dead reckoning, beacons with their ellipses, waypoints."""
    low, high = _bounds(record)
    width = width_px / PX_PER_IN
    legend = 0.4 if is_wide(width_px) else 1.0
    height = min((width - 0.75) * float((high[1] - low[1]) / (high[0] - low[0])), _TALL * width)
    figure = new_figure(width, height + legend + 0.6, PX_PER_IN)
    figure.set_label(f"{record.cfg.system}: path and map of beacons")
    axes = figure.subplots()
    dress(axes)
    _draw_room(axes, record)
    _draw_paths(axes, record, width_px)
    _draw_waypoints(axes, record, width_px)
    _draw_beacons(axes, record, high[0] - 60.0 / width_px * float(high[0] - low[0]))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x, m", ylabel="y, m")
    add_legend(axes)
    return figure


def _bounds(record: BeaconRecord) -> tuple[FloatArray, FloatArray]:
    size = np.array(record.cfg.workspace.size_m)
    places = [np.zeros((1, 2)), size[None]]
    places += [_beacon_outline(ellipse) for ellipse in record.beacons.values()]
    places += [np.array([place]) for place in record.places.values()]
    if record.truth is not None:
        places += [record.truth.place_m, record.truth.target_m]
    points = np.concatenate(places)
    points = points[np.isfinite(points).all(axis=1)]
    low, high = np.maximum(points.min(axis=0), -_BEYOND_M), np.minimum(points.max(axis=0), size + _BEYOND_M)
    return low - _MARGIN_M, high + _MARGIN_M


def _beacon_outline(ellipse: Sequence[float]) -> FloatArray:
    x, y, xx, xy, yy = ellipse
    return np.array((x, y)) + ellipse_outline(np.array(((xx, xy), (xy, yy))), SIGMAS)


def _draw_room(axes: "Axes", record: BeaconRecord) -> None:
    from matplotlib.patches import Circle, Rectangle  # noqa: PLC0415 - takes a second

    axes.add_patch(Rectangle((0.0, 0.0), *record.cfg.workspace.size_m, facecolor=PANEL, edgecolor=SEAM, zorder=0.5))
    for index, obstacle in enumerate(record.cfg.sim.obstacles if record.is_simulation else ()):
        centre, label = (obstacle.x_m, obstacle.y_m), "_" if index else "obstacle"
        axes.add_patch(Circle(centre, obstacle.radius_m, facecolor=SEAM, edgecolor=QUIET, zorder=1, label=label))


def _draw_paths(axes: "Axes", record: BeaconRecord, width_px: float) -> None:
    track = record.track
    thick = 1.2 if is_wide(width_px) else 0.8
    lines = [("dead reckoning alone", track.reckoned_m, _RECKONED, 0.8 * thick, ":")]
    if record.truth is not None:
        lines.append(("true path", record.truth.place_m, PATH, 1.6 * thick, "-"))
        lines.append(("true path of the target", record.truth.target_m, _TARGET, 0.7 * thick, "--"))
    lines.append(("estimated path", track.place_m, _ESTIMATE, thick, "-"))
    for name, points_m, colour, width, style in lines:
        if np.isfinite(points_m).all(axis=1).sum() >= 2:
            axes.plot(*points_m.T, style, color=colour, linewidth=width, label=name, zorder=2)
    step = max(1, ceil(len(track.seq) / _ELLIPSES))
    for row in range(0, len(track.seq), step):
        outline = track.place_m[row] + ellipse_outline(track.covariance[row, :2, :2], SIGMAS)
        axes.plot(*outline.T, color=_ESTIMATE, linewidth=0.7, alpha=0.8, zorder=3)
    start = record.cfg.start
    axes.plot(start.x_m, start.y_m, "o", color=INK, markersize=6, zorder=4, label="start")


def _draw_waypoints(axes: "Axes", record: BeaconRecord, width_px: float) -> None:
    if record.cfg.follow.is_active:
        return
    waypoints = np.array(record.cfg.workspace.waypoints_m)
    reached = {arrival.waypoint for arrival in record.arrivals}
    look: dict[str, Any] = {"markersize": 9, "fillstyle": "none", "markeredgewidth": 1.3, "zorder": 4}
    for name, colour, is_reached in (("waypoint reached", GOOD, True), ("waypoint, not reached", BAD, False)):
        some = [at for at in range(len(waypoints)) if (at in reached) is is_reached]
        if some:
            (rings,) = axes.plot(*waypoints[some].T, "o", color=colour, label=name, **look)
            if is_wide(width_px):
                add_tooltips(rings, [f"waypoint {at + 1}" for at in some])
    for at, place in enumerate(waypoints):
        axes.annotate(f"{at + 1}", place, xytext=(6, -12), textcoords="offset points", fontsize=8, color=QUIET)


def _draw_beacons(axes: "Axes", record: BeaconRecord, right_m: float) -> None:
    beacons = record.beacons
    for ellipse in beacons.values():
        axes.plot(*_beacon_outline(ellipse).T, color=_BEACON, linewidth=0.9, zorder=5)
    true = np.array(list(record.places.values())).reshape(-1, 2)
    if len(true):
        axes.plot(*true.T, "x", color=INK, markersize=7, zorder=6, label="true place of a beacon")
    places = np.array([ellipse[:2] for ellipse in beacons.values()]).reshape(-1, 2)
    if len(places):
        look: dict[str, Any] = {"markersize": 5, "markeredgecolor": PAPER, "markeredgewidth": 0.4, "zorder": 7}
        for index, (name, place) in enumerate(zip(beacons, places, strict=True)):
            label = "_" if index else "beacon as mapped, 3 \u03c3"
            (dot,) = axes.plot(*place, "o", color=_BEACON, label=label, **look)
            add_tooltips(dot, [name])
    for name, (x, y) in zip(beacons, places.tolist(), strict=True):
        is_left = x > right_m
        axes.annotate(
            name, (x, y), xytext=(-6 if is_left else 6, 5), textcoords="offset points", fontsize=8, color=INK, zorder=8,
            ha="right" if is_left else "left", parse_math=False,
        )  # fmt: skip
    target = record.maps[-1].target if record.maps else None
    if target is not None:
        axes.plot(*_beacon_outline(target).T, color=_TARGET, linewidth=0.9, zorder=5)
        axes.plot(target[0], target[1], "o", color=_TARGET, markersize=6, zorder=7, label="target at the end, 3 \u03c3")
