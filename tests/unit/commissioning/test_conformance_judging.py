"""The checks of frames and hellos, where no server is needed to see them fail."""

from typing import Any

import pytest

from ccatp.commissioning.conformance.command_checks import check_lost, other_duty
from ccatp.commissioning.conformance.harness import (
    CheckContext,
    CheckFailed,
    Facts,
    Frame,
    NotApplicable,
    parse,
)
from ccatp.commissioning.conformance.motion_checks import mean_rates
from ccatp.commissioning.conformance.server_checks import (
    check_clock,
    check_edges,
    check_gravity,
    line_fault,
)

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
