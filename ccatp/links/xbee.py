"""XBee API frames: the levels of radios that a coordinator reports on the serial line.

802.15.4 firmware, API mode: 0x7E, length (2 bytes), frame data, checksum (0xFF minus the sum of the data). Received
packets (0x80, 0x81) carry the level as a byte of -dBm; the answer to a node discovery (0x88, "ND") carries it in DB,
with the serial number in SH and SL and the node identifier in NI (Hevrdejs and Knoll 2017, data packet).
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

START = 0x7E
ESCAPE = 0x7D
_ESCAPED = frozenset((START, ESCAPE, 0x11, 0x13))
_FLIP = 0x20
_LONGEST = 256  # no 802.15.4 frame with its addresses is longer
_RECEIVED_64, _RECEIVED_16, _COMMAND_ANSWER = 0x80, 0x81, 0x88
_OK = 0


class XbeeLevel(NamedTuple):
    """One radio (the text that it sends, or its NI) and its level.

    ``address``: 64-bit serial number, or the 16-bit address where only that is known.
    """

    node: str
    address: int
    rssi_dbm: float


class XbeeFrames:
    """Takes bytes as they come and gives the levels in whole frames.

    Bytes before a start, frames with a wrong checksum or an impossible length, and frames that tell no level are left
    out; the former two are counted. ``escaped``: API mode 2, in which 0x7E, 0x7D, 0x11 and 0x13 are escaped.
    """

    def __init__(self, *, escaped: bool) -> None:
        self._escaped = escaped
        self._buffer = bytearray()
        self.bad = 0

    def feed(self, data: bytes) -> list[XbeeLevel]:
        """The levels of the frames that these bytes complete."""
        self._buffer += data
        return [level for frame in self._frames() if (level := level_of(frame)) is not None]

    def _frames(self) -> Iterator[bytes]:
        while (start := self._buffer.find(START)) >= 0:
            del self._buffer[:start]
            body, ends = self._unescaped()
            if len(body) < 2:
                return
            length = int.from_bytes(body[:2], "big")
            if not 1 <= length <= _LONGEST:
                self._skip()
            elif len(body) < length + 3:
                # In mode 2 a start inside a frame means that the rest of this one is lost.
                if not self._escaped or self._buffer.find(START, 1) < 0:
                    return
                self._skip()
            elif sum(body[2 : length + 3]) & 0xFF != 0xFF:
                self._skip()
            else:
                yield bytes(body[2 : length + 2])
                del self._buffer[: ends[length + 2]]
        self._buffer.clear()

    def _skip(self) -> None:
        self.bad += 1
        del self._buffer[0]

    def _unescaped(self) -> tuple[bytearray, Sequence[int]]:
        """What follows the start, as far as it belongs to this frame, and where each byte of it ends in the buffer."""
        if not self._escaped:
            return self._buffer[1:], range(2, len(self._buffer) + 1)
        body, ends, flip = bytearray(), list[int](), 0
        for index, byte in enumerate(self._buffer[1:], start=2):
            if byte == START:
                break
            if byte == ESCAPE:
                flip = _FLIP
                continue
            body.append(byte ^ flip)
            ends.append(index)
            flip = 0
        return body, ends


def level_of(frame: bytes) -> XbeeLevel | None:
    """The radio and level in the data of a frame; None where there is none, or they end too early."""
    kind = frame[0]
    if kind == _RECEIVED_16 and len(frame) >= 5:
        return XbeeLevel(_text(frame[5:]), int.from_bytes(frame[1:3], "big"), -float(frame[3]))
    if kind == _RECEIVED_64 and len(frame) >= 11:
        return XbeeLevel(_text(frame[11:]), int.from_bytes(frame[1:9], "big"), -float(frame[9]))
    # 0x88, frame number, "ND", status, then MY (2), SH (4), SL (4), DB (1), NI (text and a zero)
    if kind == _COMMAND_ANSWER and len(frame) >= 16 and frame[2:4] == b"ND" and frame[4] == _OK:
        return XbeeLevel(_text(frame[16:]), int.from_bytes(frame[7:15], "big"), -float(frame[15]))
    return None


def xbee_frame(data: bytes, *, escaped: bool) -> bytes:
    """A whole frame around its data; ``ValueError``: the data are empty or longer than any frame."""
    if not 1 <= len(data) <= _LONGEST:
        raise ValueError(f"frame data of {len(data)} bytes; an XBee frame has 1 to {_LONGEST}")
    body = len(data).to_bytes(2, "big") + data + bytes([0xFF - (sum(data) & 0xFF)])
    if not escaped:
        return bytes([START]) + body
    return bytes([START]) + b"".join(bytes([ESCAPE, b ^ _FLIP]) if b in _ESCAPED else bytes([b]) for b in body)


def _text(data: bytes) -> str:
    """Up to the first zero; bytes that are no ASCII show as a question mark."""
    return data.split(b"\0", 1)[0].decode("ascii", errors="replace").replace("\ufffd", "?").strip()
