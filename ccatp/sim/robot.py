"""The simulated survey robot: world and sensors, one frame after the other.

Choices the interface leaves open:

* The boot is frame 0 at t = 0, with one sample of each sensor.
* A set point holds for a whole frame, so it applies only if drive and permit are valid to the end of the frame.
* Without a drive in force the echo has seq 0. Ages count from the arrival of the last drive and permit that took
  effect; they are 0 before the first of the boot.
* The link's delays are whole frames. The frame read at t is delivered at t + the sensors' delay; the truth has no
  delay.
* Without a fault plan (``ccatp.sim.fault_injector``) the battery stays full, ``faults`` stays empty and nothing fails.
* A planned reboot takes no time. On the link, clock and frames restart from 0; ``seq`` and ``t_s`` here, the truth and
  the times of the plan continue.

Requests for the true state (SI; puck in the world frame, start pose in the deck frame):

* ``b"puck"``: ``{"t", "puck": [x, y, z], "moved_m"}``, ``moved_m``: largest distance of the robot from its present
  position within the last measuring time;
* ``b"misalignment"``: ``{"panels": [[row, col, piston_m, tip_rad, tilt_rad], ...], "start": [x, y, heading]}``.
"""

from collections import deque

import numpy as np

from ccatp.config.models import Config
from ccatp.core import DeckPose
from ccatp.links.robot_codec import RobotFrame, encode
from ccatp.links.robot_messages import CommandEcho, RobotData, Sensors
from ccatp.mirror.mirror import Mirror
from ccatp.sim.fault_injector import Injector
from ccatp.sim.fault_plan import FaultPlan
from ccatp.sim.ground_truth import SurveyTruth
from ccatp.sim.plant import WHOLE
from ccatp.sim.sensors import SensorSuite, as_message
from ccatp.sim.simulated_robot import SimulatedRobot
from ccatp.sim.world import World


class Robot(SimulatedRobot, SurveyTruth):
    """The survey robot; without ``start`` it starts at base, with a drawn error.

    ``rng`` is the parent of all generators. ``delivered_rows``: ``delivered`` with plain tuples for samples, before the
    faults of its delivery; do not change it.
    """

    def __init__(
        self, cfg: Config, mirror: Mirror, rng: np.random.Generator, faults: FaultPlan | None = None,
        start: DeckPose | None = None,
    ) -> None:  # fmt: skip
        sim = cfg.sim.robot
        world_rng, sensors_rng = rng.spawn(2)
        self._cfg = cfg
        self._floor = sim.fan_floor if mirror.overhang else 0.0
        self.sensors_delay_frames = round(cfg.world.sensors_delay_s * sim.frame_hz)
        limits = sim.ttl_s, cfg.robot.max_wheel_rad_s, self._floor
        super().__init__(limits, 1.0 / sim.frame_hz, sim.frame_hz, round(cfg.world.commands_delay_s * sim.frame_hz))
        self.injector = None if faults is None else Injector(faults, mirror, rng.spawn(1)[0])
        window_frames = max(1, round(cfg.etalon.measuring_time_s * sim.frame_hz))
        pushes = () if self.injector is None else self.injector.drifts
        self.world = world = World(cfg, mirror, world_rng, window_frames, pushes, start)
        self._sensors = SensorSuite(cfg, mirror, sensors_rng, lag_s=world.wheels.lag_s)
        self._sensors.edges.place(world.plant)
        world.sensors = self._sensors.edges
        # The newest frame last; the first is delivered once the deque is full.
        self._frames: deque[RobotFrame] = deque(maxlen=self.sensors_delay_frames + 1)
        self._delivered: Sensors | None = None
        self.delivered_rows: RobotFrame | None = None
        self._line = b""
        self._read()

    def describe(self) -> RobotData:
        robot = self._cfg.robot
        return RobotData(
            wheel_radius_m=robot.wheel_radius_m,
            wheel_base_m=robot.wheel_base_m,
            edge_sensors_m=robot.edge_sensors_m,
            puck_m=(0.0, 0.0, robot.puck_height_m),
            max_wheel_rad_s=robot.max_wheel_rad_s,
            fan_floor=self._floor,
        )

    def advance(self) -> None:
        before_s = self.t_s
        injector = self.injector
        if injector is not None and (due := injector.reboots(before_s)):
            self._reboot(injector, keeps_number=all(fault.keeps_number for fault in due))
        self._release_commands()
        self.seq += 1
        self.t_s = t_s = self.seq / self.frame_hz
        right, left = self.rules.set_points(t_s)
        if injector is not None and not self.world.is_fallen:
            before = self.world.plant.pose
            right, left = injector.act(self.world, self.fans, before_s, (right, left))
            if self.world.plant.pose != before:
                self._sensors.edges.place(self.world.plant)  # no readings between the old and the new place
        self.world.step(before_s, self.frame_s, right, left, self.fans.thrust)
        self._read()

    def _reboot(self, injector: Injector, *, keeps_number: bool) -> None:
        """Discard all commands and undelivered frames; the fans go to their floor."""
        health = self.fans.health
        self.reboots += 1
        self.boot_count += not keeps_number
        self.boots = *self.boots, self.seq
        self._boot()
        self.fans.health = health
        self._frames.clear()
        injector.reboot(self.seq, self.t_s)

    @property
    def delivered(self) -> Sensors | None:
        """The frame that reached the clients at this instant, ``None`` if there is none.

        Its numbers are those decoded from ``delivered_line``. It is made at the first use and shared: do not change it.
        """
        if self._delivered is None and self.delivered_rows is not None and self.injector is None:
            self._delivered = as_message(self.delivered_rows)
        return self._delivered

    @property
    def delivered_line(self) -> bytes:
        if not self._line and self.delivered_rows is not None and self.injector is None:
            self._line = encode(self.delivered_rows)
        return self._line

    def _read(self) -> None:
        seq, t_s, plant = self.seq, self.t_s, self.world.plant
        edges, imu, encoders, gravity = self._sensors.read(seq, plant)
        drive_seq, age_s, permit_age_s, is_held = self.rules.echo(t_s)
        is_held = is_held or self.world.is_fallen
        age_s, permit_age_s = (age_s * 1e6 + WHOLE - WHOLE) / 1e6, (permit_age_s * 1e6 + WHOLE - WHOLE) / 1e6
        cmd = CommandEcho(drive_seq, age_s, permit_age_s, is_held)
        frame = RobotFrame(
            seq, t_s, imu=imu, enc=encoders, edge=edges, gravity=gravity, fans=self.fans.duty, soc=1.0, cmd=cmd,
            faults=(),
        )  # fmt: skip
        injector, frames = self.injector, self._frames
        frames.append(frame if injector is None else injector.sense(frame))
        self._delivered, self._line = None, b""
        self.delivered_rows = delivered = frames[0] if len(frames) > self.sensors_delay_frames else None
        self.delivered_seq = -1 if delivered is None else delivered.seq
        if injector is not None:
            self._line, message = injector.deliver(t_s, delivered)
            self._delivered, self.delivered_seq = message, -1 if message is None else message.seq
