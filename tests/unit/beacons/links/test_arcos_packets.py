"""Packets of a Pioneer base against those that others published, and lines that are damaged."""

import struct

import pytest

from ccatp.beacons.links.arcos_packets import (
    CLOSE,
    ENABLE,
    OPEN,
    RVEL,
    SETA,
    SONAR,
    SYNC0,
    SYNC1,
    SYNC2,
    VEL,
    PacketReader,
    check_sum,
    format_command,
    format_packet,
    parse_encoders,
    parse_names,
    parse_settings,
    parse_standard,
)

# Commands as bytes in test_packet.cpp of ros_arcos (University of Patras, 2015), in a public program for a P3-DX with
# an HCS12 (StopUltra, SetAcc1, ResetPos), in the class Comms for PeopleBots, and in a question at answers.ros.org
# (351531). The base answers SYNC0 to SYNC2 with the same packets.
PUBLISHED = {
    "SYNC0": (format_command(SYNC0), "FA FB 03 00 00 00"),
    "PULSE": (format_command(0), "FA FB 03 00 00 00"),
    "SYNC1": (format_command(SYNC1), "FA FB 03 01 00 01"),
    "OPEN": (format_command(OPEN), "FA FB 03 01 00 01"),
    "SYNC2": (format_command(SYNC2), "FA FB 03 02 00 02"),
    "CLOSE, Comms": (format_command(CLOSE), "FA FB 03 02 00 02"),
    "STOP, Comms": (format_command(29), "FA FB 03 1D 00 1D"),
    "sonars off, HCS12": (format_command(SONAR, 0), "FA FB 06 1C 3B 00 00 1C 3B"),
    "acceleration, HCS12": (format_command(SETA, 1000), "FA FB 06 05 3B E8 03 ED 3E"),
    "deceleration, HCS12": (format_command(SETA, -1000), "FA FB 06 05 1B E8 03 ED 1E"),
    "motors off, HCS12": (format_command(ENABLE, 0), "FA FB 06 04 3B 00 00 04 3B"),
    "motors on, HCS12": (format_command(ENABLE, 1), "FA FB 06 04 3B 01 00 05 3B"),
    "SETO, HCS12: an even count": (format_packet(b"\x07\x3b"), "FA FB 04 07 3B 07 3B"),
    "HOSTBAUD, ros_arcos": (format_command(50, 3), "FA FB 06 32 3B 03 00 35 3B"),
    "ARM_POS, ros_arcos": (format_command(77, 3 << 8 | 25), "FA FB 06 4D 3B 19 03 66 3E"),
    "DIGOUT, ros_arcos": (format_command(30, 0x0A05), "FA FB 06 1E 3B 05 0A 23 45"),
    "TTY2 TEST, ros_arcos: a single last byte": (
        format_packet(b"\x2a\x2b\x04TEST"), "FA FB 09 2A 2B 04 54 45 53 54 73 86",
    ),
}  # fmt: skip
# Of the same question: the base ignored them, because their check sums are wrong.
WRONG = ("FA FB 06 04 3B 01 00 00 40", "FA FB 06 15 3B 20 00 00 70", "FA FB 06 21 3B 01 00 00 5D")


@pytest.mark.parametrize(("made", "printed"), PUBLISHED.values(), ids=PUBLISHED)
def test_published_commands_are_written_and_read(made: bytes, printed: str) -> None:
    assert made == bytes.fromhex(printed)
    reader = PacketReader()
    assert [packet for byte in made for packet in reader.feed(bytes([byte]))] == [made[3:-2]]


@pytest.mark.parametrize("printed", WRONG)
def test_published_packets_with_a_wrong_sum_are_dropped(printed: str) -> None:
    reader = PacketReader()
    good = format_command(CLOSE)
    assert reader.feed(bytes.fromhex(printed) + good) == [good[3:-2]]
    assert reader.counts["bad_sums"] == 1


def test_negative_numbers_have_a_type_of_their_own() -> None:
    assert format_command(VEL, -150)[3:7] == b"\x0b\x1b\x96\x00"
    assert format_command(RVEL, 20)[3:7] == b"\x15\x3b\x14\x00"


