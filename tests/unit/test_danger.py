"""Unit tests of the danger rules: stories in virtual time, with scripted samples, on thesis-m1 (10 mm seams)."""

from dataclasses import dataclass, field
from math import cos, inf, nan, pi, sin
from typing import Any
from weakref import ReferenceType, ref

import pytest
from msgspec.structs import astuple

from ccatp.conditions import text_of
from ccatp.conditions.danger import (
    BEYOND_SEAM,
    CENTRE_NEAR_RIM,
    EDGE_SENSOR_CHATTERS,
    NO_SEAM,
    OFF_WITHOUT_WHEELS,
    RIM_AHEAD,
)
from ccatp.config.models import Config
from ccatp.core import Corner, DeckPose, EdgeSample, EventCode, Verdict, WheelSample
from ccatp.danger import DangerMonitor
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.mirror.mirror import Mirror
from ccatp.safety.edge_map import EdgeMap
from ccatp.safety.wheel_odometry import KNOTS_KEPT, Odometry, WheelTrack, pose_at
from tests.support.scenario import World, config_of

FL, FR, RL, RR = ("front_left",), ("front_right",), ("rear_left",), ("rear_right",)
FRONT, ALL = FL + FR, FL + FR + RL + RR
NO_PERMIT, ANY_PERMIT = (False, False, False), (True, True, True)


def frame_of(seq: int, t: float, enc: list[WheelSample], edge: list[EdgeSample]) -> Sensors:
    return Sensors(seq, t, [], enc, edge, None, (0.8, 0.8), 1.0, CommandEcho(0, 0.0, 0.0, False), [])


@pytest.fixture
def cfg(thesis: World) -> Config:
    return thesis.cfg


@pytest.fixture
def mirror(thesis: World) -> Mirror:
    return thesis.mirror


@dataclass
class Story:
    """Feeds frames of ten samples: the robot moves as told, the sensors are what they are told to be."""

    cfg: Config
    mirror: Mirror
    pose: tuple[float, float, float]
    sigma_m: float = 1e-4
    state: str = "driving"
    has_estimate: bool = True
    has_wheels: bool = True
    seq: int = 0
    t: float = 0.0
    monitor: DangerMonitor = field(init=False)

    def __post_init__(self) -> None:
        self.monitor = DangerMonitor(self.mirror, self.cfg.robot, self.cfg.danger)

    def frame(self, v: float = 0.0, omega: float = 0.0, off: tuple[str, ...] = (), flags: str = "1" * 10) -> Verdict:
        """One frame at that velocity; ``flags``: per sample 0 where the sensors named in ``off`` are off."""
        r, base = self.cfg.robot.wheel_radius_m, self.cfg.robot.wheel_base_m
        right, left = (v + 0.5 * omega * base) / r, (v - 0.5 * omega * base) / r
        estimate = EstimateMessage(
            seq=self.seq, t_s=self.t, x_m=self.pose[0], y_m=self.pose[1], heading_rad=self.pose[2],
            sigma_m=self.sigma_m, state=self.state,
        )  # fmt: skip
        enc, edge = [], []
        for k in range(10):
            self.t += 1e-3
            enc.append(WheelSample(self.t, right, left))
            is_off = flags[k] == "0" if "0" in flags else bool(off)
            edge.append(EdgeSample(self.t, *(int(not (is_off and c.value in off)) for c in Corner)))
        self.seq += 1
        track = WheelTrack(r, base, 1.0, 1.0)
        track.push(enc)
        track.update(self.t)
        moved = Odometry(track, self.t - 0.01, self.pose)
        moved.advance_to(self.t)
        self.pose = moved.x_m, moved.y_m, moved.heading_rad
        frame = frame_of(self.seq, self.t, enc if self.has_wheels else [], edge)
        return self.monitor.step(frame, estimate if self.has_estimate else None)

    def run(self, frames: int, v: float = 0.0, omega: float = 0.0, off: tuple[str, ...] = ()) -> Verdict:
        for _ in range(frames):
            self.frame(v, omega, off)
        return self.monitor.verdict


@pytest.fixture
def on_panel(cfg: Config, mirror: Mirror) -> Story:
    """In the middle of a panel, far from seams and rim."""
    panel = list(mirror.panels.values())[40]
    return Story(cfg, mirror, (panel.x_m, panel.y_m, 0.0))


