"""The simulated robot among beacons: its vehicle, what it receives, its true state. Time is an argument.

Choices the interface leaves open:

* The boot is frame 0 at t = 0, with no reading; a frame ends each step of the world.
* The robot scans by itself, every so many frames.
* The wheels obey at once; the link has no delay; there are no fans; the battery stays full.
* A steering angle turns the robot like wheels of unequal speed, so it needs the permit ``turn``; the echo is that of
  the wheels.
"""

from math import isfinite
from typing import Protocol

import msgspec
import numpy as np

from ccatp.config.beacon_models import RadioConfig
from ccatp.links.beacon_messages import BeaconFrame, MoteBurst, RadioSample, RadioScan, SteerSample, with_extras
from ccatp.links.robot_codec import encode_sensors
from ccatp.links.robot_messages import RobotData, VehicleData
from ccatp.links.topics import BeaconPlaces, BeaconTruth
from ccatp.sim.motes import MoteListener, TrueMotes, true_motes
from ccatp.sim.radio import Packet, SimDriveCommand, TargetBearing, TruePose, WorldFrame
from ccatp.sim.radio_world import RadioWorld
from ccatp.sim.rules import SimulatedRobot

_CORNER = (0.0, 0.0)  # a robot without edge sensors has them where it is


class Surroundings(Protocol):
    """The true world round the robot; ``ccatp.sim.radio_world.RadioWorld`` is one."""

    @property
    def pose(self) -> TruePose:
        """Where the vehicle is."""

    @property
    def target_m(self) -> tuple[float, float] | None:
        """Where the moving radio is; None without one."""

    @property
    def beacons_m(self) -> dict[str, tuple[float, float]]:
        """Where the static radios are."""

    @property
    def clearance_m(self) -> float:
        """Between the vehicle's body and the nearest obstacle."""

    def step(self, command: SimDriveCommand, interval_s: float, *, static: bool, target: bool) -> WorldFrame:
        """Drive on, then listen."""


class MoteReceiver(Protocol):
    """The receiver of the motes' pulses."""

    def receive(self, time_s: float, pose: TruePose) -> list[MoteBurst]:
        """Pulses received since the last frame."""


class BeaconRobot(SimulatedRobot):
    """The robot from its boot on; the fans have no effect."""

    def __init__(self, cfg: RadioConfig, world: Surroundings, motes: MoteReceiver | None = None) -> None:
        self._cfg, self.world, self._motes = cfg, world, motes
        limits = cfg.sim.robot.ttl_s, cfg.robot.max_wheel_rad_s, 0.0
        super().__init__(limits, cfg.run.step_s, 1.0 / cfg.run.step_s)
        self._steer_rad = 0.0
        self._line = b""
        self._read(None)

    def describe(self) -> RobotData:
        """See ``SimulatedRobot``."""
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
        """Time of the next frame."""
        return (self.seq + 1) * self.frame_s

    @property
    def delivered_seq(self) -> int:
        """Number of the newest frame."""
        return self.seq

    @property
    def delivered_line(self) -> bytes:
        """The newest frame as a line with its LF."""
        return self._line

    def drive(
        self,
        seq: int,
        right_rad_s: float,
        left_rad_s: float,
        now_s: float | None = None,
        steer_rad: float | None = None,
    ) -> bool:
        """Take a drive; a steering angle other than zero makes a turn of it."""
        steer = 0.0 if steer_rad is None or self._cfg.vehicle.kind != "ackermann" else steer_rad
        if not isfinite(steer):
            return False
        at_s = self.t_s if now_s is None else now_s
        if not self.rules.drive(seq, right_rad_s, left_rad_s, at_s, is_steered=steer != 0.0):
            return False
        self._steer_rad = steer
        return True

    def advance(self) -> None:
        """Drive one frame and listen."""
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
        if vehicle.kind == "ackermann":
            return SimDriveCommand(speed_m_s, self._steer_rad, 0.0)
        return SimDriveCommand(speed_m_s, 0.0, radius_m * (right_rad_s - left_rad_s) / vehicle.track_m)

    def _read(self, frame: WorldFrame | None) -> None:
        t_s = self.t_s
        seq, age_s, permit_age_s, is_held = self.rules.echo(t_s)
        cmd = seq, round(age_s, 6), round(permit_age_s, 6), is_held
        wheels: list[tuple[float, float, float]] = []
        extras = BeaconFrame()
        if frame is not None:
            radius_m, vehicle = self._cfg.robot.wheel_radius_m, self._cfg.vehicle
            half_m_s = 0.5 * vehicle.track_m * frame.wheels.turn_rate_rad_s
            speed_m_s = frame.wheels.speed_m_s
            wheels = [(t_s, (speed_m_s + half_m_s) / radius_m, (speed_m_s - half_m_s) / radius_m)]
            extras = self._extras(frame)
        line = encode_sensors(self.seq, t_s, (), wheels, (), None, (0.0, 0.0), 1.0, cmd, ())
        self._line = with_extras(line, extras)

    def _extras(self, frame: WorldFrame) -> BeaconFrame:
        t_s = self.t_s
        is_steered = self._cfg.vehicle.kind == "ackermann"
        return BeaconFrame(
            steer=[SteerSample(t_s, frame.wheels.steer_rad)] if is_steered else [],
            radio=[_sample(t_s, sighting) for sighting in frame.sightings],
            scan=_scan(t_s, frame.packets, self._cfg.scan.readings),
            distances=list(frame.distances_m),
            motes=[] if self._motes is None else self._motes.receive(t_s, self.world.pose),
        )


