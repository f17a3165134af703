"""Our own robot keeps every promise of the interface page; the command that says so; how frames are judged."""

import json
import re
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ccatp.cli import main
from ccatp.commissioning.conformance import runner
from ccatp.commissioning.conformance.command_checks import check_lost, other_duty
from ccatp.commissioning.conformance.harness import (
    CheckContext,
    CheckFailed,
    ControllerAndMonitor,
    Facts,
    Frame,
    NotApplicable,
    parse,
)
from ccatp.commissioning.conformance.motion_checks import mean_rates
from ccatp.commissioning.conformance.runner import CHECKS, Conformance, check_ids
from ccatp.commissioning.conformance.server_checks import check_clock, check_edges, check_gravity, line_fault
from ccatp.config.models import Config
from ccatp.mirror.mirror import Mirror
from tests.contract.defects import CORRECT, TIMEOUT_S, Defect, Middle, checked, clock, serving
from tests.faults.table import conformance_rows, load_table
from tests.support.command import refused
from tests.support.scenario import config_of, mirror_of

KEY = b"secret"
NEEDS = {check.check_id: check.needs for check in CHECKS}


class Served(NamedTuple):
    """A robot that keeps all promises."""

    config: Config
    key: bytes | None = None
    mirror: Mirror | None = None
    broken: Defect = CORRECT


def expected(lockstep: bool, robot: Served) -> set[str]:
    """The checks that do not apply."""
    lacking = {"real time" if lockstep else "lockstep", *(() if robot.key else ("hmac",))}
    others = {"mirror"} if robot.mirror is None else set()
    others |= set() if robot.config.mirror.overhang else {"fan-floor"}
    return {name for name, needs in NEEDS.items() if lacking & set(needs)} | others


# With a fan floor, a key, disturbances and delays; with old frames, a wrong clock, sensors at other rates.
OVERHANGING = config_of("fyst-m2", run__world="extreme")
PLAIN = Served(config_of())
HANGING = Served(OVERHANGING, KEY, mirror_of("fyst-m2"))
# The on-board core with motors, under a rigid body; against the slope these motors do not reach 8 rad/s.
HEAVY_CONFIG = config_of("fyst-m2", sim__robot__physics="mujoco", robot__max_wheel_rad_s=6.0)
HEAVY = Served(HEAVY_CONFIG, mirror=mirror_of("fyst-m2"))
RATES = {"sim__robot__imu_hz": 50.0, "sim__robot__encoder_hz": 80.0, "sim__robot__edge_hz": 30.0}
OLD = config_of(**RATES, run__world="hard", world__sensors_delay_s=0.12)  # type: ignore[arg-type]


def keep_all_promises(lockstep: bool, robot: Served, only: tuple[str, ...] = ()) -> None:
    results = checked(robot.config, only, lockstep=lockstep, key=robot.key, broken=robot.broken, mirror=robot.mirror)
    assert [result.check_id for result in results] == [name for name in check_ids() if name in (only or check_ids())]
    assert [result for result in results if result.outcome == "fail"] == []
    not_applicable = {result.check_id for result in results if result.outcome == "not applicable"}
    assert not_applicable == expected(lockstep, robot) & {result.check_id for result in results}


@pytest.mark.fault(*conformance_rows(load_table()), part="robot")
@pytest.mark.parametrize(
    ("robot", "lockstep"),
    [
        # Each robot, and each of both modes; the other two pairs have nothing that is not in these.
        pytest.param(PLAIN, False, id="plain-False"),
        pytest.param(HANGING, True, id="over an overhang-True"),
        pytest.param(PLAIN, True, id="plain-True", marks=pytest.mark.slow),
        pytest.param(HANGING, False, id="over an overhang-False", marks=pytest.mark.slow),
    ],
)
def test_our_robots(robot: Served, lockstep: bool) -> None:
    keep_all_promises(lockstep, robot)


