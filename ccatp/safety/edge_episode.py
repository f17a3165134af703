"""One edge sensor that is off the panels: where it went off, how far it has moved since, and whether it is at an edge.

An episode is the time from the first "off" of a sensor until it is safely back on a panel.
"""

from enum import Enum, auto
from math import cos, hypot, inf, sin, sqrt

from ccatp.conditions import BEYOND_SEAM, NO_SEAM, OFF_WITHOUT_WHEELS, RIM_AHEAD, Condition
from ccatp.config.models import DangerConfig
from ccatp.safety.edge_map import Axis, EdgeMap
from ccatp.safety.wheel_odometry import Odometry

Place = tuple[float, float]

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
    DECLARED = auto()  # an edge


class EdgeLimits:
    """The limits of the edge rule."""

    def __init__(self, gap_m: float, cfg: DangerConfig) -> None:
        self.sigmas, self.margin_m = cfg.map_sigmas, cfg.map_margin_m
        self.gap_m, self.tolerance_m, self.extra_m = gap_m, cfg.gap_tolerance_m, cfg.seam_extra_m
        self.no_map_m, self.turn_m = cfg.no_map_travel_m, cfg.turn_travel_limit_m
        width = gap_m + cfg.gap_tolerance_m
        # A narrow seam may be crossed at a larger angle, because the limit is the length that the sensor travels.
        self.min_cosine = min(cos(cfg.max_crossing_angle_rad), width / cfg.slanted_crossing_m)
        # Where two seams cross, a path oblique to one is steep to the other. A crossing of both is never longer than
        # the sum of the two chords.
        self.crossing_m = width / self.min_cosine + width / sqrt(1.0 - self.min_cosine**2) + cfg.seam_extra_m
        self.outward_turn_m = cfg.outward_turn_limit_m
        self.debounce, self.clear = cfg.debounce_samples, cfg.clear_samples


