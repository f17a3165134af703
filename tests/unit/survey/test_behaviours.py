"""From the end of a leg to the request for a measurement."""

from collections.abc import Callable, Iterable
from math import atan2, cos, hypot, pi, sin
from operator import itemgetter

import numpy as np
import pytest
from msgspec.structs import replace

from ccatp.conditions import Condition
from ccatp.conditions.danger import BEYOND_SEAM, NO_SEAM, RIM_AHEAD
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.control.tracker import LegTracker
from ccatp.core import Cause, DeckPose, EventCode, PanelId, PanelPose, PointId, Stop, StopKind, Verdict
from ccatp.kinematics import difference
from ccatp.links.robot_messages import Sensors
from ccatp.mirror.mirror import Mirror
from ccatp.studies.sil_run import SilRun
from ccatp.survey.behaviours import SETTLE_LIMIT_S, Measuring, RequestState, Retreat, RetreatStep, Settling, Standstill
from ccatp.survey.checks import PATIENCE_S, READINGS, MirrorCheck
from ccatp.survey.events import Pause, Resume
from ccatp.survey.fix_gate import ApproachCounter
from ccatp.survey.planning.escape import is_on_drive
from ccatp.survey.route_follower import LegAim, LegFollower, StateEstimate, plan_aim
from tests.support.scenario import MIRRORS, mirror_of

DT, MEASURING_S = 0.01, 0.5


class Standing:
    """Standing at a stop, as the survey keeps it."""

    def __init__(self, config: Config) -> None:
        self._control, self.requests = config.control, 0
        self.settling, self.now = Settling(), Measuring()

    def has_settled(self, motion: StateEstimate) -> bool:
        self.settling = self.settling.update(self._control, motion)
        self.now = Measuring.begin(self.settling, motion.t_s, MEASURING_S)
        return self.settling.standstill.is_rest

    def is_due(self, motion: StateEstimate) -> bool:
        self.now, is_due = self.now.update(self._control, MEASURING_S, motion)
        self.requests += is_due
        return is_due


@pytest.fixture
def settling(config: Config) -> Standing:
    return Standing(config)


def at(mirror: Mirror, frame: int, speed_m_s: float = 0.0) -> StateEstimate:
    return StateEstimate(frame * DT, DT, PanelPose(PanelId(5, 5), 0.0, 0.0, 0.0), speed_m_s, 0.0)


def test_a_measurement_is_requested_once_and_after_the_measuring_time_at_rest(
    settling: Standing, mirror: Mirror
) -> None:
    settled = next(k for k in range(100) if settling.has_settled(at(mirror, k)))
    asked = [k for k in range(settled, settled + 200) if settling.is_due(at(mirror, k))]
    assert asked == [settled + round(MEASURING_S / DT)]
    assert (settling.requests, settling.now.request) == (1, RequestState.MADE)


@pytest.mark.fault("E9")
def test_a_robot_that_keeps_moving_is_not_measured_and_exceeds_its_limit(settling: Standing, mirror: Mirror) -> None:
    settled = next(k for k in range(100) if settling.has_settled(at(mirror, k)))
    frames = range(settled + 1, settled + 2000)
    assert [k for k in frames if settling.is_due(at(mirror, k, speed_m_s=0.01))] == []
    assert settling.now.rest_by_s == pytest.approx(settled * DT + SETTLE_LIMIT_S)


@pytest.mark.fault("E9")
def test_a_measurement_during_which_the_robot_moves_is_not_wanted(settling: Standing, mirror: Mirror) -> None:
    settled = next(k for k in range(100) if settling.has_settled(at(mirror, k)))
    asked = next(k for k in range(settled, settled + 200) if settling.is_due(at(mirror, k)))
    assert not settling.is_due(at(mirror, asked + 1))
    before = settling.now.request
    settling.is_due(at(mirror, asked + 2, speed_m_s=0.01))
    assert (before, settling.now.request) == (RequestState.MADE, RequestState.DUE)
    again = next(k for k in range(asked + 3, asked + 400) if settling.is_due(at(mirror, k)))
    assert again > asked + 2 + round(MEASURING_S / DT)
    assert settling.requests == 2


