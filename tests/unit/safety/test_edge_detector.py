"""One episode of the edge rule against a map that says what it is told: every threshold from both sides."""

from dataclasses import dataclass, field
from math import acos, cos, hypot, inf, radians, sin
from types import SimpleNamespace
from typing import Any, cast

import pytest

from ccatp.conditions import BEYOND_SEAM, NO_SEAM, OFF_WITHOUT_WHEELS, RIM_AHEAD
from ccatp.config.load import load_config
from ccatp.config.models import DangerConfig
from ccatp.safety.edge_detector import (
    DIRECTION_TRAVEL_M,
    LONG_ON,
    Axis,
    EdgeDetector,
    EdgeLimits,
    EdgeMap,
    EdgePhase,
    SeamNear,
)
from ccatp.safety.wheel_odometry import Odometry

GAP_M = 0.010
OFFSET = (0.09, -0.07)
RADIUS_M = hypot(*OFFSET)
HALF_BASE_M = 0.075
MOVED_M = 0.0007  # between two samples
SIGMA_M = 0.001
MAP0 = (5.0, 6.0)
UM = 1e-6


@pytest.fixture(scope="module")
def danger() -> DangerConfig:
    return load_config().danger


@dataclass
class Map:
    """Says where the rim and the seams are, and keeps what it was asked."""

    is_rim: bool = False
    seams: tuple[Axis, ...] = ()
    asked_rim: list[tuple[Any, ...]] = field(default_factory=list)
    asked_seam: list[tuple[Any, ...]] = field(default_factory=list)

    def is_rim_ahead(self, place: Any, direction: Any, reach_m: float, slack_m: float) -> bool:
        self.asked_rim.append((place, direction, reach_m, slack_m))
        return self.is_rim

    def seam_at(self, place: Any, slack_m: float, not_axis: Axis | None = None) -> SeamNear | None:
        self.asked_seam.append((place, slack_m, not_axis))
        left = [axis for axis in self.seams if axis != not_axis]
        return SeamNear(left[0], 0.0) if left else None


@dataclass
class Sensor:
    """A sensor that goes off where the robot stands at ``pose``, and then moves with the robot.

    ``turn`` is the deck's heading over that of the odometry.
    """

    cfg: DangerConfig
    map: Map
    pose: tuple[float, float, float] = (1.0, 2.0, 0.0)
    turn: float = 0.0
    gap_m: float = GAP_M
    has_map: bool = True
    episode: EdgeDetector = field(init=False)

    def __post_init__(self) -> None:
        limits = EdgeLimits(self.gap_m, self.cfg)
        edge_map = cast(EdgeMap, self.map)
        self.episode = EdgeDetector(limits, edge_map, self.odometry, (OFFSET, MOVED_M), HALF_BASE_M)
        if self.has_map:
            self.episode.place_on_map(MAP0, self.pose[2] + self.turn, SIGMA_M)

    @property
    def odometry(self) -> Odometry:
        x, y, heading = self.pose
        return cast(Odometry, SimpleNamespace(x_m=x, y_m=y, heading_rad=heading))

    @property
    def place(self) -> tuple[float, float]:
        x, y, heading = self.pose
        c, s = cos(heading), sin(heading)
        return x + c * OFFSET[0] - s * OFFSET[1], y + s * OFFSET[0] + c * OFFSET[1]

    def move(self, dx: float = 0.0, dy: float = 0.0, turn: float = 0.0) -> None:
        x, y, heading = self.pose
        self.pose = x + dx, y + dy, heading + turn

    def off(self, dx: float = 0.0, dy: float = 0.0, turn: float = 0.0, worst_m: float = 0.0) -> bool:
        """Move, then one off sample."""
        self.move(dx, dy, turn)
        return self.episode.see_off(self.odometry, self.place, worst_m)

    def on(self, dx: float = 0.0, dy: float = 0.0) -> bool:
        self.move(dx, dy)
        return self.episode.see_on(self.place)

    def stay(self, samples: int, dx: float = 0.0) -> bool:
        """On for so many samples; whether that ends the episode."""
        return sum(self.on(dx) for _ in range(samples)) > 0

    def walk(self, dx: float, dy: float = 0.0, steps: int = 20, turn: float = 0.0) -> bool:
        """Off on the whole way; whether that declares an edge."""
        return sum(self.off(dx / steps, dy / steps, turn / steps) for _ in range(steps)) > 0