def test_a_rigid_body_moves_as_promised() -> None:
    """The link is the same; in real time its wheels take the time that they take."""
    of_motion = tuple(name for name, needs in NEEDS.items() if "motion" in needs)
    assert len(of_motion) > 8
    keep_all_promises(False, HEAVY, of_motion)


@pytest.mark.parametrize("clock_rate", [pytest.param(0.99, marks=pytest.mark.slow), 1.01])
def test_old_frames_wrong_clocks_and_other_rates_break_no_promise(clock_rate: float) -> None:
    wrong = Defect("another clock", sends=clock(lambda t_s: clock_rate * t_s))
    keep_all_promises(False, Served(OLD, broken=wrong))


def test_the_robot_is_left_held_and_its_fans_as_they_were(config: Config) -> None:
    with serving(config, lockstep=False) as server:
        robot = server.robot
        robot.fans.duty = (0.31, 0.33)
        checks = ("fans", "fans-rst", "newest-fans", "move-turn")
        results = Conformance(("127.0.0.1", server.port), None, TIMEOUT_S).run(motion=True, only=checks)
        server.clock.sleep(1.0)
        assert robot.rules.is_held
        assert robot.fans.duty == pytest.approx((0.31, 0.33))
    assert [result.outcome for result in results] == ["pass"] * 4


def test_no_motion_turns_no_wheel(config: Config) -> None:
    received: list[bytes] = []

    def altered(data: bytes, _: object) -> bytes:
        received.append(data)
        return data

    drives = ("echo", "newest-drive", "fans-rst", "no-json", "nan", "many-lines", "single-bytes", "lockstep-drive")
    only = (*drives, *(name for name, needs in NEEDS.items() if "motion" in needs))
    results = checked(config, only, lockstep=True, broken=Defect("received", receives=altered), motion=False)
    sent = b"".join(received)
    assert sent.count(b'"drive"') > 100
    assert not re.search(rb'"w[rl]":"?-?[0.]*[1-9]', sent)
    left_out = [result for result in results if "motion" in NEEDS[result.check_id]]
    assert {(result.outcome, result.detail) for result in left_out} == {("not applicable", "--no-motion")}


def test_a_hello_of_no_use_fails_its_check_and_stops_the_others(config: Config) -> None:
    def sent(message: dict[str, object], _: object) -> dict[str, object]:
        if message["type"] == "hello":
            message["ttl_s"] = "0.25"
        return message

    broken = Defect("ttl as text", sends=sent)
    results = checked(config, lockstep=True, broken=broken)
    assert [(r.check_id, r.detail) for r in results if r.outcome == "fail"] == [("hello", "ttl_s = '0.25'")]
    assert [r.check_id for r in results if r.outcome == "pass"] == ["hello-robot"]
    assert results[2].detail == "the hello is of no use: ttl_s = '0.25'"


# What the code of a check may raise on data that it did not expect, and on a connection that fails.
SURPRISES = (
    IndexError("list index out of range"), KeyError("seq"), ValueError("min() arg is empty"), TypeError("no number"),
    ZeroDivisionError("float division by zero"), OverflowError("too large"), RecursionError("too deep"),
    OSError(24, "Too many open files"), AssertionError("no reason"),
)  # fmt: skip


@pytest.mark.parametrize("error", SURPRISES, ids=lambda error: type(error).__name__)
def test_a_check_that_raises_is_undecided_and_the_summary_is_printed(
    robot: str, error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_: CheckContext) -> str:
        raise error

    broken = tuple(check._replace(run=fail) if check.check_id == "boot" else check for check in CHECKS)
    monkeypatch.setattr(runner, "CHECKS", broken)
    assert main(["conformance", robot, "--only", "nonce", "--only", "boot", "--only", "echo"]) == 1
    nonce, boot, echo, last = capsys.readouterr().out.splitlines()
    assert re.match(rf"boot +\? +this check cannot be evaluated: {type(error).__name__}: ", boot)
    assert [line.split()[1] for line in (nonce, echo)] == ["ok", "ok"]
    assert last == "2 passed, 0 failed, 1 undecided, 0 not applicable"


