"""Our own robot keeps every promise of the interface page, and the command that says so."""

import asyncio
import json
import re
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from ccatp.cli import main
from ccatp.commissioning.conformance.runner import CHECKS, Conformance, Result, check_ids
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.mirror.mirror import Mirror, build_mirror
from tests.contract.crooked import HONEST, Crooked, checked, clock, serving
from tests.faults.table import conformance_rows, load_table
from tests.support.scenario import SurveyLoop

KEY = b"secret"
PATIENT_S = 10.0  # an answer takes milliseconds; a loaded machine may take this long
PARTS = 4  # run side by side, each on a robot of its own
NEEDS = {check.check_id: check.needs for check in CHECKS}


class Served(NamedTuple):
    """A robot that keeps all promises."""

    config: Config
    key: bytes | None = None
    mirror: Mirror | None = None
    crooked: Crooked = HONEST


def expected(lockstep: bool, robot: Served) -> set[str]:
    """The checks that do not apply."""
    lacking = {"real time" if lockstep else "lockstep", *(() if robot.key else ("hmac",))}
    others = {"mirror"} if robot.mirror is None else set()
    others |= set() if robot.config.mirror.overhang else {"fan-floor"}
    return {name for name, needs in NEEDS.items() if lacking & set(needs)} | others


def judge(results: list[Result], not_applicable: set[str]) -> None:
    assert [result for result in results if result.outcome == "fail"] == []
    assert {result.check_id for result in results if result.outcome == "not applicable"} == not_applicable


# With a fan floor, a key, disturbances and delays; with old frames, a wrong clock, sensors at other rates.
OVERHANGING = load_config(overrides={"run.mirror": "fyst-m2", "run.world": "extreme"})
HANGING = Served(OVERHANGING, KEY, build_mirror(OVERHANGING.mirror))
RATES = {"sim.robot.imu_hz": 50.0, "sim.robot.encoder_hz": 80.0, "sim.robot.edge_hz": 30.0}
OLD = load_config(overrides=RATES | {"run.world": "hard", "world.sensors_delay_s": 0.12})
LATE = [
    Served(OLD, crooked=Crooked("slow clock", says=clock(lambda t_s: 0.99 * t_s))),
    Served(OLD, crooked=Crooked("fast clock", says=clock(lambda t_s: 1.01 * t_s))),
]


async def keep_all_promises(lockstep: bool, *robots: Served) -> None:
    """Each part of the checks on a robot of its own."""
    slow = ["take-over", "join-late"]  # the longest, by themselves
    others = [name for name in check_ids() if name not in slow]
    parts = [*([name] for name in slow), *(others[k::PARTS] for k in range(PARTS))]
    for robot in robots:
        runs = [
            checked(
                robot.config, part, lockstep=lockstep, timeout_s=PATIENT_S, key=robot.key, crooked=robot.crooked,
                mirror=robot.mirror,
            )
            for part in parts
        ]  # fmt: skip
        results = [result for part in await asyncio.gather(*runs) for result in part]
        assert sorted(result.check_id for result in results) == sorted(check_ids())
        judge(results, expected(lockstep, robot))


@pytest.mark.fault(*conformance_rows(load_table()), part="robot")
async def test_our_robots_in_lockstep() -> None:
    await keep_all_promises(True, Served(load_config()), HANGING)


@pytest.mark.fault(*conformance_rows(load_table()), part="robot")
async def test_our_robots_on_the_wall_clock() -> None:
    await keep_all_promises(False, Served(load_config()), HANGING)


async def test_old_frames_wrong_clocks_and_other_rates_break_no_promise() -> None:
    await keep_all_promises(False, *LATE)


async def run_on(port: int, motion: bool, only: tuple[str, ...] = ()) -> list[Result]:
    """Results of the checks on a robot that is there already."""
    return await asyncio.to_thread(
        lambda: Conformance(("127.0.0.1", port), None, PATIENT_S).run(motion=motion, only=only)
    )


async def test_the_robot_is_left_held_and_its_fans_as_they_were(config: Config) -> None:
    loops: list[SurveyLoop] = []
    crooked = Crooked("seen from within", twist=loops.append)
    async with serving(config, lockstep=False, crooked=crooked) as port:
        robot = loops[0].robot
        robot.fans.duty = (0.31, 0.33)
        results = await run_on(port, True, ("fans", "fans-rst", "newest-fans", "move-turn"))
        robot.advance()
        assert robot.rules.is_held
        assert robot.fans.duty == pytest.approx((0.31, 0.33))
    assert [result.outcome for result in results] == ["pass"] * 4


async def test_no_motion_turns_no_wheel(config: Config) -> None:
    heard: list[bytes] = []

    def hears(data: bytes, _: object) -> bytes:
        heard.append(data)
        return data

    listening = Crooked("heard", hears=hears)
    drives = ("echo", "newest-drive", "fans-rst", "no-json", "nan", "many-lines", "single-bytes", "lockstep-drive")
    only = (*drives, *(name for name, needs in NEEDS.items() if "motion" in needs))
    async with serving(config, lockstep=True, crooked=listening) as port:
        results = await run_on(port, False, only)
    sent = b"".join(heard)
    assert sent.count(b'"drive"') > 100
    assert not re.search(rb'"w[rl]":"?-?[0.]*[1-9]', sent)
    left_out = [result for result in results if "motion" in NEEDS[result.check_id]]
    assert {(result.outcome, result.detail) for result in left_out} == {("not applicable", "--no-motion")}


