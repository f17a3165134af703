"""A mission among beacons over time: errors with three sigma, consistency, map, distance to the target.

The room of a mission among beacons: path, beacons with their ellipses, waypoints, the truth where known.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import ceil, floor, log10
from typing import NamedTuple

import numpy as np

from ccatp.core import FloatArray
from ccatp.report.drawing import (
    BAD,
    CHARACTER,
    GOOD,
    INK,
    PANEL,
    PATH,
    QUIET,
    SEAM,
    SERIES,
    Area,
    Dots,
    Drawing,
    Plot,
    PlotAxis,
    PolyLine,
    Shape,
    TextShape,
    envelope,
    legend,
    thinned,
)
from ccatp.report.html import NARROW
from ccatp.report.record import BeaconRecord, pose_errors_m, pose_nees, readings_of

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


def beacon_error_figure(record: BeaconRecord, width: float) -> Drawing:
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


def map_error_figure(record: BeaconRecord, width: float) -> Drawing | None:
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


def consistency_figure(record: BeaconRecord, width: float) -> Drawing | None:
    """NIS of the readings and NEES of the pose, each by its degrees of freedom: 1 is expected. None without either."""
    readings, nees = readings_of(record), pose_nees(record)
    if not readings and nees is None:
        return None
    plot = _plot(width, *_span(record), PlotAxis(0.0, _TOP, *_vertical(width)))
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


def target_figure(record: BeaconRecord, width: float) -> Drawing | None:
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
    plot = _plot(width, *_span(record), PlotAxis(0.0, 1.05 * top, *_vertical(width)))
    plot.frame("robot time, min", "m")
    plot.level(safe_m, BAD)
    for curve in curves:
        plot.line(curve.t_s / 60.0, curve.values, curve.colour, 1.5, curve.dash)
    entries = [(curve.name, curve.colour) for curve in curves]
    return _with_legend(plot, [*entries, ("to be kept", BAD)], width, "distance to the target over time")


def _logarithmic(curves: Sequence[Curve], label: str, width: float, title: str) -> Drawing:
    values = np.concatenate([curve.values for curve in curves])
    values = values[np.isfinite(values) & (values > 0.0)]
    low, high = (float(np.percentile(values, 1)), float(values.max())) if len(values) else (1.0, 10.0)
    ends = 10.0 ** floor(log10(low)), 10.0 ** ceil(log10(high * 1.05))
    times = np.concatenate([curve.t_s for curve in curves])
    span = (float(times.min()), float(times.max())) if len(times) else (0.0, 60.0)
    plot = _plot(width, *span, PlotAxis(*ends, *_vertical(width), is_logarithmic=True))
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


def _plot(width: float, begin_s: float, end_s: float, y: PlotAxis) -> Plot:
    left, right = 62.0, width - 12.0
    x = PlotAxis(begin_s / 60.0, max(end_s, begin_s + 1.0) / 60.0, left, right)
    return Plot(left, y.end, right, y.start, x, y, 11.5 if width > NARROW else 10.5)


def _with_legend(plot: Plot, entries: Sequence[tuple[str, str]], width: float, title: str) -> Drawing:
    shapes, height = legend(12.0, plot.bottom + 56.0, entries, plot.size, width - 24.0)
    return Drawing(width, plot.bottom + 48.0 + height, (*plot.shapes, *shapes), title)


_MARGIN_M, _BEYOND_M = 0.25, 1.5  # around the room; of it what stands outside is still shown
_ELLIPSES = 14  # along the path
_CORNERS = 48  # of an ellipse
_TOLERANCE_PX = 0.5
_TALL = 0.95  # most height for the width
_BEACON, _TARGET, _ESTIMATE, _RECKONED = SERIES[0], BAD, SERIES[1], SERIES[4]
_KEY_LINE = np.array([(-9.0, 0.0), (9.0, 0.0)])


def ellipse_m(place_m: FloatArray, covariance_m2: FloatArray, sigmas: float = SIGMAS) -> FloatArray:
    """Outline of an ellipse of so many standard deviations, shape (k, 2).

    Args:
        place_m: shape (2,).
        covariance_m2: shape (2, 2).
    """
    values, vectors = np.linalg.eigh(covariance_m2)
    angles = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    return np.asarray(place_m + sigmas * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


@dataclass(slots=True)
class _Room:
    """The room on a picture: x to the right, y up, metres beside it."""

    width: float
    low: FloatArray
    high: FloatArray
    shapes: list[Shape] = field(default_factory=list)
    keys: list[tuple[str, Shape]] = field(default_factory=list)
    plot: Plot = field(init=False)

    def __post_init__(self) -> None:
        span = self.high - self.low
        left, right, top = 46.0, self.width - 12.0, 8.0
        scale = min((right - left) / span[0], _TALL * self.width / span[1])
        x = PlotAxis(float(self.low[0]), float(self.high[0]), left, left + scale * float(span[0]))
        bottom = top + scale * float(span[1])
        y = PlotAxis(float(self.low[1]), float(self.high[1]), bottom, top)
        self.plot = Plot(left, top, x.end, bottom, x, y, 11.5 if self.is_wide else 10.5)

    @property
    def is_wide(self) -> bool:
        return self.width > NARROW

    def pixels(self, points_m: FloatArray) -> FloatArray:
        points = np.asarray(points_m, dtype=np.float64).reshape(-1, 2)
        return np.column_stack([self.plot.x.pixels(points[:, 0]), self.plot.y.pixels(points[:, 1])])

    def line(self, name: str, points_m: FloatArray, colour: str, width: float, dash: tuple[float, ...] = ()) -> None:
        """A path with its key; where nothing is known of it, none."""
        if np.isfinite(points_m).all(axis=1).sum() < 2:
            return
        self.shapes.append(PolyLine(thinned(self.pixels(points_m), _TOLERANCE_PX), colour, width, dash))
        self.keys.append((name, PolyLine(_KEY_LINE, colour, width + 0.6, dash)))

    def dots(self, name: str, places_m: FloatArray, dots: Dots) -> None:
        if len(places_m) == 0:
            return
        one = Dots(np.zeros((1, 2)), min(dots.radius, 4.5), dots.colour, dots.mark, edge=dots.edge)
        self.shapes.append(Dots(self.pixels(places_m), dots.radius, dots.colour, dots.mark, dots.titles, dots.edge))
        self.keys.append((name, one))

    def finish(self, title: str) -> Drawing:
        self.plot.frame("x, m", "y, m")
        y = self.plot.bottom + 54.0
        keys, height = _legend(self.keys, y, self.plot.size, self.width)
        return Drawing(self.width, y + height, (*self.plot.shapes, *self.shapes, *keys), title)


def beacon_map_figure(record: BeaconRecord, width: float) -> Drawing:
    """Draw the map."""
    room = _Room(width, *_bounds(record))
    _draw_room(room, record)
    _draw_paths(room, record)
    _draw_waypoints(room, record)
    _draw_beacons(room, record)
    return room.finish(f"{record.cfg.system}: path and map of beacons")


def _bounds(record: BeaconRecord) -> tuple[FloatArray, FloatArray]:
    size = np.array(record.cfg.workspace.size_m)
    places = [np.zeros((1, 2)), size[None]]
    for x, y, xx, xy, yy in record.beacons.values():
        places.append(ellipse_m(np.array([x, y]), np.array(((xx, xy), (xy, yy)))))
    places += [np.array([place]) for place in record.places.values()]
    if record.truth is not None:
        places += [record.truth.place_m, record.truth.target_m]
    points = np.concatenate(places)
    points = points[np.isfinite(points).all(axis=1)]
    low, high = np.maximum(points.min(axis=0), -_BEYOND_M), np.minimum(points.max(axis=0), size + _BEYOND_M)
    return low - _MARGIN_M, high + _MARGIN_M


def _draw_room(room: _Room, record: BeaconRecord) -> None:
    width_m, depth_m = record.cfg.workspace.size_m
    corners = np.array([(0.0, 0.0), (width_m, 0.0), (width_m, depth_m), (0.0, depth_m)])
    room.shapes.append(Area(room.pixels(corners), fill=PANEL, colour=SEAM, width=1.2))
    obstacles = record.cfg.sim.obstacles if record.is_simulation else ()
    for obstacle in obstacles:
        outline = ellipse_m(np.array([obstacle.x_m, obstacle.y_m]), np.eye(2) * obstacle.radius_m**2, 1.0)
        room.shapes.append(Area(room.pixels(outline), fill=SEAM, colour=QUIET, width=1.0))
    if obstacles:
        room.keys.append(("obstacle", Dots(np.zeros((1, 2)), 4.5, SEAM, edge=QUIET)))


def _draw_paths(room: _Room, record: BeaconRecord) -> None:
    track = record.track
    thick = 1.6 if room.is_wide else 1.1
    room.line("dead reckoning alone", track.reckoned_m, _RECKONED, 0.8 * thick, (2.0, 3.0))
    if record.truth is not None:
        room.line("true path", record.truth.place_m, PATH, 1.6 * thick)
        room.line("true path of the target", record.truth.target_m, _TARGET, 0.7 * thick, (5.0, 3.0))
    room.line("estimated path", track.place_m, _ESTIMATE, thick)
    step = max(1, ceil(len(track.seq) / _ELLIPSES))
    for row in range(0, len(track.seq), step):
        outline = ellipse_m(track.place_m[row], track.covariance[row, :2, :2])
        room.shapes.append(Area(room.pixels(outline), colour=_ESTIMATE, width=0.8, opacity=0.8))
    start = np.array([[record.cfg.start.x_m, record.cfg.start.y_m]])
    room.dots("start", start, Dots(start, 4.5, INK))


def _draw_waypoints(room: _Room, record: BeaconRecord) -> None:
    if record.cfg.follow.is_active:
        return
    waypoints = np.array(record.cfg.workspace.waypoints_m)
    reached = {arrival.waypoint for arrival in record.arrivals}
    for name, colour, is_reached in (("waypoint reached", GOOD, True), ("waypoint, not reached", BAD, False)):
        some = [at for at in range(len(waypoints)) if (at in reached) is is_reached]
        titles = tuple(f"waypoint {at + 1}" for at in some)
        room.dots(name, waypoints[some], Dots(waypoints[some], 6.0, colour, "ring", titles if room.is_wide else ()))
    for at, (x, y) in enumerate(room.pixels(waypoints).tolist()):
        room.shapes.append(TextShape(x + 8.0, y + 14.0, str(at + 1), room.plot.size, QUIET))


def _draw_beacons(room: _Room, record: BeaconRecord) -> None:
    beacons = record.beacons
    for x, y, xx, xy, yy in beacons.values():
        outline = ellipse_m(np.array([x, y]), np.array(((xx, xy), (xy, yy))))
        room.shapes.append(Area(room.pixels(outline), colour=_BEACON, width=1.2))
    true = np.array(list(record.places.values())).reshape(-1, 2)
    room.dots("true place of a beacon", true, Dots(true, 4.5, INK, "cross"))
    places = np.array([ellipse[:2] for ellipse in beacons.values()]).reshape(-1, 2)
    room.dots("beacon as mapped, 3 \u03c3", places, Dots(places, 3.6, _BEACON, titles=tuple(beacons)))
    for name, (x, y) in zip(beacons, room.pixels(places).tolist(), strict=True):
        is_left = x > room.plot.right - 60.0
        room.shapes.append(
            TextShape(x + (-7.0 if is_left else 7.0), y - 6.0, name, room.plot.size, INK, "end" if is_left else "start")
        )
    target = record.maps[-1].target if record.maps else None
    if target is not None:
        place = np.array([target[:2]])
        outline = ellipse_m(place[0], np.array(((target[2], target[3]), (target[3], target[4]))))
        room.shapes.append(Area(room.pixels(outline), colour=_TARGET, width=1.2))
        room.dots("target at the end, 3 \u03c3", place, Dots(place, 4.0, _TARGET))


def _legend(keys: list[tuple[str, Shape]], y: float, size: float, width: float) -> tuple[list[Shape], float]:
    """What each mark means, in lines that fit; and the height of them all."""
    shapes: list[Shape] = []
    at, line = 20.0, y
    for name, key in keys:
        length = 26.0 + CHARACTER * size * len(name) + 12.0
        if at + length > width and at > 20.0:
            at, line = 20.0, line + 1.7 * size
        shapes += [_moved(key, at, line - 0.35 * size), TextShape(at + 15.0, line, name, size, INK)]
        at += length
    return shapes, line - y + 1.8 * size


def _moved(key: Shape, x: float, y: float) -> Shape:
    offset = np.array((x, y))
    if isinstance(key, PolyLine):
        return PolyLine(key.points + offset, key.colour, key.width, key.dash)
    if isinstance(key, Dots):
        return Dots(key.places + offset, key.radius, key.colour, key.mark, edge=key.edge)
    return key
