"""The DataLoop over real sockets: what a peer that only read the interface control document meets."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ccatp import dataloop
from ccatp.config.models import Config
from ccatp.daemon.loops import sim_robot
from ccatp.dataloop import DataLoop, SimOutlets, StandInOptions, serve, survey_robot
from ccatp.links.robot_messages import Sensors
from tests.support.daemon import at_work, link_to
from tests.support.scenario import SurveyLoop, any_port, config_of
from tests.support.sockets import DEADLINE_S, Peer

JOIN = b'{"type":"join","role":"controller","client":"peer"}\n'
JOIN_MONITOR = b'{"type":"join","role":"monitor","client":"peer"}\n'


class RobotPeer(Peer):
    """A plain socket that talks to a robot."""

    async def message(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(await self.line())
        return found

    async def expect(self, kind: str) -> dict[str, Any]:
        """The next message, which has this type."""
        message = await self.message()
        assert message["type"] == kind, message
        return message

    def drive(self, seq: int, ack: int, right: float = 3.0, left: float = 3.0) -> None:
        self.writer.write(b'{"type":"drive","seq":%d,"ack":%d,"wr":%r,"wl":%r}\n' % (seq, ack, right, left))


class Notes:
    """The log of a DataLoop."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._more = asyncio.Event()

    def info(self, event: str, **fields: object) -> None:
        self.lines.append(str(fields.get("text", event)))
        self._more.set()

    async def until(self, line: str) -> None:
        """Wait for a line, and forget it and all before it."""
        async with asyncio.timeout(DEADLINE_S):
            while line not in self.lines:
                self._more.clear()
                await self._more.wait()
        del self.lines[: self.lines.index(line) + 1]


class Rig:
    """A running DataLoop."""

    def __init__(self, loop: DataLoop, port: int, notes: Notes) -> None:
        self.loop, self.port, self.notes = loop, port, notes
        self._peers: list[RobotPeer] = []

    async def peer(self, first: bytes = b"") -> RobotPeer:
        peer = RobotPeer(*await asyncio.open_connection("127.0.0.1", self.port))
        self._peers.append(peer)
        if first:
            await peer.expect("hello")
            peer.writer.write(first)
        return peer

    async def close(self) -> None:
        for peer in self._peers:
            peer.writer.close()
        for peer in self._peers:
            try:
                await peer.writer.wait_closed()
            except ConnectionError:
                continue


@asynccontextmanager
async def running(config: Config, *, lockstep: bool = True) -> AsyncIterator[Rig]:
    notes = Notes()
    loop = SurveyLoop(config, lockstep=lockstep, log=notes)
    async with at_work(loop) as port:
        rig = Rig(loop, port, notes)
        yield rig
        await rig.close()


# -- malformed lines --------------------------------------------------------------------------------------------------


@pytest.mark.fault("L7")
async def test_a_line_of_a_megabyte(config: Config) -> None:
    async with running(config, lockstep=False) as rig:
        holder = await rig.peer(JOIN)
        await holder.expect("joined")
        for first in (b"", JOIN_MONITOR):
            rogue = await rig.peer(first)
            rogue.writer.write(b"x" * 1_000_000)
            assert await rogue.is_closed()
        assert rig.loop.counts["oversized_lines"] == 2
        assert (await holder.expect("sensors"))["seq"] > 0


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(noise=st.lists(st.binary(max_size=200), max_size=20))
def test_fuzz(config: Config, noise: list[bytes]) -> None:
    """Random bytes between good commands: the good ones work, or the session is closed; the robot goes on."""

    async def story() -> None:
        async with running(config) as rig:
            peer = await rig.peer(JOIN)
            await peer.expect("joined")
            await peer.expect("sensors")
            for k, junk in enumerate(noise):
                if peer.reader.at_eof():
                    break
                peer.writer.write(junk.replace(b"\n", b"") + b"\n")
                peer.drive(k, k)
                line = await peer.line()
                while line and json.loads(line)["seq"] == k:  # repeated, because the answer took long
                    line = await peer.line()
                assert line == b"" or json.loads(line)["seq"] == k + 1
            await rig.peer()

    asyncio.run(story())


# -- keys, sessions, fans ---------------------------------------------------------------------------------------------


async def test_a_session_is_lost_with_its_fin_however_much_its_client_has_not_read(config: Config) -> None:
    async with running(config) as rig:
        peer = await rig.peer(JOIN)
        await peer.expect("joined")
        next(iter(rig.loop.connections)).write(
            b"x" * 20_000_000
        )  # more than the kernel keeps for a client that is deaf
        peer.writer.write_eof()
        await rig.notes.until("controller lost: wheels held")


