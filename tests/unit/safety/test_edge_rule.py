"""The edge rule's own part: which samples count, what an episode is opened with, lifted and put back."""

from dataclasses import dataclass, field
from math import cos, hypot, pi, radians, sin
from typing import Any, cast

import pytest
from msgspec.structs import astuple

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import DeckPose, EdgeSample, WheelSample
from ccatp.links.topics import EstimateMessage
from ccatp.mirror.rim import Rim
from ccatp.safety.edge_episode import EdgeEpisode, EdgePhase
from ccatp.safety.edge_map import EdgeMap, SeamNear
from ccatp.safety.edge_rule import CentreClearanceCheck, EdgeRule

MS = 1e-3
OFF_FL = (0, 1, 1, 1)
ON, OFF = (1, 1, 1, 1), (0, 0, 0, 0)
SEAM = SeamNear("x", 0.0)


@pytest.fixture(scope="module")
def cfg() -> Config:
    return load_config()


@dataclass
class Map:
    """A map without rim, and without seams unless told, that keeps what it was asked."""

    gap_m: float = 0.01
    is_rim: bool = False
    placed: list[tuple[Any, ...]] = field(default_factory=list)
    slacks_m: list[float] = field(default_factory=list)
    rims: list[tuple[Any, ...]] = field(default_factory=list)
    seam: SeamNear | None = None

    def place(self, pose: Any, offset_m: Any) -> tuple[float, float]:
        self.placed.append((pose, offset_m))
        return 5.0, 6.0

    def is_rim_ahead(self, *asked: Any) -> bool:
        self.rims.append(asked)
        return self.is_rim

    def seam_at(self, place: Any, slack_m: float, not_axis: Any = None) -> SeamNear | None:
        self.slacks_m.append(slack_m)
        return self.seam


class Rule:
    """The rule, fed with a sample per millisecond at a constant velocity."""

    def __init__(self, cfg: Config) -> None:
        self.cfg, self.map = cfg, Map()
        self.rule = EdgeRule(cast(EdgeMap, self.map), cfg.robot, cfg.danger)
        self.t_s = 0.0

    def feed(self, values: list[tuple[int, int, int, int]], v: float = 0.0, omega: float = 0.0, **rest: Any) -> None:
        robot = self.cfg.robot
        half = 0.5 * omega * robot.wheel_base_m
        right, left = (v + half) / robot.wheel_radius_m, (v - half) / robot.wheel_radius_m
        wheels, samples = [], []
        for a, b, c, d in values:
            self.t_s += MS
            wheels.append(WheelSample(self.t_s, right, left))
            samples.append(EdgeSample(self.t_s, a, b, c, d))
        self.rule.track.push(wheels)
        self.rule.step(samples, rest.get("estimate"))

    def estimate(self, age_s: float = 0.0, sigma_m: float = 0.001) -> EstimateMessage:
        return EstimateMessage(
            seq=0, t_s=self.t_s - age_s, x_m=1.0, y_m=2.0, heading_rad=0.5, sigma_m=sigma_m, state="driving"
        )


@pytest.fixture
def rule(cfg: Config) -> Rule:
    return Rule(cfg)


def test_a_new_rule_is_idle(rule: Rule) -> None:
    under_test = rule.rule
    assert under_test.is_idle
    assert not under_test.is_lifted
    assert under_test.episodes == [None] * 4
    assert under_test.opened == under_test.declared == [0, 0, 0, 0]
    rule.feed([])
    rule.feed([ON] * 10)
    assert under_test.is_idle


@pytest.mark.parametrize("k", range(4))
def test_each_sensor_opens_its_own_episode_and_declares_its_own_edge(rule: Rule, k: int) -> None:
    values = tuple(int(i != k) for i in range(4))
    rule.feed([cast(Any, values)] * 10, v=0.1 if k < 2 else -0.1)
    only = [int(i == k) for i in range(4)]
    assert rule.rule.opened == only
    assert [episode is not None for episode in rule.rule.episodes] == [bool(i) for i in only]
    assert rule.rule.declared == [0, 0, 0, 0]
    # 5 mm off without an explanation
    rule.feed([cast(Any, values)] * 60, v=0.1 if k < 2 else -0.1)
    assert rule.rule.declared == only


