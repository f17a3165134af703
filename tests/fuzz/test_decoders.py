"""The decoders that read what others wrote, as targets of the fuzzer."""

import json
import math
import os
import random
import tempfile
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path

import msgspec
import pytest

from ccatp.core import Cause, EventCode, Verdict
from ccatp.errors import ConfigError
from ccatp.links import channels, multiline, topics
from ccatp.links import robot_codec as robot
from ccatp.links.auth import read_clients
from ccatp.links.bus_codec import BadMessage, unpack
from ccatp.links.robot_codec import LineBuffer, LineTooLong
from ccatp.links.robot_messages import Sensors
from ccatp.safety.emergency_latch import answer_observatory
from ccatp.sim.fault_plan import parse_plan
from tests.contract.test_channels import ID, Desk
from tests.contract.test_multiline import REPLIES
from tests.contract.test_robot_wire import GOLDEN_FROM_CLIENT, GOLDEN_FROM_ROBOT, HELLO_LINE, SENSORS_LINE
from tests.fuzz.fuzzer import Target, fuzz

PLAN = b"""[[fault]]
signal = "imu_wz"
type = "stuck"
at_s = 40.0
for_s = 0.5
value = 0.1

[[fault]]
signal = "body"
type = "kidnap"
at_s = 1.0
dx_m = 0.1
dy_m = 0.0
dheading_rad = 0.1

[[link]]
type = "delay"
direction = "to_client"
at_s = 110.0
for_s = 2.0
delay_s = 0.02
jitter_s = 0.01
"""
CLIENTS = b"""[clients.site]
public_key = "rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7"
role = "raise"
"""
VERDICT = Verdict(7, 0.07, EventCode.NEAR_EDGE, Cause("rim_ahead"), "front_left", 0.01, 0.0, False, True, False)


def targets() -> list[Target]:
    """All decoders that work on bytes in memory."""
    return [
        Target("robot link, from the robot", [*_lines_of(GOLDEN_FROM_ROBOT), UNKNOWN], _robot, (robot.BadLine,)),
        Target("robot link, from a client", [*_lines_of(GOLDEN_FROM_CLIENT), UNKNOWN], _client, (robot.BadLine,)),
        Target("robot link, lines", [SENSORS_LINE + HELLO_LINE], _lines, (LineTooLong,)),
        Target(
            "MultiLine, requests",
            [b"isconnected", b"latestlengthvalid,1,2,32"],
            _request,
            (multiline.BadMultilineRequest,),
        ),
        Target("MultiLine, replies", [line.strip() for _, line in REPLIES], _reply, (multiline.BadReply,)),
        Target("observatory channel", _observatory(), _emergency, (channels.BadRequest,)),
        Target("operator channel", [b'{"cmd":"status"}', b'{"cmd":"abort"}'], _operator, (channels.BadRequest,)),
        Target("replies of both channels", [b'{"ok":true,"code":0}'], _channel_reply, (channels.BadRequest,)),
        Target("observatory's clients", [CLIENTS], _clients, (ConfigError,)),
        Target("bus", _bus(), _topic, (BadMessage,)),
        Target("fault plan", [PLAN], _plan, (ConfigError,)),
    ]


# -- robot link -------------------------------------------------------------------------------------------------------


UNKNOWN = b'{"type":"x","y":{"z":[1,2.5]}}'


def _lines_of(golden: Sequence[tuple[object, bytes]]) -> list[bytes]:
    return [line.rstrip() for _, line in golden]


def _robot(line: bytes) -> Hashable:
    message = robot.decode_from_robot(line)
    assert_finite(message)
    if isinstance(message, Sensors):
        return len(message.imu), len(message.enc), len(message.edge), message.gravity is None, len(message.faults) > 0
    return type(message).__name__


def _client(line: bytes) -> Hashable:
    message = robot.decode_from_client(line)
    assert_finite(message)
    return type(message).__name__


def assert_finite(message: object) -> None:
    """Nothing that is no number gets through, however deep."""
    if isinstance(message, float):
        assert math.isfinite(message)
    elif isinstance(message, list | tuple):
        for part in message:
            assert_finite(part)
    elif hasattr(message, "__struct_fields__"):
        for name in message.__struct_fields__:
            assert_finite(getattr(message, name))


def _lines(data: bytes) -> Hashable:
    """However the stream is chopped, the lines are the same; the second run is byte by byte in clumps."""
    limit = 600
    whole = _fed(LineBuffer(limit), [data])
    rng = random.Random(len(data))
    cuts = sorted(rng.randrange(len(data) + 1) for _ in range(5))
    parts = [data[a:b] for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True)]
    assert _fed(LineBuffer(limit), parts) == whole
    lines, is_too_long = whole
    assert all(len(line) <= limit and b"\n" not in line for line in lines)
    if is_too_long:
        raise LineTooLong
    return min(len(lines), 20)


