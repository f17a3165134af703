"""Pure. The robot's sensors: what they read of the plant, at their own rates and with the world's errors.

Samples are plain tuples in the order of the robot link, rounded as a real sensor bus would. Every sensor draws from a
stream of its own, so that its noise depends on the seed alone, not on the rates of the others.
"""

from collections.abc import Sequence
from math import hypot

import numpy as np

from ccatp.config.models import PanelsConfig, SimRobotConfig, WorldConfig
from ccatp.mirror.mirror import Mirror
from ccatp.samples import DeckPose, Vector3
from ccatp.sim.edge_sensors import EdgeSensors, EdgeTuple
from ccatp.sim.encoders import CountingEncoders, RateEncoders, WheelTuple
from ccatp.sim.inertial import ImuTuple, InertialUnit
from ccatp.sim.noise import WHOLE, NoiseStream
from ccatp.sim.panel_edges import PanelEdges
from ccatp.sim.plant import Plant
from ccatp.sim.sample_times import SampleTimes

GravityTuple = tuple[float, float, float, float]

_PER_UNIT = 1e7  # resolution of the direction of gravity: far below every noise, short on the wire


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
