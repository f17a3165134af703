"""Serial devices of a robot among beacons: a driver names the device that answers where another one was expected."""

from math import inf

from ccatp.beacons.links.arcos_packets import PacketReader, format_greeting
from ccatp.beacons.links.cricket_lines import ASK_REPORT, LineReader
from ccatp.beacons.links.xbee_frames import FrameReader, format_at, format_frame
from ccatp.onboard.devices.serial_device import SerialDevice

ANSWER_S = 4.0
PATIENCE_S = 8.0  # for the answer of a device
# What each device answers to, and what the others ignore.
QUESTIONS = format_frame(format_at(1, b"AP"), is_escaped=False) + format_greeting() + ASK_REPORT
_SEEN_BYTES = 512  # that are kept to recognize another device


def recognize(data: bytes) -> str:
    """The device that sent these bytes, for messages; empty if it is none of the known ones."""
    if any(FrameReader(is_escaped=is_escaped).feed(data) for is_escaped in (False, True)):
        return "an XBee"
    if PacketReader().feed(data):
        return "a Pioneer base"
    reader = LineReader()
    if reader.feed(data + b"\n") or reader.report.mode is not None or reader.counts["silent"]:
        return "a Cricket mote"
    return ""


class BeaconDevice(SerialDevice):
    """A device whose port may have been exchanged with that of another one."""

    answer_s, patience_s = ANSWER_S, PATIENCE_S
    _seen = b""
    _asks_s = inf  # when any known device is asked to show itself

    def _begin(self, now_s: float) -> None:
        self._seen, self._asks_s = b"", now_s + 0.5 * ANSWER_S

    def _receive(self, data: bytes, now_s: float) -> None:
        """Keep what was received; ask all known devices while this one does not answer."""
        self._seen = (self._seen + data)[-_SEEN_BYTES:]
        if now_s >= self._asks_s and not self.is_ready and now_s - self._line.valid_s > 0.4 * ANSWER_S:
            self._asks_s = inf
            self._line.write(QUESTIONS)

    def why(self) -> str:
        """The reason why it is not ready; another device that answers on its port."""
        if self._line.is_open and self._line.garbage and (other := recognize(self._seen)):
            return f"{other} answers on its port; exchange the ports, or correct {self.key}.device"
        return super().why()
