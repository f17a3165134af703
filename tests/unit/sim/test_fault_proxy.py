"""Faults of the proxy: of connections, of lines without sockets, and each between the robot link and a robot."""

import asyncio
import contextlib
import json
import random
import socket
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import pairwise, product
from typing import Any

import pytest

from ccatp.config.load import load_config
from ccatp.dataloop import SimOutlets, StandInOptions, serve
from ccatp.onboard import server, sessions
from ccatp.sim.fault_plan import LINK_TYPES, LOCKSTEP_TYPES, parse_plan
from ccatp.sim.fault_proxy import FaultProxy, LineStage, OneWayFaults
from tests.support.daemon import LINK_DEADLINE_S, Driver, Waiting
from tests.support.scenario import begin
from tests.support.sockets import scripted

DEADLINE_S = 5.0  # what never happens in a good run may take this long in a bad one
LINES = [b"line %d of some length\n" % k for k in range(40)]
TEXT = b"".join(LINES)


class Server(Waiting):
    """Keeps what it gets, piece by piece, and sends what it is told."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.ends: list[str] = []
        self.writers: list[asyncio.StreamWriter] = []
        self.changed = asyncio.Event()
        self.is_echo = False

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writers.append(writer)
        self.changed.set()
        try:
            while data := await reader.read(65536):
                self.pieces.append(data)
                self.changed.set()
                if self.is_echo:
                    writer.write(data)
            self.ends.append("FIN")
        except ConnectionResetError:
            self.ends.append("RST")
        except ConnectionError:
            self.ends.append("lost")
        finally:
            self.changed.set()

    @property
    def text(self) -> bytes:
        return b"".join(self.pieces)


class Rig:
    """A server behind a proxy."""

    def __init__(self, server: Server, proxy: FaultProxy) -> None:
        self.server, self.proxy = server, proxy
        self.writers: list[asyncio.StreamWriter] = []

    async def connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """A client; the server has it, too."""
        before = len(self.server.writers)
        reader, writer = await asyncio.open_connection("127.0.0.1", self.proxy.port)
        self.writers.append(writer)
        await self.server.until(lambda: len(self.server.writers) > before)
        return reader, writer


@asynccontextmanager
async def rig(seed: int = 1) -> AsyncIterator[Rig]:
    server = Server()
    async with scripted(server.serve) as port, FaultProxy("127.0.0.1", port, seed=seed) as proxy:
        found = Rig(server, proxy)
        yield found
        for writer in found.writers:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()


async def passes(condition: Callable[[], bool]) -> None:
    """Let the event loop turn until the condition holds."""
    for _ in range(100_000):
        if condition():
            return
        await asyncio.sleep(0)
    pytest.fail("it never came true")


async def read(reader: asyncio.StreamReader, count: int) -> bytes:
    async with asyncio.timeout(DEADLINE_S):
        return await reader.readexactly(count)


async def rest(reader: asyncio.StreamReader) -> tuple[bytes, str]:
    """What comes until the end, and how it ends."""
    found = b""
    async with asyncio.timeout(DEADLINE_S):
        try:
            while data := await reader.read(65536):
                found += data
        except ConnectionResetError:
            return found, "RST"
    return found, "FIN"


async def test_a_server_that_is_not_there_ends_the_connection(free_port: int) -> None:
    async with FaultProxy("127.0.0.1", free_port, seed=1) as proxy:
        reader, writer = await asyncio.open_connection("127.0.0.1", proxy.port)
        assert (await rest(reader))[0] == b""
        assert proxy.counts["refused"] == 1
        writer.close()


@pytest.mark.parametrize("count", [1, 23, 24, 100, len(TEXT) - 1])
async def test_reset_after_exactly_so_many_bytes(count: int) -> None:
    async with rig() as r:
        reader, _ = await r.connect()
        r.proxy.reset_after(count)
        r.server.writers[0].write(TEXT)
        assert await rest(reader) == (TEXT[:count], "RST")
        assert r.proxy.counts["reset"] == 1


async def test_a_black_hole_one_way_swallows_data_and_the_end() -> None:
    async with rig() as r:
        reader, writer = await r.connect()
        begin(r.proxy, "black_hole", "to_robot")
        writer.write(TEXT)
        r.server.writers[0].write(b"still here\n")
        assert await read(reader, 11) == b"still here\n"  # the other way is open
        await passes(lambda: r.proxy.counts["black_hole"] == len(TEXT))
        writer.write_eof()
        r.server.writers[0].write(b"half-open\n")
        assert await read(reader, 10) == b"half-open\n"
        assert r.server.pieces == []
        assert r.server.ends == []
        r.proxy.heal("to_robot")
        await r.server.until(lambda: r.server.ends == ["FIN"])  # now it knows
        assert r.server.pieces == []


async def test_a_stall_ends_in_one_burst() -> None:
    async with rig() as r:
        reader, writer = await r.connect()
        begin(r.proxy, "stall", "to_robot")
        for line in LINES:
            writer.write(line)
            await writer.drain()
            await asyncio.sleep(0)
        r.server.writers[0].write(b"other way\n")
        assert await read(reader, 10) == b"other way\n"
        assert r.server.pieces == []
        r.proxy.heal("to_robot", "stall")
        await r.server.until(lambda: r.server.text == TEXT)
        assert r.server.pieces == [TEXT]
        assert r.proxy.counts["stall"] >= 1


def stage(seed: int = 1, **faults: dict[str, Any]) -> tuple[LineStage, OneWayFaults, Counter[str]]:
    switched: OneWayFaults = {}
    for name, keys in faults.items():
        switched[name] = LINK_TYPES[name].model_validate({"type": name, "direction": "both", **keys})
    counts: Counter[str] = Counter()
    return LineStage(switched, counts, random.Random(seed)), switched, counts


def out(line_stage: LineStage, *lines: bytes) -> list[bytes]:
    return [piece for line in lines for piece in line_stage.feed(line)]


def test_lines_are_reordered_and_none_is_lost() -> None:
    line_stage, faults, counts = stage(reorder={"every": 4})
    assert out(line_stage, *LINES[:6]) == [*LINES[:3], LINES[4], LINES[3], LINES[5]]
    assert out(line_stage, *LINES[6:9]) == LINES[6:8]  # the last one is withheld
    faults.clear()
    assert out(line_stage, LINES[9]) == [LINES[9] + LINES[8]]
    faults.update(stage(reorder={"every": 9})[1])
    assert out(line_stage, LINES[10]) == []
    assert line_stage.finish() == LINES[10]
    assert counts == {"reorder": 3}


def test_lines_are_duplicated_and_end_in_lf_alone() -> None:
    line_stage, _, counts = stage(duplicate={"every": 2})
    assert out(line_stage, b"a\rb\r\nc", b"\nd\n") == [b"a\rb\r\n", b"c\n", b"c\n", b"d\n"]
    assert counts == {"duplicate": 1}


def test_one_byte_of_a_line_is_corrupted() -> None:
    texts = []
    for seed in (1, 1, 2):
        line_stage, _, counts = stage(seed, corrupt={"every": 8})
        found = out(line_stage, TEXT)
        wrong = [k for k, line in enumerate(found) if line != LINES[k]]
        assert wrong == [7, 15, 23, 31, 39]
        assert all(sum(a != b for a, b in zip(found[k], LINES[k], strict=True)) == 1 for k in wrong)
        assert all(line.endswith(b"\n") and line.count(b"\n") == 1 for line in found)
        assert counts == {"corrupt": 5}
        texts.append(found)
    assert texts[0] == texts[1]  # of the seed
    assert texts[0] != texts[2]
    assert out(stage(corrupt={"every": 1})[0], b"\n\n") == [b"\n", b"\n"]  # an empty line stays


# -- between the client's end and a simulated robot --------------------------------------------------------------------


class Log:
    """Keeps the log lines."""

    def __init__(self) -> None:
        self.entries: list[tuple[str, dict[str, object]]] = []

    def info(self, event: str, **fields: object) -> None:
        self.entries.append((event, fields))

    def of(self, what: str) -> list[dict[str, object]]:
        return [fields for event, fields in self.entries if event == f"fault_{what}" and fields["signal"] == "link"]


async def drive(plan: str, is_over: Callable[[Driver], bool], *, lockstep: bool) -> tuple[Driver, Log]:
    """Join a robot with a plan, drive until a condition holds; what the client saw and the robot's log."""
    cfg = load_config(overrides={"run.seed": 3})
    log, stop = Log(), asyncio.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        options, outlets = StandInOptions(parse_plan(plan, "plan")), SimOutlets(log=log)
        client = Driver(listener.getsockname()[1])
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(serve(cfg, options, lockstep=lockstep, stop=stop, listener=listener, outlets=outlets))
            try:
                await client.link.connect(LINK_DEADLINE_S)
                await client.until(lambda: is_over(client))
            finally:
                client.link.close()
                stop.set()
    return client, log