@pytest.fixture
def at_seam(cfg: Config, mirror: Mirror) -> Story:
    """Heading +x, the front sensors 1 mm before a seam."""
    panel = list(mirror.panels.values())[40]
    return Story(cfg, mirror, (panel.x_m + panel.half_x_m - 0.091, panel.y_m, 0.0))


@pytest.fixture
def at_rim(cfg: Config, mirror: Mirror) -> Story:
    """Heading +x in the middle row, the front sensors 1 mm before the rim."""
    right = max(mirror.panels.values(), key=lambda panel: (panel.x_m, -abs(panel.y_m)))
    return Story(cfg, mirror, (right.x_m + right.half_x_m - 0.091, right.y_m, 0.0))


def permits(verdict: Verdict) -> tuple[bool, bool, bool]:
    return verdict.forward, verdict.reverse, verdict.turn


# -- normal operation -------------------------------------------------------------------------------------------------


def test_normal_operation_permits_everything(on_panel: Story) -> None:
    verdict = on_panel.run(3, v=0.1)
    assert verdict == Verdict.normal(3, verdict.t_s)
    assert on_panel.monitor.counts["episodes"] == dict.fromkeys(Corner, 0)


def test_nothing_is_permitted_before_the_first_frame(on_panel: Story) -> None:
    assert permits(on_panel.monitor.verdict) == NO_PERMIT


# -- (a) rim ----------------------------------------------------------------------------------------------------------


def test_a_rim_is_an_edge_at_the_second_off_sample(at_rim: Story) -> None:
    verdict = at_rim.frame(0.1, off=FRONT, flags="1111111100")
    assert verdict.code is EventCode.NORMAL  # not moved far enough to have a direction
    verdict = at_rim.frame(0.1, off=FRONT)
    assert (verdict.code, text_of(verdict.cause), verdict.signal) == (
        EventCode.NEAR_EDGE,
        RIM_AHEAD.message,
        "front_left",
    )
    assert verdict.value < 0.0005  # m of travel: three samples at 0.1 m/s
    assert permits(verdict) == (False, True, False)
    assert verdict.off == (True, True, False, False)
    assert at_rim.monitor.counts["edges"][Corner.FRONT_LEFT] == 1


@pytest.mark.parametrize(
    ("ahead_m", "heading", "v", "off", "permitted"),
    [
        (0.0, pi, -0.1, RL, (True, False, False)),
        (0.091, pi / 2, 0.05, FR + RR, NO_PERMIT),  # front and rear bar both
    ],
)
def test_a_sensor_over_the_rim_bars_its_direction(
    at_rim: Story, ahead_m: float, heading: float, v: float, off: tuple[str, ...], permitted: tuple[bool, bool, bool]
) -> None:
    x, y, _ = at_rim.pose
    at_rim.pose = (x + ahead_m, y, heading)
    verdict = at_rim.run(2, v=v, off=off)
    assert permits(verdict) == permitted
    assert verdict.off == tuple(corner.value in off for corner in Corner)


def test_a_sensor_over_a_gap_behind_does_not_keep_the_edge_alive(at_seam: Story) -> None:
    at_seam.sigma_m = 10.0  # three sigma reach the rim: whatever is off is an edge
    at_seam.run(2, v=0.1, off=FRONT)
    assert at_seam.monitor.code is EventCode.NEAR_EDGE
    at_seam.sigma_m = 1e-4
    at_seam.pose = (at_seam.pose[0] + 0.184, *at_seam.pose[1:])  # now the rear sensors stand over the seam
    at_seam.frame(-0.05, off=RL + RR)
    assert at_seam.frame(-0.05, off=RL + RR).code is EventCode.NORMAL


# -- (b) seam ---------------------------------------------------------------------------------------------------------


def test_a_seam_allows_its_width_and_then_is_an_edge(at_seam: Story) -> None:
    verdict = at_seam.run(14, v=0.1, off=FRONT)  # 14 mm: gap 10 + tolerance 1 + extra 3, less the first sample
    assert verdict.code is EventCode.NORMAL
    verdict = at_seam.frame(0.1, off=FRONT)
    assert (verdict.code, text_of(verdict.cause)) == (EventCode.NEAR_EDGE, BEYOND_SEAM.message)
    assert verdict.limit == pytest.approx(0.014, abs=1e-6)  # m; the direction is along the normal to 1e-3 rad
    assert verdict.value == pytest.approx(0.014, abs=2e-4)  # m; two samples at 0.1 m/s