async def test_a_hello_of_no_use_fails_its_check_and_stops_the_others(config: Config) -> None:
    def says(message: dict[str, object], _: object) -> dict[str, object]:
        if message["type"] == "hello":
            message["ttl_s"] = "0.25"
        return message

    crooked = Crooked("ttl as text", says=says)
    results = await checked(config, lockstep=True, timeout_s=PATIENT_S, crooked=crooked)
    assert [(r.check_id, r.detail) for r in results if r.outcome == "fail"] == [("hello", "ttl_s = '0.25'")]
    assert [r.check_id for r in results if r.outcome == "pass"] == ["hello-robot"]
    assert results[2].detail == "the hello is of no use: ttl_s = '0.25'"


# -- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def robot(config: Config, request: pytest.FixtureRequest) -> Iterator[str]:
    """A robot in lockstep, in a thread of its own, with a key or a fault where a test names one; its address."""
    yield from _in_a_thread(config, *getattr(request, "param", (HONEST, None)))


def _on_fire(message: dict[str, object], _: object) -> dict[str, object]:
    return message | {"faults": ["on_fire"]} if message["type"] == "sensors" else message


broken = pytest.mark.parametrize("robot", [(Crooked("on fire", says=_on_fire), None)], indirect=True, ids=["broken"])
locked = pytest.mark.parametrize("robot", [(HONEST, KEY)], indirect=True, ids=["locked"])


def _in_a_thread(config: Config, crooked: Crooked, key: bytes | None) -> Iterator[str]:
    ready, over = threading.Event(), threading.Event()
    port = 0

    async def serve() -> None:
        nonlocal port
        async with serving(config, lockstep=True, crooked=crooked, key=key) as port:
            ready.set()
            await asyncio.to_thread(over.wait)

    thread = threading.Thread(target=lambda: asyncio.run(serve()))
    thread.start()
    try:
        assert ready.wait(PATIENT_S)
        yield f"127.0.0.1:{port}"
    finally:
        over.set()
        thread.join()


def test_json_alone_on_standard_output(robot: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", robot, "--json", "--only", "hello", "--only", "move-turn", "--only", "mac"]) == 0
    captured = capsys.readouterr()
    result = json.loads(captured.out)
    assert (result["server"], result["passed"], result["failed"]) == (robot, 2, 0)
    assert [list(check) for check in result["checks"]] == [["id", "promise", "result", "detail"]] * 3
    assert [(check["id"], check["result"]) for check in result["checks"]] == [
        ("hello", "pass"), ("mac", "not applicable"), ("move-turn", "pass"),
    ]  # fmt: skip
    assert "wheels will turn in 1 checks, each at most 0.5 rad/s (15 mm/s)" in captured.err


@broken
def test_the_table(robot: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", robot, "--no-motion", "--only", "boot", "--only", "frames-faults"]) == 1
    captured = capsys.readouterr()
    boot, faults, last = captured.out.splitlines()
    assert re.fullmatch(r"boot +ok +boot \d+ on 8 connections", boot)
    promised = "promised: faults holds names out of the page's list"
    assert re.fullmatch(rf"frames-faults +FAIL +seen: faults\[0\] = 'on_fire'; {promised}", faults)
    assert last == "1 passed, 1 failed, 0 not applicable"
    assert captured.err == ""


@locked
def test_a_key(robot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", robot, "--no-motion"]) == 2
    assert "asks for a key: name its file with --key" in capsys.readouterr().err
    assert main(["conformance", robot, "--key", str(tmp_path / "none")]) == 2
    assert "--key: cannot read" in capsys.readouterr().err
    key_file = tmp_path / "key"
    key_file.write_bytes(KEY + b"\n")
    assert main(["conformance", robot, "--key", str(key_file), "--only", "mac", "--only", "mac-wrong"]) == 0


def test_another_program_drives(robot: str, capsys: pytest.CaptureFixture[str]) -> None:
    host, _, port = robot.partition(":")
    with socket.create_connection((host, int(port))) as other, other.makefile("rb") as lines:
        lines.readline()
        other.sendall(b'{"type":"join","role":"controller","client":"main"}\n')
        assert b"joined" in lines.readline()
        assert main(["conformance", robot, "--no-motion", "--timeout", "0.3"]) == 5
    assert "another program drives the robot" in capsys.readouterr().err


def test_nobody_there(free_port: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", f"127.0.0.1:{free_port}"]) == 5
    assert f"no server at 127.0.0.1:{free_port}: Connection refused" in capsys.readouterr().err


@pytest.mark.parametrize(("first", "said"), [(b"SSH-2.0-OpenSSH\n", "says 'SSH-2.0-OpenSSH'"), (b"", "says nothing")])
def test_another_kind_of_server(first: bytes, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def greet() -> None:
            peer, _ = listener.accept()
            with peer:
                peer.sendall(first)

        thread = threading.Thread(target=greet)
        thread.start()
        assert main(["conformance", f"127.0.0.1:{listener.getsockname()[1]}"]) == 5
        thread.join()
    assert said in capsys.readouterr().err