def reached(seq: int) -> Callable[[Driver], bool]:
    return lambda client: bool(client.lost or (client.seqs and client.seqs[-1] >= seq))


def only_repeats(client: Driver) -> bool:
    """Nothing was wrong; on a busy machine a line of lockstep may be repeated that was only late."""
    return client.link.counts.keys() <= {"repeated_frames"}


Keys = dict[str, Any]
BOTH = {"direction": "both"}
TO_CLIENT = {"direction": "to_client"}
# type: keys, what the client must have seen
TABLE: dict[str, tuple[Keys, Callable[[Driver], bool]]] = {
    # The client finds out when it reads, or when it writes.
    "reset": ({}, lambda c: "Connection reset" in c.lost or "Broken pipe" in c.lost),
    "close": ({}, lambda c: "closed" in c.lost),
    "duplicate": ({**BOTH, "every": 2}, lambda c: c.link.counts["repeated_frames"] >= 5),
    "fragment": ({**BOTH, "write_bytes": 40}, only_repeats),
    "garbage": ({**TO_CLIENT, "garbage_bytes": 20, "every": 4}, lambda c: c.link.counts["bad_lines"] >= 3),
    "black_hole": (TO_CLIENT, lambda c: max(b - a for a, b in pairs(c.seqs)) > 5),
    "stall": (TO_CLIENT, lambda c: max(b - a for a, b in pairs(c.seqs)) == 1),
    "delay": (
        {**TO_CLIENT, "delay_s": 0.03, "jitter_s": 0.01},
        lambda c: max(b - a for a, b in pairs(c.seqs)) == 1 and only_repeats(c),
    ),
    "reorder": ({**TO_CLIENT, "every": 3}, lambda c: c.link.counts["repeated_frames"] >= 2),
    "flood": ({**TO_CLIENT, "rate_hz": 300.0, "lines": "copies"}, lambda c: c.link.counts["repeated_frames"] >= 10),
    "slowloris": ({"direction": "to_robot", "bytes_per_s": 400.0}, only_repeats),
    "corrupt": ({**TO_CLIENT, "every": 5}, lambda c: c.link.counts["bad_lines"] >= 1),
}


