"""The daemon in one event loop with its peers, in real time: what happens can be seen from within.

`running_daemon` has both loops; `robot_behind_proxy` and `Driver` only the robot link.
"""

import asyncio
import json
import tempfile
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import structlog
import zmq

from ccatp.config.load import dump_config
from ccatp.config.models import Config
from ccatp.core import PanelPose
from ccatp.daemon.loops.danger_loop import DangerLoop
from ccatp.daemon.loops.main_loop import MainLoop, open_runner
from ccatp.daemon.supervision.process import Endpoints, ProcessArgs
from ccatp.links.robot_link import LinkHandler, RobotLink
from ccatp.links.robot_messages import PROTOCOL, Hello, RobotData, Role, Sensors
from ccatp.localizer import Localizer, build_localizer
from ccatp.onboard.rules import MotionRules
from ccatp.sim.etalon_server import EtalonSimulator, ZmqPuck
from ccatp.sim.fault_proxy import FaultProxy
from ccatp.sim.ground_truth import GroundTruthPublisher
from tests.support.scenario import SurveyLoop, any_port, config_of, mirror_of, one_panel

DEADLINE_S = 60.0
LINK_DEADLINE_S = 30.0  # what never happens in a good run may take this long in a bad one
SEED = 3
SEND_DRIVE, SEND_PERMIT, SET_POINTS = RobotLink.send_drive, RobotLink.send_permit, MotionRules.set_points
HELLO = Hello(
    protocol=PROTOCOL, boot=1, nonce="ab" * 16, auth="none", lockstep=False, frame_hz=100.0, ttl_s=0.25,
    robot=RobotData(wheel_radius_m=0.03, wheel_base_m=0.15,
                    edge_sensors_m=((0.09, 0.09), (0.09, -0.09), (-0.09, 0.09), (-0.09, -0.09)),
                    puck_m=(0.0, 0.0, 0.05), max_wheel_rad_s=8.0, fan_floor=0.0),
)  # fmt: skip
LATE_FRAMES = 16  # of 10 ms: data are too old after 150 ms


class Executed(NamedTuple):
    """One step in which the robot's wheels turned by a drive: its number, and when it was."""

    seq: int
    at_s: float


