"""One episode of the edge rule against a map that says what it is told: every threshold from both sides."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import acos, cos, hypot, inf, radians, sin
from types import SimpleNamespace
from typing import Any, NamedTuple, cast
from unittest.mock import ANY

import pytest

from ccatp.conditions import Condition
from ccatp.conditions.danger import (
    BEYOND_SEAM,
    NO_SEAM,
    OFF_WITHOUT_WHEELS,
    RIM_AHEAD,
)
from ccatp.config.load import load_config
from ccatp.safety.edge_episode import DIRECTION_TRAVEL_M, LONG_ON, EdgeEpisode, EdgeLimits, EdgePhase, FoundEdge
from ccatp.safety.edge_map import Axis, EdgeMap, SeamNear
from ccatp.safety.wheel_odometry import Odometry

GAP_M = 0.010
OFFSET = (0.09, -0.07)
RADIUS_M = hypot(*OFFSET)
HALF_BASE_M = 0.075
MOVED_M = 0.0007  # between two samples
SIGMA_M = 0.001
MAP0 = (5.0, 6.0)
UM = 1e-6
DANGER = load_config().danger
approx = pytest.approx
WIDTH_M = GAP_M + DANGER.gap_tolerance_m
LIMIT_M = WIDTH_M + DANGER.seam_extra_m  # across a seam
ALONG_M = WIDTH_M / cos(DANGER.max_crossing_angle_rad) + DANGER.seam_extra_m
CROSSING_M = EdgeLimits(GAP_M, DANGER).crossing_m
FREE_M = DANGER.no_map_travel_m  # where the map has nothing


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

    map: Map
    pose: tuple[float, float, float] = (1.0, 2.0, 0.0)
    turn: float = 0.0
    gap_m: float = GAP_M
    has_map: bool = True
    episode: EdgeEpisode = field(init=False)

    def __post_init__(self) -> None:
        limits = EdgeLimits(self.gap_m, DANGER)
        edge_map = cast(EdgeMap, self.map)
        self.episode = EdgeEpisode(limits, edge_map, self.odometry, OFFSET, step_m=MOVED_M, half_base_m=HALF_BASE_M)
        if self.has_map:
            self.episode.place_on_map(MAP0, self.pose[2] + self.turn, SIGMA_M)

    @property
    def edge(self) -> FoundEdge:
        assert self.episode.edge is not None
        return self.episode.edge

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


def test_the_limits_are_those_of_the_configuration() -> None:
    limits = EdgeLimits(GAP_M, DANGER)
    width, angle = GAP_M + DANGER.gap_tolerance_m, DANGER.max_crossing_angle_rad
    assert width / cos(angle) > DANGER.slanted_crossing_m
    assert limits.min_cosine == cos(angle)
    assert limits.crossing_m == approx(width / cos(angle) + width / sin(angle) + DANGER.seam_extra_m)
    assert (limits.width_m, limits.tolerance_m, limits.extra_m) == (width, DANGER.gap_tolerance_m, DANGER.seam_extra_m)


def test_a_new_episode() -> None:
    sensor = Sensor(Map(is_rim=True), has_map=False)
    episode = sensor.episode
    assert episode.phase is EdgePhase.FRESH
    assert episode.edge is None
    assert not episode.is_from_turn
    assert not episode.is_suspect
    assert not episode.is_on
    assert episode.retreat_m == 0.0
    assert episode.permits_turn
    assert episode.needs_map
    episode.place_on_map(MAP0, 0.0, SIGMA_M)
    assert not episode.needs_map
    assert not episode.look_ahead()
    assert sensor.map.asked_rim == []


def test_an_episode_on_its_way_needs_no_map_any_more() -> None:
    sensor = Sensor(Map(), has_map=False)
    sensor.off(0.001)
    assert sensor.episode.phase is EdgePhase.NO_MAP
    assert not sensor.episode.needs_map


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.0])
@pytest.mark.parametrize("turn", [0.0, 0.5, -1.2])
def test_the_map_is_asked_at_the_sensors_place_along_its_way(heading: float, turn: float) -> None:
    sensor = Sensor(Map(), (1.0, 2.0, heading), turn)
    sensor.off(0.0006, 0.0008)
    c, s = cos(turn), sin(turn)
    there = MAP0[0] + c * 0.0006 - s * 0.0008, MAP0[1] + s * 0.0006 + c * 0.0008
    way = c * 0.6 - s * 0.8, s * 0.6 + c * 0.8
    place, direction, reach_m, slack_m = sensor.map.asked_rim[0]
    assert place == approx(there)
    assert direction == approx(way)
    assert reach_m == DANGER.map_margin_m
    assert slack_m == approx(DANGER.map_sigmas * SIGMA_M)
    place, slack_m, axis = sensor.map.asked_seam[0]
    assert place == MAP0
    assert slack_m == approx(DANGER.gap_tolerance_m + DANGER.seam_extra_m + DANGER.map_sigmas * SIGMA_M + MOVED_M)
    assert axis is None


def test_silent_wheels_count_as_the_fastest() -> None:
    limit = DANGER.no_map_travel_m
    sensor = Sensor(Map(seams=("x",)))
    assert not sensor.off(0.0, worst_m=limit)
    assert sensor.off(0.0, worst_m=limit + UM)
    assert sensor.edge.cause is OFF_WITHOUT_WHEELS
    assert (sensor.edge.value_m, sensor.edge.limit_m) == (limit + UM, limit)


# -- ways off the panel -----------------------------------------------------------------------------------------------

Way = tuple[Any, ...]
CLEAR, RIM, X, Y, XY = Map(), Map(is_rim=True), Map(seams=("x",)), Map(seams=("y",)), Map(seams=("x", "y"))
NOWHERE = {"has_map": False}
BEGUN = (0.001, 0.0, 1)
SIGNS = (1.0, -1.0)


class Ways(NamedTuple):
    """Ways off the panel: (dx, dy, samples, turn). The last declares an edge, those before do not; no cause: none does.

    ``phase``: before the last way.
    """

    map: Map
    ways: Sequence[Way]
    cause: Condition | None = BEYOND_SEAM
    value: Any = ANY
    limit: Any = ANY
    phase: Any = ANY
    sensor: Mapping[str, Any] = {}


def aside(side: float) -> list[Way]:
    """To where the sensor went off, and then across that way."""
    ux, uy = 0.003 / hypot(0.003, 0.001), 0.001 / hypot(0.003, 0.001)
    across = [(-side * way_m * uy, side * way_m * ux, samples) for way_m, samples in ((FREE_M - UM, 20), (2 * UM, 2))]
    return [(0.003, 0.001, 1), (-0.01 * ux, -0.01 * uy, 20), *across]


def straight(angle: float, limit_m: float, near_m: float) -> list[Way]:
    """At an angle to the seam's normal: nearly as far as it allows, and on."""
    ways = ((limit_m - near_m, 40), (2 * near_m, 2))
    return [(way_m * cos(angle), way_m * sin(angle), samples) for way_m, samples in ways]


