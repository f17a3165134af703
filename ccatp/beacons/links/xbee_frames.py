"""Frames of XBee modules in API mode 1 and 2: bytes to frames, frames to what they say, commands to bytes.

A frame is 7E, the length of its data (two bytes, high byte first), the data, and FF minus the sum of the data. In mode
2 the bytes 7E, 7D, 11 and 13 of length, data and sum are sent as 7D and the byte XOR 20, so 7E always begins a frame.
The numbers of the frame types and the layouts are those of Digi's manuals of the S1, S2C and XBee 3 modules.
"""

from typing import NamedTuple

from ccatp.links.byte_frames import FrameFinder

START, ESCAPE, FLIP = 0x7E, 0x7D, 0x20
ESCAPED = frozenset((START, ESCAPE, 0x11, 0x13))
LONGEST = 300  # bytes of data; a longer length is noise, and would hold up the frames behind it

AT, REMOTE_AT = 0x08, 0x17
AT_RESPONSE, MODEM_STATUS, REMOTE_RESPONSE, ROUTE_RECORD = 0x88, 0x8A, 0x97, 0xA1
# Frames about a packet that came by radio: any of them changes what the command DB answers.
BY_RADIO = frozenset((0x80, 0x81, 0x82, 0x83, 0x90, 0x91, 0x92, 0x94, 0x95, REMOTE_RESPONSE, 0xA0, ROUTE_RECORD, 0xA3))
RESETS = frozenset((0x00, 0x01))  # modem status: hardware reset, watchdog timer reset
OK = 0
_END_DEVICE = 2
_COORDINATORS = frozenset((0x0000, 0xFFFE))  # parent of a node that no other node stands between


class AtResponse(NamedTuple):
    """Answer of the own module to a command."""

    frame_id: int
    command: bytes
    status: int
    data: bytes


class RemoteResponse(NamedTuple):
    """Answer of another module to a command; ``address``: its serial number."""

    frame_id: int
    address: int
    command: bytes
    status: int
    data: bytes


class ModemStatus(NamedTuple):
    """The own module reports an event."""

    status: int


class RouteRecord(NamedTuple):
    """Number of modules that relay the packets of a module."""

    address: int
    relays: int


class OtherFrame(NamedTuple):
    """Any other frame."""

    kind: int


Message = AtResponse | RemoteResponse | ModemStatus | RouteRecord | OtherFrame


class Node(NamedTuple):
    """A module that answered the node discovery.

    ``is_relayed``: its packets come by way of another module; None for one that the answer says nothing of.
    """

    address: int
    is_relayed: bool | None


class FrameReader(FrameFinder):
    """Finds the frames in received bytes; in mode 2 a frame may hold the start byte only escaped."""

    START = bytes([START])

    def __init__(self, *, is_escaped: bool) -> None:
        super().__init__()
        self._is_escaped = is_escaped
        self._flips_next = False

    def feed(self, data: bytes) -> list[bytes]:
        """The data of each frame that is complete now."""
        frames = list[bytes]()
        if not self._is_escaped:
            frames += self.find(data)
        else:
            first, *others = data.split(self.START)
            frames += self.find(self._plain(first))
            for part in others:
                self.drop(len(self._buffer))
                self._flips_next = False
                frames += self.find(self.START + self._plain(part))
        return [frame[3:-1] for frame in frames]

    def give_up(self) -> list[bytes]:
        """A frame that is not complete now will not be: its length was damaged. Search its bytes for others."""
        if self._buffer:
            self.drop_start()
        return self.feed(b"")

    def drop_start(self) -> None:
        """No frame begins here: with escapes none begins within it."""
        self.drop(len(self._buffer) if self._is_escaped else 1)

    def _plain(self, data: bytes) -> bytes:
        plain = bytearray()
        for byte in data:
            if byte == ESCAPE:
                self._flips_next = True
                continue
            plain.append(byte ^ FLIP if self._flips_next else byte)
            self._flips_next = False
        return bytes(plain)

    def _size(self, data: bytearray) -> int:
        if len(data) < 3:
            return 0
        size = data[1] << 8 | data[2]
        return size + 4 if 0 < size <= LONGEST else -1

    def _is_right(self, frame: bytes) -> bool:
        return sum(frame[3:]) & 0xFF == 0xFF


def format_frame(data: bytes, *, is_escaped: bool) -> bytes:
    """A frame as bytes."""
    body = len(data).to_bytes(2) + data + bytes([0xFF - (sum(data) & 0xFF)])
    if is_escaped:
        body = b"".join(bytes([ESCAPE, byte ^ FLIP]) if byte in ESCAPED else bytes([byte]) for byte in body)
    return bytes([START]) + body


def format_at(frame_id: int, command: bytes, value: bytes = b"") -> bytes:
    """Data of a command for the own module."""
    return bytes([AT, frame_id]) + command + value


def format_remote_at(frame_id: int, address: int, command: bytes) -> bytes:
    """Data of a command for another module, given by its serial number; its network address need not be known."""
    return bytes([REMOTE_AT, frame_id]) + address.to_bytes(8) + b"\xff\xfe\x00" + command


def parse_frame(data: bytes) -> Message:
    """What a frame says; one that is too short for its type is ``OtherFrame``."""
    kind = data[0]
    if kind == AT_RESPONSE and len(data) >= 5:
        return AtResponse(data[1], data[2:4], data[4], data[5:])
    if kind == REMOTE_RESPONSE and len(data) >= 15:
        return RemoteResponse(data[1], int.from_bytes(data[2:10]), data[12:14], data[14], data[15:])
    if kind == MODEM_STATUS and len(data) >= 2:
        return ModemStatus(data[1])
    if kind == ROUTE_RECORD and len(data) >= 13 and len(data) == 13 + 2 * data[12]:
        return RouteRecord(int.from_bytes(data[1:9]), data[12])
    return OtherFrame(kind)


def parse_node(data: bytes) -> Node | None:
    """One answer to the node discovery ``ND``; None for its end and for what is no such answer.

    Network address (2), serial number (8), with 802.15.4 a level, name, zero. With Zigbee, and with some firmware of
    802.15.4, also parent (2), type, status, profile (2), maker (2), and what ``NO`` adds. The name is not read from
    here, because nothing shows whether a level stands before it. A router may be relayed as well; a route record says
    so.
    """
    _, zero, rest = data[10:].partition(b"\0")
    if not zero:
        return None
    is_relayed = None
    if len(rest) >= 8 and rest[2] == _END_DEVICE:
        is_relayed = int.from_bytes(rest[:2]) not in _COORDINATORS
    return Node(int.from_bytes(data[2:10]), is_relayed)


def name_of(address: int, data: bytes) -> str:
    """The name of a module from its answer to ``NI``; its serial number without one."""
    return data.decode("latin-1").strip("\0 ") or f"{address:016X}"
