"""The simulated survey robot: world and sensors, one frame after the other, and the log of its true state.

Choices the interface leaves open:

* The boot is frame 0 at t = 0, with one sample of each sensor.
* A set point holds for a whole frame, so drive and permit must last to the end of the frame for it to be driven.
* A drive over ``max_wheel_rad_s`` is slowed down as a whole; its path stays the same. Numbers not finite are dropped.
* Without a drive in force the echo has seq -1; ages count from the arrival of what came into force last, at most from
  the boot.
* The link's delays are whole frames. The frame read at t is delivered when the clock shows t + the sensors' delay,
  the truth is that of the clock. Commands wait in ``ccatp.sim.rules.CommandDelay``.
* The battery stays full, ``faults`` stays empty, nothing fails without a fault plan (``ccatp.sim.fault_injector``).
* A reboot by plan takes no time. On the link, clock and frames count from it; ``seq`` and ``t_s`` here, the truth and
  the times of the plan go on.
"""

from collections import deque
from math import ceil

import msgspec
import numpy as np

from ccatp.config.models import Config
from ccatp.core import DeckPose
from ccatp.links.robot_messages import MAX_LINE_BYTES, CommandEcho, RobotData, Sensors
from ccatp.links.topics import Misalignment, TruthMessage
from ccatp.mirror.mirror import Mirror
from ccatp.sim.fault_injector import Injector
from ccatp.sim.fault_plan import FaultPlan
from ccatp.sim.rules import SimulatedRobot
from ccatp.sim.sensors import RobotFrame, SensorSuite, as_line, as_message
from ccatp.sim.world import TruthRow, World

# Worst case of a frame's line: fixed part, and bytes per sample of each list. Counted rates have all their digits.
_FRAME_BYTES, _IMU_BYTES, _ENCODER_BYTES, _COUNTER_BYTES, _EDGE_BYTES = 420, 48, 44, 64, 26


