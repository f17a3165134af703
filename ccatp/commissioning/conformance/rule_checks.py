"""Stories of keys, time-to-live, the newest, and lost sessions; the wheels stand still by command.

Stories of the fans. Duties change by a few hundredths, never below the floor but where the floor is tested.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Literal

from ccatp.commissioning.conformance.connections import (
    ALL,
    NOTHING,
    STILL,
    CheckContext,
    ControllerAndMonitor,
    RawConnection,
)
from ccatp.commissioning.conformance.judges import (
    LATE_FRAMES,
    CheckedFrame,
    CheckFailed,
    Key,
    NotApplicable,
    is_duty,
    judge_lost,
    judge_newest,
    judge_once,
    judge_ttl,
    judge_untouched,
    require,
)

Ending = Literal["FIN", "RST"]
AFTER_TTL_S = 0.3  # watched beyond the time-to-live
SHORT_S = 0.12  # wall time in which a message on loopback or a local network has arrived, below every useful ttl_s
NOISE_S = 0.08  # between bad lines: fewer than 20 a second
ATTEMPTS = 6
AHEAD = 1000


def no_permit(stage: CheckContext) -> str:
    """Drives, a monitor, and no permit."""
    pair = ControllerAndMonitor(stage)
    pair.allowed = None
    return _always_held(pair, "no permit")


def no_drive(stage: CheckContext) -> str:
    """Permits and no drive."""
    pair = ControllerAndMonitor(stage)
    pair.rates = None
    return _always_held(pair, "no drive")


def ttl(key: Key) -> Callable[[CheckContext], str]:
    """Both keys, then one is no longer turned."""

    def story(stage: CheckContext) -> str:
        pair = ControllerAndMonitor(stage)
        pair.steady()
        _withhold(pair, key)
        frames = pair.run(stage.facts.ttl_s + AFTER_TTL_S)
        return judge_ttl(frames, key, stage.facts.ttl_s, stage.facts.frame_s)

    return story


def noise_is_no_drive(stage: CheckContext) -> str:
    """Both keys, then nothing but bad drives."""
    pair = ControllerAndMonitor(stage)
    pair.steady()
    pair.rates = None
    first, begin_s = len(pair.frames), pair.newest.t_s
    while pair.newest.t_s < begin_s + stage.facts.ttl_s + AFTER_TTL_S:
        seq, ack = stage.next_seq(), pair.newest.seq
        pair.controller.send(b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":"0"}\n' % (seq, ack))
        pair.run(NOISE_S)
    return judge_ttl(pair.frames[first:], "drive", stage.facts.ttl_s, stage.facts.frame_s)


def lost(role: Key, ending: Ending) -> Callable[[CheckContext], str]:
    """Both keys, then the session of one ends, and the other sends a last message right behind."""

    def story(stage: CheckContext) -> str:
        for _ in range(ATTEMPTS):
            pair = ControllerAndMonitor(stage)
            pair.steady()
            frames = _end(pair, role, ending)
            witness: Key = "permit" if role == "drive" else "drive"
            seen = judge_lost(frames, witness, stage.facts.ttl_s, stage.facts.frame_s)
            if seen is not None:
                return seen
            stage.clear()
        raise NotApplicable("the server or this machine is too slow to tell")

    return story


def newest_drive(stage: CheckContext) -> str:
    """An older drive, and one with the same number."""
    pair = ControllerAndMonitor(stage)
    pair.steady()
    newest = stage.next_seq()
    old = newest - 1
    pair.rates = None
    first = len(pair.frames)
    if stage.facts.is_lockstep:
        pair.allowed = None  # the frame waits until both have arrived
    pair.drive(newest)
    pair.drive(old)
    _look(pair)
    judge_newest(pair.frames[first:], newest, old)
    again, first = pair.stage.next_seq(), len(pair.frames)
    pair.rates = None
    pair.drive(again)
    _look_twice(pair, lambda: pair.drive(again))
    judge_once(pair.frames[first:], again, stage.facts.frame_s)
    return f"drive {old} after {newest} and a second {again} dropped"


def newest_permit(stage: CheckContext) -> str:
    """Older permits, and one with the same number: the age tells."""
    pair = ControllerAndMonitor(stage)
    pair.steady()
    newest = stage.next_seq()
    pair.allowed = None
    pair.permit(newest)
    if stage.facts.is_lockstep:
        arrival_s = _one_more(pair).permit_arrival_s
    else:
        pair.run(SHORT_S)
        arrival_s = pair.expect(lambda frame: frame.permit_age_s > 0.0, "permits do not age").permit_arrival_s
    for seq in (newest - 1, newest):
        if stage.facts.is_lockstep:
            pair.drive()
        pair.permit(seq)
        for frame in pair.pause(SHORT_S):
            late_s = frame.permit_arrival_s - arrival_s
            require(late_s <= 0.5 * stage.facts.frame_s, f"permit {seq} came into force after {newest}")
    pair.answer_again()
    pair.steady()
    return f"permit {newest - 1} after {newest} and a second {newest} dropped"


def wrong_role(stage: CheckContext) -> str:
    """A drive of the monitor, with the highest number of all."""
    pair = ControllerAndMonitor(stage)
    pair.steady()
    seq = pair.newest.drive_seq + AHEAD  # once obeyed it stays the newest for a while
    pair.monitor.send(b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":0.0}\n' % (seq, pair.newest.seq))
    pair.find(lambda frame: frame.drive_seq == seq, 10 * stage.facts.frame_s)
    require(pair.newest.drive_seq != seq, f"drive {seq} of the monitor came into force")
    while stage.next_seq() < seq:
        continue
    pair.settle()
    return "a drive of the monitor does nothing"


def _always_held(pair: ControllerAndMonitor, why: str) -> str:
    facts = pair.stage.facts
    frames = pair.run(facts.ttl_s + AFTER_TTL_S)
    begin_s = frames[0].t_s + facts.ttl_s + LATE_FRAMES * facts.frame_s
    judged = [frame for frame in frames if frame.t_s > begin_s]
    require(bool(judged), "no frames")
    require(all(frame.is_held for frame in judged), f"not held with {why} for {judged[-1].t_s - frames[0].t_s:.2f} s")
    return f"held in {len(judged)} frames with {why}"


def _withhold(pair: ControllerAndMonitor, key: Key) -> None:
    if key == "drive":
        pair.rates = None
    else:
        pair.allowed = None


def _end(pair: ControllerAndMonitor, role: Key, ending: Ending) -> Sequence[CheckedFrame]:
    """End one session, send a last message on the other, and watch."""
    first = len(pair.frames)
    link = pair.controller if role == "drive" else pair.monitor
    pair.rates = pair.allowed = None
    link.reset() if ending == "RST" else link.finish()
    if role == "drive":
        pair.permit()
    else:
        pair.drive()
    enough_s = 0.7 * pair.stage.facts.ttl_s
    pair.run(enough_s)
    # A robot that makes up for late frames may be behind: watch until the last message is old enough by its own clock.
    pair.find(lambda frame: (frame.permit_age_s if role == "drive" else frame.age_s) >= enough_s)
    return pair.frames[first:]


def _look(pair: ControllerAndMonitor) -> None:
    """Give the robot time to take what was sent, then answer frames again."""
    pair.pause(SHORT_S)
    pair.rates, pair.allowed = STILL, ALL
    pair.settle()


def _look_twice(pair: ControllerAndMonitor, act: Callable[[], object]) -> None:
    """Give the robot time to take what was sent, act, and give it time again."""
    if pair.stage.facts.is_lockstep:
        _one_more(pair)
    else:
        pair.run(SHORT_S)
    act()
    if pair.stage.facts.is_lockstep:
        pair.permit()
    pair.pause(SHORT_S)
    pair.answer_again()
    _look(pair)


def _one_more(pair: ControllerAndMonitor) -> CheckedFrame:
    newest = pair.newest.seq
    return pair.expect(lambda frame: frame.seq > newest, "no frame after drive and permit for the one before")


Duty = tuple[float, float]
STEP = 0.05
TOLERANCE = 0.01  # a duty in eight bits


def obeyed(stage: CheckContext) -> str:
    """A new duty."""
    with _changed(ControllerAndMonitor(stage)) as (pair, duty):
        pair.settle()
        judge_untouched(pair.settle(), duty, TOLERANCE, "by themselves")
        return f"fans at {_shown(duty)}"


def newest(stage: CheckContext) -> str:
    """An older command, and one with the same number."""
    with _changed(ControllerAndMonitor(stage)) as (pair, duty):
        last = pair.fans(duty)
        pair.settle()
        other = _other(duty, stage.facts.fan_floor)
        for seq in (last - 1, last):
            pair.fans(other, seq)
            frames = [*pair.settle(), *pair.run(2 * stage.facts.frame_s)]
            judge_untouched(frames, duty, TOLERANCE, f"by command {seq} after {last}")
        return f"commands {last - 1} and {last} after {last} dropped"


def of_the_monitor(stage: CheckContext) -> str:
    """A command of the wrong role."""
    with _changed(ControllerAndMonitor(stage)) as (pair, duty):
        left, right = _other(duty, stage.facts.fan_floor)
        seq = stage.next_seq()
        pair.monitor.send(b'{"type":"fans","seq":%d,"duty":[%.3f,%.3f]}\n' % (seq, left, right))
        frames = [*pair.run(10 * stage.facts.frame_s), *pair.settle()]
        judge_untouched(frames, duty, TOLERANCE, "by a command of the monitor")
        return "a command of the monitor does nothing"


def after_time_out(stage: CheckContext) -> str:
    """Neither drives nor permits for longer than they live."""
    with _changed(ControllerAndMonitor(stage)) as (pair, duty):
        pair.rates = pair.allowed = None
        judge_untouched(pair.run(stage.facts.ttl_s + AFTER_TTL_S), duty, TOLERANCE, "by a time-out")
        return f"{_shown(duty)} over {stage.facts.ttl_s + AFTER_TTL_S:.2f} s without drive and permit"


def after_stop(stage: CheckContext) -> str:
    """A permit that allows nothing."""
    with _changed(ControllerAndMonitor(stage)) as (pair, duty):
        pair.allowed = NOTHING
        judge_untouched(pair.run(10 * stage.facts.frame_s), duty, TOLERANCE, "by a permit that allows nothing")
        return f"{_shown(duty)} while nothing is allowed"


def after_lost(ending: Ending) -> Callable[[CheckContext], str]:
    """Both sessions end, one after the other, and come again."""

    def story(stage: CheckContext) -> str:
        with _changed(ControllerAndMonitor(stage)) as (pair, duty):
            _stories_fans_end(pair.controller, ending)
            if not stage.facts.is_lockstep:  # there the monitor sees no frame without the controller
                pair.rates = None
                judge_untouched(pair.run(10 * stage.facts.frame_s), duty, TOLERANCE, f"by a lost controller ({ending})")
            _stories_fans_end(pair.monitor, ending)
            pair.rejoin()
            first = len(pair.frames)
            pair.steady()
            judge_untouched(pair.frames[first:], duty, TOLERANCE, f"by lost sessions ({ending})")
            return f"{_shown(duty)} after {ending}"

    return story


def floor(stage: CheckContext) -> str:
    """A duty a little below the floor."""
    lowest = stage.facts.fan_floor
    if lowest <= 0.0:
        raise NotApplicable("fan_floor 0")
    with _changed(ControllerAndMonitor(stage)) as (pair, _):
        below = max(0.0, lowest - STEP)
        pair.fans((below, below))
        frames = [*pair.settle(), *pair.run(2 * stage.facts.frame_s)]
        for frame in frames:
            require(min(frame.fans) >= lowest - TOLERANCE, f"fans at {_shown(frame.fans)}, floor {lowest:g}")
        require(is_duty(pair.newest.fans, (lowest, lowest), TOLERANCE), f"fans at {_shown(pair.newest.fans)}")
        faults = pair.messages[0][-1].get("faults", [])
        require("fan_left" not in faults and "fan_right" not in faults, f"faults {faults} for a duty below the floor")
        return f"duty {below:g} clamped to {lowest:g}"


@contextmanager
def _changed(pair: ControllerAndMonitor) -> Iterator[tuple[ControllerAndMonitor, Duty]]:
    """Fans at another duty than they were found at; put back at the end."""
    found = pair.steady().fans
    duty = _other(found, pair.stage.facts.fan_floor)
    try:
        pair.fans(duty)
        pair.expect(lambda frame: is_duty(frame.fans, duty, TOLERANCE), f"fans never went to {_shown(duty)}")
        yield pair, duty
    finally:
        with suppress(CheckFailed):
            if pair.controller.is_ended or not pair.controller.is_open:
                pair.rejoin()
            pair.steady()
            pair.fans(found)
            pair.expect(lambda frame: is_duty(frame.fans, found, TOLERANCE), "")


def _stories_fans_end(link: RawConnection, ending: Ending) -> None:
    if ending == "RST":
        link.reset()
    else:
        link.finish()


def _other(duty: Duty, lowest: float) -> Duty:
    """Duties that differ from these, and are allowed.

    Raises:
        NotApplicable: there are none.
    """
    if lowest > 1.0 - STEP:
        raise NotApplicable(f"a floor of {lowest:g} leaves no room")
    left, right = (value + STEP if value <= 1.0 - STEP else value - STEP for value in duty)
    return left, right


def _shown(duty: Duty) -> str:
    return f"[{duty[0]:.3g}, {duty[1]:.3g}]"
