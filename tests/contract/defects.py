"""SurveyLoops that break the interface page in one place: messages changed on their way, or other rules inside.

Checks and server share a thread and a clock on which nothing waits: the server runs while a check waits for it.
"""

import asyncio
import json
import select
import selectors
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import patch

from ccatp.commissioning.conformance import command_checks, harness, server_checks
from ccatp.commissioning.conformance.runner import Conformance, Result
from ccatp.config.models import Config
from ccatp.mirror.mirror import Mirror
from ccatp.onboard.rules import MotionRules
from ccatp.onboard.server import Connection
from tests.support.scenario import SurveyLoop
from tests.support.virtual_time import VirtualLoop, VirtualSelector

Message = dict[str, Any]
TIMEOUT_S = 1.0


class Defect(NamedTuple):
    """A defect that a server of the robot link is given.

    Attributes:
        name: what is wrong with it.
        fails: the checks that have to find it, separated by blanks; all others of ``runs`` have to pass.
        runs: the checks that run.
        sends: changes a message of the robot; returns it, bytes of its own, or nothing.
        receives: changes what a client sent, as it came.
        modify: changes the robot or its link before the first connection.
    """

    name: str
    fails: str = ""
    runs: tuple[str, ...] = ()
    sends: Callable[[Message, "Middle"], Message | bytes | None] | None = None
    receives: Callable[[bytes, "Middle"], bytes] | None = None
    modify: Callable[[SurveyLoop], object] | None = None


class Middle(Connection):
    """A connection whose messages are changed on their way.

    Attributes:
        owner: the SurveyLoop.
        hello: what it said first.
        count: messages of the robot so far.
        has_sent: whether the client has sent what a broken server waits for.
    """

    def __init__(self, owner: "BrokenLoop") -> None:
        super().__init__(owner)
        self.owner, self._broken = owner, owner.broken
        self.hello: Message = {}
        self.count = 0
        self.has_sent = False

    def write(self, data: bytes) -> None:
        if self._broken.sends is None and self.hello:
            super().write(data)
            return
        message = json.loads(data)
        self.count += 1
        if message["type"] == "hello":
            self.hello = message
        said = message if self._broken.sends is None else self._broken.sends(message, self)
        if said is not None:
            super().write(said if isinstance(said, bytes) else json.dumps(said).encode() + b"\n")

    def data_received(self, data: bytes) -> None:
        super().data_received(data if self._broken.receives is None else self._broken.receives(data, self))


class BrokenLoop(SurveyLoop):
    """A server whose messages are changed on their way."""

    broken: Defect
    port: int
    clock: "OneThreadLoop"

    def connect(self) -> Connection:
        return Middle(self)


class OneThread(VirtualSelector):
    """What this thread sent is in the other socket at once, so no wait for sockets takes time."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        found = selectors.DefaultSelector.select(self, 0)
        if not found and timeout is not None:
            self.now_s += timeout
        return found


class OneThreadLoop(VirtualLoop):
    """The event loop of a server that runs while the checks wait."""

    def __init__(self) -> None:
        self.virtual = OneThread()
        asyncio.SelectorEventLoop.__init__(self, self.virtual)

    def select(
        self, reading: Sequence[harness.RawConnection], _writing: object, _failed: object, wait_s: float
    ) -> tuple[list[harness.RawConnection], list[Any], list[Any]]:
        """`select.select` of the checks."""
        found = select.select(reading, [], [], 0.0)
        if not found[0]:
            self.run_until_complete(self._readable([one.fileno() for one in reading], wait_s))
            found = select.select(reading, [], [], 0.0)
        return found

    async def _readable(self, sockets: list[int], wait_s: float) -> None:
        ready = asyncio.Event()
        for one in sockets:
            self.add_reader(one, ready.set)
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await ready.wait()
        finally:
            for one in sockets:
                self.remove_reader(one)

    def sleep(self, wait_s: float) -> None:
        """`time.sleep` of the checks."""
        self.run_until_complete(asyncio.sleep(wait_s))


CORRECT = Defect("correct")


def of(kind: str, change: Callable[[Message, Middle], object]) -> Callable[[Message, Middle], Message]:
    """Change messages of one type in place."""

    def sent(message: Message, middle: Middle) -> Message:
        if message["type"] == kind:
            change(message, middle)
        return message

    return sent


def put(kind: str, **values: Any) -> Callable[[Message, Middle], Message]:
    """Other values in messages of one type."""
    return of(kind, lambda message, _: message.update(values))


def each(change: Callable[[Message], object]) -> Callable[[Message, Middle], Message]:
    """Change each frame in place."""
    return of("sensors", lambda frame, _: change(frame))


def clock(change: Callable[[float], float]) -> Callable[[Message, Middle], Message]:
    """Another clock, in frames and their samples."""

    def sent(frame: Message) -> None:
        frame["t"] = change(frame["t"])
        for sample in (*frame["imu"], *frame["enc"], *frame["edge"], *([frame["gravity"]] if frame["gravity"] else ())):
            sample[0] = change(sample[0])

    return each(sent)


def swap(old: bytes, new: bytes) -> Callable[[bytes, Middle], bytes]:
    """Something else in what clients send."""
    return lambda data, _: data.replace(old, new)


def rules(**methods: Any) -> Callable[[SurveyLoop], None]:
    """Other rules of motion, by method."""

    def modified(loop: SurveyLoop) -> None:
        loop.robot.rules.__class__ = type("Other", (MotionRules,), methods)

    return modified


def around(path: str, new: Callable[..., Any]) -> Callable[[SurveyLoop], None]:
    """A method of the robot or its server (no dot), replaced by ``new(loop, method, *arguments)``."""

    def modified(loop: SurveyLoop) -> None:
        *parts, name = path.split(".")
        owner = getattr(loop, *parts) if parts else loop
        method = getattr(owner, name)
        setattr(owner, name, lambda *args, **kwargs: new(loop, method, *args, **kwargs))

    return modified


@contextmanager
def serving(
    config: Config, *, lockstep: bool, key: bytes | None = None, broken: Defect = CORRECT
) -> Iterator[BrokenLoop]:
    """A server whose time passes while the checks wait."""
    with asyncio.Runner(loop_factory=OneThreadLoop) as runner, ExitStack() as stack:
        loop = runner.get_loop()
        assert isinstance(loop, OneThreadLoop)
        now = SimpleNamespace(monotonic=loop.time, sleep=loop.sleep)
        for module, name, value in (
            (harness, "time", now), (harness, "monotonic", loop.time), (harness, "select", loop),
            (server_checks, "time", now), (command_checks, "time", now),
        ):  # fmt: skip
            stack.enter_context(patch.object(module, name, value))
        server = BrokenLoop(config, lockstep=lockstep, key=key)
        server.broken, server.clock, stop = broken, loop, asyncio.Event()
        server.port = loop.run_until_complete(server.start())
        if broken.modify is not None:
            broken.modify(server)
        running = loop.create_task(server.run(stop))
        try:
            yield server
        finally:
            stop.set()
            loop.run_until_complete(running)


def checked(
    config: Config,
    only: Iterable[str] = (),
    *,
    lockstep: bool,
    key: bytes | None = None,
    broken: Defect = CORRECT,
    mirror: Mirror | None = None,
    motion: bool = True,
) -> list[Result]:
    """Results of the checks on such a server."""
    with serving(config, lockstep=lockstep, key=key, broken=broken) as server:
        return Conformance(("127.0.0.1", server.port), key, TIMEOUT_S, mirror).run(motion=motion, only=tuple(only))