def pairs(frames: list[int]) -> list[tuple[int, int]]:
    return list(pairwise(frames))


def plan_of(kind: str, trigger: str, keys: Keys) -> str:
    rows = {"type": kind, **keys}
    if "direction" in keys:
        rows["for_s"] = 0.2
    return "[[link]]\n" + trigger + "\n" + "\n".join(f"{key} = {json.dumps(value)}" for key, value in rows.items())


def test_the_table_knows_every_type() -> None:
    assert set(TABLE) == set(LINK_TYPES)


@pytest.mark.parametrize("kind", TABLE)
async def test_on_the_wall_clock_each_fault_reaches_the_client_and_the_log(kind: str) -> None:
    keys, seen = TABLE[kind]
    is_far = reached(40)
    _, log = await drive(plan_of(kind, "at_s = 0.1", keys), lambda c: is_far(c) and seen(c), lockstep=False)
    (began,) = log.of("begins")
    assert (began["type"], began["at_s"], began["from_s"]) == (kind, 0.1, 0.1)
    (record,) = log.of("injected")
    assert (record["signal"], record["type"]) == ("link", kind)
    count = record["samples"]
    assert isinstance(count, int)
    assert count > 0
    if "direction" in keys:
        (ended,) = log.of("ended")
        assert ended["until_s"] == pytest.approx(0.3, abs=0.011)


@pytest.mark.parametrize(
    ("trigger", "kind"),
    [
        *(("at_s = 0.2", kind) for kind in LOCKSTEP_TYPES),
        *product(("after_lines = 20", "after_bytes = 20000"), ("reset", "fragment")),  # an instant, and what lasts
    ],
)
async def test_in_lockstep_each_fault_that_makes_sense_there(
    trigger: str, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sessions, "REPEAT_S", 0.4)  # of a line that is lost
    monkeypatch.setattr(server, "HOUSEKEEPING_S", 0.02)
    keys, seen = TABLE[kind]
    client, log = await drive(plan_of(kind, trigger, keys), reached(100), lockstep=True)
    assert seen(client), (client.seqs, client.lost, client.link.counts)
    assert client.seqs == list(range(len(client.seqs)))  # simulated time waited for each
    (record,) = log.of("injected")
    assert isinstance(record["samples"], int)
    assert record["samples"] > 0


async def test_a_fault_that_never_began_is_reported() -> None:
    client, log = await drive('[[link]]\ntype = "reset"\nat_s = 99.0', reached(20), lockstep=True)
    assert not client.lost
    assert log.of("begins") == []
    (record,) = log.of("injected")
    assert (record["from_s"], record["samples"]) == (None, 0)


async def test_faults_of_robot_and_link_in_one_plan() -> None:
    plan = '[[fault]]\nsignal = "frames"\ntype = "drop"\nevery = 2\nat_s = 0.1\nfor_s = 0.1\n'
    client, log = await drive(
        plan + plan_of("fragment", "at_s = 0.1", TABLE["fragment"][0]), reached(60), lockstep=True
    )
    assert len(client.seqs) == len(range(client.seqs[-1] + 1)) - 5
    injected = [(fields["signal"], fields["type"]) for event, fields in log.entries if event == "fault_injected"]
    assert injected == [("frames", "drop"), ("link", "fragment")]