def test_the_limits_are_those_of_the_configuration(danger: DangerConfig) -> None:
    limits = EdgeLimits(GAP_M, danger)
    width, angle = GAP_M + danger.gap_tolerance_m, danger.max_crossing_angle_rad
    assert width / cos(angle) > danger.slanted_crossing_m
    assert limits.min_cosine == cos(angle)
    assert limits.crossing_m == pytest.approx(width / cos(angle) + width / sin(angle) + danger.seam_extra_m)
    assert (limits.gap_m, limits.tolerance_m, limits.extra_m) == (GAP_M, danger.gap_tolerance_m, danger.seam_extra_m)


def test_a_new_episode(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map(is_rim=True), has_map=False)
    episode = sensor.episode
    assert episode.phase is EdgePhase.FRESH
    assert (episode.value_m, episode.limit_m) == (0.0, 0.0)
    assert not episode.is_from_turn
    assert not episode.is_doubted
    assert not episode.is_on
    assert episode.retreat_m == 0.0
    assert episode.permits_turn
    assert episode.needs_map
    episode.place_on_map(MAP0, 0.0, SIGMA_M)
    assert not episode.needs_map
    assert not episode.look_ahead()
    assert sensor.map.asked_rim == []


def test_an_episode_on_its_way_needs_no_map_any_more(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map(), has_map=False)
    sensor.off(0.001)
    assert sensor.episode.phase is EdgePhase.NO_MAP
    assert not sensor.episode.needs_map


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.0])
@pytest.mark.parametrize("turn", [0.0, 0.5, -1.2])
def test_the_map_is_asked_at_the_sensors_place_along_its_way(danger: DangerConfig, heading: float, turn: float) -> None:
    sensor = Sensor(danger, Map(), (1.0, 2.0, heading), turn)
    sensor.off(0.0006, 0.0008)
    c, s = cos(turn), sin(turn)
    there = MAP0[0] + c * 0.0006 - s * 0.0008, MAP0[1] + s * 0.0006 + c * 0.0008
    way = c * 0.6 - s * 0.8, s * 0.6 + c * 0.8
    place, direction, reach_m, slack_m = sensor.map.asked_rim[0]
    assert place == pytest.approx(there)
    assert direction == pytest.approx(way)
    assert reach_m == danger.map_margin_m
    assert slack_m == pytest.approx(danger.map_sigmas * SIGMA_M)
    place, slack_m, axis = sensor.map.asked_seam[0]
    assert place == MAP0
    assert slack_m == pytest.approx(
        danger.gap_tolerance_m + danger.seam_extra_m + danger.map_sigmas * SIGMA_M + MOVED_M
    )
    assert axis is None


def test_a_direction_takes_some_travel(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map(is_rim=True))
    assert not sensor.off(0.9 * DIRECTION_TRAVEL_M)
    assert sensor.map.asked_rim == []
    assert sensor.off(0.2 * DIRECTION_TRAVEL_M)
    assert len(sensor.map.asked_rim) == 1


def test_the_rim_counts_from_the_debounced_sample_on(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map(is_rim=True))
    assert danger.debounce_samples == 2
    assert not sensor.off(0.001)
    assert sensor.episode.phase is EdgePhase.RIM
    assert sensor.off(0.001)
    episode = sensor.episode
    assert (episode.cause, episode.limit_m) == (RIM_AHEAD, 0.0)
    assert episode.value_m == pytest.approx(0.002)
    assert not sensor.off(0.001)  # declared once


def test_without_a_map_the_travel_away_from_the_panel_counts(danger: DangerConfig) -> None:
    limit = danger.no_map_travel_m
    for has_map in (False, True):
        sensor = Sensor(danger, Map(), has_map=has_map)
        assert not sensor.walk(limit - UM)
        assert sensor.episode.phase is EdgePhase.NO_MAP
        assert sensor.off(2 * UM)
        assert sensor.episode.cause is NO_SEAM
        assert sensor.episode.value_m == pytest.approx(limit + UM)
        assert sensor.episode.limit_m == limit