@pytest.mark.parametrize("error", SURPRISES[:2], ids=lambda error: type(error).__name__)
def test_a_surprise_before_or_after_the_checks_leaves_their_results(
    robot: str, error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_: object) -> None:
        raise error

    monkeypatch.setattr(ControllerAndMonitor, "join", fail)
    assert main(["conformance", robot, "--json", "--only", "hello", "--only", "echo"]) == 1
    result = json.loads(capsys.readouterr().out)
    assert (result["passed"], result["failed"], result["undecided"]) == (1, 0, 1)


@pytest.mark.parametrize("lockstep", [True, False])
def test_a_late_first_frame_of_the_controller_breaks_no_promise(config: Config, lockstep: bool) -> None:
    def sent(message: dict[str, object], middle: Middle) -> dict[str, object] | None:
        if message["type"] == "joined" and message["role"] == "controller":
            controllers.append(middle)
        return None if middle in controllers and 2 < middle.count < 9 else message  # after hello and joined

    controllers: list[Middle] = []
    results = checked(config, ["seq-session"], lockstep=lockstep, broken=Defect("late", sends=sent))
    assert [(result.outcome, result.detail) for result in results if result.outcome != "pass"] == []


# -- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def robot(config: Config, request: pytest.FixtureRequest) -> Iterator[str]:
    """A robot in lockstep, with a key or a fault where a test names one; its address."""
    broken, key = getattr(request, "param", (CORRECT, None))
    with serving(config, lockstep=True, broken=broken, key=key) as server:
        yield f"127.0.0.1:{server.port}"


def _on_fire(message: dict[str, object], _: object) -> dict[str, object]:
    return message | {"faults": ["on_fire"]} if message["type"] == "sensors" else message


broken = pytest.mark.parametrize("robot", [(Defect("on fire", sends=_on_fire), None)], indirect=True, ids=["broken"])
locked = pytest.mark.parametrize("robot", [(CORRECT, KEY)], indirect=True, ids=["locked"])


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
    assert last == "1 passed, 1 failed, 0 undecided, 0 not applicable"
    assert captured.err == ""


@locked
def test_a_key(robot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "asks for a key: name its file with --key" in refused(capsys, "conformance", robot, "--no-motion")
    assert "--key: cannot read" in refused(capsys, "conformance", robot, "--key", tmp_path / "none")
    key_file = tmp_path / "key"
    key_file.write_bytes(KEY + b"\n")
    assert main(["conformance", robot, "--key", str(key_file), "--only", "mac", "--only", "mac-wrong"]) == 0


def test_another_program_drives(robot: str, capsys: pytest.CaptureFixture[str]) -> None:
    host, _, port = robot.partition(":")
    other = CheckContext((host, int(port)), None, TIMEOUT_S)
    connection, hello = other.greet()
    connection.send(other.join_line(hello, "controller", mac=""))
    assert other.answer(connection)["type"] == "joined"
    said = refused(capsys, "conformance", robot, "--no-motion", "--timeout", "0.3", status=5)
    assert "another program drives the robot" in said
    other.clear()


def test_nobody_there(free_port: int, capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, "conformance", f"127.0.0.1:{free_port}", status=5)
    assert f"no server at 127.0.0.1:{free_port}: Connection refused" in said


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


# -- frames and hellos that are judged without a server ----------------------------------------------------------------

TTL_S, FRAME_S = 0.25, 0.01
CMD: dict[str, Any] = {"seq": 1, "age": 0.01, "permit_age": 0.02, "held": False}
SENSORS: dict[str, Any] = {"type": "sensors", "seq": 5, "t": 0.05, "cmd": CMD}
SENSORS |= {"enc": [[0.05, 1.0, 2.0]], "fans": [0, 1]}


def frame(t_s: float, age_s: float = 0.01, permit_age_s: float = 0.01, held: bool = False, seq: int = 1) -> Frame:
    cmd = {"seq": seq, "age": age_s, "permit_age": permit_age_s, "held": held}
    return Frame.model_validate({"seq": round(100 * t_s), "t": t_s, "fans": [0.0, 0.0], "enc": [], "cmd": cmd})


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        (b'{"a":1.5,"b":[null,true]}', None),
        (b'{"a":{"b":1,"b":2}}', "a key stands twice"),
        (b'{"a":-Infinity}', "-Infinity is no number of JSON"),
        (b'{"a":1e999}', "number 1e999 is not finite"),
        (b"[1]", "no object: [1]"),
        (b"\xff", "invalid start byte"),
        (b'{"a":"' + b"x" * 100 + b'"}', "a line of 108 bytes"),
    ],
)
def test_lines(line: bytes, fault: str | None) -> None:
    found = line_fault(line, 100)
    assert found is None if fault is None else fault in str(found)


