"""Pure. The robot: its rules, its fans, its world and its sensors, one frame after the other. Time is an argument.

Choices the interface leaves open:

* The boot is frame 0 at t = 0, with one sample of each sensor.
* A set point holds for a whole frame, so a key must last to the end of the frame for the frame to be driven.
* A drive over ``max_wheel_rad_s`` is slowed down as a whole; its path stays the same. Numbers not finite are dropped.
* Without a drive in force the echo has seq -1; ages count from the last drive or permit, at most from the boot.
* The battery stays full, ``faults`` stays empty.
"""

from math import ceil

import numpy as np

from ccatp.config.models import Config
from ccatp.mirror.mirror import Mirror
from ccatp.sim.rules import Fans, MotionRules
from ccatp.sim.sensors import SensorSuite
from ccatp.sim.world import World
from ccatp.wire.lines import MAX_LINE_BYTES
from ccatp.wire.robot import PROTOCOL, Hello, RobotData, encode_sensors

# Worst case of a frame's line: fixed part, and bytes per sample of each list.
_FRAME_BYTES, _IMU_BYTES, _ENCODER_BYTES, _EDGE_BYTES = 420, 48, 44, 26


class Robot:
    """The robot from one boot to the next.

    Attributes:
        rules, fans: what it enforces, and its fan duties.
        world: the truth.
        seq, t_s, line: newest frame, its time on the robot's clock, its line with LF.
        frame_s: period of the frames.
    """

    def __init__(self, cfg: Config, mirror: Mirror, rng: np.random.Generator) -> None:
        """Boot.

        Args:
            cfg: robot, world, sim and etalon sections.
            mirror: the mirror it stands on.
            rng: parent of every random draw.

        Raises:
            ValueError: the rates put more samples in a frame than a line may hold, or a frame outlasts the TTL.
        """
        sim = cfg.sim.robot
        _check_rates(cfg)
        world_rng, sensors_rng = rng.spawn(2)
        self.frame_s = 1.0 / sim.frame_hz
        self._frame_hz = sim.frame_hz
        self._cfg = cfg
        self._floor = sim.fan_floor if mirror.overhang else 0.0
        self.rules = MotionRules(sim.ttl_s, cfg.robot.max_wheel_rad_s)
        self.fans = Fans(self._floor)
        self.world = World(cfg, mirror, world_rng, max(1, round(cfg.etalon.measuring_time_s * sim.frame_hz)))
        self._sensors = SensorSuite(mirror, sim, cfg.world, cfg.robot.edge_sensors_m, sensors_rng)
        self._sensors.edges.place(self.world.plant)
        self.world.look_at_rim(self._sensors.edges.places)
        self.seq, self.t_s = 0, 0.0
        self.line = b""
        self._read()

    def hello(self, *, boot: int, nonce: str, auth: str, lockstep: bool) -> Hello:
        """The first message on a connection."""
        robot = self._cfg.robot
        data = RobotData(
            wheel_radius_m=robot.wheel_radius_m,
            wheel_base_m=robot.wheel_base_m,
            edge_sensors_m=robot.edge_sensors_m,
            puck_m=(0.0, 0.0, robot.puck_height_m),
            max_wheel_rad_s=robot.max_wheel_rad_s,
            fan_floor=self._floor,
        )
        return Hello(
            protocol=PROTOCOL,
            boot=boot,
            nonce=nonce,
            auth="hmac-sha256" if auth == "hmac-sha256" else "none",
            lockstep=lockstep,
            frame_hz=self._frame_hz,
            ttl_s=self._cfg.sim.robot.ttl_s,
            robot=data,
        )

    @property
    def next_t_s(self) -> float:
        """Time of the next frame."""
        return (self.seq + 1) / self._frame_hz

    def advance(self) -> None:
        """Drive one frame and read the sensors into ``line``."""
        t_s = self.next_t_s
        right, left = self.rules.set_points(t_s)
        self.world.step(self.t_s, self.frame_s, right, left, self.fans.thrust)
        self.seq, self.t_s = self.seq + 1, t_s
        self._read()

    def _read(self) -> None:
        seq, t_s, sensors, world = self.seq, self.t_s, self._sensors, self.world
        plant = world.plant
        sensors.enter(seq)
        edges = sensors.read_edges(plant)
        world.look_at_rim(sensors.edges.places)
        drive_seq, age_s, permit_age_s, is_held = self.rules.echo(t_s)
        self.line = encode_sensors(
            seq,
            t_s,
            sensors.read_imu(plant),
            sensors.read_encoders(plant),
            edges,
            sensors.read_gravity(plant),
            self.fans.duty,
            1.0,
            (drive_seq, _to_microseconds(age_s), _to_microseconds(permit_age_s), is_held or world.is_fallen),
            (),
        )


def _to_microseconds(t_s: float) -> float:
    return round(t_s * 1e6) / 1e6


def _check_rates(cfg: Config) -> None:
    sim = cfg.sim.robot
    if sim.frame_hz * sim.ttl_s < 1.0:
        raise ValueError(
            f"sim.robot: a frame of {1.0 / sim.frame_hz:g} s outlasts ttl_s {sim.ttl_s:g}, it would never move: "
            "raise frame_hz or ttl_s"
        )
    line_bytes = _FRAME_BYTES
    for hz, sample_bytes in ((sim.imu_hz, _IMU_BYTES), (sim.encoder_hz, _ENCODER_BYTES), (sim.edge_hz, _EDGE_BYTES)):
        line_bytes += ceil(hz / sim.frame_hz) * sample_bytes
    if line_bytes > MAX_LINE_BYTES:
        raise ValueError(
            f"sim.robot: frames at {sim.frame_hz:g} Hz take up to {line_bytes} bytes, a line holds {MAX_LINE_BYTES}: "
            "raise frame_hz or lower the sensors' rates"
        )
