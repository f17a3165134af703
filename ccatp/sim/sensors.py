"""The robot's sensors: what they read of the plant, at their own rates and with the world's errors; frames of readings.

Samples are plain tuples in the order of the robot link, rounded as a real sensor bus would. Every sensor draws from its
own stream, so that its noise depends on the seed alone, not on the rates of the others.

Encoders give either rates with white noise, or angles that are counted. An encoder that counts floors the wheel's angle
to whole counts at each sample and reports the change since the sample before as a rate,
``rate = counts (2 pi / counts_per_rev) hz``. The sum of rates times the sample period is the counted angle exactly, so
nothing is rounded here. The place of the first count is drawn for each wheel.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, pairwise, repeat
from math import exp, hypot, pi
from typing import TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from ccatp.config.models import PanelsConfig, SimRobotConfig, WorldConfig
from ccatp.core import DeckPose, EdgeSample, GravitySample, ImuSample, Vector3, WheelSample
from ccatp.links.robot_codec import encode_sensors
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.mirror.mirror import Mirror
from ccatp.sim.disturbances import BLOCK, WHOLE, DriftingBias, NoiseStream
from ccatp.sim.edge_sensors import EdgeSensors, EdgeTuple, PanelEdges
from ccatp.sim.plant import Plant

_SAME_RATIO = 1e-9  # rates this near to a whole ratio are meant to be one
_BLOCK_FRAMES = 512  # instants are computed ahead for so many frames

Instants = tuple[list[float], list[float], list[float]]
_BOOT: Instants = ([0.0], [1.0], [1.0])
_NONE: Instants = ([], [], [])


class SampleTimes:
    """Instants ``n / hz`` that fall into the frames ``((k-1)/frame_hz, k/frame_hz]``.

    Args:
        lag_s: time constant of the wheel servo, for ``decays``.

    Attributes:
        times_s: the instants of the frame entered last.
        fractions: the same, as fractions of the frame, in (0, 1].
        decays: ``exp(-tau/lag)`` at the same instants, tau counted from the start of the frame.
    """

    __slots__ = ("_ahead", "_ahead_from", "_count", "_frame_hz", "_hz", "_lag_s", "decays", "fractions", "times_s")

    def __init__(self, hz: float, frame_hz: float, lag_s: float) -> None:
        self._hz, self._frame_hz, self._lag_s = hz, frame_hz, lag_s
        ratio = hz / frame_hz
        self._count = round(ratio) if abs(ratio - round(ratio)) < _SAME_RATIO * ratio else 0
        self._ahead: list[Instants] = []
        self._ahead_from = 0
        self.times_s: list[float] = []
        self.fractions: list[float] = []
        self.decays: list[float] = []

    def enter(self, frame: int) -> None:
        """Go on to a frame; frame 0 is the single instant of boot."""
        at = frame - self._ahead_from
        if not 0 <= at < len(self._ahead):
            self._look_ahead(frame)
            at = 0
        self.times_s, self.fractions, self.decays = self._ahead[at]

    def _look_ahead(self, frame: int) -> None:
        self._ahead_from = frame
        if frame == 0:
            self._ahead = [_BOOT]
            return
        frames = np.arange(frame - 1, frame + _BLOCK_FRAMES)
        lasts = np.floor(frames * (self._hz / self._frame_hz) + _SAME_RATIO).astype(np.int64)
        times_s = np.arange(lasts[0] + 1, lasts[-1] + 1) / self._hz
        self._ahead = self._even(times_s) if self._count else self._uneven(times_s, lasts - lasts[0], frame)

    def _even(self, times_s: NDArray[np.float64]) -> list[Instants]:
        """The same number of instants in every frame, always at the same fractions of it."""
        fractions = [(j + 1) / self._count for j in range(self._count)]
        decays = self._decays(fractions)
        return [(row, fractions, decays) for row in times_s.reshape(-1, self._count).tolist()]

    def _uneven(self, times_s: NDArray[np.float64], starts: NDArray[np.int64], frame: int) -> list[Instants]:
        found: list[Instants] = []
        times = times_s.tolist()
        for before, (start, end) in enumerate(pairwise(starts.tolist()), frame - 1):
            if start == end:
                found.append(_NONE)
                continue
            row = times[start:end]
            fractions = [t * self._frame_hz - before for t in row]
            found.append((row, fractions, self._decays(fractions)))
        return found

    def _decays(self, fractions: Sequence[float]) -> list[float]:
        return [exp(-f / (self._frame_hz * self._lag_s)) for f in fractions]


WheelTuple = tuple[float, float, float]

_PER_UNIT = 1e7  # resolution of rates in rad/s: far below every noise, short on the wire
_BLOCK = 4096  # more than two wheels read in a frame


class RateEncoders:
    """Wheel rates with white noise, right and left independent."""

    __slots__ = ("_next", "_noise", "_rng", "_sigma", "_still")

    def __init__(self, sigma_rad_s: float, rng: np.random.Generator) -> None:
        self._rng = rng
        self._sigma = sigma_rad_s * _PER_UNIT
        self._noise: list[float] = []
        self._still: list[float] = []  # what a wheel at rest reads with that noise
        self._next = 0

    def read(self, plant: Plant, times: SampleTimes) -> list[WheelTuple]:
        """(t, right, left) wheel rates of the frame."""
        times_s = times.times_s
        count = len(times_s)
        if self._next + 2 * count > len(self._noise):
            self._draw()
        start = self._next
        middle, self._next = start + count, start + 2 * count
        if plant.are_wheels_still:
            return list(zip(times_s, self._still[start:middle], self._still[middle : self._next], strict=True))
        right_noise, left_noise = self._noise[start:middle], self._noise[middle : self._next]
        right, right_lag, left, left_lag = plant.servo
        unit, whole = _PER_UNIT, WHOLE
        right, right_lag, left, left_lag = right * unit, right_lag * unit, left * unit, left_lag * unit
        found: list[WheelTuple] = []
        for t, e, a, b in zip(times_s, times.decays, right_noise, left_noise):  # noqa: B905 - of one length; bare it compiles to a plain loop
            found.append(
                (
                    t,
                    (right + right_lag * e + a + whole - whole) / unit,
                    (left + left_lag * e + b + whole - whole) / unit,
                )
            )
        return found

    def _draw(self) -> None:
        fresh = self._sigma * self._rng.standard_normal(_BLOCK)
        self._noise = self._noise[self._next :] + fresh.tolist()
        self._still = self._still[self._next :] + (np.floor(fresh + 0.5) / _PER_UNIT).tolist()
        self._next = 0


class CountingEncoders:
    """Rates that are differences of counted angles."""

    __slots__ = ("_counts", "_frame_s", "_left_phase", "_per_rad", "_right_phase", "_unit")

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
        # The angle at tau is angle_0 + set tau + lag T (1 - exp(-tau/T)); all in counts, half a one less, so that
        # rounding finds the whole counts below.
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


ImuTuple = tuple[float, float, float]


class InertialUnit:
    """Reads ``ax + bias(t) + noise`` and ``wz (1 + scale) + bias(t) + noise``.

    What is added does not depend on the motion, so it is made ahead in blocks.
    """

    __slots__ = ("_ax_bias", "_next_errors", "_noise", "_scale", "_sigmas", "_wz_bias")

    def __init__(
        self, world: WorldConfig, hz: float, noise_rng: np.random.Generator, bias_rng: np.random.Generator
    ) -> None:
        """Draw scale and biases: three draws, whatever is switched off.

        Args:
            world: their standard deviations and walks, and the white noise.
            hz: rate of the samples.
            noise_rng: generator of the white noise.
            bias_rng: parent of the generators of scale and biases.
        """
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
        """(t, ax, wz) of the frame."""
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


GravityTuple = tuple[float, float, float, float]


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
        *,
        panels: PanelsConfig,
        lag_s: float,
    ) -> None:
        """Set up the streams.

        Args:
            mirror: the panels and the direction of gravity.
            cfg: rates and gravity noise.
            world: errors of inertial unit, encoders and panel edges.
            edge_sensors_m: places of the edge sensors, robot frame, shape (4, 2).
            rng: parent of the sensors' generators.
            panels: pitches of the panels.
            lag_s: true time constant of the wheel servos.
        """
        imu, encoders, gravity = rng.spawn(3)
        biases, counts, panel_edges = rng.spawn(3)
        self._mirror = mirror
        self._gravity_noise = NoiseStream(gravity).one
        self._gravity_on_deck = mirror.rotate_deck_from_world((0.0, 0.0, 1.0))  # the telescope points to the zenith
        self._gravity_pose: DeckPose | None = None
        self._gravity = (0.0, 0.0, 0.0)
        self._gravity_sigma = cfg.gravity_sigma_rad
        frame_hz = cfg.frame_hz
        kept = {
            hz: SampleTimes(hz, frame_hz, lag_s) for hz in (cfg.imu_hz, cfg.encoder_hz, cfg.edge_hz, cfg.gravity_hz)
        }
        self._times = tuple(kept.values())  # sensors of the same rate are read at the same instants
        self._imu_times, self._encoder_times = kept[cfg.imu_hz], kept[cfg.encoder_hz]
        self._edge_times, self._gravity_times = kept[cfg.edge_hz], kept[cfg.gravity_hz]
        self._imu = InertialUnit(world, cfg.imu_hz, imu, biases)
        self._encoders: CountingEncoders | RateEncoders
        if world.encoder_counts_per_rev:
            self._encoders = CountingEncoders(world, cfg.encoder_hz, 1.0 / frame_hz, counts)
        else:
            self._encoders = RateEncoders(world.encoder_sigma_rad_s, encoders)
        shifted = None
        if world.panel_edge_sigma_m:
            shifted = PanelEdges(mirror, panels, world.panel_edge_sigma_m, panel_edges)
        self.edges = EdgeSensors(mirror, edge_sensors_m, shifted)

    def enter(self, frame: int) -> None:
        """Go on to the instants of a frame (counted from 1; frame 0 is the instant of boot)."""
        for times in self._times:
            times.enter(frame)

    def read_imu(self, plant: Plant) -> list[ImuTuple]:
        """(t, ax, wz) of the frame: acceleration of the forward speed and angular rate about the normal."""
        return self._imu.read(plant, self._imu_times)

    def read_encoders(self, plant: Plant) -> list[WheelTuple]:
        """(t, right, left) wheel rates of the frame."""
        return self._encoders.read(plant, self._encoder_times)

    def read_edges(self, plant: Plant) -> list[EdgeTuple]:
        """(t, front left, front right, rear left, rear right) of the frame."""
        return self.edges.read(plant, self._edge_times.times_s, self._edge_times.fractions)

    def read_gravity(self, plant: Plant) -> GravityTuple | None:
        """(t, gx, gy, gz) where the sensor was read within the frame: the newest reading."""
        times = self._gravity_times.times_s
        if not times:
            return None
        pose = plant.pose
        if pose != self._gravity_pose:
            self._gravity_pose, self._gravity = pose, self._gravity_at(pose)
        sigma, noise, unit, whole = self._gravity_sigma, self._gravity_noise, _PER_UNIT, WHOLE
        x, y, z = self._gravity
        x, y, z = x + sigma * noise(), y + sigma * noise(), z + sigma * noise()
        scale = unit / hypot(x, y, z)
        return (
            times[-1],
            (x * scale + whole - whole) / unit,
            (y * scale + whole - whole) / unit,
            (z * scale + whole - whole) / unit,
        )

    def _gravity_at(self, pose: DeckPose) -> Vector3:
        gx, gy, gz = self._gravity_on_deck
        (hx, hy, hz), (lx, ly, lz), (nx, ny, nz) = self._mirror.robot_axes(pose)
        return hx * gx + hy * gy + hz * gz, lx * gx + ly * gy + lz * gz, nx * gx + ny * gy + nz * gz


_Row = TypeVar("_Row", ImuSample, WheelSample, EdgeSample)


class RobotFrame(msgspec.Struct, frozen=True, gc=False):
    """A frame as it was read: the fields of ``Sensors``, in the same places, with samples as plain tuples.

    Making named tuples of twenty samples takes as long as reading them, so it waits until names are needed.
    """

    seq: int
    t: float
    imu: list[ImuTuple]
    enc: list[WheelTuple]
    edge: list[EdgeTuple]
    gravity: GravityTuple | None
    fans: tuple[float, float]
    soc: float
    cmd: CommandEcho
    faults: tuple[str, ...]


def as_line(frame: RobotFrame) -> bytes:
    """The frame as a line with its LF."""
    seq, t_s, imu, encoders, edges, gravity, fans, soc, cmd, faults = msgspec.structs.astuple(frame)
    return encode_sensors(seq, t_s, imu, encoders, edges, gravity, fans, soc, msgspec.structs.astuple(cmd), faults)


def as_message(frame: RobotFrame) -> Sensors:
    """The message that a client decodes from the frame's line."""
    gravity = frame.gravity
    return Sensors(
        frame.seq,
        frame.t,
        named(ImuSample, frame.imu),
        named(WheelSample, frame.enc),
        named(EdgeSample, frame.edge),
        None if gravity is None else GravitySample(*gravity),
        frame.fans,
        frame.soc,
        frame.cmd,
        list(frame.faults),
    )


def named(kind: type[_Row], rows: Iterable[tuple[object, ...]]) -> list[_Row]:
    """The rows as named tuples; five times as fast as calling the class for each."""
    return list(map(tuple.__new__, repeat(kind), rows))
