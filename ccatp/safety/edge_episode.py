"""One edge sensor that is off the panels: where it went off, how far it has moved since, and whether it is at an edge.

An episode is the time from the first "off" of a sensor until it is safely back on a panel.
"""

from enum import Enum, auto
from math import cos, hypot, sin, sqrt
from typing import NamedTuple

from ccatp.conditions import Condition
from ccatp.conditions.danger import (
    BEYOND_SEAM,
    NO_SEAM,
    OFF_WITHOUT_WHEELS,
    RIM_AHEAD,
)
from ccatp.config.models import DangerConfig
from ccatp.safety.edge_map import Axis, EdgeMap, Place
from ccatp.safety.wheel_odometry import Odometry

# Length over which the direction of a sensor's motion is computed: far above the encoder noise at rest (1e-5 m per
# minute), far below every limit of the rules.
DIRECTION_TRAVEL_M = 2e-4
# Below this cosine the direction of motion does not show from which side a sensor came to a seam.
MIN_SIDE_COSINE = 0.3
# A sensor that stays on for this many times ``clear_samples`` is on a panel, even if it does not move.
LONG_ON = 10


class EdgePhase(Enum):
    """How the map explains an episode."""

    FRESH = auto()  # the sensor has not moved since it went off
    SEAM = auto()  # the map explains it by a seam
    NO_MAP = auto()  # the map does not explain it
    RIM = auto()  # the map has the rim ahead


class EdgeLimits:
    """The limits of the edge rule."""

    def __init__(self, gap_m: float, cfg: DangerConfig) -> None:
        self.sigmas = cfg.map_sigmas
        self.margin_m = cfg.map_margin_m
        self.tolerance_m = cfg.gap_tolerance_m
        self.extra_m = cfg.seam_extra_m
        self.no_map_m = cfg.no_map_travel_m
        self.turn_m = cfg.turn_travel_limit_m
        self.width_m = width = gap_m + cfg.gap_tolerance_m
        # A narrow seam may be crossed at a larger angle, because the limit is the length that the sensor travels.
        self.min_cosine = min(cos(cfg.max_crossing_angle_rad), width / cfg.slanted_crossing_m)
        # Where two seams cross, a path oblique to one is steep to the other. A crossing of both is never longer than
        # the sum of the two chords.
        self.crossing_m = width / self.min_cosine + width / sqrt(1.0 - self.min_cosine**2) + cfg.seam_extra_m
        self.outward_turn_m = cfg.outward_turn_limit_m
        self.debounce = cfg.debounce_samples
        self.clear = cfg.clear_samples


class EpisodeStart(NamedTuple):
    """Where an episode began, in the frame of the odometry: robot and sensor, m, and heading."""

    robot: Place
    sensor: Place
    heading_rad: float


class OnMap(NamedTuple):
    """Where the sensor went off on the map: its place there, and the turn from the odometry's frame to the deck."""

    place: Place
    cos: float
    sin: float
    sigma_m: float


class EpisodeTravel(NamedTuple):
    """Displacements of sensor and robot since the start, m; deck frame, without a place on the map the odometry's."""

    sensor: Place
    robot: Place


class Departure(NamedTuple):
    """How the sensor left the panel: unit vector of its motion, and the sign of the robot's turn.

    ``is_by_turn``: the turn, not the robot's translation, led there.
    """

    direction: Place
    is_by_turn: bool
    turn_sign: float


class SeamCrossing(NamedTuple):
    """A seam that the sensor crosses; ``begin``: from where its travel counts.

    ``axis``: deck coordinate that is constant along the seam; ``side``: sign of the motion along it, 0: unknown.
    """

    axis: Axis
    side: float
    begin: EpisodeTravel
    is_second: bool = False


class FoundEdge(NamedTuple):
    """An edge: the rule that found it, and the travel that exceeded its limit, m."""

    cause: Condition
    value_m: float
    limit_m: float


_NO_TRAVEL = EpisodeTravel((0.0, 0.0), (0.0, 0.0))


