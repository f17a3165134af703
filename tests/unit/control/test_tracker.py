"""Turn-and-move tracking, closed over an ideal robot with a first-order servo."""

from collections import deque
from math import asin, cos, exp, hypot, pi, sin, sqrt
from typing import Any

import numpy as np
import pytest
from msgspec.structs import astuple
from scipy.linalg import solve_continuous_are

from ccatp.config.models import Config
from ccatp.control.gate import DriveGate, Purpose
from ccatp.control.line import LegLine, LegView, line_rate
from ccatp.control.tracker import LegMotion, LegPhase, LegTracker
from ccatp.control.wheel_motion import SentDrives
from ccatp.core import Twist, Verdict
from ccatp.kinematics import difference, twist_of, wheel_rates
from ccatp.survey.planning.search import bang_bang_time

DT = 0.01
FREE = Verdict.normal(0, 0.0)
NONE, NEAR_M = (0.0, 0.0), 0.12
Pose = tuple[float, float, float]


class Leg:
    """A tracker with the motion that it drives."""

    def __init__(self, tracker: LegTracker) -> None:
        self._tracker = tracker
        self._motion: LegMotion | None = None

    @property
    def motion(self) -> LegMotion:
        assert self._motion is not None
        return self._motion

    @property
    def phase(self) -> LegPhase:
        return self.motion.phase

    def begin(self, *leg: Any, **more: Any) -> None:
        self._motion = self._tracker.begin(*leg, **more)

    def begin_turn(self, angle_rad: float) -> None:
        self._motion = self._tracker.begin_turn(angle_rad)

    def step(self, *frame: Any) -> Twist:
        self._motion, twist = self._tracker.step(self.motion, *frame)
        return twist

    def step_turn(self, remaining_rad: float, dt_s: float) -> Twist:
        self._motion, twist = self._tracker.step_turn(self.motion, remaining_rad, dt_s)
        return twist


class Rig:
    """A robot on a plane with its own lag, slip per wheel and drift, and a link of whole frames each way."""

    def __init__(
        self,
        config: Config,
        *,
        lag: float = 1.0,
        slip: tuple[float, float] = NONE,
        creep: tuple[float, float] = NONE,
        delay: int = 0,
        pose: Pose = (0.0, 0.0, 0.0),
    ) -> None:
        robot = config.robot
        self.r, self.base = robot.wheel_radius_m, robot.wheel_base_m
        self.x, self.y, self.heading = pose
        self.wheels = [0.0, 0.0]
        self.slip, self.creep, self.lag_s = slip, creep, lag * robot.wheel_lag_s
        self.sent = SentDrives(robot, DT)
        self.gate = DriveGate(config.limits, config.robot, config.mission.verdict_timeout_s)
        self.tracker = Leg(LegTracker(config.control, config.limits, robot.wheel_lag_s))
        self.link: deque[tuple[int, float, float]] = deque([(-1, 0.0, 0.0)] * delay)
        self.echo, self.seq = -1, 0
        self.t = 0.0
        self.trace: list[tuple[float, float, float]] = []

    @property
    def pose(self) -> Pose:
        return self.x, self.y, self.heading

    @property
    def twist(self) -> Twist:
        right, left = (w * (1.0 - s) for w, s in zip(self.wheels, self.slip, strict=True))
        return twist_of(right, left, self.r, self.base)

    @property
    def is_at_rest(self) -> bool:
        is_slow = abs(self.twist.v_m_s) <= 5e-4 and abs(self.twist.omega_rad_s) <= 5e-3
        return is_slow and not any(right or left for _, right, left in self.link)

    def look(self) -> tuple[Pose, Twist]:
        v, omega = self.twist.v_m_s, self.twist.omega_rad_s
        seen = self.sent.ahead(self.pose, v, omega, self.echo, DT, self.echo < 0, self.creep)
        return seen.pose, Twist(seen.v_m_s, seen.omega_rad_s)

    def drive(self, wanted: Twist) -> None:
        right, left = self.gate.pass_through(wanted, FREE, DT, FREE.t_s, 0.0, Purpose.SURVEY)
        self.seq += 1
        self.sent.add(self.seq, right, left)
        self.link.append((self.seq, right, left))
        self.echo, right, left = self.link.popleft()
        self.move(right, left)

    def go(self, wanted: Twist) -> None:
        """Without gate and link."""
        self.move(*wheel_rates(wanted, self.r, self.base))

    def move(self, right: float, left: float) -> None:
        keep = exp(-DT / self.lag_s)
        share = self.lag_s * (1.0 - keep) / DT
        means = []
        for k, u in enumerate((right, left)):
            means.append((u + (self.wheels[k] - u) * share) * (1.0 - self.slip[k]))
            self.wheels[k] = u + (self.wheels[k] - u) * keep
        mean = twist_of(means[0], means[1], self.r, self.base)
        travel, middle = mean.v_m_s * DT, self.heading + 0.5 * mean.omega_rad_s * DT
        self.x += travel * cos(middle) + abs(travel) * self.creep[0]
        self.y += travel * sin(middle) + abs(travel) * self.creep[1]
        self.heading += mean.omega_rad_s * DT
        self.t += DT
        self.trace.append((self.t, mean.v_m_s, mean.omega_rad_s))

    def leg(self, target: tuple[float, float], reverse: bool = False) -> float:
        """Drive a leg until the robot is at rest; returns the time taken."""
        start, pose = self.t, self.look()[0]
        self.tracker.begin(pose, target, reverse, self.creep)
        while self.tracker.phase is not LegPhase.DONE:
            pose, twist = self.look()
            self.drive(self.tracker.step(pose, target, DT, twist, self.creep))
            assert self.t - start < 20.0, f"still {self.tracker.phase}"
        while not self.is_at_rest:
            self.drive(Twist(0.0, 0.0))
            assert self.t - start < 20.0, "does not come to rest"
        return self.t - start


