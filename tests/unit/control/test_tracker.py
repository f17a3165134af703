"""Turn-and-move tracking, closed over an ideal robot with a first-order servo."""

from collections.abc import Callable
from math import cos, exp, hypot, pi, sin

import pytest

from ccatp.config.models import Config
from ccatp.control.tracker import LegPhase, LegTracker
from ccatp.core import Twist, difference

DT, LAG = 0.01, 0.08
Pose = tuple[float, float, float]


class Robot:
    """Unicycle with a first-order servo on both velocities."""

    def __init__(self, pose: Pose) -> None:
        self.x, self.y, self.heading = pose
        self.v = self.omega = 0.0

    @property
    def pose(self) -> Pose:
        return self.x, self.y, self.heading

    def drive(self, twist: Twist) -> None:
        keep = exp(-DT / LAG)
        mean = LAG * (1.0 - keep) / DT
        v_mean = twist.v_m_s + (self.v - twist.v_m_s) * mean
        omega_mean = twist.omega_rad_s + (self.omega - twist.omega_rad_s) * mean
        middle = self.heading + 0.5 * omega_mean * DT
        self.x += v_mean * DT * cos(middle)
        self.y += v_mean * DT * sin(middle)
        self.heading += omega_mean * DT
        self.v = twist.v_m_s + (self.v - twist.v_m_s) * keep
        self.omega = twist.omega_rad_s + (self.omega - twist.omega_rad_s) * keep


def run_leg(tracker: LegTracker, robot: Robot, target: tuple[float, float], reverse: bool, limit_s: float) -> float:
    tracker.begin(robot.pose, target, reverse)
    t = 0.0
    while tracker.phase is not LegPhase.DONE:
        robot.drive(tracker.step(robot.pose, target, DT))
        t += DT
        assert t < limit_s, f"still {tracker.phase} after {limit_s} s"
    return t


@pytest.fixture
def tracker(config: Config) -> LegTracker:
    return LegTracker(config.control, config.limits, LAG)


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("bearing", [0.0, 0.01, 0.5, pi / 2, -2.5, pi])
def test_arrives_in_nearly_the_bang_bang_time(tracker: LegTracker, bearing: float, reverse: bool) -> None:
    robot = Robot((0.3, -0.2, 0.4))
    heading = robot.heading + bearing + (pi if reverse else 0.0)
    target = (robot.x + 0.22 * cos(heading), robot.y + 0.22 * sin(heading))
    angle = abs(difference(bearing, 0.0))
    ideal = 0.22 / 0.1 + 0.1 / 0.2 + (angle / 1.0 + 0.5 if angle > 0.5 else 2.0 * (angle / 2.0) ** 0.5)
    spent = run_leg(tracker, robot, target, reverse, limit_s=10.0)
    # A tenth of a second: a few frames for the turn's and the leg's last bit.
    assert spent <= ideal + 0.1
    assert hypot(target[0] - robot.x, target[1] - robot.y) < 5e-4  # half of the arrival tolerance
    assert abs(robot.v) < 1e-3


def test_the_printed_argument_order_of_eq_3_2_would_turn_the_wrong_way(tracker: LegTracker) -> None:
    # arctan(x, y) as printed gives 0 for a target on the y axis, where the bearing is 90 degrees.
    tracker.begin((0.0, 0.0, 0.0), (0.0, 1.0), False)
    assert tracker.phase is LegPhase.TURN
    assert tracker.step((0.0, 0.0, 0.0), (0.0, 1.0), DT).omega_rad_s > 0.0


def test_frame_change_on_the_way_changes_nothing(tracker: LegTracker, config: Config) -> None:
    other = LegTracker(config.control, config.limits, LAG)
    pose, target, turned = (0.1, 0.2, 0.3), (0.9, 0.5), 0.7

    def moved(f: Callable[[float], float], g: Callable[[float], float], p: tuple[float, float]) -> tuple[float, float]:
        return f(turned) * p[0] - g(turned) * p[1] + 5.0, g(turned) * p[0] + f(turned) * p[1] - 3.0

    tracker.begin(pose, target, False)
    other.begin(pose, target, False)
    far_pose = (*moved(cos, sin, pose[:2]), pose[2] + turned)
    a = tracker.step(pose, target, DT)
    b = other.step(far_pose, moved(cos, sin, target), DT)
    assert (a.v_m_s, a.omega_rad_s) == pytest.approx((b.v_m_s, b.omega_rad_s), abs=1e-12)