def test_going_back_is_no_travel_but_going_aside_is(danger: DangerConfig) -> None:
    limit = danger.no_map_travel_m
    sensor = Sensor(danger, Map(), has_map=False)
    sensor.off(0.001)
    assert not sensor.walk(-0.05)
    assert sensor.walk(0.0, limit + UM)
    for side in (1.0, -1.0):
        sensor = Sensor(danger, Map(), has_map=False)
        sensor.off(0.003, 0.001)
        ux, uy = 0.003 / hypot(0.003, 0.001), 0.001 / hypot(0.003, 0.001)
        assert not sensor.walk(-0.01 * ux, -0.01 * uy)
        assert not sensor.walk(-side * (limit - UM) * uy, side * (limit - UM) * ux)
        assert sensor.walk(-side * 2 * UM * uy, side * 2 * UM * ux, 2)
        assert sensor.episode.value_m == pytest.approx(limit, abs=2 * UM)


def test_unheard_wheels_count_as_the_fastest(danger: DangerConfig) -> None:
    limit = danger.no_map_travel_m
    sensor = Sensor(danger, Map(seams=("x",)))
    assert not sensor.off(0.0, worst_m=limit)
    assert sensor.off(0.0, worst_m=limit + UM)
    assert sensor.episode.cause is OFF_WITHOUT_WHEELS
    assert (sensor.episode.value_m, sensor.episode.limit_m) == (limit + UM, limit)


# -- seams ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("axis", "k"), [("x", 0), ("y", 1)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_seam_allows_its_width_across(danger: DangerConfig, axis: Axis, k: int, sign: float) -> None:
    limit = GAP_M + danger.gap_tolerance_m + danger.seam_extra_m
    step = [0.0, 0.0]
    step[k] = sign
    sensor = Sensor(danger, Map(seams=(axis,)))
    assert not sensor.walk(step[0] * (limit - UM), step[1] * (limit - UM))
    assert sensor.episode.phase is EdgePhase.SEAM
    assert not sensor.episode.is_from_turn
    assert sensor.off(step[0] * 2 * UM, step[1] * 2 * UM)
    assert sensor.episode.cause is BEYOND_SEAM
    assert sensor.episode.value_m == pytest.approx(limit + UM)
    assert sensor.episode.limit_m == pytest.approx(limit)


@pytest.mark.parametrize("angle", [0.3, -0.6, 1.0, 1.3])
@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_a_seam_allows_more_to_an_oblique_way(danger: DangerConfig, angle: float, turn: float) -> None:
    width = GAP_M + danger.gap_tolerance_m
    cosine = max(cos(angle), cos(danger.max_crossing_angle_rad))
    limit = width / cosine + danger.seam_extra_m
    # Across, the seam ends earlier where the way is steep.
    limit = min(limit, (width + danger.seam_extra_m) / cos(angle))
    sensor = Sensor(danger, Map(seams=("x",)), turn=turn)
    way = angle - turn  # in the odometry's frame
    assert not sensor.walk((limit - 2 * UM) * cos(way), (limit - 2 * UM) * sin(way), 40)
    assert sensor.walk(4 * UM * cos(way), 4 * UM * sin(way), 2)


@pytest.mark.parametrize("gap_m", [0.0012, 0.004, 0.005, GAP_M, 0.020])
def test_a_narrow_seam_may_be_crossed_at_a_greater_slant(danger: DangerConfig, gap_m: float) -> None:
    """Either the angle or the way across it bounds the slant, whichever allows more."""
    limits = EdgeLimits(gap_m, danger)
    width = gap_m + danger.gap_tolerance_m
    longest = max(danger.slanted_crossing_m, width / cos(danger.max_crossing_angle_rad))
    assert width / limits.min_cosine == pytest.approx(longest)
    angle = acos(limits.min_cosine)
    assert limits.crossing_m == pytest.approx(longest + width / sin(angle) + danger.seam_extra_m)


