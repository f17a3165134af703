"""Checks of hello, join and roles."""

import re
import time
from typing import Any

from ccatp.commissioning.conformance.checks import (
    CheckFailed,
    CheckList,
    Message,
    NotApplicable,
    Run,
    is_number,
    is_numbers,
    is_positive,
    is_whole,
    require,
)
from ccatp.commissioning.conformance.connections import (
    ALL,
    STILL,
    CheckContext,
    ControllerAndMonitor,
    RawConnection,
    steady_pair,
)
from ccatp.links.robot_codec import encode, join_mac
from ccatp.links.robot_messages import AUTH_HMAC, AUTH_NONE, PROTOCOL, Drive, Role

CHECKS = CheckList()
CONNECTIONS = 8
JOIN_S = 2.0
IN_TIME_S, LATE_S = 1.0, 2.1  # after the hello
SILENCE_S, STILL_HELD_S, TAKEN_S = 5.0, 3.5, 5.3
NOISE_S = 0.3  # between bad lines of a holder that sends nothing else
ROLES: tuple[Role, Role] = ("controller", "monitor")
_NONCE = re.compile(r"[0-9a-fA-F]{32}")

# -- hello ------------------------------------------------------------------------------------------------------------


@CHECKS.add("hello", "on accept the robot says hello: protocol, boot, nonce, auth, lockstep, frame_hz, ttl_s")
def hello_fields(context: CheckContext) -> str:
    """Fields, types and ranges of one hello."""
    return check_fields(context.greet()[1])


@CHECKS.add("hello-robot", "hello.robot describes wheels, edge sensors in their order, puck, limit and fan floor")
def hello_robot(context: CheckContext) -> str:
    """Fields, shapes and ranges of one hello."""
    return check_robot(context.greet()[1])


def check_fields(hello: Message) -> str:
    """Fields of the hello beside ``robot``, with their types."""
    _right(hello, "protocol", hello.get("protocol") == PROTOCOL)
    _right(hello, "boot", is_whole(hello.get("boot")))
    _right(hello, "nonce", isinstance(hello.get("nonce"), str) and bool(_NONCE.fullmatch(hello["nonce"])))
    _right(hello, "auth", hello.get("auth") in {AUTH_NONE, AUTH_HMAC})
    _right(hello, "lockstep", isinstance(hello.get("lockstep"), bool))
    for name in ("frame_hz", "ttl_s"):
        _right(hello, name, is_positive(hello.get(name)))
    return f"{hello['protocol']}, auth {hello['auth']}, {hello['frame_hz']:g} Hz, ttl {hello['ttl_s']:g} s"


def check_robot(hello: Message) -> str:
    """Fields of ``robot`` with their shapes, and the order of the edge sensors."""
    robot: Any = hello.get("robot")
    require(isinstance(robot, dict), f"robot = {robot!r}")
    for name in ("wheel_radius_m", "wheel_base_m", "max_wheel_rad_s"):
        _right(robot, name, is_positive(robot.get(name)))
    floor: Any
    edges: Any
    floor, edges = robot.get("fan_floor"), robot.get("edge_sensors_m")
    _right(robot, "fan_floor", is_number(floor) and 0.0 <= floor <= 1.0)
    _right(robot, "puck_m", is_numbers(robot.get("puck_m"), 3))
    shape = isinstance(edges, list) and len(edges) == 4 and all(is_numbers(edge, 2) for edge in edges)
    _right(robot, "edge_sensors_m", shape)
    front_left, front_right, rear_left, rear_right = edges
    fore = min(front_left[0], front_right[0]) > max(rear_left[0], rear_right[0])
    aside = min(front_left[1], rear_left[1]) > max(front_right[1], rear_right[1])
    require(fore and aside, f"edge_sensors_m not in the order front-left, front-right, rear-left, rear-right: {edges}")
    return f"wheels {robot['wheel_radius_m']:g} m on {robot['wheel_base_m']:g} m, fan floor {floor:g}"


def _right(message: Message, name: str, is_right: bool) -> None:
    require(is_right, f"{name} = {message[name]!r}" if name in message else f"no {name}")


@CHECKS.add("nonce", "each connection has a nonce of its own")
def nonces(context: CheckContext) -> str:
    """The hellos of 8 connections."""
    found = [context.greet()[1].get("nonce") for _ in range(CONNECTIONS)]
    again = next((nonce for k, nonce in enumerate(found) if nonce in found[:k]), None)
    require(again is None, f"nonce {again} twice in {len(found)} connections")
    return f"{len(found)} connections, {len(found)} nonces"