class Daemon:
    """What a test sees of it.

    Attributes:
        main, danger: the loops.
        robot: the stand-in.
        to_main, to_danger: the proxies before it, one for each loop.
        log: what the loops logged.
        sent: wall time of each drive that was not zero, by its number.
        late: commands to move, drives or permits, that were computed from a frame of more than ``LATE_FRAMES`` ago.
        executed: the steps in which the wheels turned.
        loops: the tasks of main and danger.
        stop: ends both.
    """

    def __init__(
        self, main: MainLoop, danger: DangerLoop, robot: SurveyLoop, proxies: tuple[FaultProxy, FaultProxy]
    ) -> None:
        self.main, self.danger, self.robot = main, danger, robot
        self.to_main, self.to_danger = proxies
        self.log: list[dict[str, Any]] = []
        self.sent: dict[int, float] = {}
        self.late: list[str] = []
        self.executed: list[Executed] = []
        self.loops: list[asyncio.Task[None]] = []
        self.stop = asyncio.Event()

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Functions in place of the methods of links and robot: bound methods would not get the link itself."""
        clock = asyncio.get_running_loop().time

        def send_drive(
            link: RobotLink, seq: int, ack: int, wr_rad_s: float, wl_rad_s: float, steer_rad: float | None = None
        ) -> None:
            if wr_rad_s or wl_rad_s:
                self.sent[seq] = clock()
                self._note_late("drive", ack)
            SEND_DRIVE(link, seq, ack, wr_rad_s, wl_rad_s, steer_rad=steer_rad)

        def send_permit(link: RobotLink, seq: int, ack: int, forward: bool, reverse: bool, turn: bool) -> None:
            if forward or reverse or turn:
                self._note_late("permit", ack)
            SEND_PERMIT(link, seq, ack, forward, reverse, turn=turn)

        def set_points(rules: MotionRules, until_s: float) -> tuple[float, float]:
            found = SET_POINTS(rules, until_s)
            if any(found):
                self.executed.append(Executed(rules._drive_seq, clock()))
            return found

        with (
            patch.object(RobotLink, "send_drive", send_drive),
            patch.object(RobotLink, "send_permit", send_permit),
            patch.object(MotionRules, "set_points", set_points),
        ):
            yield

    def _note_late(self, kind: str, ack: int) -> None:
        if self.robot.robot.seq - ack > LATE_FRAMES:
            self.late.append(f"{kind} on frame {ack} at frame {self.robot.robot.seq}")

    async def until(self, condition: Callable[[], bool]) -> None:
        """Wait for something; the loops go on meanwhile."""
        try:
            async with asyncio.timeout(DEADLINE_S):
                while not condition():  # noqa: ASYNC110 - frames are worth no event each
                    await asyncio.sleep(0.005)
        except TimeoutError:
            raise AssertionError(tell(self)) from None

    @property
    def is_driving(self) -> bool:
        """Whether the wheels turned within the last tenth of a second."""
        return bool(self.executed) and asyncio.get_running_loop().time() - self.executed[-1].at_s < 0.1

    def events(self, event: str) -> list[dict[str, Any]]:
        """What was logged under a name."""
        return [entry for entry in self.log if entry["event"] == event]


def configuration(mirror: str = "fyst-m1", **settings: object) -> Config:
    """A survey of one panel, which begins to drive as soon as gravity is known."""
    how = {"run__filter": "kf", "run__seed": 5, "run__realtime_priority": 0, "sim__robot__port": 0}
    return one_panel(run__mirror=mirror, **how, **settings)


@contextmanager
def _logging_to(entries: list[dict[str, Any]]) -> Iterator[None]:
    def keep(_: object, __: str, fields: Any) -> Any:
        entries.append(dict(fields))
        raise structlog.DropEvent

    logger = structlog.wrap_logger(None, processors=[structlog.processors.add_log_level, keep])
    with patch("ccatp.daemon.loops.robot_loop.open_log", lambda _, name: logger.bind(logger=name)):
        yield


@asynccontextmanager
async def stand_ins(
    cfg: Config, folder: Path, robot_cfg: Config | None = None
) -> AsyncIterator[tuple[SurveyLoop, int, int]]:
    """Robot (of another configuration, where that is given) and laser system in real time, and their ports.

    The true state of the robot is at the sockets ``puck`` and ``truth`` in a folder.
    """
    endpoints, mirror, stop = Endpoints(folder), mirror_of(cfg.mirror.name), asyncio.Event()
    async with AsyncExitStack() as stack:
        robot = SurveyLoop(robot_cfg or cfg, lockstep=False)
        outlet = GroundTruthPublisher(robot.robot, endpoints.of("puck"), endpoints.of("truth"))
        robot.each_frame.append(outlet.add)
        stack.callback(outlet.close)
        puck = ZmqPuck(endpoints.of("puck"))
        stack.callback(puck.close)
        laser = EtalonSimulator(cfg.sim.etalon, mirror.channels, mirror.collimators_m, puck, np.random.default_rng(1))
        stack.push_async_callback(laser.close)
        robot_port, laser_port = await robot.start(), await laser.start(any_port())
        async with asyncio.TaskGroup() as tasks:
            serving = [tasks.create_task(work) for work in (robot.run(stop), outlet.serve(), laser.serve())]
            try:
                yield robot, robot_port, laser_port
            finally:
                stop.set()
                for task in serving[1:]:
                    task.cancel()


@asynccontextmanager
async def running_daemon(cfg: Config, robot_cfg: Config | None = None) -> AsyncIterator[Daemon]:
    """A survey under way, from its beginning; it is stopped at the end.

    Args:
        cfg: the daemon's configuration.
        robot_cfg: that of the robot, if it is another one.
    """
    entries: list[dict[str, Any]] = []
    stop = asyncio.Event()
    async with AsyncExitStack() as stack:
        run_dir = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ccatp-")))
        stack.enter_context(_logging_to(entries))
        robot, port, laser_port = await stack.enter_async_context(stand_ins(cfg, run_dir, robot_cfg))
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.destroy, linger=0)
        proxies = [await stack.enter_async_context(FaultProxy("127.0.0.1", port, seed=seed)) for seed in (1, 2)]
        configs, endpoints = [_at(cfg, proxy.port, laser_port) for proxy in proxies], Endpoints(run_dir)
        main_args, danger_args = (ProcessArgs(at, run_dir, endpoints, None, True, False) for at in configs)
        (run_dir / "config.toml").write_text(dump_config(configs[0]), encoding="utf-8")
        main = MainLoop(main_args, context, stack.enter_context(open_runner(main_args)))
        daemon = Daemon(main, DangerLoop(danger_args, context), robot, (proxies[0], proxies[1]))
        daemon.log, daemon.stop = entries, stop
        recorder = context.socket(zmq.SUB)
        recorder.connect(endpoints.of("main"))
        recorder.subscribe("track")
        stack.enter_context(daemon.watching())
        async with asyncio.TaskGroup() as tasks:
            daemon.loops = [tasks.create_task(one.loop.run(stop)) for one in (daemon.main, daemon.danger)]
            try:
                yield daemon
            finally:
                stop.set()
                await asyncio.wait(daemon.loops)


def _at(cfg: Config, robot_port: int, laser_port: int) -> Config:
    robot = cfg.robot.model_copy(update={"port": robot_port})
    return cfg.model_copy(update={"robot": robot, "etalon": cfg.etalon.model_copy(update={"port": laser_port})})


def tell(daemon: Daemon) -> str:
    """For a test that failed."""
    return json.dumps(daemon.log[-20:], default=str, indent=1)


# -- the robot link alone ---------------------------------------------------------------------------------------------


def link_to(
    port: int,
    role: Role = "controller",
    kind: type[RobotLink] = RobotLink,
    *,
    key: bytes | None = None,
    **events: Callable[..., Any],
) -> RobotLink:
    """A client's end; ``events``: what it calls, as in ``LinkHandler``."""
    given: dict[str, Callable[..., Any]] = {"on_sensors": lambda *_: None, "on_lost": lambda _: None}
    handler = LinkHandler(**(given | events))
    return kind(host="127.0.0.1", port=port, role=role, client="test", key=key, handler=handler)


