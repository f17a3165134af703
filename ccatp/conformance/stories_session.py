"""Edge. Stories of hello, join and roles."""

import time

from ccatp.conformance import judge_hello
from ccatp.conformance.link import Link
from ccatp.conformance.pair import ALL, STILL, Pair
from ccatp.conformance.stage import Stage
from ccatp.conformance.verdict import Broken, NotApplicable, require
from ccatp.wire.robot import Drive, Role, encode, join_mac

CONNECTIONS = 8
JOIN_S = 2.0
IN_TIME_S, LATE_S = 1.0, 2.1  # after the hello
SILENCE_S, STILL_HELD_S, TAKEN_S = 5.0, 3.5, 5.3
NOISE_S = 0.3  # between bad lines of a holder that says nothing else
ROLES: tuple[Role, Role] = ("controller", "monitor")


def hello_fields(stage: Stage) -> str:
    """One hello."""
    return judge_hello.judge_fields(stage.greet()[1])


def hello_robot(stage: Stage) -> str:
    """What it says of the robot."""
    return judge_hello.judge_robot(stage.greet()[1])


def nonces(stage: Stage) -> str:
    """Several connections."""
    return judge_hello.judge_nonces([stage.greet()[1] for _ in range(CONNECTIONS)])


def boots(stage: Stage) -> str:
    """Several connections."""
    return judge_hello.judge_boots([stage.greet()[1] for _ in range(CONNECTIONS)])


def join_both(stage: Stage) -> str:
    """Each role, at once."""
    said = []
    for role in ROLES:
        link, hello = stage.greet()
        link.send(stage.join_line(hello, role))
        said.append(_joined(stage, link, role))
    return "; ".join(said)


def join_in_time(stage: Stage) -> str:
    """A client that takes its time."""
    link, hello = stage.greet()
    require(not stage.is_closed(link, IN_TIME_S), f"closed within {IN_TIME_S:g} s of the hello")
    link.send(stage.join_line(hello, "monitor"))
    answer = stage.answer(link)
    require(answer["type"] == "joined", f"refused {IN_TIME_S:g} s after the hello: {answer.get('reason')}")
    return f"joined {IN_TIME_S:g} s after the hello"


def join_late(stage: Stage) -> str:
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


def join_unknown_role(stage: Stage) -> str:
    """A role that there is not."""
    link, _ = stage.greet()
    link.send(b'{"type":"join","role":"king","client":"conformance","mac":""}\n')
    return _refused(stage, link, ("bad join",))


def join_without_client(stage: Stage) -> str:
    """A join with a key missing."""
    link, _ = stage.greet()
    link.send(b'{"type":"join","role":"controller"}\n')
    return _refused(stage, link, ("bad join",))


def command_before_join(stage: Stage) -> str:
    """A drive as the first message."""
    link, _ = stage.greet()
    link.send(encode(Drive(seq=stage.next_seq(), ack=0, wr=0.0, wl=0.0)))
    return _refused(stage, link, ("bad join",))


def role_taken(stage: Stage) -> str:
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


def refused_is_harmless(stage: Stage) -> str:
    """Clients that are refused for every reason, while two others drive."""
    pair = Pair(stage)
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


def mac_right(stage: Stage) -> str:
    """The right mac."""
    _needs_key(stage)
    link, hello = stage.greet()
    link.send(stage.join_line(hello, "monitor"))
    return _joined(stage, link, "monitor")


def mac_wrong(stage: Stage) -> str:
    """A mac made with another key."""
    key = _needs_key(stage)
    link, hello = stage.greet()
    link.send(stage.join_line(hello, "monitor", join_mac(key + b"x", str(hello["nonce"]), "monitor")))
    return _refused(stage, link, ("bad mac",))


def mac_missing(stage: Stage) -> str:
    """No mac."""
    _needs_key(stage)
    link, _ = stage.greet()
    link.send(b'{"type":"join","role":"monitor","client":"conformance"}\n')
    return _refused(stage, link, ("bad mac", "bad join"))


def mac_of_another(stage: Stage) -> str:
    """A mac that was right on another connection."""
    _needs_key(stage)
    _, other = stage.greet()
    link, _ = stage.greet()
    link.send(stage.join_line(other, "monitor"))
    return _refused(stage, link, ("bad mac",))


def mac_of_the_other_role(stage: Stage) -> str:
    """A mac that is right for the other role."""
    key = _needs_key(stage)
    link, hello = stage.greet()
    link.send(stage.join_line(hello, "monitor", join_mac(key, str(hello["nonce"]), "controller")))
    return _refused(stage, link, ("bad mac",))


def take_over(stage: Stage) -> str:
    """A holder that sends nothing but bad lines."""
    pair = Pair(stage)
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
    except Broken as broken:
        raise Broken(f"{broken} after {pair.newest.t_s - silent_s:.2f} s without a valid line of its holder") from None
    return f"refused at {STILL_HELD_S:g} s of silence, joined at {TAKEN_S:g} s"


def _be_noisy(pair: Pair, until_s: float) -> None:
    """Bad lines until the robot's clock shows ``until_s``."""
    while pair.newest.t_s < until_s:
        pair.controller.send(b'{"type":"drive","seq":\n')
        pair.run(NOISE_S)


def _needs_key(stage: Stage) -> bytes:
    if stage.key is None:
        raise NotApplicable("no --key")
    return stage.key


def _joined(stage: Stage, link: Link, role: Role) -> str:
    answer = stage.answer(link)
    require(answer["type"] == "joined", f"{role} refused: {answer.get('reason')}")
    session = answer.get("session")
    require(answer.get("role") == role, f"joined as {answer.get('role')!r} instead of {role}")
    require(isinstance(session, int) and not isinstance(session, bool), f"joined with session = {session!r}")
    return f"{role} joined, session {session}"


def _refused(stage: Stage, link: Link, reasons: tuple[str, ...]) -> str:
    """Wait for a refusal and the end of the connection; a close without a word is one where only time has run out."""
    answer = stage.answer(link)
    require(answer["type"] == "refused", f"{answer['type']} instead of refused: {' or '.join(reasons)}")
    require(answer.get("reason") in reasons, f"refused: {answer.get('reason')!r} instead of {' or '.join(reasons)}")
    require(stage.is_closed(link), f"refused: {answer['reason']}, and not closed")
    require(not link.lines, "a line after refused")
    return f"refused: {answer['reason']}, closed"