def first_rest(config: Config, mirror: Mirror, speeds: Iterable[float], rates: Iterable[float]) -> int | None:
    standstill = Standstill()
    for k, (v, omega) in enumerate(zip(speeds, rates, strict=False)):
        standstill = standstill.update(config.control, replace(at(mirror, k, v), rate_rad_s=omega))
        if standstill.is_rest:
            return k
    return None


def test_at_rest_after_the_settling_time_below_both_limits(config: Config, mirror: Mirror) -> None:
    control = config.control
    speeds = [0.1, 0.02] + [0.9 * control.settle_speed_m_s] * 10
    rates = [0.0, 0.0, 0.0] + [0.9 * control.settle_rate_rad_s] * 10
    assert first_rest(config, mirror, speeds, rates) == 2 + round(control.settle_time_s / DT)


@pytest.mark.parametrize("speed", [lambda c: 1.1 * c.settle_speed_m_s, lambda c: -1.1 * c.settle_speed_m_s])
def test_a_robot_that_creeps_never_rests(config: Config, mirror: Mirror, speed: Callable[[object], float]) -> None:
    assert first_rest(config, mirror, [speed(config.control)] * 1000, [0.0] * 1000) is None


POSE = (0.1, 0.2, 0.5)


@pytest.fixture
def follower(config: Config, mirror: Mirror) -> LegFollower:
    return LegFollower(mirror, config)


def seen(ahead_m: float, left_m: float) -> tuple[float, float]:
    x, y, heading = POSE
    c, s = cos(heading), sin(heading)
    return x + c * ahead_m - s * left_m, y + s * ahead_m + c * left_m


@pytest.mark.parametrize("ahead_m", [0.02, -0.02])
@pytest.mark.parametrize("left_m", [0.0069, -0.0069])
def test_what_lies_nearly_along_the_heading_is_driven_to_without_a_turn(ahead_m: float, left_m: float) -> None:
    aim = plan_aim(POSE, seen(ahead_m, left_m), 0.010, 0.7)
    assert aim == pytest.approx(LegAim(*seen(ahead_m, 0.0), ahead_m < 0.0, 0.0))


def test_beyond_its_reach_there_is_no_correction(follower: LegFollower, config: Config) -> None:
    pose = PanelPose(PanelId(5, 5), 0.0, 0.0, 0.0)
    reach = config.mission.correction_reach_m
    assert follower.correction(pose, (0.99 * reach, 0.0)) is not None
    assert follower.correction(pose, (1.01 * reach, 0.0)) is None


def at_the_rim(mirror: Mirror, depth_m: float) -> PanelPose:
    """On the last panel of the middle row, ``depth_m`` from the rim at its right, heading along it."""
    y = mirror.deck_pose(PanelPose(PanelId(5, 5), 0.0, 0.0, 0.0)).y_m
    x = max(float(vx) for vx, _ in mirror.rim.vertices) - depth_m
    col = max(panel.col for panel in mirror.panels if panel.row == 5)
    return mirror.panel_pose(PanelId(5, col), DeckPose(x, y, pi / 2))


def test_no_sensor_may_pass_the_rim_on_the_way(follower: LegFollower, mirror: Mirror) -> None:
    # Sensors 0.09 m beside the robot stand 15 mm inside the rim; turning they reach out to 0.127 m.
    pose = at_the_rim(mirror, 0.105)
    along = (pose.x_m, pose.y_m + 0.03)
    assert follower.correction(pose, along) is not None
    for depth_m, is_safe in ((0.105, False), (0.2, True)):
        pose = at_the_rim(mirror, depth_m)  # it would have to turn
        assert (follower.correction(pose, (pose.x_m - 0.03, pose.y_m + 0.001)) is not None) is is_safe


def test_after_a_correction_a_turn_at_the_rim_is_looked_at(follower: LegFollower, mirror: Mirror) -> None:
    for depth_m, is_safe in ((0.105, False), (0.2, True)):
        pose = mirror.deck_pose(at_the_rim(mirror, depth_m))
        assert follower.can_proceed(pose, Stop(pose.x_m, pose.y_m + 0.2, StopKind.MEASURE))
        assert follower.can_proceed(pose, Stop(pose.x_m - 0.2, pose.y_m, StopKind.MEASURE)) is is_safe
        assert follower.can_proceed(pose, Stop(pose.x_m, pose.y_m - 0.2, StopKind.MEASURE, reverse=True))


