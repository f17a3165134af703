"""Lockstep over links that lose, repeat, delay and damage lines: every wait ends or is reported."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zmq

from ccatp.config.models import Config
from ccatp.daemon.loops import lockstep, robot_loop
from ccatp.daemon.loops.robot_loop import RobotLoop
from ccatp.daemon.supervision.process import Endpoints, ProcessArgs
from ccatp.links.robot_codec import RobotFrame, encode
from ccatp.links.robot_link import RobotTimeout
from ccatp.links.robot_messages import CommandEcho, Hello, Joined, Role, Sensors
from ccatp.onboard import server, sessions
from ccatp.sim.fault_proxy import FaultProxy
from tests.support.daemon import HELLO, at_work
from tests.support.scenario import SurveyLoop, begin, config_of
from tests.support.sockets import scripted

DEADLINE_S = 30.0  # what never happens in a good run may take this long in a bad one
FRAMES = 40
SEED = 3


class LoopClock:
    """Does not count the time in which this process waits for a processor: that is no silence of the robot."""

    def __init__(self) -> None:
        self._now_s, self._seen_s = 0.0, time.monotonic()

    def monotonic(self) -> float:
        seen_s = time.monotonic()
        self._now_s += min(seen_s - self._seen_s, 0.02)
        self._seen_s = seen_s
        return self._now_s


CLOCK = LoopClock()


@pytest.fixture(autouse=True)
def _short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the real ones, in the same proportions."""
    monkeypatch.setattr(robot_loop, "time", CLOCK)
    for module, times_s in (
        (server, {"HOUSEKEEPING_S": 0.02}),
        (sessions, {"REPEAT_S": 0.1}),
        (lockstep, {"REPEAT_S": 0.1, "DUPLICATE_S": 0.05, "INVALID_S": 0.05, "OVERDUE_S": 0.3}),
        (robot_loop, {"WAIT_PERIOD_S": 0.005}),
    ):
        for name, time_s in times_s.items():
            monkeypatch.setattr(module, name, time_s)


class Answering:
    """A controller that drives, or a monitor that permits; both keep what the page asks of a client.

    Attributes:
        frames: numbers of those that were served.
        reports: what its operator would read.
        sent: number, frame and values of each answer.
        withheld: frames that it does not answer.
    """

    def __init__(self, role: Role, cfg: Config, folder: Path, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        name = "main" if role == "controller" else "danger"
        self.peer: Any = SimpleNamespace(maintain=lambda: None)
        self._role = role
        args = ProcessArgs(cfg, folder, Endpoints(folder), None, False, False)
        self.loop = RobotLoop(name, role, args, context, self)
        self.session = self.loop.session
        self.frames, self.reports, self.losses = list[int](), list[str](), list[str]()
        self.sent, self.withheld = list[tuple[int, int, tuple[float, ...]]](), set[int]()
        self._newest: tuple[int, tuple[float, ...]] | None = None

    def services(self) -> tuple[Coroutine[Any, Any, None], ...]:
        return ()

    async def connect(self) -> None:
        """There is only the robot."""

    def is_peer_ready(self) -> bool:
        return True

    async def end(self, _stop: asyncio.Event) -> None:
        """Nothing to say."""

    async def close(self) -> None:
        """Nothing to close."""

    def on_restarted(self) -> None:
        raise AssertionError("the robot does not restart")

    def on_bad_line(self) -> None:
        """The loop reports it."""

    def report_bad_line(self, text: str) -> None:
        """Not what is asked for here."""

    def on_heartbeat(self) -> None:
        """Nobody listens."""

    def is_frame_due(self) -> bool:
        return self._role == "controller" and (not self.frames or self.frames[-1] not in self.withheld)

    def on_joined(self, hello: Hello) -> None:
        self._newest = None
        self.loop.begin_session()

    def on_lost(self, reason: str) -> None:
        self.losses.append(reason)

    def on_silence(self, age_s: float) -> None:
        raise AssertionError("lockstep has no silence of its own")

    def report_overdue(self, text: str) -> None:
        self.reports.append(text)

    def on_sensors(self, sensors: Sensors, _raw: bytes) -> None:
        self.loop.heartbeat.frame_s = CLOCK.monotonic()
        self.frames.append(sensors.seq)
        if sensors.seq not in self.withheld:
            self.answer(sensors.seq)

    def answer(self, seq: int) -> None:
        """The answer to a frame."""
        self._newest = seq, (1.0, 0.01 * seq) if self._role == "controller" else (True, True, True)
        self.answer_again()

    def answer_again(self) -> None:
        if self._newest is None:
            return
        number, (ack, values) = len(self.sent), self._newest
        self.sent.append((number, ack, values))
        if self._role == "controller":
            self.session.link.send_drive(number, ack, *values)
        else:
            self.session.link.send_permit(number, ack, *map(bool, values))


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(DEADLINE_S):
        while not condition():  # noqa: ASYNC110 - frames have no event of their own
            await asyncio.sleep(0.002)


class Rig:
    """A robot in lockstep, and its two clients, each through a proxy of its own."""

    robot: SurveyLoop
    proxies: dict[Role, FaultProxy]
    clients: dict[Role, Answering]
    notes: list[str]

    async def drive(self, frames: int) -> None:
        """Until the robot's frame of that number."""
        await until(lambda: self.robot.robot.seq >= frames)

    @property
    def where(self) -> tuple[float, ...]:
        """The true state of the robot."""
        plant = self.robot.robot.world.plant
        return plant.x_m, plant.y_m, plant.heading_rad, plant.right_rad_s, plant.left_rad_s


@asynccontextmanager
async def running(folder: Path) -> AsyncIterator[Rig]:
    rig = Rig()
    rig.notes, rig.proxies, rig.clients = [], {}, {}
    log: Any = SimpleNamespace(info=lambda _event, **fields: rig.notes.append(str(fields.get("text", ""))))
    rig.robot = SurveyLoop(config_of(run__seed=SEED), lockstep=True, log=log)
    async with AsyncExitStack() as stack:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.destroy, linger=0)
        port = await stack.enter_async_context(at_work(rig.robot))
        tasks: list[asyncio.Task[None]] = []
        roles: tuple[Role, ...] = ("monitor", "controller")
        for role in roles:
            proxy = await stack.enter_async_context(FaultProxy("127.0.0.1", port, seed=1))
            client = Answering(role, config_of(run__seed=SEED, robot__port=proxy.port), folder, context)
            rig.proxies[role], rig.clients[role] = proxy, client
            await client.session.join(is_patient=False)
            tasks += [asyncio.create_task(service) for service in (client.loop.watch(), client.session.serve())]
        try:
            yield rig
        finally:
            for client in rig.clients.values():
                client.session.leave()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


