"""Edge. Stories of lines that are wrong, odd, chopped or glued."""

import time
from collections.abc import Callable

from ccatp.conformance.pair import Pair
from ccatp.conformance.stage import Stage
from ccatp.conformance.verdict import require
from ccatp.wire.lines import MAX_LINE_BYTES
from ccatp.wire.robot import format_drive

TOLERATED = 20  # bad lines in a second
CROWD = 150  # drives in one segment, some 8 KiB
STRANGERS = 40
BYTE_S = 0.002  # between single bytes
# Drives with one thing wrong each; %d is the number, then the frame.
BAD_DRIVES: dict[str, bytes] = {
    "no-json": b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":0.0\n',
    "key-twice": b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wr":0.0,"wl":0.0}\n',
    "nan": b'{"type":"drive","seq":%d,"ack":%d,"wr":NaN,"wl":0.0}\n',
    "infinity": b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":Infinity}\n',
    "overflow": b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":1e999}\n',
    "key-missing": b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0}\n',
    "text-for-number": b'{"type":"drive","seq":%d,"ack":%d,"wr":"0.0","wl":0.0}\n',
    "no-utf-8": b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":0.0,"note":"\xff"}\n',
}


def dropped(kind: str) -> Callable[[Stage], str]:
    """A bad drive with the higher number in front of a good one: only if it is dropped does the good one count."""
    template = BAD_DRIVES[kind]

    def story(stage: Stage) -> str:
        pair = Pair(stage)
        pair.steady()
        good = stage.next_seq()
        bad = good + 1
        pair.drive(good, before=template % (bad, pair.newest.seq))
        frame = pair.echoed(good, bad, otherwise="the good drive behind it was not obeyed")
        require(frame.drive_seq == good, "it came into force")
        pair.steady()
        return "dropped, the drive behind it obeyed"

    return story


def unknown_key(stage: Stage) -> str:
    """A good drive with keys of its own."""
    pair = Pair(stage)
    pair.steady()
    line = b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":0.0,"colour":"red","more":{"x":[1,2,null]}}\n'
    _obeyed(pair, lambda seq, ack: line % (seq, ack), "a drive with unknown keys was not obeyed")
    return "a drive with unknown keys is obeyed"


def unknown_type(stage: Stage) -> str:
    """More of them in a second than bad lines are allowed."""
    pair = Pair(stage)
    pair.steady()
    pair.controller.send(b'{"type":"dance","seq":7,"partner":null}\n' * STRANGERS)
    pair.run(5 * stage.facts.frame_s)
    pair.settle()
    return f"{STRANGERS} lines of an unknown type, the session goes on"


def few_bad_lines(stage: Stage) -> str:
    """As many as are allowed."""
    pair = Pair(stage)
    pair.steady()
    pair.controller.send(b"garbage\n" * TOLERATED)
    pair.run(5 * stage.facts.frame_s)
    pair.settle()
    return f"{TOLERATED} bad lines at once, the session goes on"


def many_bad_lines(stage: Stage) -> str:
    """One more, on a session that nobody needs."""
    link = stage.join("monitor")
    link.send(b"garbage\n" * (TOLERATED + 1))
    require(stage.is_closed(link), f"{TOLERATED + 1} bad lines at once, and the session is not closed")
    return f"{TOLERATED + 1} bad lines at once close the session"


def long_line(stage: Stage) -> str:
    """A line over the limit, with and without its end."""
    for end in (b"", b"\n"):
        link = stage.join("monitor")
        link.send(b'{"type":"dance","note":"' + b"x" * MAX_LINE_BYTES + b'"}' + end)
        require(stage.is_closed(link), f"a line over {MAX_LINE_BYTES} bytes, and the session is not closed")
    return "closes the session"


def longest_line(stage: Stage) -> str:
    """A drive of just the limit, LF included."""
    pair = Pair(stage)
    pair.steady()

    def line(seq: int, ack: int) -> bytes:
        head = format_drive(seq, ack, 0.0, 0.0)[:-2] + b',"note":"'
        return head + b"x" * (MAX_LINE_BYTES - len(head) - 3) + b'"}\n'

    _obeyed(pair, line, f"a drive of {MAX_LINE_BYTES} bytes was not obeyed")
    return f"a drive of {MAX_LINE_BYTES} bytes is obeyed"


def single_bytes(stage: Stage) -> str:
    """A join and a drive, byte by byte."""
    link, hello = stage.greet()
    for byte in stage.join_line(hello, "monitor"):
        link.send(bytes((byte,)))
        time.sleep(BYTE_S)
    require(stage.answer(link)["type"] == "joined", "a join in single bytes is refused")
    stage.clear()
    pair = Pair(stage)
    pair.steady()
    seq = stage.next_seq()
    for byte in format_drive(seq, pair.newest.seq, 0.0, 0.0):
        pair.controller.send(bytes((byte,)))
        pair.pause(BYTE_S)
    pair.mark_driven()
    pair.echoed(seq, otherwise="a drive in single bytes was not obeyed")
    return "join and drive obeyed"


def many_lines(stage: Stage) -> str:
    """Drives in one segment: the last counts."""
    pair = Pair(stage)
    pair.steady()
    before, first = pair.newest.seq - 1, stage.next_seq()
    last = first + CROWD - 1
    while stage.next_seq() < last:
        continue
    # Only the last answers the newest frame: where time waits for that, it waits for all of them.
    crowd = b"".join(format_drive(seq, before, 0.0, 0.0) for seq in range(first, last))
    pair.drive(last, before=crowd)
    pair.echoed(last, otherwise=f"the last of {CROWD} drives in one segment was not obeyed")
    return f"the last of {CROWD} drives obeyed"


def glued_lines(stage: Stage) -> str:
    """An unknown type, fans that change nothing, and a drive, in one segment."""
    pair = Pair(stage)
    left, right = pair.steady().fans
    seq = stage.next_seq()
    fans = b'{"type":"fans","seq":%d,"duty":[%.6f,%.6f]}\n' % (stage.next_seq(), left, right)
    pair.drive(seq, before=b'{"type":"dance"}\n' + fans)
    pair.echoed(seq, otherwise="a drive behind two other lines was not obeyed")
    return "a drive behind two other lines is obeyed"


def _obeyed(pair: Pair, line: Callable[[int, int], bytes], otherwise: str) -> None:
    """Send a drive as it is, and answer frames until it is echoed."""
    seq = pair.stage.next_seq()
    pair.controller.send(line(seq, pair.newest.seq))
    pair.mark_driven()
    pair.echoed(seq, otherwise=otherwise)