def oblique(angle: float) -> float:
    """How far: across, the seam ends earlier where the way is steep."""
    cosine = max(cos(angle), cos(DANGER.max_crossing_angle_rad))
    return min(WIDTH_M / cosine + DANGER.seam_extra_m, LIMIT_M / cos(angle))


WAYS = [
    # A direction takes some travel, and the rim counts from the debounced sample on.
    Ways(RIM, [(0.9 * DIRECTION_TRAVEL_M, 0, 1), (0.2 * DIRECTION_TRAVEL_M, 0, 1)], RIM_AHEAD, phase=EdgePhase.FRESH),
    Ways(RIM, [BEGUN, BEGUN], RIM_AHEAD, approx(0.002), 0.0, EdgePhase.RIM),
    # Without a map the travel away from the panel counts: going back is none, but going aside is.
    *(
        Ways(CLEAR, [(FREE_M - UM, 0, 20), (2 * UM, 0, 1)], NO_SEAM, approx(FREE_M + UM), FREE_M, EdgePhase.NO_MAP, one)
        for one in (NOWHERE, {})
    ),
    Ways(CLEAR, [BEGUN, (-0.05, 0, 20), (0, FREE_M + UM, 20)], NO_SEAM, sensor=NOWHERE),
    *(Ways(CLEAR, aside(side), NO_SEAM, approx(FREE_M, abs=2 * UM), sensor=NOWHERE) for side in SIGNS),
    # A seam allows its width across, forth only,
    *(
        Ways(
            seam, [(c * (LIMIT_M - UM), s * (LIMIT_M - UM), 20), (c * 2 * UM, s * 2 * UM, 1)],
            value=approx(LIMIT_M + UM), limit=approx(LIMIT_M), phase=EdgePhase.SEAM,
        )
        for seam, c, s in ((X, 1, 0), (X, -1, 0), (Y, 0, 1), (Y, 0, -1))
    ),
    Ways(X, [BEGUN, (-0.1, 0, 50), (0, 0, 1)], None, phase=EdgePhase.SEAM),
    # and more to an oblique way; as built, 1.2 mm wide: (gap + tolerance)/cos(angle) + 3 mm, which 22 + 3 mm end.
    *(
        Ways(X, straight(angle - turn, oblique(angle), 2 * UM), sensor={"turn": turn})
        for angle in (0.3, -0.6, 1.0, 1.3)
        for turn in (0.0, 0.6)
    ),
    *(
        Ways(X, straight(radians(degrees), allowed_m, 5e-5), sensor={"gap_m": 0.0012})
        for degrees, allowed_m in ((78.0, 0.01358), (83.0, 0.02105), (84.2, 0.02477), (88.0, 0.025))
    ),
    # Beside its direction a sensor's side is not known: either way across counts, and either way along.
    *(Ways(X, [(0, 0.001, 1), (sign * (LIMIT_M - 0.003), 0, 3), (sign * 0.004, 0, 4)]) for sign in SIGNS),
    Ways(X, [(0, 0.001, 1), (0, -ALONG_M, 40), (0, -0.002, 4)]),
    # Back across: no way over the seam for who came from there, one for who came from nowhere, as by a turn.
    *(
        Ways(X, [(0.001 * c, 0.001 * (1.0 - c * c) ** 0.5, 1), (-LIMIT_M - 0.002, 0, 30)], cause)
        for c, cause in ((0.2, BEYOND_SEAM), (0.4, None))
    ),
    Ways(
        X, [(0, 0, 1, 0.005), (-(LIMIT_M + 0.002) * cos(0.5), -(LIMIT_M + 0.002) * sin(0.5), 20)],
        sensor={"pose": (1.0, 2.0, 0.5), "turn": -0.5},
    ),
    # A turn away from the seam adds nothing.
    *(Ways(X, [(sign * 0.001, 0, 1), (0, 0, 20, -sign * 0.4)], None) for sign in SIGNS),
    # Where two seams cross: forth and back along one the way from the start counts, which ends with both chords;
    Ways(XY, [(0.001, CROSSING_M + 0.001, 60)], value=approx(CROSSING_M, abs=0.001)),
    Ways(XY, [BEGUN, (0, CROSSING_M + 0.001, 1)]),
    Ways(Y, [(0, LIMIT_M + 0.001, 20)]),  # there is no other
    # along the other one its width once more, to either side of the first way, which has no side any more.
    *(
        Ways(XY, [BEGUN, (LIMIT_M, 0, 60), (0, side * (LIMIT_M - 0.001), 60), (0, side * 0.002, 10)])
        for side in SIGNS
    ),
    Ways(XY, [(0.0008, 0.0006, 1), (LIMIT_M, 0, 60), (0, -LIMIT_M - 0.002, 60)], value=approx(LIMIT_M, abs=0.001)),
]  # fmt: skip


