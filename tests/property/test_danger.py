"""Property tests of the edge rule on the real mirrors, with a small kinematic robot in virtual time.

The robot: first-order wheels (T = 0.08 s), sensors at 1 kHz, frames at 100 Hz, permits and drives in force two frames
after the frame that they answer. Motion follows the tangent plane of the curved surface; the rule knows a flat one.
"""

from collections import deque
from dataclasses import dataclass, field
from functools import lru_cache
from math import atan2, copysign, cos, hypot, pi, radians, sin

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import DeckPose, EdgeSample, EventCode, PanelId, PointId, Verdict, WheelSample
from ccatp.danger import DangerMonitor
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.mirror.mirror import Mirror, build_mirror

MIRRORS = ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")
LAG_S = 0.08  # the robot's wheel servo, worlds.md
LATENCY_FRAMES = 2  # from a frame to the permit that answers it, on a link with one frame of delay each way
STEP_S = 1e-3
STEPS = 10
FRAME_S = STEPS * STEP_S
SIGMA_M = 0.002  # the start error of the worlds


@lru_cache
def world(name: str) -> tuple[Config, Mirror]:
    cfg = load_config(None, {"run.mirror": name})
    return cfg, build_mirror(cfg.mirror)


def frame_of(seq: int, t: float, enc: list[WheelSample], edge: list[EdgeSample]) -> Sensors:
    return Sensors(seq, t, [], enc, edge, None, (0.8, 0.8), 1.0, CommandEcho(0, 0.0, 0.0, False), [])


@dataclass
class Robot:
    """The true robot and the monitor that watches it.

    ``error`` (x, y, heading) is added to the pose that the monitor gets; None = no estimate at all.
    """

    name: str
    pose: tuple[float, float, float]
    error: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    sigma_m: float = SIGMA_M
    obeys_missing: bool = True  # without an estimate nothing is permitted; False: only edges stop this robot
    wheels: tuple[float, float] = (0.0, 0.0)  # true rates, right and left, rad/s
    command: tuple[float, float] = (0.0, 0.0)
    t: float = 0.0
    seq: int = 0
    verdicts: list[Verdict] = field(default_factory=list)
    overrun_m: float = 0.0
    least_centre_m: float = 1.0

    def __post_init__(self) -> None:
        cfg, self.mirror = world(self.name)
        self.cfg = cfg.robot
        self.monitor = DangerMonitor(self.mirror, cfg.robot, cfg.danger)
        self.estimate: EstimateMessage | None = None
        self._answers: deque[tuple[tuple[float, float], Verdict | None]] = deque([((0.0, 0.0), None)] * LATENCY_FRAMES)
        self._at_declaration: tuple[float, tuple[float, ...]] | None = None
        self.frame()  # the first estimate exists before the robot is told to move

    def twist(self, v: float, omega: float) -> None:
        """Command a velocity."""
        half = 0.5 * omega * self.cfg.wheel_base_m
        self.command = (v + half) / self.cfg.wheel_radius_m, (v - half) / self.cfg.wheel_radius_m

    def sensors(self) -> list[tuple[float, float]]:
        hx, hy, lx, ly = self.mirror.body_axes(DeckPose(*self.pose))
        x, y, _ = self.pose
        return [(x + ox * hx + oy * lx, y + ox * hy + oy * ly) for ox, oy in self.cfg.edge_sensors_m]

    def frame(self) -> Verdict:
        command, verdict = self._answers.popleft()
        right, left = command if self._permitted(command, verdict) else (0.0, 0.0)
        enc, edge = [], []
        for _ in range(STEPS):
            self._move(right, left)
            on = [int(self.mirror.is_on_panel(x, y)) for x, y in self.sensors()]
            enc.append(WheelSample(self.t, *self.wheels))
            edge.append(EdgeSample(self.t, on[0], on[1], on[2], on[3]))
        self.seq += 1
        verdict = self.monitor.step(frame_of(self.seq, self.t, enc, edge), self.estimate)
        self.verdicts.append(verdict)
        self._answers.append((self.command, verdict))
        self._watch(verdict)
        if self.error is None:
            self.estimate = None
        else:
            x, y, heading = (a + b for a, b in zip(self.pose, self.error, strict=True))
            self.estimate = EstimateMessage(
                seq=self.seq, t_s=self.t, x_m=x, y_m=y, heading_rad=heading, sigma_m=self.sigma_m, state="driving"
            )
        return verdict

    def run(self, duration_s: float) -> Verdict:
        for _ in range(max(1, round(duration_s / FRAME_S))):
            self.frame()
        return self.verdicts[-1]

    def _permitted(self, command: tuple[float, float], verdict: Verdict | None) -> bool:
        if verdict is None:
            return False
        if not self.obeys_missing and verdict.code is EventCode.NORMAL:
            return True
        v = command[0] + command[1]
        return (
            (v <= 1e-9 or verdict.forward)
            and (v >= -1e-9 or verdict.reverse)
            and (abs(command[0] - command[1]) < 1e-9 or verdict.turn)
        )

    def _move(self, right: float, left: float) -> None:
        gain = STEP_S / LAG_S
        wr, wl = self.wheels
        self.wheels = wr + gain * (right - wr), wl + gain * (left - wl)
        v = 0.5 * self.cfg.wheel_radius_m * sum(self.wheels)
        omega = self.cfg.wheel_radius_m / self.cfg.wheel_base_m * (self.wheels[0] - self.wheels[1])
        hx, hy, _, _ = self.mirror.body_axes(DeckPose(*self.pose))
        x, y, heading = self.pose
        self.pose = x + v * hx * STEP_S, y + v * hy * STEP_S, heading + omega * STEP_S
        self.t += STEP_S

    def _watch(self, verdict: Verdict) -> None:
        x, y, _ = self.pose
        rim = self.mirror.rim
        self.least_centre_m = min(self.least_centre_m, rim.signed_distance_m(x, y))
        if verdict.code is not EventCode.NEAR_EDGE:
            self._at_declaration = None
            return
        beyond = [-rim.signed_distance_m(*place) for place in self.sensors()]
        if self._at_declaration is None:
            self._at_declaration = self.t, tuple(beyond)
            return
        for now, then in zip(beyond, self._at_declaration[1], strict=True):
            self.overrun_m = max(self.overrun_m, now - max(then, 0.0))

    @property
    def has_edge(self) -> bool:
        return any(verdict.code is EventCode.NEAR_EDGE for verdict in self.verdicts)

    @property
    def episodes(self) -> int:
        return sum(self.monitor.episodes_opened.values())