def test_the_sensor_may_have_gone_off_as_early_as_the_sample_before(rule: Rule) -> None:
    rule.feed([ON] * 10, v=0.1, omega=0.2)
    rule.feed([OFF_FL] * 10, v=0.1, omega=0.2, estimate=rule.estimate())
    danger, (ox, oy) = rule.cfg.danger, rule.cfg.robot.edge_sensors_m[0]
    moved_m = (0.1 + 0.2 * hypot(ox, oy)) * MS
    slack_m = danger.gap_tolerance_m + danger.seam_extra_m + danger.map_sigmas * 0.001 + moved_m
    assert rule.map.slacks_m[0] == pytest.approx(slack_m, rel=1e-9)


def test_without_a_sample_before_nothing_is_known_of_its_way(rule: Rule) -> None:
    rule.feed([OFF_FL] * 10, v=0.1, estimate=rule.estimate())
    danger = rule.cfg.danger
    slack_m = danger.gap_tolerance_m + danger.seam_extra_m + danger.map_sigmas * 0.001
    assert rule.map.slacks_m[0] == pytest.approx(slack_m, rel=1e-9)


@pytest.mark.parametrize("omega", [0.5, -0.5])
def test_turning_in_place_is_recognized_by_half_the_wheel_base(rule: Rule, omega: float) -> None:
    half_m = 0.5 * rule.cfg.robot.wheel_base_m
    for share, is_turn in ((0.95, True), (1.05, False)):
        one = Rule(rule.cfg)
        one.feed([ON] * 10, v=share * half_m * abs(omega), omega=omega)
        one.feed([OFF_FL] * 10, v=share * half_m * abs(omega), omega=omega)
        episode = one.rule.episodes[0]
        assert episode is not None
        assert episode.is_from_turn is is_turn


def test_an_estimate_of_the_past_is_carried_to_the_sample(rule: Rule) -> None:
    for _ in range(14):
        rule.feed([ON] * 10, v=0.1)
    rule.feed([OFF_FL] * 10, v=0.1, estimate=rule.estimate(age_s=0.1))
    pose, offset_m = rule.map.placed[0]
    x_m, y_m, heading_rad = astuple(pose)
    # The estimate of 0.1 s before the frame, and a millisecond to the first sample off.
    way_m = 0.1 * 0.101
    assert (x_m, y_m) == pytest.approx((1.0 + way_m * cos(0.5), 2.0 + way_m * sin(0.5)), abs=1e-6)
    assert heading_rad == pytest.approx(0.5)
    assert offset_m == rule.cfg.robot.edge_sensors_m[0]


@pytest.mark.parametrize("key", ["stale_after_s", "estimate_stale_after_s"])
def test_the_track_reaches_back_as_far_as_data_may_be_old(cfg: Config, key: str) -> None:
    rule = Rule(cfg.model_copy(update={"danger": cfg.danger.model_copy(update={key: 0.08})}))
    for _ in range(40):
        rule.feed([ON] * 10, v=0.1)
    assert rule.rule.track.knots == []  # nothing is read while nothing is off
    rule.feed([OFF_FL] * 10, v=0.1)
    oldest_s = rule.rule.track.knots[0].t_s
    reach_s = 2.0 * max(rule.cfg.danger.stale_after_s, rule.cfg.danger.estimate_stale_after_s)
    assert rule.t_s - oldest_s == pytest.approx(reach_s, abs=0.011)


def test_a_sample_counts_once(rule: Rule) -> None:
    rule.feed([ON] * 10, v=0.01)
    rule.feed([OFF_FL], v=0.01)
    again = EdgeSample(rule.t_s, *OFF)
    for _ in range(5):
        rule.rule.step([again], None)
    assert rule.rule.opened == [1, 0, 0, 0]
    assert not rule.rule.is_lifted