def standard(**changes: object) -> bytes:
    values: dict[str, object] = {
        "x": 32767, "y": 1, "th": -5, "left": -150, "right": 148, "battery": 121, "bits": (1, 6), "flags": 3,
        "sonars": ((0, 5000), (7, 350)),
    } | changes  # fmt: skip
    sonars = values["sonars"]
    assert isinstance(sonars, tuple)
    head = struct.pack(
        "<BHHhhhBBBhHBB", 0x33, values["x"], values["y"], values["th"], values["left"], values["right"],
        values["battery"], *values["bits"], 0, values["flags"], 0, len(sonars),  # type: ignore[misc]
    )  # fmt: skip
    return head + b"".join(struct.pack("<BH", *sonar) for sonar in sonars) + bytes(12)


# No published bytes of a standard, encoder or configuration packet were found. The layouts are those of the tables in
# the Pioneer 3 manual, and three independent programs read them so: ARIA, p2os, ros_arcos.
def test_a_standard_packet() -> None:
    found = parse_standard(standard())
    assert found is not None
    assert (found.left_mm_s, found.right_mm_s, found.is_enabled) == (-150, 148, True)
    assert found.battery_v == pytest.approx(12.1)
    # ArModeBumps of ARIA takes the bumpers at the front from the high byte of STALL AND BUMPERS, as p2os does.
    assert (found.stalls, found.bumpers) == ((True, False), (3, 0))
    assert found.sonars == ((0, 5000), (7, 350))
    none = parse_standard(standard(bits=(0, 1), flags=2, sonars=()))
    assert none is not None
    assert (none.stalls, none.is_enabled, none.sonars) == ((False, True), False, ())


@pytest.mark.parametrize("size", [1, 20, 24])
def test_a_standard_packet_that_is_cut_says_nothing(size: int) -> None:
    assert parse_standard(standard()[:size]) is None
    assert parse_standard(b"\x20" + bytes(40)) is None


def test_encoders_names_and_configuration() -> None:
    assert parse_encoders(b"\x90" + struct.pack("<ii", -7, 1 << 30)) == (-7, 1 << 30)
    assert parse_encoders(b"\x90\x00") is None
    assert parse_names(b"\x02Bradley_1\x00Pioneer\x00p3dx-sh\x00") == ("Bradley_1", "Pioneer", "p3dx-sh")
    assert parse_names(b"\x02") == ("", "", "")
    head = b"\x20Pioneer\x00p3dx-sh\x00SN1\x00\x04" + struct.pack("<5H", 1, 2, 3, 4, 500) + b"name\x00"
    body = bytes([0, 2, 0]) + struct.pack("<HHBHHH", 0, 1, 0, 115, 16570, 800)
    assert parse_settings(head + body) == (0.8, None)  # older firmware tells no more
    assert parse_settings(head + body[:-1]) is None
    assert parse_settings(b"\x20Pioneer") is None
    numbers = struct.pack("<B16H6BhBB", 0, 150, 100, *range(14), 0, 0, 0, 40, 2, 1, -7, 0, 0)
    assert parse_settings(head + body + numbers + struct.pack("<HH", 128, 105)) == (0.8, 128)


def test_a_byte_lost_at_any_position_costs_at_most_the_packet_and_the_next() -> None:
    packet = format_packet(standard())
    for k in range(len(packet)):
        reader = PacketReader()
        found = reader.feed(packet + packet[:k] + packet[k + 1 :] + 3 * packet)
        assert 3 <= len(found) <= 4
        assert set(found) == {packet[3:-2]}


def test_impossible_counts_and_noise_hold_nothing_up() -> None:
    reader, good = PacketReader(), format_command(CLOSE)
    assert len(reader.feed(b"\xfa\xfb\x00" + good + b"\xfa\xfb\xff" + good + b"\xfa" + good + b"\xfa\xfa")) == 3
    assert check_sum(b"\x01\x02\x03") == 0x0101
