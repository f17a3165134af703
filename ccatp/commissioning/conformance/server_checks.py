"""Checks of the messages of the server: hello, answers to a join, sensors frames."""

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from statistics import median
from typing import Annotated, Any, Literal, NoReturn

from pydantic import Field

from ccatp.commissioning.conformance.harness import (
    STILL,
    CheckContext,
    CheckFailed,
    CheckList,
    ControllerAndMonitor,
    Frame,
    Message,
    MessagePart,
    NotApplicable,
    Positive,
    RawConnection,
    RobotBody,
    RobotTiming,
    Three,
    parse,
    require,
    shorten,
    steady,
    whole_samples,
)
from ccatp.core import ALL_MOTION
from ccatp.links.robot_codec import MAX_LINE_BYTES, encode, join_mac
from ccatp.links.robot_messages import PROTOCOL, Drive, Role
from ccatp.survey.checks import PATIENCE_S, MirrorCheck

CHECKS = CheckList()
check, check_steady = CHECKS.add, partial(CHECKS.add, fixture=steady)
CONNECTIONS = 8
JOIN_S = 2.0
IN_TIME_S, LATE_S = 1.0, 2.1  # after the hello
SILENCE_S, STILL_HELD_S, TAKEN_S = 5.0, 3.5, 5.3
NOISE_S = 0.3  # between bad lines of a session that sends no others
ROLES: tuple[Role, Role] = ("controller", "monitor")
FRAMES = 40  # each answered by a drive and a permit
# Largest sample rates.
MOST_HZ = {"imu": 100.0, "enc": 1000.0, "edge": 1000.0}
PERIOD_TOLERANCE = 0.2
RATE_TOLERANCE = 1.1
CLOCK_S, CLOCK_TOLERANCE = 2.0, 0.03  # 1 % of the clock, and the jitter of the frames
ATTEMPTS = 5  # a busy machine can look like a fault
OLDEST_S = 0.15  # robot.sensors_timeout_s
STALE_GRAVITY_S = 0.5
FIRST_FRAME_S = 1.0
NORM_TOLERANCE = 0.02  # of a unit vector with few decimals
TIME_TOLERANCE_S = 1e-6  # times printed with six decimals