def test_standing_over_a_gap_is_no_edge_however_long(at_seam: Story) -> None:
    at_seam.run(5, v=0.1, off=FRONT)
    assert at_seam.run(6000, off=FRONT).code is EventCode.NORMAL  # a minute
    assert at_seam.run(5, v=0.1, off=FRONT).code is EventCode.NORMAL
    assert at_seam.run(2, v=0.1).code is EventCode.NORMAL
    assert at_seam.monitor.counts["episodes"][Corner.FRONT_LEFT] == 1


# -- (c) no map -------------------------------------------------------------------------------------------------------


def test_without_an_estimate_no_seam_is_assumed_and_nothing_is_permitted(at_seam: Story) -> None:
    at_seam.has_estimate = False
    verdict = at_seam.run(6, v=0.1, off=FRONT)
    assert verdict.code is EventCode.NEAR_EDGE
    assert text_of(verdict.cause) == f"{NO_SEAM.message}; no estimate"
    assert permits(verdict) == NO_PERMIT


def test_a_sensor_over_a_gap_since_before_the_first_estimate_is_explained_by_it(at_seam: Story) -> None:
    at_seam.has_estimate = False
    at_seam.pose = (at_seam.pose[0] + 0.002, *at_seam.pose[1:])
    at_seam.run(10, off=FRONT)
    at_seam.has_estimate = True
    assert at_seam.run(9, v=0.1, off=FRONT).code is EventCode.NORMAL
    assert at_seam.run(2, v=0.1).code is EventCode.NORMAL


# -- (e) a fix --------------------------------------------------------------------------------------------------------


def declared_where_the_robot_was_not(story: Story, aside_m: float) -> None:
    """An edge, by an estimate that is aside from where the story says that the robot is; then it comes to rest."""
    x, y, heading = story.pose
    story.sigma_m = 1.5e-3
    story.pose = (x - aside_m, y, heading)
    assert story.run(10, v=0.1, off=FRONT).code is EventCode.NEAR_EDGE
    story.pose = (story.pose[0] + aside_m, y, heading)
    story.run(5, off=FRONT)


def test_an_edge_that_a_fix_shows_to_be_a_seam_was_none(at_seam: Story) -> None:
    at_seam.pose = (at_seam.pose[0] - 0.006, *at_seam.pose[1:])
    declared_where_the_robot_was_not(at_seam, aside_m=0.04)
    assert at_seam.run(20, off=FRONT).code is EventCode.NEAR_EDGE  # the pose alone says nothing
    at_seam.sigma_m = 6e-6
    assert at_seam.run(1, off=FRONT).code is EventCode.NORMAL
    assert permits(at_seam.run(4, v=0.1, off=FRONT)) == ANY_PERMIT
    # A seam, and no more: its width and tolerances are allowed once.
    verdict = at_seam.run(12, v=0.1, off=FRONT)
    assert (verdict.code, text_of(verdict.cause)) == (EventCode.NEAR_EDGE, BEYOND_SEAM.message)
    # Without another fix that stays so, however long it stands.
    assert at_seam.run(200, off=FRONT).code is EventCode.NEAR_EDGE


# -- (d) turns --------------------------------------------------------------------------------------------------------


def test_at_an_edge_found_in_a_turn_the_turn_back_is_permitted(on_panel: Story) -> None:
    on_panel.run(7, omega=0.5, off=FL)  # 4.4 mm of arc
    verdict = on_panel.run(6, omega=0.1, off=FL)  # slowly, so that the declaration is fresh
    assert verdict.code is EventCode.NEAR_EDGE
    assert permits(verdict) == (False, True, True)
    on_panel.run(3, omega=-0.5, off=FL)
    assert on_panel.monitor.verdict.turn
    on_panel.run(3, omega=-0.5)
    assert permits(on_panel.monitor.verdict) == ANY_PERMIT


def test_turning_on_outwards_bars_the_turn_until_the_sensor_is_on(on_panel: Story) -> None:
    on_panel.run(20, omega=0.5, off=FL)  # 12.7 mm of arc: 5 to the declaration, 5 allowed
    verdict = on_panel.run(1, omega=-0.5, off=FL)
    assert permits(verdict) == (False, True, False)
    on_panel.run(15, omega=-0.5, off=FL)  # back inside what is allowed: still latched
    assert not on_panel.monitor.verdict.turn
    on_panel.run(3, omega=-0.5)
    assert permits(on_panel.monitor.verdict) == ANY_PERMIT