def run_leg(rig: Rig, target: tuple[float, float], reverse: bool, limit_s: float) -> float:
    rig.tracker.begin(rig.pose, target, reverse)
    while rig.tracker.phase is not LegPhase.DONE:
        rig.go(rig.tracker.step(rig.pose, target, DT))
        assert rig.t < limit_s, f"still {rig.tracker.phase} after {limit_s} s"
    return rig.t


@pytest.fixture
def tracker(config: Config) -> Leg:
    return Rig(config).tracker


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("bearing", [0.0, 0.01, 0.5, pi / 2, -2.5, pi])
def test_arrives_in_nearly_the_bang_bang_time(config: Config, bearing: float, reverse: bool) -> None:
    rig = Rig(config, pose=(0.3, -0.2, 0.4))
    heading = rig.heading + bearing + (pi if reverse else 0.0)
    target = (rig.x + 0.22 * cos(heading), rig.y + 0.22 * sin(heading))
    angle = abs(difference(bearing, 0.0))
    ideal = 0.22 / 0.1 + 0.1 / 0.2 + (angle / 1.0 + 0.5 if angle > 0.5 else 2.0 * (angle / 2.0) ** 0.5)
    spent = run_leg(rig, target, reverse, limit_s=10.0)
    # A tenth of a second: a few frames for the turn's and the leg's last bit.
    assert spent <= ideal + 0.1
    assert hypot(target[0] - rig.x, target[1] - rig.y) < 5e-4  # half of the arrival tolerance
    assert abs(rig.twist.v_m_s) < 1e-3


def test_the_thesis_gains_arrive_too_but_slowly(config: Config) -> None:
    control = config.control.model_copy(update={"gains": "thesis"})
    rig = Rig(config.model_copy(update={"control": control}))
    spent = run_leg(rig, (0.0, 0.22), False, limit_s=120.0)
    assert hypot(rig.x, rig.y - 0.22) < 0.01
    assert spent > 5.0