@pytest.mark.parametrize(
    ("change", "seen"),
    [
        ({"cmd": None}, "cmd = None"),
        ({"cmd": {}}, "no cmd.seq"),
        ({"t": True}, "t = True"),
        ({"fans": [0.1]}, r"fans = \[0.1\]"),
        ({"t": float("inf")}, "t = inf"),
        ({"enc": {}}, r"enc = \{\}"),
        ({"cmd": CMD | {"age": None}}, "cmd.age = None"),
    ],
)
def test_a_frame_of_no_use(change: dict[str, Any], seen: str) -> None:
    with pytest.raises(CheckFailed, match=seen):
        parse(Frame, SENSORS | change)


def test_a_lost_session() -> None:
    frames = [frame(t / 100, permit_age_s=t / 100 - 0.1, held=t > 13) for t in range(11, 30)]
    assert check_lost(frames, "permit", TTL_S, FRAME_S) == "held 40 ms after the end of the session"
    assert check_lost(frames[:3], "permit", TTL_S, FRAME_S) is None  # no frame yet that tells
    with pytest.raises(NotApplicable, match=r"ttl_s 0\.08 holds the wheels as soon"):
        check_lost(frames, "permit", 0.08, FRAME_S)


def test_judges_of_frames_without_what_they_judge() -> None:
    with pytest.raises(NotApplicable, match="no edge samples"):
        check_edges([{"edge": []}])
    with pytest.raises(CheckFailed, match="no gravity"):
        check_gravity([{}])
    with pytest.raises(CheckFailed, match="t 1 after 1"):
        check_clock([{"seq": k, "t": 1} for k in range(3)], 100.0)
    assert mean_rates([frame(0.1)]) is None


def test_duties_to_change_to() -> None:
    assert other_duty((0.6, 0.98), 0.6) == pytest.approx((0.65, 0.95))
    with pytest.raises(NotApplicable, match=r"a floor of 0\.98 leaves no room"):
        other_duty((0.99, 0.99), 0.98)


def test_a_mac_without_a_key() -> None:
    context = CheckContext(("127.0.0.1", 1), None, 1.0)
    body = {"wheel_radius_m": 0.03, "wheel_base_m": 0.15, "max_wheel_rad_s": 8.0, "fan_floor": 0.0}
    hello = {"lockstep": False, "frame_hz": 100.0, "ttl_s": TTL_S, "auth": "hmac-sha256", "robot": body}
    context.facts = parse(Facts, hello)
    with pytest.raises(NotApplicable, match="asks for a mac, and there is no key"):
        context.join_line({"nonce": "0"}, "monitor")


def test_a_server_that_accepts_no_more(free_port: int) -> None:
    with pytest.raises(CheckFailed, match="connection not accepted: Connection refused"):
        CheckContext(("127.0.0.1", free_port), None, 1.0).greet()