@CHECKS.add("boot", "boot changes at a power-up only")
def boots(context: CheckContext) -> str:
    """The hellos of 8 connections."""
    found = [context.greet()[1].get("boot") for _ in range(CONNECTIONS)]
    require(found.count(found[0]) == len(found), f"boot changes without a power-up: {found}")
    return f"boot {found[0]} on {len(found)} connections"


# -- join -------------------------------------------------------------------------------------------------------------


@CHECKS.add("join", "a join is answered by joined, with role and session")
def join_both(context: CheckContext) -> str:
    """Both roles, at once."""
    return "; ".join(_joined(context, role) for role in ROLES)


@CHECKS.add("join-in-time", "a client has 2 s to join")
def join_in_time(context: CheckContext) -> str:
    """A join 1 s after the hello."""
    link, hello = context.greet()
    require(not context.is_closed(link, IN_TIME_S), f"closed within {IN_TIME_S:g} s of the hello")
    link.send(context.join_line(hello, "monitor"))
    answer = context.answer(link)
    require(answer["type"] == "joined", f"refused {IN_TIME_S:g} s after the hello: {answer.get('reason')}")
    return f"joined {IN_TIME_S:g} s after the hello"


@CHECKS.add("join-late", "a client that does not join within 2 s is refused and closed")
def join_late(context: CheckContext) -> str:
    """A join 2.1 s after the hello, unless refused before."""
    began_s = time.monotonic()
    link, hello = context.greet()
    context.is_closed(link, LATE_S)
    spent_s = time.monotonic() - began_s
    if not link.is_ended and not link.lines:
        link.send(context.join_line(hello, "controller"))
        spent_s = time.monotonic() - began_s
    else:
        require(spent_s > 0.9 * JOIN_S, f"closed {spent_s:.2f} s after the hello")
    return f"{spent_s:.2f} s after the hello: {_refused(context, link, 'bad join')}"


_BAD_FIRST_MESSAGES = (
    ("join-role", "a role that does not exist is refused as bad join, and closed",
     b'{"type":"join","role":"king","client":"conformance","mac":""}\n'),
    ("join-client", "a join without all its keys is refused as bad join, and closed",
     b'{"type":"join","role":"controller"}\n'),
    ("join-first", "the first message of a client is its join; others are refused as bad join",
     encode(Drive(seq=1, ack=0, wr=0.0, wl=0.0))),
)  # fmt: skip


def _bad_join(line: bytes) -> Run:
    def run(context: CheckContext) -> str:
        link, _ = context.greet()
        link.send(line)
        return _refused(context, link, "bad join")

    return run


for _check_id, _promise, _line in _BAD_FIRST_MESSAGES:
    CHECKS.add(_check_id, _promise)(_bad_join(_line))


@CHECKS.add("role-taken", "one controller and one monitor at most")
def role_taken(context: CheckContext) -> str:
    """A second client for each role."""
    holders = [context.join(role) for role in ROLES]
    seen = ""
    for role in ROLES:
        link, hello = context.greet()
        link.send(context.join_line(hello, role))
        seen = _refused(context, link, "role taken")
    context.poll(0.0)
    require(not any(holder.is_ended for holder in holders), "the holder's session was closed")
    return seen


@CHECKS.add("refused-harmless", "a refused client never disturbs the holder")
def refused_is_harmless(context: CheckContext) -> str:
    """Four refused clients, while two others hold the roles."""
    pair = steady_pair(context)
    facts = context.facts
    first = len(pair.frames)
    refused = 0
    for role in ROLES:
        for line in (None, b'{"type":"join","role":"king","client":"conformance"}\n'):
            link, hello = context.greet()
            pair.run(2 * facts.frame_s)
            if not facts.is_lockstep:
                pair.rates = pair.allowed = None  # what was sent has to last
            link.send(context.join_line(hello, role) if line is None else line)
            require(context.is_closed(link), "a refused client's connection stays open")
            refused += 1
            pair.run(3 * facts.frame_s)
            pair.rates, pair.allowed = STILL, ALL
    pair.run(5 * facts.frame_s)
    pair.settle()
    limit_s = facts.ttl_s - 2 * facts.frame_s
    for frame in pair.frames[first:]:
        fresh = frame.age_s < limit_s and frame.permit_age_s < limit_s
        require(not (frame.is_held and fresh), f"the holder's drive of {frame.age_s:.3f} s is held after a refusal")
    return f"{refused} refused, {len(pair.frames) - first} frames of the holders go on"


