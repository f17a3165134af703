"""SurveyLoops that break the interface page in one place: messages changed on their way, or other rules inside."""

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, asynccontextmanager
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import patch

from ccatp.commissioning.conformance.runner import Conformance, Result
from ccatp.config.models import Config
from ccatp.dataloop import Connection
from ccatp.mirror.mirror import Mirror
from ccatp.sim.rules import MotionRules
from tests.support.scenario import SurveyLoop

Message = dict[str, Any]
STOP_S = 10.0
STEP_S, MOST_S = 0.005, 0.02  # of the clock of the servers


class Crooked(NamedTuple):
    """One broken server.

    Attributes:
        name: what is wrong with it.
        fails: the checks that have to find it, parted by blanks; all others of ``runs`` have to pass.
        runs: the checks that run.
        says: changes a message of the robot; returns it, bytes of its own, or nothing.
        hears: changes what a client sent, as it came.
        twist: changes the robot or its link before the first connection.
    """

    name: str
    fails: str = ""
    runs: tuple[str, ...] = ()
    says: Callable[[Message, "Middle"], Message | bytes | None] | None = None
    hears: Callable[[bytes, "Middle"], bytes] | None = None
    twist: Callable[[SurveyLoop], object] | None = None


class Middle(Connection):
    """A connection whose messages are changed on their way.

    Attributes:
        owner: the SurveyLoop.
        hello: what it said first.
        count: messages of the robot so far.
        has_sent: whether the client has sent what a broken server waits for.
    """

    def __init__(self, owner: "CrookedLoop") -> None:
        super().__init__(owner)
        self.owner, self._crooked = owner, owner.crooked
        self.hello: Message = {}
        self.count = 0
        self.has_sent = False

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


class CrookedLoop(SurveyLoop):
    """A server whose messages are changed on their way."""

    crooked: Crooked

    def connect(self) -> Connection:
        return Middle(self)


@asynccontextmanager
async def server_time(*modules: ModuleType) -> AsyncIterator[None]:
    """Let the checks in these modules wait by the clock of the event loop that serves the robots.

    What passes while that loop waits for a processor does not count: the patience of the checks is for a silent server
    and not for a busy machine.
    """
    now_s = time.monotonic()

    async def run() -> None:
        nonlocal now_s
        before_s = time.monotonic()
        while True:
            await asyncio.sleep(STEP_S)
            seen_s = time.monotonic()
            now_s += min(seen_s - before_s, MOST_S)
            before_s = seen_s

    running = asyncio.create_task(run())
    seen = SimpleNamespace(monotonic=lambda: now_s, sleep=time.sleep)
    try:
        with ExitStack() as stack:
            for module in modules:
                stack.enter_context(patch.object(module, "time", seen))
            yield
    finally:
        running.cancel()


HONEST = Crooked("honest")


def of(kind: str, change: Callable[[Message, Middle], object]) -> Callable[[Message, Middle], Message]:
    """Change messages of one type in place."""

    def says(message: Message, middle: Middle) -> Message:
        if message["type"] == kind:
            change(message, middle)
        return message

    return says


def put(kind: str, **values: Any) -> Callable[[Message, Middle], Message]:
    """Other values in messages of one type."""
    return of(kind, lambda message, _: message.update(values))


def each(change: Callable[[Message], object]) -> Callable[[Message, Middle], Message]:
    """Change each frame in place."""
    return of("sensors", lambda frame, _: change(frame))


def clock(change: Callable[[float], float]) -> Callable[[Message, Middle], Message]:
    """Another clock, in frames and their samples."""

    def says(frame: Message) -> None:
        frame["t"] = change(frame["t"])
        for sample in (*frame["imu"], *frame["enc"], *frame["edge"], *([frame["gravity"]] if frame["gravity"] else ())):
            sample[0] = change(sample[0])

    return each(says)


def swap(old: bytes, new: bytes) -> Callable[[bytes, Middle], bytes]:
    """Something else in what clients send."""
    return lambda data, _: data.replace(old, new)


def rules(**methods: Any) -> Callable[[SurveyLoop], None]:
    """Other rules of motion, by method."""

    def twist(loop: SurveyLoop) -> None:
        loop.robot.rules.__class__ = type("Other", (MotionRules,), methods)

    return twist


def around(path: str, new: Callable[..., Any]) -> Callable[[SurveyLoop], None]:
    """A method of the robot or its server (no dot), replaced by ``new(loop, method, *arguments)``."""

    def twist(loop: SurveyLoop) -> None:
        *parts, name = path.split(".")
        owner = getattr(loop, *parts) if parts else loop
        method = getattr(owner, name)
        setattr(owner, name, lambda *args, **kwargs: new(loop, method, *args, **kwargs))

    return twist


@asynccontextmanager
async def serving(
    config: Config, *, lockstep: bool, key: bytes | None = None, crooked: Crooked = HONEST
) -> AsyncIterator[int]:
    """Run a server; its port."""
    loop = CrookedLoop(config, lockstep=lockstep, key=key)
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
    mirror: Mirror | None = None,
) -> list[Result]:
    """Results of the checks on such a server."""
    async with serving(config, lockstep=lockstep, key=key, crooked=crooked) as port:

        def run() -> list[Result]:
            return Conformance(("127.0.0.1", port), key, timeout_s, mirror).run(motion=True, only=tuple(only))

        with ThreadPoolExecutor(1) as own:  # the common one has too few threads for servers side by side
            return await asyncio.get_running_loop().run_in_executor(own, run)