def test_lifted_needs_as_many_samples_in_a_row_and_so_does_being_put_back(rule: Rule) -> None:
    danger, under_test = rule.cfg.danger, rule.rule
    assert danger.lifted_samples == 2
    rule.feed([OFF, OFF_FL, OFF])
    assert not under_test.is_lifted
    rule.feed([OFF])
    assert under_test.is_lifted
    assert under_test.opened == [1, 1, 1, 1]
    rule.feed([ON] * (danger.clear_samples - 1))
    rule.feed([OFF_FL])
    rule.feed([ON] * (danger.clear_samples - 1))
    assert under_test.is_lifted
    assert not under_test.is_idle
    rule.feed([ON])
    assert not under_test.is_lifted
    assert under_test.episodes == [None] * 4
    assert under_test.is_idle


def test_lifted_keeps_the_rule_awake_without_an_episode(rule: Rule) -> None:
    rule.feed([OFF] * 3)
    rule.rule.episodes = [None] * 4
    rule.feed([ON])
    assert not rule.rule.is_idle


def test_a_reset_keeps_only_the_counts(rule: Rule) -> None:
    rule.feed([OFF], v=0.1)
    rule.rule.reset()
    rule.t_s = 0.0
    rule.feed([OFF], v=0.1)
    assert not rule.rule.is_lifted  # one before the reset and one after it are not two in a row
    assert rule.rule.opened == [2, 2, 2, 2]


def test_a_reset_drops_the_wheel_samples_of_the_old_clock(rule: Rule) -> None:
    rule.feed([ON] * 200)
    rule.rule.reset()
    rule.t_s = 0.0
    rule.feed([OFF_FL] * 70, v=0.1)
    assert rule.rule.declared == [1, 0, 0, 0]


def test_after_the_robot_is_put_back_the_episodes_start_again(rule: Rule) -> None:
    rule.feed([OFF_FL] * 80, v=0.1)
    assert rule.rule.episodes[0] is not None
    assert rule.rule.episodes[0].edge is not None
    rule.feed([OFF] * 3 + [ON] * 20)  # lifted, and on its wheels for as long as it takes
    assert rule.rule.episodes == [None] * 4


def test_a_robot_that_stands_with_all_sensors_on_was_not_put_back(rule: Rule) -> None:
    rule.feed([OFF_FL] * 10, v=0.1)
    rule.feed([ON] * 2 * rule.cfg.danger.clear_samples)
    assert rule.rule.episodes[0] is not None


def test_an_edge_seen_ahead_is_counted_once(rule: Rule) -> None:
    rule.feed([ON] * 10, v=0.05)
    rule.feed([OFF_FL] * 20, v=0.05, estimate=rule.estimate())
    assert rule.rule.declared == [0, 0, 0, 0]
    rule.map.is_rim = True
    for _ in range(3):
        rule.feed([OFF_FL] * 10, v=0.05)
        assert rule.rule.declared == [1, 0, 0, 0]


# -- (e) a fix --------------------------------------------------------------------------------------------------------


def declared(rule: Rule, sigma_m: float = 0.001) -> EdgeEpisode:
    """An edge, and after it the sensor stays off while the robot is moved back and comes to rest."""
    rule.feed([OFF_FL] * 80, v=0.1, estimate=rule.estimate(sigma_m=sigma_m))
    rule.feed([OFF_FL] * 100, v=-0.1, estimate=rule.estimate(sigma_m=sigma_m))
    rule.feed([OFF_FL] * 10, estimate=rule.estimate(sigma_m=sigma_m))
    episode = rule.rule.episodes[0]
    assert episode is not None
    assert episode.edge is not None
    rule.map.slacks_m.clear()
    rule.map.rims.clear()
    return episode


def measured(rule: Rule, sigma_m: float, *, v: float = 0.0, omega: float = 0.0, flags: Any = OFF_FL) -> EdgeEpisode:
    rule.feed([flags] * 10, v=v, omega=omega, estimate=rule.estimate(sigma_m=sigma_m))
    episode = rule.rule.episodes[0]
    assert episode is not None
    return episode


def phase_of(episode: EdgeEpisode) -> EdgePhase:
    """The phase as it is now: a checker of types would take it for what it was at the last look."""
    return episode.phase