@pytest.mark.parametrize(("creep_m_rad", "is_early"), [(0.01, True), (0.002, False)])
def test_a_leg_ends_uphill_of_where_the_next_turn_begins(
    config: Config, mirror: Mirror, follower: LegFollower, creep_m_rad: float, *, is_early: bool
) -> None:
    gx, gy, _ = mirror.gravity_in_robot(DeckPose(0.5, 0.5, 0.0))
    downhill = atan2(gy, gx)
    start = mirror.panel_pose(PanelId(5, 5), DeckPose(0.5 - 0.3 * cos(downhill), 0.5 - 0.3 * sin(downhill), downhill))
    via = Stop(0.5, 0.5, StopKind.VIA)
    after = Stop(0.5 - 0.2 * sin(downhill), 0.5 + 0.2 * cos(downhill), StopKind.MEASURE)  # a quarter turn to the left
    motion = StateEstimate(0.0, DT, start, 0.0, 0.0, turn_creep_m_rad=creep_m_rad)
    stop = follower.begin(motion, via, after).stop
    early_m = hypot(stop.x_m - via.x_m, stop.y_m - via.y_m)
    assert (early_m > config.mission.turn_clearance_m) is is_early
    if is_early:
        assert early_m == pytest.approx(0.5 * pi * creep_m_rad, rel=0.5)  # by heading it creeps more or less
        assert difference(atan2(via.y_m - stop.y_m, via.x_m - stop.x_m), downhill) == pytest.approx(0.0, abs=0.02)
    assert follower.begin(motion, via).stop is via
    assert follower.begin(motion, after, via).stop is after  # where it is measured, it stands


def test_beside_the_rim_it_does_not_end_where_a_sensor_would_pass_it(mirror: Mirror, follower: LegFollower) -> None:
    x, y = max(((float(x), float(y)) for x, y in mirror.rim.vertices), key=itemgetter(1))
    via = Stop(x - 0.14, y - 0.15, StopKind.VIA)  # uphill of it is the rim
    after = Stop(via.x_m - 0.3, via.y_m, StopKind.MEASURE)
    start = mirror.panel_pose(mirror.nearest_panel(via.x_m, via.y_m - 0.3), DeckPose(via.x_m, via.y_m - 0.3, 0.0))
    motion = StateEstimate(0.0, DT, start, 0.0, 0.0, turn_creep_m_rad=0.03)
    assert follower.begin(motion, via, after).stop is via


HERE, THERE = PointId(1, 2, 3), PointId(1, 2, 4)


def test_a_point_is_approached_again_where_it_may_be_further_off_than_allowed() -> None:
    approaches = ApproachCounter(3e-3, 3)
    assert not approaches.is_too_far(HERE, 2.98e-3, 5e-6)
    assert approaches.is_too_far(THERE, 2.99e-3, 5e-6)  # 3 sigma are 15 um
    assert not approaches.is_too_far(HERE, 2.99e-3, 0.0)


def test_a_laser_system_of_little_precision_takes_a_tenth_of_the_tolerance_at_most() -> None:
    approaches = ApproachCounter(3e-3, 3)
    for sigma_m in (1e-3, float("inf")):
        assert not approaches.is_too_far(HERE, 2.69e-3, sigma_m)
        assert approaches.is_too_far(THERE, 2.71e-3, sigma_m)


def test_the_last_approach_counts_wherever_it_ends_and_each_point_has_its_own() -> None:
    approaches = ApproachCounter(3e-3, 3)
    assert [approaches.is_too_far(HERE, 5e-3, 0.0) for _ in range(3)] == [True, True, False]
    assert approaches.count == 3
    assert approaches.is_too_far(THERE, 5e-3, 0.0)
    assert approaches.count == 1


CFG = load_config()
FRAME_S = 0.01
PANEL = PanelId(1, 1)
Pose = tuple[float, float, float]
Four = tuple[bool, bool, bool, bool]


def off_at(pose: Pose) -> Four:
    """Beyond two rims that meet: what lies at x < 0 or y < 0."""
    x, y, heading = pose
    c, s = cos(heading), sin(heading)
    a, b, rear_a, rear_b = (
        x + c * ox - s * oy < 0.0 or y + s * ox + c * oy < 0.0 for ox, oy in CFG.robot.edge_sensors_m
    )
    return a, b, rear_a, rear_b