@pytest.mark.parametrize("case", WAYS)
def test_a_path_off_the_panel_is_an_edge_beyond_its_limit(case: Ways) -> None:
    sensor = Sensor(case.map, **case.sensor)
    *before, last = case.ways
    assert not any(sensor.walk(*way) for way in before)
    assert sensor.episode.phase == case.phase
    assert sensor.walk(*last) is (case.cause is not None)
    if case.cause is not None:
        assert not sensor.off(0.001)  # declared once
        assert (sensor.edge.cause, sensor.edge.limit_m) == (case.cause, case.limit)
        assert sensor.edge.value_m == case.value


def test_a_sensor_may_leave_a_seam_along_another_one_once() -> None:
    sensor = Sensor(Map(seams=("x", "y")))
    sensor.off(0.001, 0.0003)
    assert not sensor.walk(LIMIT_M, 0.3 * LIMIT_M, 60)  # 1 mm beyond what the first allows
    # The second allows what is left of both chords, and there is no third.
    assert sensor.walk(0.1, steps=200)
    assert sensor.edge.cause is BEYOND_SEAM
    ((x, y), slack_m, axis) = next(asked for asked in sensor.map.asked_seam if asked[2] is not None)
    assert len(sensor.map.asked_seam) == 2
    assert axis == "x"
    assert x == approx(MAP0[0] + LIMIT_M, abs=2e-3)
    assert y - MAP0[1] == approx(0.3 * (x - MAP0[0]), rel=0.05)
    assert slack_m > DANGER.gap_tolerance_m


@pytest.mark.parametrize("gap_m", [0.0012, 0.004, 0.005, GAP_M, 0.020])
def test_a_narrow_seam_may_be_crossed_at_a_greater_slant(gap_m: float) -> None:
    """Either the angle or the way across it bounds the slant, whichever allows more."""
    limits = EdgeLimits(gap_m, DANGER)
    width = gap_m + DANGER.gap_tolerance_m
    longest = max(DANGER.slanted_crossing_m, width / cos(DANGER.max_crossing_angle_rad))
    assert width / limits.min_cosine == approx(longest)
    angle = acos(limits.min_cosine)
    assert limits.crossing_m == approx(longest + width / sin(angle) + DANGER.seam_extra_m)


