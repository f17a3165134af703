"""Stories of hello, join and roles.

Stories of lines that are wrong, odd, chopped or glued.
"""

import time
from collections.abc import Callable

from ccatp.commissioning.conformance import judges as judge_hello
from ccatp.commissioning.conformance.connections import ALL, STILL, CheckContext, ControllerAndMonitor, RawConnection
from ccatp.commissioning.conformance.judges import CheckFailed, NotApplicable, require
from ccatp.links.robot_codec import encode, format_drive, join_mac
from ccatp.links.robot_messages import MAX_LINE_BYTES, Drive, Role

CONNECTIONS = 8
JOIN_S = 2.0
IN_TIME_S, LATE_S = 1.0, 2.1  # after the hello
SILENCE_S, STILL_HELD_S, TAKEN_S = 5.0, 3.5, 5.3
NOISE_S = 0.3  # between bad lines of a holder that says nothing else
ROLES: tuple[Role, Role] = ("controller", "monitor")


def hello_fields(stage: CheckContext) -> str:
    """One hello."""
    return judge_hello.judge_fields(stage.greet()[1])


def hello_robot(stage: CheckContext) -> str:
    """What it says of the robot."""
    return judge_hello.judge_robot(stage.greet()[1])


def nonces(stage: CheckContext) -> str:
    """Several connections."""
    return judge_hello.judge_nonces([stage.greet()[1] for _ in range(CONNECTIONS)])


def boots(stage: CheckContext) -> str:
    """Several connections."""
    return judge_hello.judge_boots([stage.greet()[1] for _ in range(CONNECTIONS)])


def join_both(stage: CheckContext) -> str:
    """Each role, at once."""
    said = []
    for role in ROLES:
        link, hello = stage.greet()
        link.send(stage.join_line(hello, role))
        said.append(_joined(stage, link, role))
    return "; ".join(said)


def join_in_time(stage: CheckContext) -> str:
    """A client that takes its time."""
    link, hello = stage.greet()
    require(not stage.is_closed(link, IN_TIME_S), f"closed within {IN_TIME_S:g} s of the hello")
    link.send(stage.join_line(hello, "monitor"))
    answer = stage.answer(link)
    require(answer["type"] == "joined", f"refused {IN_TIME_S:g} s after the hello: {answer.get('reason')}")
    return f"joined {IN_TIME_S:g} s after the hello"


def join_late(stage: CheckContext) -> str:
    """A client that takes too long."""
    began_s = time.monotonic()
    link, hello = stage.greet()
    stage.is_closed(link, LATE_S)
    spent_s = time.monotonic() - began_s
    if not link.is_ended and not link.lines:
        link.send(stage.join_line(hello, "controller"))
        spent_s = time.monotonic() - began_s
    else:
        require(spent_s > 0.9 * JOIN_S, f"closed {spent_s:.2f} s after the hello")
    return f"{spent_s:.2f} s after the hello: {_refused(stage, link, ('bad join',))}"


def join_unknown_role(stage: CheckContext) -> str:
    """A role that there is not."""
    link, _ = stage.greet()
    link.send(b'{"type":"join","role":"king","client":"conformance","mac":""}\n')
    return _refused(stage, link, ("bad join",))


def join_without_client(stage: CheckContext) -> str:
    """A join with a key missing."""
    link, _ = stage.greet()
    link.send(b'{"type":"join","role":"controller"}\n')
    return _refused(stage, link, ("bad join",))


def command_before_join(stage: CheckContext) -> str:
    """A drive as the first message."""
    link, _ = stage.greet()
    link.send(encode(Drive(seq=stage.next_seq(), ack=0, wr=0.0, wl=0.0)))
    return _refused(stage, link, ("bad join",))


def role_taken(stage: CheckContext) -> str:
    """A second client for each role."""
    holders = [stage.join(role) for role in ROLES]
    said = ""
    for role in ROLES:
        link, hello = stage.greet()
        link.send(stage.join_line(hello, role))
        said = _refused(stage, link, ("role taken",))
    stage.poll(0.0)
    require(not any(holder.is_ended for holder in holders), "the holder's session was closed")
    return said


def refused_is_harmless(stage: CheckContext) -> str:
    """Clients that are refused for every reason, while two others drive."""
    pair = ControllerAndMonitor(stage)
    pair.steady()
    first = len(pair.frames)
    intruders = 0
    for role in ROLES:
        for line in (None, b'{"type":"join","role":"king","client":"conformance"}\n'):
            link, hello = stage.greet()
            pair.run(2 * stage.facts.frame_s)
            if not stage.facts.is_lockstep:
                pair.rates = pair.allowed = None  # what was sent has to last
            link.send(stage.join_line(hello, role) if line is None else line)
            require(stage.is_closed(link), "a refused client's connection stays open")
            intruders += 1
            pair.run(3 * stage.facts.frame_s)
            pair.rates, pair.allowed = STILL, ALL
    pair.run(5 * stage.facts.frame_s)
    pair.settle()
    limit_s = stage.facts.ttl_s - 2 * stage.facts.frame_s
    for frame in pair.frames[first:]:
        fresh = frame.age_s < limit_s and frame.permit_age_s < limit_s
        require(not (frame.is_held and fresh), f"the holder's drive of {frame.age_s:.3f} s is held after a refusal")
    return f"{intruders} refused, {len(pair.frames) - first} frames of the holders go on"


