"""DataLoops that break the interface page in one place: a man in the middle, or other rules inside."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

from ccatp.commissioning.conformance.runner import Conformance, Result
from ccatp.config.models import Config
from ccatp.dataloop import DataLoop, _Connection

Message = dict[str, Any]
STOP_S = 10.0


class Crooked(NamedTuple):
    """One broken server.

    Attributes:
        name: what is wrong with it.
        fails: the checks that have to find it; all others of ``runs`` have to pass.
        runs: the checks that run.
        says: changes a message of the robot; returns it, bytes of its own, or nothing.
        hears: changes what a client sent, as it came.
        twist: changes the robot or its link before the first connection.
    """

    name: str
    fails: frozenset[str]
    runs: tuple[str, ...]
    says: Callable[[Message, "Middle"], Message | bytes | None] | None = None
    hears: Callable[[bytes, "Middle"], bytes] | None = None
    twist: Callable[[DataLoop], object] | None = None


class Middle(_Connection):
    """A connection with somebody in between.

    Attributes:
        owner: the DataLoop.
        hello: what it said first.
        count: messages of the robot so far.
    """

    def __init__(self, owner: "CrookedLoop") -> None:
        super().__init__(owner)
        self.owner, self._crooked = owner, owner.crooked
        self.hello: Message = {}
        self.count = 0

    def write(self, data: bytes) -> None:
        message = json.loads(data)
        self.count += 1
        if message["type"] == "hello":
            self.hello = message
        if self._crooked.says is None:
            super().write(data)
            return
        said = self._crooked.says(message, self)
        if said is not None:
            super().write(said if isinstance(said, bytes) else json.dumps(said).encode() + b"\n")

    def data_received(self, data: bytes) -> None:
        super().data_received(data if self._crooked.hears is None else self._crooked.hears(data, self))

    @property
    def session(self) -> Any:
        """The robot's side of it."""
        return self._session


class CrookedLoop(DataLoop):
    """A DataLoop whose connections have somebody in between."""

    crooked: Crooked

    def _connection(self) -> _Connection:
        return Middle(self)


HONEST = Crooked("honest", frozenset(), ())


@asynccontextmanager
async def serving(
    config: Config, *, lockstep: bool, key: bytes | None = None, crooked: Crooked = HONEST
) -> AsyncIterator[int]:
    """Run a server; its port."""
    robot = config.sim.robot.model_copy(update={"port": 0})
    config = config.model_copy(update={"sim": config.sim.model_copy(update={"robot": robot})})
    loop = CrookedLoop(config, lockstep, 1, key)
    loop.crooked = crooked
    port = await loop.start()
    if crooked.twist is not None:
        crooked.twist(loop)
    stop = asyncio.Event()
    running = asyncio.create_task(loop.run(stop))
    try:
        yield port
    finally:
        stop.set()
        async with asyncio.timeout(STOP_S):
            await running


async def checked(
    config: Config,
    only: Iterable[str] = (),
    *,
    lockstep: bool,
    timeout_s: float,
    key: bytes | None = None,
    crooked: Crooked = HONEST,
) -> list[Result]:
    """Results of the checks on such a server."""
    async with serving(config, lockstep=lockstep, key=key, crooked=crooked) as port:

        def run() -> list[Result]:
            return Conformance(("127.0.0.1", port), key, timeout_s).run(motion=True, only=tuple(only))

        with ThreadPoolExecutor(1) as own:  # the common one has too few threads for servers side by side
            return await asyncio.get_running_loop().run_in_executor(own, run)


async def failures(config: Config, crooked: Crooked, *, lockstep: bool, key: bytes | None = None) -> dict[str, str]:
    """What failed, and by what was seen."""
    results = await checked(config, crooked.runs, lockstep=lockstep, timeout_s=1.0, key=key, crooked=crooked)
    return {result.check_id: result.detail for result in results if result.outcome == "fail"}