def verdict_of(off: Four, *, may_turn: bool, row: Condition = RIM_AHEAD) -> Verdict:
    code = EventCode.NEAR_EDGE if any(off) else EventCode.NORMAL
    is_free = not any(off)
    forward, reverse = not (off[0] or off[1]), not (off[2] or off[3])
    return Verdict(0, 0.0, code, row.cause(), "", 0.0, 0.0, forward, reverse, may_turn or is_free, off)


def retreated(
    pose: Pose, *, may_turn: bool, blames: Four | None = None, row: Condition = RIM_AHEAD
) -> tuple[Pose, list[RetreatStep]]:
    """Where a retreat ends that begins with the sensors that are off there, or ``blames``; wheels follow at once."""
    tracker = LegTracker(CFG.control, CFG.limits, 0.0)
    first = verdict_of(blames or off_at(pose), may_turn=False)
    retreat = Retreat.begin(CFG.mission, first, PanelPose(PANEL, *pose), 0.0)
    seen, rate_rad_s = [retreat.step], 0.0
    for k in range(1500):
        if retreat.step in (RetreatStep.OVER, RetreatStep.STUCK):
            break
        motion = StateEstimate(k * FRAME_S, FRAME_S, PanelPose(PANEL, *pose), 0.0, rate_rad_s)
        verdict = verdict_of(off_at(pose), may_turn=may_turn, row=row)
        retreat, twist = retreat.update(CFG.mission, tracker, motion, verdict, is_slow=False)
        rate_rad_s = twist.omega_rad_s
        x, y, heading = pose
        heading += twist.omega_rad_s * FRAME_S
        pose = x + twist.v_m_s * FRAME_S * cos(heading), y + twist.v_m_s * FRAME_S * sin(heading), heading
        if retreat.step is not seen[-1]:
            seen.append(retreat.step)
    return pose, seen


@pytest.mark.parametrize("heading_rad", [0.0, 0.05, -0.05])
@pytest.mark.parametrize("y_m", [1.0, 0.3])
def test_one_that_met_the_edge_backwards_drives_off_it_and_does_not_turn(y_m: float, heading_rad: float) -> None:
    start = (0.088, y_m, heading_rad)
    assert any(off_at(start)[2:])
    end, seen = retreated(start, may_turn=True)
    assert seen == [RetreatStep.BACK, RetreatStep.OVER]
    assert end[0] >= start[0] + 0.5 * CFG.mission.backoff_m * cos(heading_rad) - 1e-3
    assert end[2] == pytest.approx(heading_rad, abs=1e-3)
    assert not any(off_at(end))


def test_a_turn_away_that_sweeps_a_corner_over_the_rim_is_undone() -> None:
    # It looks along one rim; turned away to the right, to the side of that rim, its right rear comes over it.
    start = (1.0, 0.1, 0.0)
    front_left = (True, False, False, False)
    end, seen = retreated(start, may_turn=True, blames=front_left)
    assert seen == [RetreatStep.BACK, RetreatStep.TURN_AWAY, RetreatStep.UNTURN, RetreatStep.OVER]
    assert not any(off_at(end))
    turned = -end[2]
    assert 0.0 < turned < CFG.mission.turn_away_rad


@pytest.mark.parametrize("row", [NO_SEAM, BEYOND_SEAM], ids=lambda row: row.name)
def test_off_what_may_be_a_seam_it_stands(row: Condition) -> None:
    _, seen = retreated((1.0, 0.1, 0.0), may_turn=True, blames=(True, False, False, False), row=row)
    assert seen == [RetreatStep.BACK, RetreatStep.TURN_AWAY, RetreatStep.OVER]


@pytest.mark.parametrize(("off", "sense"), [((True, False, False, False), -1.0), ((False, True, False, False), 1.0)])
def test_where_there_is_room_it_turns_to_the_side_that_stands(off: Four, sense: float) -> None:
    end, seen = retreated((1.0, 1.0, 0.5 * pi), may_turn=True, blames=off)
    assert seen == [RetreatStep.BACK, RetreatStep.TURN_AWAY, RetreatStep.OVER]
    assert end[1] == pytest.approx(1.0 - 0.5 * CFG.mission.backoff_m, abs=2e-3)
    assert end[2] - 0.5 * pi == pytest.approx(sense * CFG.mission.turn_away_rad, abs=0.05)