# The robot may creep by as much as it turns: half of what it turns by is left again.
# 2 rad take 2.5 s at once; feedback at a quarter of the rate brings the rest in 3.8 s.
@pytest.mark.parametrize(("angle", "kept", "limit_s"), [(-1.2, 1.0, 4.0), (1.0, 0.5, 3.0)])
def test_a_turn_in_place_ends_within_tolerance(config: Config, angle: float, kept: float, limit_s: float) -> None:
    rig = Rig(config)
    rig.tracker.begin_turn(angle)
    while rig.tracker.phase is not LegPhase.DONE:
        rig.go(rig.tracker.step_turn(angle - kept * rig.heading, DT))
        assert rig.t < limit_s
    assert kept * rig.heading == pytest.approx(angle, abs=0.01)  # heading tolerance


# Carried to the right of +x by what 0.25 rad to the left make up for.
DRIFT = (0.0, -sin(0.25))


def test_against_a_drift_it_turns_off_the_bearing(tracker: Leg) -> None:
    tracker.begin((0.0, 0.0, 0.0), (0.5, 0.0), False, DRIFT)
    assert tracker.phase is LegPhase.TURN
    assert tracker.step((0.0, 0.0, 0.0), (0.5, 0.0), DT, Twist(0.0, 0.0), DRIFT).omega_rad_s > 0.0


def test_steering_damps_an_unwanted_rate(tracker: Leg, config: Config) -> None:
    rates = []
    for omega in (0.0, 0.1):
        tracker.begin((0.0, 0.0, 0.0), (0.5, 0.0), False)
        rates.append(tracker.step((0.0, 0.0, 0.0), (0.5, 0.0), DT, Twist(0.0, omega)).omega_rad_s)
    assert rates[1] - rates[0] == pytest.approx(-0.1 * config.control.gain_sets["shipped"].angular.kd)


def test_a_turn_ends_although_the_bearing_of_a_near_stop_changes(config: Config) -> None:
    # The turn carries the robot round the stop, which is always a radian further.
    stop, near_m, rig = (0.3, 0.4), 0.002, Rig(config)

    def carry() -> None:
        rig.x, rig.y = stop[0] - near_m * cos(rig.heading + 1.0), stop[1] - near_m * sin(rig.heading + 1.0)

    carry()
    rig.tracker.begin(rig.pose, stop, reverse=False)
    planned_s = rig.tracker.motion.planned_s
    while rig.tracker.phase is not LegPhase.DONE:
        rig.go(rig.tracker.step(rig.pose, stop, DT))
        carry()
        assert rig.t < 1.2 * planned_s, f"still {rig.tracker.phase} after {rig.t} s"
    assert rig.t >= planned_s