Error = tuple[float, float, float]

names = st.sampled_from(MIRRORS)
speeds = st.floats(0.02, 0.15)
shares = st.floats(0.0, 1.0, exclude_max=True)
angles = st.floats(radians(-60.0), radians(60.0))
# Within three sigma of the start errors of the worlds: 2 mm and 0.01 rad.
errors = st.tuples(st.floats(-0.004, 0.004), st.floats(-0.004, 0.004), st.floats(-0.02, 0.02))
few = settings(max_examples=12, deadline=None)  # which ones is the profile's choice


def boundary(name: str, share: float) -> tuple[float, float, float]:
    """A place on the rim at ``share`` of its length, and the direction of the outward normal."""
    vertices = world(name)[1].rim.vertices.tolist()
    edges = list(zip(vertices, vertices[1:] + vertices[:1], strict=True))
    left = share * sum(hypot(b[0] - a[0], b[1] - a[1]) for a, b in edges)
    for a, b in edges:
        length = hypot(b[0] - a[0], b[1] - a[1])
        if left <= length:
            ux, uy = (b[0] - a[0]) / length, (b[1] - a[1]) / length
            # The outline runs counter-clockwise: outward is to the right.
            return a[0] + left * ux, a[1] + left * uy, atan2(-ux, uy)
        left -= length
    return boundary(name, 0.0)


def drive_off(
    name: str, share: float, angle: float, speed: float, error: Error | None, obeys_missing: bool = True
) -> Robot:
    """Drive straight off the rim from 0.22 m inside it, at ``angle`` to the rim's normal; speed < 0 = backwards."""
    x, y, normal = boundary(name, share)
    course = normal + angle
    run_up = 0.22 / cos(angle)
    x, y = x - run_up * cos(course), y - run_up * sin(course)
    # At a step of the rim the run-up may lie beyond it, or so close that the robot begins with a sensor off.
    assume(world(name)[1].rim.signed_distance_m(x, y) > 0.15)
    heading = course if speed > 0.0 else course + pi
    robot = Robot(name, (x, y, heading), error, obeys_missing=obeys_missing)
    robot.twist(speed, 0.0)
    # 0.5 s more than it takes to get the centre 50 mm beyond the rim
    robot.run((run_up + 0.05) / abs(speed) + 0.5)
    return robot


def check_stopped(robot: Robot, centre_m: float) -> None:
    assert robot.has_edge
    assert robot.overrun_m <= 0.020  # invariant I5
    assert robot.least_centre_m > centre_m


@few
@given(names, shares, angles, speeds, errors, st.booleans())
def test_no_fall_with_a_right_estimate(
    name: str, share: float, angle: float, speed: float, error: Error, backwards: bool
) -> None:
    robot = drive_off(name, share, angle, -speed if backwards else speed, error)
    check_stopped(robot, 0.02)  # half the lead of the sensors less 15 mm of stopping and 4 mm of error