def test_a_sensor_that_a_fix_shows_over_a_seam_starts_a_new_episode_there(rule: Rule) -> None:
    known = declared(rule)
    rule.map.seam = SEAM
    anew = measured(rule, 4.9e-4)
    assert anew is not known
    assert phase_of(anew) is EdgePhase.FRESH
    assert (rule.rule.opened[0], rule.rule.declared[0]) == (2, 1)
    # It is tied to the map by the fix, give or take 0.1 rad: the seam explains it, and so far only.
    rule.feed([OFF_FL] * 10, v=0.1)
    assert phase_of(anew) is EdgePhase.SEAM
    rule.map.seam = None  # where it ends, no other crosses it
    rule.feed([OFF_FL] * 200, v=0.1)
    assert anew.edge is not None


def test_the_map_is_asked_with_the_slack_of_fix_and_heading(rule: Rule, cfg: Config) -> None:
    declared(rule)
    measured(rule, 4e-4)
    aside_m = 0.1 * hypot(*cfg.robot.edge_sensors_m[0])
    slack_m = cfg.danger.map_sigmas * 4e-4 + aside_m
    assert rule.map.slacks_m == [pytest.approx(cfg.danger.gap_tolerance_m + slack_m)]
    assert rule.map.rims == [((5.0, 6.0), (1.0, 0.0), 0.0, pytest.approx(cfg.danger.map_margin_m + slack_m))]
    assert rule.map.placed[-1] == (DeckPose(1.0, 2.0, 0.5), cfg.robot.edge_sensors_m[0])
    rule.map.seam = SEAM
    declared(rule, 0.01)
    anew = measured(rule, 4e-4, v=4e-4)  # how late it was noticed has no part in it
    rule.map.slacks_m.clear()
    rule.feed([OFF_FL] * 5, v=0.1)
    assert anew.phase is EdgePhase.SEAM
    extra_m = cfg.danger.gap_tolerance_m + cfg.danger.seam_extra_m
    assert rule.map.slacks_m == [pytest.approx(extra_m + slack_m)]


def test_a_sensor_that_a_fix_shows_at_the_rim_is_not_suspect(rule: Rule) -> None:
    episode = declared(rule)
    assert episode.retreat_m > 0.007
    episode.is_suspect = rule.map.is_rim = True
    assert measured(rule, 4.9e-4) is episode
    assert episode.edge is not None
    assert not episode.is_suspect
    # From here on the way back counts anew.
    assert episode.retreat_m == 0.0
    rule.feed([OFF_FL] * 50, v=-0.1)
    assert episode.retreat_m == pytest.approx(0.005, abs=1e-4)


def test_a_sensor_that_a_fix_shows_at_no_edge_stays_suspect(rule: Rule) -> None:
    episode = declared(rule)
    episode.is_suspect = True
    assert measured(rule, 4.9e-4) is episode
    assert episode.is_suspect
    assert episode.retreat_m > 0.007


@pytest.mark.parametrize(
    ("sigma_m", "v", "omega", "is_fix"),
    [
        *((sigma_m, 0.0, 0.0, False) for sigma_m in (5e-4, 9e-4, 1e-3, 2e-3)),  # less than half the sigma is one
        *((1e-5, v, 0.0, False) for v in (6e-4, -6e-4)),  # a robot that moves has none
        *((1e-5, 0.0, omega, False) for omega in (0.008, -0.008)),
        (1e-5, 4e-4, 0.0, True),  # but for noise it stands
        (1e-5, 0.0, -0.004, True),
    ],
)
def test_which_decrease_of_sigma_is_a_fix(rule: Rule, sigma_m: float, v: float, omega: float, is_fix: bool) -> None:
    episode = declared(rule)
    rule.map.seam = SEAM
    assert (measured(rule, sigma_m, v=v, omega=omega) is not episode) is is_fix
    if v or omega:
        assert (measured(rule, 1e-5) is not episode) is is_fix  # nor afterwards


def test_a_fix_is_compared_with_the_largest_sigma_since_the_robot_stands(rule: Rule) -> None:
    episode = declared(rule)
    rule.map.seam = SEAM
    measured(rule, 3e-3)
    assert measured(rule, 1.6e-3) is episode
    assert measured(rule, 1.4e-3) is not episode


def test_each_fix_counts_once(rule: Rule) -> None:
    declared(rule)
    measured(rule, 1e-5)
    rule.map.seam = SEAM
    episode = measured(rule, 1e-5)
    assert episode.edge is not None
    assert measured(rule, 1e-5) is episode