def mac_right(stage: CheckContext) -> str:
    """The right mac."""
    _needs_key(stage)
    link, hello = stage.greet()
    link.send(stage.join_line(hello, "monitor"))
    return _joined(stage, link, "monitor")


def mac_wrong(stage: CheckContext) -> str:
    """A mac made with another key."""
    key = _needs_key(stage)
    link, hello = stage.greet()
    link.send(stage.join_line(hello, "monitor", join_mac(key + b"x", str(hello["nonce"]), "monitor")))
    return _refused(stage, link, ("bad mac",))


def mac_missing(stage: CheckContext) -> str:
    """No mac."""
    _needs_key(stage)
    link, _ = stage.greet()
    link.send(b'{"type":"join","role":"monitor","client":"conformance"}\n')
    return _refused(stage, link, ("bad mac", "bad join"))


def mac_of_another(stage: CheckContext) -> str:
    """A mac that was right on another connection."""
    _needs_key(stage)
    _, other = stage.greet()
    link, _ = stage.greet()
    link.send(stage.join_line(other, "monitor"))
    return _refused(stage, link, ("bad mac",))


def mac_of_the_other_role(stage: CheckContext) -> str:
    """A mac that is right for the other role."""
    key = _needs_key(stage)
    link, hello = stage.greet()
    link.send(stage.join_line(hello, "monitor", join_mac(key, str(hello["nonce"]), "controller")))
    return _refused(stage, link, ("bad mac",))


def take_over(stage: CheckContext) -> str:
    """A holder that sends nothing but bad lines."""
    pair = ControllerAndMonitor(stage)
    pair.steady()
    pair.rates = None
    silent_s = pair.newest.t_s
    _be_noisy(pair, silent_s + STILL_HELD_S)
    link, hello = stage.greet()
    link.send(stage.join_line(hello, "controller"))
    answer = stage.answer(link)
    pair.pause(0.0)
    if answer["type"] == "joined":
        early_s = pair.newest.t_s - silent_s
        require(early_s > SILENCE_S, f"taken over after a silence of {early_s:.2f} s")
        raise NotApplicable("the server or this machine is too slow to tell")
    _be_noisy(pair, silent_s + TAKEN_S)
    try:
        # Not for long: now the holder is silent altogether.
        link = stage.join("controller", patience_s=0.2 * SILENCE_S)
    except CheckFailed as broken:
        raise CheckFailed(
            f"{broken} after {pair.newest.t_s - silent_s:.2f} s without a valid line of its holder"
        ) from None
    return f"refused at {STILL_HELD_S:g} s of silence, joined at {TAKEN_S:g} s"


def _be_noisy(pair: ControllerAndMonitor, until_s: float) -> None:
    while pair.newest.t_s < until_s:
        pair.controller.send(b'{"type":"drive","seq":\n')
        pair.run(NOISE_S)


def _needs_key(stage: CheckContext) -> bytes:
    if stage.key is None:
        raise NotApplicable("no --key")
    return stage.key


def _joined(stage: CheckContext, link: RawConnection, role: Role) -> str:
    answer = stage.answer(link)
    require(answer["type"] == "joined", f"{role} refused: {answer.get('reason')}")
    session = answer.get("session")
    require(answer.get("role") == role, f"joined as {answer.get('role')!r} instead of {role}")
    require(isinstance(session, int) and not isinstance(session, bool), f"joined with session = {session!r}")
    return f"{role} joined, session {session}"


def _refused(stage: CheckContext, link: RawConnection, reasons: tuple[str, ...]) -> str:
    """Wait for a refusal and the end of the connection; a close without a word is one where only time has run out."""
    answer = stage.answer(link)
    require(answer["type"] == "refused", f"{answer['type']} instead of refused: {' or '.join(reasons)}")
    require(answer.get("reason") in reasons, f"refused: {answer.get('reason')!r} instead of {' or '.join(reasons)}")
    require(stage.is_closed(link), f"refused: {answer['reason']}, and not closed")
    require(not link.lines, "a line after refused")
    return f"refused: {answer['reason']}, closed"


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


