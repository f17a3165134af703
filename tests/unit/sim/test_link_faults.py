"""Every fault of the proxy between the client's end of the robot link and a simulated robot, by the robot's clock."""

import asyncio
import json
import socket
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest

from ccatp.config.load import load_config
from ccatp.dataloop import serve
from ccatp.onboard import server, sessions
from ccatp.sim.fault_plan import LINK_TYPES, LOCKSTEP_TYPES, parse_plan
from tests.support.daemon import LINK_DEADLINE_S as DEADLINE_S
from tests.support.daemon import Driver


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
        faults = parse_plan(plan, "plan")
        client = Driver(listener.getsockname()[1])
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(serve(cfg, lockstep=lockstep, stop=stop, listener=listener, log=log, faults=faults))
            try:
                await client.link.connect(DEADLINE_S)
                await client.until(lambda: is_over(client))
            finally:
                client.link.close()
                stop.set()
    return client, log


def reached(seq: int) -> Callable[[Driver], bool]:
    return lambda client: bool(client.lost or (client.seqs and client.seqs[-1] >= seq))


Keys = dict[str, Any]
BOTH = {"direction": "both"}
TO_CLIENT = {"direction": "to_client"}
# type: keys, what the client must have seen
TABLE: dict[str, tuple[Keys, Callable[[Driver], bool]]] = {
    # The client finds out when it reads, or when it writes.
    "reset": ({}, lambda c: "Connection reset" in c.lost or "Broken pipe" in c.lost),
    "close": ({}, lambda c: "closed" in c.lost),
    "duplicate": ({**BOTH, "every": 2}, lambda c: c.link.counts["repeated_frames"] >= 5),
    "fragment": ({**BOTH, "write_bytes": 40}, lambda c: not c.link.counts),
    "garbage": ({**TO_CLIENT, "garbage_bytes": 20, "every": 4}, lambda c: c.link.counts["bad_lines"] >= 3),
    "black_hole": (TO_CLIENT, lambda c: max(b - a for a, b in pairs(c.seqs)) > 5),
    "stall": (TO_CLIENT, lambda c: max(b - a for a, b in pairs(c.seqs)) == 1),
    "delay": (
        {**TO_CLIENT, "delay_s": 0.03, "jitter_s": 0.01},
        lambda c: max(b - a for a, b in pairs(c.seqs)) == 1 and not c.link.counts,
    ),
    "reorder": ({**TO_CLIENT, "every": 3}, lambda c: c.link.counts["repeated_frames"] >= 2),
    "flood": (
        {**TO_CLIENT, "rate_hz": 300.0, "lines": "copies"},
        lambda c: c.link.counts["repeated_frames"] >= 10,
    ),
    "slowloris": ({"direction": "to_robot", "bytes_per_s": 400.0}, lambda c: not c.link.counts),
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
    client, log = await drive(plan_of(kind, "at_s = 0.1", keys), reached(40), lockstep=False)
    assert seen(client), (client.seqs, client.lost, client.link.counts)
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


@pytest.mark.parametrize("kind", LOCKSTEP_TYPES)
@pytest.mark.parametrize("trigger", ["at_s = 0.2", "after_lines = 20", "after_bytes = 20000"])
async def test_in_lockstep_each_fault_that_makes_sense_there(
    kind: str, trigger: str, monkeypatch: pytest.MonkeyPatch
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


async def test_a_fault_that_never_began_says_so() -> None:
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
