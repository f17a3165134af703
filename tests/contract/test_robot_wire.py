"""The robot link's lines: golden bytes both ways, and refusals of everything that is not quite right."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ccatp.core import EdgeSample, GravitySample, ImuSample, WheelSample
from ccatp.links import multiline
from ccatp.links.robot_codec import (
    BadLine,
    BadLineCounter,
    LineBuffer,
    RobotFrame,
    decode_from_client,
    decode_from_robot,
    encode,
    format_permit,
    is_mac_right,
    join_mac,
    set_point_on_wire,
)
from ccatp.links.robot_messages import (
    CommandEcho,
    Drive,
    Fans,
    FromClient,
    FromRobot,
    Hello,
    Join,
    Joined,
    Permit,
    Refused,
    RobotData,
    Sensors,
    Unknown,
)

NONCE = "00112233445566778899aabbccddeeff"
HELLO = Hello(
    protocol="ccatp-robot/1",
    boot=417,
    nonce=NONCE,
    auth="none",
    lockstep=False,
    frame_hz=100.0,
    ttl_s=0.25,
    robot=RobotData(
        wheel_radius_m=0.03,
        wheel_base_m=0.15,
        edge_sensors_m=((0.09, 0.09), (0.09, -0.09), (-0.09, 0.09), (-0.09, -0.09)),
        puck_m=(0.0, 0.0, 0.05),
        max_wheel_rad_s=8.0,
        fan_floor=0.0,
    ),
)
HELLO_LINE = (
    b'{"type":"hello","protocol":"ccatp-robot/1","boot":417,"nonce":"00112233445566778899aabbccddeeff","auth":"none",'
    b'"lockstep":false,"frame_hz":100.0,"ttl_s":0.25,"robot":{"wheel_radius_m":0.03,"wheel_base_m":0.15,'
    b'"edge_sensors_m":[[0.09,0.09],[0.09,-0.09],[-0.09,0.09],[-0.09,-0.09]],"puck_m":[0.0,0.0,0.05],'
    b'"max_wheel_rad_s":8.0,"fan_floor":0.0}}\n'
)
SENSORS = Sensors(
    seq=8812,
    t=88.12,
    imu=[ImuSample(88.12, 0.01, -0.02)],
    enc=[WheelSample(88.119, 3.3, 3.2), WheelSample(88.12, 3.31, None)],
    edge=[EdgeSample(88.12, 1, 1, 0, 1)],
    gravity=GravitySample(88.12, 0.0, 0.6, -0.8),
    fans=(0.8, 0.75),
    soc=0.93,
    cmd=CommandEcho(seq=8810, age=0.012, permit_age=0.008, held=False),
    faults=["battery_low"],
)
SENSORS_LINE = (
    b'{"type":"sensors","seq":8812,"t":88.12,"imu":[[88.12,0.01,-0.02]],"enc":[[88.119,3.3,3.2],[88.12,3.31,null]],'
    b'"edge":[[88.12,1,1,0,1]],"gravity":[88.12,0.0,0.6,-0.8],"fans":[0.8,0.75],"soc":0.93,'
    b'"cmd":{"seq":8810,"age":0.012,"permit_age":0.008,"held":false},"faults":["battery_low"]}\n'
)
DRIVE_LINE = b'{"type":"drive","seq":7,"ack":6,"wr":3.5,"wl":-0.25}\n'
PERMIT_LINE = b'{"type":"permit","seq":7,"ack":6,"forward":true,"reverse":false,"turn":true}\n'
FANS_LINE = b'{"type":"fans","seq":1,"duty":[0.8,0.75]}\n'
JOIN_LINE = b'{"type":"join","role":"controller","client":"main"}\n'

GOLDEN_FROM_ROBOT: list[tuple[FromRobot, bytes]] = [
    (HELLO, HELLO_LINE),
    (Joined(role="monitor", session=12), b'{"type":"joined","role":"monitor","session":12}\n'),
    (Refused(reason="role taken"), b'{"type":"refused","reason":"role taken"}\n'),
    (SENSORS, SENSORS_LINE),
]
GOLDEN_FROM_CLIENT: list[tuple[FromClient, bytes]] = [
    (Join(role="controller", client="main"), JOIN_LINE),
    (
        Join(role="monitor", client="danger", mac="00ff"),
        b'{"type":"join","role":"monitor","client":"danger","mac":"00ff"}\n',
    ),
    (Drive(seq=7, ack=6, wr=3.5, wl=-0.25), DRIVE_LINE),
    (Permit(seq=7, ack=6, forward=True, reverse=False, turn=True), PERMIT_LINE),
    (Fans(seq=1, duty=(0.8, 0.75)), FANS_LINE),
]

# Every way found so far of being no good line of a client: values of one key, whole members, and whole lines.
DRIVE = b'{"type":"drive","seq":%b,"ack":1,"wr":%b,"wl":0%b}'
HUGE = b"1" + b"0" * 500
BAD_RATES = b'NaN Infinity -Infinity 1e999 null "0" true [0] 01 .5 0x1'.split()
BAD_NUMBERS = b'true 1.5 -1 9007199254740992 "1"'.split()
BAD_MEMBERS = (
    b',"seq":1 ,"wl":0 ,"w\\u006c":8 ,"type":"drive" ,"x":{"a":1,"a":1} ,"x":1e999 ,"x":NaN ,"x":"\xff" , '
    b',"x":' + HUGE + b' ,"x":' + b"[" * 7000
).split()
BAD_PERMITS = (
    b'"forward":1,"reverse":false,"turn":true "forward":"true","reverse":false,"turn":true '
    b'"forward":true,"reverse":null,"turn":true "forward":true,"turn":true '
    b'"forward":true,"reverse":true,"turn":true,"turn":false'
).split()
BAD_DUTIES = b"[0.8] [0.8,0.8,0.8] [0.8,1.1] [-0.1,0.8] 0.8 [true,0.8]".split()
BAD_JOINS = (
    b'"role":"controller" "role":"king","client":"main" "role":"controller","client":7 '
    b'"role":"controller","role":"monitor","client":"main"'
).split()
BAD_LINES = (
    b'garbage null [] 42 "drive" {} {"seq":1} {"type":1} {"type":null,"seq":1} {"type":"drive"} '
    b'{"type":"drive","seq":1,"ack":1,"wr":0} {"type":"wink","a":1,"a":2} {"type":"wink","a":Infinity} ' + b"[" * 8000
).split()
GOOD = DRIVE % (b"1", b"0", b"")
MALFORMED_FROM_CLIENT: list[bytes] = [
    *BAD_LINES,
    *(GOOD[:-1], GOOD + b"x", GOOD + b"{}", GOOD.replace(b'"', b"'"), b"\xef\xbb\xbf" + GOOD, b"", b"\r"),
    GOOD.decode().encode("utf-16"),
    GOOD.replace(b'"seq":1', b'"seq" :2,"seq":1'),
    *(DRIVE % (b"1", rate, b"") for rate in (*BAD_RATES, HUGE)),
    *(DRIVE % (number, b"0", b"") for number in BAD_NUMBERS),
    *(DRIVE % (b"1", b"0", member) for member in BAD_MEMBERS),
    *(b'{"type":"permit","seq":1,"ack":1,%b}' % members for members in BAD_PERMITS),
    *(b'{"type":"fans","seq":1,"duty":%b}' % duty for duty in BAD_DUTIES),
    *(b'{"type":"join",%b}' % members for members in BAD_JOINS),
]


@pytest.mark.parametrize(("message", "line"), GOLDEN_FROM_ROBOT)
def test_golden_bytes_from_the_robot(message: FromRobot, line: bytes) -> None:
    assert encode(message) == line
    assert decode_from_robot(line[:-1]) == message


@pytest.mark.parametrize(("message", "line"), GOLDEN_FROM_CLIENT)
def test_golden_bytes_from_a_client(message: FromClient, line: bytes) -> None:
    assert encode(message) == line
    assert decode_from_client(line[:-1]) == message


def test_fast_encoders_give_the_golden_bytes() -> None:
    assert format_permit(7, 6, True, False, True) == PERMIT_LINE
    line = encode(
        RobotFrame(
            8812,
            88.12,
            [(88.12, 0.01, -0.02)],
            [(88.119, 3.3, 3.2), (88.12, 3.31, None)],
            [(88.12, 1, 1, 0, 1)],
            (88.12, 0.0, 0.6, -0.8),
            (0.8, 0.75),
            0.93,
            CommandEcho(8810, 0.012, 0.008, False),
            ["battery_low"],
        )
    )
    assert line == SENSORS_LINE


def test_lists_may_be_empty_and_gravity_null() -> None:
    line = encode(RobotFrame(0, 0.0, (), (), (), None, (0.0, 0.0), 1.0, CommandEcho(-1, 0.0, 0.0, True), ()))
    decoded = decode_from_robot(line)
    assert isinstance(decoded, Sensors)
    assert (decoded.imu, decoded.enc, decoded.edge, decoded.gravity, decoded.cmd.seq) == ([], [], [], None, -1)


@pytest.mark.parametrize("line", MALFORMED_FROM_CLIENT, ids=lambda line: repr(line[:60]))
def test_malformed_lines_of_a_client_are_refused(line: bytes) -> None:
    with pytest.raises(BadLine, match="bad line: "):
        decode_from_client(line)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b'{"type":"drive","seq":1,"seq":1,"ack":1,"wr":0,"wl":0}', "a key stands twice"),
        (b'{"type":"drive","seq":1,"ack":1,"wr":0,"wl":0,"x":1e999}', "bad line: x is Infinity"),
        (b'{"type":"drive","seq":1,"ack":1,"wr":NaN,"wl":0}', "bad line: wr is NaN"),
        (
            b'{"type":"drive","seq":1,"ack":1,"wr":0,"wl":0,"x":{"y":[[1,2],[3,-Infinity]]}}',
            r"x\.y\[1\]\[1\] is -Infinity",
        ),
        (b"NaN", "the line is NaN"),
        (b'{"type":"drive","seq":1,"ack":1,"wr":0,"wl":0,"x":1' + b"0" * 500 + b"}", "too many digits"),
        (b'{"seq":1}', "no object with a type"),
        (b'{"type":"drive"}', "missing required field"),
        (b"nonsense", "JSONDecodeError"),
    ],
)
def test_reasons(line: bytes, reason: str) -> None:
    with pytest.raises(BadLine, match=reason):
        decode_from_client(line)


def _sensors_with(**changes: object) -> bytes:
    return json.dumps(json.loads(SENSORS_LINE) | changes).encode()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"edge": [[1.0, 1, 1, 2, 1]]}, "edge sample out of range"),
        ({"edge": [[1.0, 1, 1, -1, 1]]}, "edge sample out of range"),
        ({"edge": [[-1.0, 1, 1, 1, 1]]}, "edge sample out of range"),
        ({"edge": [[1.0, 1, 1, True, 1]]}, "Expected `int`"),
        ({"edge": [[1.0, 1, 1, 1]]}, "length 5"),
        ({"imu": [[1.0, 0.0, 1e5]]}, "imu sample out of range"),
        ({"imu": [[2e9, 0.0, 0.0]]}, "imu sample out of range"),
        ({"imu": [[1.0, 1e5, 0.0]]}, "imu sample out of range"),
        ({"edge": [[1e9 + 1.0, 1, 1, 1, 1]]}, "edge sample out of range"),
        ({"gravity": [2e9, 0.0, 0.6, -0.8]}, "gravity out of range"),
        ({"gravity": [1.0, 0.0, 1.2, -1.6]}, "gravity out of range"),
        ({"imu": [[1.0, 0.0, 0.0, 0.0]]}, "length 3"),
        ({"enc": [[1.0, 2e4, 0.0]]}, "encoder sample out of range"),
        ({"enc": [[1.0, 0.0, -2e4]]}, "encoder sample out of range"),
        ({"enc": [[-1.0, 0.0, 0.0]]}, "encoder sample out of range"),
        ({"gravity": [1.0, 0.0, 0.0, 0.0]}, "gravity out of range"),
        ({"gravity": [1.0, 9.81, 0.0, 0.0]}, "gravity out of range"),
        ({"fans": [0.8, 1.5]}, "fans"),
        ({"soc": -0.1}, "soc"),
        ({"t": -1.0}, r"\$\.t"),
        ({"seq": -1}, "seq"),
        ({"cmd": {"seq": 1, "age": -0.1, "permit_age": 0.0, "held": False}}, "cmd.age"),
        ({"cmd": {"seq": 1, "age": 0.1, "held": False}}, "permit_age"),
        ({"faults": "imu"}, "faults"),
    ],
)
def test_sensors_out_of_range_are_refused(changes: dict[str, object], reason: str) -> None:
    with pytest.raises(BadLine, match=reason):
        decode_from_robot(_sensors_with(**changes))


@pytest.mark.parametrize("t_s", [0.0, 1e9])
def test_the_first_and_the_last_time_are_in_range(t_s: float) -> None:
    changes = {"imu": [[t_s, 1e4, -1e4]], "enc": [[t_s, 1e4, None]], "edge": [[t_s, 1, 0, 1, 0]]}
    decoded = decode_from_robot(_sensors_with(**changes))
    assert isinstance(decoded, Sensors)
    assert decoded.imu[0].t_s == decoded.enc[0].t_s == decoded.edge[0].t_s == t_s


@pytest.mark.parametrize("nonce", [NONCE, NONCE.upper()])
def test_the_digits_of_a_nonce_may_be_capitals(nonce: str) -> None:
    hello = decode_from_robot(HELLO_LINE.replace(NONCE.encode(), nonce.encode()))
    assert isinstance(hello, Hello)
    assert hello.nonce == nonce


def test_unknown_keys_are_ignored_and_unknown_types_are_recognized() -> None:
    assert decode_from_client(b'{"type":"drive","note":{"a":[1,":"]},"seq":7,"ack":6,"wr":3.5,"wl":-0.25}') == Drive(
        seq=7, ack=6, wr=3.5, wl=-0.25
    )
    assert decode_from_robot(_sensors_with(extra=1)) == SENSORS
    assert decode_from_client(b'{"type":"dance","seq":1}') == Unknown("dance")
    assert decode_from_robot(b'{"type":"drive","seq":7,"ack":6,"wr":3.5,"wl":-0.25}') == Unknown("drive")


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_drive_that_is_not_finite_is_never_encoded(value: float) -> None:
    with pytest.raises(ValueError, match="must be finite"):
        encode(Drive(seq=1, ack=1, wr=value, wl=0.0))
    with pytest.raises(ValueError, match="must be finite"):
        encode(Drive(seq=1, ack=1, wr=0.0, wl=value))


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_what_arrives_of_a_set_point_is_known_beforehand(right: float, left: float) -> None:
    arrived = decode_from_client(encode(Drive(seq=1, ack=1, wr=right, wl=left))[:-1])
    assert arrived == Drive(seq=1, ack=1, wr=set_point_on_wire(right), wl=set_point_on_wire(left))
    assert set_point_on_wire(right) == pytest.approx(right, rel=5e-9)  # nine digits


@pytest.mark.fault("S15")
@given(st.sampled_from([DRIVE_LINE, PERMIT_LINE, FANS_LINE, JOIN_LINE]), st.data())
def test_a_damaged_line_gives_a_message_or_a_bad_line(golden: bytes, data: st.DataObject) -> None:
    line = bytearray(golden[:-1])
    for _ in range(data.draw(st.integers(1, 4))):
        line[data.draw(st.integers(0, len(line) - 1))] = data.draw(st.integers(0, 255))
    try:
        message = decode_from_client(bytes(line))
    except BadLine:
        return
    # What is accepted must say the same to an independent strict reader.
    read = json.loads(bytes(line).decode("utf-8"), object_pairs_hook=_no_duplicates)
    if isinstance(message, Drive):
        assert (message.seq, message.ack, message.wr, message.wl) == (read["seq"], read["ack"], read["wr"], read["wl"])


def _no_duplicates(pairs: list[tuple[str, object]]) -> dict[str, object]:
    assert len({key for key, _ in pairs}) == len(pairs)
    return dict(pairs)


def test_mac() -> None:
    # Computed with: printf '00112233445566778899aabbccddeeff:monitor' | openssl dgst -sha256 -hmac secret
    expected = "c76bcd9615c8ef94e3ff8c90130dbfdda20a5987f4dcace580999bfdcb3db345"
    assert join_mac(b"secret", NONCE, "monitor") == expected
    assert is_mac_right(b"secret", NONCE, Join(role="monitor", client="x", mac=expected))
    assert is_mac_right(b"secret", NONCE, Join(role="monitor", client="x", mac=expected.upper()))
    for wrong in ("", "ä", expected[:-1], "0" * 64, join_mac(b"secret", NONCE, "controller")):
        assert not is_mac_right(b"secret", NONCE, Join(role="monitor", client="x", mac=wrong))


# -- lines ------------------------------------------------------------------------------------------------------------


@pytest.mark.fault("L5")
@given(st.lists(st.binary(max_size=40).map(lambda b: b.replace(b"\n", b"")), max_size=8), st.data())
def test_lines_do_not_depend_on_how_the_stream_is_chopped(lines: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(line + b"\n" for line in lines) + b"rest"
    buffer = LineBuffer()
    found: list[bytes] = []
    while stream:
        cut = data.draw(st.integers(1, len(stream)))
        found += buffer.feed(stream[:cut])
        stream = stream[cut:]
    assert found == lines


@pytest.mark.fault("L7")
@pytest.mark.parametrize("limit", [10, 8192, multiline.MAX_LINE_BYTES])
def test_a_line_at_the_limit_passes_and_nothing_beyond_it_is_kept(limit: int) -> None:
    buffer = LineBuffer() if limit == 8192 else LineBuffer(limit)
    assert buffer.feed(b"x" * limit + b"\ny") == [b"x" * limit]
    assert buffer.feed(b"\n") == [b"y"]
    assert buffer.error is None
    assert buffer.feed(b"ok\n" + b"x" * (limit + 1) + b"\nnever\n") == [b"ok"]
    assert str(buffer.error) == f"line of more than {limit} bytes"
    unfinished = LineBuffer(limit)
    assert unfinished.feed(b"x" * limit) == unfinished.feed(b"a") == []
    assert unfinished.error is not None
    assert unfinished.feed(b"\n") == [b""]  # nothing of it was kept


def test_bad_lines_are_counted_within_a_window() -> None:
    counter = BadLineCounter(limit=20, window_s=1.0)
    assert not any(counter.add(0.04 * k, f"reason {k}") for k in range(20))
    assert counter.add(0.9, "reason 20")
    assert counter.first_reason == "reason 0"
    slow = BadLineCounter(limit=20, window_s=1.0)
    assert not any(slow.add(0.051 * k, "") for k in range(100))  # 19.6 a second
    assert slow.total == 100