def test_a_sweep_along_a_seam_is_no_edge(cfg: Config, mirror: Mirror) -> None:
    panel = list(mirror.panels.values())[40]
    # The corner sensor's circle of 127.3 mm touches the seam from 122 mm on and does not reach its far side.
    story = Story(cfg, mirror, (panel.x_m, panel.y_m + panel.half_y_m - 0.122, 0.5))
    # front left: entering at 73.4 deg from +x, leaving at 106.6; 45 deg of them are the heading's
    story.pose = (*story.pose[:2], 1.281 - pi / 4)
    assert story.run(57, omega=1.0, off=FL).code is EventCode.NORMAL  # 73 mm of arc


def test_a_turn_across_a_seam_allows_its_width(cfg: Config, mirror: Mirror) -> None:
    panel = list(mirror.panels.values())[40]
    # Front right points along -y and moves along +x, across the seam that begins under it.
    story = Story(cfg, mirror, (panel.x_m + panel.half_x_m + 1e-4, panel.y_m, -pi / 4))
    assert story.run(10, omega=1.0, off=FR).code is EventCode.NORMAL  # 12.7 mm of arc
    verdict = story.run(2, omega=1.0, off=FR)
    assert (verdict.code, text_of(verdict.cause)) == (EventCode.NEAR_EDGE, BEYOND_SEAM.message)
    assert verdict.limit == pytest.approx(0.014, abs=1e-9)  # m; 10 + 1 + 3 mm


def test_a_turn_has_a_limit_even_along_a_seam(mirror: Mirror) -> None:
    short = config_of("thesis-m1", danger__turn_travel_limit_m=0.05)
    panel = list(mirror.panels.values())[40]
    story = Story(short, mirror, (panel.x_m, panel.y_m + panel.half_y_m - 0.122, 1.281 - pi / 4))
    assert story.run(39, omega=1.0, off=FL).code is EventCode.NORMAL  # 49.6 mm of arc
    verdict = story.run(2, omega=1.0, off=FL)
    assert (verdict.code, verdict.limit) == (EventCode.NEAR_EDGE, 0.05)


# -- (g) wheels -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [None, nan, inf])
def test_a_silent_wheel_permits_nothing_and_counts_as_fastest(on_panel: Story, bad: float | None) -> None:
    on_panel.run(2)
    monitor, t = on_panel.monitor, on_panel.t
    for k in range(1, 18):
        t_s = t + 0.01 * k
        enc = [WheelSample(t_s, bad, 0.0)]
        estimate = EstimateMessage(
            seq=k, t_s=t_s, x_m=on_panel.pose[0], y_m=on_panel.pose[1], heading_rad=0.0, sigma_m=1e-4, state="driving"
        )
        verdict = monitor.step(frame_of(100 + k, t_s, enc, [EdgeSample(t_s, 1, 1, 1, 1)]), estimate)
        if k <= 14:
            assert permits(verdict) == ANY_PERMIT  # the last sample is held for 150 ms
    assert (verdict.code, text_of(verdict.cause), verdict.signal) == (EventCode.NORMAL, "encoder samples stale", "enc")
    assert permits(verdict) == NO_PERMIT
    assert verdict.value == pytest.approx(0.17, abs=1e-9)  # s; sums of time steps
    t_s += 0.001
    verdict = monitor.step(
        frame_of(200, t_s, [], [EdgeSample(t_s, 0, 1, 1, 1), EdgeSample(t_s + 1e-3, 0, 1, 1, 1)]), None
    )
    assert verdict.code is EventCode.NEAR_EDGE
    assert text_of(verdict.cause).startswith(OFF_WITHOUT_WHEELS.message)
    assert verdict.value > 0.06  # m: 0.17 s at the 0.41 m/s of a corner sensor with one wheel against the other


# -- (h) lifted -------------------------------------------------------------------------------------------------------


def test_all_four_off_is_lifted_or_fallen(on_panel: Story) -> None:
    assert on_panel.frame(off=ALL, flags="1111111110").code is EventCode.NORMAL
    verdict = on_panel.frame(off=ALL, flags="0111111111")
    assert (verdict.code, text_of(verdict.cause)) == (EventCode.NEAR_EDGE, "lifted or fallen")
    assert permits(verdict) == NO_PERMIT
    assert verdict.off == (True, True, True, True)
    assert on_panel.frame().code is EventCode.NEAR_EDGE
    assert on_panel.run(2).code is EventCode.NORMAL