@pytest.mark.parametrize(("degrees", "allowed_m"), [(78.0, 0.01358), (83.0, 0.02105), (84.2, 0.02477), (88.0, 0.025)])
def test_how_far_along_a_seam_as_built(danger: DangerConfig, degrees: float, allowed_m: float) -> None:
    """1.2 mm wide: (gap + tolerance)/cos(angle) + 3 mm, which 22 + 3 mm end."""
    sensor = Sensor(danger, Map(seams=("x",)), gap_m=0.0012)
    c, s = cos(radians(degrees)), sin(radians(degrees))
    assert not sensor.walk((allowed_m - 5e-5) * c, (allowed_m - 5e-5) * s, 40)
    assert sensor.walk(1e-4 * c, 1e-4 * s, 2)
    assert sensor.episode.cause is BEYOND_SEAM


def test_back_over_the_seam_is_no_way_across(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map(seams=("x",)))
    assert not sensor.off(0.001)
    assert not sensor.walk(-0.1, steps=50)
    assert sensor.episode.phase is EdgePhase.SEAM


def test_a_way_along_the_seam_has_a_limit_both_ways(danger: DangerConfig) -> None:
    """Beside its direction a sensor's side is not told: either way across counts."""
    limit = GAP_M + danger.gap_tolerance_m + danger.seam_extra_m
    for sign in (1.0, -1.0):
        sensor = Sensor(danger, Map(seams=("x",)))
        sensor.off(0.0, 0.001)
        assert not sensor.walk(sign * (limit - 0.003), steps=3)
        assert sensor.walk(sign * 0.004, steps=4)


@pytest.mark.parametrize(("cosine", "is_told"), [(0.2, False), (0.4, True)])
def test_the_side_is_told_by_a_way_that_is_steep_enough(danger: DangerConfig, cosine: float, is_told: bool) -> None:
    limit = GAP_M + danger.gap_tolerance_m + danger.seam_extra_m
    sensor = Sensor(danger, Map(seams=("x",)))
    sensor.off(0.001 * cosine, 0.001 * (1.0 - cosine * cosine) ** 0.5)
    # Back across: no way over the seam for who came from there, one for who came from nowhere.
    assert sensor.walk(-limit - 0.002, steps=30) is not is_told


def test_more_than_both_chords_is_no_crossing(danger: DangerConfig) -> None:
    crossing = EdgeLimits(GAP_M, danger).crossing_m
    sensor = Sensor(danger, Map(seams=("x", "y")))
    # Forth and back along the seam within its width: the way from the start is what counts.
    assert sensor.walk(0.001, crossing + 0.001, 60)
    assert sensor.episode.cause is BEYOND_SEAM
    assert sensor.episode.value_m <= crossing + 0.001


def test_one_seam_may_be_left_along_another_once(danger: DangerConfig) -> None:
    width = GAP_M + danger.gap_tolerance_m
    limit = width + danger.seam_extra_m
    sensor = Sensor(danger, Map(seams=("x", "y")))
    sensor.off(0.001)
    assert not sensor.walk(limit, steps=20)  # 1 mm beyond what the first allows
    assert sensor.map.asked_seam[-1][2] == "x"
    place, slack_m, _ = sensor.map.asked_seam[-1]
    assert place[0] == pytest.approx(MAP0[0] + limit, abs=2e-3)
    assert place[1] == MAP0[1]
    assert slack_m > danger.gap_tolerance_m
    # The second allows what is left of both chords, and there is no third.
    assert sensor.walk(0.1, steps=200)
    assert sensor.episode.cause is BEYOND_SEAM


def test_a_single_seam_is_not_left_along_another(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map(seams=("y",)))
    limit = GAP_M + danger.gap_tolerance_m + danger.seam_extra_m
    assert sensor.walk(0.0, limit + 0.001, 20)
    assert sensor.map.asked_seam[-1][2] == "y"


# -- turning ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_edge_met_in_turning_may_be_turned_back_and_not_on(danger: DangerConfig, sign: float) -> None:
    sensor = Sensor(danger, Map(is_rim=True))
    assert not sensor.off(turn=sign * 0.005)
    assert sensor.off(turn=sign * 0.005)
    episode = sensor.episode
    assert episode.is_from_turn
    assert episode.permits_turn
    limit = danger.outward_turn_limit_m / RADIUS_M
    sensor.off(turn=sign * (limit - 1e-4))
    assert episode.permits_turn
    sensor.off(turn=-sign * 2.0)
    assert episode.permits_turn
    sensor.off(turn=sign * (2.0 + 2e-4))
    assert not episode.permits_turn
    sensor.off(turn=-sign * 3.0)
    assert not episode.permits_turn


