"""The robot's sensors: readings of the plant, each sensor at its own rate and with the world's errors.

Samples are plain tuples in the order of the robot link, rounded as by a real sensor bus. Every sensor draws from its
own stream, so that its noise depends on the seed alone, not on the rates of the others.

Each true panel edge is shifted along its normal, to represent the mounting of the panels. The shift affects the edge
sensors only; the rim at which the robot falls stays the ideal one.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain, islice, pairwise, repeat
from math import exp, hypot, inf, pi
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np

from ccatp.config.models import Config, PanelsConfig, WorldConfig
from ccatp.core import DeckPose, EdgeSample, GravitySample, ImuSample, PanelId, WheelSample
from ccatp.links.robot_codec import RobotFrame
from ccatp.links.robot_messages import Sensors
from ccatp.mirror.mirror import Mirror
from ccatp.sim.plant import BLOCK, WHOLE, DriftingBias, Plant, noise_stream

_SAME_RATIO = 1e-9  # a ratio of rates this close to an integer is taken as the integer
_BLOCK_FRAMES = 512  # instants are computed ahead for so many frames
_PER_UNIT = 1e7  # steps per unit of a rounded reading: a step is far below every noise, and the line stays short

WheelTuple = tuple[float, float, float]
ImuTuple = tuple[float, float, float]
GravityTuple = tuple[float, float, float, float]
MIN_GAP_M = 2e-4

# A sensor is sampled along the chord of its path within a frame, which differs from the arc by microns.
_ROUNDING_M = 1e-9
# Upper bound of the displacement of a sensor in the deck plane over that of the body; the surface is curved.
_CURVED = 1.01

Rectangle = tuple[float, float, float, float]
"""Low x, high x, low y, high y, m, deck plane."""
EdgeTuple = tuple[float, int, int, int, int]
_Body = tuple[float, float, float, float, float, float]
_Row = TypeVar("_Row", bound=tuple[object, ...])


class SampleTimes(NamedTuple):
    """Instants of a sensor in one frame."""

    times_s: list[float]
    fractions: list[float]  # of the frame, in (0, 1]
    decays: list[float]  # ``exp(-tau/lag_s)`` of the wheel servo, tau counted from the start of the frame


_NO_TIMES = SampleTimes([], [], [])


def sample_times(hz: float, frame_hz: float, lag_s: float, frame: int, count: int) -> list[SampleTimes]:
    """Instants ``n / hz`` that fall into ``count`` frames ``((k-1)/frame_hz, k/frame_hz]`` from k = ``frame`` on.

    For frame 0 the result is the single instant of the boot.
    """
    if frame == 0:
        return [SampleTimes([0.0], [1.0], [1.0])]

    def decays_at(fractions: Sequence[float]) -> list[float]:
        return [exp(-f / (frame_hz * lag_s)) for f in fractions]

    ratio = hz / frame_hz
    lasts = np.floor(np.arange(frame - 1, frame + count) * ratio + _SAME_RATIO).astype(np.int64)
    times_s = np.arange(lasts[0] + 1, lasts[-1] + 1) / hz
    per_frame = round(ratio)
    if abs(ratio - per_frame) < _SAME_RATIO * ratio:  # always at the same fractions of a frame
        fractions = [(j + 1) / per_frame for j in range(per_frame)]
        decays = decays_at(fractions)
        return named(SampleTimes, zip(times_s.reshape(-1, per_frame).tolist(), repeat(fractions), repeat(decays)))
    found: list[SampleTimes] = []
    times, starts = times_s.tolist(), (lasts - lasts[0]).tolist()
    for before, (start, end) in enumerate(pairwise(starts), frame - 1):
        if start == end:
            found.append(_NO_TIMES)
            continue
        row = times[start:end]
        fractions = [t * frame_hz - before for t in row]
        found.append(SampleTimes(row, fractions, decays_at(fractions)))
    return found


class RateEncoders:
    """Wheel rates with white noise, right and left independent."""

    def __init__(self, sigma_rad_s: float, rng: np.random.Generator) -> None:
        self._noise = noise_stream(rng, sigma_rad_s * _PER_UNIT)

    def read(self, plant: Plant, times: SampleTimes) -> list[WheelTuple]:
        """(t, right, left) wheel rates of the frame."""
        noise, count, unit, whole = self._noise, len(times.times_s), _PER_UNIT, WHOLE
        right_noise, left_noise = list(islice(noise, count)), list(islice(noise, count))
        right, right_lag, left, left_lag = (unit * rate_rad_s for rate_rad_s in plant.servo)
        found: list[WheelTuple] = []
        for t, e, a, b in zip(times.times_s, times.decays, right_noise, left_noise):  # noqa: B905 - of one length; bare it compiles to a plain loop
            right_rad_s = (right + right_lag * e + a + whole - whole) / unit
            left_rad_s = (left + left_lag * e + b + whole - whole) / unit
            found.append((t, right_rad_s, left_rad_s))
        return found


class CountingEncoders:
    """Rates that are differences of counted angles, ``rate = counts (2 pi / counts_per_rev) hz``.

    The wheel's angle is floored to whole counts at each sample. The rates are not rounded, so that their sum times the
    sample period is exactly the counted angle. The initial phase of the counter is drawn for each wheel.
    """

    def __init__(self, world: WorldConfig, hz: float, frame_s: float, rng: np.random.Generator) -> None:
        self._per_rad = world.encoder_counts_per_rev / (2.0 * pi)
        self._unit = 2.0 * pi / world.encoder_counts_per_rev * hz
        self._frame_s = frame_s
        self._right_phase, self._left_phase = rng.random(2).tolist()
        self._counts = 0.0, 0.0

    def read(self, plant: Plant, times: SampleTimes) -> list[WheelTuple]:
        """(t, right, left) wheel rates of the frame."""
        if plant.are_wheels_still:
            return [(t, 0.0, 0.0) for t in times.times_s]
        # The angle at tau is angle_0 + set tau + lag T (1 - exp(-tau/T)); all in counts, minus 0.5, so that rounding
        # gives the floor.
        per_rad, unit, whole = self._per_rad, self._unit, WHOLE
        right, left = self._counts
        right_0, left_0 = plant.start_angles_rad
        right_0, left_0 = right_0 * per_rad + self._right_phase - 0.5, left_0 * per_rad + self._left_phase - 0.5
        right_set, right_lag, left_set, left_lag = plant.servo
        right_per_frame, left_per_frame = right_set * per_rad * self._frame_s, left_set * per_rad * self._frame_s
        right_lag, left_lag = right_lag * per_rad * plant.lag_s, left_lag * per_rad * plant.lag_s
        found: list[WheelTuple] = []
        for t, f, e in zip(times.times_s, times.fractions, times.decays):  # noqa: B905 - of one length; bare it compiles to a plain loop
            gone = 1.0 - e
            right_new = right_0 + right_per_frame * f + right_lag * gone + whole - whole
            left_new = left_0 + left_per_frame * f + left_lag * gone + whole - whole
            found.append((t, (right_new - right) * unit, (left_new - left) * unit))
            right, left = right_new, left_new
        self._counts = right, left
        return found


class InertialUnit:
    """Reads ``ax + bias(t) + noise`` and ``wz (1 + scale) + bias(t) + noise``.

    Biases and noise do not depend on the motion, so they are drawn ahead in blocks. Scale and biases always take three
    draws, also if they are zero; ``bias_rng`` is the parent of their generators.
    """

    def __init__(
        self, world: WorldConfig, hz: float, noise_rng: np.random.Generator, bias_rng: np.random.Generator
    ) -> None:
        constants, ax_walk, wz_walk = bias_rng.spawn(3)
        scale, wz_bias, ax_bias = constants.standard_normal(3).tolist()
        self._scale = 1.0 + world.gyroscope_scale_sigma * scale
        self._wz_bias = DriftingBias(
            world.gyroscope_bias_sigma_rad_s * wz_bias, world.gyroscope_bias_walk_rad_s_sqrt_s, 1.0 / hz, wz_walk
        )
        self._ax_bias = DriftingBias(
            world.accelerometer_bias_sigma_m_s2 * ax_bias, world.accelerometer_bias_walk_m_s2_sqrt_s, 1.0 / hz, ax_walk
        )
        self._noise = noise_rng
        self._sigmas = world.accelerometer_sigma_m_s2, world.gyroscope_sigma_rad_s
        blocks: Iterator[list[list[float]]] = iter(self._errors, None)
        self._next_errors: Callable[[], list[float]] = chain.from_iterable(blocks).__next__

    def read(self, plant: Plant, times: SampleTimes) -> list[ImuTuple]:
        """(t, ax, wz) of the frame: acceleration of the forward speed and angular rate about the normal."""
        unit, whole = _PER_UNIT, WHOLE
        found: list[ImuTuple] = []
        for t, e in zip(times.times_s, times.decays):  # noqa: B905 - of one length; bare it compiles to a plain loop
            ax_error, wz_error = self._next_errors()
            ax = plant.acceleration_at(e) + ax_error
            wz = plant.turn_rate_at(e) * self._scale + wz_error
            found.append((t, (ax * unit + whole - whole) / unit, (wz * unit + whole - whole) / unit))
        return found

    def _errors(self) -> list[list[float]]:
        """Bias and noise of the next samples, acceleration and rate in turn."""
        errors = self._noise.standard_normal((BLOCK // 2, 2)) * self._sigmas
        errors[:, 0] += self._ax_bias.ahead(BLOCK // 2)
        errors[:, 1] += self._wz_bias.ahead(BLOCK // 2)
        rows: list[list[float]] = errors.tolist()
        return rows


def draw_rectangles(
    mirror: Mirror, panels: PanelsConfig, sigma_m: float, rng: np.random.Generator
) -> dict[PanelId, Rectangle]:
    """The rectangle of each panel as mounted: four draws per panel, in the order of ``mirror.panels``.

    An edge shifts outwards by at most half of (gap - ``MIN_GAP_M``). So neighbours keep a gap of ``MIN_GAP_M``, and
    every panel stays in its own cell: a point can only be on the panel of its cell.
    """
    x_out = max(0.0, 5e-4 * (panels.pitch_x_mm - panels.size_x_mm) - 0.5 * MIN_GAP_M)
    y_out = max(0.0, 5e-4 * (panels.pitch_y_mm - panels.size_y_mm) - 0.5 * MIN_GAP_M)
    found = {}
    for pid, p in mirror.panels.items():
        west, east, south, north = (sigma_m * rng.standard_normal(4)).tolist()
        x0, x1 = p.x_m - p.half_x_m - min(west, x_out), p.x_m + p.half_x_m + min(east, x_out)
        found[pid] = x0, x1, p.y_m - p.half_y_m - min(south, y_out), p.y_m + p.half_y_m + min(north, y_out)
    return found


def _outer_sides(panel: PanelId, material: Mapping[PanelId, Rectangle]) -> Rectangle:
    """The sides of a panel that lie at the rim; infinitely far where it has a neighbour."""
    (row, col), (x0, x1, y0, y1) = panel, material[panel]
    return (
        -inf if PanelId(row, col - 1) in material else x0,
        inf if PanelId(row, col + 1) in material else x1,
        -inf if PanelId(row - 1, col) in material else y0,
        inf if PanelId(row + 1, col) in material else y1,
    )


class EdgeSensors:
    """Whether there is panel material under each edge sensor; call ``place`` before the first ``read``.

    The panels are looked up again only when a sensor may have moved as far as its distance from an edge at the last
    look-up. ``offsets_m``: positions of the sensors, robot frame, shape (4, 2). ``material``: rectangles of the panels.
    """

    def __init__(
        self, mirror: Mirror, offsets_m: Sequence[tuple[float, float]], material: Mapping[PanelId, Rectangle]
    ) -> None:
        self._panel_at, self._material = mirror.panel_at, material
        self._outer = {panel: _outer_sides(panel, material) for panel in material}
        self._offsets = [(float(x), float(y)) for x, y in offsets_m]
        self._reach_m = _CURVED * max(hypot(x, y) for x, y in self._offsets)
        self._values = (1, 1, 1, 1)
        self._slack_m = 0.0
        self._body: _Body = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def places(self) -> list[tuple[float, float]]:
        """Deck (x, y) of the sensors at the end of the last frame, m."""
        return self._places_of(self._body)

    def _places_of(self, body: _Body) -> list[tuple[float, float]]:
        x, y, hx, hy, lx, ly = body
        return [(x + a * hx + b * lx, y + a * hy + b * ly) for a, b in self._offsets]

    def place(self, plant: Plant) -> None:
        """Take the pose of the plant, without readings on the way to it."""
        self._body = plant.x_m, plant.y_m, plant.hx, plant.hy, plant.lx, plant.ly
        self._look()

    def lift(self) -> None:
        """There is no panel under any sensor from now on: the robot has left the surface, and its wheels stand."""
        self._values = (0, 0, 0, 0)

    def is_on(self, x: float, y: float) -> bool:
        """Whether there is material at a point of the deck plane."""
        return self._inside_m(x, y) >= 0.0

    def _inside_m(self, x: float, y: float) -> float:
        """Least distance of a point from the edges of the panel of its cell, m; negative outside the panel."""
        panel = self._panel_at(x, y)
        if panel is None:
            return -1.0
        x0, x1, y0, y1 = self._material[panel]
        return min(x - x0, x1 - x, y - y0, y1 - y)

    def outer_edge_m(self, x: float, y: float) -> float:
        """Distance of a point from the nearest edge of its panel that has no neighbour, m; inf if all have one."""
        panel = self._panel_at(x, y)
        if panel is None:
            return inf
        x0, x1, y0, y1 = self._outer[panel]
        return min(x - x0, x1 - x, y - y0, y1 - y)

    def _look(self) -> None:
        inside_m = [self._inside_m(x, y) for x, y in self.places]
        a, b, c, d = (int(one >= 0.0) for one in inside_m)
        self._values, self._slack_m = (a, b, c, d), min(inside_m) - _ROUNDING_M

    def read(self, plant: Plant, times_s: Sequence[float], fractions: Sequence[float]) -> list[EdgeTuple]:
        """Readings at the times of a frame, after the plant's step.

        ``fractions``: the times as fractions of the frame, ascending to at most 1.
        """
        if plant.is_moving:
            before, self._body = self._body, (plant.x_m, plant.y_m, plant.hx, plant.hy, plant.lx, plant.ly)
            way_m = _CURVED * (abs(plant.forward_m) + abs(plant.left_m)) + self._reach_m * abs(plant.turn_rad)
            self._slack_m -= way_m
            if self._slack_m <= 0.0:
                chords = list(zip(self._places_of(before), self.places, strict=True))
                found: list[EdgeTuple] = []
                for t, f in zip(times_s, fractions, strict=True):
                    a, b, c, d = (int(self.is_on(x + f * (u - x), y + f * (v - y))) for (x, y), (u, v) in chords)
                    found.append((t, a, b, c, d))
                self._look()
                return found
        a, b, c, d = self._values
        return [(t, a, b, c, d) for t in times_s]


class SensorSuite:
    """All sensors of the robot; ``rng`` is the parent of their generators, ``lag_s``: of the true wheel servos."""

    def __init__(self, cfg: Config, mirror: Mirror, rng: np.random.Generator, *, lag_s: float) -> None:
        sim, world = cfg.sim.robot, cfg.world
        imu, encoders, gravity = rng.spawn(3)
        biases, counts, panel_edges = rng.spawn(3)
        self._gravity_noise = noise_stream(gravity, sim.gravity_sigma_rad)
        self._gravity_in_robot = mirror.gravity_in_robot
        self._gravity_pose: DeckPose | None = None
        self._gravity = (0.0, 0.0, 0.0)
        self._rates_hz = sim.edge_hz, sim.imu_hz, sim.encoder_hz, sim.gravity_hz
        self._frame_hz, self._lag_s = sim.frame_hz, lag_s
        self._ahead: list[tuple[SampleTimes, ...]] = []  # of the sensors in the order of their rates, frame by frame
        self._ahead_from = 0
        self._imu = InertialUnit(world, sim.imu_hz, imu, biases)
        (lateral,) = rng.spawn(1)
        self._lateral_bias_m_s2 = world.accelerometer_bias_sigma_m_s2 * float(lateral.standard_normal())
        sigma_m_s2 = hypot(world.accelerometer_sigma_m_s2, world.vibration_acceleration_m_s2)
        self._lateral_noise = noise_stream(lateral, sigma_m_s2)
        self._encoders: CountingEncoders | RateEncoders
        if world.encoder_counts_per_rev:
            self._encoders = CountingEncoders(world, sim.encoder_hz, 1.0 / sim.frame_hz, counts)
        else:
            self._encoders = RateEncoders(world.encoder_sigma_rad_s, encoders)
        material = draw_rectangles(mirror, cfg.mirror.panels, world.panel_edge_sigma_m, panel_edges)
        self.edges = EdgeSensors(mirror, cfg.robot.edge_sensors_m, material)

    def read(
        self, frame: int, plant: Plant, *, has_encoders: bool = True
    ) -> tuple[list[EdgeTuple], list[ImuTuple], list[WheelTuple], GravityTuple | None]:
        """Edge, inertial and encoder samples of a frame, and the newest reading of gravity within it.

        Frames count from 1; frame 0 is the instant of boot. Call it once per frame, after the plant's step.
        ``has_encoders``: else there is no sample of them.
        """
        at = frame - self._ahead_from
        if not 0 <= at < len(self._ahead):
            self._look_ahead(frame)
            at = 0
        edge_times, imu_times, encoder_times, gravity_times = self._ahead[at]
        return (
            self.edges.read(plant, edge_times.times_s, edge_times.fractions),
            self._imu.read(plant, imu_times),
            self._encoders.read(plant, encoder_times) if has_encoders else [],
            self._read_gravity(plant, gravity_times.times_s[-1]) if gravity_times.times_s else None,
        )

    def read_lateral(self, plant: Plant, decay: float) -> float:
        """Acceleration along robot y without gravity, m/s^2; vibration is white noise. The link does not report it."""
        return plant.lateral_acceleration_at(decay) + self._lateral_bias_m_s2 + next(self._lateral_noise)

    def _look_ahead(self, frame: int) -> None:
        rates_hz = self._rates_hz
        # Sensors of the same rate are read at the same instants.
        times = {hz: sample_times(hz, self._frame_hz, self._lag_s, frame, _BLOCK_FRAMES) for hz in set(rates_hz)}
        self._ahead = list(zip(*(times[hz] for hz in rates_hz), strict=True))
        self._ahead_from = frame

    def _read_gravity(self, plant: Plant, t_s: float) -> GravityTuple:
        pose = plant.pose
        if pose != self._gravity_pose:
            self._gravity_pose, self._gravity = pose, self._gravity_in_robot(pose)
        noise, unit, whole = self._gravity_noise, _PER_UNIT, WHOLE
        x, y, z = self._gravity
        x, y, z = x + next(noise), y + next(noise), z + next(noise)
        scale = unit / hypot(x, y, z)
        gx, gy, gz = ((component * scale + whole - whole) / unit for component in (x, y, z))
        return t_s, gx, gy, gz


def as_message(frame: RobotFrame) -> Sensors:
    """The message that a client decodes from the frame's line."""
    seq, t_s, imu, encoders, edges, gravity, fans, soc, cmd, faults, sliding = msgspec.structs.astuple(frame)
    read = named(ImuSample, imu), named(WheelSample, encoders), named(EdgeSample, edges)
    return Sensors(
        seq, t_s, *read, None if gravity is None else GravitySample(*gravity), fans, soc, cmd, list(faults), sliding
    )


def named(kind: type[_Row], rows: Iterable[tuple[object, ...]]) -> list[_Row]:
    """The rows as named tuples; five times as fast as a call of the class for each."""
    return list(map(tuple.__new__, repeat(kind), rows))