class Robot(SimulatedRobot):
    """The robot from one boot to the next."""

    def __init__(
        self,
        cfg: Config,
        mirror: Mirror,
        rng: np.random.Generator,
        faults: FaultPlan | None = None,
        start: DeckPose | None = None,
    ) -> None:
        """Boot.

        Args:
            cfg: robot, world, sim and etalon sections.
            mirror: the mirror it stands on.
            rng: parent of every random draw.
            faults: what shall go wrong.
            start: where it stands, if not at base.

        Raises:
            ValueError: the rates put more samples in a frame than a line may hold, or a frame outlasts the TTL.
        """
        sim = cfg.sim.robot
        _check_rates(cfg)
        world_rng, sensors_rng = rng.spawn(2)
        self._cfg = cfg
        self._floor = sim.fan_floor if mirror.overhang else 0.0
        self.sensors_delay_frames = round(cfg.world.sensors_delay_s * sim.frame_hz)
        super().__init__(
            (sim.ttl_s, cfg.robot.max_wheel_rad_s, self._floor),
            1.0 / sim.frame_hz,
            sim.frame_hz,
            round(cfg.world.commands_delay_s * sim.frame_hz),
        )
        self.injector = None if faults is None else Injector(faults, mirror, rng.spawn(1)[0])
        window_frames = max(1, round(cfg.etalon.measuring_time_s * sim.frame_hz))
        pushes = () if self.injector is None else self.injector.body.drifts
        self.world = World(cfg, mirror, world_rng, window_frames, pushes, start)
        self._sensors = SensorSuite(
            mirror,
            sim,
            cfg.world,
            cfg.robot.edge_sensors_m,
            sensors_rng,
            panels=cfg.mirror.panels,
            lag_s=self.world.wheels.lag_s,
        )
        self._sensors.edges.place(self.world.plant)
        self.world.watch(self._sensors.edges)
        # The newest frame last; the first is delivered once the deque is full.
        self._frames: deque[RobotFrame] = deque(maxlen=self.sensors_delay_frames + 1)
        self._delivered: Sensors | None = None
        self._line = b""
        self._read()

    def describe(self) -> RobotData:
        """See ``SimulatedRobot``."""
        robot = self._cfg.robot
        return RobotData(
            wheel_radius_m=robot.wheel_radius_m,
            wheel_base_m=robot.wheel_base_m,
            edge_sensors_m=robot.edge_sensors_m,
            puck_m=(0.0, 0.0, robot.puck_height_m),
            max_wheel_rad_s=robot.max_wheel_rad_s,
            fan_floor=self._floor,
        )

    @property
    def next_t_s(self) -> float:
        """Time of the next frame."""
        return (self.seq + 1) / self._frame_hz

    # -- frames ---------------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Drive one frame and read the sensors."""
        before_s = self.t_s
        if self.injector is not None and self.injector.is_rebooting(before_s):
            self._reboot(self.injector)
        self.seq += 1
        self.t_s = t_s = self.seq / self._frame_hz
        self._commands.release(self.seq - 1)
        right, left = self.rules.set_points(t_s)
        if self.injector is not None and not self.world.is_fallen:
            right, left = self._act(self.injector, before_s, (right, left))
        self.world.step(before_s, self.frame_s, right, left, self.fans.thrust)
        self._read()

    def _act(self, injector: Injector, t_s: float, set_points_rad_s: tuple[float, float]) -> tuple[float, float]:
        plant = self.world.plant
        before = plant.pose
        found = injector.body.act(self.world, self.fans, t_s, set_points_rad_s)
        if plant.pose != before:
            self._sensors.edges.place(plant)  # they do not see the way of a body that was put elsewhere
        return found

    def _reboot(self, injector: Injector) -> None:
        """No command of the boot before stays; the fans go to their floor."""
        health = self.fans.health
        self.reboots += 1
        self._boot(self.t_s)
        self.fans.health = health
        self._frames.clear()
        injector.reboot(self.seq, self.t_s)

    @property
    def delivered_seq(self) -> int:
        """Number of the frame that reached the clients at this instant; -1 while none has, or a fault took it."""
        if self.injector is not None:
            message = self.injector.outgoing.message
            return -1 if message is None else message.seq
        frame = self.delivered_rows
        return -1 if frame is None else frame.seq

    @property
    def delivered(self) -> Sensors | None:
        """The frame that reached the clients at this instant, ``None`` while none has.

        Equal in every number to decoding ``delivered_line``. Made at the first use and then shared: do not change
        it.
        """
        if self.injector is not None:
            return self.injector.outgoing.message
        if self._delivered is None:
            frame = self.delivered_rows
            self._delivered = None if frame is None else as_message(frame)
        return self._delivered

    @property
    def delivered_rows(self) -> RobotFrame | None:
        """The same with plain tuples for samples, at no cost, before the faults of its delivery; leave it as it is."""
        frames = self._frames
        return frames[0] if len(frames) > self.sensors_delay_frames else None

    @property
    def delivered_line(self) -> bytes:
        """The same frame as a line with its LF; empty while none has reached the clients.

        With faults it is whatever leaves the robot at this instant: nothing, a line that none may take, several lines.
        """
        if self.injector is not None:
            return self.injector.outgoing.line
        if not self._line:
            frame = self.delivered_rows
            self._line = b"" if frame is None else as_line(frame)
        return self._line

    def _read(self) -> None:
        seq, t_s, sensors, plant = self.seq, self.t_s, self._sensors, self.world.plant
        sensors.enter(seq)
        edges, imu, encoders = sensors.read_edges(plant), sensors.read_imu(plant), sensors.read_encoders(plant)
        gravity = sensors.read_gravity(plant)
        drive_seq, age_s, permit_age_s, is_held = self.rules.echo(t_s)
        is_held = is_held or self.world.is_fallen
        cmd = CommandEcho(drive_seq, round(age_s * 1e6) / 1e6, round(permit_age_s * 1e6) / 1e6, is_held)
        frame = RobotFrame(seq, t_s, imu, encoders, edges, gravity, self.fans.duty, 1.0, cmd, ())
        injector = self.injector
        self._frames.append(frame if injector is None else injector.sense(frame))
        self._delivered, self._line = None, b""
        if injector is not None:
            injector.deliver(t_s, self.delivered_rows)


