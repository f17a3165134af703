"""Pure. The robot's sensors: what they read of the plant, at their own rates and with the world's noise.

Samples are plain tuples in the order of the robot link, rounded as a real sensor bus would. Every sensor draws from a
stream of its own, so that its noise depends on the seed alone, not on the rates of the others.
"""

from collections.abc import Sequence
from math import exp, floor, hypot

import numpy as np

from ccatp.config.models import SimRobotConfig, WorldConfig
from ccatp.mirror.mirror import Mirror
from ccatp.sim.plant import Plant

ImuTuple = tuple[float, float, float]
WheelTuple = tuple[float, float, float]
EdgeTuple = tuple[float, int, int, int, int]
GravityTuple = tuple[float, float, float, float]
Rectangle = tuple[float, float, float, float]

_BLOCK = 4096
_SAME_RATIO = 1e-9  # rates this near to a whole ratio are meant to be one
_PER_UNIT = 1e7  # resolution of rates and accelerations: far below every noise, short on the wire
# A frame within which no sensor comes this near to a panel's edge needs no sub-samples. The arc that a sensor travels
# in a frame departs from its chord by microns.
_EDGE_MARGIN_M = 1e-3
_NOWHERE: Rectangle = (1.0, 0.0, 1.0, 0.0)


class NoiseStream:
    """Standard normal numbers of one sensor, drawn in blocks: a function of the seed only.

    Args:
        rng: the sensor's own generator.
    """

    __slots__ = ("_block", "_next", "_rng")

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._block: list[float] = []
        self._next = 0

    def take(self, count: int) -> list[float]:
        """The next ``count`` numbers."""
        start = self._next
        self._next = end = start + count
        if end <= len(self._block):
            return self._block[start:end]
        rest = self._block[start:]
        while len(rest) < count:
            rest += self._rng.standard_normal(_BLOCK).tolist()
        self._block, self._next = rest, count
        return rest[:count]


class SampleTimes:
    """Instants ``n / hz`` that fall into the frames ``((k-1)/frame_hz, k/frame_hz]``.

    Args:
        hz: rate of the sensor.
        frame_hz: rate of the frames.
        lag_s: time constant of the wheel servo, for ``decays``.

    Attributes:
        times_s: the instants of the frame entered last.
        fractions: the same, as fractions of the frame, in (0, 1].
        decays: ``exp(-tau/lag)`` at the same instants, tau counted from the start of the frame.
    """

    __slots__ = ("_every", "_frame_hz", "_hz", "_lag_s", "decays", "fractions", "times_s")

    def __init__(self, hz: float, frame_hz: float, lag_s: float) -> None:
        self._hz, self._frame_hz, self._lag_s = hz, frame_hz, lag_s
        ratio = hz / frame_hz
        count = round(ratio) if abs(ratio - round(ratio)) < _SAME_RATIO * ratio else 0
        fractions = [(j + 1) / count for j in range(count)]
        self._every = (count, fractions, self._decays(fractions))
        self.times_s: list[float] = []
        self.fractions: list[float] = []
        self.decays: list[float] = []

    def enter(self, frame: int) -> None:
        """Go on to a frame; frame 0 is the single instant of boot."""
        hz = self._hz
        count, self.fractions, self.decays = self._every
        if frame == 0:
            self.times_s, self.fractions, self.decays = [0.0], [1.0], [1.0]
        elif count:
            last = frame * count
            self.times_s = [n / hz for n in range(last - count + 1, last + 1)]
        else:
            ratio = hz / self._frame_hz
            first, last = floor((frame - 1) * ratio + _SAME_RATIO) + 1, floor(frame * ratio + _SAME_RATIO)
            self.times_s = [n / hz for n in range(first, last + 1)]
            self.fractions = [n / ratio - (frame - 1) for n in range(first, last + 1)]
            self.decays = self._decays(self.fractions)

    def _decays(self, fractions: Sequence[float]) -> list[float]:
        return [exp(-f / (self._frame_hz * self._lag_s)) for f in fractions]