# -- the centre -------------------------------------------------------------------------------------------------------


def test_the_centre_may_not_drive_at_the_rim(at_rim: Story) -> None:
    x, y, _ = at_rim.pose
    at_rim.pose = (x + 0.045, y, 0.0)  # 46 mm from the rim, and the sensors see nothing
    assert at_rim.frame(0.1).code is EventCode.NORMAL
    verdict = at_rim.run(3, v=0.1)
    assert (verdict.code, text_of(verdict.cause), verdict.signal) == (
        EventCode.NEAR_EDGE,
        CENTRE_NEAR_RIM.message,
        "estimate",
    )
    assert permits(verdict) == (False, True, False)
    assert verdict.off == (True, True, False, False)
    assert verdict.value < verdict.limit == pytest.approx(0.0453, abs=1e-9)  # m; half the lead and three sigma
    assert at_rim.run(15, v=-0.1).code is EventCode.NORMAL


def test_the_centre_may_leave_the_rim_in_either_direction(at_rim: Story) -> None:
    x, y, _ = at_rim.pose
    at_rim.pose = (x + 0.06, y, pi)
    assert at_rim.run(3, v=0.1).code is EventCode.NORMAL
    assert at_rim.run(30).code is EventCode.NORMAL  # at rest
    verdict = at_rim.run(3, v=-0.1)
    assert permits(verdict) == (True, False, False)
    assert verdict.off == (False, False, True, True)
    at_rim.has_estimate = False
    verdict = at_rim.run(20)
    assert (verdict.code, text_of(verdict.cause)) == (EventCode.NEAR_EDGE, f"{CENTRE_NEAR_RIM.message}; no estimate")
    assert permits(verdict) == NO_PERMIT


def test_the_centre_needs_wheels_to_tell_its_direction(at_rim: Story) -> None:
    x, y, _ = at_rim.pose
    at_rim.run(1)
    at_rim.pose, at_rim.has_wheels = (x + 0.06, y, 0.0), False
    assert at_rim.run(12, v=0.001).code is EventCode.NORMAL


# -- stale data -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("field_name", ["t_s", "x_m", "y_m", "heading_rad", "sigma_m"])
@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_an_estimate_that_is_not_finite_is_none(on_panel: Story, field_name: str, value: float) -> None:
    on_panel.run(1)
    fields: dict[str, Any] = {
        "t_s": on_panel.t,
        "x_m": 0.0,
        "y_m": 0.0,
        "heading_rad": 0.0,
        "sigma_m": 1e-4,
        field_name: value,
    }
    estimate = EstimateMessage(seq=1, state="held", **fields)
    t_s = on_panel.t + 1e-3
    frame = frame_of(9, t_s, [WheelSample(t_s, 0.0, 0.0)], [EdgeSample(t_s, 1, 1, 1, 1)])
    verdict = on_panel.monitor.step(frame, estimate)
    assert (text_of(verdict.cause), verdict.value) == ("estimate not finite", 0.15)
    assert permits(verdict) == NO_PERMIT
    assert not on_panel.monitor.at_base_or_held


@pytest.mark.parametrize(("age_s", "expected"), [(0.149, ANY_PERMIT), (0.151, NO_PERMIT), (-0.151, NO_PERMIT)])
def test_the_age_of_an_estimate(on_panel: Story, age_s: float, expected: tuple[bool, bool, bool]) -> None:
    on_panel.run(20)
    x, y, heading = on_panel.pose
    t_s = on_panel.t + 1e-3
    estimate = EstimateMessage(seq=1, t_s=t_s - age_s, x_m=x, y_m=y, heading_rad=heading, sigma_m=1e-4, state="driving")
    frame = frame_of(99, t_s, [WheelSample(t_s, 0.0, 0.0)], [EdgeSample(t_s, 1, 1, 1, 1)])
    verdict = on_panel.monitor.step(frame, estimate)
    assert permits(verdict) == expected
    assert text_of(verdict.cause) == ("" if expected[0] else "estimate stale")