def _sample(t_s: float, sighting: TargetBearing) -> RadioSample:
    return RadioSample(t_s, sighting.beacon, sighting.rssi_dbm, sighting.bearing_rad)


def _scan(t_s: float, packets: tuple[Packet, ...], readings: int) -> RadioScan | None:
    if not packets:
        return None
    step_rad = 6.283185307179586 / readings
    levels: dict[str, list[float | None]] = {}
    for packet in packets:
        row = levels.setdefault(packet.beacon, [None] * readings)
        row[round(packet.direction_rad / step_rad) % readings] = packet.rssi_dbm
    return RadioScan(t_s, step_rad, levels)


BATCH_ROWS = 50


class BeaconTruthLog:
    """Collects a row per frame.

    Requests, answered as JSON: ``b"flush"``: ``{"rows": n}``, the number of rows taken so far (the caller takes the
    pending ones first); anything else: ``{"error"}``.
    """

    def __init__(self, robot: BeaconRobot, motes_m: dict[str, tuple[float, float]]) -> None:
        self._robot, self._motes_m = robot, motes_m
        self._rows: list[tuple[int, float, float, float, float, float | None, float | None, float | None]] = []
        self._taken = 0
        self.add()

    def add(self) -> bool:
        """Add the row of the newest frame; true when the batch should be taken."""
        robot = self._robot
        world = robot.world
        target = world.target_m or (None, None)
        clearance_m = world.clearance_m
        is_bounded = clearance_m < float("inf")
        self._rows.append((robot.seq, robot.t_s, *world.pose, *target, clearance_m if is_bounded else None))
        return len(self._rows) >= BATCH_ROWS

    def batch(self) -> tuple[str, BeaconTruth] | None:
        """The pending rows as a topic and its message, or ``None`` without any."""
        rows, self._rows = self._rows, []
        self._taken += len(rows)
        return ("beacon_truth", BeaconTruth(seq=self._robot.seq, t_s=self._robot.t_s, rows=rows)) if rows else None

    def preface(self) -> tuple[str, BeaconPlaces]:
        """Where radios and motes are."""
        places = {**self._robot.world.beacons_m, **self._motes_m}
        return "beacon_places", BeaconPlaces(seq=self._robot.seq, t_s=self._robot.t_s, places=places)

    def answer(self, request: bytes) -> bytes:
        """The reply to a request."""
        known = {"rows": self._taken} if request == b"flush" else {"error": "unknown request; known is flush"}
        return msgspec.json.encode(known)


# Streams of random numbers of a seed, apart from those of the world.
_LAYOUT, _RECEIVER = 20, 21


def build_beacon_robot(cfg: RadioConfig) -> BeaconRobot:
    """The robot of a configuration, just booted."""
    world = RadioWorld(cfg)
    if cfg.system != "cricket":
        return BeaconRobot(cfg, world)
    rng = np.random.default_rng([cfg.run.seed, _RECEIVER])
    return BeaconRobot(cfg, world, MoteListener(cfg.cricket, cfg.listener, _motes(cfg), rng))


def motes_of(cfg: RadioConfig) -> dict[str, tuple[float, float]]:
    """Where the motes are, by name."""
    if cfg.system != "cricket":
        return {}
    motes = _motes(cfg)
    places = motes.positions_m.tolist()
    return {name: (place[0], place[1]) for name, place in zip(motes.names, places, strict=True)}


def _motes(cfg: RadioConfig) -> TrueMotes:
    return true_motes(cfg.cricket, np.random.default_rng([cfg.run.seed, _LAYOUT]))