Near = Annotated[float, Field(ge=-1.0, le=1.0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
FaultName = Literal[
    "imu", "encoder_left", "encoder_right", "edge", "fan_left", "fan_right", "battery_low", "stall"
]  # fmt: skip
Frames = Sequence[Message]

# -- hello ------------------------------------------------------------------------------------------------------------


class _HelloPart(RobotTiming):
    protocol: str
    boot: int
    nonce: Annotated[str, Field(pattern=r"^[0-9a-fA-F]{32}$")]
    auth: Literal["none", "hmac-sha256"]


class _VehiclePart(MessagePart):
    kind: Literal["ackermann", "differential"]
    axle_distance_m: Positive
    steer_max_rad: Annotated[float, Field(ge=0.0, le=1.6)]
    distance_sensors_rad: list[Annotated[float, Field(ge=-6.3, le=6.3)]]


class _RobotPart(RobotBody):
    vehicle: _VehiclePart | None = None
    fan_floor: Fraction
    puck_m: Annotated[list[Near], Field(min_length=3, max_length=3)]
    edge_sensors_m: Annotated[list[Annotated[list[Near], Field(min_length=2, max_length=2)]],
                              Field(min_length=4, max_length=4)]  # fmt: skip


class _HelloRobot(MessagePart):
    robot: _RobotPart


@check("hello", "on accept the robot says hello: protocol, boot, nonce, auth, lockstep, frame_hz, ttl_s")
def _hello(context: CheckContext) -> str:
    found = parse(_HelloPart, context.greet()[1])
    require(found.protocol == PROTOCOL, f"protocol = {found.protocol!r}")
    return f"{found.protocol}, auth {found.auth}, {found.frame_hz:g} Hz, ttl {found.ttl_s:g} s"


@check("hello-robot", "hello.robot describes wheels, edge sensors in their order or the vehicle, limit and fan floor")
def _hello_robot(context: CheckContext) -> str:
    robot = parse(_HelloRobot, context.greet()[1]).robot
    wheels = f"wheels {robot.wheel_radius_m:g} m on {robot.wheel_base_m:g} m"
    if (vehicle := robot.vehicle) is not None:  # it drives on a floor, which has no edge
        return f"{wheels}, {vehicle.kind}, {len(vehicle.distance_sensors_rad)} distance sensors"
    front_left, front_right, rear_left, rear_right = edges = robot.edge_sensors_m
    fore = min(front_left[0], front_right[0]) > max(rear_left[0], rear_right[0])
    aside = min(front_left[1], rear_left[1]) > max(front_right[1], rear_right[1])
    require(fore and aside, f"edge_sensors_m not in the order front-left, front-right, rear-left, rear-right: {edges}")
    return f"{wheels}, fan floor {robot.fan_floor:g}"


@check("nonce", "each connection has a nonce of its own")
def _nonces(context: CheckContext) -> str:
    found = [context.greet()[1].get("nonce") for _ in range(CONNECTIONS)]
    again = next((nonce for k, nonce in enumerate(found) if nonce in found[:k]), None)
    require(again is None, f"nonce {again} twice in {len(found)} connections")
    return f"{len(found)} connections, {len(found)} nonces"


@check("boot", "boot changes at a power-up only")
def _boots(context: CheckContext) -> str:
    found = [context.greet()[1].get("boot") for _ in range(CONNECTIONS)]
    require(found.count(found[0]) == len(found), f"boot changes without a power-up: {found}")
    return f"boot {found[0]} on {len(found)} connections"


# -- join -------------------------------------------------------------------------------------------------------------


@check("join", "a join is answered by joined, with role and a session of its own")
def _join_both(context: CheckContext) -> str:
    seen = [_joined(context, role) for role in ROLES]
    require(len({session for _, session in seen}) == len(ROLES), f"both sessions have the number {seen[0][1]}")
    return "; ".join(f"{role} joined, session {session}" for role, session in seen)


@check("join-in-time", "a client has 2 s to join")
def _join_in_time(context: CheckContext) -> str:
    connection, hello = context.greet()
    require(not context.is_closed(connection, IN_TIME_S), f"closed within {IN_TIME_S:g} s of the hello")
    connection.send(context.join_line(hello, "monitor"))
    answer = context.answer(connection)
    require(answer["type"] == "joined", f"refused {IN_TIME_S:g} s after the hello: {answer.get('reason')}")
    return f"joined {IN_TIME_S:g} s after the hello"


@check("join-late", "a client that does not join within 2 s is refused and closed")
def _join_late(context: CheckContext) -> str:
    began_s = time.monotonic()
    connection, hello = context.greet()
    context.is_closed(connection, LATE_S)
    spent_s = time.monotonic() - began_s
    if not connection.is_ended and not connection.lines:
        connection.send(context.join_line(hello, "controller"))
        spent_s = time.monotonic() - began_s
    else:
        require(spent_s > 0.9 * JOIN_S, f"closed {spent_s:.2f} s after the hello")
    return f"{spent_s:.2f} s after the hello: {_refused(context, connection, 'bad join')}"


def _bad_join(check_id: str, promise: str, line: bytes, reason: str = "bad join") -> None:
    @check(check_id, promise)
    def _(context: CheckContext) -> str:
        connection, _ = context.greet()
        connection.send(line)
        return _refused(context, connection, reason)


_bad_join("join-role", "a role that does not exist is refused as bad join, and closed",
          b'{"type":"join","role":"king","client":"conformance","mac":""}\n')  # fmt: skip
_bad_join("join-client", "a join without all its keys is refused as bad join, and closed",
          b'{"type":"join","role":"controller"}\n')  # fmt: skip
_bad_join("join-first", "the first message of a client is its join; others are refused as bad join",
          encode(Drive(seq=1, ack=0, wr=0.0, wl=0.0)))  # fmt: skip
_bad_join("join-protocol", "a join for another protocol is refused as bad protocol, and closed",
          b'{"type":"join","protocol":"ccatp-robot/0","role":"controller","client":"conformance","mac":""}\n',
          "bad protocol")  # fmt: skip


@check("role-taken", "one controller and one monitor at most")
def _role_taken(context: CheckContext) -> str:
    holders = [context.join(role) for role in ROLES]
    seen = ""
    for role in ROLES:
        connection, hello = context.greet()
        connection.send(context.join_line(hello, role))
        seen = _refused(context, connection, "role taken")
    context.poll(0.0)
    require(not any(holder.is_ended for holder in holders), "the holder's session was closed")
    return seen


@check_steady("refused-harmless", "a refused client never disturbs the holder")
def _refused_is_harmless(pair: ControllerAndMonitor) -> str:
    facts = pair.facts
    first = len(pair.frames)
    refused = 0
    for role in ROLES:
        for line in (None, b'{"type":"join","role":"king","client":"conformance"}\n'):
            connection, hello = pair.context.greet()
            pair.run_frames(2)
            if not facts.lockstep:
                pair.rates = pair.allowed = None  # the commands already sent must stay in force
            connection.send(pair.context.join_line(hello, role) if line is None else line)
            require(pair.context.is_closed(connection), "a refused client's connection stays open")
            refused += 1
            pair.run_frames(3)
            pair.rates, pair.allowed = STILL, ALL_MOTION
    pair.run_frames(5)
    pair.settle()
    limit_s = facts.ttl_s - 2 * facts.frame_s
    for frame in pair.frames[first:]:
        is_fresh = max(frame.cmd.age, frame.cmd.permit_age) < limit_s
        require(
            not (frame.cmd.held and is_fresh), f"the holder's drive of {frame.cmd.age:.3f} s is held after a refusal"
        )
    return f"{refused} refused, {len(pair.frames) - first} frames of the holders continue"


@check_steady(
    "take-over", "a role may be taken over after 5 s without a valid line of its holder, not before", "real time"
)
def _take_over(pair: ControllerAndMonitor) -> str:
    pair.rates = None
    silent_s = pair.newest.t
    _send_bad_lines(pair, silent_s + STILL_HELD_S)
    _, answer = pair.context.request("controller")
    pair.pause(0.0)
    if answer["type"] == "joined":
        early_s = pair.newest.t - silent_s
        require(early_s > SILENCE_S, f"taken over after a silence of {early_s:.2f} s")
        raise NotApplicable("the server or this machine is too slow for this check")
    _send_bad_lines(pair, silent_s + TAKEN_S)
    try:
        # Retry for a short time only: now the holder sends no lines at all.
        pair.context.join("controller", retry_s=0.2 * SILENCE_S)
    except CheckFailed as failed:
        late_s = pair.newest.t - silent_s
        raise CheckFailed(f"{failed} after {late_s:.2f} s without a valid line of its holder") from None
    return f"refused at {STILL_HELD_S:g} s of silence, joined at {TAKEN_S:g} s"


def _send_bad_lines(pair: ControllerAndMonitor, until_s: float) -> None:
    while pair.newest.t < until_s:
        pair.controller.send(b'{"type":"drive","seq":\n')
        pair.run(NOISE_S)


# -- mac --------------------------------------------------------------------------------------------------------------


@check("mac", "a join with the right mac is accepted", "hmac")
def _mac_right(context: CheckContext) -> str:
    return f"monitor joined, session {_joined(context, 'monitor')[1]}"


def _bad_mac(check_id: str, promise: str, line: Callable[[CheckContext, Message], bytes], *reasons: str) -> None:
    @check(check_id, promise, "hmac")
    def _(context: CheckContext) -> str:
        connection, hello = context.greet()
        connection.send(line(context, hello))
        return _refused(context, connection, "bad mac", *reasons)


def _forged(context: CheckContext, hello: Message, suffix: bytes, role: Role) -> bytes:
    """A monitor's join with the mac of another key or role."""
    return context.join_line(hello, "monitor", join_mac((context.key or b"") + suffix, str(hello["nonce"]), role))


_bad_mac("mac-wrong", "a wrong mac is refused as bad mac, and closed",
         lambda context, hello: _forged(context, hello, b"x", "monitor"))  # fmt: skip
_bad_mac("mac-missing", "a join without the mac that auth asks for is refused, and closed",
         lambda *_: b'{"type":"join","role":"monitor","client":"conformance"}\n', "bad join")  # fmt: skip
_bad_mac("mac-nonce", "a mac belongs to one connection",
         lambda context, _: context.join_line(context.greet()[1], "monitor"))  # fmt: skip
_bad_mac("mac-role", "a mac belongs to one role",
         lambda context, hello: _forged(context, hello, b"", "controller"))  # fmt: skip


def _joined(context: CheckContext, role: Role) -> tuple[Role, int]:
    _, answer = context.request(role)
    require(answer["type"] == "joined", f"{role} refused: {answer.get('reason')}")
    session = answer.get("session")
    require(answer.get("role") == role, f"joined as {answer.get('role')!r} instead of {role}")
    if type(session) is not int:
        raise CheckFailed(f"joined with session = {session!r}")
    return role, session


def _refused(context: CheckContext, connection: RawConnection, *reasons: str) -> str:
    answer = context.answer(connection)
    require(answer["type"] == "refused", f"{answer['type']} instead of refused: {' or '.join(reasons)}")
    require(answer.get("reason") in reasons, f"refused: {answer.get('reason')!r} instead of {' or '.join(reasons)}")
    require(context.is_closed(connection), f"refused: {answer['reason']}, and not closed")
    require(not connection.lines, "a line after refused")
    return f"refused: {answer['reason']}, closed"


# -- frames -----------------------------------------------------------------------------------------------------------


class _SamplesPart(MessagePart):
    imu: list[Three]
    enc: list[Three]
    edge: list[Annotated[list[float], Field(min_length=5, max_length=5)]]


class _GravityPart(MessagePart):
    gravity: Annotated[list[float], Field(min_length=4, max_length=4)] | None


class _StatePart(MessagePart):
    fans: Annotated[list[Fraction], Field(min_length=2, max_length=2)]
    soc: Fraction


class _FaultsPart(MessagePart):
    faults: list[FaultName]


@contextmanager
def _recorded(context: CheckContext) -> Iterator[ControllerAndMonitor]:
    pair = ControllerAndMonitor(context)
    pair.run_frames(FRAMES)
    if pair.facts.lockstep:  # a frame is sent again, unchanged, if this machine was busy
        for messages in pair.messages:
            messages[1:] = [after for before, after in pairwise(messages) if after != before]
    require(len(pair.messages[0]) > 2, "fewer than three frames for the controller")
    yield pair


@contextmanager
def _received(context: CheckContext) -> Iterator[Frames]:
    with _recorded(context) as pair:
        yield pair.messages[0]


check_recorded, check_frames = partial(CHECKS.add, fixture=_recorded), partial(CHECKS.add, fixture=_received)


@check_recorded("frames-lines", "one JSON object a line, finite numbers, no key twice, at most 8192 bytes")
def _lines(pair: ControllerAndMonitor) -> str:
    for line in pair.raw:
        require((fault := line_fault(line, MAX_LINE_BYTES)) is None, str(fault))
    return f"{len(pair.raw)} lines, the longest of {max(map(len, pair.raw))} bytes"


def line_fault(line: bytes, limit_bytes: int) -> str | None:
    """The error of a line: length, JSON, a repeated key, a number that is not finite; ``None`` if it is correct."""

    def once(pairs: list[tuple[str, Any]]) -> Message:
        if len(dict(pairs)) != len(pairs):
            raise ValueError("a key stands twice")
        return dict(pairs)

    def finite(text: str) -> float:
        if not math.isfinite(float(text)):
            raise ValueError(f"number {text[:20]} is not finite")
        return float(text)

    def constant(text: str) -> NoReturn:
        raise ValueError(f"{text} is no number of JSON")

    if len(line) > limit_bytes:
        return f"a line of {len(line)} bytes"
    try:
        value = json.loads(line.decode("utf-8"), object_pairs_hook=once, parse_float=finite, parse_constant=constant)
    except (ValueError, RecursionError) as error:
        return f"{error} in {shorten(line)}"
    return None if isinstance(value, dict) else f"no object: {shorten(line)}"


@check("frames-first", "the first frame comes unasked, at most 1 s after joined")
def _first_frame(context: CheckContext) -> str:
    controller = context.join("controller")
    came = context.until(lambda: b'"sensors"' in b"".join(controller.lines), FIRST_FRAME_S + NOISE_S)
    require(came, f"no frame within {FIRST_FRAME_S + NOISE_S:g} s after joined, of a controller that sends nothing")
    return "a frame for a controller that sends nothing"


@check_frames("frames-seq", "seq of the frames increases by one")
def _seq(frames: Frames) -> str:
    numbers = [frame["seq"] for frame in frames]
    for before, after in pairwise(numbers):
        require(after == before + 1, f"seq {after} after {before}")
    return f"{numbers[0]} to {numbers[-1]} in {len(frames)} frames"


@check_recorded("frames-clock", "t is a monotonic clock in seconds; frames come at frame_hz")
def _clock(pair: ControllerAndMonitor) -> str:
    return check_clock(pair.messages[0], pair.facts.frame_hz)


def check_clock(frames: Frames, frame_hz: float) -> str:
    """The times of the frames increase, and their median period is that of the hello within ``PERIOD_TOLERANCE``."""
    require(frames[0]["t"] >= 0.0, f"t = {frames[0]['t']!r}")
    steps_s = []
    for before, after in pairwise(frames):
        require(after["t"] > before["t"], f"t {after['t']} after {before['t']}")
        steps_s.append((after["t"] - before["t"]) / max(1, after["seq"] - before["seq"]))
    step_s = median(steps_s)
    seen = f"a frame each {1e3 * step_s:.3g} ms, frame_hz {frame_hz:g}"
    require(abs(step_s * frame_hz - 1.0) <= PERIOD_TOLERANCE, seen)
    return seen


@check_frames("frames-samples", "imu, enc and edge are lists of samples, each with its time")
def _shapes(frames: Frames) -> str:
    for frame in frames:
        parse(_SamplesPart, frame)
    return ", ".join(f"{sum(len(frame[name]) for frame in frames)} {name}" for name in MOST_HZ) + " samples"


@check_frames("frames-times", "a list holds the samples since the last frame, oldest first")
def _times(frames: Frames) -> str:
    for frame in frames:
        gravity_s, *_ = frame.get("gravity") or [frame["t"]]
        is_fresh = frame["t"] - STALE_GRAVITY_S <= gravity_s <= frame["t"] + TIME_TOLERANCE_S
        require(is_fresh, f"gravity of {gravity_s} in the frame of {frame['t']}")
    for name in MOST_HZ:
        latest_s = -math.inf
        for before, after in pairwise(frames):
            for t_s, *_ in _samples(after, name):
                require(t_s > latest_s, f"{name} sample of {t_s} after one of {latest_s}")
                inside = before["t"] - TIME_TOLERANCE_S < t_s <= after["t"] + TIME_TOLERANCE_S
                require(inside, f"{name} sample of {t_s} in the frame from {before['t']} to {after['t']}")
                latest_s = t_s
    return f"in order and within their frames, {len(frames) - 1} frames"


@check_frames("frames-rates", "IMU up to 100 Hz, encoders and edge sensors up to 1000 Hz")
def _rates(frames: Frames) -> str:
    span_s = frames[-1]["t"] - frames[0]["t"]
    seen = []
    for name, most_hz in MOST_HZ.items():
        rate_hz = sum(len(_samples(frame, name)) for frame in frames[1:]) / span_s
        seen.append(f"{name} {rate_hz:.0f} Hz")
        require(rate_hz <= RATE_TOLERANCE * most_hz, f"{name} at {rate_hz:.0f} Hz, at most {most_hz:g}")
    return ", ".join(seen)


def _samples(frame: Message, name: str) -> list[list[float]]:
    return whole_samples(frame.get(name), 5 if name == "edge" else 3)


@check_frames("frames-edge", "edge values are 0 or 1")
def check_edges(frames: Frames) -> str:
    """Values of the edge sensors are 0 or 1."""
    samples = [sample for frame in frames for sample in _samples(frame, "edge")]
    if not samples:
        raise NotApplicable("no edge samples in these frames")
    for sample in samples:
        require(all(value in {0, 1} for value in sample[1:]), f"edge sample {sample}")
    return f"{len(samples)} samples of 0 and 1, the last {samples[-1][1:]}"


@check_recorded("frames-gravity", "gravity is null, or a time and the unit vector along which things fall")
def _gravity(pair: ControllerAndMonitor) -> str:
    return check_gravity(pair.messages[0], pair.facts.robot.fan_floor)


def check_gravity(frames: Frames, fan_floor: float = 0.0) -> str:
    """Gravity is null, or a time and a unit vector, which points towards the surface if ``fan_floor`` is 0."""
    found = [gravity for frame in frames if (gravity := parse(_GravityPart, frame).gravity) is not None]
    for gravity in found:
        norm = math.hypot(*gravity[1:])
        require(abs(norm - 1.0) <= NORM_TOLERANCE, f"gravity of length {norm:.4g}: {gravity}")
        holds = fan_floor > 0.0 or gravity[3] < 0.0
        require(holds, f"gravity {gravity[1:]} points away from the surface, and fan_floor is 0: wrong sign of z?")
    return f"{len(found)} unit vectors in {len(frames)} frames"


@check_steady("mirror", "gravity is that of the mirror's base, and the edge sensors see its panel")
def _at_base(pair: ControllerAndMonitor) -> str:
    mirror = pair.context.mirror
    if mirror is None:
        raise NotApplicable("--mirror says at whose base the robot stands")
    check = MirrorCheck(mirror, is_heading_known=True)

    def update(frame: Frame) -> bool:
        gravity = whole_samples([frame.gravity], 4)
        return check.update(frame.t, gravity[0] if gravity else None, mirror.base_pose)

    pair.find(update, PATIENCE_S + 1.0)
    require(not check.contradiction, check.contradiction)
    require(not mirror.overhang or pair.facts.robot.fan_floor > 0.0, f"fan_floor 0 on {mirror.name}, which overhangs")
    edges = [sample for message in pair.messages[0][-FRAMES:] for sample in _samples(message, "edge")]
    require(not edges or edges[-1][1:] == [1.0] * 4, f"edge sample {edges[-1:]} at base, where all see the panel")
    return check.warning or f"slope and edge values are those of {mirror.name} at base"


@check_frames("frames-state", "fans and soc are within 0 and 1")
def _state(frames: Frames) -> str:
    states = [parse(_StatePart, frame) for frame in frames]
    return f"fans {states[-1].fans}, charge {states[-1].soc:g}"


@check_frames("frames-faults", "faults holds names out of the page's list")
def _faults(frames: Frames) -> str:
    seen = {name for frame in frames for name in parse(_FaultsPart, frame).faults}
    return f"faults: {', '.join(sorted(seen)) or 'none'}"


@check_frames("frames-cmd", "cmd holds seq, age, permit_age and held")
def _command(frames: Frames) -> str:
    for frame in frames:
        for name in ("age", "permit_age"):
            require(frame["cmd"][name] >= 0.0, f"cmd.{name} = {frame['cmd'][name]!r}")
    return f"the last {frames[-1]['cmd']}"


@check_recorded("frames-all", "every frame goes to every joined session")
def _to_both(pair: ControllerAndMonitor) -> str:
    """Compares the range of frames that both sessions received."""
    one, other = ([frame["seq"] for frame in frames] for frames in pair.messages)
    require(bool(other), "no frames for the monitor")
    first, last = max(one[0], other[0]), min(one[-1], other[-1])
    one, other = ([seq for seq in seqs if first <= seq <= last] for seqs in (one, other))
    lacking = sorted(set(one) ^ set(other))
    require(not lacking, f"frame {lacking[0] if lacking else ''} reached one session only")
    require(bool(one), "controller and monitor saw no frame in common")
    return f"{len(one)} frames, the same for both"


@check_steady("frames-joined", "frames go to joined sessions only")
def _before_join(pair: ControllerAndMonitor) -> str:
    onlooker, _ = pair.context.greet()
    pair.run_frames(10)
    require(not any(b'"sensors"' in line for line in onlooker.lines), "sensors frames before the join")
    return f"none in {len(pair.frames)} frames"


@check_steady("echo", "cmd echoes the newest drive in force and its age")
def _echo(pair: ControllerAndMonitor) -> str:
    frames = [*pair.run_frames(20), *pair.settle()]
    for before, after in pairwise(frames):
        require(after.cmd.seq >= before.cmd.seq, f"cmd.seq {after.cmd.seq} after {before.cmd.seq}")
    ages_s = [frame.cmd.age for frame in frames[-10:]]
    require(max(ages_s) < pair.facts.ttl_s, f"cmd.age {max(ages_s):.3f} s with a new drive for each frame")
    return f"drive {pair.newest.cmd.seq} in force, age {ages_s[-1]:.3f} s"


@check_steady("seq-session", "a client's seq counts within its session, the robot's within its boot")
def _seq_of_a_session(pair: ControllerAndMonitor) -> str:
    context, last = pair.context, pair.settle()[-1].seq
    used, context.last_seq = context.last_seq, 0
    pair.rejoin()
    first = len(pair.messages[0])
    try:
        frame = pair.steady()
        if len(pair.messages[0]) == first:  # so far only the monitor's frames have arrived
            pair.expect(lambda _: len(pair.messages[0]) > first, "no frame for the controller in a new session")
    finally:
        context.last_seq = used
    new = pair.messages[0][first]["seq"]
    require(new >= last, f"frame {new} of a new session after {last}")  # equal in lockstep: the frame is sent again
    return f"drive {frame.cmd.seq} of a new session obeyed after {used}, frame {new} after {last}"


@check_steady("clock", "the rate of the robot's clock is wrong by up to 1 %", "real time")
def _clock_rate(pair: ControllerAndMonitor) -> str:
    """Rate between the frames with the shortest delay in the first and in the last quarter of the time."""
    rate = 0.0
    for _ in range(ATTEMPTS):
        first = len(pair.frames)
        pair.run(CLOCK_S)
        times = [(s - f.t, f.t) for f, s in zip(pair.frames[first:], pair.received_s[first:], strict=True)]
        (early_s, begin_s), (late_s, end_s) = min(times[: len(times) // 4]), min(times[-len(times) // 4 :])
        rate = (end_s - begin_s) / (end_s - begin_s + late_s - early_s) - 1.0
        if abs(rate) <= CLOCK_TOLERANCE:
            break
    require(abs(rate) <= CLOCK_TOLERANCE, f"the robot's clock goes {100.0 * rate:+.1f} % against this machine's")
    return f"{100.0 * rate:+.1f} % against this machine's"


@check_steady("frames-age", "a frame that answers a drive is not older than 0.15 s, there and back", "real time")
def _age(pair: ControllerAndMonitor) -> str:
    trip_s = math.inf
    for _ in range(ATTEMPTS):
        pair.run(FIRST_FRAME_S)
        # Age 0 gives no arrival time: a robot that sends late frames afterwards reports it for later messages.
        seen = [(f.cmd, at_s) for f, at_s in zip(pair.frames, pair.received_s, strict=True) if f.cmd.age > 0.0]
        trip_s = min((at_s - pair.sent_s.get(cmd.seq, -math.inf) - cmd.age for cmd, at_s in seen), default=math.inf)
        if trip_s <= OLDEST_S:
            break
    require(trip_s <= OLDEST_S, f"frames are {1e3 * trip_s:.0f} ms old, {1e3 * OLDEST_S:g} ms at most")
    return f"{1e3 * trip_s:.1f} ms from drive to frame, besides its age"