def test_the_rate_is_that_of_the_riccati_equation() -> None:
    g, w, v = 600.0, 9.0, 0.07
    a, b = np.array([[0.0, v], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    p = solve_continuous_are(a, b, np.diag([(g * v) ** 2, w]), np.eye(1))
    gain = (b.T @ p)[0]
    assert line_rate(LegView(0.1, 1.0, 0.0, 1.0), v, g, w) == pytest.approx(-gain[0], rel=1e-9)
    assert line_rate(LegView(0.1, 0.0, 1.0, 1.0), v, g, w) == pytest.approx(-gain[1], rel=1e-9)


@pytest.mark.parametrize("reverse", [False, True])
def test_left_of_the_line_is_left_of_its_direction(reverse: bool) -> None:
    heading = 3.141592653589793 if reverse else 0.0
    line = LegLine.through((0.0, 0.0, heading), (1.0, 0.0))
    _, sight = line.look((0.4, 0.01, heading + 0.1), (1.0, 0.0), NONE, reverse, NEAR_M)
    assert astuple(sight) == pytest.approx((0.6, 0.01, 0.1, 1.0))


def test_against_a_drift_the_body_points_beside_the_line_and_progress_counts_it() -> None:
    line = LegLine.through((0.0, 0.0, 0.0), (0.0, 1.0))
    angle = asin(0.04)  # the drift is towards -x, which is left of +y: the body points to the right
    _, sight = line.look((0.0, 0.0, np.pi / 2 - angle), (0.0, 1.0), (-0.04, 0.03), False, NEAR_M)
    assert sight.off_rad == pytest.approx(0.0, abs=1e-12)
    assert sight.gain == pytest.approx(sqrt(1.0 - 0.04**2) + 0.03)


def test_a_new_frame_near_by_keeps_the_angle_to_the_robot() -> None:
    line = LegLine.through((0.0, 0.0, 0.0), (1.0, 0.0))
    line, before = line.look((0.95, 0.002, 0.03), (1.0, 0.0), NONE, False, NEAR_M)
    turned = 0.7
    c, s = cos(turned), sin(turned)
    ahead, left = 0.05, -0.002
    target = (5.0 + c * ahead - s * left, 5.0 + s * ahead + c * left)
    _, after = line.look((5.0, 5.0, 0.03 + turned), target, NONE, False, NEAR_M)
    assert astuple(after) == pytest.approx(astuple(before), abs=1e-12)


def survey(rig: Rig) -> tuple[list[float], float]:
    """Six legs with two quarter turns; stop errors and the time over that of the ideal robot."""
    x = y = course = ideal = taken = 0.0
    errors = []
    for turn, length in ((0.0, 0.22), (0.0, 0.22), (pi / 2, 0.25), (0.0, 0.22), (-pi / 2, 0.22), (0.0, 0.25)):
        course += turn
        x, y = x + length * cos(course), y + length * sin(course)
        ideal += bang_bang_time(length, 0.1, 0.2) + bang_bang_time(turn, 1.0, 2.0)
        taken += rig.leg((x, y))
        errors.append(hypot(rig.x - x, rig.y - y))
    return errors, taken / ideal


@pytest.mark.parametrize("delay", [0, pytest.param(2, marks=pytest.mark.slow), 4])
def test_a_disturbed_robot_stops_within_a_third_of_a_millimetre_and_loses_little_time(
    config: Config, delay: int
) -> None:
    rng = np.random.default_rng(delay)
    errors, ratios = [], []
    for _ in range(12):
        direction, size = rng.uniform(0.0, 2.0 * pi), rng.uniform(0.02, 0.05)
        right, left = rng.uniform(0.01, 0.05, 2)
        rig = Rig(
            config,
            lag=rng.uniform(0.8, 1.2),
            slip=(right, left),
            creep=(size * cos(direction), size * sin(direction)),
            delay=delay,
        )
        stops, ratio = survey(rig)
        errors += stops
        ratios.append(ratio)
    assert float(np.mean(errors)) < 3e-4  # stop tolerance along the line and as much beside it
    assert max(errors) < 6e-4
    assert float(np.mean(ratios)) < 1.04  # what a quiet mission may cost over its bound


def test_the_crab_angle_keeps_a_drifting_robot_on_its_line(config: Config) -> None:
    rig = Rig(config, creep=(0.0, 0.05), pose=(0.0, 0.0, -0.05))
    beside = []
    rig.tracker.begin(rig.pose, (0.4, 0.0), False, rig.creep)
    while rig.tracker.phase is not LegPhase.DONE:
        rig.drive(rig.tracker.step(rig.pose, (0.4, 0.0), DT, rig.twist, rig.creep))
        beside.append(abs(rig.y))
    assert max(beside) < 1e-4  # the drift over the leg is 20 mm
    assert rig.heading == pytest.approx(-0.05, abs=2e-3)  # asin(0.05), and what steering moved it


def test_a_drive_that_cannot_end_stops_in_time_near_the_stop_and_continues_far_from_it(config: Config) -> None:
    budget_s = bang_bang_time(0.3, 0.1, 0.2) + config.control.stop_time_s
    for left_over_m, is_ended in ((0.002, True), (0.05, False)):
        tracker = Leg(LegTracker(config.control, config.limits, 0.08))
        tracker.begin((0.0, 0.0, 0.0), (0.3, 0.0), False)
        for _ in range(round(budget_s / DT) + 2):
            tracker.step((0.3 - left_over_m, 0.0, 0.0), (0.3, 0.0), DT, Twist(0.0, 0.0))
        assert (tracker.phase is LegPhase.DONE) is is_ended
