"""A robot's stand-in, the faulty proxy before it, and the daemon's own end of the link, in one event loop."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from ccatp.config.load import load_config
from ccatp.core import PanelPose
from ccatp.dataloop import DataLoop
from ccatp.links.robot_link import RobotLink
from ccatp.links.robot_messages import Sensors
from ccatp.localizer import Localizer, build_localizer
from ccatp.mirror.mirror import build_mirror
from ccatp.sim.fault_proxy import FaultProxy

DEADLINE_S = 30.0  # what never happens in a good run may take this long in a bad one
SEED = 3


class Driver:
    """Joins as the controller, localizes, and answers each frame by the same drive.

    Args:
        port: where the robot, or the proxy before it, listens.
        key: of the robot link.

    Attributes:
        seqs: numbers of the frames that reached it.
        lost: why the session ended.
    """

    def __init__(self, port: int, key: bytes | None = None) -> None:
        cfg = load_config(overrides={"run.seed": SEED, "run.filter": "kf"})
        self.localizer: Localizer = build_localizer(cfg, build_mirror(cfg.mirror))
        self.seqs: list[int] = []
        self.lost = ""
        self.changed = asyncio.Event()
        self.link = RobotLink(
            host="127.0.0.1",
            port=port,
            role="controller",
            client="test",
            key=key,
            on_sensors=self._on_sensors,
            on_lost=self._on_lost,
        )

    def _on_sensors(self, frame: Sensors, _line: bytes) -> None:
        self.seqs.append(frame.seq)
        self.localizer.step(frame.t, frame.imu, frame.enc, frame.edge, frame.gravity)
        self.link.send_drive(frame.seq + 1, frame.seq, 1.1, 1.0)
        self.changed.set()

    def _on_lost(self, reason: str) -> None:
        self.lost = reason
        self.changed.set()

    @property
    def pose(self) -> PanelPose:
        return self.localizer.pose

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(DEADLINE_S):
            while not condition():
                self.changed.clear()
                await self.changed.wait()

    async def drive(self, frames: int) -> None:
        """Until frame number ``frames`` came, or the session ended."""
        await self.until(lambda: bool(self.lost or (self.seqs and self.seqs[-1] >= frames)))


@asynccontextmanager
async def robot_behind_proxy(*, lockstep: bool, key: bytes | None = None) -> AsyncIterator[tuple[DataLoop, FaultProxy]]:
    """A running DataLoop with a proxy before it."""
    cfg = load_config(overrides={"run.seed": SEED, "sim.robot.port": 0})
    loop = DataLoop(cfg, lockstep, SEED, key)
    port = await loop.start()
    stop = asyncio.Event()
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(loop.run(stop))
        try:
            async with FaultProxy("127.0.0.1", port, seed=1) as proxy:
                yield loop, proxy
        finally:
            stop.set()