def test_an_edge_met_in_driving_permits_no_turn(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map(is_rim=True))
    # Less translation than half the wheel base per radian is a turn, more is none.
    sensor.off(HALF_BASE_M * 0.1 * 1.01, turn=0.1)
    assert not sensor.episode.is_from_turn
    sensor.off(0.001)
    assert not sensor.episode.permits_turn
    turning = Sensor(danger, Map(is_rim=True))
    turning.off(HALF_BASE_M * 0.1 * 0.99, turn=0.1)
    assert turning.episode.is_from_turn


# -- looking ahead ----------------------------------------------------------------------------------------------------


def test_a_seam_may_lead_to_the_rim(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map(seams=("x",)))
    sensor.off(0.001)
    sensor.off(0.001)
    sensor.map.asked_rim.clear()
    assert not sensor.episode.look_ahead()
    place, direction, reach_m, slack_m = sensor.map.asked_rim[0]
    assert place == pytest.approx((MAP0[0] + 0.002, MAP0[1]))
    assert direction == pytest.approx((1.0, 0.0))
    assert (reach_m, slack_m) == (danger.map_margin_m, danger.map_sigmas * SIGMA_M)
    # Along what has been travelled since, and not without travel.
    sensor.map.asked_rim.clear()
    sensor.map.is_rim = True
    assert not sensor.episode.look_ahead()
    assert sensor.map.asked_rim == []
    sensor.off(0.0, -0.9 * DIRECTION_TRAVEL_M)
    assert not sensor.episode.look_ahead()
    sensor.off(0.0, -0.2 * DIRECTION_TRAVEL_M)
    assert sensor.episode.look_ahead()
    assert sensor.map.asked_rim[0][1] == pytest.approx((0.0, -1.0))
    assert sensor.episode.cause is RIM_AHEAD
    assert sensor.episode.value_m == pytest.approx(hypot(0.002, 1.1 * DIRECTION_TRAVEL_M))


def test_looking_ahead_goes_by_the_way_since_the_last_look(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map(seams=("x",)))
    for dx, dy in ((0.001, 0.002), (0.0, 0.001), (0.001, 0.0), (-0.003, 0.004)):
        sensor.off(dx, dy)
        sensor.map.asked_rim.clear()
        assert not sensor.episode.look_ahead()
        assert sensor.map.asked_rim[0][1] == pytest.approx((dx / hypot(dx, dy), dy / hypot(dx, dy)))


def test_no_looking_ahead_while_on_or_without_a_place(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map(seams=("x",)))
    sensor.off(0.001)
    sensor.off(0.001)
    sensor.map.is_rim = True
    assert not sensor.on(0.001)
    assert not sensor.episode.look_ahead()
    assert sensor.episode.phase is not EdgePhase.DECLARED
    lost = Sensor(danger, Map(is_rim=True), has_map=False)
    lost.off(0.001)
    lost.off(0.001)
    assert not lost.episode.look_ahead()


@pytest.mark.parametrize("early", [1, 0])
def test_looking_ahead_waits_for_the_debounced_sample(danger: DangerConfig, early: int) -> None:
    sensor = Sensor(danger, Map(seams=("x",)))
    for _ in range(danger.debounce_samples - early):
        sensor.off(0.001)
    sensor.map.is_rim = True
    assert sensor.episode.look_ahead() is not bool(early)
    assert sensor.episode.phase is (EdgePhase.RIM if early else EdgePhase.DECLARED)
    assert sensor.off(0.0) is bool(early)  # declared once


# -- back on ----------------------------------------------------------------------------------------------------------


def test_an_episode_ends_on_the_panel_after_some_way(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map())
    sensor.off(0.001)
    clear = danger.clear_samples
    assert not sensor.stay(clear - 1, 0.001)
    assert sensor.on(0.0)  # 19 mm on
    near = Sensor(danger, Map())
    near.off(0.001)
    assert not near.stay(clear)
    assert not near.on(danger.no_map_travel_m - UM)
    assert near.on(2 * UM)