# -- turning ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_at_an_edge_found_in_a_turn_only_the_turn_back_is_permitted(sign: float) -> None:
    sensor = Sensor(Map(is_rim=True))
    assert not sensor.off(turn=sign * 0.005)
    assert sensor.off(turn=sign * 0.005)
    episode = sensor.episode
    assert episode.is_from_turn
    assert episode.permits_turn
    limit = DANGER.outward_turn_limit_m / RADIUS_M
    sensor.off(turn=sign * (limit - 1e-4))
    assert episode.permits_turn
    sensor.off(turn=-sign * 2.0)
    assert episode.permits_turn
    sensor.off(turn=sign * (2.0 + 2e-4))
    assert not episode.permits_turn
    sensor.off(turn=-sign * 3.0)
    assert not episode.permits_turn


def test_an_edge_found_in_driving_permits_no_turn() -> None:
    sensor = Sensor(Map(is_rim=True))
    # Less translation than half the wheel base per radian is a turn, more is none.
    sensor.off(HALF_BASE_M * 0.1 * 1.01, turn=0.1)
    assert not sensor.episode.is_from_turn
    sensor.off(0.001)
    assert not sensor.episode.permits_turn
    turning = Sensor(Map(is_rim=True))
    turning.off(HALF_BASE_M * 0.1 * 0.99, turn=0.1)
    assert turning.episode.is_from_turn


# -- looking ahead ----------------------------------------------------------------------------------------------------


def test_a_seam_may_lead_to_the_rim() -> None:
    sensor = Sensor(Map(seams=("x",)))
    sensor.off(0.001)
    sensor.off(0.001)
    sensor.map.asked_rim.clear()
    assert not sensor.episode.look_ahead()
    place, direction, reach_m, slack_m = sensor.map.asked_rim[0]
    assert place == approx((MAP0[0] + 0.002, MAP0[1]))
    assert direction == approx((1.0, 0.0))
    assert (reach_m, slack_m) == (DANGER.map_margin_m, DANGER.map_sigmas * SIGMA_M)
    # Along what has been travelled since, and not without travel.
    sensor.map.asked_rim.clear()
    sensor.map.is_rim = True
    assert not sensor.episode.look_ahead()
    assert sensor.map.asked_rim == []
    sensor.off(0.0, -0.9 * DIRECTION_TRAVEL_M)
    assert not sensor.episode.look_ahead()
    sensor.off(0.0, -0.2 * DIRECTION_TRAVEL_M)
    assert sensor.episode.look_ahead()
    assert sensor.map.asked_rim[0][1] == approx((0.0, -1.0))
    assert sensor.edge.cause is RIM_AHEAD
    assert sensor.edge.value_m == approx(hypot(0.002, 1.1 * DIRECTION_TRAVEL_M))


def test_looking_ahead_goes_by_the_way_since_the_last_look() -> None:
    sensor = Sensor(Map(seams=("x",)))
    for dx, dy in ((0.001, 0.002), (0.0, 0.001), (0.001, 0.0), (-0.003, 0.004)):
        sensor.off(dx, dy)
        sensor.map.asked_rim.clear()
        assert not sensor.episode.look_ahead()
        assert sensor.map.asked_rim[0][1] == approx((dx / hypot(dx, dy), dy / hypot(dx, dy)))


def test_no_looking_ahead_while_on_or_without_a_place() -> None:
    sensor = Sensor(Map(seams=("x",)))
    sensor.off(0.001)
    sensor.off(0.001)
    sensor.map.is_rim = True
    assert not sensor.on(0.001)
    assert not sensor.episode.look_ahead()
    assert sensor.episode.edge is None
    lost = Sensor(Map(is_rim=True), has_map=False)
    lost.off(0.001)
    lost.off(0.001)
    assert not lost.episode.look_ahead()


@pytest.mark.parametrize("early", [1, 0])
def test_looking_ahead_waits_for_the_debounced_sample(early: int) -> None:
    sensor = Sensor(Map(seams=("x",)))
    for _ in range(DANGER.debounce_samples - early):
        sensor.off(0.001)
    sensor.map.is_rim = True
    assert sensor.episode.look_ahead() is not bool(early)
    assert sensor.episode.phase is EdgePhase.RIM
    assert (sensor.episode.edge is None) is bool(early)
    assert sensor.off(0.0) is bool(early)  # declared once