async def end_of(
    folder: Path, disturb: Callable[[Rig], Coroutine[Any, Any, None]] | None = None
) -> tuple[Rig, tuple[float, ...]]:
    """The rig when all have come to frame ``FRAMES``, and where the robot is then."""
    async with running(folder) as rig:
        for client in rig.clients.values():
            client.withheld.add(FRAMES)
        await rig.drive(5)
        if disturb is not None:
            await disturb(rig)
        await until(lambda: all(client.frames[-1] == FRAMES for client in rig.clients.values()))
        where = rig.where
    return rig, where


UNDISTURBED: list[tuple[float, ...]] = []  # where the robot is then, once a test has found out


FAULTS: dict[str, tuple[str, dict[str, Any]]] = {
    "corrupt": ("garbage", {"every": 3, "garbage_bytes": 30}),
    "late": ("delay", {"delay_s": 0.15, "jitter_s": 0.0}),
    "duplicated": ("duplicate", {"every": 2}),
    "missing": ("reorder", {"every": 4}),  # a line that is withheld until the next one is missing until then
}


@pytest.mark.parametrize("way", ["to_client", "to_robot"])
@pytest.mark.parametrize("role", ["controller", "monitor"])
@pytest.mark.parametrize("fault", FAULTS)
async def test_a_faulty_link_stops_no_mission_and_changes_nothing(
    tmp_path: Path, fault: str, role: Role, way: Any
) -> None:
    kind, values = FAULTS[fault]

    async def disturb(rig: Rig) -> None:
        begin(rig.proxies[role], kind, way, **values)
        seq = rig.robot.robot.seq
        await rig.drive(seq + 10)
        rig.proxies[role].heal()

    if not UNDISTURBED:
        UNDISTURBED.append((await end_of(tmp_path))[1])
    rig, where = await end_of(tmp_path, disturb)
    assert [where] == UNDISTURBED
    assert rig.proxies[role].counts[kind] >= 2
    for client in rig.clients.values():
        assert client.frames == list(range(FRAMES + 1))
        assert not client.losses
        values_of: dict[int, set[tuple[float, ...]]] = {}
        for _, ack, answer in client.sent:
            values_of.setdefault(ack, set()).add(answer)
        assert all(len(answers) == 1 for answers in values_of.values())
        assert [number for number, *_ in client.sent] == list(range(len(client.sent)))


@pytest.mark.parametrize("role", ["controller", "monitor"])
@pytest.mark.parametrize("fault", ["corrupt", "missing"])
@pytest.mark.parametrize("way", ["to_client", "to_robot"])
async def test_a_line_that_is_gone_for_good_is_sent_again(tmp_path: Path, fault: str, role: Role, way: Any) -> None:
    async with running(tmp_path) as rig:
        await rig.drive(5)
        client, proxy, repeats = rig.clients[role], rig.proxies[role], rig.robot.counts["repeats"]
        kind, values = ("corrupt", {"every": 1}) if fault == "corrupt" else ("black_hole", {})
        begin(proxy, kind, way, **values)
        await until(lambda: proxy.counts[kind] > 0 and rig.robot.counts["repeats"] > repeats)
        stands_at = rig.robot.robot.seq
        proxy.heal()
        await rig.drive(stands_at + 10)
        assert not client.losses
        frames = client.frames
        assert frames == sorted(set(frames))  # a digit of a number may have become another one