class Waiting:
    """Something that sets an event at each change, so that a test can wait for a condition."""

    changed: asyncio.Event

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(LINK_DEADLINE_S):
            while not condition():
                self.changed.clear()
                await self.changed.wait()


class Driver(Waiting):
    """Joins as the controller, localizes, and answers each frame, and one that comes again, by the same drive.

    Args:
        port: where the robot, or the proxy before it, listens.
        key: of the robot link.

    Attributes:
        seqs: numbers of the frames that reached it.
        lost: why the session ended.
    """

    def __init__(self, port: int, key: bytes | None = None) -> None:
        self.localizer: Localizer = build_localizer(config_of(run__seed=SEED, run__filter="kf"), mirror_of())
        self.seqs: list[int] = []
        self.lost = ""
        self.changed = asyncio.Event()
        self.link = link_to(port, key=key, on_sensors=self._on_sensors, on_lost=self._on_lost, on_repeated=self._answer)
        self._answers = 0

    def _on_sensors(self, frame: Sensors, _line: bytes) -> None:
        self.seqs.append(frame.seq)
        self.localizer.step(frame.t, frame.imu, frame.enc, frame.edge, frame.gravity)
        self._answer()
        self.changed.set()

    def _answer(self) -> None:
        self._answers += 1
        self.link.send_drive(self._answers, self.seqs[-1], 1.1, 1.0)

    def _on_lost(self, reason: str) -> None:
        self.lost = reason
        self.changed.set()

    @property
    def pose(self) -> PanelPose:
        return self.localizer.pose

    async def drive(self, frames: int) -> None:
        """Until frame number ``frames`` came, or the session ended."""
        await self.until(lambda: bool(self.lost or (self.seqs and self.seqs[-1] >= frames)))


@asynccontextmanager
async def at_work(robot: SurveyLoop) -> AsyncIterator[int]:
    """A simulated robot behind its link; its port."""
    port, stop = await robot.start(), asyncio.Event()
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(robot.run(stop))
        try:
            yield port
        finally:
            stop.set()


@asynccontextmanager
async def robot_behind_proxy(
    *, lockstep: bool, key: bytes | None = None
) -> AsyncIterator[tuple[SurveyLoop, FaultProxy]]:
    """A running DataLoop with a proxy before it."""
    loop = SurveyLoop(config_of(run__seed=SEED), lockstep=lockstep, key=key)
    async with at_work(loop) as port, FaultProxy("127.0.0.1", port, seed=1) as proxy:
        yield loop, proxy