# -- back on ----------------------------------------------------------------------------------------------------------


def test_an_episode_ends_on_the_panel_after_some_way() -> None:
    sensor = Sensor(Map())
    sensor.off(0.001)
    clear = DANGER.clear_samples
    assert not sensor.stay(clear - 1, 0.001)
    assert sensor.on(0.0)  # 19 mm on
    near = Sensor(Map())
    near.off(0.001)
    assert not near.stay(clear)
    assert not near.on(DANGER.no_map_travel_m - UM)
    assert near.on(2 * UM)


def test_the_way_on_the_panel_counts_from_the_first_sample_on() -> None:
    episode, there = Sensor(Map()).episode, (DANGER.no_map_travel_m, 0.0)
    assert not episode.see_on((0.0, 0.0))
    ended = [episode.see_on(there) for _ in range(DANGER.clear_samples - 1)]
    assert ended == [False] * (DANGER.clear_samples - 2) + [True]


@pytest.mark.parametrize("is_edge", [False, True])
def test_at_rest_an_episode_ends_after_a_long_time_and_an_edge_once_the_sensor_is_on(is_edge: bool) -> None:
    sensor = Sensor(Map(is_rim=is_edge))
    sensor.off(0.001)
    assert sensor.off(0.001) is is_edge
    assert LONG_ON * DANGER.clear_samples == 200  # 0.2 s
    assert not sensor.stay((1 if is_edge else LONG_ON) * DANGER.clear_samples - 1)
    assert sensor.on()


def test_after_chatter_the_count_starts_again() -> None:
    sensor = Sensor(Map())
    sensor.off(0.001)
    for _ in range(3):
        assert not sensor.stay(DANGER.clear_samples - 1)
        sensor.off()
    # The way on the panel counts from where it came back last.
    assert not sensor.on(0.02)
    assert not sensor.stay(DANGER.clear_samples)


def test_an_unknown_position_makes_every_seam_possible() -> None:
    sensor = Sensor(Map())
    sensor.episode.place_on_map(MAP0, 0.0, inf)
    sensor.off(0.001)
    assert sensor.map.asked_seam[0][1] == inf
    assert sensor.episode.phase is EdgePhase.NO_MAP


# -- what counts across, from both sides ------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("heading", [0.0, 3.0])
def test_motion_by_a_turn_counts_across_the_seam(sign: float, heading: float) -> None:
    """The robot drives on to the seam and then turns: the sensor goes on across it without the robot."""
    limit = GAP_M + DANGER.gap_tolerance_m + DANGER.seam_extra_m
    sensor = Sensor(Map(seams=("x",)), (0.0, 0.0, heading), -heading)
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
    assert sensor.edge.value_m == approx(limit, abs=1e-4)


def test_a_sensor_about_which_the_robot_turns_does_not_move() -> None:
    sensor = Sensor(Map(seams=("x",)))
    x, y = sensor.place
    for k in range(1, 60):
        heading = 0.01 * k
        c, s = cos(heading), sin(heading)
        sensor.pose = x - c * OFFSET[0] + s * OFFSET[1], y - s * OFFSET[0] - c * OFFSET[1], heading
        assert not sensor.off()


@pytest.mark.parametrize("heading", [0.5, -2.0])
def test_an_edge_found_in_a_turn_is_recognized_at_every_heading(heading: float) -> None:
    sensor = Sensor(Map(is_rim=True), (1.0, 2.0, heading))
    sensor.off(HALF_BASE_M * 0.01 * 1.05, turn=0.01)
    assert not sensor.episode.is_from_turn


def test_on_and_the_way_back_from_an_edge_are_reported() -> None:
    sensor = Sensor(Map(is_rim=True))
    sensor.off(0.001)
    assert sensor.off(0.001)
    sensor.off(-0.003, -0.004)
    assert sensor.episode.retreat_m == approx(0.005)
    assert not sensor.episode.is_on
    sensor.on()
    assert sensor.episode.is_on
    sensor.off()
    assert not sensor.episode.is_on


def test_after_a_confirmation_the_retreat_is_measured_from_there() -> None:
    sensor = Sensor(Map(is_rim=True))
    sensor.off(0.001)
    assert sensor.off(0.001)
    sensor.episode.confirm()
    sensor.off(-0.003, -0.004)
    assert sensor.episode.retreat_m == approx(0.005)
    sensor.episode.is_suspect = True
    sensor.episode.confirm()
    assert (sensor.episode.is_suspect, sensor.episode.retreat_m) == (False, 0.0)
    assert sensor.episode.edge is not None
    sensor.off(0.0, 0.002)
    assert sensor.episode.retreat_m == approx(0.002)