class EdgeEpisode:
    """One episode of one sensor. Places are in the frame of the odometry unless they are called map places.

    ``sensor``: its place in the robot frame, and how far it moves between two samples, m (the detection may be late by
    this distance). Less translation than ``half_base_m`` per radian counts as a turn in place. ``retreat_m``: how far
    the sensor has moved since the edge was declared, while it stayed off.
    """

    def __init__(
        self,
        limits: EdgeLimits,
        edge_map: EdgeMap,
        odometry: Odometry,
        sensor: tuple[Place, float],
        half_base_m: float,
    ) -> None:
        self._limits, self._map = limits, edge_map
        offset_m, moved_m = sensor
        self._radius_m, self._half_base_m, self._moved_m = hypot(*offset_m), half_base_m, moved_m
        c, s = cos(odometry.heading_rad), sin(odometry.heading_rad)
        self._robot0: Place = (odometry.x_m, odometry.y_m)
        self._sensor0: Place = (
            odometry.x_m + c * offset_m[0] - s * offset_m[1],
            odometry.y_m + s * offset_m[0] + c * offset_m[1],
        )
        self._heading0 = self._heading = odometry.heading_rad
        self._map0: Place | None = None
        self._cos, self._sin, self._sigma_m = 1.0, 0.0, inf
        self._moved: Place = (0.0, 0.0)
        self._recent: Place = (0.0, 0.0)
        self._direction: Place = (0.0, 0.0)
        self._axis: Axis = "x"
        self._side = 0.0
        self._has_switched = False
        self._base: tuple[Place, Place] = ((0.0, 0.0), (0.0, 0.0))
        self.is_from_turn = False
        self._turn_sign = 0.0
        self._off_samples = self._on_samples = 0
        self._on_place: Place = self._sensor0
        self._declared_heading = 0.0
        self._declared_place: Place = self._sensor0
        self._place: Place = self._sensor0
        self._is_turn_spent = False
        self.retreat_m = 0.0
        self.is_doubted = False
        self.phase = EdgePhase.FRESH
        self.cause: Condition = NO_SEAM  # valid once an edge is declared
        self.value_m = self.limit_m = 0.0

    def place_on_map(self, place: Place, deck_heading_rad: float, sigma_m: float) -> None:
        """Set the sensor's place on the map, the robot's deck heading and the standard deviation of the estimate."""
        turn = deck_heading_rad - self._heading0
        self._map0, self._cos, self._sin, self._sigma_m = place, cos(turn), sin(turn), sigma_m

    @property
    def needs_map(self) -> bool:
        """Whether the sensor has no place on the map and has not moved since it went off."""
        return self.phase is EdgePhase.FRESH and self._map0 is None

    # -- samples --------------------------------------------------------------------------------------------------

    def see_on(self, place: Place) -> bool:
        """Take an "on" sample at ``place``. Returns whether the episode is over."""
        if self._on_samples == 0:
            self._on_place = place
        self._on_samples += 1
        if self._on_samples < self._limits.clear:
            return False
        if self.phase is EdgePhase.DECLARED or self._on_samples >= LONG_ON * self._limits.clear:
            return True
        return hypot(place[0] - self._on_place[0], place[1] - self._on_place[1]) >= self._limits.no_map_m

    def see_off(self, odometry: Odometry, place: Place, worst_m: float) -> bool:
        """Take an "off" sample; whether it declares an edge. ``worst_m``: largest unmeasured travel, rule (g)."""
        self._off_samples += 1
        self._on_samples = 0
        self._heading, self._place = odometry.heading_rad, place
        if self.phase is EdgePhase.DECLARED:
            self._watch_turn()
            self.retreat_m = hypot(place[0] - self._declared_place[0], place[1] - self._declared_place[1])
            return False
        self._declared_place = place
        if worst_m > self._limits.no_map_m:
            return self._declare(OFF_WITHOUT_WHEELS, worst_m, self._limits.no_map_m)
        c, s, sensor0, robot0 = self._cos, self._sin, self._sensor0, self._robot0
        dx, dy = place[0] - sensor0[0], place[1] - sensor0[1]
        self._moved = c * dx - s * dy, s * dx + c * dy
        dx, dy = odometry.x_m - robot0[0], odometry.y_m - robot0[1]
        robot = c * dx - s * dy, s * dx + c * dy
        if self.phase is EdgePhase.FRESH:
            self._classify(robot)
        return self._judge(robot)

    def look_ahead(self) -> bool:
        """Apply rule (a) along the motion since the last call. Returns whether it declares an edge."""
        dx, dy = self._moved[0] - self._recent[0], self._moved[1] - self._recent[1]
        length = hypot(dx, dy)
        if self._on_samples or self._map0 is None or length < DIRECTION_TRAVEL_M or self.phase is EdgePhase.FRESH:
            return False
        self._recent = self._moved
        if not self._is_rim((dx / length, dy / length)):
            return False
        self.phase = EdgePhase.RIM
        return self._off_samples >= self._limits.debounce and self._declare_rim()

    def trust(self) -> None:
        """A fix confirms that the sensor is correct: measure the retreat again, from here."""
        self._declared_place, self.retreat_m, self.is_doubted = self._place, 0.0, False

    @property
    def is_on(self) -> bool:
        """Whether the last sample was "on"; the episode may be about to end."""
        return self._on_samples > 0

    @property
    def permits_turn(self) -> bool:
        """Whether the robot may turn. At a declared edge: only when a turn led there, to turn back."""
        return self.phase is not EdgePhase.DECLARED or (self.is_from_turn and not self._is_turn_spent)

    # -- rules ----------------------------------------------------------------------------------------------------

    def _classify(self, robot: Place) -> None:
        length = hypot(*self._moved)
        if length < DIRECTION_TRAVEL_M:
            return
        self._direction = direction = self._moved[0] / length, self._moved[1] / length
        turned = self._heading - self._heading0
        self.is_from_turn = hypot(*robot) < abs(turned) * self._half_base_m
        self._turn_sign = 1.0 if turned >= 0.0 else -1.0
        self.phase = EdgePhase.NO_MAP
        if self._map0 is None:
            return
        if self._is_rim(direction):
            self.phase = EdgePhase.RIM
            return
        seam = self._map.seam_at(self._map0, self._slack_m())
        if seam is not None:
            self.phase = EdgePhase.SEAM
            self._set_seam(seam.axis)

    def _slack_m(self) -> float:
        """Allowance across a seam, m. ``extra_m`` covers the heading's error: 3 mm are 1.3 deg at a corner sensor."""
        limits = self._limits
        return limits.tolerance_m + limits.extra_m + limits.sigmas * self._sigma_m + self._moved_m

    def _is_rim(self, direction: Place) -> bool:
        if self._map0 is None:
            return False
        here = self._map0[0] + self._moved[0], self._map0[1] + self._moved[1]
        return self._map.is_rim_ahead(here, direction, self._limits.margin_m, self._limits.sigmas * self._sigma_m)

    def _set_seam(self, axis: Axis) -> None:
        self._axis = axis
        across = self._direction[0] if axis == "x" else self._direction[1]
        # The direction tells forward from back only if the robot's translation, not a turn, brought the sensor here.
        known = not self.is_from_turn and not self._has_switched and abs(across) >= MIN_SIDE_COSINE
        self._side = (1.0 if across > 0.0 else -1.0) if known else 0.0

    def _judge(self, robot: Place) -> bool:
        if self._off_samples < self._limits.debounce:
            return False
        if self.phase is EdgePhase.RIM:
            return self._declare_rim()
        if self.phase is EdgePhase.NO_MAP:
            return self._judge_no_map()
        return self.phase is EdgePhase.SEAM and self._judge_seam(robot)

    def _declare_rim(self) -> bool:
        return self._declare(RIM_AHEAD, hypot(*self._moved), 0.0)

    def _judge_no_map(self) -> bool:
        ux, uy = self._direction
        mx, my = self._moved
        travel = hypot(max(ux * mx + uy * my, 0.0), ux * my - uy * mx)
        return travel > self._limits.no_map_m and self._declare(NO_SEAM, travel, self._limits.no_map_m)

    def _judge_seam(self, robot: Place) -> bool:
        value, limit = self._seam_excess(robot)
        if value <= limit or self._switch_seam(robot):
            return False
        return self._declare(BEYOND_SEAM, value, limit)

    def _seam_excess(self, robot: Place) -> tuple[float, float]:
        """Rule (b): the first travel that exceeds its limit, and that limit; else the translation and its limit."""
        limits = self._limits
        k = 0 if self._axis == "x" else 1
        width = limits.gap_m + limits.tolerance_m
        sensor0, robot0 = self._base
        across = self._moved[k] - sensor0[k]
        across = across * self._side if self._side else abs(across)
        if across > width + limits.extra_m:
            return across, width + limits.extra_m
        swept = abs(self._heading - self._heading0) * self._radius_m
        if swept > limits.turn_m:
            return swept, limits.turn_m
        tx, ty = robot[0] - robot0[0], robot[1] - robot0[1]
        if self._side and tx * self._direction[0] + ty * self._direction[1] <= 0.0:
            return 0.0, width
        travel = hypot(tx, ty)
        if travel < width:
            return travel, width
        from_start = hypot(*robot)
        if from_start > limits.crossing_m:
            return from_start, limits.crossing_m
        cosine = max(abs((tx, ty)[k]) / travel, limits.min_cosine)
        return travel, width / cosine + limits.extra_m

    def _switch_seam(self, robot: Place) -> bool:
        """Where two seams cross, a sensor may leave one seam along the other. Once per episode this is not an edge."""
        if self._has_switched or self._map0 is None or hypot(*robot) > self._limits.crossing_m:
            return False
        here = self._map0[0] + self._moved[0], self._map0[1] + self._moved[1]
        seam = self._map.seam_at(here, self._slack_m(), not_axis=self._axis)
        if seam is None:
            return False
        self._has_switched = True
        self._base = (self._moved, robot)
        self._set_seam(seam.axis)
        return True

    def _declare(self, cause: Condition, value_m: float, limit_m: float) -> bool:
        self.phase = EdgePhase.DECLARED
        self.cause, self.value_m, self.limit_m = cause, value_m, limit_m
        self._declared_heading = self._heading
        return True

    def _watch_turn(self) -> None:
        outward = self._turn_sign * (self._heading - self._declared_heading) * self._radius_m
        if outward > self._limits.outward_turn_m:
            self._is_turn_spent = True
