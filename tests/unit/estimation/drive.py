"""Pure but for reading the shipped configuration. A robot on the curved deck, and the localizer that listens to it.

The truth carries the heading as a vector in space: every millisecond it moves along the surface, and what of the vector
leaves the tangent plane is cut off, which is parallel transport. It shares the mirror's polynomial with the localizer,
and nothing else.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import atan2, cos, floor, hypot, pi, sin, sqrt
from typing import Any, NamedTuple

import numpy as np

from ccatp.config.models import FOUR_STATE, Config
from ccatp.core import (
    DeckPose,
    EdgeSample,
    Fix,
    FloatArray,
    GravitySample,
    ImuSample,
    PanelId,
    PanelPose,
    Vector3,
    WheelSample,
)
from ccatp.estimation.full_state import FullStateLocalizer
from ccatp.estimation.localizer_base import FilterWrap, unwrapped
from ccatp.filters.base import Filter, FilterDiverged
from ccatp.kinematics import difference
from ccatp.localizer import Localizer, build_localizer
from tests.support.scenario import config_of, mirror_of

Rate = Callable[[float], float]
DT_S = 1e-3
PER_FRAME = 10
FRAME_S = DT_S * PER_FRAME
STEEP = PanelPose(PanelId(2, 8), 0.0, 0.0, 0.3)  # near the border: both slopes, and the mixed derivative, are large


class Frame(NamedTuple):
    """Arguments of ``FullStateLocalizer.step``."""

    t_s: float
    imu: list[ImuSample]
    encoders: list[WheelSample]
    edges: list[EdgeSample]
    gravity: GravitySample | None


config, mirror = cache(config_of), mirror_of


def build(
    name: str = "ekf",
    start: PanelPose = STEEP,
    use: dict[str, bool] | None = None,
    wrap: FilterWrap = unwrapped,
    **changes: float,
) -> FullStateLocalizer:
    """A localizer; ``use`` sets switches, ``changes`` entries of [localizer.full_state] and [localizer]."""
    found = build_localizer(changed(name, use, **changes), mirror(), wrap, start)
    assert isinstance(found, FullStateLocalizer)
    return found


def changed(name: str = "ekf", use: dict[str, bool] | None = None, **changes: float) -> Config:
    cfg = config().localizer
    full, four = cfg.full_state, cfg.four_state
    own = four if name in FOUR_STATE else full  # both have densities
    of_own = {key: value for key, value in changes.items() if hasattr(own, key)}
    of_both = {key: value for key, value in changes.items() if hasattr(cfg, key) and key not in of_own}
    assert changes.keys() == of_own.keys() | of_both.keys()
    full = full.model_copy(update={"use": full.use.model_copy(update=use or {}), **(of_own if own is full else {})})
    four = four.model_copy(update=of_own if own is four else {})
    cfg = cfg.model_copy(update={"full_state": full, "four_state": four, **of_both})
    run = config().run.model_copy(update={"filter": name})
    return config().model_copy(update={"localizer": cfg, "run": run})


def nothing(_: float) -> float:
    return 0.0


def trapeze(begin_s: float, duration_s: float, top: float, ramp: float) -> Rate:
    """A rate that rises with slope ``ramp``, stays at ``top`` and falls again."""

    def at(t: float) -> float:
        t -= begin_s
        return top * max(0.0, min(1.0, t * ramp / abs(top), (duration_s - t) * ramp / abs(top)))

    return at


@dataclass(frozen=True)
class Errors:
    """What is wrong with the robot; names and signs as in ``state_model``."""

    right_slip: float = 0.0
    left_slip: float = 0.0
    base: float = 0.0
    creep: float = 0.0
    turn_creep: float = 0.0  # m/rad
    gyro_bias: float = 0.0
    gyro_scale: float = 0.0
    accelerometer_bias: float = 0.0
    noise: float = 0.0  # of the sensors, in units of the thesis's table 2.1
    counts_per_turn: int = 0  # of the encoders; 0 = they give rates


def dot(a: Vector3, b: Vector3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def along_surface(v: Vector3, n: Vector3) -> Vector3:
    """Unit vector of the part of ``v`` across the unit vector ``n``."""
    d = dot(v, n)
    x, y, z = v[0] - d * n[0], v[1] - d * n[1], v[2] - d * n[2]
    length = sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


class Robot:
    """The robot as it really moves.

    Args:
        start: where it stands at first.
        v, omega: speed (m/s) and rate (rad/s) of the body over time, creep apart.
        errors: what is wrong with it.
        has_edges: whether the edge sensors read the map; costs as much as all the rest.
        shift: how far the panels' edges lie from the map along x and y.
    """

    def __init__(
        self,
        start: PanelPose = STEEP,
        v: Rate = nothing,
        omega: Rate = nothing,
        errors: Errors = Errors(),
        *,
        has_edges: bool = False,
        shift_m: tuple[float, float] = (0.0, 0.0),
        seed: int = 1,
    ) -> None:
        self.mirror, self.cfg = mirror(), config().robot
        self.v, self.omega, self.errors = v, omega, errors
        self.has_edges, self.shift_m = has_edges, shift_m
        self.rng = np.random.default_rng(seed)
        self.ticks = 0
        pose = self.mirror.deck_pose(start)
        self.x_m, self.y_m = pose.x_m, pose.y_m
        self.h = self.mirror.robot_axes(pose)[0]
        self.gravity = self.mirror.rotate_deck_from_world((0.0, 0.0, 1.0))
        self.angles = [0.3, 0.7]  # of the wheels: no count begins at zero

    @property
    def t_s(self) -> float:
        return self.ticks * DT_S

    @property
    def pose(self) -> DeckPose:
        e1, e2, _ = self.mirror.surface.axes(self.x_m, self.y_m)
        return DeckPose(self.x_m, self.y_m, atan2(dot(self.h, e2), dot(self.h, e1)))

    def wheel_rates(self, t_s: float) -> tuple[float, float]:
        e, r, half = self.errors, self.cfg.wheel_radius_m, 0.5 * self.cfg.wheel_base_m
        v, side = self.v(t_s), half * (1.0 + e.base) * self.omega(t_s)
        return (v + side) / (r * (1.0 - e.right_slip)), (v - side) / (r * (1.0 - e.left_slip))

    def move(self) -> None:
        middle_s = self.t_s + 0.5 * DT_S
        d, turn = self.v(middle_s) * DT_S, self.omega(middle_s) * DT_S
        for k, rate in enumerate(self.wheel_rates(middle_s)):
            self.angles[k] += rate * DT_S
        self.ticks += 1
        if d == turn == 0.0:
            return
        h, x, y = self._turned(self.h, self.x_m, self.y_m, 0.5 * turn), self.x_m, self.y_m
        for _ in range(2):  # the direction of the middle of the step
            n = self.mirror.surface.normal(x, y)
            h = along_surface(h, n)
            dx, dy = d * h[0], d * h[1]
            if self.errors.creep or self.errors.turn_creep:
                way = self.errors.creep * abs(d) + self.errors.turn_creep * abs(turn)
                g = along_surface(self.gravity, n)
                dx, dy = dx + way * g[0], dy + way * g[1]
            x, y = self.x_m + 0.5 * dx, self.y_m + 0.5 * dy
        self.x_m, self.y_m = self.x_m + dx, self.y_m + dy
        self.h = self._turned(h, self.x_m, self.y_m, 0.5 * turn)

    def _turned(self, h: Vector3, x: float, y: float, turn: float) -> Vector3:
        n = self.mirror.surface.normal(x, y)
        h = along_surface(h, n)
        if not turn:
            return h
        c, s = cos(turn), sin(turn)
        left = n[1] * h[2] - n[2] * h[1], n[2] * h[0] - n[0] * h[2], n[0] * h[1] - n[1] * h[0]
        return c * h[0] + s * left[0], c * h[1] + s * left[1], c * h[2] + s * left[2]

    def frame(self) -> Frame:
        e = self.errors
        encoders, edges = [], []
        for _ in range(PER_FRAME):
            before = self._counted()
            self.move()
            t = self.t_s
            if e.counts_per_turn:
                right, left = ((a - b) / DT_S for a, b in zip(self._counted(), before, strict=True))
            else:
                right, left = self.wheel_rates(t)
                if e.noise:
                    right, left = (rate + 0.001 * e.noise * self.rng.normal() for rate in (right, left))
            encoders.append(WheelSample(t, right, left))
            if self.has_edges:
                edges.append(self.edges())
        ax = (self.v(t) - self.v(t - 1e-5)) / 1e-5 + e.accelerometer_bias
        wz = self.omega(t) * (1.0 + e.gyro_scale) + e.gyro_bias
        if e.noise:
            ax, wz = ax + 0.0059 * e.noise * self.rng.normal(), wz + 0.0087 * e.noise * self.rng.normal()
        return Frame(t, [ImuSample(t, ax, wz)], encoders, edges, None)

    def _counted(self) -> tuple[float, float]:
        size = 2.0 * pi / (self.errors.counts_per_turn or 1)
        return size * floor(self.angles[0] / size), size * floor(self.angles[1] / size)

    def edges(self) -> EdgeSample:
        hx, hy, lx, ly = self.mirror.body_axes(self.pose)
        x, y = self.x_m - self.shift_m[0], self.y_m - self.shift_m[1]
        seen = ((x + a * hx + b * lx, y + a * hy + b * ly) for a, b in self.cfg.edge_sensors_m)
        return EdgeSample(self.t_s, *(int(self.mirror.is_on_panel(*place)) for place in seen))

    def frames(self, duration_s: float) -> list[Frame]:
        return [self.frame() for _ in range(round(duration_s / FRAME_S))]

    def fix(self, sigma_m: float = 1e-5, off_m: tuple[float, float] = (0.0, 0.0), t_s: float | None = None) -> Fix:
        """A fix of the puck now, ``off_m`` from where it is along deck x and y."""
        return fix_at(self.t_s if t_s is None else t_s, (self.x_m + off_m[0], self.y_m + off_m[1]), sigma_m)


def shifted(frame: Frame, by_s: float) -> Frame:
    """A frame of a robot whose clock is ahead."""
    return Frame(
        frame.t_s + by_s,
        [s._replace(t_s=s.t_s + by_s) for s in frame.imu],
        [s._replace(t_s=s.t_s + by_s) for s in frame.encoders],
        [s._replace(t_s=s.t_s + by_s) for s in frame.edges],
        None,
    )


class Fragile:
    """A filter that diverges when it is told to."""

    def __init__(self, filter_: Filter) -> None:
        self._filter = filter_
        self.is_broken = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._filter, name)

    def predict(self, F: Any, Q: FloatArray) -> None:
        if self.is_broken:
            raise FilterDiverged("for the sake of the test")
        self._filter.predict(F, Q)


def fix_at(t_s: float, xy_m: tuple[float, float], sigma_m: float = 1e-5) -> Fix:
    """A fix of a robot that stands at a deck point."""
    puck: Vector3 = mirror().puck_world(DeckPose(*xy_m, 0.0), config().robot.puck_height_m)
    c = sigma_m**2
    return Fix(t_s, puck, (c, 0.0, 0.0, 0.0, c, 0.0, 0.0, 0.0, c), 1.5, (1, 2, 3, 4), 1e-6)


def run(localizer: Localizer, frames: list[Frame]) -> None:
    for frame in frames:
        localizer.step(*frame)


def errors_of(localizer: Localizer, pose: DeckPose) -> tuple[float, float]:
    """Distance (m) and heading error (rad) of the estimate."""
    found = localizer.deck_pose
    return hypot(found.x_m - pose.x_m, found.y_m - pose.y_m), difference(found.heading_rad, pose.heading_rad)