async def test_an_invalid_line_is_reported_while_the_robot_stands(tmp_path: Path) -> None:
    roles: tuple[Role, ...] = ("controller", "monitor")
    for role in roles:
        async with running(tmp_path) as rig:
            client, proxy = rig.clients[role], rig.proxies[role]
            await rig.drive(5)
            begin(proxy, "garbage", "to_client", every=1, garbage_bytes=20)
            begin(proxy, "black_hole", "to_robot")
            await until(partial(bool, client.reports))
            proxy.heal()
            stood_at = rig.robot.robot.seq
            await rig.drive(stood_at + 5)
        assert client.reports[0].startswith("the robot stands: no new frame for ")
        assert client.reports[0].endswith("a line that is not valid")


async def test_a_withheld_answer_keeps_the_session_and_the_clock(tmp_path: Path) -> None:
    async with running(tmp_path) as rig:
        controller = rig.clients["controller"]
        controller.withheld.add(20)
        await rig.drive(20)
        await until(lambda: sum(ack == 19 for _, ack, _ in controller.sent) >= 5)
        assert rig.robot.robot.seq == 20
        assert len({answer for _, ack, answer in controller.sent if ack == 19}) == 1
        assert not controller.reports  # it knows why
        controller.withheld.clear()
        controller.answer(20)
        await rig.drive(30)
        assert not controller.losses


async def test_a_robot_that_waits_for_the_other_client_is_reported(tmp_path: Path) -> None:
    async with running(tmp_path) as rig:
        controller, monitor = rig.clients["controller"], rig.clients["monitor"]
        monitor.withheld.add(20)
        await until(lambda: controller.reports != [])
        assert controller.reports[0].endswith("its last frame again")
        assert not monitor.reports
        monitor.withheld.clear()
        monitor.answer(20)
        await rig.drive(30)


@pytest.mark.parametrize("role", ["controller", "monitor"])
async def test_a_connection_that_is_silent_is_dropped_and_the_next_one_continues(
    tmp_path: Path, role: Role, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lockstep, "LOCKSTEP_SILENCE_S", 0.6)
    async with running(tmp_path) as rig:
        client, proxy = rig.clients[role], rig.proxies[role]
        await rig.drive(5)
        begin(proxy, "black_hole", "to_client")
        await until(lambda: client.losses != [])
        assert client.losses[0].endswith("in lockstep, not even the last one again")
        proxy.heal()
        stood_at = rig.robot.robot.seq
        await rig.drive(stood_at + 5)
        assert client.session.count >= 2


# -- robots that break the page ---------------------------------------------------------------------------------------

LOCKSTEP = encode(HELLO).replace(b'"lockstep":false', b'"lockstep":true')
NO_COMMAND = CommandEcho(-1, 0.0, 0.0, True)
FRAME = encode(RobotFrame(0, 0.0, [(0.0, 0.0, 0.25)], (), (), None, (0.0, 0.0), 1.0, NO_COMMAND, ()))


@pytest.mark.parametrize(
    ("frame", "sends"),
    [
        pytest.param(b"", "nothing", id="no first frame"),
        pytest.param(FRAME.replace(b"0.25", b"NaN"), "a line that is not valid", id="NaN in each frame"),
    ],
)
@pytest.mark.parametrize("role", ["controller", "monitor"])
async def test_a_robot_without_a_valid_first_frame_is_reported_and_given_up(
    tmp_path: Path, frame: bytes, sends: str, role: Role, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lockstep, "LOCKSTEP_SILENCE_S", 0.6)
    joined = rounds = 0

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal joined, rounds
        writer.write(LOCKSTEP)
        await reader.readline()
        writer.write(encode(Joined(role=role, session=joined)))
        joined += 1
        while not reader.at_eof():
            writer.write(frame)
            rounds += 1
            try:
                async with asyncio.timeout(0.1):
                    await reader.readline()
            except TimeoutError:
                continue

    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    async with scripted(talk) as port:
        cfg = config_of(robot__port=port, robot__reconnect_timeout_s=1.0)
        client = Answering(role, cfg, tmp_path, context)
        await client.session.join(is_patient=False)
        watching = asyncio.create_task(client.loop.watch())
        if role == "controller":
            with pytest.raises(RobotTimeout, match="it accepts the session and sends no valid frame"):
                async with asyncio.timeout(DEADLINE_S):
                    await client.session.serve()
            assert joined >= 2
            assert "not even the last one again" in client.losses[0]
            assert client.reports[0].endswith(sends)
        else:  # a monitor gets no frame before a controller has joined
            await until(lambda: rounds > 10)  # longer than the silence that a controller allows
            assert joined == 1
            assert [report.endswith(sends) for report in client.reports] == ([True] if frame else [])
        watching.cancel()
        client.session.leave()
        await asyncio.gather(watching, return_exceptions=True)
    context.destroy(linger=0)
    assert not client.sent