class SensorSuite:
    """All sensors of the robot.

    Call ``enter`` once per frame, after the plant's step, then read each sensor once.
    """

    def __init__(
        self,
        mirror: Mirror,
        cfg: SimRobotConfig,
        world: WorldConfig,
        edge_sensors_m: Sequence[tuple[float, float]],
        rng: np.random.Generator,
    ) -> None:
        """Set up the streams.

        Args:
            mirror: the panels and the direction of gravity.
            cfg: rates and gravity noise.
            world: noise of inertial unit and encoders.
            edge_sensors_m: places of the edge sensors, robot frame, shape (4, 2).
            rng: parent of the sensors' generators.
        """
        imu, encoders, gravity = rng.spawn(3)
        self._mirror, self._world = mirror, world
        self._imu_noise, self._encoder_noise, self._gravity_noise = (
            NoiseStream(imu),
            NoiseStream(encoders),
            NoiseStream(gravity),
        )
        self._gravity_sigma = cfg.gravity_sigma_rad
        frame_hz, lag_s = cfg.frame_hz, cfg.wheel_lag_s
        self._imu_times = SampleTimes(cfg.imu_hz, frame_hz, lag_s)
        self._encoder_times = SampleTimes(cfg.encoder_hz, frame_hz, lag_s)
        self._edge_times = SampleTimes(cfg.edge_hz, frame_hz, lag_s)
        self._gravity_times = SampleTimes(cfg.gravity_hz, frame_hz, lag_s)
        self.edges = EdgeSensors(mirror, edge_sensors_m)

    def enter(self, frame: int) -> None:
        """Go on to the instants of a frame (counted from 1; frame 0 is the instant of boot)."""
        self._imu_times.enter(frame)
        self._encoder_times.enter(frame)
        self._edge_times.enter(frame)
        self._gravity_times.enter(frame)

    def read_imu(self, plant: Plant) -> list[ImuTuple]:
        """(t, ax, wz) of the frame: acceleration of the forward speed and angular rate about the normal."""
        times = self._imu_times
        noise = self._imu_noise.take(2 * len(times.times_s))
        sigma_a, sigma_w = self._world.accelerometer_sigma_m_s2, self._world.gyroscope_sigma_rad_s
        return [
            (
                t,
                floor((plant.acceleration_at(e) + sigma_a * noise[2 * j]) * _PER_UNIT + 0.5) / _PER_UNIT,
                floor((plant.turn_rate_at(e) + sigma_w * noise[2 * j + 1]) * _PER_UNIT + 0.5) / _PER_UNIT,
            )
            for j, (t, e) in enumerate(zip(times.times_s, times.decays, strict=True))
        ]

    def read_encoders(self, plant: Plant) -> list[WheelTuple]:
        """(t, right, left) wheel rates of the frame."""
        times = self._encoder_times
        count = len(times.times_s)
        noise = self._encoder_noise.take(2 * count)
        sigma = self._world.encoder_sigma_rad_s * _PER_UNIT
        return [
            (
                t,
                floor(right * _PER_UNIT + sigma * a + 0.5) / _PER_UNIT,
                floor(left * _PER_UNIT + sigma * b + 0.5) / _PER_UNIT,
            )
            for t, (right, left), a, b in zip(
                times.times_s, plant.rates_at(times.decays), noise[:count], noise[count:], strict=True
            )
        ]

    def read_edges(self, plant: Plant) -> list[EdgeTuple]:
        """(t, front left, front right, rear left, rear right) of the frame."""
        return self.edges.read(plant, self._edge_times.times_s, self._edge_times.fractions)

    def read_gravity(self, plant: Plant) -> GravityTuple | None:
        """(t, gx, gy, gz) where the sensor was read within the frame: the newest reading."""
        times = self._gravity_times.times_s
        if not times:
            return None
        sigma = self._gravity_sigma
        noise = self._gravity_noise.take(3)
        gx, gy, gz = (g + sigma * n for g, n in zip(self._mirror.gravity_in_robot(plant.pose), noise, strict=True))
        scale = _PER_UNIT / hypot(gx, gy, gz)
        x, y, z = (floor(g * scale + 0.5) / _PER_UNIT for g in (gx, gy, gz))
        return times[-1], x, y, z