def test_a_fix_changes_no_episode_without_an_edge_or_on_again(rule: Rule) -> None:
    episode = declared(rule)
    rule.map.seam = SEAM
    assert measured(rule, 1e-5, flags=ON) is episode
    fresh = Rule(rule.cfg)
    fresh.feed([OFF_FL] * 10, estimate=fresh.estimate())
    fresh.map.seam, known = SEAM, fresh.rule.episodes[0]
    assert measured(fresh, 1e-5) is known


def test_without_an_estimate_there_is_no_fix(rule: Rule) -> None:
    episode = declared(rule)
    rule.map.seam = SEAM
    rule.feed([OFF_FL] * 10)
    assert rule.rule.episodes[0] is episode


def test_a_reset_drops_the_largest_sigma(rule: Rule) -> None:
    declared(rule)
    rule.rule.reset()
    rule.feed([OFF_FL] * 80, v=0.1)
    episode = rule.rule.episodes[0]
    rule.map.seam = SEAM
    assert measured(rule, 1e-5) is episode


# -- the centre -------------------------------------------------------------------------------------------------------


class Wall:
    """A straight rim through the origin, ``normal_rad`` inwards, that counts how often it was asked."""

    def __init__(self, normal_rad: float = 0.0) -> None:
        self.asked, self._normal_rad = 0, normal_rad

    def signed_distance_m(self, x: float, y: float) -> float:
        self.asked += 1
        return x * cos(self._normal_rad) + y * sin(self._normal_rad)


def centre_at(x_m: float, y_m: float = 0.0, heading_rad: float = pi) -> EstimateMessage:
    """Without another heading it is towards the wall at x = 0."""
    return EstimateMessage(seq=0, t_s=0.0, x_m=x_m, y_m=y_m, heading_rad=heading_rad, sigma_m=0.0, state="driving")


def test_the_clearance_is_looked_up_when_it_may_be_short_and_ten_times_a_second(cfg: Config) -> None:
    wall = Wall()
    check = CentreClearanceCheck(cast(Rim, wall), cfg.robot, cfg.danger)
    check.step(0.0, centre_at(1.0), ())
    limit_m, fastest_m_s = check.limit_m, cfg.robot.wheel_radius_m * cfg.robot.max_wheel_rad_s
    looks = {0.0999: 1, 0.1001: 2}
    for t_s, count in looks.items():
        check.step(t_s, centre_at(limit_m + 0.04 * fastest_m_s), ())
        assert wall.asked == count
    for t_s, count in {0.1400: 2, 0.1402: 3}.items():
        check.step(t_s, centre_at(1.0), ())
        assert wall.asked == count


@pytest.mark.parametrize(("sum_rad_s", "direction"), [(0.0199, 0), (0.0201, 1), (-0.0201, 0)])
def test_the_centre_at_the_rim_bars_the_way_that_it_takes_outwards(
    cfg: Config, sum_rad_s: float, direction: int
) -> None:
    check = CentreClearanceCheck(cast(Rim, Wall()), cfg.robot, cfg.danger)
    check.step(0.0, centre_at(0.001), [WheelSample(0.0, 0.5 * sum_rad_s, 0.5 * sum_rad_s)])
    assert check.direction == direction


@pytest.mark.parametrize("wheel_rad_s", [1.0, -1.0])
@pytest.mark.parametrize("heading_deg", range(0, 360, 30))
@pytest.mark.parametrize("normal_deg", [10, 100, 190, 280])
def test_only_the_way_outwards_is_barred_whatever_the_heading_and_the_rim(
    cfg: Config, normal_deg: int, heading_deg: int, wheel_rad_s: float
) -> None:
    normal_rad, heading_rad = radians(normal_deg), radians(heading_deg)
    check = CentreClearanceCheck(cast(Rim, Wall(normal_rad)), cfg.robot, cfg.danger)
    here = centre_at(0.001 * cos(normal_rad), 0.001 * sin(normal_rad), heading_rad)
    check.step(0.0, here, [WheelSample(0.0, wheel_rad_s, wheel_rad_s)])
    is_outwards = wheel_rad_s * cos(heading_rad - normal_rad) < 0.0
    assert check.direction == (wheel_rad_s if is_outwards else 0.0)