def test_the_thesis_gains_arrive_too_but_slowly(config: Config) -> None:
    control = config.control.model_copy(update={"gains": "thesis"})
    robot = Robot((0.0, 0.0, 0.0))
    spent = run_leg(LegTracker(control, config.limits, LAG), robot, (0.0, 0.22), False, limit_s=120.0)
    assert hypot(robot.x, robot.y - 0.22) < 0.01
    assert spent > 5.0


def test_turn_in_place_ends_within_tolerance(tracker: LegTracker) -> None:
    robot = Robot((0.0, 0.0, 0.0))
    tracker.begin_turn(-1.2)
    for _ in range(400):
        robot.drive(tracker.step_turn(difference(-1.2, robot.heading), DT))
        if tracker.phase is LegPhase.DONE:
            break
    assert robot.heading == pytest.approx(-1.2, abs=0.01)  # heading tolerance


# Carried to the right of +x by what 0.25 rad to the left make up for.
DRIFT = (0.0, -sin(0.25))


def test_against_a_drift_it_points_beside_the_bearing(tracker: LegTracker) -> None:
    tracker.begin((0.0, 0.0, 0.25), (0.5, 0.0), False, DRIFT)
    assert tracker.phase is LegPhase.DRIVE


def test_against_a_drift_it_turns_off_the_bearing(tracker: LegTracker) -> None:
    tracker.begin((0.0, 0.0, 0.0), (0.5, 0.0), False, DRIFT)
    assert tracker.phase is LegPhase.TURN
    assert tracker.step((0.0, 0.0, 0.0), (0.5, 0.0), DT, Twist(0.0, 0.0), DRIFT).omega_rad_s > 0.0


def test_driven_against_the_drift_the_wheels_are_faster(tracker: LegTracker) -> None:
    speeds = []
    for along in (0.0, -0.05):
        tracker.begin((0.0, 0.0, 0.0), (0.5, 0.0), False, (along, 0.0))
        speeds.append(tracker.step((0.0, 0.0, 0.0), (0.5, 0.0), DT, Twist(0.0, 0.0), (along, 0.0)).v_m_s)
    assert speeds[1] == pytest.approx(speeds[0] / 0.95)


def test_steering_damps_a_rate_that_it_did_not_want(tracker: LegTracker, config: Config) -> None:
    rates = []
    for omega in (0.0, 0.1):
        tracker.begin((0.0, 0.0, 0.0), (0.5, 0.0), False)
        rates.append(tracker.step((0.0, 0.0, 0.0), (0.5, 0.0), DT, Twist(0.0, omega)).omega_rad_s)
    assert rates[1] - rates[0] == pytest.approx(-0.1 * config.control.gain_sets["shipped"].angular.kd)


def test_a_turn_does_not_chase_the_bearing_of_a_stop_at_its_feet(tracker: LegTracker) -> None:
    # The turn carries the robot round the stop, which is always a radian further.
    stop, near_m = (0.3, 0.4), 0.002

    def carry(robot: Robot) -> None:
        robot.x, robot.y = stop[0] - near_m * cos(robot.heading + 1.0), stop[1] - near_m * sin(robot.heading + 1.0)

    robot = Robot((0.0, 0.0, 0.0))
    carry(robot)
    tracker.begin(robot.pose, stop, reverse=False)
    planned_s, t = tracker.planned_s, 0.0
    while tracker.phase is not LegPhase.DONE:
        robot.drive(tracker.step(robot.pose, stop, DT))
        carry(robot)
        t += DT
        assert t < 1.2 * planned_s, f"still {tracker.phase} after {t} s"
    assert t >= planned_s