def test_the_way_on_the_panel_counts_from_the_first_sample_on(danger: DangerConfig) -> None:
    episode, there = Sensor(danger, Map()).episode, (danger.no_map_travel_m, 0.0)
    assert not episode.see_on((0.0, 0.0))
    ended = [episode.see_on(there) for _ in range(danger.clear_samples - 1)]
    assert ended == [False] * (danger.clear_samples - 2) + [True]


@pytest.mark.parametrize("is_edge", [False, True])
def test_at_rest_an_episode_ends_after_a_long_time_and_an_edge_once_the_sensor_is_on(
    danger: DangerConfig, is_edge: bool
) -> None:
    sensor = Sensor(danger, Map(is_rim=is_edge))
    sensor.off(0.001)
    assert sensor.off(0.001) is is_edge
    assert LONG_ON * danger.clear_samples == 200  # 0.2 s
    assert not sensor.stay((1 if is_edge else LONG_ON) * danger.clear_samples - 1)
    assert sensor.on()


def test_chatter_begins_to_count_anew(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map())
    sensor.off(0.001)
    for _ in range(3):
        assert not sensor.stay(danger.clear_samples - 1)
        sensor.off()
    # The way on the panel counts from where it came back last.
    assert not sensor.on(0.02)
    assert not sensor.stay(danger.clear_samples)


def test_an_unknown_position_makes_every_seam_possible(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map())
    sensor.episode.place_on_map(MAP0, 0.0, inf)
    sensor.off(0.001)
    assert sensor.map.asked_seam[0][1] == inf
    assert sensor.episode.phase is EdgePhase.NO_MAP


# -- what counts across, from both sides ------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("heading", [0.0, 3.0])
def test_what_a_turn_adds_counts_across_the_seam(danger: DangerConfig, sign: float, heading: float) -> None:
    """The robot drives on to the seam and then turns: the sensor goes on across it without the robot."""
    limit = GAP_M + danger.gap_tolerance_m + danger.seam_extra_m
    sensor = Sensor(danger, Map(seams=("x",)), (0.0, 0.0, heading), -heading)
    c, s = cos(heading), sin(heading)
    for _ in range(2):
        assert not sensor.off(sign * 0.0005 * c, sign * 0.0005 * s)
    # About the deck's z axis the sensor at (0.09, -0.07) moves towards +x with a turn to the left.
    across, turned = sign * 0.001, 0.0
    while abs(across) < limit - 1e-4:
        turned += sign * 1e-4
        across = sign * 0.001 + OFFSET[0] * (cos(turned) - 1.0) - OFFSET[1] * sin(turned)
        assert not sensor.off(turn=sign * 1e-4)
    assert sensor.walk(0.0, turn=sign * 0.01)
    assert sensor.episode.value_m == pytest.approx(limit, abs=1e-4)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_turn_away_from_the_seam_adds_nothing(danger: DangerConfig, sign: float) -> None:
    sensor = Sensor(danger, Map(seams=("x",)))
    sensor.off(sign * 0.001)
    assert not sensor.walk(0.0, turn=-sign * 0.4)


def test_a_sensor_about_which_the_robot_turns_does_not_move(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map(seams=("x",)))
    x, y = sensor.place
    for k in range(1, 60):
        heading = 0.01 * k
        c, s = cos(heading), sin(heading)
        sensor.pose = x - c * OFFSET[0] + s * OFFSET[1], y - s * OFFSET[0] - c * OFFSET[1], heading
        assert not sensor.off()


def test_a_sensor_that_a_turn_brought_there_has_no_side(danger: DangerConfig) -> None:
    limit = GAP_M + danger.gap_tolerance_m + danger.seam_extra_m
    sensor = Sensor(danger, Map(seams=("x",)), (1.0, 2.0, 0.5), -0.5)
    sensor.off(turn=0.005)
    assert sensor.episode.is_from_turn
    # Back across, to where a driving robot came from: without a side that is a way over the seam.
    assert sensor.walk(-(limit + 0.002) * cos(0.5), -(limit + 0.002) * sin(0.5))


