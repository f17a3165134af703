"""Pure. The room of a mission among beacons: path, beacons with their ellipses, waypoints, the truth where known."""

from dataclasses import dataclass, field
from math import ceil

import numpy as np

from ccatp.drawing.axes import CHARACTER, Axis, Plot
from ccatp.drawing.colours import BAD, GOOD, INK, PANEL, PATH, QUIET, SEAM, SERIES
from ccatp.drawing.shapes import Area, Dots, FloatArray, Line, Picture, Shape, Text
from ccatp.drawing.thinning import thinned
from ccatp.reporting.beacon_record import BeaconRecord
from ccatp.reporting.html import NARROW

SIGMAS = 3.0
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
        sigmas: half axes in standard deviations.
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
        x = Axis(float(self.low[0]), float(self.high[0]), left, left + scale * float(span[0]))
        bottom = top + scale * float(span[1])
        y = Axis(float(self.low[1]), float(self.high[1]), bottom, top)
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
        self.shapes.append(Line(thinned(self.pixels(points_m), _TOLERANCE_PX), colour, width, dash))
        self.keys.append((name, Line(_KEY_LINE, colour, width + 0.6, dash)))

    def dots(self, name: str, places_m: FloatArray, dots: Dots) -> None:
        """Marks with their key."""
        if len(places_m) == 0:
            return
        one = Dots(np.zeros((1, 2)), min(dots.radius, 4.5), dots.colour, dots.mark, edge=dots.edge)
        self.shapes.append(Dots(self.pixels(places_m), dots.radius, dots.colour, dots.mark, dots.titles, dots.edge))
        self.keys.append((name, one))

    def finish(self, title: str) -> Picture:
        """Room behind, keys below."""
        self.plot.frame("x, m", "y, m")
        y = self.plot.bottom + 54.0
        keys, height = _legend(self.keys, y, self.plot.size, self.width)
        return Picture(self.width, y + height, (*self.plot.shapes, *self.shapes, *keys), title)


def beacon_map_figure(record: BeaconRecord, width: float) -> Picture:
    """Draw the map.

    Args:
        record: the mission.
        width: of the picture, pixels.
    """
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
        room.shapes.append(Text(x + 8.0, y + 14.0, str(at + 1), room.plot.size, QUIET))


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
            Text(x + (-7.0 if is_left else 7.0), y - 6.0, name, room.plot.size, INK, "end" if is_left else "start")
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
        shapes += [_moved(key, at, line - 0.35 * size), Text(at + 15.0, line, name, size, INK)]
        at += length
    return shapes, line - y + 1.8 * size


def _moved(key: Shape, x: float, y: float) -> Shape:
    offset = np.array((x, y))
    if isinstance(key, Line):
        return Line(key.points + offset, key.colour, key.width, key.dash)
    if isinstance(key, Dots):
        return Dots(key.places + offset, key.radius, key.colour, key.mark, edge=key.edge)
    return key