@few
@given(names, shares, angles, speeds, st.floats(-pi, pi), st.sampled_from([0.0, pi / 2, 3.0]))
def test_overrun_with_an_estimate_one_metre_off(
    name: str, share: float, angle: float, speed: float, direction: float, turned: float
) -> None:
    robot = drive_off(name, share, angle, speed, (cos(direction), sin(direction), turned))
    assert robot.has_edge
    assert robot.overrun_m <= 0.020  # invariant I5
    if is_straight_rim(robot):
        assert robot.least_centre_m > 0.0


@few
@given(names, shares, angles, speeds)
def test_no_fall_where_the_estimate_pretends_a_seam(name: str, share: float, angle: float, speed: float) -> None:
    _, mirror = world(name)
    _, _, normal = boundary(name, share)
    panel = next(iter(mirror.panels.values()))
    # Moved in by one panel and a gap and a half, the rim lies in the middle of a seam.
    shift_x = 2.0 * panel.half_x_m + 1.5 * mirror.gap_m
    shift_y = 2.0 * panel.half_y_m + 1.5 * mirror.gap_m
    robot = drive_off(name, share, angle, speed, (-cos(normal) * shift_x, -sin(normal) * shift_y, 0.0))
    assert robot.has_edge
    assert robot.overrun_m <= 0.020  # invariant I5
    if is_straight_rim(robot):
        assert robot.least_centre_m > 0.0


@few
@given(names, shares, angles, speeds)
def test_no_fall_without_an_estimate_even_where_only_edges_stop_the_robot(
    name: str, share: float, angle: float, speed: float
) -> None:
    robot = drive_off(name, share, angle, speed, None, obeys_missing=False)
    assert robot.has_edge
    assert robot.overrun_m <= 0.020  # invariant I5
    if is_straight_rim(robot):
        assert robot.least_centre_m > 0.0


def is_straight_rim(robot: Robot) -> bool:
    """No inner corner of the rim within reach: there the tip of a notch passes between the sensors, and only the map
    can tell (``ccatp.safety.edge_rule``)."""
    x, y, _ = robot.pose
    return all(hypot(x - vx, y - vy) > 0.25 for vx, vy in inner_corners(robot.name))


@lru_cache
def inner_corners(name: str) -> list[tuple[float, float]]:
    v = world(name)[1].rim.vertices.tolist()
    turns = [
        (b, (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0]))
        for a, b, c in zip(v[-1:] + v[:-1], v, v[1:] + v[:1], strict=True)
    ]
    return [(b[0], b[1]) for b, turn in turns if turn < 0.0]


@pytest.mark.parametrize("name", MIRRORS)
def test_no_fall_into_an_inner_corner_with_a_right_estimate(name: str) -> None:
    _, mirror = world(name)
    for x, y in inner_corners(name):
        # Along the bisector, outwards from the middle: the tip comes exactly under the centre.
        course = atan2(copysign(1.0, y), copysign(1.0, x))
        robot = Robot(name, (x - 0.15 * cos(course), y - 0.15 * sin(course), course), (0.002, -0.002, 0.005))
        robot.twist(0.15, 0.0)
        robot.run(1.5)
        check_stopped(robot, 0.02)  # 45 mm less 15 mm of stopping and 3 mm of error
        assert mirror.rim.signed_distance_m(*robot.pose[:2]) > 0.02


# -- seams ------------------------------------------------------------------------------------------------------------


def cross_seam(
    name: str, at: tuple[int, bool, bool, float], angle: float, speed: float, error: Error, stops: list[float]
) -> Robot:
    """Drive a whole robot over a seam of a panel, at ``angle`` to the seam's normal, pausing at each of ``stops``.

    ``at``: number of the panel, which of its four sides (two flags), place along the side (-1 to 1).
    """
    _, mirror = world(name)
    number, is_x, is_positive, along = at
    panel = list(mirror.panels.values())[number % len(mirror.panels)]
    side = 1 if is_positive else -1
    row, col = panel.id
    assume((PanelId(row, col + side) if is_x else PanelId(row + side, col)) in mirror.panels)
    half_gap = 0.5 * mirror.gap_m
    x = panel.x_m + (side * (panel.half_x_m + half_gap) if is_x else along * (panel.half_x_m - 0.01))
    y = panel.y_m + (along * (panel.half_y_m - 0.01) if is_x else side * (panel.half_y_m + half_gap))
    course = (0.0 if side > 0 else pi) if is_x else side * pi / 2
    course += angle
    length = 0.14 + mirror.gap_m / cos(angle)
    start = x - length * cos(course), y - length * sin(course)
    robot = Robot(name, (*start, course), error)
    robot.twist(speed, 0.0)
    robot.wheels = robot.command
    assume(is_free(robot, course, 2.0 * length, is_x, angle))
    for stop in stops:
        robot.run(stop * 2.0 * length / speed)
        command, robot.command = robot.command, (0.0, 0.0)
        robot.run(0.5)
        robot.command = command
    robot.run((1.0 - sum(stops)) * 2.0 * length / speed)
    return robot


