"""Frames of XBee modules against frames that others published, and lines that are damaged."""

import random

import pytest

from ccatp.beacons.links.xbee_frames import (
    AtResponse,
    FrameReader,
    ModemStatus,
    Node,
    OtherFrame,
    RemoteResponse,
    RouteRecord,
    format_at,
    format_frame,
    format_remote_at,
    name_of,
    parse_frame,
    parse_node,
)

BEACON, OTHER = 0x0013A20040522BAA, 0x0013A20012345678
# Frames as printed in Digi's manuals, with their page, and in public questions. Manuals: ZB = XBee/XBee-PRO ZB of 2011,
# S2C = XBee/XBee-PRO S2C Zigbee (90002002), 802.15.4 = XBee/XBee-PRO S2C 802.15.4 (90001500), 3 = XBee 3 Zigbee,
# SX = XBee SX 868, 900HP = XBee-PRO 900HP/XSC, SE = XBee/XBee-PRO SE of 2009.
PUBLISHED = {
    "S2C, API operating mode, escaped characters": ("7E 00 02 23 11 CB", OtherFrame(0x23)),
    "3 p. 256, command BD": ("7E 00 06 08 01 42 44 04 B0 BC", OtherFrame(0x08)),
    "example-a.com 22074092, command ND": ("7E 00 05 08 01 4E 44 00 64", OtherFrame(0x08)),
    "802.15.4 p. 117, transmit to 1234": ("7E 00 0B 01 87 12 34 00 54 78 44 61 74 61 EB", OtherFrame(0x01)),
    "802.15.4 p. 117, broadcast": ("7E 00 0E 01 00 FF FF 00 42 72 6F 61 64 63 61 73 74 6D", OtherFrame(0x01)),
    "802.15.4 p. 126, transmit status": ("7E 00 03 89 01 00 75", OtherFrame(0x89)),
    "ZB, S2C, 3 p. 288, transmit status": ("7E 00 07 8B 01 7D 84 00 00 01 71", OtherFrame(0x8B)),
    "SE p. 93, coordinator started": ("7E 00 02 8A 06 6F", ModemStatus(6)),
    "DigiMesh 2.4 p. 79, hardware reset": ("7E 00 02 8A 00 75", ModemStatus(0)),
    "SE p. 93, answer to BD": ("7E 00 05 88 01 42 44 00 F0", AtResponse(1, b"BD", 0, b"")),
    "manongdao.com 942208, answer to ND of a router without a name": (
        "7E 00 19 88 02 4E 44 00 17 85 00 13 A2 00 40 B4 50 23 20 00 FF FE 01 00 C1 05 10 1E 19",
        AtResponse(2, b"ND", 0, bytes.fromhex("17850013A20040B450232000FFFE0100C105101E")),
    ),
    "S2C, explicit receive": (
        "7E 00 18 91 00 13 A2 00 40 52 2B AA 7D 84 E0 E0 22 11 C1 05 02 52 78 44 61 74 61 52", OtherFrame(0x91),
    ),
    "900HP p. 73, node identification with DD and level": (
        "7E 00 25 95 00 13 A2 00 40 74 02 AC FF FE C2 FF FE 00 13 A2 00 40 74 02 AC 20 00 FF FE 01 01 C1 05 10 1E "
        "00 0C 00 00 2E 33", OtherFrame(0x95),
    ),
    "ZB p. 118, remote answer to SL": (
        "7E 00 13 97 55 00 13 A2 00 40 52 2B AA 7D 84 53 4C 00 40 52 2B AA F0",
        RemoteResponse(0x55, BEACON, b"SL", 0, bytes.fromhex("40522BAA")),
    ),
    "SX p. 200, remote answer to NI": (
        "7E 00 0F 97 27 00 13 A2 00 12 34 56 78 12 7E 4E 49 00 51", RemoteResponse(0x27, OTHER, b"NI", 0, b""),
    ),
    "SX p. 200, remote request that was not transmitted": (
        "7E 00 0F 97 27 00 13 A2 00 12 34 56 78 FF FE 49 44 04 EA", RemoteResponse(0x27, OTHER, b"ID", 4, b""),
    ),
    "forums.digi.com 11628, remote DB that was not transmitted": (
        "7E 00 0F 97 01 00 13 A2 00 70 40 76 44 FF FE 44 42 04 C1",
        RemoteResponse(1, 0x0013A20070407644, b"DB", 4, b""),
    ),
    "ZB p. 119, S2C p. 203, route record with three relays": (
        "7E 00 13 A1 00 13 A2 00 40 40 11 22 33 44 01 03 EE FF CC DD AA BB 80", RouteRecord(0x0013A20040401122, 3),
    ),
    "S2C p. 247, route record of four hops": (
        "7E 00 13 A1 00 13 A2 00 12 34 56 78 DD DD 01 03 CC CC BB BB AA AA 75", RouteRecord(OTHER, 3),
    ),
}  # fmt: skip


@pytest.mark.parametrize(("printed", "meaning"), PUBLISHED.values(), ids=PUBLISHED)
@pytest.mark.parametrize("is_escaped", [False, True])
def test_published_frames_are_read_and_written(printed: str, meaning: object, is_escaped: bool) -> None:
    frame = bytes.fromhex(printed)
    sent = format_frame(frame[3:-1], is_escaped=is_escaped)
    assert is_escaped or sent == frame
    reader = FrameReader(is_escaped=is_escaped)
    (found,) = [data for byte in sent for data in reader.feed(bytes([byte]))]
    assert parse_frame(found) == meaning
    assert reader.counts["noise"] == 0