class EdgeSensors:
    """Whether there is panel material under each edge sensor.

    Attributes:
        places: deck (x, y) of the sensors at the end of the last frame, m.
    """

    __slots__ = ("_mirror", "_offsets", "_rectangles", "_values", "places")

    def __init__(self, mirror: Mirror, offsets_m: Sequence[tuple[float, float]]) -> None:
        """Set up; ``place`` before the first ``read``."""
        self._mirror = mirror
        self._offsets = [(float(x), float(y)) for x, y in offsets_m]
        self._rectangles = [_NOWHERE] * len(self._offsets)
        self._values = (1, 1, 1, 1)
        self.places: list[tuple[float, float]] = []

    def place(self, plant: Plant) -> None:
        """Put the sensors where the plant is."""
        self.places = self._places(plant)
        a, b, c, d = (int(self._mirror.is_on_panel(x, y)) for x, y in self.places)
        self._values = a, b, c, d

    def read(self, plant: Plant, times_s: Sequence[float], fractions: Sequence[float]) -> list[EdgeTuple]:
        """Readings at the times of a frame.

        Args:
            plant: after its step.
            times_s: when the sensors are read.
            fractions: the same, as fractions of the frame, ascending to at most 1.
        """
        if plant.is_moving:
            before, self.places = self.places, self._places(plant)
            unsafe = [k for k in range(4) if not self._is_safe(k, before[k])]
            if unsafe:
                return self._sample(before, unsafe, times_s, fractions)
            self._values = (1, 1, 1, 1)
        a, b, c, d = self._values
        return [(t, a, b, c, d) for t in times_s]

    def _places(self, plant: Plant) -> list[tuple[float, float]]:
        x, y, hx, hy, lx, ly = plant.x_m, plant.y_m, plant.hx, plant.hy, plant.lx, plant.ly
        return [(x + a * hx + b * lx, y + a * hy + b * ly) for a, b in self._offsets]

    def _is_safe(self, k: int, before: tuple[float, float]) -> bool:
        """The sensor stayed well within one panel: both ends do, and a panel is convex."""
        x, y = self.places[k]
        x0, x1, y0, y1 = self._rectangles[k]
        if x0 <= x <= x1 and y0 <= y <= y1 and x0 <= before[0] <= x1 and y0 <= before[1] <= y1:
            return True
        self._rectangles[k] = x0, x1, y0, y1 = self._rectangle(x, y)
        return x0 <= x <= x1 and y0 <= y <= y1 and x0 <= before[0] <= x1 and y0 <= before[1] <= y1

    def _rectangle(self, x: float, y: float) -> Rectangle:
        panel_id = self._mirror.panel_at(x, y)
        if panel_id is None:
            return _NOWHERE
        panel = self._mirror.panels[panel_id]
        half_x, half_y = panel.half_x_m - _EDGE_MARGIN_M, panel.half_y_m - _EDGE_MARGIN_M
        return panel.x_m - half_x, panel.x_m + half_x, panel.y_m - half_y, panel.y_m + half_y

    def _sample(
        self,
        before: Sequence[tuple[float, float]],
        unsafe: Sequence[int],
        times_s: Sequence[float],
        fractions: Sequence[float],
    ) -> list[EdgeTuple]:
        is_on = self._mirror.is_on_panel
        lines = [(k, *before[k], *self.places[k]) for k in unsafe]
        values = [1, 1, 1, 1]
        found: list[EdgeTuple] = []
        for t, f in zip(times_s, fractions, strict=True):
            for k, x0, y0, x1, y1 in lines:
                values[k] = int(is_on(x0 + f * (x1 - x0), y0 + f * (y1 - y0)))
            found.append((t, values[0], values[1], values[2], values[3]))
        for k, _, _, x1, y1 in lines:
            values[k] = int(is_on(x1, y1))
        self._values = values[0], values[1], values[2], values[3]
        return found
