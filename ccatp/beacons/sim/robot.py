"""The simulated robot among beacons: its vehicle, its receivers, its true state. Time is an argument.

Choices the interface leaves open:

* The boot is frame 0 at t = 0, with no reading; each step of the world gives one frame.
* The robot scans by itself, each time after a number of frames (``observation``).
* The wheels have no lag; the link has no delay; there are no fans; the battery stays full.
* A steering angle turns the robot like unequal wheel speeds, so it needs the permit ``turn``.
"""

from math import inf

import numpy as np
from msgspec.structs import replace

from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.links.messages import BeaconFrame, SteerSample, with_extras
from ccatp.beacons.links.topics import BeaconPlaces, BeaconTruth
from ccatp.beacons.sim.motes import MoteListener, TrueMotes, true_motes
from ccatp.beacons.sim.radio import SimDriveCommand, WorldFrame
from ccatp.beacons.sim.radio_world import RadioWorld
from ccatp.links.robot_codec import RobotFrame, encode
from ccatp.links.robot_messages import CommandEcho, RobotData, VehicleData
from ccatp.sim.simulated_robot import SimulatedRobot

_CORNER = (0.0, 0.0)  # reported place of the edge sensors, which it does not have
# Streams of random numbers of a seed, different from those of the world.
_LAYOUT, _RECEIVER = 20, 21

BeaconTruthRow = tuple[int, float, float, float, float, float | None, float | None, float | None]


class SimulatedBeaconRobot(SimulatedRobot):
    """A robot in the true world of beacons."""

    world: RadioWorld
    motes: TrueMotes | None
    seq: int
    t_s: float
    truth_rows = 50

    def truth_row(self) -> BeaconTruthRow:
        world = self.world
        target_x_m, target_y_m = world.target_m or (None, None)
        clearance_m = world.clearance_m if world.clearance_m < inf else None
        return self.seq, self.t_s, *world.pose, target_x_m, target_y_m, clearance_m

    def truth_message(self, rows: list[BeaconTruthRow]) -> tuple[str, BeaconTruth]:
        return "beacon_truth", BeaconTruth(seq=self.seq, t_s=self.t_s, rows=rows)

    def truth_preface(self) -> tuple[str, BeaconPlaces]:
        places = dict(self.world.beacons_m)
        if self.motes is not None:
            for name, place in zip(self.motes.names, self.motes.positions_m.tolist(), strict=True):
                places[name] = place[0], place[1]
        return "beacon_places", BeaconPlaces(seq=self.seq, t_s=self.t_s, places=places)


class BeaconRobot(SimulatedBeaconRobot):
    """The simulated robot; fan commands have no effect on its motion."""

    def __init__(self, cfg: RadioConfig, world: RadioWorld, motes: TrueMotes | None = None) -> None:
        self._cfg, self.world, self.motes = cfg, world, motes
        self._listener = None if motes is None else listener_of(cfg, motes)
        limits = cfg.sim.robot.ttl_s, cfg.robot.max_wheel_rad_s, 0.0
        super().__init__(limits, cfg.run.step_s, 1.0 / cfg.run.step_s)
        self.is_steerable = cfg.vehicle.kind == "ackermann"
        self._line = b""
        self._read(None)

    def describe(self) -> RobotData:
        cfg, vehicle = self._cfg, self._cfg.vehicle
        return RobotData(
            wheel_radius_m=cfg.robot.wheel_radius_m,
            wheel_base_m=vehicle.track_m,
            edge_sensors_m=(_CORNER, _CORNER, _CORNER, _CORNER),
            puck_m=(0.0, 0.0, 0.0),
            max_wheel_rad_s=cfg.robot.max_wheel_rad_s,
            fan_floor=0.0,
            vehicle=VehicleData(
                kind=vehicle.kind,
                axle_distance_m=vehicle.wheelbase_m,
                steer_max_rad=vehicle.steer_max_rad,
                distance_sensors_rad=list(cfg.avoidance.sensors_rad),
            ),
        )

    @property
    def next_t_s(self) -> float:
        return (self.seq + 1) * self.frame_s

    @property
    def delivered_line(self) -> bytes:
        return self._line

    def advance(self) -> None:
        self.seq += 1
        self.t_s = round(self.seq * self.frame_s, 9)
        right, left = self.rules.set_points(self.t_s)
        observation = self._cfg.observation
        frame = self.world.step(
            self._command(right, left),
            self.frame_s,
            static=self.seq % observation.every_steps == 0,
            target=self.seq % observation.target_every_steps == 0,
        )
        self._read(frame)

    def _command(self, right_rad_s: float, left_rad_s: float) -> SimDriveCommand:
        radius_m, vehicle = self._cfg.robot.wheel_radius_m, self._cfg.vehicle
        speed_m_s = 0.5 * radius_m * (right_rad_s + left_rad_s)
        if self.is_steerable:
            return SimDriveCommand(speed_m_s, self.rules.steer_rad, 0.0)
        return SimDriveCommand(speed_m_s, 0.0, radius_m * (right_rad_s - left_rad_s) / vehicle.track_m)

    def _read(self, frame: WorldFrame | None) -> None:
        t_s, self.delivered_seq = self.t_s, self.seq
        seq, age_s, permit_age_s, is_held = self.rules.echo(t_s)
        cmd = CommandEcho(seq, round(age_s, 6), round(permit_age_s, 6), is_held)
        wheels: list[tuple[float, float, float]] = []
        extras = BeaconFrame()
        if frame is not None:
            radius_m, vehicle = self._cfg.robot.wheel_radius_m, self._cfg.vehicle
            half_m_s = 0.5 * vehicle.track_m * frame.wheels.turn_rate_rad_s
            speed_m_s = frame.wheels.speed_m_s
            wheels = [(t_s, (speed_m_s + half_m_s) / radius_m, (speed_m_s - half_m_s) / radius_m)]
            steer = [SteerSample(t_s, frame.wheels.steer_rad)] if self.is_steerable else []
            motes = [] if self._listener is None else self._listener.receive(t_s, self.world.pose)
            extras = replace(frame.extras, steer=steer, motes=motes)
        line = RobotFrame(
            self.seq, t_s, imu=(), enc=wheels, edge=(), gravity=None, fans=self.fans.duty, soc=1.0, cmd=cmd, faults=()
        )
        self._line = with_extras(encode(line), extras)


def motes_of(cfg: RadioConfig) -> TrueMotes | None:
    """The motes of a configuration; None without."""
    return true_motes(cfg.cricket, np.random.default_rng([cfg.run.seed, _LAYOUT])) if cfg.system == "cricket" else None


def listener_of(cfg: RadioConfig, motes: TrueMotes) -> MoteListener:
    """What the listeners among the motes receive."""
    return MoteListener(cfg.cricket, cfg.listener, motes, np.random.default_rng([cfg.run.seed, _RECEIVER]))


def build_beacon_robot(cfg: RadioConfig) -> BeaconRobot:
    """The robot of a configuration, just booted."""
    return BeaconRobot(cfg, RadioWorld(cfg), motes_of(cfg))