SIGMA_RAD = 0.035  # of a reading, as shipped
SEEDS = 40


def noisy(direction: np.ndarray, rng: np.random.Generator) -> tuple[float, float, float, float]:
    found = direction + SIGMA_RAD * rng.normal(size=3)
    x, y, z = found / np.linalg.norm(found)
    return 0.0, float(x), float(y), float(z)


def tilted(mirror: Mirror, pose: DeckPose, by_deg: float, heading: float) -> np.ndarray:
    """Gravity in the robot frame on a surface whose slope differs by so much, the robot turned anyhow."""
    gx, gy, gz = mirror.gravity_in_robot(pose)
    slope = np.arctan2(np.hypot(gx, gy), -gz) + np.radians(by_deg)
    return np.array([np.sin(slope) * np.cos(heading), np.sin(slope) * np.sin(heading), -np.cos(slope)])


def check(mirror: Mirror, direction: np.ndarray, seed: int, *, is_heading_known: bool = False) -> MirrorCheck:
    """Frames of 100 Hz, a reading in every fifth, until it is known."""
    rng = np.random.default_rng(seed)
    found = MirrorCheck(mirror, is_heading_known=is_heading_known)
    for k in range(1000):
        if found.update(0.01 * k, None if k % 5 else noisy(direction, rng), mirror.base_pose):
            assert k == 5 * (READINGS - 1)
            return found
    raise AssertionError("it never came to an end")


@pytest.mark.fault("P21")
def test_no_other_mirror_passes(measured: object) -> None:
    """Every mirror of the telescope taken for every other one whose slope at the base differs by more than 5 deg."""
    begun = 0
    mirrors = [mirror_of(name) for name in MIRRORS]
    for configured in mirrors:
        for real in mirrors:
            direction = np.array(real.gravity_in_robot(real.base_pose))
            is_same = configured.overhang == real.overhang
            for seed in range(SEEDS):
                contradiction = check(configured, direction, seed).contradiction
                assert is_same == (not contradiction), (configured.name, real.name, contradiction)
                begun += not is_same and not contradiction
    assert callable(measured)
    measured("P21", begun)


@pytest.mark.fault("P21")
@pytest.mark.parametrize("name", MIRRORS)
def test_a_slope_that_differs_by_more_than_5_deg_never_passes(name: str) -> None:
    mirror = mirror_of(name)
    for by_deg in (-60, -20, -10, -7, -5.5, -5, 5, 5.5, 7, 10, 20, 60):
        for seed in range(SEEDS):
            direction = tilted(mirror, mirror.base_pose, by_deg, 0.4 * seed)
            assert "is this the right mirror" in check(mirror, direction, seed).contradiction, by_deg
    for by_deg in (-1.5, 0.0, 1.5):
        for seed in range(SEEDS):
            assert not check(mirror, tilted(mirror, mirror.base_pose, by_deg, 0.4 * seed), seed).contradiction, by_deg


def test_a_robot_without_the_sensor_is_waited_for_and_reported() -> None:
    found = MirrorCheck(mirror_of("fyst-m1"))
    pose = mirror_of("fyst-m1").base_pose
    assert not found.update(10.0, None, pose)
    assert not found.update(10.0 + 0.99 * PATIENCE_S, None, pose)
    assert found.update(10.0 + PATIENCE_S, None, pose)
    assert "reports no gravity" in found.warning
    assert not found.contradiction


def test_a_slow_sensor_is_judged_by_what_has_come() -> None:
    found = MirrorCheck(mirror_of("fyst-m1"))
    pose = mirror_of("fyst-m1").base_pose
    found.update(0.0, (0.0, *mirror_of("fyst-m2").gravity_in_robot(pose)), pose)
    assert found.update(PATIENCE_S, None, pose)
    assert "104" in found.contradiction or "deg" in found.contradiction


REACTION = "gravity points the other way: the robot reports the reaction (up) instead of the direction of fall"