@CHECKS.add("take-over", "a role may be taken over after 5 s without a valid line of its holder, not before",
            "real time")  # fmt: skip
def take_over(context: CheckContext) -> str:
    """A holder that sends bad lines only; joins at 3.5 s and at 5.3 s."""
    pair = steady_pair(context)
    pair.rates = None
    silent_s = pair.newest.t_s
    _send_bad_lines(pair, silent_s + STILL_HELD_S)
    link, hello = context.greet()
    link.send(context.join_line(hello, "controller"))
    answer = context.answer(link)
    pair.pause(0.0)
    if answer["type"] == "joined":
        early_s = pair.newest.t_s - silent_s
        require(early_s > SILENCE_S, f"taken over after a silence of {early_s:.2f} s")
        raise NotApplicable("the server or this machine is too slow to tell")
    _send_bad_lines(pair, silent_s + TAKEN_S)
    try:
        # Not for long: now the holder is silent altogether.
        context.join("controller", retry_s=0.2 * SILENCE_S)
    except CheckFailed as failed:
        raise CheckFailed(
            f"{failed} after {pair.newest.t_s - silent_s:.2f} s without a valid line of its holder"
        ) from None
    return f"refused at {STILL_HELD_S:g} s of silence, joined at {TAKEN_S:g} s"


def _send_bad_lines(pair: ControllerAndMonitor, until_s: float) -> None:
    while pair.newest.t_s < until_s:
        pair.controller.send(b'{"type":"drive","seq":\n')
        pair.run(NOISE_S)


# -- mac --------------------------------------------------------------------------------------------------------------


@CHECKS.add("mac", "a join with the right mac is accepted", "hmac")
def mac_right(context: CheckContext) -> str:
    """HMAC-SHA256 of nonce, colon and role."""
    _key(context)
    return _joined(context, "monitor")


@CHECKS.add("mac-wrong", "a wrong mac is refused as bad mac, and closed", "hmac")
def mac_wrong(context: CheckContext) -> str:
    """A mac made with another key."""
    key = _key(context)
    link, hello = context.greet()
    link.send(context.join_line(hello, "monitor", join_mac(key + b"x", str(hello["nonce"]), "monitor")))
    return _refused(context, link, "bad mac")


@CHECKS.add("mac-missing", "a join without the mac that auth asks for is refused, and closed", "hmac")
def mac_missing(context: CheckContext) -> str:
    """No mac."""
    _key(context)
    link, _ = context.greet()
    link.send(b'{"type":"join","role":"monitor","client":"conformance"}\n')
    return _refused(context, link, "bad mac", "bad join")


@CHECKS.add("mac-nonce", "a mac belongs to one connection", "hmac")
def mac_of_another(context: CheckContext) -> str:
    """The right mac of another connection."""
    _key(context)
    _, other = context.greet()
    link, _ = context.greet()
    link.send(context.join_line(other, "monitor"))
    return _refused(context, link, "bad mac")


@CHECKS.add("mac-role", "a mac belongs to one role", "hmac")
def mac_of_the_other_role(context: CheckContext) -> str:
    """The right mac of the other role."""
    key = _key(context)
    link, hello = context.greet()
    link.send(context.join_line(hello, "monitor", join_mac(key, str(hello["nonce"]), "controller")))
    return _refused(context, link, "bad mac")


def _key(context: CheckContext) -> bytes:
    if context.key is None:
        raise NotApplicable("no --key")
    return context.key


def _joined(context: CheckContext, role: Role) -> str:
    link, hello = context.greet()
    link.send(context.join_line(hello, role))
    answer = context.answer(link)
    require(answer["type"] == "joined", f"{role} refused: {answer.get('reason')}")
    session = answer.get("session")
    require(answer.get("role") == role, f"joined as {answer.get('role')!r} instead of {role}")
    require(is_whole(session), f"joined with session = {session!r}")
    return f"{role} joined, session {session}"


def _refused(context: CheckContext, link: RawConnection, *reasons: str) -> str:
    answer = context.answer(link)
    require(answer["type"] == "refused", f"{answer['type']} instead of refused: {' or '.join(reasons)}")
    require(answer.get("reason") in reasons, f"refused: {answer.get('reason')!r} instead of {' or '.join(reasons)}")
    require(context.is_closed(link), f"refused: {answer['reason']}, and not closed")
    require(not link.lines, "a line after refused")
    return f"refused: {answer['reason']}, closed"