def is_free(robot: Robot, course: float, length: float, is_x: bool, angle: float) -> bool:
    """The robot stays on the mirror, and meets a crossing seam only at 60 degrees to its normal or less."""
    x0, y0, _ = robot.pose
    mirror = robot.mirror
    for k in range(31):
        x, y = x0 + k / 30 * length * cos(course), y0 + k / 30 * length * sin(course)
        if mirror.rim.signed_distance_m(x, y) < 0.16:
            return False
        if abs(angle) >= radians(30.0):
            continue
        panel = mirror.panels[mirror.nearest_panel(x, y)]
        to_side = panel.half_y_m - abs(y - panel.y_m) if is_x else panel.half_x_m - abs(x - panel.x_m)
        # 127 mm: a corner sensor's radius; 10 mm: how far the path moves between two looks
        if to_side < 0.127 + 0.010:
            return False
    return True


sides = st.tuples(st.integers(0, 200), st.booleans(), st.booleans(), st.floats(-1.0, 1.0))


@few
@given(names, sides, angles, st.floats(0.005, 0.15), errors)
def test_no_false_edge_at_a_seam(
    name: str, at: tuple[int, bool, bool, float], angle: float, speed: float, error: Error
) -> None:
    robot = cross_seam(name, at, angle, max(speed, 0.02), error, [])
    assert not robot.has_edge


@few
@given(names, sides, angles, errors, st.lists(st.floats(0.05, 0.4), min_size=1, max_size=2))
def test_no_false_edge_with_stops_over_the_gap(
    name: str, at: tuple[int, bool, bool, float], angle: float, error: Error, stops: list[float]
) -> None:
    assert not cross_seam(name, at, angle, 0.08, error, stops).has_edge


@settings(max_examples=3, deadline=None)
@given(names, sides, angles, errors)
def test_no_false_edge_at_5_mm_a_second(
    name: str, at: tuple[int, bool, bool, float], angle: float, error: Error
) -> None:
    assert not cross_seam(name, at, angle, 0.005, error, []).has_edge


# -- turns in place ---------------------------------------------------------------------------------------------------

turns = st.lists(st.tuples(st.integers(-16, 16), st.sampled_from([0.3, 1.0])), min_size=1, max_size=3)


def turn_about(
    name: str, place: tuple[float, float], heading: float, error: Error, steps: list[tuple[int, float]]
) -> Robot:
    """Turn in place by multiples of 22.5 degrees, with a stop after each."""
    assume(world(name)[1].rim.signed_distance_m(*place) > 0.128)  # a corner sensor's radius
    robot = Robot(name, (*place, heading), error)
    for sixteenths, rate in steps:
        robot.twist(0.0, copysign(rate, sixteenths))
        robot.run(abs(sixteenths) * pi / 8 / rate)
        robot.twist(0.0, 0.0)
        robot.run(0.4)
    return robot


@few
@given(names, st.integers(0, 200), st.integers(1, 9), st.integers(0, 15), errors, turns)
def test_no_false_edge_in_turns_at_the_measurement_points(
    name: str, number: int, point: int, sixteenths: int, error: Error, steps: list[tuple[int, float]]
) -> None:
    _, mirror = world(name)
    panel = list(mirror.panels)[number % len(mirror.panels)]
    place = mirror.point_on_deck(PointId(*panel, point))
    robot = turn_about(name, place, sixteenths * pi / 8, error, steps)
    assert not robot.has_edge


@few
@example("thesis-m1", 40, (0.9, 1.0), 0.1, (0.0, 0.0, 0.0), [(16, 1.0)])
@given(names, st.integers(0, 200), st.tuples(st.floats(-1, 1), st.floats(-1, 1)), st.floats(-pi, pi), errors, turns)
def test_no_false_edge_in_turns_anywhere(
    name: str,
    number: int,
    share: tuple[float, float],
    heading: float,
    error: Error,
    steps: list[tuple[int, float]],
) -> None:
    _, mirror = world(name)
    panel = list(mirror.panels.values())[number % len(mirror.panels)]
    # The cube root crowds the places towards the seams, where the corner sensors sweep over them.
    x, y = (copysign(abs(s) ** (1 / 3), s) for s in share)
    place = panel.x_m + x * panel.half_x_m, panel.y_m + y * panel.half_y_m
    assert not turn_about(name, place, heading, error, steps).has_edge