def dropped(kind: str) -> Callable[[CheckContext], str]:
    """A bad drive with the higher number in front of a good one: only if it is dropped does the good one count."""
    template = BAD_DRIVES[kind]

    def story(stage: CheckContext) -> str:
        pair = ControllerAndMonitor(stage)
        pair.steady()
        good = stage.next_seq()
        bad = good + 1
        pair.drive(good, before=template % (bad, pair.newest.seq))
        frame = pair.echoed(good, bad, otherwise="the good drive behind it was not obeyed")
        require(frame.drive_seq == good, "it came into force")
        pair.steady()
        return "dropped, the drive behind it obeyed"

    return story


def unknown_key(stage: CheckContext) -> str:
    """A good drive with keys of its own."""
    pair = ControllerAndMonitor(stage)
    pair.steady()
    line = b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":0.0,"colour":"red","more":{"x":[1,2,null]}}\n'
    _obeyed(pair, lambda seq, ack: line % (seq, ack), "a drive with unknown keys was not obeyed")
    return "a drive with unknown keys is obeyed"


def unknown_type(stage: CheckContext) -> str:
    """More of them in a second than bad lines are allowed."""
    pair = ControllerAndMonitor(stage)
    pair.steady()
    pair.controller.send(b'{"type":"dance","seq":7,"partner":null}\n' * STRANGERS)
    pair.run(5 * stage.facts.frame_s)
    pair.settle()
    return f"{STRANGERS} lines of an unknown type, the session goes on"


def few_bad_lines(stage: CheckContext) -> str:
    """As many as are allowed."""
    pair = ControllerAndMonitor(stage)
    pair.steady()
    pair.controller.send(b"garbage\n" * TOLERATED)
    pair.run(5 * stage.facts.frame_s)
    pair.settle()
    return f"{TOLERATED} bad lines at once, the session goes on"


def many_bad_lines(stage: CheckContext) -> str:
    """One more, on a session that nobody needs."""
    link = stage.join("monitor")
    link.send(b"garbage\n" * (TOLERATED + 1))
    require(stage.is_closed(link), f"{TOLERATED + 1} bad lines at once, and the session is not closed")
    return f"{TOLERATED + 1} bad lines at once close the session"


def long_line(stage: CheckContext) -> str:
    """A line over the limit, with and without its end."""
    for end in (b"", b"\n"):
        link = stage.join("monitor")
        link.send(b'{"type":"dance","note":"' + b"x" * MAX_LINE_BYTES + b'"}' + end)
        require(stage.is_closed(link), f"a line over {MAX_LINE_BYTES} bytes, and the session is not closed")
    return "closes the session"


def longest_line(stage: CheckContext) -> str:
    """A drive of just the limit, LF included."""
    pair = ControllerAndMonitor(stage)
    pair.steady()

    def line(seq: int, ack: int) -> bytes:
        head = format_drive(seq, ack, 0.0, 0.0)[:-2] + b',"note":"'
        return head + b"x" * (MAX_LINE_BYTES - len(head) - 3) + b'"}\n'

    _obeyed(pair, line, f"a drive of {MAX_LINE_BYTES} bytes was not obeyed")
    return f"a drive of {MAX_LINE_BYTES} bytes is obeyed"


def single_bytes(stage: CheckContext) -> str:
    """A join and a drive, byte by byte."""
    link, hello = stage.greet()
    for byte in stage.join_line(hello, "monitor"):
        link.send(bytes((byte,)))
        time.sleep(BYTE_S)
    require(stage.answer(link)["type"] == "joined", "a join in single bytes is refused")
    stage.clear()
    pair = ControllerAndMonitor(stage)
    pair.steady()
    seq = stage.next_seq()
    for byte in format_drive(seq, pair.newest.seq, 0.0, 0.0):
        pair.controller.send(bytes((byte,)))
        pair.pause(BYTE_S)
    pair.mark_driven()
    pair.echoed(seq, otherwise="a drive in single bytes was not obeyed")
    return "join and drive obeyed"


def many_lines(stage: CheckContext) -> str:
    """Drives in one segment: the last counts."""
    pair = ControllerAndMonitor(stage)
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


def glued_lines(stage: CheckContext) -> str:
    """An unknown type, fans that change nothing, and a drive, in one segment."""
    pair = ControllerAndMonitor(stage)
    left, right = pair.steady().fans
    seq = stage.next_seq()
    fans = b'{"type":"fans","seq":%d,"duty":[%.6f,%.6f]}\n' % (stage.next_seq(), left, right)
    pair.drive(seq, before=b'{"type":"dance"}\n' + fans)
    pair.echoed(seq, otherwise="a drive behind two other lines was not obeyed")
    return "a drive behind two other lines is obeyed"


def _obeyed(pair: ControllerAndMonitor, line: Callable[[int, int], bytes], otherwise: str) -> None:
    """Send a drive as it is, and answer frames until it is echoed."""
    seq = pair.stage.next_seq()
    pair.controller.send(line(seq, pair.newest.seq))
    pair.mark_driven()
    pair.echoed(seq, otherwise=otherwise)
