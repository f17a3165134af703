"""Which of the known devices answers on a serial line where another one was expected."""

from ccatp.beacons.links.arcos_packets import SYNC0, PacketReader, format_command
from ccatp.beacons.links.cricket_lines import LineReader
from ccatp.beacons.links.xbee_frames import FrameReader, format_at, format_frame

# What each device answers to, and what the others ignore.
QUESTIONS = format_frame(format_at(1, b"AP"), is_escaped=False) + format_command(SYNC0) + b"\rG CF\r"


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
