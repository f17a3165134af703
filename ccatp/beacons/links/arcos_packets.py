"""Packets of a Pioneer base with ARCOS: commands to bytes, bytes to packets, packets to what they say.

A packet is FA FB, the number of bytes that follow, its type or command, its data (numbers with the low byte first), and
a check sum (two bytes, high byte first). Names, numbers and layouts are those of the Pioneer 3 Operations Manual.
"""

import struct
from typing import NamedTuple

from ccatp.links.byte_frames import FrameFinder

HEADER = b"\xfa\xfb"
LONGEST = 208  # bytes after the count; a larger count is noise
_POSITIVE, _NEGATIVE = 0x3B, 0x1B  # types of a number in a command

# Commands. OPEN has the number of SYNC1.
SYNC0, SYNC1, SYNC2 = 0, 1, 2
OPEN, CLOSE, ENABLE, SETA, VEL, CONFIG, ENCODER, RVEL, SETRA, SONAR, STOP = 1, 2, 4, 5, 11, 18, 19, 21, 23, 28, 29
CONFIG_PACKET, ENCODER_PACKET = 0x20, 0x90
STANDARD_PACKETS = frozenset((0x32, 0x33))  # motors stopped, robot moving
_STANDARD = struct.Struct("<HHhhhBBBhHBB")
_READING = struct.Struct("<BH")
_ENCODERS = struct.Struct("<ii")
_MOTORS_ENABLED = 0x0001


class Standard(NamedTuple):
    """The packet of each cycle; ``sonars``: number and range, mm, of each new reading.

    ``stalls``, ``bumpers``: of the left and the right wheel; of the bumpers at the front and at the rear, as bits. The
    byte with the stall of the left wheel has the bumpers at the rear, that of the right wheel those at the front.
    """

    left_mm_s: int
    right_mm_s: int
    battery_v: float
    stalls: tuple[bool, bool]
    bumpers: tuple[int, int]
    is_enabled: bool
    sonars: tuple[tuple[int, int], ...]


def check_sum(data: bytes) -> int:
    """Sum of the byte pairs, high byte first; a single last byte is XORed."""
    pairs = len(data) // 2 * 2
    total = sum(data[k] << 8 | data[k + 1] for k in range(0, pairs, 2)) & 0xFFFF
    return total ^ data[-1] if len(data) % 2 else total


def format_packet(data: bytes) -> bytes:
    """A packet as bytes; ``data``: type or command, and what follows."""
    return HEADER + bytes([len(data) + 2]) + data + check_sum(data).to_bytes(2)


def format_command(command: int, value: int | None = None) -> bytes:
    """A command without or with a number, -32767 to 32767."""
    if value is None:
        return format_packet(bytes([command]))
    kind = _NEGATIVE if value < 0 else _POSITIVE
    return format_packet(bytes([command, kind]) + abs(value).to_bytes(2, "little"))


def format_greeting(stage: int = SYNC0) -> bytes:
    """Begins a handshake, or continues one that another program has begun.

    A base whose watchdog has expired in a session that is still open resumes its last motion with the next packet,
    whatever it is: so the first one is ``STOP``.
    """
    return format_command(STOP) + format_command(stage)


class PacketReader(FrameFinder):
    """Finds the packets in received bytes."""

    START = HEADER

    def feed(self, data: bytes) -> list[bytes]:
        """Type and data of each packet that is complete now."""
        return [packet[3:-2] for packet in self.find(data)]

    def _size(self, data: bytearray) -> int:
        if len(data) < 3:
            return 0
        return 3 + data[2] if 3 <= data[2] <= LONGEST else -1

    def _is_right(self, frame: bytes) -> bool:
        return check_sum(frame[3:-2]) == int.from_bytes(frame[-2:])


def parse_standard(packet: bytes) -> Standard | None:
    """A standard packet; None if it is none, or has not all of its sonar readings."""
    if packet[0] not in STANDARD_PACKETS or len(packet) < 1 + _STANDARD.size:
        return None
    _, _, _, left, right, battery, left_rear, right_front, _, flags, _, count = _STANDARD.unpack_from(packet, 1)
    start = 1 + _STANDARD.size
    if len(packet) < start + count * _READING.size:
        return None
    sonars = tuple(_READING.unpack_from(packet, start + k * _READING.size) for k in range(count))
    stalls, bumpers = (bool(left_rear & 1), bool(right_front & 1)), (right_front >> 1, left_rear >> 1)
    return Standard(left, right, 0.1 * battery, stalls, bumpers, bool(flags & _MOTORS_ENABLED), sonars)


def parse_encoders(packet: bytes) -> tuple[int, int] | None:
    """Counts of the left and the right encoder, which wrap; None if it is no such packet."""
    if packet[0] != ENCODER_PACKET or len(packet) < 1 + _ENCODERS.size:
        return None
    left, right = _ENCODERS.unpack_from(packet, 1)
    return left, right


def parse_names(packet: bytes) -> tuple[str, str, str]:
    """Name, class and subclass in the answer to ``SYNC2``; empty where they are missing."""
    name, kind, model, *_ = [*(text.decode("ascii", "replace") for text in packet[1:].split(b"\0")), "", "", ""]
    return name, kind, model


class Settings(NamedTuple):
    """Parameters in the flash memory of a base; ``counts_per_mm``: None where it does not tell."""

    watchdog_s: float
    counts_per_mm: int | None


# Between the serial number and the name: one byte, five numbers. Between the name and the watchdog: SIP cycle, three
# bytes for baud rates without the last, gripper (2), front sonar (2), rear sonar (1), low battery (2), RevCount (2).
# Between the watchdog and TicksMM: one byte, 16 numbers, six bytes, drift of the gyroscope (2), two baud rates.
_BEFORE_NAME, _BEFORE_WATCHDOG, _BEFORE_TICKS = 1 + 5 * 2, 3 + 2 + 2 + 1 + 2 + 2, 1 + 16 * 2 + 6 + 2 + 2
_SETTINGS = struct.Struct(f"<{_BEFORE_WATCHDOG}xH{_BEFORE_TICKS}xH")


def parse_settings(packet: bytes) -> Settings | None:
    """The packet that answers ``CONFIG``; None if it is none or too short."""
    if packet[0] != CONFIG_PACKET:
        return None
    parts = packet[1:].split(b"\0", 3)  # type, model, serial number, and what follows them
    _, zero, rest = parts[-1][_BEFORE_NAME:].partition(b"\0")
    if len(parts) < 4 or not zero or len(rest) < _BEFORE_WATCHDOG + 2:
        return None
    watchdog_ms, counts_per_mm = _SETTINGS.unpack_from(rest.ljust(_SETTINGS.size, b"\0"))
    return Settings(1e-3 * watchdog_ms, counts_per_mm or None)