def test_escapes_are_those_of_the_manual() -> None:
    assert format_frame(b"\x23\x11", is_escaped=True) == bytes.fromhex("7E 00 02 23 7D 31 CB")


def test_commands_are_those_of_the_manual() -> None:
    assert format_frame(format_at(0x52, b"MY"), is_escaped=False) == bytes.fromhex("7E 00 04 08 52 4D 59 FF")
    # As sent by the question at forums.digi.com, 11628.
    frame = format_frame(format_remote_at(1, 0x0013A20070407644, b"DB"), is_escaped=False)
    assert frame == bytes.fromhex("7E 00 0F 17 01 00 13 A2 00 70 40 76 44 FF FE 00 44 42 45")


# Without escapes a frame whose last byte is 7E and gets lost borrows its end from the next frame: no level is 7E.
FRAME = format_frame(b"\x88\x01DB\x00\x28", is_escaped=False)
ESCAPED = format_frame(b"\x88\x7eDB\x00\x7e", is_escaped=True)


@pytest.mark.parametrize("frame", [FRAME, ESCAPED], ids=["API 1", "API 2"])
def test_a_byte_lost_at_any_position_costs_at_most_the_frame_and_the_next(frame: bytes) -> None:
    for k in range(len(frame)):
        reader = FrameReader(is_escaped=frame is ESCAPED)
        found = reader.feed(frame + frame[:k] + frame[k + 1 :] + 3 * frame) + reader.give_up()
        assert 3 <= len(found) <= 4
        assert set(found) == {b"\x88\x01DB\x00\x28" if frame is FRAME else b"\x88\x7eDB\x00\x7e"}
        assert reader.counts["noise"] or len(found) == 4


@pytest.mark.parametrize("is_escaped", [False, True])
def test_wrong_sums_noise_and_impossible_lengths_hold_nothing_up(is_escaped: bool) -> None:
    frame = format_frame(b"\x8a\x06", is_escaped=is_escaped)
    reader = FrameReader(is_escaped=is_escaped)
    wrong = frame[:-1] + bytes([frame[-1] ^ 1])
    found = reader.feed(b"\x00\x7e\xff\xff" + frame + wrong + frame + b"\x7e\x00\x00" + frame)
    assert [parse_frame(data) for data in found] == 3 * [ModemStatus(6)]
    assert reader.counts["bad_sums"] >= 1


def test_noise_is_bounded_and_hardly_ever_a_frame() -> None:
    rng = random.Random(5)
    for is_escaped in (False, True):
        reader = FrameReader(is_escaped=is_escaped)
        frames = reader.feed(rng.randbytes(50_000))
        kept = 50_000 - reader.counts["noise"] - sum(len(frame) + 4 for frame in frames)
        assert kept <= 304 or is_escaped  # escapes are removed before the count
        assert len(frames) < 50  # one start in 256, one sum in 256


@pytest.mark.parametrize("data", [b"\x88", b"\x97\x01", b"\xa1" + bytes(12) + b"\x03", b"\x8a", b"\x88\x01DB"])
def test_a_frame_too_short_for_its_type_says_nothing(data: bytes) -> None:
    assert parse_frame(data) == OtherFrame(data[0])


ZIGBEE = bytes.fromhex("1234 0013A20040522BAA") + b"beacon1\x00"


@pytest.mark.parametrize(
    ("data", "node"),
    [
        (
            bytes.fromhex("1785 0013A20040B45023 2000 FFFE 01 00 C105 101E"),  # as published, see above
            Node(0x0013A20040B45023, None),
        ),
        (ZIGBEE + bytes.fromhex("FFFE 01 00 C105 101E"), Node(BEACON, None)),  # a router, which may be relayed
        (ZIGBEE + bytes.fromhex("0000 02 00 C105 101E"), Node(BEACON, False)),  # child of the coordinator
        (ZIGBEE + bytes.fromhex("4F21 02 00 C105 101E"), Node(BEACON, True)),  # child of a router
        (ZIGBEE + bytes.fromhex("FFFE 01 00 C105 101E 00030000 2A"), Node(BEACON, None)),  # with NO
        (bytes.fromhex("1234 0013A20040522BAA 2A") + b"beacon1\x00", Node(BEACON, None)),  # 802.15.4
        (ZIGBEE, Node(BEACON, None)),  # 802.15.4 without a level
        (
            bytes.fromhex("1234 0013A20040522BAA 2A") + b"beacon1\x00" + bytes.fromhex("FFFE 02 00 C105 101E"),
            Node(BEACON, False),
        ),  # 802.15.4 of XBee 3, as its command mode prints it
        (b"", None),
        (ZIGBEE[:-1], None),
    ],
)
def test_answers_to_the_discovery(data: bytes, node: Node | None) -> None:
    assert parse_node(data) == node


def test_names_of_any_bytes_are_different_names_that_the_link_can_hold() -> None:
    assert [name_of(BEACON, data) for data in (b"beacon1", b"beacon1 ", b" ", b"", b"20 letters, not one ")] == [
        "beacon1", "beacon1", "0013A20040522BAA", "0013A20040522BAA", "20 letters, not one",
    ]  # fmt: skip
    names = {name_of(BEACON, b"k\xfcche" + bytes([byte])) for byte in range(0x80, 0x100)}
    assert len(names) == 128
    assert max(map(len, names)) == 6
