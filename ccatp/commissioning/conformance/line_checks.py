"""Checks of lines that are malformed, unusual, split or joined by TCP."""

import time
from collections.abc import Callable
from functools import partial

from ccatp.commissioning.conformance.checks import CheckList, require
from ccatp.commissioning.conformance.connections import CheckContext, ControllerAndMonitor, steady_pair
from ccatp.links.robot_codec import format_drive
from ccatp.links.robot_messages import MAX_LINE_BYTES

CHECKS = CheckList()
TOLERATED = 20  # bad lines in a second
CROWD = 150  # drives in one segment, some 8 KiB
STRANGERS = 40
BYTE_S = 0.002  # between single bytes
# Drives with one thing wrong each; %d is the number, then the frame.
BAD_DRIVES: dict[str, tuple[str, bytes]] = {
    "no-json": ("a line that is no JSON is dropped", b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":0.0\n'),
    "key-twice": ("a key that stands twice makes a bad line",
                  b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wr":0.0,"wl":0.0}\n'),
    "nan": ("numbers are finite", b'{"type":"drive","seq":%d,"ack":%d,"wr":NaN,"wl":0.0}\n'),
    "infinity": ("numbers are finite", b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":Infinity}\n'),
    "overflow": ("numbers are finite", b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":1e999}\n'),
    "key-missing": ("a line that fails a check is dropped", b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0}\n'),
    "text-for-number": ("a line that fails a check is dropped",
                        b'{"type":"drive","seq":%d,"ack":%d,"wr":"0.0","wl":0.0}\n'),
    "no-utf-8": ("lines are UTF-8", b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":0.0,"note":"\xff"}\n'),
}  # fmt: skip


def dropped(template: bytes, context: CheckContext) -> str:
    """A bad drive with the higher number in front of a good one: only if it is dropped does the good one count."""
    pair = steady_pair(context)
    good = context.next_seq()
    bad = good + 1
    pair.drive(good, before=template % (bad, pair.newest.seq))
    frame = pair.echoed(good, bad, otherwise="the good drive behind it was not obeyed")
    require(frame.drive_seq == good, "it came into force")
    pair.steady()
    return "dropped, the drive behind it obeyed"


for _check_id, (_promise, _template) in BAD_DRIVES.items():
    CHECKS.add(_check_id, _promise)(partial(dropped, _template))


@CHECKS.add("unknown-key", "unknown keys are ignored")
def unknown_key(context: CheckContext) -> str:
    """A drive with two more keys."""
    line = b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":0.0,"colour":"red","more":{"x":[1,2,null]}}\n'
    _obeyed(steady_pair(context), lambda seq, ack: line % (seq, ack), "a drive with unknown keys was not obeyed")
    return "a drive with unknown keys is obeyed"


@CHECKS.add("unknown-type", "an unknown type is ignored, and no bad line")
def unknown_type(context: CheckContext) -> str:
    """40 lines at once: more than bad lines are allowed in a second."""
    pair = steady_pair(context)
    pair.controller.send(b'{"type":"dance","seq":7,"partner":null}\n' * STRANGERS)
    pair.run(5 * context.facts.frame_s)
    pair.settle()
    return f"{STRANGERS} lines of an unknown type, the session goes on"


@CHECKS.add("bad-lines-few", "20 bad lines in a second do not close the session")
def few_bad_lines(context: CheckContext) -> str:
    """20 bad lines at once."""
    pair = steady_pair(context)
    pair.controller.send(b"garbage\n" * TOLERATED)
    pair.run(5 * context.facts.frame_s)
    pair.settle()
    return f"{TOLERATED} bad lines at once, the session goes on"


@CHECKS.add("bad-lines-many", "more than 20 bad lines in a second close the session")
def many_bad_lines(context: CheckContext) -> str:
    """21 bad lines at once."""
    link = context.join("monitor")
    link.send(b"garbage\n" * (TOLERATED + 1))
    require(context.is_closed(link), f"{TOLERATED + 1} bad lines at once, and the session is not closed")
    return f"{TOLERATED + 1} bad lines at once close the session"


@CHECKS.add("line-longest", "a line holds up to 8192 bytes")
def longest_line(context: CheckContext) -> str:
    """A drive of 8192 bytes with its LF."""

    def line(seq: int, ack: int) -> bytes:
        head = format_drive(seq, ack, 0.0, 0.0)[:-2] + b',"note":"'
        return head + b"x" * (MAX_LINE_BYTES - len(head) - 3) + b'"}\n'

    _obeyed(steady_pair(context), line, f"a drive of {MAX_LINE_BYTES} bytes was not obeyed")
    return f"a drive of {MAX_LINE_BYTES} bytes is obeyed"


@CHECKS.add("line-too-long", "a line over 8192 bytes closes the session")
def long_line(context: CheckContext) -> str:
    """With and without LF."""
    for end in (b"", b"\n"):
        link = context.join("monitor")
        link.send(b'{"type":"dance","note":"' + b"x" * MAX_LINE_BYTES + b'"}' + end)
        require(context.is_closed(link), f"a line over {MAX_LINE_BYTES} bytes, and the session is not closed")
    return "closes the session"


@CHECKS.add("single-bytes", "one object a line, however TCP chops it")
def single_bytes(context: CheckContext) -> str:
    """A join and a drive, byte by byte."""
    link, hello = context.greet()
    for byte in context.join_line(hello, "monitor"):
        link.send(bytes((byte,)))
        time.sleep(BYTE_S)
    require(context.answer(link)["type"] == "joined", "a join in single bytes is refused")
    context.clear()
    pair = steady_pair(context)
    seq = context.next_seq()
    for byte in format_drive(seq, pair.newest.seq, 0.0, 0.0):
        pair.controller.send(bytes((byte,)))
        pair.pause(BYTE_S)
    pair.mark_driven()
    pair.echoed(seq, otherwise="a drive in single bytes was not obeyed")
    return "join and drive obeyed"


@CHECKS.add("many-lines", "one object a line, however many come at once")
def many_lines(context: CheckContext) -> str:
    """150 drives in one segment: the last counts."""
    pair = steady_pair(context)
    before, first = pair.newest.seq - 1, context.next_seq()
    last = first + CROWD - 1
    while context.next_seq() < last:
        continue
    # Only the last answers the newest frame: where time waits for that, it waits for all of them.
    crowd = b"".join(format_drive(seq, before, 0.0, 0.0) for seq in range(first, last))
    pair.drive(last, before=crowd)
    pair.echoed(last, otherwise=f"the last of {CROWD} drives in one segment was not obeyed")
    return f"the last of {CROWD} drives obeyed"


@CHECKS.add("glued-lines", "one object a line, however TCP glues them")
def glued_lines(context: CheckContext) -> str:
    """Three messages in one segment: an unknown type, fans that change nothing, and a drive."""
    pair = steady_pair(context)
    left, right = pair.newest.fans
    seq = context.next_seq()
    fans = b'{"type":"fans","seq":%d,"duty":[%.6f,%.6f]}\n' % (context.next_seq(), left, right)
    pair.drive(seq, before=b'{"type":"dance"}\n' + fans)
    pair.echoed(seq, otherwise="a drive behind two other lines was not obeyed")
    return "a drive behind two other lines is obeyed"


def _obeyed(pair: ControllerAndMonitor, line: Callable[[int, int], bytes], otherwise: str) -> None:
    """Send a drive as it is, and answer frames until it is echoed."""
    seq = pair.context.next_seq()
    pair.controller.send(line(seq, pair.newest.seq))
    pair.mark_driven()
    pair.echoed(seq, otherwise=otherwise)