def test_every_value_is_finite_before_the_first_reception(on_panel: Story) -> None:
    edge = [EdgeSample(1e-3 * k, 0, 0, 0, 1) for k in range(1, 4)]
    verdict = on_panel.monitor.step(frame_of(1, 0.003, [], edge), None)
    assert text_of(verdict.cause) == f"{OFF_WITHOUT_WHEELS.message}; encoder samples stale"
    assert verdict.value == pytest.approx(0.061, abs=1e-3)  # m: 0.15 s at 0.41 m/s


def test_no_frame_permits_nothing_whatever_the_code(at_rim: Story) -> None:
    verdict = at_rim.monitor.stale(7, 1.5)
    assert (verdict.seq, verdict.t_s, verdict.code, text_of(verdict.cause)) == (
        7,
        1.5,
        EventCode.NORMAL,
        "no sensors frame",
    )
    assert permits(verdict) == NO_PERMIT
    at_rim.monitor.emergency("fire", "a")
    assert at_rim.monitor.stale(7, 1.5).code is EventCode.ABORTED
    at_rim.run(2, v=0.1, off=FRONT)
    assert at_rim.monitor.stale(7, 1.5).code is EventCode.NEAR_EDGE


def test_a_frame_that_is_not_new_is_not_judged_and_permits_nothing(at_rim: Story) -> None:
    at_rim.run(2)
    last = at_rim.monitor.verdict
    assert permits(last) != NO_PERMIT
    t_s = at_rim.t
    again = frame_of(2, t_s, [WheelSample(t_s, 9.0, 9.0)], [EdgeSample(t_s + 1e-3 * k, 0, 0, 0, 0) for k in range(5)])
    found = at_rim.monitor.step(again, None)
    assert (permits(found), text_of(found.cause)) == (NO_PERMIT, "no sensors frame")
    assert at_rim.monitor.verdict is last
    assert at_rim.monitor._edges.is_idle


def test_edge_samples_that_go_back_in_time_are_dropped(on_panel: Story) -> None:
    on_panel.run(2)
    t_s = on_panel.t
    old = [EdgeSample(t_s - 5e-3, 0, 0, 0, 0), EdgeSample(t_s - 4e-3, 0, 0, 0, 0)]
    frame = frame_of(9, t_s + 1e-3, [WheelSample(t_s + 1e-3, 0.0, 0.0)], [*old, EdgeSample(t_s + 1e-3, 1, 1, 1, 1)])
    assert on_panel.monitor.step(frame, None).code is EventCode.NORMAL
    assert on_panel.monitor.counts["episodes"] == dict.fromkeys(Corner, 0)


def test_a_value_that_is_neither_0_nor_1_counts_as_off(on_panel: Story) -> None:
    on_panel.run(1)
    t_s = on_panel.t + 1e-3
    on_panel.monitor.step(frame_of(9, t_s, [WheelSample(t_s, 0.0, 0.0)], [EdgeSample(t_s, 2, 1, 1, 1)]), None)
    assert on_panel.monitor.counts["episodes"][Corner.FRONT_LEFT] == 1


def test_reset_begins_a_new_session_and_keeps_the_abort(at_rim: Story) -> None:
    at_rim.monitor.emergency("fire", "a")
    at_rim.run(2, v=0.1, off=FRONT)
    at_rim.monitor.reset()
    assert at_rim.monitor.code is EventCode.ABORTED
    assert permits(at_rim.monitor.verdict) == NO_PERMIT
    at_rim.seq, at_rim.t = 0, 0.0
    assert permits(at_rim.run(1)) == ANY_PERMIT


# -- emergencies ------------------------------------------------------------------------------------------------------


def test_an_emergency_is_code_2_with_motion_permitted(on_panel: Story) -> None:
    assert on_panel.monitor.emergency("fire", "a", "smoke") is None
    verdict = on_panel.run(1)
    assert (verdict.code, text_of(verdict.cause), verdict.signal) == (
        EventCode.ABORTED,
        "emergency: fire",
        "emergency:fire",
    )
    assert permits(verdict) == ANY_PERMIT
    assert on_panel.monitor.clear("a", at_base_or_held=True) is None
    assert on_panel.run(1).code is EventCode.NORMAL


def test_nothing_moves_while_the_ground_shakes(on_panel: Story) -> None:
    on_panel.monitor.emergency("earthquake", "a")
    on_panel.monitor.emergency("fire", "b")
    verdict = on_panel.run(1)
    assert (verdict.code, text_of(verdict.cause)) == (EventCode.ABORTED, "emergency: earthquake")
    assert permits(verdict) == NO_PERMIT
    assert on_panel.monitor.clear("a", at_base_or_held=True) is None
    verdict = on_panel.run(1)
    assert (text_of(verdict.cause), permits(verdict)) == ("emergency: fire", ANY_PERMIT)