class EdgeEpisode:
    """One episode of one sensor. Places are in the frame of the odometry unless they are called map places.

    ``offset_m``: the sensor's place in the robot frame; ``step_m``: how far it moves between two samples (the detection
    may be late by this distance). Less translation than ``half_base_m`` per radian counts as a turn in place.
    ``edge``: what was declared, or ``None``. ``retreat_m``: how far the sensor has moved since then while off.
    """

    def __init__(
        self,
        limits: EdgeLimits,
        edge_map: EdgeMap,
        odometry: Odometry,
        offset_m: Place,
        *,
        step_m: float,
        half_base_m: float,
    ) -> None:
        self._limits = limits
        self._map = edge_map
        self._radius_m = hypot(*offset_m)
        self._step_m = step_m
        self._half_base_m = half_base_m
        self._start = _start(odometry, offset_m)
        self._on_map: OnMap | None = None
        # The newest sample off.
        self._place = self._start.sensor
        self._heading_rad = self._start.heading_rad
        self._travel = _NO_TRAVEL
        self._looked_at = _NO_TRAVEL.sensor
        self._off_samples = 0
        # The samples on since then.
        self._on_place = self._start.sensor
        self._on_samples = 0
        # What is known once the sensor has moved.
        self.phase = EdgePhase.FRESH
        self._departure: Departure | None = None
        self._seam: SeamCrossing | None = None
        # What is known once an edge is declared.
        self.edge: FoundEdge | None = None
        self._declared_heading_rad = self._start.heading_rad
        self._retreat_from = self._start.sensor
        self._is_turn_spent = False
        self.retreat_m = 0.0
        self.is_suspect = False

    def place_on_map(self, place: Place, deck_heading_rad: float, sigma_m: float) -> None:
        """Set the sensor's place on the map, the robot's deck heading and the standard deviation of the estimate."""
        turn = deck_heading_rad - self._start.heading_rad
        self._on_map = OnMap(place, cos(turn), sin(turn), sigma_m)

    @property
    def needs_map(self) -> bool:
        """Whether the sensor has no place on the map and has not moved since it went off."""
        return self.phase is EdgePhase.FRESH and self._on_map is None

    @property
    def is_on(self) -> bool:
        """Whether the last sample was "on"; the episode may be about to end."""
        return self._on_samples > 0

    @property
    def is_from_turn(self) -> bool:
        """Whether a turn of the robot, not its translation, led the sensor off the panel."""
        return self._departure is not None and self._departure.is_by_turn

    @property
    def permits_turn(self) -> bool:
        """Whether the robot may turn. At a declared edge: only when a turn led there, to turn back."""
        return self.edge is None or (self.is_from_turn and not self._is_turn_spent)

    # -- samples --------------------------------------------------------------------------------------------------

    def see_on(self, place: Place) -> bool:
        """Take an "on" sample at ``place``. Returns whether the episode is over."""
        if self._on_samples == 0:
            self._on_place = place
        self._on_samples += 1
        if self._on_samples < self._limits.clear:
            return False
        if self.edge is not None or self._on_samples >= LONG_ON * self._limits.clear:
            return True
        return hypot(place[0] - self._on_place[0], place[1] - self._on_place[1]) >= self._limits.no_map_m

    def see_off(self, odometry: Odometry, place: Place, worst_m: float) -> bool:
        """Take an "off" sample; whether it declares an edge. ``worst_m``: largest unmeasured travel, rule (g)."""
        self._off_samples += 1
        self._on_samples = 0
        self._place = place
        self._heading_rad = odometry.heading_rad
        if self.edge is not None:
            self._watch_retreat()
            return False
        edge = self._judge_silence(worst_m)
        if edge is None:
            self._travel = self._travel_of(odometry, place)
            if self.phase is EdgePhase.FRESH:
                self._classify()
            edge = self._judge()
        if edge is None:
            return False
        second = self._second_seam() if edge.cause is BEYOND_SEAM else None
        if second is not None:
            self._seam = second
            return False
        self._declare(edge)
        return True

    def look_ahead(self) -> bool:
        """Apply rule (a) along the motion since the last call. Returns whether it declares an edge."""
        on_map, now, before = self._on_map, self._travel.sensor, self._looked_at
        dx, dy = now[0] - before[0], now[1] - before[1]
        length = hypot(dx, dy)
        if self._on_samples or on_map is None or length < DIRECTION_TRAVEL_M:
            return False
        self._looked_at = now
        if not self._is_rim_ahead(on_map, (dx / length, dy / length)):
            return False
        self.phase = EdgePhase.RIM
        if self._off_samples < self._limits.debounce:
            return False
        self._declare(self._judge_rim())
        return True

    def confirm(self) -> None:
        """A fix confirms that the sensor is correct: measure the retreat again, from here."""
        self._retreat_from = self._place
        self.retreat_m = 0.0
        self.is_suspect = False

    def _declare(self, edge: FoundEdge) -> None:
        self.edge = edge
        self._declared_heading_rad = self._heading_rad
        self._retreat_from = self._place

    def _watch_retreat(self) -> None:
        """Update how far the sensor has moved since the edge was declared, and whether the robot turned on outwards."""
        x, y = self._retreat_from
        self.retreat_m = hypot(self._place[0] - x, self._place[1] - y)
        if self._departure is not None:
            outward_rad = self._departure.turn_sign * (self._heading_rad - self._declared_heading_rad)
            self._is_turn_spent = self._is_turn_spent or outward_rad * self._radius_m > self._limits.outward_turn_m

    # -- what the map shows ---------------------------------------------------------------------------------------

    def _travel_of(self, odometry: Odometry, place: Place) -> EpisodeTravel:
        start, on_map = self._start, self._on_map
        c, s = (1.0, 0.0) if on_map is None else (on_map.cos, on_map.sin)
        dx, dy = place[0] - start.sensor[0], place[1] - start.sensor[1]
        sensor = c * dx - s * dy, s * dx + c * dy
        dx, dy = odometry.x_m - start.robot[0], odometry.y_m - start.robot[1]
        return EpisodeTravel(sensor, (c * dx - s * dy, s * dx + c * dy))

    def _classify(self) -> None:
        """Find out, once the sensor has moved, how it left the panel and how the map explains it."""
        (mx, my), on_map = self._travel.sensor, self._on_map
        length = hypot(mx, my)
        if length < DIRECTION_TRAVEL_M:
            return
        turned = self._heading_rad - self._start.heading_rad
        is_by_turn = hypot(*self._travel.robot) < abs(turned) * self._half_base_m
        self._departure = departure = Departure((mx / length, my / length), is_by_turn, 1.0 if turned >= 0.0 else -1.0)
        self.phase = EdgePhase.NO_MAP
        if on_map is None:
            return
        if self._is_rim_ahead(on_map, departure.direction):
            self.phase = EdgePhase.RIM
            return
        seam = self._map.seam_at(on_map.place, self._slack_m(on_map))
        if seam is not None:
            self.phase = EdgePhase.SEAM
            self._seam = SeamCrossing(seam.axis, _side(departure, seam.axis), _NO_TRAVEL)

    def _slack_m(self, on_map: OnMap) -> float:
        """Allowance across a seam, m. ``extra_m`` covers the heading's error: 3 mm are 1.3 deg at a corner sensor."""
        limits = self._limits
        return limits.tolerance_m + limits.extra_m + limits.sigmas * on_map.sigma_m + self._step_m

    def _here(self, on_map: OnMap) -> Place:
        """The sensor's map place now."""
        return on_map.place[0] + self._travel.sensor[0], on_map.place[1] + self._travel.sensor[1]

    def _is_rim_ahead(self, on_map: OnMap, direction: Place) -> bool:
        limits = self._limits
        here = self._here(on_map)
        return self._map.is_rim_ahead(here, direction, limits.margin_m, limits.sigmas * on_map.sigma_m)

    def _second_seam(self) -> SeamCrossing | None:
        """Where two seams cross, a sensor may leave one seam along the other. Once per episode this is not an edge."""
        seam, on_map = self._seam, self._on_map
        if seam is None or seam.is_second or on_map is None or hypot(*self._travel.robot) > self._limits.crossing_m:
            return None
        other = self._map.seam_at(self._here(on_map), self._slack_m(on_map), not_axis=seam.axis)
        return None if other is None else SeamCrossing(other.axis, 0.0, self._travel, is_second=True)

    # -- rules: each judges the newest sample off, and changes nothing ---------------------------------------------

    def _judge_silence(self, worst_m: float) -> FoundEdge | None:
        """Rule (g)."""
        limit_m = self._limits.no_map_m
        return FoundEdge(OFF_WITHOUT_WHEELS, worst_m, limit_m) if worst_m > limit_m else None

    def _judge(self) -> FoundEdge | None:
        """Rules (a) to (c)."""
        departure = self._departure
        if departure is None or self._off_samples < self._limits.debounce:
            return None
        if self.phase is EdgePhase.RIM:
            return self._judge_rim()
        if self._seam is not None:
            return self._judge_seam(departure, self._seam)
        return self._judge_no_map(departure)

    def _judge_rim(self) -> FoundEdge:
        """Rule (a)."""
        return FoundEdge(RIM_AHEAD, hypot(*self._travel.sensor), 0.0)

    def _judge_no_map(self, departure: Departure) -> FoundEdge | None:
        """Rule (c): motion back to where the sensor was on adds no travel."""
        (ux, uy), (mx, my), limit_m = departure.direction, self._travel.sensor, self._limits.no_map_m
        travel_m = hypot(max(ux * mx + uy * my, 0.0), ux * my - uy * mx)
        return FoundEdge(NO_SEAM, travel_m, limit_m) if travel_m > limit_m else None

    def _judge_seam(self, departure: Departure, seam: SeamCrossing) -> FoundEdge | None:
        """Rule (b): the first travel that exceeds its limit."""
        limits, travel, width_m = self._limits, self._travel, self._limits.width_m
        k = 0 if seam.axis == "x" else 1
        across = travel.sensor[k] - seam.begin.sensor[k]
        across_m = across * seam.side if seam.side else abs(across)
        if across_m > width_m + limits.extra_m:
            return FoundEdge(BEYOND_SEAM, across_m, width_m + limits.extra_m)
        swept_m = abs(self._heading_rad - self._start.heading_rad) * self._radius_m
        if swept_m > limits.turn_m:
            return FoundEdge(BEYOND_SEAM, swept_m, limits.turn_m)
        tx, ty = travel.robot[0] - seam.begin.robot[0], travel.robot[1] - seam.begin.robot[1]
        if seam.side and tx * departure.direction[0] + ty * departure.direction[1] <= 0.0:
            return None
        way_m = hypot(tx, ty)
        if way_m < width_m:
            return None
        from_start_m = hypot(*travel.robot)
        if from_start_m > limits.crossing_m:
            return FoundEdge(BEYOND_SEAM, from_start_m, limits.crossing_m)
        limit_m = width_m / max(abs((tx, ty)[k]) / way_m, limits.min_cosine) + limits.extra_m
        return FoundEdge(BEYOND_SEAM, way_m, limit_m) if way_m > limit_m else None


def _start(odometry: Odometry, offset_m: Place) -> EpisodeStart:
    x, y, heading_rad = odometry.x_m, odometry.y_m, odometry.heading_rad
    c, s = cos(heading_rad), sin(heading_rad)
    sensor = x + c * offset_m[0] - s * offset_m[1], y + s * offset_m[0] + c * offset_m[1]
    return EpisodeStart((x, y), sensor, heading_rad)


def _side(departure: Departure, axis: Axis) -> float:
    """The sign of the motion along an axis, 0: unknown.

    The direction tells forward from back only if the robot's translation, not a turn, brought the sensor here.
    """
    along = departure.direction[0 if axis == "x" else 1]
    if departure.is_by_turn or abs(along) < MIN_SIDE_COSINE:
        return 0.0
    return 1.0 if along > 0.0 else -1.0