def _fed(buffer: LineBuffer, parts: list[bytes]) -> tuple[list[bytes], bool]:
    lines: list[bytes] = []
    for part in parts:
        lines += buffer.feed(part)
        if buffer.error is not None:
            return lines, True
    return lines, False


# -- MultiLine --------------------------------------------------------------------------------------------------------


def _request(line: bytes) -> Hashable:
    request = multiline.parse_request(line)
    assert set(request.channels) <= set(multiline.CHANNEL_NUMBERS)
    assert multiline.parse_request(multiline.format_request(request).strip()) == request
    return request.command, len(request.channels)


def _reply(line: bytes) -> Hashable:
    reply = multiline.parse_reply(line)
    if isinstance(reply, multiline.ChannelData):
        lengths_m, reasons = multiline.valid_lengths(reply, range(1, 33))
        assert all(math.isfinite(length) and length > 0.0 for length in lengths_m.values())
        assert len(lengths_m) + len(reasons) == 32
        return len(reply.records), len(lengths_m), reply.server_error == 0
    return type(reply).__name__, reply if isinstance(reply, multiline.Notice) else ""


# -- channels ---------------------------------------------------------------------------------------------------------


def _observatory() -> list[bytes]:
    return [
        b'{"cmd":"ping"}',
        json.dumps({"cmd": "emergency", "kind": "fire", "id": ID, "note": "north wing"}).encode(),
        json.dumps({"cmd": "clear", "id": ID}).encode(),
    ]


def _emergency(frame: bytes) -> Hashable:
    # Whatever comes is answered, with an answer that can be read.
    answer = answer_observatory(frame, Desk(), at_base_or_held=True, age_s=0.1)
    assert channels.parse_reply(answer)["ok"] in (True, False)
    return type(channels.parse_observatory(frame)).__name__


def _operator(frame: bytes) -> Hashable:
    return channels.parse_operator(frame)


def _channel_reply(frame: bytes) -> Hashable:
    reply = channels.parse_reply(frame)
    return reply["ok"], min(len(reply), 5)


def _clients(data: bytes) -> Hashable:
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        return tuple(sorted(client.role for client in read_clients(Path(file.name), "list").values()))


# -- the rest ---------------------------------------------------------------------------------------------------------


def _bus() -> list[bytes]:
    presence = topics.Heartbeat(seq=1, t_s=0.5, process="main", pid=7, phase="ready")
    estimate = topics.EstimateMessage(
        seq=5, t_s=0.05, x_m=1.0, y_m=2.0, heading_rad=0.5, sigma_m=0.001, state="driving"
    )
    track = topics.TrackMessage(seq=1, t_s=0.1, rows=[(1, 0.1, 1, 2, 0.1, 0.2, 0.3, 0.001)])
    return [
        b"heartbeat.main " + msgspec.json.encode(presence),
        b"estimate " + msgspec.json.encode(estimate),
        b"track " + msgspec.json.encode(track),
        b"verdict " + msgspec.json.encode(VERDICT),
    ]


def _topic(frame: bytes) -> Hashable:
    return unpack(frame)[0]


def _plan(data: bytes) -> Hashable:
    plan = parse_plan(data.decode("utf-8", "replace"), "plan.toml")
    return tuple(sorted(type(f).__name__ for f in (*plan.faults, *plan.link)))


FEW = 3000
GRAMMAR = "MultiLine, replies"
MANY = int(os.environ.get("CCATP_FUZZ_INPUTS", "1000000"))
SEED = int(os.environ.get("CCATP_FUZZ_SEED", "1"))
TARGETS = [
    pytest.param(target, id=target.name, marks=[pytest.mark.fault("E7")] if target.name == GRAMMAR else [])
    for target in targets()
]
Measured = Callable[[str, float], None]


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize(("inputs", "seed"), [(FEW, 0), pytest.param(MANY, SEED, marks=pytest.mark.slow)])
def test_inputs_are_decoded_or_refused(target: Target, inputs: int, seed: int, measured: Measured) -> None:
    report = fuzz(target, inputs if target.name != "fault plan" else inputs // 3, seed)
    print(report.line)
    if target.name == GRAMMAR:
        measured("E7", len(report.failures))
    assert not report.failures, "\n".join(report.failures)
    assert len(report.outcomes) > 3


def test_the_same_seed_gives_the_same_run() -> None:
    target = targets()[0]
    one, two, other = fuzz(target, 300, 5), fuzz(target, 300, 5), fuzz(target, 300, 6)
    assert one.outcomes == two.outcomes
    assert one.accepted == two.accepted
    assert other.outcomes != one.outcomes


def test_a_surprise_is_a_failure() -> None:
    def fragile(data: bytes) -> int:
        return 1 // (len(data) - 3)

    report = fuzz(Target("fragile", [b"ab"], fragile, (ValueError,)), 1000, 0)
    assert report.failures
    assert "ZeroDivisionError" in report.failures[0]