def test_an_edge_outranks_an_abort(at_rim: Story) -> None:
    at_rim.monitor.emergency("fire", "a")
    verdict = at_rim.run(2, v=0.1, off=FRONT)
    assert verdict.code is EventCode.NEAR_EDGE
    assert permits(verdict) == (False, True, False)
    verdict = at_rim.run(2, v=-0.1)
    assert verdict.code is EventCode.ABORTED
    assert permits(verdict) == ANY_PERMIT


def test_a_stale_estimate_holds_an_aborted_robot_too(on_panel: Story) -> None:
    on_panel.monitor.emergency("power", "a")
    on_panel.has_estimate = False
    verdict = on_panel.run(1)
    assert (verdict.code, text_of(verdict.cause)) == (EventCode.ABORTED, "no estimate")
    assert permits(verdict) == NO_PERMIT


def test_the_state_of_main_decides_whether_an_emergency_may_be_cleared(on_panel: Story) -> None:
    on_panel.run(1)
    assert not on_panel.monitor.at_base_or_held
    on_panel.state = "held"
    on_panel.run(1)
    assert on_panel.monitor.at_base_or_held
    on_panel.has_estimate = False
    on_panel.run(1)
    assert not on_panel.monitor.at_base_or_held


def test_a_state_sent_before_an_emergency_does_not_clear_it(on_panel: Story) -> None:
    on_panel.state = "held"
    on_panel.run(5)
    assert on_panel.monitor.emergency("fire", "a") is None
    assert not on_panel.monitor.at_base_or_held  # it may have been told to go on meanwhile
    on_panel.run(2)
    assert not on_panel.monitor.at_base_or_held
    on_panel.run(3)
    assert on_panel.monitor.at_base_or_held
    assert on_panel.monitor.emergency("fire", "a") is None  # repeated, it is no other one
    assert on_panel.monitor.at_base_or_held


# -- map and odometry -------------------------------------------------------------------------------------------------


def test_the_seams_are_those_of_the_mirror(mirror: Mirror) -> None:
    edge_map = EdgeMap(mirror)
    for panel in mirror.panels.values():
        for dx, dy in ((1, 0.3), (-1, 0.3), (0.3, 1), (0.3, -1)):
            x = panel.x_m + dx * (panel.half_x_m + 0.002 * (abs(dx) == 1))
            y = panel.y_m + dy * (panel.half_y_m + 0.002 * (abs(dy) == 1))
            expected = mirror.nearest_seam(x, y)
            is_interior = mirror.rim.signed_distance_m(x, y) > 0.0
            found = edge_map.seam_at((x, y), 0.001)
            assert (found is not None) == is_interior
            if found is not None and expected is not None:
                assert found.axis == expected.axis
                assert found.distance_m == pytest.approx(expected.distance_m, abs=1e-9)  # m; sums of millimetres
            assert found is None or edge_map.seam_at((x, y), 0.001, not_axis=found.axis) is None


def test_the_rim_is_ahead_only_in_the_direction_of_motion(mirror: Mirror) -> None:
    edge_map = EdgeMap(mirror)
    right = max(mirror.panels.values(), key=lambda panel: (panel.x_m, -abs(panel.y_m)))
    place = right.x_m + right.half_x_m - 0.012, right.y_m
    assert edge_map.is_rim_ahead(place, (1.0, 0.0), 0.013, 0.0)
    assert not edge_map.is_rim_ahead(place, (1.0, 0.0), 0.011, 0.0)
    assert not edge_map.is_rim_ahead(place, (0.0, 1.0), 0.013, 0.011)
    assert edge_map.is_rim_ahead(place, (0.0, 1.0), 0.013, 0.0125)
    assert not edge_map.is_rim_ahead((0.0, 0.0), (1.0, 0.0), 0.013, 0.0125)


