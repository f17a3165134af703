"""The servers of the simulated robots, their log, and the publication of the true state.

The robot link carries only what a real robot would send. The true state is sent by ZeroMQ: a REP socket for the
requests of ``GroundTruthPublisher`` and of the robot, and a PUB socket with rows.

Known limitations: the battery stays full, and nothing fails without a fault plan (``ccatp.sim.fault_injector``).
"""

import asyncio
import socket
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ccatp.config.files import read_key
from ccatp.config.load import load_onboard_config
from ccatp.config.mission import CommonConfig
from ccatp.config.models import Config
from ccatp.config.onboard_models import OnboardConfig
from ccatp.core import DeckPose
from ccatp.links.robot_codec import decode_from_robot
from ccatp.links.robot_messages import Sensors
from ccatp.mirror.mirror import build_mirror
from ccatp.missions import kind_of
from ccatp.onboard.robot import OnboardRobot
from ccatp.onboard.server import TcpRobotServer
from ccatp.onboard.sessions import ServerLog
from ccatp.sim.fault_injector import Injector
from ccatp.sim.fault_plan import FaultPlan, Injected
from ccatp.sim.fault_proxy import FaultProxy, LinkFaults
from ccatp.sim.ground_truth import GroundTruthPublisher, SimPoseFile, SurveyTruth
from ccatp.sim.hardware import DriveTrain, SimulatedHardware
from ccatp.sim.robot import Robot
from ccatp.sim.simulated_robot import SimulatedRobot

_SAME_STEP = 1e-6  # tolerance for the rounding of times of steps and frames


def _hardware_class(cfg: Config) -> type[SimulatedHardware]:
    if cfg.sim.robot.physics != "mujoco":
        return SimulatedHardware
    from ccatp.sim.physics import PhysicsHardware  # noqa: PLC0415 - its package is optional

    return PhysicsHardware


class MotorRobot(OnboardRobot, SimulatedRobot, SurveyTruth):
    """A simulated survey robot whose motors are driven by the on-board core, just booted; simulated time."""

    injector = None  # only ``Robot`` has faults

    def __init__(self, cfg: Config, onboard: OnboardConfig, start: DeckPose | None = None) -> None:
        servo, sim = onboard.servo, cfg.sim.robot
        train = DriveTrain(servo.loop_hz, servo.counts_per_rev)
        hardware = _hardware_class(cfg)(
            cfg, build_mirror(cfg.mirror), np.random.default_rng(cfg.run.seed), train, start=start
        )
        self.world = hardware.world
        super().__init__(onboard, hardware, round(cfg.world.commands_delay_s * sim.frame_hz))
        # The newest line is last; the first one is delivered once the deque is full.
        self._lines: deque[tuple[int, bytes]] = deque(maxlen=round(cfg.world.sensors_delay_s * sim.frame_hz) + 1)
        self._steps = 0
        self._close_frame(self.t_s)

    def advance(self) -> None:
        self._release_commands()
        loop_hz = self._cfg.servo.loop_hz
        while self._steps <= self.next_t_s * loop_hz + _SAME_STEP:
            self.control(self._steps / loop_hz)
            self._steps += 1
        super().advance()

    @property
    def delivered(self) -> Sensors | None:
        """The frame that was delivered to the clients now, or ``None``."""
        message = decode_from_robot(self.delivered_line) if self.delivered_line else None
        return message if isinstance(message, Sensors) else None

    def _close_frame(self, t_s: float) -> None:
        super()._close_frame(t_s)
        lines = self._lines
        lines.append((self.seq, self._line))
        self.delivered_seq, self._line = lines[0] if len(lines) == lines.maxlen else (-1, b"")


class StandInOptions(NamedTuple):
    """What a simulated robot begins with: a plan of faults; the file that keeps its true pose between runs."""

    faults: FaultPlan | None = None
    body_file: Path | None = None
    is_resuming: bool = False


class StandIn(NamedTuple):
    """A simulated robot, just booted; faults that it injects; what is done after each frame, and at the end."""

    robot: SimulatedRobot
    faults: Sequence[Injector] = ()
    each_frame: Sequence[Callable[[], object]] = ()
    close: Callable[[], object] = lambda: None