# -- determinism ------------------------------------------------------------------------------------------------------


async def _drive_through(config: Config, frames: int) -> list[bytes]:
    """Our own two clients, driving until frame ``frames``; every line of the controller."""
    lines: list[bytes] = []
    over = asyncio.Event()
    async with running(config) as rig:

        def on_frame(sensors: Sensors, line: bytes) -> None:
            lines.append(line)
            if sensors.seq == frames:
                over.set()
                return
            speed = 3.0 if sensors.seq % 200 < 100 else -2.0
            controller.send_drive(sensors.seq, sensors.seq, speed, speed - 0.1 * (sensors.seq % 7))

        def on_monitored(sensors: Sensors, line: bytes) -> None:
            monitor.send_permit(sensors.seq, sensors.seq, True, True, sensors.seq % 50 != 0)

        controller, monitor = (
            link_to(rig.port, on_sensors=on_frame),
            link_to(rig.port, "monitor", on_sensors=on_monitored),
        )
        await monitor.connect(DEADLINE_S)
        await controller.connect(DEADLINE_S)
        async with asyncio.timeout(DEADLINE_S):
            await over.wait()
        assert not controller.counts
        assert not monitor.counts
        controller.close()
        monitor.close()
    return lines


@pytest.mark.parametrize("world", ["thesis", "extreme"])
async def test_the_same_seed_gives_the_same_bytes(world: str) -> None:
    cfg = config_of(run__world=world)
    first = await _drive_through(cfg, 300)
    assert [json.loads(line)["seq"] for line in first] == list(range(301))
    assert await _drive_through(cfg, 300) == first
    assert await _drive_through(config_of(run__world=world, run__seed=cfg.run.seed + 1), 300) != first


# -- a fall -----------------------------------------------------------------------------------------------------------


async def test_a_fall_is_reported_to_the_program_that_started_the_robot_and_not_on_the_link(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    robot = survey_robot(config_of())
    monkeypatch.setattr(dataloop, "survey_robot", lambda *_: robot)
    stop, listener = asyncio.Event(), any_port()
    logged: list[dict[str, object]] = []

    class Log:
        def info(self, event: str, **fields: object) -> None:
            if event == "robot_fell":
                logged.append(fields)
                stop.set()

    serving = serve(
        config_of(), StandInOptions(), lockstep=False, stop=stop, listener=listener, outlets=SimOutlets(log=Log())
    )
    task = asyncio.create_task(serving)
    peer = RobotPeer(*await asyncio.open_connection(*listener.getsockname()))
    peer.writer.write(JOIN)
    await peer.message()
    robot.world.displace(50.0, 0.0, 0.0)
    async with asyncio.timeout(DEADLINE_S):
        assert await task
    (fell,) = logged
    assert fell["cause"] == "rim"
    assert b"fell" not in await peer.reader.read()
    peer.writer.close()


def test_the_status_after_a_fall(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(sim_robot, "serve", AsyncMock(side_effect=[True, False]))
    cfg = config_of(sim__robot__port=0)
    tmp_path.chmod(0o700)
    assert sim_robot.run_alone(cfg, lockstep=True, runtime_dir=tmp_path) == 4
    assert "the simulated robot fell" in capsys.readouterr().err
    assert sim_robot.run_alone(cfg, lockstep=True, runtime_dir=tmp_path) == 0


async def test_an_unforeseen_error_ends_the_loop_aloud(config: Config) -> None:
    for lockstep in (True, False):
        loop = SurveyLoop(config, lockstep=lockstep)
        port = await loop.start()

        def fail() -> None:
            raise RuntimeError("surprise")

        loop.robot.advance = fail  # type: ignore[method-assign]
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(JOIN + b'{"type":"drive","seq":0,"ack":0,"wr":1,"wl":1}\n')
        with pytest.raises(RuntimeError, match="surprise"):
            async with asyncio.timeout(DEADLINE_S):
                await loop.run(asyncio.Event())
        writer.close()
        await writer.wait_closed()


async def test_a_client_that_does_not_read_is_skipped_and_finds_the_newest_later(config: Config) -> None:
    async with running(config) as rig:
        deaf = await rig.peer(JOIN_MONITOR)
        await deaf.expect("joined")
        connection = next(iter(rig.loop.connections))
        connection.pause_writing()
        connection.write(b"lost\n")
        connection.resume_writing()
        connection.write(b'{"type":"kept"}\n')
        await deaf.expect("kept")
