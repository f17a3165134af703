"""Pure. A mission among beacons over time: errors with three sigma, consistency, map, distance to the target."""

from collections.abc import Sequence
from math import ceil, floor, log10
from typing import NamedTuple

import numpy as np

from ccatp.drawing.axes import Axis, Plot, legend
from ccatp.drawing.colours import BAD, QUIET, SERIES
from ccatp.drawing.shapes import Dots, FloatArray, Picture
from ccatp.drawing.thinning import envelope
from ccatp.reporting.beacon_record import BeaconRecord, pose_errors_m, pose_nees, readings_of
from ccatp.reporting.html import NARROW

SIGMAS = 3.0
_POSE_STATES = 3
_MILLI = 1e3
_TOP = 6.0  # of the figure of consistency: what lies above is drawn at its edge
_DOTTED = (5.0, 4.0)


class Curve(NamedTuple):
    """One series of a figure, shapes (k,)."""

    name: str
    t_s: FloatArray
    values: FloatArray
    colour: str
    dash: tuple[float, ...] = ()


def beacon_error_figure(record: BeaconRecord, width: float) -> Picture:
    """Error of the position, its three sigma, and what dead reckoning alone would err; mm, logarithmic."""
    track = record.track
    curves = []
    errors = pose_errors_m(record)
    if errors is not None and record.truth is not None:
        off = np.hypot(*(track.reckoned_m - record.truth.place_m).T)
        curves.append(Curve("dead reckoning alone", track.t_s, _MILLI * off, SERIES[4], (2.0, 3.0)))
    curves.append(Curve("3 \u03c3 of the estimate", track.t_s, SIGMAS * _MILLI * track.sigma_m, SERIES[1], _DOTTED))
    if errors is not None:
        curves.append(Curve("true error", track.t_s, _MILLI * errors, SERIES[0]))
    return _logarithmic(curves, "mm", width, "localization error over time")


def map_error_figure(record: BeaconRecord, width: float) -> Picture | None:
    """Root of the mean square error of the beacons, expected and true, against time; None without a map."""
    times, expected, true = list[float](), list[float](), list[float]()
    for told in record.maps:
        beacons = record.standing(told)
        if not beacons:
            continue
        times.append(told.t_s)
        expected.append(float(np.mean([xx + yy for _, _, xx, _, yy in beacons.values()])) ** 0.5)
        squares = [
            (x - record.places[name][0]) ** 2 + (y - record.places[name][1]) ** 2
            for name, (x, y, *_) in beacons.items()
            if name in record.places
        ]
        true.append(float(np.mean(squares)) ** 0.5 if squares else float("nan"))
    if len(times) < 2:
        return None
    t_s = np.array(times)
    curves = [Curve("expected", t_s, _MILLI * np.array(expected), SERIES[1], _DOTTED)]
    if np.isfinite(true).any():
        curves.append(Curve("true error", t_s, _MILLI * np.array(true), SERIES[0]))
    return _logarithmic(curves, "mm, rms of a place", width, "error of the map over time")


def consistency_figure(record: BeaconRecord, width: float) -> Picture | None:
    """NIS of the readings and NEES of the pose, each by its degrees of freedom: 1 is expected. None without either."""
    readings, nees = readings_of(record), pose_nees(record)
    if not readings and nees is None:
        return None
    plot = _plot(width, *_span(record), Axis(0.0, _TOP, *_vertical(width)))
    plot.frame("robot time, min", "for each degree of freedom")
    plot.level(1.0, QUIET)
    entries = []
    if readings:
        t_s = np.array([reading.t_s for reading in readings]) / 60.0
        values = np.array([reading.nis / reading.size for reading in readings])
        places = np.column_stack([plot.x.pixels(t_s), plot.y.pixels(np.minimum(values, _TOP))])
        plot.shapes.append(Dots(places, 1.8, SERIES[2]))
        entries.append(("NIS of the readings", SERIES[2]))
        sums = np.cumsum([reading.nis for reading in readings]) / np.cumsum([reading.size for reading in readings])
        plot.line(t_s, sums, SERIES[0], 1.8)
        entries.append(("mean NIS so far", SERIES[0]))
    if nees is not None:
        known = np.isfinite(nees) & (record.track.t_s >= record.settled_s)
        thin = envelope(record.track.t_s[known] / 60.0, nees[known] / _POSE_STATES, int(width))
        plot.line(thin.x, np.minimum(thin.mean, _TOP), SERIES[1], 1.2)
        entries.append(("NEES of the pose", SERIES[1]))
    return _with_legend(plot, entries, width, "consistency over time")