@pytest.mark.parametrize("name", MIRRORS)
def test_a_wrong_sign_and_exchanged_axes_are_named(name: str) -> None:
    """With the heading known, each single mistake is named unless it makes no difference here, where it is said."""
    mirror = mirror_of(name)
    x, y, z = mirror.gravity_in_robot(mirror.base_pose)
    wrong = [
        (REACTION, (-x, -y, -z)), ("x has the wrong sign", (-x, y, z)), ("y has the wrong sign", (x, -y, z)),
        ("z has the wrong sign", (x, y, -z)), ("x and y of gravity have the wrong sign", (-x, -y, z)),
        ("x and y of gravity are exchanged", (y, x, z)), ("x and z of gravity are exchanged", (z, y, x)),
        ("the robot reports y, z, x of gravity as x, y, z", (y, z, x)),
    ]  # fmt: skip
    for what, reported in wrong:
        found = check(mirror, np.array(reported), 1, is_heading_known=True)
        assert what in found.contradiction or what in found.unseen, (what, found.contradiction)
        assert "right mirror" not in found.contradiction
        # Without the heading the slope decides, and what it contradicts is named as well.
        by_slope = check(mirror, np.array(reported), 1).contradiction
        assert not by_slope or what in by_slope, (what, by_slope)
    assert check(mirror, np.array((-x, -y, -z)), 1).contradiction.startswith(REACTION)
    assert not check(mirror, np.array((x, y, z)), 1, is_heading_known=True).contradiction


def test_exchanged_axes_show_where_they_differ() -> None:
    x, y, z = mirror_of("fyst-m1").gravity_in_robot(mirror_of("fyst-m1").base_pose)
    found = check(mirror_of("fyst-m1"), np.array((y, x, z)), 1, is_heading_known=True)
    assert found.contradiction.startswith("x and y of gravity are exchanged")
    x, y, z = mirror_of("fyst-m2").gravity_in_robot(mirror_of("fyst-m2").base_pose)
    same = check(mirror_of("fyst-m2"), np.array((x, y, z)), 1, is_heading_known=True)
    assert same.unseen == ["x and y of gravity are exchanged"]  # 0.69 and 0.68


def test_a_robot_that_is_turned_is_no_other_mirror() -> None:
    mirror = mirror_of("fyst-m1")
    base = mirror.base_pose
    turned = DeckPose(base.x_m, base.y_m, base.heading_rad + 0.9)
    direction = np.array(mirror.gravity_in_robot(turned))
    assert not check(mirror, direction, 1).contradiction
    assert "is the robot turned" in check(mirror, direction, 1, is_heading_known=True).contradiction
    a_little = DeckPose(base.x_m, base.y_m, base.heading_rad + 0.1)
    direction = np.array(mirror.gravity_in_robot(a_little))
    assert not check(mirror, direction, 1, is_heading_known=True).contradiction


DRIVE = (
    Stop(0.0, 0.1, StopKind.CALIBRATE, reverse=True),
    Stop(0.0, 0.0, StopKind.CALIBRATE),
    Stop(0.0, 0.1, StopKind.CALIBRATE),
    Stop(0.5, 0.5, StopKind.MEASURE, PointId(1, 1, 1)),
)


@pytest.mark.parametrize(
    ("place", "expected"),
    [((0.0, 0.05), True), ((0.02, 0.11), True), ((0.0, -0.02), True), ((0.04, 0.05), False), ((0.0, 0.14), False)],
)
def test_near_its_line_the_drive_continues(place: tuple[float, float], expected: bool) -> None:
    assert is_on_drive(DRIVE, *place) is expected
    assert not is_on_drive(DRIVE[-1:], *place)


class Paused(SilRun):
    """An operator holds the robot for a moment."""

    def __init__(self, cfg: Config, pause_s: float) -> None:
        super().__init__(cfg)
        self.pause_s = pause_s

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        super()._serve(frame, dt_s)
        if self.pause_s <= frame.t < self.pause_s + 0.005:
            self.mission.handle(Pause(Cause("an operator")))
        elif self.pause_s + 1.0 <= frame.t < self.pause_s + 1.005:
            self.mission.handle(Resume())


@pytest.mark.parametrize("pause_s", [6.0])
def test_a_pause_leaves_nothing_out(pause_s: float) -> None:
    cfg = load_config(overrides={"run.panels": 1, "run.filter": "ekf"})
    result = Paused(cfg, pause_s).run()
    assert result.outcome == "complete"
    assert result.summary["mission_time_s"] > result.summary["lower_bound_s"] + 0.9
    assert result.summary["arrival_error_mm"]["max"] < 0.2