def test_odometry_of_an_arc_forwards_and_backwards() -> None:
    track = WheelTrack(0.03, 0.15, 0.15, 10.0)
    v, omega = 0.1, 0.5
    right, left = (v + 0.5 * omega * 0.15) / 0.03, (v - 0.5 * omega * 0.15) / 0.03
    track.push([WheelSample(k * 1e-3, right, left) for k in range(1001)])
    track.update(1.0)
    start = DeckPose(1.0, 2.0, 0.3)
    end = pose_at(track, 0.9004, 0.1003, start)
    # chord of an arc: 2 R sin(angle / 2), R = v / omega
    angle = omega * 0.8001

    chord = 2.0 * v / omega * sin(0.5 * angle)
    expected = (1.0 + chord * cos(0.3 + 0.5 * angle), 2.0 + chord * sin(0.3 + 0.5 * angle), 0.3 + angle)
    # Midpoint headings over 1 ms are exact to 1e-8 of the path.
    assert astuple(end) == pytest.approx(expected, abs=1e-9)
    assert astuple(pose_at(track, 0.1003, 0.9004, end)) == pytest.approx(astuple(start), abs=1e-9)


def test_odometry_interpolates_and_then_holds_the_velocity() -> None:
    track = WheelTrack(0.03, 0.15, 0.15, 10.0)
    track.push([WheelSample(0.0, 0.0, 0.0), WheelSample(0.1, 2.0, 2.0)])
    track.update(0.1)
    odometry = Odometry(track, 0.05)
    odometry.advance_to(0.2)
    # 0.03 m/s at 0.05 s, 0.06 at 0.1, held to 0.2
    assert odometry.x_m == pytest.approx(0.045 * 0.05 + 0.06 * 0.1, abs=1e-12)  # exact but for rounding
    assert (odometry.y_m, odometry.heading_rad) == (0.0, 0.0)


def test_a_track_reads_each_wheel_by_itself_and_drops_old_samples() -> None:
    track = WheelTrack(0.03, 0.15, 0.15, 0.3)
    track.push([WheelSample(0.0, 1.0, None), WheelSample(0.001, None, 1.0), WheelSample(0.0005, 9.0, None)])
    track.update(0.001)
    assert [knot.v_m_s for knot in track.knots] == [pytest.approx(0.03)]
    assert track.silence_s(0.15) == 0.0
    assert track.silence_s(0.16) == pytest.approx(0.16)
    for k in range(4 * KNOTS_KEPT):
        track.push([WheelSample(1.0 + k * 1e-3, 1.0, 1.0)])
        track.update(1.0 + k * 1e-3)
    assert len(track.knots) <= 2 * KNOTS_KEPT
    track.push([WheelSample(100.0, 1.0, 1.0)])
    track.push([WheelSample(101.0, 1.0, 1.0)])
    track.update(101.0)
    assert track.knots[-2].t_s < 100.0  # beyond the reach: not read


class Samples(list[WheelSample]):
    """Of a frame; shows when nothing refers to it any more."""


def test_a_track_drops_frames_that_it_will_not_read() -> None:
    track = WheelTrack(0.03, 0.15, 0.15, 0.25)
    frames: list[ReferenceType[Samples]] = []
    for k in range(64):
        samples = Samples([WheelSample(0.125 * k, 1.0, 1.0)])
        track.push(samples)
        frames.append(ref(samples))
    del samples
    assert [frame() is None for frame in frames] == 61 * [True] + 3 * [False]  # 0.25 s back, not more
    track.update(7.875)
    assert [knot.t_s for knot in track.knots] == [7.625, 7.75, 7.875]


def test_odometry_continues_after_the_track_dropped_knots() -> None:
    track = WheelTrack(0.03, 0.15, 0.15, 0.3)
    track.push([WheelSample(0.0, 1.0, 1.0)])
    track.update(0.0)
    odometry = Odometry(track, 0.0)
    for k in range(1, 5 * KNOTS_KEPT):
        track.push([WheelSample(k * 1e-3, 1.0, 1.0)])
        track.update(k * 1e-3)
        odometry.advance_to(k * 1e-3)
    assert odometry.x_m == pytest.approx(0.03 * 1e-3 * (5 * KNOTS_KEPT - 1), abs=1e-9)  # sums of 2,559 steps


def test_a_sensor_that_chatters_is_found_while_its_episode_is_open(on_panel: Story) -> None:
    cfg = on_panel.cfg
    on_panel.monitor = DangerMonitor(on_panel.mirror, cfg.robot, cfg.danger, cfg.health)
    found = [on_panel.frame(off=FL, flags="1010101010") for _ in range(20)]
    assert EDGE_SENSOR_CHATTERS.message in {text_of(verdict.cause) for verdict in found}