def _check_rates(cfg: Config) -> None:
    sim = cfg.sim.robot
    if sim.frame_hz * sim.ttl_s < 1.0:
        raise ValueError(
            f"sim.robot: a frame of {1.0 / sim.frame_hz:g} s outlasts ttl_s {sim.ttl_s:g}, it would never move: "
            "raise frame_hz or ttl_s"
        )
    line_bytes = _FRAME_BYTES
    encoder_bytes = _COUNTER_BYTES if cfg.world.encoder_counts_per_rev else _ENCODER_BYTES
    for hz, sample_bytes in ((sim.imu_hz, _IMU_BYTES), (sim.encoder_hz, encoder_bytes), (sim.edge_hz, _EDGE_BYTES)):
        line_bytes += ceil(hz / sim.frame_hz) * sample_bytes
    if line_bytes > MAX_LINE_BYTES:
        raise ValueError(
            f"sim.robot: frames at {sim.frame_hz:g} Hz take up to {line_bytes} bytes, a line holds {MAX_LINE_BYTES}: "
            "raise frame_hz or lower the sensors' rates"
        )


BATCH_ROWS = 100


class TruthLog:
    """Collects a row per frame.

    Requests, answered as JSON (SI; puck in the world frame, start pose in the deck frame):

    * ``b"puck"``: ``{"t", "puck": [x, y, z], "moved_m"}``, ``moved_m`` the furthest within the last measuring time;
    * ``b"misalignment"``: ``{"panels": [[row, col, piston_m, tip_rad, tilt_rad], ...], "start": [x, y, heading]}``;
    * ``b"flush"``: ``{"rows": n}``, the number of rows taken so far (the caller takes the pending ones first);
    * anything else: ``{"error"}``.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._rows: list[TruthRow] = []
        self._taken = 0
        self._is_fallen = False
        self.add()

    def add(self) -> bool:
        """Add the row of the newest frame; true when the batch should be taken: it is full, or the robot fell."""
        robot = self._robot
        world = robot.world
        self._rows.append(world.truth_row(robot.seq, robot.t_s))
        has_changed = world.is_fallen is not self._is_fallen
        self._is_fallen = world.is_fallen
        return has_changed or len(self._rows) >= BATCH_ROWS

    def take(self) -> TruthMessage | None:
        """The pending rows as a message of the topic table, or ``None`` without any."""
        rows, self._rows = self._rows, []
        self._taken += len(rows)
        return TruthMessage(seq=self._robot.seq, t_s=self._robot.t_s, rows=rows) if rows else None

    def batch(self) -> tuple[str, TruthMessage] | None:
        """The same with its topic."""
        rows = self.take()
        return None if rows is None else ("truth", rows)

    def preface(self) -> tuple[str, Misalignment]:
        """How the panels lie, with its topic."""
        return "misalignment", self.misalignment()

    def misalignment(self) -> Misalignment:
        """How the panels lie, as a message of the topic table."""
        return Misalignment(seq=self._robot.seq, t_s=self._robot.t_s, panels=self._panels())

    def _panels(self) -> list[tuple[int, int, float, float, float]]:
        found = self._robot.world.misalignments.items()
        return [(*panel, m.piston_m, m.tip_rad, m.tilt_rad) for panel, m in found]

    def answer(self, request: bytes) -> bytes:
        """The reply to a request."""
        world = self._robot.world
        reply: dict[str, object]
        if request == b"puck":
            reply = {"t": self._robot.t_s, "puck": world.puck_world(), "moved_m": world.moved_m()}
        elif request == b"flush":
            reply = {"rows": self._taken}
        elif request == b"misalignment":
            start = world.start_pose
            reply = {"panels": self._panels(), "start": (start.x_m, start.y_m, start.heading_rad)}
        else:
            reply = {"error": "unknown request; known are puck, misalignment, flush"}
        return msgspec.json.encode(reply)