class DataLoop(TcpRobotServer):
    """The server of one simulated robot. It logs the begin, end and effect of ``faults``, and a fall of the robot."""

    robot: SimulatedRobot

    def __init__(
        self,
        robot: SimulatedRobot,
        *,
        lockstep: bool,
        key: bytes | None = None,
        log: ServerLog | None = None,
        faults: Sequence[Injector | LinkFaults] = (),
    ) -> None:
        super().__init__(robot, lockstep=lockstep, key=key, log=log)
        self._faults = faults
        self._is_fall_logged = False
        self.each_frame += [self._log_faults, self._log_fall] if faults else [self._log_fall]

    async def close(self) -> None:
        if self._listener is not None:
            self._log_faults()  # changes since the last frame
            for faults in self._faults:
                for injected in faults.injected:
                    self._log_fault("injected", injected)
        await super().close()

    def _log_faults(self) -> None:
        for faults in self._faults:
            for what, injected in faults.changes(self.robot.t_s):
                self._log_fault(what, injected)

    def _log_fall(self) -> None:
        if self.robot.is_fallen and not self._is_fall_logged and self._log is not None:
            self._is_fall_logged = True
            self._log.info("robot_fell", **self.robot.describe_fall())

    def _log_fault(self, what: str, injected: Injected) -> None:
        if self._log is not None:
            self._log.info(f"fault_{what}", **injected.as_fields())


def motor_robot(cfg: Config, start: DeckPose | None = None) -> MotorRobot:
    """The survey robot with motors, as ``survey_robot``."""
    robot, sim = cfg.robot, cfg.sim.robot
    onboard = load_onboard_config(
        overrides={
            "link.frame_hz": sim.frame_hz,
            "link.ttl_s": sim.ttl_s,
            "link.sample_latency_s": 0.0,
            "robot.wheel_radius_m": robot.wheel_radius_m,
            "robot.wheel_base_m": robot.wheel_base_m,
            "robot.edge_sensors_m": robot.edge_sensors_m,
            "robot.puck_m": (0.0, 0.0, robot.puck_height_m),
            "robot.max_wheel_rad_s": robot.max_wheel_rad_s,
            "robot.fan_floor": sim.fan_floor if build_mirror(cfg.mirror).overhang else 0.0,
            "servo.response_s": sim.wheel_lag_s,
        }
    )
    return MotorRobot(cfg, onboard, start)


def survey_robot(cfg: Config, faults: FaultPlan | None = None, start: DeckPose | None = None) -> Robot:
    """The survey robot of a configuration, just booted, at ``start`` or at base."""
    return Robot(cfg, build_mirror(cfg.mirror), np.random.default_rng(cfg.run.seed), faults, start=start)


def _keep(file: SimPoseFile, robot: Robot | MotorRobot) -> None:
    file.keep(robot.seq, robot.world.plant)


def survey_stand_in(cfg: Config, options: StandInOptions) -> StandIn:
    """The simulated robot of a survey, where it stood last, or at base."""
    body = None if options.body_file is None else SimPoseFile(options.body_file)
    start = body.read() if body is not None and options.is_resuming else None
    robot: Robot | MotorRobot
    faults: list[Injector] = []
    if cfg.sim.robot.physics != "lag":
        robot = motor_robot(cfg, start)
    else:
        robot = survey_robot(cfg, options.faults, start)
        if robot.injector is not None:
            faults.append(robot.injector)
    if body is None:
        return StandIn(robot, faults)
    return StandIn(robot, faults, (partial(_keep, body, robot),), body.close)


class SimOutlets(NamedTuple):
    """Where a simulated robot reports: endpoints of the true state (requests, rows), and the log."""

    truth_rep: str | None = None
    truth_pub: str | None = None
    log: ServerLog | None = None


async def serve(
    cfg: CommonConfig,
    options: StandInOptions,
    *,
    lockstep: bool,
    stop: asyncio.Event,
    listener: socket.socket,
    outlets: SimOutlets,
) -> bool:
    """Run the simulated robot of a configuration until ``stop`` is set; returns whether it fell.

    Faults of the link in the plan need a proxy, which listens instead of the robot. Raises ``zmq.ZMQError`` if an
    endpoint cannot be bound.
    """
    make: Callable[[Any, StandInOptions], StandIn] = kind_of(cfg).stand_in.get()
    made = make(cfg, options)
    faults, log = options.faults, outlets.log
    robot, at_work = made.robot, list[Injector | LinkFaults](made.faults)
    async with AsyncExitStack() as stack:
        stack.callback(made.close)
        if faults is not None and faults.link:
            behind = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
            proxy = FaultProxy(*behind.getsockname()[:2], seed=cfg.run.seed, listener=listener)
            at_work.append(LinkFaults(faults.link, await stack.enter_async_context(proxy)))
            listener = behind
        server = DataLoop(robot, lockstep=lockstep, key=read_key(cfg.robot.key_file), log=log, faults=at_work)
        truth = GroundTruthPublisher(robot, outlets.truth_rep, outlets.truth_pub)
        stack.callback(truth.close)
        server.each_frame += [truth.add, *made.each_frame]
        await server.start(listener)
        async with asyncio.TaskGroup() as tasks:
            answering = tasks.create_task(truth.serve())
            try:
                await server.run(stop)
            finally:
                truth.flush()
                answering.cancel()
        return robot.is_fallen
