"""What a bad link or a bad peer does to the daemon's end of the robot link, and to the robot's."""

import asyncio
import random
import socket
import statistics
import threading
import time
import tracemalloc
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager

import numpy as np
import pytest

from ccatp.links.robot_codec import BadLineLimit, RobotFrame, encode
from ccatp.links.robot_link import BACKLOG_S, FLOOD_FACTOR, RobotLink, RobotTimeout, WrongProtocol
from ccatp.links.robot_messages import PROTOCOL, CommandEcho, Sensors
from ccatp.sim.fault_proxy import FaultProxy
from tests.faults.linking import Measured
from tests.support.daemon import HELLO, Driver, at_work, link_to, robot_behind_proxy
from tests.support.daemon import LINK_DEADLINE_S as DEADLINE_S
from tests.support.scenario import ServedRobot, SurveyLoop, begin, config_of, mirror_of
from tests.unit.links.test_robot_link import robot

FRAMES = 60
KEY = b"secret"
JOIN = b'{"type":"join","role":"controller","client":"test"}\n'
JOINED = b'{"type":"joined","role":"controller","session":1}\n'


def frame(seq: int, samples: int = 10) -> bytes:
    t_s = seq / 100.0
    wheels = [(t_s + 1e-3 * k, 1.0 + 1e-9 * seq, 1.0) for k in range(samples)]
    echo = CommandEcho(seq, 0.0, 0.0, False)
    return encode(RobotFrame(seq, t_s, [(t_s, 0.1, 0.2)], wheels, (), None, (0.8, 0.8), 1.0, echo, ()))


@asynccontextmanager
async def driving(*, lockstep: bool) -> AsyncIterator[tuple[SurveyLoop, FaultProxy, Driver]]:
    """A robot, a proxy before it that may be told to misbehave, and who drives."""
    async with robot_behind_proxy(lockstep=lockstep) as (loop, proxy):
        driver = Driver(proxy.port)
        await driver.link.connect(DEADLINE_S)
        yield loop, proxy, driver
        driver.link.close()


# -- what TCP or a proxy may do to whole messages ---------------------------------------------------------------------


@pytest.mark.fault("S14")
async def test_frames_that_come_twice_leave_the_pose_as_it_is(measured: Measured) -> None:
    drivers = []
    for is_disturbed in (False, True):
        async with driving(lockstep=True) as (_, proxy, driver):
            if is_disturbed:
                begin(proxy, "duplicate", "both", every=1)
            await driver.drive(FRAMES)
        assert not driver.lost
        drivers.append(driver)
    clean, twice = drivers
    assert twice.link.counts["repeated_frames"] >= FRAMES - 1
    assert twice.seqs == list(range(len(twice.seqs)))
    measured("S14", twice.pose != clean.pose)


@pytest.mark.fault("S14")
async def test_frames_out_of_order_never_reach_the_localizer() -> None:
    async with driving(lockstep=False) as (_, proxy, driver):
        begin(proxy, "reorder", "to_client", every=3)
        await driver.drive(FRAMES)
        assert proxy.counts["reorder"] >= 5
        assert driver.link.counts["repeated_frames"] >= 5
        assert driver.seqs == sorted(set(driver.seqs))
        assert driver.localizer.counts["stale_frames"] == 0


@pytest.mark.fault("S15")
async def test_a_damaged_line_costs_itself_alone(measured: Measured) -> None:
    async with driving(lockstep=False) as (_, proxy, driver):
        begin(proxy, "corrupt", "to_client", every=10)  # ten a second; more than twenty would end the session
        await driver.drive(2 * FRAMES)
        assert not driver.lost
        assert proxy.counts["corrupt"] >= 8
        assert driver.link.counts["bad_lines"] >= 5  # a digit may have become another digit: a valid line
        gaps = [b - a - 1 for a, b in zip(driver.seqs, driver.seqs[1:], strict=False)]
        measured("S15", max(gaps))
        assert sum(gaps) <= proxy.counts["corrupt"]


# -- floods and trickles ----------------------------------------------------------------------------------------------


class Timed(RobotLink):
    """Notes the processor time of each pass of the event loop that serves the link."""

    passes_s: list[float]

    def data_received(self, data: bytes) -> None:
        begun = time.thread_time()
        super().data_received(data)
        self.passes_s.append(time.thread_time() - begun)


