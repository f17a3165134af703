"""Property tests of the edge rule on the real mirrors, with a small kinematic robot in virtual time.

The robot: first-order wheels (T = 0.08 s), sensors at 1 kHz, frames at 100 Hz, permits and drives in force two frames
after the frame that they answer. Motion follows the tangent plane of the curved surface; the rule knows only a flat one.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from math import cos, hypot, pi, radians, sin, tan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ccatp.config.loader import load_config
from ccatp.config.models import Config
from ccatp.danger import DangerMonitor
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.samples import DeckPose, EdgeSample, EventCode, Verdict, WheelSample

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


@dataclass(slots=True)
class Frame:
    seq: int
    t: float
    enc: list[WheelSample]
    edge: list[EdgeSample]


@dataclass(slots=True)
class Pose:
    seq: int
    t_s: float
    x_m: float
    y_m: float
    heading_rad: float
    sigma_m: float
    state: str = "driving"


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
    wheels: tuple[float, float] = (0.0, 0.0)
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
        self.estimate: Pose | None = None
        self._answers: deque[tuple[tuple[float, float], Verdict | None]] = deque([((0.0, 0.0), None)] * LATENCY_FRAMES)
        self._at_declaration: tuple[float, tuple[float, ...]] | None = None
        self.frame()  # the first estimate exists before the robot is told to move

    def twist(self, v: float, omega: float) -> None:
        """Command a velocity; wheels that already turn so (``running``) need ``self.wheels`` too."""
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
        verdict = self.monitor.step(Frame(self.seq, self.t, enc, edge), self.estimate)
        self.verdicts.append(verdict)
        self._answers.append((self.command, verdict))
        self._watch(verdict)
        if self.error is None:
            self.estimate = None
        else:
            x, y, heading = (a + b for a, b in zip(self.pose, self.error, strict=True))
            self.estimate = Pose(self.seq, self.t, x, y, heading, self.sigma_m)
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


def boundary(name: str, share: float) -> tuple[float, float, float]:
    """A place on the rim at ``share`` of its length, and the direction of the outward normal."""
    vertices = world(name)[1].rim.vertices.tolist()
    edges = list(zip(vertices, vertices[1:] + vertices[:1], strict=True))
    lengths = [hypot(b[0] - a[0], b[1] - a[1]) for a, b in edges]
    left = share * sum(lengths)
    for (a, b), length in zip(edges, lengths, strict=True):
        if left <= length:
            ux, uy = (b[0] - a[0]) / length, (b[1] - a[1]) / length
            # The outline runs counter-clockwise: outward is to the right.
            return a[0] + left * ux, a[1] + left * uy, pi / 2 * round((_atan2(uy, ux) - pi / 2) / (pi / 2))
        left -= length
    return boundary(name, 0.0)


def _atan2(y: float, x: float) -> float:
    from math import atan2

    return atan2(y, x)


def drive_off(
    name: str,
    share: float,
    angle: float,
    speed: float,
    error: tuple[float, float, float] | None,
    *,
    backwards: bool = False,
    **options: object,
) -> Robot:
    """Drive straight off the rim from 0.22 m inside it, at ``angle`` to the rim's normal."""
    x, y, normal = boundary(name, share)
    course = normal + angle
    x, y = x - 0.22 / cos(angle) * cos(course), y - 0.22 / cos(angle) * sin(course)
    heading = course + (pi if backwards else 0.0)
    robot = Robot(name, (x, y, heading), error, **options)  # type: ignore[arg-type]
    robot.twist(-speed if backwards else speed, 0.0)
    # 0.5 s more than it takes to get 50 mm beyond the rim
    robot.run((0.22 / cos(angle) + 0.05) / speed + 0.5)
    return robot
