"""Checks of the robot's reaction to commands: drive and permit, sequence numbers, lost sessions, fans, bad lines.

The commanded wheel rates are zero. Fan duties change by a few hundredths; only ``fan_floor`` requests less than the
floor. The ages in a frame give the arrival time of a message on the robot's clock, so a slow network or a stalled
client is not reported as a fault of the robot.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial

from ccatp.commissioning.conformance.harness import (
    DUTY_TOLERANCE,
    STILL,
    CheckContext,
    CheckFailed,
    CheckList,
    ControllerAndMonitor,
    Ending,
    Frame,
    Key,
    NotApplicable,
    Pair,
    require,
    steady,
)
from ccatp.core import ALL_MOTION, NO_MOTION
from ccatp.links.robot_codec import MAX_LINE_BYTES, encode, format_drive
from ccatp.links.robot_messages import Fans

CHECKS = CheckList()
check, check_steady = CHECKS.add, partial(CHECKS.add, fixture=steady)
AFTER_TTL_S = 0.3  # observed after the end of the time-to-live
SHORT_S = 0.12  # wall time within which a message arrives on loopback or a local network; below every useful ttl_s
NOISE_S = 0.08  # between bad lines: fewer than 20 a second
ATTEMPTS = 6
AHEAD = 1000
LOST_S = 0.05
EARLY_FRAMES, LATE_FRAMES = 2, 3  # a robot acts once a frame
FAN_STEPS = 0.05, 0.03  # left, right
ENDINGS: tuple[Ending, Ending] = ("FIN", "RST")
TOLERATED = 20  # bad lines in a second
CROWD = 150  # drives in one segment, about 8 KiB
STRANGERS = 40
BYTE_S = 0.002  # between single bytes

# -- drive and permit -------------------------------------------------------------------------------------------------


def _always_held(key: Key, context: CheckContext) -> str:
    pair = ControllerAndMonitor(context)
    pair.withhold(key)
    facts = context.facts
    frames = pair.run(facts.ttl_s + AFTER_TTL_S)
    begin_s = frames[0].t + facts.ttl_s + LATE_FRAMES * facts.frame_s
    late = [frame for frame in frames if frame.t > begin_s]
    require(bool(late), "no frames")
    require(all(frame.cmd.held for frame in late), f"not held with no {key} for {late[-1].t - frames[0].t:.2f} s")
    return f"held in {len(late)} frames with no {key}"


def _ttl(key: Key, pair: ControllerAndMonitor) -> str:
    pair.withhold(key)
    frames = pair.run(pair.facts.ttl_s + AFTER_TTL_S)
    return check_ttl(frames, key, pair.facts.ttl_s, pair.facts.frame_s)


check("no-permit", "once a monitor has joined, wheels are held without its permit", "real time")(
    partial(_always_held, "permit")
)
check("no-drive", "wheels are held without a drive", "real time")(partial(_always_held, "drive"))
check_steady("ttl-drive", "a drive is in force for ttl_s", "real time")(partial(_ttl, "drive"))
check_steady("ttl-permit", "a permit is in force for ttl_s", "real time")(partial(_ttl, "permit"))


def _noise(key: Key, line: bytes, pair: ControllerAndMonitor) -> str:
    """The controller sends lines that must not count as a drive or permit, in place of drives or permits."""
    facts = pair.facts
    pair.withhold(key)
    first, begin_s = len(pair.frames), pair.newest.t
    while pair.newest.t < begin_s + facts.ttl_s + AFTER_TTL_S:
        pair.controller.send(line % (pair.context.next_seq(), pair.newest.seq))
        pair.run(NOISE_S)
    return check_ttl(pair.frames[first:], key, facts.ttl_s, facts.frame_s)


BAD_DRIVE = b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":"0"}\n'
PERMIT = b'{"type":"permit","seq":%d,"ack":%d,"forward":true,"reverse":true,"turn":true}\n'
check_steady("ttl-noise", "a bad line never refreshes a time-out", "real time")(partial(_noise, "drive", BAD_DRIVE))
check_steady("role-permit", "permits are the monitor's", "real time")(partial(_noise, "permit", PERMIT))


def check_ttl(frames: Sequence[Frame], key: Key, ttl_s: float, frame_s: float) -> str:
    """The robot is held when the last drive or permit expires, and not before.

    ``frames`` begin at that drive or permit; the other command is renewed in each frame.
    """
    held_s: float | None = None
    has_moved, age_s = False, 0.0
    for frame in frames:
        age_s = frame.age_s(key)
        seen = f"held at a {key} age of {age_s:.3f} s, ttl_s {ttl_s:g}"
        if frame.cmd.held:
            is_due = max(frame.cmd.age, frame.cmd.permit_age) >= ttl_s - EARLY_FRAMES * frame_s
            require(is_due or not has_moved, seen)
            held_s = age_s if held_s is None else held_s
        else:
            has_moved, held_s = True, None
            require(age_s <= ttl_s + LATE_FRAMES * frame_s, f"not {seen}")
    span_s = frames[-1].t - frames[0].t
    require(held_s is not None, f"not held {span_s:.2f} s after the last {key}, its reported age {age_s:.3f} s")
    return f"held at a {key} age of {held_s:.3f} s, ttl_s {ttl_s:g}"


@check_steady("newest-drive", "a drive with an older or equal seq is dropped")
def _newest_drive(pair: ControllerAndMonitor) -> str:
    is_lockstep = pair.facts.lockstep
    newest = pair.context.next_seq()
    old = newest - 1
    pair.rates = None
    first = len(pair.frames)
    if is_lockstep:
        pair.allowed = None  # the frame waits until both have arrived
    pair.drive(newest)
    pair.drive(old)
    _pause_and_settle(pair)
    frames = pair.frames[first:]
    require(all(frame.cmd.seq != old for frame in frames), f"drive {old} came into force after {newest}")
    require(any(frame.cmd.seq == newest for frame in frames), f"drive {newest} never came into force")
    again, first = pair.context.next_seq(), len(pair.frames)
    pair.rates = None
    pair.drive(again)
    if is_lockstep:
        _answered_frame(pair)
        pair.drive(again)
        pair.permit()
    else:
        pair.run(SHORT_S)
        pair.drive(again)
    pair.pause(SHORT_S)
    pair.answer_again()
    _pause_and_settle(pair)
    in_force = [frame for frame in pair.frames[first:] if frame.cmd.seq == again]
    require(bool(in_force), f"drive {again} never came into force")
    # The age must not start again. A robot that sends late frames afterwards reports age 0 for a message that arrived
    # after the frame's time.
    arrivals_s = [frame.arrival_s("drive") for frame in in_force if frame.cmd.age > 0.0]
    spread_s = max(arrivals_s) - min(arrivals_s) if arrivals_s else 0.0
    late = f"a second drive {again} came into force {1e3 * spread_s:.0f} ms after the first"
    require(spread_s <= 0.5 * pair.facts.frame_s, late)
    return f"drive {old} after {newest} and a second {again} dropped"


def _pause_and_settle(pair: ControllerAndMonitor) -> None:
    """Wait until the sent messages have arrived, then answer frames again."""
    pair.pause(SHORT_S)
    pair.rates, pair.allowed = STILL, ALL_MOTION
    pair.settle()


def _answered_frame(pair: ControllerAndMonitor) -> Frame:
    return pair.next_frame("no frame after drive and permit for the one before")


@check_steady("newest-permit", "a permit with an older or equal seq is dropped")
def _newest_permit(pair: ControllerAndMonitor) -> str:
    newest = pair.context.next_seq()
    pair.allowed = None
    pair.permit(newest)
    if pair.facts.lockstep:
        in_force = _answered_frame(pair)
    else:
        half_s = 0.5 * pair.facts.ttl_s  # then no earlier permit is still on its way
        in_force = pair.expect(lambda frame: frame.cmd.permit_age >= half_s, "permits do not age")
    # The age shows which permit is in force.
    latest_s = in_force.arrival_s("permit") + 0.5 * pair.facts.frame_s
    for seq in (newest - 1, newest):
        if pair.facts.lockstep:
            pair.drive()
        pair.permit(seq)
        is_dropped = all(frame.arrival_s("permit") <= latest_s for frame in pair.pause(SHORT_S))
        require(is_dropped, f"permit {seq} came into force after {newest}")
    pair.answer_again()
    pair.steady()
    return f"permit {newest - 1} after {newest} and a second {newest} dropped"


@check_steady("role-drive", "drives are the controller's")
def _wrong_role(pair: ControllerAndMonitor) -> str:
    seq = pair.newest.cmd.seq + AHEAD  # if the robot accepts it, it stays the newest for some frames
    pair.monitor.send(b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":0.0}\n' % (seq, pair.newest.seq))
    pair.find(lambda frame: frame.cmd.seq == seq, 10 * pair.facts.frame_s)
    require(pair.newest.cmd.seq != seq, f"drive {seq} of the monitor came into force")
    pair.context.last_seq = max(pair.context.last_seq, seq)
    pair.settle()
    return "a drive of the monitor does nothing"


# -- lost sessions ----------------------------------------------------------------------------------------------------


def _lost(key: Key, ending: Ending, context: CheckContext) -> str:
    """The session that sends ``key`` ends, and the other session sends a last message immediately after."""
    witness: Key = "permit" if key == "drive" else "drive"
    for _ in range(ATTEMPTS):
        with steady(context) as pair:
            frames = _end(pair, key, witness, ending)
        seen = check_lost(frames, witness, context.facts.ttl_s, context.facts.frame_s)
        if seen is not None:
            return seen
        context.clear()
    raise NotApplicable("the server or this machine is too slow for this check")


def _end(pair: ControllerAndMonitor, key: Key, witness: Key, ending: Ending) -> Sequence[Frame]:
    first = len(pair.frames)
    pair.rates = pair.allowed = None
    if key == "drive":
        pair.controller.end(ending)
        pair.permit()
    else:
        pair.monitor.end(ending)
        pair.drive()
    enough_s = 0.7 * pair.facts.ttl_s
    pair.run(enough_s)
    # A robot that sends late frames afterwards may be behind: wait until the last message is old enough by its clock.
    pair.find(lambda frame: frame.age_s(witness) >= enough_s)
    return pair.frames[first:]


def check_lost(frames: Sequence[Frame], witness: Key, ttl_s: float, frame_s: float) -> str | None:
    """The robot is held within ``LOST_S`` after one session ended and the other sent a last message immediately after.

    The arrival time of that message, the witness, is taken as the time of the loss. ``frames`` begin at the end of the
    session; ``None`` if none of them lies between the limit and the end of the time-to-live. ``NotApplicable`` if the
    time-to-live is so short that it would hold the wheels as early.
    """
    if ttl_s < LOST_S + 4 * frame_s:
        raise NotApplicable(f"ttl_s {ttl_s:g} holds the wheels as soon")
    arrival_s = max(frame.arrival_s(witness) for frame in frames)
    due_s, expiry_s = arrival_s + LOST_S + frame_s, arrival_s + ttl_s - frame_s
    due = [frame for frame in frames if due_s < frame.t < expiry_s]
    for frame in due:
        require(frame.cmd.held, f"not held {1e3 * (frame.t - arrival_s):.0f} ms after the end of the session")
    first = next((frame for frame in frames if frame.cmd.held), None)
    if not due or first is None:
        return None
    return f"held {max(0.0, 1e3 * (first.t - arrival_s)):.0f} ms after the end of the session"


LOST: tuple[tuple[str, Key], ...] = (("controller", "drive"), ("monitor", "permit"))
for _role, _key in LOST:
    for _ending in ENDINGS:
        check(
            f"lost-{_role}-{_ending.lower()}", f"the {_role}'s lost session holds the wheels within 50 ms", "real time"
        )(partial(_lost, _key, _ending))

# -- fans -------------------------------------------------------------------------------------------------------------


@contextmanager
def _changed_fans(context: CheckContext) -> Iterator[ControllerAndMonitor]:
    """Change the fan duties; restore them at the end."""
    pair = ControllerAndMonitor(context)
    left, right = pair.steady().fans
    pair.duty = duty = other_duty((left, right), context.facts.robot.fan_floor)
    try:
        pair.fans(duty)
        pair.expect(lambda frame: frame.has_fans(duty), f"fans never went to {_shown(duty)}")
        yield pair
    finally:
        with suppress(CheckFailed):
            if pair.controller.is_ended or not pair.controller.is_open:
                pair.rejoin()
            pair.steady()
            pair.fans((left, right))
            pair.expect(lambda frame: frame.has_fans((left, right)), "")


check_fans = partial(CHECKS.add, fixture=_changed_fans)


def other_duty(duty: Pair, lowest: float) -> Pair:
    """Other allowed duties (left, right); ``NotApplicable`` if the floor leaves no room."""
    if lowest > 1.0 - max(FAN_STEPS):
        raise NotApplicable(f"a floor of {lowest:g} leaves no room")
    left, right = (v + step if v <= 1.0 - step else v - step for v, step in zip(duty, FAN_STEPS, strict=True))
    return left, right


def _check_unchanged(pair: ControllerAndMonitor, frames: Sequence[Frame], cause: str) -> None:
    for frame in frames:
        require(frame.has_fans(pair.duty), f"fans went from {list(pair.duty)} to {frame.fans} {cause}")


def _shown(duty: Sequence[float]) -> str:
    return f"[{duty[0]:.3g}, {duty[1]:.3g}]"


@check_fans("fans", "duties stay in force until changed")
def _fans_obeyed(pair: ControllerAndMonitor) -> str:
    pair.settle()
    _check_unchanged(pair, pair.settle(), "by themselves")
    return f"fans at {_shown(pair.duty)}"


@check_fans("newest-fans", "a fans command with an older or equal seq is dropped")
def _newest_fans(pair: ControllerAndMonitor) -> str:
    last = pair.fans(pair.duty)
    pair.settle()
    other = other_duty(pair.duty, pair.facts.robot.fan_floor)
    for seq in (last - 1, last):
        pair.fans(other, seq)
        _check_unchanged(pair, [*pair.settle(), *pair.run_frames(2)], f"by command {seq} after {last}")
    return f"commands {last - 1} and {last} after {last} dropped"


@check_fans("role-fans", "fans are the controller's")
def _fans_of_the_monitor(pair: ControllerAndMonitor) -> str:
    left, right = other_duty(pair.duty, pair.facts.robot.fan_floor)
    pair.monitor.send(b'{"type":"fans","seq":%d,"duty":[%.3f,%.3f]}\n' % (pair.context.next_seq(), left, right))
    _check_unchanged(pair, [*pair.run_frames(10), *pair.settle()], "by a command of the monitor")
    return "a command of the monitor does nothing"


@check_fans("fans-ttl", "fans are never changed by a time-out", "real time")
def _fans_after_time_out(pair: ControllerAndMonitor) -> str:
    silence_s = pair.facts.ttl_s + AFTER_TTL_S
    pair.rates = pair.allowed = None
    _check_unchanged(pair, pair.run(silence_s), "by a time-out")
    return f"{_shown(pair.duty)} over {silence_s:.2f} s without drive and permit"


@check_fans("fans-stop", "fans are never changed by a stop")
def _fans_after_stop(pair: ControllerAndMonitor) -> str:
    pair.allowed = NO_MOTION
    _check_unchanged(pair, pair.run_frames(10), "by a permit that allows nothing")
    return f"{_shown(pair.duty)} while nothing is allowed"


def _fans_after_lost(ending: Ending, pair: ControllerAndMonitor) -> str:
    """Both sessions end, one after the other, and join again."""
    pair.controller.end(ending)
    if not pair.facts.lockstep:  # in lockstep there is no new frame without the controller
        pair.rates = None
        _check_unchanged(pair, pair.run_frames(10), f"by a lost controller ({ending})")
    pair.monitor.end(ending)
    pair.rejoin()
    first = len(pair.frames)
    pair.steady()
    _check_unchanged(pair, pair.frames[first:], f"by lost sessions ({ending})")
    return f"{_shown(pair.duty)} after {ending}"


for _ending in ENDINGS:
    check_fans(f"fans-{_ending.lower()}", "fans are never changed by a lost session")(
        partial(_fans_after_lost, _ending)
    )


@check_fans("fan-floor", "a duty below fan_floor is clamped to it, without a fault")
def _fan_floor(pair: ControllerAndMonitor) -> str:
    lowest = pair.facts.robot.fan_floor
    if lowest <= 0.0:
        raise NotApplicable("fan_floor 0")
    below = max(0.0, lowest - max(FAN_STEPS))
    pair.fans((below, below))
    for frame in [*pair.settle(), *pair.run_frames(2)]:
        require(min(frame.fans) >= lowest - DUTY_TOLERANCE, f"fans at {_shown(frame.fans)}, floor {lowest:g}")
    require(pair.newest.has_fans((lowest, lowest)), f"fans at {_shown(pair.newest.fans)}")
    faults = pair.messages[0][-1].get("faults", [])
    require("fan_left" not in faults and "fan_right" not in faults, f"faults {faults} for a duty below the floor")
    return f"duty {below:g} clamped to {lowest:g}"


# -- lines ------------------------------------------------------------------------------------------------------------

# Drives with one error each; the first %d is seq, the second is ack.
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


def _dropped(template: bytes, pair: ControllerAndMonitor) -> str:
    """A bad drive with a higher number before a good one: the good one is accepted only if the bad one is dropped."""
    good = pair.context.next_seq()
    bad = good + 1
    pair.drive(good, before=template % (bad, pair.newest.seq))
    frame = pair.echoed(good, bad, otherwise="the good drive behind it was not obeyed")
    require(frame.cmd.seq == good, "it came into force")
    pair.steady()
    return "dropped, the drive behind it obeyed"


for _check_id, (_promise, _template) in BAD_DRIVES.items():
    check_steady(_check_id, _promise)(partial(_dropped, _template))


@check_steady("unknown-key", "unknown keys are ignored")
def _unknown_key(pair: ControllerAndMonitor) -> str:
    line = b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":0.0,"colour":"red","more":{"x":[1,2,null]}}\n'
    _check_obeyed(pair, lambda seq, ack: line % (seq, ack), "a drive with unknown keys was not obeyed")
    return "a drive with unknown keys is obeyed"


@check_steady("unknown-type", "an unknown type is ignored, and no bad line")
def _unknown_type(pair: ControllerAndMonitor) -> str:
    # More lines than the number of bad lines allowed in a second.
    _check_tolerated(pair, b'{"type":"dance","seq":7,"partner":null}\n' * STRANGERS)
    return f"{STRANGERS} lines of an unknown type, the session continues"


@check_steady("bad-lines-few", "20 bad lines in a second do not close the session")
def _few_bad_lines(pair: ControllerAndMonitor) -> str:
    _check_tolerated(pair, b"garbage\n" * TOLERATED)
    return f"{TOLERATED} bad lines at once, the session continues"


def _many_bad_lines(line: bytes, context: CheckContext) -> str:
    monitor = context.join("monitor")
    monitor.send(line * (TOLERATED + 1))
    require(context.is_closed(monitor), f"{TOLERATED + 1} bad lines at once, and the session is not closed")
    return f"{TOLERATED + 1} bad lines at once close the session"


check("bad-lines-many", "more than 20 bad lines in a second close the session")(partial(_many_bad_lines, b"garbage\n"))
check("bad-lines-role", "a message that is not for the sender's role counts as a bad line")(
    partial(_many_bad_lines, encode(Fans(seq=0, duty=STILL)))
)


@check_steady("line-longest", "a line holds up to 8192 bytes")
def _longest_line(pair: ControllerAndMonitor) -> str:
    def line(seq: int, ack: int) -> bytes:
        head = format_drive(seq, ack, 0.0, 0.0)[:-2] + b',"note":"'
        return head + b"x" * (MAX_LINE_BYTES - len(head) - 3) + b'"}\n'

    _check_obeyed(pair, line, f"a drive of {MAX_LINE_BYTES} bytes was not obeyed")
    return f"a drive of {MAX_LINE_BYTES} bytes is obeyed"


@check("line-too-long", "a line over 8192 bytes closes the session")
def _long_line(context: CheckContext) -> str:
    for end in (b"", b"\n"):
        monitor = context.join("monitor")
        monitor.send(b'{"type":"dance","note":"' + b"x" * MAX_LINE_BYTES + b'"}' + end)
        require(context.is_closed(monitor), f"a line over {MAX_LINE_BYTES} bytes, and the session is not closed")
    return "closes the session"


@check("single-bytes", "one object a line, however TCP chops it")
def _single_bytes(context: CheckContext) -> str:
    connection, hello = context.greet()
    for byte in context.join_line(hello, "monitor"):
        connection.send(bytes((byte,)))
        time.sleep(BYTE_S)
    require(context.answer(connection)["type"] == "joined", "a join in single bytes is refused")
    context.clear()
    with steady(context) as pair:
        seq = context.next_seq()
        for byte in format_drive(seq, pair.newest.seq, 0.0, 0.0):
            pair.controller.send(bytes((byte,)))
            pair.pause(BYTE_S)
        pair.mark_driven()
        pair.echoed(seq, otherwise="a drive in single bytes was not obeyed")
    return "join and drive obeyed"


@check_steady("many-lines", "one object a line, however many come at once")
def _many_lines(pair: ControllerAndMonitor) -> str:
    before, first = pair.newest.seq - 1, pair.context.next_seq()
    last = pair.context.last_seq = first + CROWD - 1
    # Only the last one answers the newest frame: in lockstep the clock waits for it, and so for all of them.
    crowd = b"".join(format_drive(seq, before, 0.0, 0.0) for seq in range(first, last))
    pair.drive(last, before=crowd)
    pair.echoed(last, otherwise=f"the last of {CROWD} drives in one segment was not obeyed")
    return f"the last of {CROWD} drives obeyed"


@check_steady("glued-lines", "one object a line, however TCP glues them")
def _glued_lines(pair: ControllerAndMonitor) -> str:
    left, right = pair.newest.fans
    seq = pair.context.next_seq()
    fans = b'{"type":"fans","seq":%d,"duty":[%.6f,%.6f]}\n' % (pair.context.next_seq(), left, right)
    pair.drive(seq, before=b'{"type":"dance"}\n' + fans)
    pair.echoed(seq, otherwise="a drive behind two other lines was not obeyed")
    return "a drive behind two other lines is obeyed"


def _check_obeyed(pair: ControllerAndMonitor, line: Callable[[int, int], bytes], otherwise: str) -> None:
    """Send a drive line unchanged, and answer frames until it is echoed."""
    seq = pair.context.next_seq()
    pair.controller.send(line(seq, pair.newest.seq))
    pair.mark_driven()
    pair.echoed(seq, otherwise=otherwise)


def _check_tolerated(pair: ControllerAndMonitor, lines: bytes) -> None:
    """Send lines that must have no effect, and check that the session continues."""
    pair.controller.send(lines)
    pair.run_frames(5)
    pair.settle()