@contextmanager
def flooding_robot() -> Iterator[int]:
    """A robot that sends valid frames as fast as the client takes them, from a thread of its own."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(DEADLINE_S)

        def flood() -> None:
            peer, _ = listener.accept()
            with peer:
                peer.settimeout(DEADLINE_S)
                try:
                    peer.sendall(encode(HELLO))
                    peer.recv(4096)
                    peer.sendall(JOINED)
                    for block in range(8000):
                        peer.sendall(b"".join(frame(25 * block + k) for k in range(25)))
                except ConnectionError:
                    return

        thread = threading.Thread(target=flood)
        thread.start()
        try:
            yield listener.getsockname()[1]
        finally:
            thread.join(DEADLINE_S)
            assert not thread.is_alive()


async def flooded(kind: type[RobotLink]) -> tuple[RobotLink, list[int], str]:
    """A flooded link, the frames that came through, and why it ended."""
    seqs: list[int] = []
    over: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    with flooding_robot() as port:
        link = link_to(port, kind=kind, on_sensors=lambda sensors, _: seqs.append(sensors.seq), on_lost=over.set_result)
        if isinstance(link, Timed):
            link.passes_s = []
        await link.connect(DEADLINE_S)
        async with asyncio.timeout(DEADLINE_S):
            why = await over
    return link, seqs, why


@pytest.mark.fault("L4")
async def test_a_flood_ends_its_session_and_the_event_loop_keeps_its_turns(measured: Measured) -> None:
    link, seqs, why = await flooded(Timed)
    assert "flood" in why
    assert isinstance(link, Timed)
    limit = BACKLOG_S * HELLO.frame_hz
    assert 0 < len(seqs) <= limit * 1.5
    measured("L4", 1e3 * float(np.quantile(link.passes_s, 0.999)))


@pytest.mark.fault("L4")
async def test_a_flood_takes_no_memory(measured: Measured) -> None:
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        await flooded(RobotLink)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # The flooder's own block and the socket's buffer are in it.
    measured("L4", (peak - before) / (1 << 20), "MiB")


def test_what_piled_up_in_half_a_minute_is_no_flood() -> None:
    budget = BadLineLimit(30.0 * 100.0, 3.0 * 100.0)
    assert budget.take(2999, 100.0)  # at once, after a stall
    assert all(budget.take(1, 100.0 + 0.01 * k) for k in range(1000))
    assert all(budget.take(3, 110.0 + 0.01 * k) for k in range(3000))
    assert not budget.take(3001, 1000.0)
    assert not budget.take(1, 1000.0)
    assert FLOOD_FACTOR == 3.0


@pytest.mark.fault("L6")
def test_a_client_that_trickles_is_closed_in_time_and_nobody_else_notices(measured: Measured) -> None:
    served = ServedRobot(config_of(), mirror_of(), lockstep=False)
    begun_s = served.now_s
    driver, trickler = served.client(JOIN), served.client()
    text, closed_s = JOIN.replace(b"controller", b"monitor"), None
    for k in range(1, 400):
        served.run(0.01)
        driver.drive(k, 0, 1.0, 1.0)
        if not trickler.is_closed and k % 100 == 0:
            trickler.send(text[k // 100 : k // 100 + 1])  # a byte a second
        if k % 25 == 0:
            served.server.check_time(served.now_s)
        if trickler.is_closed and closed_s is None:
            closed_s = served.now_s - begun_s
    assert closed_s is not None
    measured("L6", closed_s)
    assert b"bad join" in trickler.sent
    assert driver.sent.count(b'"type":"sensors"') == served.frames > 300
    assert not served.robot.rules.is_held


@pytest.mark.fault("L6")
async def test_a_robot_that_trickles_is_given_up() -> None:
    async def trickle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for byte in encode(HELLO):
            writer.write(bytes([byte]))
            if reader.at_eof():
                break
            await asyncio.sleep(0.02)

    async with robot(trickle) as (link, _):
        with pytest.raises(RobotTimeout, match="no answer from the robot"):
            await link.connect(0.2)


# -- who is not who they should be ------------------------------------------------------------------------------------


@pytest.mark.fault("L8")
def test_a_thousand_connections_do_not_disturb_the_controller(measured: Measured) -> None:
    """Every frame and every set point is as without them; what they cost is their own processor time."""
    costs_s: list[float] = []

    def drive(rogues: int) -> bytes:
        served = ServedRobot(config_of(), mirror_of())
        client = served.client(JOIN)
        for k in range(100):
            begun = time.thread_time()
            for _ in range(rogues):
                rogue = served.client(random.choice((JOIN, b"\xff\n", b"GET / HTTP/1.1\r\n")))
                served.server.lost(rogue)
            costs_s.append(time.thread_time() - begun)
            served.now_s += 0.01
            client.drive(k, served.robot.delivered_seq, 1.0, 0.9)
        return client.sent.partition(b"\n")[2]

    alone, crowded = drive(0), drive(10)  # of 10 ms each: 1000 a second
    assert alone == crowded
    assert crowded.count(b'"type":"sensors"') == 101
    measured("L8", 1e3 * float(np.quantile(costs_s, 0.99)) / 10)


@pytest.mark.fault("L9")
async def test_a_recorded_session_opens_no_door(measured: Measured) -> None:
    accepted = 0
    async with robot_behind_proxy(lockstep=True, key=KEY) as (loop, proxy):
        driver = Driver(proxy.port, KEY)
        recorded: list[bytes] = []
        send = driver.link.send_raw

        def send_and_keep(data: bytes) -> None:
            recorded.append(data)
            send(data)

        driver.link.send_raw = send_and_keep  # type: ignore[method-assign]
        await driver.link.connect(DEADLINE_S)
        await driver.drive(20)
        driver.link.close()
        assert b'"mac"' in recorded[0]
        session = b"".join(recorded)
        guesses = [session, session.replace(b'"controller"', b'"monitor"'), session.replace(b'"mac":"', b'"mac":"0')]
        guesses += [b"".join(recorded[1:]), recorded[0].replace(b'"test"', b'"main"')]
        while not loop.robot.rules.is_held or proxy.connections:
            await asyncio.sleep(0.001)  # the last of its drives and its end are on their way
            loop.robot.rules.set_points(loop.robot.t_s)
        before = loop.counts["refused"], loop.robot.seq
        for guess in guesses:
            reader, writer = await asyncio.open_connection("127.0.0.1", proxy.port)
            writer.write(guess)
            async with asyncio.timeout(DEADLINE_S):
                answer = await reader.read()
            accepted += b'"joined"' in answer
            assert b'"refused"' in answer
            writer.close()
            await writer.wait_closed()
        assert loop.counts["refused"] == before[0] + len(guesses)
        assert loop.robot.seq == before[1]
    measured("L9", accepted)


@pytest.mark.fault("L9")
async def test_commands_that_come_again_are_dropped() -> None:
    async with driving(lockstep=True) as (loop, proxy, driver):
        begin(proxy, "duplicate", "to_robot", every=1)
        await driver.drive(FRAMES)
        assert loop.counts["stale"] >= FRAMES - 5


@pytest.mark.fault("L12")
@pytest.mark.parametrize(
    "protocol",
    ["ccatp-robot/2", "ccatp-robot/0", "ccatp-robot/10", "ccatp-robot/1.1", "ccatp-robot", "CCATP-ROBOT/1", "other/1",
     "", " ccatp-robot/1", "ccatp-robot/1\u200b"],
)  # fmt: skip
async def test_no_other_version_is_joined(protocol: str, measured: Measured) -> None:
    received: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()

    async def speak(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(encode(HELLO).replace(PROTOCOL.encode(), protocol.encode()))
        received.set_result(await reader.read())

    async with robot(speak) as (link, _):
        with pytest.raises(WrongProtocol, match="this program ccatp-robot/1"):
            await link.connect(DEADLINE_S)
        async with asyncio.timeout(DEADLINE_S):
            measured("L12", 100.0 if await received == b"" else 0.0)  # no join, no command


# -- small messages ---------------------------------------------------------------------------------------------------


async def round_trips(count: int) -> list[float]:
    """Times from a frame to the next one in lockstep: our answer's way, the robot's step, the frame's way."""
    times_s: list[float] = []
    done = asyncio.Event()

    def on_sensors(frame: Sensors, _: bytes) -> None:
        times_s.append(time.perf_counter())
        link.send_drive(frame.seq + 1, frame.seq, 0.0, 0.0)
        if len(times_s) > count:
            done.set()

    async with at_work(SurveyLoop(config_of(), lockstep=True)) as port:
        link = link_to(port, on_sensors=on_sensors, on_lost=lambda _: done.set())
        await link.connect(DEADLINE_S)
        async with asyncio.timeout(DEADLINE_S):
            await done.wait()
        link.close()
    return list(np.diff(times_s))


@pytest.mark.fault("L10")
async def test_answers_do_not_wait_for_more_to_send(measured: Measured) -> None:
    """With small messages held back each round trip would take 40 ms; the median does not mind a busy machine."""
    measured("L10", 1e3 * statistics.median(await round_trips(200)))


@pytest.mark.slow
@pytest.mark.fault("L10")
async def test_99_of_100_round_trips(measured: Measured) -> None:
    measured("L10", 1e3 * float(np.quantile(await round_trips(5000), 0.99)))
