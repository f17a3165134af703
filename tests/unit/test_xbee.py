"""XBee frames: built by the format's own description, cut anywhere, damaged, escaped."""

import pytest

from ccatp.links.xbee import XbeeFrames, XbeeLevel, level_of, xbee_frame

DISCOVERY = (
    b"\x88\x01ND\x00" + b"\x12\x34" + b"\x00\x13\xa2\x00" + b"\x40\x7d\x11\x7e" + b"\x29" + b"beacon3\x00"
)  # frame 1, MY, SH, SL, DB = 41, NI
EXPECTED = XbeeLevel("beacon3", 0x0013A200407D117E, -41.0)


def test_a_discovery_answer_tells_node_and_level() -> None:
    assert level_of(DISCOVERY) == EXPECTED


def test_received_packets_carry_their_level() -> None:
    assert level_of(b"\x81\x00\x05\x38\x00target") == XbeeLevel("target", 5, -56.0)
    assert level_of(b"\x80" + bytes(7) + b"\x09\x21\x00b1") == XbeeLevel("b1", 9, -33.0)


@pytest.mark.parametrize(
    "data", [b"\x8a\x06", b"\x81\x00", b"\x80\x00", b"\x88\x01ND\x04", b"\x88\x01MY\x00\x00\x00", DISCOVERY[:15]]
)
def test_frames_without_a_level_tell_none(data: bytes) -> None:
    assert level_of(data) is None


@pytest.mark.parametrize("escaped", [False, True])
def test_bytes_may_come_in_any_pieces(escaped: bool) -> None:
    stream = b"\x00\xff" + xbee_frame(DISCOVERY, escaped=escaped) + xbee_frame(b"\x8a\x00", escaped=escaped)
    stream += xbee_frame(b"\x81\x00\x05\x38\x00x", escaped=escaped)
    for size in range(1, len(stream) + 1):
        frames = XbeeFrames(escaped=escaped)
        found = [level for at in range(0, len(stream), size) for level in frames.feed(stream[at : at + size])]
        assert found == [EXPECTED, XbeeLevel("x", 5, -56.0)]
        assert frames.bad == 0


def test_escaping_hides_starts_inside_a_frame() -> None:
    assert xbee_frame(DISCOVERY, escaped=True)[1:].count(0x7E) == 0


def test_known_frame_of_the_manual() -> None:
    # The sum of the data and the checksum is 0xFF: 0x08 + 0x01 + 'N' + 'D' = 0x9B.
    assert xbee_frame(b"\x08\x01ND", escaped=False) == b"\x7e\x00\x04\x08\x01ND\x64"


def test_a_damaged_frame_is_counted_and_the_next_one_read() -> None:
    broken = bytearray(xbee_frame(b"\x81\x00\x05\x38\x00x", escaped=True))
    broken[6] ^= 1
    frames = XbeeFrames(escaped=True)
    assert frames.feed(bytes(broken) + xbee_frame(DISCOVERY, escaped=True)) == [EXPECTED]
    assert frames.bad == 1


def test_an_impossible_length_does_not_swallow_the_stream() -> None:
    frames = XbeeFrames(escaped=False)
    assert frames.feed(b"\x7e\xff\xff" + xbee_frame(DISCOVERY, escaped=False)) == [EXPECTED]
    assert frames.bad == 1


def test_frames_of_no_length_are_refused() -> None:
    with pytest.raises(ValueError, match="frame data of 0 bytes"):
        xbee_frame(b"", escaped=False)
