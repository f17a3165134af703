"""Edge. Stories of keys, time-to-live, the newest, and lost sessions; the wheels stand still by command."""

from collections.abc import Callable, Sequence
from typing import Literal

from ccatp.conformance.judge_rules import LATE_FRAMES, Key, judge_lost, judge_newest, judge_once, judge_ttl
from ccatp.conformance.pair import ALL, STILL, Pair
from ccatp.conformance.reading import Frame
from ccatp.conformance.stage import Stage
from ccatp.conformance.verdict import NotApplicable, require

Ending = Literal["FIN", "RST"]
AFTER_TTL_S = 0.3  # watched beyond the time-to-live
SHORT_S = 0.12  # wall time in which a message on loopback or a local network has arrived, below every useful ttl_s
NOISE_S = 0.08  # between bad lines: fewer than 20 a second
ATTEMPTS = 6
AHEAD = 1000


def no_permit(stage: Stage) -> str:
    """Drives, a monitor, and no permit."""
    pair = Pair(stage)
    pair.allowed = None
    return _always_held(pair, "no permit")


def no_drive(stage: Stage) -> str:
    """Permits and no drive."""
    pair = Pair(stage)
    pair.rates = None
    return _always_held(pair, "no drive")


def ttl(key: Key) -> Callable[[Stage], str]:
    """Both keys, then one is no longer turned."""

    def story(stage: Stage) -> str:
        pair = Pair(stage)
        pair.steady()
        _withhold(pair, key)
        frames = pair.run(stage.facts.ttl_s + AFTER_TTL_S)
        return judge_ttl(frames, key, stage.facts.ttl_s, stage.facts.frame_s)

    return story


def noise_is_no_drive(stage: Stage) -> str:
    """Both keys, then nothing but bad drives."""
    pair = Pair(stage)
    pair.steady()
    pair.rates = None
    first, begin_s = len(pair.frames), pair.newest.t_s
    while pair.newest.t_s < begin_s + stage.facts.ttl_s + AFTER_TTL_S:
        seq, ack = stage.next_seq(), pair.newest.seq
        pair.controller.send(b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":"0"}\n' % (seq, ack))
        pair.run(NOISE_S)
    return judge_ttl(pair.frames[first:], "drive", stage.facts.ttl_s, stage.facts.frame_s)


def lost(role: Key, ending: Ending) -> Callable[[Stage], str]:
    """Both keys, then the session of one ends, and the other sends a last message right behind.

    Args:
        role: what the session that ends has sent.
        ending: how.
    """

    def story(stage: Stage) -> str:
        for _ in range(ATTEMPTS):
            pair = Pair(stage)
            pair.steady()
            frames = _end(pair, role, ending)
            witness: Key = "permit" if role == "drive" else "drive"
            seen = judge_lost(frames, witness, stage.facts.ttl_s, stage.facts.frame_s)
            if seen is not None:
                return seen
            stage.clear()
        raise NotApplicable("the server or this machine is too slow to tell")

    return story


def newest_drive(stage: Stage) -> str:
    """An older drive, and one with the same number."""
    pair = Pair(stage)
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


def newest_permit(stage: Stage) -> str:
    """Older permits, and one with the same number: the age tells."""
    pair = Pair(stage)
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


def wrong_role(stage: Stage) -> str:
    """A drive of the monitor, with the highest number of all."""
    pair = Pair(stage)
    pair.steady()
    seq = pair.newest.drive_seq + AHEAD  # once obeyed it stays the newest for a while
    pair.monitor.send(b'{"type":"drive","seq":%d,"ack":%d,"wr":0.0,"wl":0.0}\n' % (seq, pair.newest.seq))
    pair.find(lambda frame: frame.drive_seq == seq, 10 * stage.facts.frame_s)
    require(pair.newest.drive_seq != seq, f"drive {seq} of the monitor came into force")
    while stage.next_seq() < seq:
        continue
    pair.settle()
    return "a drive of the monitor does nothing"


def _always_held(pair: Pair, why: str) -> str:
    facts = pair.stage.facts
    frames = pair.run(facts.ttl_s + AFTER_TTL_S)
    begin_s = frames[0].t_s + facts.ttl_s + LATE_FRAMES * facts.frame_s
    judged = [frame for frame in frames if frame.t_s > begin_s]
    require(bool(judged), "no frames")
    require(all(frame.is_held for frame in judged), f"not held with {why} for {judged[-1].t_s - frames[0].t_s:.2f} s")
    return f"held in {len(judged)} frames with {why}"


def _withhold(pair: Pair, key: Key) -> None:
    if key == "drive":
        pair.rates = None
    else:
        pair.allowed = None


def _end(pair: Pair, role: Key, ending: Ending) -> Sequence[Frame]:
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


def _look(pair: Pair) -> None:
    """Give the robot time to take what was sent, then answer frames again."""
    pair.pause(SHORT_S)
    pair.rates, pair.allowed = STILL, ALL
    pair.settle()


def _look_twice(pair: Pair, act: Callable[[], object]) -> None:
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


def _one_more(pair: Pair) -> Frame:
    newest = pair.newest.seq
    return pair.expect(lambda frame: frame.seq > newest, "no frame after drive and permit for the one before")