def target_figure(record: BeaconRecord, width: float) -> Picture | None:
    """Distance to the radio that is followed, by the estimate and in truth; None where none is followed."""
    if not record.cfg.follow.is_active:
        return None
    told = [one for one in record.maps if one.target is not None]
    curves = []
    if record.truth is not None:
        off = np.hypot(*(record.truth.target_m - record.truth.place_m).T)
        curves.append(Curve("true distance", record.track.t_s, off, SERIES[0]))
    if told:
        t_s = np.array([one.t_s for one in told])
        off = np.array(
            [np.hypot(one.target[0] - one.pose[0], one.target[1] - one.pose[1]) for one in told if one.target]
        )
        curves.append(Curve("estimated distance", t_s, off, SERIES[1], _DOTTED))
    curves = [curve for curve in curves if np.isfinite(curve.values).any()]
    if not curves:
        return None
    safe_m = record.cfg.follow.safe_distance_m
    top = max(1.5 * safe_m, *(float(np.nanmax(curve.values)) for curve in curves))
    plot = _plot(width, *_span(record), Axis(0.0, 1.05 * top, *_vertical(width)))
    plot.frame("robot time, min", "m")
    plot.level(safe_m, BAD)
    for curve in curves:
        plot.line(curve.t_s / 60.0, curve.values, curve.colour, 1.5, curve.dash)
    entries = [(curve.name, curve.colour) for curve in curves]
    return _with_legend(plot, [*entries, ("to be kept", BAD)], width, "distance to the target over time")


def _logarithmic(curves: Sequence[Curve], label: str, width: float, title: str) -> Picture:
    values = np.concatenate([curve.values for curve in curves])
    values = values[np.isfinite(values) & (values > 0.0)]
    low, high = (float(np.percentile(values, 1)), float(values.max())) if len(values) else (1.0, 10.0)
    ends = 10.0 ** floor(log10(low)), 10.0 ** ceil(log10(high * 1.05))
    times = np.concatenate([curve.t_s for curve in curves])
    span = (float(times.min()), float(times.max())) if len(times) else (0.0, 60.0)
    plot = _plot(width, *span, Axis(*ends, *_vertical(width), is_logarithmic=True))
    plot.frame("robot time, min", label)
    for curve in curves:
        known = np.isfinite(curve.values)
        seen = envelope(curve.t_s[known] / 60.0, np.maximum(curve.values[known], ends[0]), int(width))
        plot.line(seen.x, seen.mean, curve.colour, 1.5, curve.dash)
    return _with_legend(plot, [(curve.name, curve.colour) for curve in reversed(curves)], width, title)


def _span(record: BeaconRecord) -> tuple[float, float]:
    t_s = record.track.t_s
    return (float(t_s[0]), float(t_s[-1])) if len(t_s) else (0.0, 60.0)


def _vertical(width: float) -> tuple[float, float]:
    return (260.0 if width > NARROW else 220.0), 10.0


def _plot(width: float, begin_s: float, end_s: float, y: Axis) -> Plot:
    left, right = 62.0, width - 12.0
    x = Axis(begin_s / 60.0, max(end_s, begin_s + 1.0) / 60.0, left, right)
    return Plot(left, y.end, right, y.start, x, y, 11.5 if width > NARROW else 10.5)


def _with_legend(plot: Plot, entries: Sequence[tuple[str, str]], width: float, title: str) -> Picture:
    shapes, height = legend(12.0, plot.bottom + 56.0, entries, plot.size, width - 24.0)
    return Picture(width, plot.bottom + 48.0 + height, (*plot.shapes, *shapes), title)
