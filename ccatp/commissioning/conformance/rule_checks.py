"""Checks of what the robot enforces by itself: drive and permit, time-to-live, newest only, lost sessions, fans.

The wheels stand still by command. Fan duties change by a few hundredths, below the floor in ``fan_floor`` alone.
The ages in a frame say on the robot's clock when a message arrived, so a slow network or a stalled client is never
taken for a fault of the robot.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Literal

from ccatp.commissioning.conformance.checks import (
    DUTY_TOLERANCE,
    CheckedFrame,
    CheckFailed,
    CheckList,
    Duty,
    NotApplicable,
    is_duty,
    require,
)
from ccatp.commissioning.conformance.connections import (
    ALL,
    NOTHING,
    STILL,
    CheckContext,
    ControllerAndMonitor,
    Ending,
    steady_pair,
)

CHECKS = CheckList()
Key = Literal["drive", "permit"]
AFTER_TTL_S = 0.3  # watched beyond the time-to-live
SHORT_S = 0.12  # wall time in which a message on loopback or a local network has arrived, below every useful ttl_s
NOISE_S = 0.08  # between bad lines: fewer than 20 a second
ATTEMPTS = 6
AHEAD = 1000
LOST_S = 0.05
EARLY_FRAMES, LATE_FRAMES = 2, 3  # a robot acts from frame to frame
FAN_STEP = 0.05

# -- drive and permit -------------------------------------------------------------------------------------------------


def always_held(key: Key, context: CheckContext) -> str:
    """Drives of zero without a permit, or permits without a drive."""
    pair = ControllerAndMonitor(context)
    _withhold(pair, key)
    facts = context.facts
    frames = pair.run(facts.ttl_s + AFTER_TTL_S)
    begin_s = frames[0].t_s + facts.ttl_s + LATE_FRAMES * facts.frame_s
    late = [frame for frame in frames if frame.t_s > begin_s]
    require(bool(late), "no frames")
    require(all(frame.is_held for frame in late), f"not held with no {key} for {late[-1].t_s - frames[0].t_s:.2f} s")
    return f"held in {len(late)} frames with no {key}"


def ttl(key: Key, context: CheckContext) -> str:
    """Drives of zero and permits, then one of the two no longer."""
    pair = steady_pair(context)
    _withhold(pair, key)
    frames = pair.run(context.facts.ttl_s + AFTER_TTL_S)
    return check_ttl(frames, key, context.facts.ttl_s, context.facts.frame_s)


def _withhold(pair: ControllerAndMonitor, key: Key) -> None:
    if key == "drive":
        pair.rates = None
    else:
        pair.allowed = None


CHECKS.add("no-permit", "once a monitor has joined, wheels are held without its permit", "real time")(
    partial(always_held, "permit")
)
CHECKS.add("no-drive", "wheels are held without a drive", "real time")(partial(always_held, "drive"))
CHECKS.add("ttl-drive", "a drive is in force for ttl_s", "real time")(partial(ttl, "drive"))
CHECKS.add("ttl-permit", "a permit is in force for ttl_s", "real time")(partial(ttl, "permit"))


@CHECKS.add("ttl-noise", "a bad line never refreshes a time-out", "real time")
def noise_is_no_drive(context: CheckContext) -> str:
    """Drives of zero, then bad drives."""
    pair = steady_pair(context)
    facts = context.facts
    pair.rates = None
    first, begin_s = len(pair.frames), pair.newest.t_s
    while pair.newest.t_s < begin_s + facts.ttl_s + AFTER_TTL_S:
        seq, ack = context.next_seq(), pair.newest.seq
        pair.controller.send(b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":"0"}\n' % (seq, ack))
        pair.run(NOISE_S)
    return check_ttl(pair.frames[first:], "drive", facts.ttl_s, facts.frame_s)


def check_ttl(frames: Sequence[CheckedFrame], key: Key, ttl_s: float, frame_s: float) -> str:
    """Held in time, in frames from the last drive or permit on, while the other is renewed in each frame."""
    held_s: float | None = None
    has_moved, age_s = False, 0.0
    for frame in frames:
        age_s, other_s = (frame.age_s, frame.permit_age_s) if key == "drive" else (frame.permit_age_s, frame.age_s)
        seen = f"held at a {key} age of {age_s:.3f} s, ttl_s {ttl_s:g}"
        if frame.is_held:
            require(not has_moved or max(age_s, other_s) >= ttl_s - EARLY_FRAMES * frame_s, seen)
            held_s = age_s if held_s is None else held_s
        else:
            has_moved, held_s = True, None
            require(age_s <= ttl_s + LATE_FRAMES * frame_s, f"not {seen}")
    span_s = frames[-1].t_s - frames[0].t_s
    require(held_s is not None, f"not held {span_s:.2f} s after the last {key}, its reported age {age_s:.3f} s")
    return f"held at a {key} age of {held_s:.3f} s, ttl_s {ttl_s:g}"


@CHECKS.add("newest-drive", "a drive with an older or equal seq is dropped")
def newest_drive(context: CheckContext) -> str:
    """One, an older one, and one more of the same number."""
    pair = steady_pair(context)
    newest = context.next_seq()
    old = newest - 1
    pair.rates = None
    first = len(pair.frames)
    if context.facts.is_lockstep:
        pair.allowed = None  # the frame waits until both have arrived
    pair.drive(newest)
    pair.drive(old)
    _pause_and_settle(pair)
    check_newest(pair.frames[first:], newest, old)
    again, first = context.next_seq(), len(pair.frames)
    pair.rates = None
    pair.drive(again)
    if context.facts.is_lockstep:
        _next_frame(pair)
        pair.drive(again)
        pair.permit()
    else:
        pair.run(SHORT_S)
        pair.drive(again)
    pair.pause(SHORT_S)
    pair.answer_again()
    _pause_and_settle(pair)
    check_once(pair.frames[first:], again, context.facts.frame_s)
    return f"drive {old} after {newest} and a second {again} dropped"


def _pause_and_settle(pair: ControllerAndMonitor) -> None:
    """Wait until the robot has taken what was sent, then answer frames again."""
    pair.pause(SHORT_S)
    pair.rates, pair.allowed = STILL, ALL
    pair.settle()


def _next_frame(pair: ControllerAndMonitor) -> CheckedFrame:
    newest = pair.newest.seq
    return pair.expect(lambda frame: frame.seq > newest, "no frame after drive and permit for the one before")


def check_newest(frames: Sequence[CheckedFrame], newest: int, old: int) -> None:
    """The newer came into force and the older did not, in frames from when a drive and then an older one were sent."""
    require(all(frame.drive_seq != old for frame in frames), f"drive {old} came into force after {newest}")
    require(any(frame.drive_seq == newest for frame in frames), f"drive {newest} never came into force")


def check_once(frames: Sequence[CheckedFrame], seq: int, frame_s: float) -> None:
    """The age does not start again, in frames in which a drive was sent, and sent again under the same number."""
    in_force = [frame for frame in frames if frame.drive_seq == seq]
    require(bool(in_force), f"drive {seq} never came into force")
    # A robot that makes up for late frames reports 0 for what arrived after their time: that gives no arrival.
    arrivals_s = [frame.drive_arrival_s for frame in in_force if frame.age_s > 0.0]
    spread_s = max(arrivals_s) - min(arrivals_s) if arrivals_s else 0.0
    require(spread_s <= 0.5 * frame_s, f"a second drive {seq} came into force {1e3 * spread_s:.0f} ms after the first")


@CHECKS.add("newest-permit", "a permit with an older or equal seq is dropped")
def newest_permit(context: CheckContext) -> str:
    """One, an older one, and one more of the same number: the age shows which is in force."""
    pair = steady_pair(context)
    newest = context.next_seq()
    pair.allowed = None
    pair.permit(newest)
    if context.facts.is_lockstep:
        arrival_s = _next_frame(pair).permit_arrival_s
    else:
        pair.run(SHORT_S)
        arrival_s = pair.expect(lambda frame: frame.permit_age_s > 0.0, "permits do not age").permit_arrival_s
    for seq in (newest - 1, newest):
        if context.facts.is_lockstep:
            pair.drive()
        pair.permit(seq)
        for frame in pair.pause(SHORT_S):
            late_s = frame.permit_arrival_s - arrival_s
            require(late_s <= 0.5 * context.facts.frame_s, f"permit {seq} came into force after {newest}")
    pair.answer_again()
    pair.steady()
    return f"permit {newest - 1} after {newest} and a second {newest} dropped"


@CHECKS.add("role-drive", "drives are the controller's")
def wrong_role(context: CheckContext) -> str:
    """A drive of the monitor, with the highest number of all."""
    pair = steady_pair(context)
    seq = pair.newest.drive_seq + AHEAD  # once obeyed it stays the newest for a while
    pair.monitor.send(b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":0.0}\n' % (seq, pair.newest.seq))
    pair.find(lambda frame: frame.drive_seq == seq, 10 * context.facts.frame_s)
    require(pair.newest.drive_seq != seq, f"drive {seq} of the monitor came into force")
    while context.next_seq() < seq:
        continue
    pair.settle()
    return "a drive of the monitor does nothing"


# -- lost sessions ----------------------------------------------------------------------------------------------------


def lost(key: Key, ending: Ending, context: CheckContext) -> str:
    """The session that sends one of the two ends, and the other sends a last message right behind."""
    for _ in range(ATTEMPTS):
        frames = _end(steady_pair(context), key, ending)
        witness: Key = "permit" if key == "drive" else "drive"
        seen = check_lost(frames, witness, context.facts.ttl_s, context.facts.frame_s)
        if seen is not None:
            return seen
        context.clear()
    raise NotApplicable("the server or this machine is too slow to tell")


def _end(pair: ControllerAndMonitor, key: Key, ending: Ending) -> Sequence[CheckedFrame]:
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
    # A robot that makes up for late frames may be behind: watch until the last message is old enough by its own clock.
    pair.find(lambda frame: (frame.permit_age_s if key == "drive" else frame.age_s) >= enough_s)
    return pair.frames[first:]


def check_lost(frames: Sequence[CheckedFrame], witness: Key, ttl_s: float, frame_s: float) -> str | None:
    """Held in time after one session ended and the other sent a last message right behind.

    The arrival of that message, the witness, is the moment at which the loss was there, too. ``frames`` reach from the
    end of the session over some 0.2 s; ``None`` if they do not reach over the time in question. ``NotApplicable`` where
    the time-to-live is so short that it would hold the wheels as soon.
    """
    if ttl_s < LOST_S + 4 * frame_s:
        raise NotApplicable(f"ttl_s {ttl_s:g} holds the wheels as soon")
    arrival_s = max(frame.drive_arrival_s if witness == "drive" else frame.permit_arrival_s for frame in frames)
    due_s, expiry_s = arrival_s + LOST_S + frame_s, arrival_s + ttl_s - frame_s
    due = [frame for frame in frames if due_s < frame.t_s < expiry_s]
    for frame in due:
        require(frame.is_held, f"not held {1e3 * (frame.t_s - arrival_s):.0f} ms after the end of the session")
    first = next((frame for frame in frames if frame.is_held), None)
    if not due or first is None:
        return None
    return f"held {max(0.0, 1e3 * (first.t_s - arrival_s)):.0f} ms after the end of the session"


_KEYS: dict[str, Key] = {"controller": "drive", "monitor": "permit"}
_ENDINGS: tuple[Ending, Ending] = ("FIN", "RST")
for _role, _key in _KEYS.items():
    for _ending in _ENDINGS:
        CHECKS.add(
            f"lost-{_role}-{_ending.lower()}", f"the {_role}'s lost session holds the wheels within 50 ms", "real time"
        )(partial(lost, _key, _ending))


# -- fans -------------------------------------------------------------------------------------------------------------


@contextmanager
def _changed_fans(context: CheckContext) -> Iterator[tuple[ControllerAndMonitor, Duty]]:
    """Fans at another duty than they were found at; put back at the end."""
    pair = ControllerAndMonitor(context)
    found = pair.steady().fans
    duty = other_duty(found, context.facts.fan_floor)
    try:
        pair.fans(duty)
        pair.expect(lambda frame: is_duty(frame.fans, duty), f"fans never went to {_shown(duty)}")
        yield pair, duty
    finally:
        with suppress(CheckFailed):
            if pair.controller.is_ended or not pair.controller.is_open:
                pair.rejoin()
            pair.steady()
            pair.fans(found)
            pair.expect(lambda frame: is_duty(frame.fans, found), "")


def other_duty(duty: Duty, lowest: float) -> Duty:
    """Duties that differ from these, and are allowed; ``NotApplicable`` where there are none."""
    if lowest > 1.0 - FAN_STEP:
        raise NotApplicable(f"a floor of {lowest:g} leaves no room")
    left, right = (value + FAN_STEP if value <= 1.0 - FAN_STEP else value - FAN_STEP for value in duty)
    return left, right


def _check_unchanged(frames: Sequence[CheckedFrame], fans: Duty, cause: str) -> None:
    for frame in frames:
        require(is_duty(frame.fans, fans), f"fans went from {list(fans)} to {list(frame.fans)} {cause}")


def _shown(duty: Duty) -> str:
    return f"[{duty[0]:.3g}, {duty[1]:.3g}]"


@CHECKS.add("fans", "duties stay in force until changed")
def fans_obeyed(context: CheckContext) -> str:
    """A duty changed by 0.05."""
    with _changed_fans(context) as (pair, duty):
        pair.settle()
        _check_unchanged(pair.settle(), duty, "by themselves")
        return f"fans at {_shown(duty)}"


@CHECKS.add("newest-fans", "a fans command with an older or equal seq is dropped")
def newest_fans(context: CheckContext) -> str:
    """One, an older one, and one more of the same number."""
    with _changed_fans(context) as (pair, duty):
        last = pair.fans(duty)
        pair.settle()
        other = other_duty(duty, context.facts.fan_floor)
        for seq in (last - 1, last):
            pair.fans(other, seq)
            frames = [*pair.settle(), *pair.run(2 * context.facts.frame_s)]
            _check_unchanged(frames, duty, f"by command {seq} after {last}")
        return f"commands {last - 1} and {last} after {last} dropped"


@CHECKS.add("role-fans", "fans are the controller's")
def fans_of_the_monitor(context: CheckContext) -> str:
    """A command of the monitor."""
    with _changed_fans(context) as (pair, duty):
        left, right = other_duty(duty, context.facts.fan_floor)
        seq = context.next_seq()
        pair.monitor.send(b'{"type":"fans","seq":%d,"duty":[%.3f,%.3f]}\n' % (seq, left, right))
        frames = [*pair.run(10 * context.facts.frame_s), *pair.settle()]
        _check_unchanged(frames, duty, "by a command of the monitor")
        return "a command of the monitor does nothing"


@CHECKS.add("fans-ttl", "fans are never changed by a time-out", "real time")
def fans_after_time_out(context: CheckContext) -> str:
    """No drive and no permit for longer than ttl_s."""
    silence_s = context.facts.ttl_s + AFTER_TTL_S
    with _changed_fans(context) as (pair, duty):
        pair.rates = pair.allowed = None
        _check_unchanged(pair.run(silence_s), duty, "by a time-out")
        return f"{_shown(duty)} over {silence_s:.2f} s without drive and permit"


@CHECKS.add("fans-stop", "fans are never changed by a stop")
def fans_after_stop(context: CheckContext) -> str:
    """A permit that allows nothing."""
    with _changed_fans(context) as (pair, duty):
        pair.allowed = NOTHING
        _check_unchanged(pair.run(10 * context.facts.frame_s), duty, "by a permit that allows nothing")
        return f"{_shown(duty)} while nothing is allowed"


def fans_after_lost(ending: Ending, context: CheckContext) -> str:
    """Both sessions end, one after the other, and join again."""
    with _changed_fans(context) as (pair, duty):
        pair.controller.end(ending)
        if not context.facts.is_lockstep:  # there the monitor sees no frame without the controller
            pair.rates = None
            _check_unchanged(pair.run(10 * context.facts.frame_s), duty, f"by a lost controller ({ending})")
        pair.monitor.end(ending)
        pair.rejoin()
        first = len(pair.frames)
        pair.steady()
        _check_unchanged(pair.frames[first:], duty, f"by lost sessions ({ending})")
        return f"{_shown(duty)} after {ending}"


for _ending in _ENDINGS:
    CHECKS.add(f"fans-{_ending.lower()}", "fans are never changed by a lost session")(partial(fans_after_lost, _ending))


@CHECKS.add("fan-floor", "a duty below fan_floor is clamped to it, without a fault")
def fan_floor(context: CheckContext) -> str:
    """A duty 0.05 below."""
    lowest = context.facts.fan_floor
    if lowest <= 0.0:
        raise NotApplicable("fan_floor 0")
    with _changed_fans(context) as (pair, _):
        below = max(0.0, lowest - FAN_STEP)
        pair.fans((below, below))
        frames = [*pair.settle(), *pair.run(2 * context.facts.frame_s)]
        for frame in frames:
            require(min(frame.fans) >= lowest - DUTY_TOLERANCE, f"fans at {_shown(frame.fans)}, floor {lowest:g}")
        require(is_duty(pair.newest.fans, (lowest, lowest)), f"fans at {_shown(pair.newest.fans)}")
        faults = pair.messages[0][-1].get("faults", [])
        require("fan_left" not in faults and "fan_right" not in faults, f"faults {faults} for a duty below the floor")
        return f"duty {below:g} clamped to {lowest:g}"