def test_the_way_along_a_seam_counts_in_either_direction(danger: DangerConfig) -> None:
    width = GAP_M + danger.gap_tolerance_m
    limit = width / cos(danger.max_crossing_angle_rad) + danger.seam_extra_m
    sensor = Sensor(danger, Map(seams=("x",)))
    sensor.off(0.0, 0.001)
    assert not sensor.walk(0.0, -limit, 40)
    assert sensor.walk(0.0, -0.002, 4)


def test_another_seam_is_asked_for_once_at_the_sensors_place(danger: DangerConfig) -> None:
    limit = GAP_M + danger.gap_tolerance_m + danger.seam_extra_m
    sensor = Sensor(danger, Map(seams=("x", "y")))
    sensor.off(0.001, 0.0003)
    sensor.walk(limit, 0.3 * limit, 60)
    sensor.walk(0.05, steps=100)
    asked = [place for place, _, axis in sensor.map.asked_seam if axis is not None]
    assert len(asked) == 1
    x, y = asked[0]
    assert x > MAP0[0] + 0.010
    assert y - MAP0[1] == pytest.approx(0.3 * (x - MAP0[0]), rel=0.05)


def test_behind_a_switch_the_way_begins_anew_and_has_no_side(danger: DangerConfig) -> None:
    width = GAP_M + danger.gap_tolerance_m
    limit = width + danger.seam_extra_m
    crossing = EdgeLimits(GAP_M, danger).crossing_m
    # Along the other seam, beside the first way: its width once more, to either side.
    for side in (1.0, -1.0):
        one = Sensor(danger, Map(seams=("x", "y")))
        one.off(0.001)
        assert not one.walk(limit, 0.0, 60)
        assert not one.walk(0.0, side * (limit - 0.001), 60)
        assert hypot(limit, limit) < crossing
        assert one.walk(0.0, side * 0.002, 10)


def test_no_switch_beyond_the_crossing(danger: DangerConfig) -> None:
    crossing = EdgeLimits(GAP_M, danger).crossing_m
    sensor = Sensor(danger, Map(seams=("x", "y")))
    sensor.off(0.001)
    assert sensor.off(0.0, crossing + 0.001)
    assert [axis for *_, axis in sensor.map.asked_seam] == [None]


@pytest.mark.parametrize("heading", [0.5, -2.0])
def test_an_edge_met_in_turning_is_told_at_every_heading(danger: DangerConfig, heading: float) -> None:
    sensor = Sensor(danger, Map(is_rim=True), (1.0, 2.0, heading))
    sensor.off(HALF_BASE_M * 0.01 * 1.05, turn=0.01)
    assert not sensor.episode.is_from_turn


def test_on_and_the_way_back_from_an_edge_are_told(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map(is_rim=True))
    sensor.off(0.001)
    assert sensor.off(0.001)
    sensor.off(-0.003, -0.004)
    assert sensor.episode.retreat_m == pytest.approx(0.005)
    assert not sensor.episode.is_on
    sensor.on()
    assert sensor.episode.is_on
    sensor.off()
    assert not sensor.episode.is_on


def test_one_to_be_trusted_is_moved_back_from_where_it_is(danger: DangerConfig) -> None:
    sensor = Sensor(danger, Map(is_rim=True))
    sensor.off(0.001)
    assert sensor.off(0.001)
    sensor.episode.trust()
    sensor.off(-0.003, -0.004)
    assert sensor.episode.retreat_m == pytest.approx(0.005)
    sensor.episode.is_doubted = True
    sensor.episode.trust()
    assert (sensor.episode.is_doubted, sensor.episode.retreat_m) == (False, 0.0)
    assert sensor.episode.phase is EdgePhase.DECLARED
    sensor.off(0.0, 0.002)
    assert sensor.episode.retreat_m == pytest.approx(0.002)


def test_behind_a_switch_an_oblique_way_has_no_side_either(danger: DangerConfig) -> None:
    limit = GAP_M + danger.gap_tolerance_m + danger.seam_extra_m
    sensor = Sensor(danger, Map(seams=("x", "y")))
    sensor.off(0.0008, 0.0006)
    assert not sensor.walk(limit, 0.0, 60)
    assert sensor.map.asked_seam[-1][2] == "x"
    assert sensor.walk(0.0, -limit - 0.002, 60)
    assert sensor.episode.value_m < limit + 0.001
