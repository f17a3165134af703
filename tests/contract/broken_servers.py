"""Servers that break the interface page in one place each, with the checks that this place must fail."""

import asyncio
import json
import math
from collections import deque
from collections.abc import Callable
from typing import Any

from ccatp.commissioning.conformance.command_checks import BAD_DRIVES
from ccatp.commissioning.conformance.runner import check_ids
from ccatp.core import Permits
from ccatp.links.robot_codec import BadLineCounter, LineBuffer, join_mac
from ccatp.links.robot_messages import Drive, Permit, Role
from ccatp.links.robot_messages import Fans as FansMessage
from ccatp.onboard.rules import MotionRules
from tests.contract.defects import Defect, Message, Middle, around, clock, each, of, put, rules, swap
from tests.support.scenario import SurveyLoop

KEY = b"secret"
IDS = check_ids()
HELLO = tuple(IDS[: IDS.index("join")])
JOIN = ("join", "join-role", "join-client", "join-first", "join-protocol", "role-taken", "refused-harmless")
MAC = tuple(name for name in IDS if name.startswith("mac"))
FRAMES = (*(name for name in IDS if name.startswith("frames")), "echo")
AT_BASE = ("mirror", "frames-gravity", "frames-edge")
NEWEST = ("newest-drive", "newest-permit", "role-drive", "newest-fans", "role-fans")
FANS = ("fans", "newest-fans", "role-fans", "fans-stop", "fans-fin", "fans-rst", "fan-floor")
LINES = tuple(IDS[IDS.index("no-json") : IDS.index("lockstep-drive")])
LOCKSTEP = tuple(name for name in IDS if name.startswith("lockstep"))
MOVES = tuple(name for name in IDS if name.startswith("move"))  # the last is move-clamp
TIMED = (
    "no-permit",
    "no-drive",
    "ttl-drive",
    "ttl-permit",
    "ttl-noise",
    "role-permit",
    *(n for n in IDS if n.startswith("lost")),
)


# -- hello and join ---------------------------------------------------------------------------------------------------


def _edges(hello: Message, _: Middle) -> None:
    edges = hello["robot"]["edge_sensors_m"]
    edges[0], edges[1] = edges[1], edges[0]


def _boots(hello: Message, middle: Middle) -> None:
    middle.owner.counts["boots"] += 1
    hello["boot"] = middle.owner.counts["boots"]


def _throw_out(loop: SurveyLoop, join: Any, session: Any, message: Any, now_s: float) -> None:
    holder = loop._holders.get(getattr(message, "role", "controller"))
    if holder is not None:
        loop.drop(holder, "thrown out")
    join(session, message, now_s)


def _disturb(loop: SurveyLoop, refuse: Any, session: Any, reason: Any) -> None:
    for holder in list(loop._holders.values()):
        holder.close()
    refuse(session, reason)


def _each_session(change: Callable[[Any], object]) -> Callable[[SurveyLoop], None]:
    def accept(_: SurveyLoop, method: Any, session: Any, now_s: float) -> None:
        method(session, now_s)
        change(session)

    return around("accept", accept)


def _patient(extra_s: float) -> Callable[[SurveyLoop], None]:
    return _each_session(lambda session: setattr(session, "joined_s", session.joined_s + extra_s))


def _join_by_drive(data: bytes, middle: Middle) -> bytes:
    if middle.role is None and b"drive" in data:
        return b'{"type":"join","role":"controller","client":"x"}\n'
    return data


def _mac(is_good: Callable[[Message, Middle], bool]) -> Callable[[bytes, Middle], bytes]:
    """Macs that are not right, and taken."""

    def received(data: bytes, middle: Middle) -> bytes:
        if b'"join"' not in data:
            return data
        join = json.loads(data)
        if is_good(join, middle):
            join["mac"] = join_mac(KEY, middle.hello["nonce"], join["role"])
        return json.dumps(join).encode() + b"\n"

    return received


def _mac_of_any(join: Message, middle: Middle) -> bool:
    nonces = middle.owner.__dict__.setdefault("nonces", [])
    others = [connection for connection in middle.owner.connections if isinstance(connection, Middle)]
    nonces.extend(connection.hello["nonce"] for connection in others if connection.hello)
    return any(join.get("mac") == join_mac(KEY, nonce, join["role"]) for nonce in nonces)


def _mac_of_any_role(join: Message, middle: Middle) -> bool:
    return join.get("mac") in {join_mac(KEY, middle.hello["nonce"], role) for role in ("controller", "monitor")}


def _of_robot(**values: Any) -> Callable[[Message, Middle], Message]:
    return of("hello", lambda hello, _: hello["robot"].update(values))


def _stays(loop: SurveyLoop, _: Any, session: Any, reason: str) -> None:
    session.write(json.dumps({"type": "refused", "reason": reason}).encode() + b"\n")


def _first_asks(message: Message, middle: Middle) -> Message | None:
    return message if message["type"] != "sensors" or middle.has_sent else None


def _notes_what_was_sent(data: bytes, middle: Middle) -> bytes:
    middle.has_sent = middle.has_sent or b'"drive"' in data
    return data


SESSIONS = [
    Defect("wheel radius in mm", "hello-robot", HELLO, sends=_of_robot(wheel_radius_m=30.0)),
    Defect("wheel base in mm", "hello-robot", HELLO, sends=_of_robot(wheel_base_m=150.0)),
    Defect("top speed in rpm", "hello-robot", HELLO, sends=_of_robot(max_wheel_rad_s=76.4)),
    Defect("edge sensors in mm", "hello-robot", HELLO,
            sends=_of_robot(edge_sensors_m=[[90.0, 90.0], [90.0, -90.0], [-90.0, 90.0], [-90.0, -90.0]])),
    Defect("puck in mm", "hello-robot", HELLO, sends=_of_robot(puck_m=[0.0, 0.0, 50.0])),
    Defect("fan floor in per cent", "hello-robot", HELLO, sends=_of_robot(fan_floor=60.0)),
    Defect("no puck", "hello-robot", HELLO, sends=of("hello", lambda hello, _: hello["robot"].pop("puck_m"))),
    Defect("a time-to-live of five seconds", "hello", HELLO, sends=put("hello", ttl_s=5.0)),
    Defect("time-to-live in ms", "hello", HELLO, sends=put("hello", ttl_s=250.0)),
    Defect("period of the frames for their rate", "hello", HELLO, sends=put("hello", frame_hz=0.01)),
    Defect("one session number for all", "join", JOIN, sends=put("joined", session=1)),
    Defect("joins of another protocol", "join-protocol", JOIN, receives=swap(b"ccatp-robot/0", b"ccatp-robot/1")),
    Defect("refuses and stays", "join-role join-client join-first join-protocol", JOIN[1:5],
            modify=around("refuse", _stays)),
    Defect("no frame without a drive", "frames-first", ("frames-first",), sends=_first_asks,
            receives=_notes_what_was_sent),
    Defect("protocol of another version", "hello", HELLO, sends=put("hello", protocol="ccatp-robot/2")),
    Defect("boot as text", "hello", HELLO, sends=put("hello", boot="417")),
    Defect("edge sensors in another order", "hello-robot", HELLO, sends=of("hello", _edges)),
    Defect("a repeated nonce", "nonce", HELLO, sends=put("hello", nonce="0" * 32)),
    Defect("a boot per connection", "boot", HELLO, sends=of("hello", _boots)),
    Defect("joined without session", "join", JOIN, sends=of("joined", lambda joined, _: joined.pop("session"))),
    Defect("an unknown role taken for monitor", "join-role", JOIN[:5], receives=swap(b"king", b"monitor")),
    Defect("join without client", "join-client", JOIN, receives=swap(b'"controller"}', b'"controller","client":"x"}')),
    Defect("joined by a drive", "join-first", JOIN, receives=_join_by_drive),
    Defect("the last to come has the role", "role-taken refused-harmless", JOIN,
            modify=around("join", _throw_out)),
    Defect("a refusal closes the holders, too", "role-taken refused-harmless", JOIN,
            modify=around("refuse", _disturb)),
    Defect("waits for joins for ever", "join-late", ("join-late", "join"), modify=_patient(60.0)),
    Defect("waits for joins half a second", "join-late join-in-time",
            ("join-late", "join-in-time", "join"), modify=_patient(-1.5)),
]  # fmt: skip
MACS = [
    Defect("takes every mac", " ".join(MAC[1:]), MAC, receives=_mac(lambda *_: True)),
    Defect("takes a bad mac", "mac-wrong mac-nonce mac-role", MAC, receives=_mac(lambda join, _: "mac" in join)),
    Defect("takes no mac", "mac-missing", MAC, receives=_mac(lambda join, _: "mac" not in join)),
    Defect("takes a mac of any connection", "mac-nonce", MAC, receives=_mac(_mac_of_any)),
    Defect("takes a mac of any role", "mac-role", MAC, receives=_mac(_mac_of_any_role)),
    Defect("says bad join of a bad mac", "mac-wrong mac-nonce mac-role", MAC, sends=put("refused", reason="bad join")),
]  # fmt: skip

# -- frames -----------------------------------------------------------------------------------------------------------


def _thrice(frame: Message) -> None:
    frame["imu"] = [[t - back, ax, wz] for t, ax, wz in frame["imu"] for back in (0.006, 0.003, 0.0)]


def _not_each_to_the_monitor(message: Message, middle: Middle) -> Message | None:
    is_left_out = message["type"] == "sensors" and middle.role == "monitor" and message["seq"] % 7 == 0
    return None if is_left_out else message


def _to_all(loop: SurveyLoop, send: Any) -> None:
    send()
    if len(loop._holders) == 2:
        for session in loop._sessions:
            if session.role is None:
                session.write(loop.robot.delivered_line)


def _key_twice(message: Message, _: Middle) -> Message | bytes:
    if message["type"] != "sensors":
        return message
    return json.dumps(message).encode().replace(b'"soc"', b'"soc": 1.0, "soc"') + b"\n"


def _fix(name: str, frame: Message, place: int, value: float) -> None:
    for sample in frame[name]:
        sample[place] = value


def _shifted(name: str, back_s: float) -> Callable[[Message, Middle], Message]:
    return each(lambda f: [sample.__setitem__(0, sample[0] - back_s) for sample in f[name]])


def _gravity(change: Callable[[float, float, float, float], list[float]]) -> Callable[[Message, Middle], Message]:
    return each(lambda f: f["gravity"] and f.update(gravity=change(*f["gravity"])))


STREAMS = [
    Defect("samples of three frames ago", "frames-times", FRAMES, sends=_shifted("enc", 0.03)),
    Defect("samples of the next frame", "frames-times", FRAMES, sends=_shifted("edge", -0.01)),
    Defect("samples with the frame's time", "frames-times", FRAMES, sends=each(
        lambda f: _fix("enc", f, 0, f["t"]))),
    Defect("gravity of a second ago", "frames-times", FRAMES, sends=_gravity(lambda t, *g: [t - 1.0, *g])),
    Defect("gravity of the time to come", "frames-times", FRAMES, sends=_gravity(lambda t, *g: [t + 0.5, *g])),
    Defect("gravity points up", "frames-gravity", FRAMES, sends=_gravity(lambda t, x, y, z: [t, -x, -y, -z])),
    Defect("time in ms", "frames-clock", ("frames-clock",), sends=clock(lambda t_s: 1000.0 * t_s)),
    Defect("time in whole seconds", "frames-clock", ("frames-clock",), sends=each(lambda f: f.update(t=f["t"] // 1))),
    Defect("a clock that jumps back", "frames-clock", ("frames-clock",),
            sends=clock(lambda t_s: t_s - 0.05 * (round(100 * t_s) % 10 == 0))),
    Defect("ages in ms", "echo", FRAMES, sends=each(lambda f: f["cmd"].update(age=1000.0 * f["cmd"]["age"]))),
    Defect("fan duties in per cent", "frames-state", FRAMES, sends=each(
        lambda f: f.update(fans=[100.0 * duty + 50.0 for duty in f["fans"]]))),
    Defect("a rate that is no number", "frames-lines", ("frames-lines", "frames-seq"),
            sends=each(lambda f: _fix("imu", f, 2, math.nan))),
    Defect("a key twice", "frames-lines", FRAMES, sends=_key_twice),
    Defect("another rate than the hello's", "frames-clock", FRAMES, sends=put("hello", frame_hz=60.0)),
    Defect("samples of two", "frames-samples", FRAMES,
            sends=each(lambda frame: frame.update(imu=[sample[:2] for sample in frame["imu"]]))),
    Defect("newest samples first", "frames-times", FRAMES, sends=each(lambda f: f["enc"].reverse())),
    Defect("samples of the frame before", "frames-times", FRAMES,
            sends=each(lambda f: [sample.__setitem__(0, sample[0] - 0.015) for sample in f["imu"]])),
    Defect("three times as many", "frames-rates", FRAMES, sends=each(_thrice)),
    Defect("an edge of two", "frames-edge", FRAMES, sends=each(lambda f: _fix("edge", f, 3, 2))),
    Defect("gravity in m/s2", "frames-gravity", FRAMES, sends=each(
        lambda f: f["gravity"] and f.update(gravity=[f["gravity"][0], 0.0, 0.0, -9.81]))),
    Defect("charge in per cent", "frames-state", FRAMES, sends=put("sensors", soc=93.0)),
    Defect("a fault of its own", "frames-faults", FRAMES, sends=put("sensors", faults=["on_fire"])),
    Defect("ages below zero", "frames-cmd", FRAMES,
            sends=each(lambda frame: frame["cmd"].update(age=frame["cmd"]["age"] - 0.02))),
    Defect("a monitor that misses frames", "frames-all", FRAMES, sends=_not_each_to_the_monitor),
    Defect("frames for all who connect", "frames-joined", FRAMES, modify=around("_send_frame", _to_all)),
    Defect("an echo that jumps", "echo", FRAMES,
            sends=each(lambda frame: frame["seq"] % 5 or frame["cmd"].update(seq=7))),
]  # fmt: skip

# -- what is newest, fans, lines --------------------------------------------------------------------------------------


def _taken(kind: str, is_taken: Callable[[int, int], bool]) -> Callable[[SurveyLoop], None]:
    """A robot that takes a command whose number is older than the newest, or the same."""

    def take(loop: SurveyLoop, method: Any, of: str, seq: int, values: Any) -> Any:
        if of == kind and is_taken(seq, loop.robot._newest[kind]):
            loop.robot._newest[kind] = -1
        return method(of, seq, values)

    return around("robot._take", take)


def _obey(kind: type[Drive | FansMessage | Permit]) -> Callable[[SurveyLoop], None]:
    """Messages of one kind from whatever role."""
    owner = "monitor" if kind is Permit else "controller"

    def command(_: SurveyLoop, method: Any, session: Any, role: Any, message: Any, now_s: float) -> bool:
        return bool(method(session, owner if isinstance(message, kind) else role, message, now_s))

    return around("command", command)


def _fans_off_when_lost(loop: SurveyLoop, lose: Any, role: Role) -> None:
    lose(role)
    if role == "controller":
        loop.robot.fans.duty = (0.0, 0.0)


def _fans_off_when_denied(
    loop: SurveyLoop, permit: Any, seq: int, forward: bool, reverse: bool, turn: bool, now_s: float | None = None
) -> Any:
    if not (forward or reverse or turn):
        loop.robot.fans.duty = (0.0, 0.0)
    return permit(seq, forward, reverse, turn, now_s)


def _no_buffer(data: bytes, middle: Middle) -> bytes:
    middle._lines = LineBuffer()
    return data


CORRECTED = {
    "no-json": swap(b'"wl":0.0\n', b'"wl":0.0}\n'),
    "key-twice": swap(b'"wr":0.0,"wr":0.0', b'"wr":0.0'),
    "nan": swap(b"NaN", b"0.0"),
    "infinity": swap(b"Infinity", b"0.0"),
    "overflow": swap(b"1e999", b"0.0"),
    "key-missing": swap(b'"wr":0.0}', b'"wr":0.0,"wl":0.0}'),
    "text-for-number": swap(b'"0.0"', b"0.0"),
    "no-utf-8": swap(b"\xff", b"?"),
}


def _counts_none(_: SurveyLoop, command: Any, session: Any, role: Any, message: Any, now_s: float) -> bool:
    command(session, role, message, now_s)
    return True


COMMANDS = [
    Defect("remembers the numbers of the session before", "seq-session", ("seq-session",),
            modify=lambda loop: setattr(loop.robot, "_forget", lambda _: None)),
    Defect("fans exchanged", "fans", ("fans",), sends=each(lambda f: f["fans"].reverse())),
    Defect("does not count what is not for a role", "bad-lines-role", LINES, modify=around("command", _counts_none)),
    *(Defect(f"obeys {what} {order}", f"newest-{what}", NEWEST, modify=_taken(what, is_taken))
      for order, is_taken in (("that are old", int.__lt__), ("twice", int.__eq__))
      for what in ("drive", "permit", "fans")),
    Defect("obeys drives of the monitor", "role-drive", NEWEST, modify=_obey(Drive)),
    Defect("obeys fans of the monitor", "role-fans", NEWEST, modify=_obey(FansMessage)),
    Defect("has no fans", "fans", ("fans",), receives=swap(b'"fans"', b'"sails"')),
    Defect("stops fans at a lost session", "fans-fin fans-rst", FANS,
            modify=around("robot.lose", _fans_off_when_lost)),
    Defect("stops fans at a stop", "fans-stop", FANS, modify=around("robot.permit", _fans_off_when_denied)),
    *(Defect(f"takes {kind}", kind, tuple(BAD_DRIVES), receives=CORRECTED[kind]) for kind in BAD_DRIVES),
    Defect("refuses unknown keys", "unknown-key", LINES, receives=swap(b'"colour":', b'"colour",')),
    Defect("counts unknown types as bad", "unknown-type", LINES, receives=swap(b'"dance","s', b'dance",s')),
    Defect("closes after five bad lines", "bad-lines-few", LINES,
            modify=_each_session(lambda session: setattr(session, "_bad", BadLineCounter(5)))),
    Defect("bears any number of bad lines", "bad-lines-many bad-lines-role", LINES,
            modify=_each_session(lambda session: setattr(session, "_bad", BadLineCounter(10_000)))),
    Defect("knows short lines only", "line-longest", LINES,
            modify=_each_session(lambda session: setattr(session, "_lines", LineBuffer(4096)))),
    Defect("knows endless lines", "line-too-long", LINES,
            modify=_each_session(lambda session: setattr(session, "_lines", LineBuffer(1 << 20)))),
    Defect("takes segments for lines", "single-bytes", LINES, receives=_no_buffer),
    Defect("reads one line of a segment", "many-lines glued-lines",
            ("many-lines", "glued-lines", "unknown-key"), receives=lambda data, _: data.partition(b"\n")[0] + b"\n"),
]  # fmt: skip
FLOORS = [
    Defect("goes below the floor", "fan-floor", FANS, modify=lambda loop: setattr(loop.robot.fans, "_floor", 0.0)),
    Defect("calls a clamped duty a fault", "fan-floor", FANS,
            sends=each(lambda frame: 0.6 in frame["fans"] and frame.update(faults=["fan_left"]))),
]  # fmt: skip

# -- lockstep and motion ----------------------------------------------------------------------------------------------


def _never_waits(missing: Role) -> Callable[[SurveyLoop], None]:
    def command(loop: SurveyLoop, method: Any, *args: Any) -> Any:
        loop._acked.add(missing)
        return method(*args)

    return around("command", command)


def _any_ack(loop: SurveyLoop, command: Any, session: Any, role: Any, message: Any, now_s: float) -> Any:
    if hasattr(message, "ack"):
        message.ack = loop.robot.delivered_seq
    return command(session, role, message, now_s)


def _two_steps(_: SurveyLoop, advance: Any, now_s: float) -> None:
    advance(now_s)
    advance(now_s)


def _wall_ages(frame: Message, middle: Middle) -> None:
    """Ages that go on while time stands still."""
    now_s = asyncio.get_running_loop().time()
    before_s = middle.owner.__dict__.setdefault("frame_s", {}).setdefault(frame["seq"] - 1, now_s)
    middle.owner.__dict__["frame_s"][frame["seq"]] = now_s
    frame["cmd"]["permit_age"] += now_s - before_s


def _allowing(**forced: bool) -> Callable[[SurveyLoop], None]:
    """Directions that are allowed, or denied, whatever a permit says."""

    def permit(self: MotionRules, forward: bool, reverse: bool, turn: bool, now_s: float) -> None:
        allowed = {"forward": forward, "reverse": reverse, "turn": turn, **forced}
        MotionRules.permit(self, **allowed, now_s=now_s)

    return rules(permit=permit)


def _lie(self: MotionRules, until_s: float) -> tuple[float, float]:
    """Say held, and turn."""
    MotionRules.set_points(self, until_s)
    return self._drive or (0.0, 0.0)


def _sides(frame: Message) -> None:
    frame["enc"] = [[t, left, right] for t, right, left in frame["enc"]]


def _only_once(loop: SurveyLoop, send: Any) -> None:
    if loop._repeated_s <= loop._frame_wall_s:
        send()


def _emptied(message: Message, middle: Middle) -> None:
    message["soc"] = 1.0 / middle.count


def _scaled(name: str, place: int, factor: float) -> Callable[[Message, Middle], Message]:
    return each(lambda f: [sample.__setitem__(place, factor * sample[place]) for sample in f[name]])


def _wheels(right: float, left: float) -> Callable[[Message, Middle], Message]:
    return each(lambda f: f.update(enc=[[t, right * a, left * b] for t, a, b in f["enc"]]))


def _motors(change: Callable[[float, float], tuple[float, float]]) -> Callable[[SurveyLoop], None]:
    """Wheels that turn otherwise than the robot's rules say."""

    def set_points(self: MotionRules, until_s: float) -> tuple[float, float]:
        return change(*MotionRules.set_points(self, until_s))

    return rules(set_points=set_points)


def _columns(frame: Message) -> None:
    frame["imu"] = [[t, wz, ax] for t, ax, wz in frame["imu"]]


def _with_gravity(frame: Message) -> None:
    frame["imu"] = [[t, ax - 0.31 * 9.81, wz] for t, ax, wz in frame["imu"]]


ALL_MOVES = " ".join(name for name in MOVES if name != "move-clamp")
STRAIGHT = ("move-forward", "move-turn")
INERTIAL = ("gyroscope", "accelerometer")
QUANTITIES = [
    *(Defect(f"encoders {what}", "move-forward move-turn", STRAIGHT, sends=_wheels(factor, factor))
      for what, factor in (("in rpm", 9.55), ("in degrees", 57.3), ("in turns per second", 0.159),
                           ("of the motor's shaft", 20.0), ("of the other sign", -1.0), ("that stand still", 0.0))),
    Defect("right encoder of the other sign", "move-forward move-turn", STRAIGHT, sends=_wheels(-1.0, 1.0)),
    Defect("left encoder that is dead", "move-forward move-turn", STRAIGHT, sends=_wheels(1.0, 0.0)),
    Defect("drives taken for rpm", "move-forward", STRAIGHT[:1], modify=_motors(lambda a, b: (a / 9.55, b / 9.55))),
    Defect("drives taken for degrees", "move-forward", STRAIGHT[:1],
            modify=_motors(lambda a, b: (a / 57.3, b / 57.3))),
    Defect("motors exchanged", "move-turn", STRAIGHT, modify=_motors(lambda a, b: (b, a))),
    Defect("wheels exchanged, encoders too", "gyroscope", INERTIAL, sends=each(_sides),
            modify=_motors(lambda a, b: (b, a))),
    Defect("wheels reversed, encoders too", "gyroscope accelerometer", INERTIAL, sends=_wheels(-1.0, -1.0),
            modify=_motors(lambda a, b: (-a, -b))),
    Defect("half the wheel base", "gyroscope", INERTIAL, sends=_of_robot(wheel_base_m=0.075)),
    Defect("diameter for the radius", "gyroscope accelerometer", INERTIAL, sends=_of_robot(wheel_radius_m=0.06)),
    *(Defect(f"gyroscope {what}", "gyroscope", INERTIAL, sends=_scaled("imu", 2, factor))
      for what, factor in (("in degrees", 57.3), ("of the other sign", -1.0), ("in turns per second", 0.159),
                           ("that is dead", 0.0))),
    *(Defect(f"accelerometer {what}", "accelerometer", INERTIAL, sends=_scaled("imu", 1, factor))
      for what, factor in (("in g", 1.0 / 9.81), ("of the other sign", -1.0), ("in mm/s2", 1000.0),
                           ("that is dead", 0.0))),
    Defect("accelerometer and gyroscope exchanged", "gyroscope accelerometer", INERTIAL, sends=each(_columns)),
    Defect("gravity in the acceleration", "accelerometer", INERTIAL, sends=each(_with_gravity)),
]  # fmt: skip


def _goes_on(self: MotionRules, seq: int, right: float, left: float, now_s: float, steer: float = 0.0) -> None:
    """A drive of zero is taken, and changes nothing."""
    before = self._drive
    MotionRules.drive(self, seq, right, left, now_s, steer)
    self._drive = before if before is not None and right == left == 0.0 else self._drive


def _each_wheel(self: MotionRules, seq: int, right: float, left: float, now_s: float, steer: float = 0.0) -> None:
    most = self._max_wheel_rad_s
    MotionRules.drive(self, seq, max(-most, min(most, right)), max(-most, min(most, left)), now_s, steer)


def _not_beyond(self: MotionRules, seq: int, right: float, left: float, now_s: float, steer: float = 0.0) -> None:
    is_beyond = max(abs(right), abs(left)) > self._max_wheel_rad_s
    MotionRules.drive(self, seq, *((0.0, 0.0) if is_beyond else (right, left)), now_s, steer)


def _judging(
    judge: Callable[[MotionRules, tuple[bool, bool, bool], float], tuple[bool, bool, bool]],
) -> Callable[[SurveyLoop], None]:
    """Permits that are kept otherwise than they came: (forward, reverse, turn), the robot's time."""

    def permit(self: MotionRules, forward: bool, reverse: bool, turn: bool, now_s: float) -> None:
        MotionRules.permit(self, *judge(self, (forward, reverse, turn), now_s), now_s)

    return rules(permit=permit)


def _remembered(self: MotionRules, new: tuple[bool, bool, bool], _: float) -> tuple[bool, bool, bool]:
    forward, reverse, turn = (a or b for a, b in zip(new, self._permit or new, strict=True))
    return forward, reverse, turn


def _while_it_lasts(self: MotionRules, new: tuple[bool, bool, bool], now_s: float) -> tuple[bool, bool, bool]:
    """Each direction for the time-to-live since it was allowed last."""
    allowed_s = self.__dict__.setdefault("allowed_s", [-9.0] * 3)
    allowed_s[:] = [now_s if is_on else before_s for is_on, before_s in zip(new, allowed_s, strict=True)]
    forward, reverse, turn = (now_s - at_s <= self._ttl_s for at_s in allowed_s)
    return forward, reverse, turn


def _until_it_stands(self: MotionRules, new: tuple[bool, bool, bool], _: float) -> tuple[bool, bool, bool]:
    is_moving = not self.is_held and self._drive is not None and self._drive != (0.0, 0.0)
    return self._permit if is_moving and self._permit is not None else new


def _curves(is_allowed: Callable[[bool, bool], tuple[bool, bool]]) -> Callable[[SurveyLoop], None]:
    """Curves that are judged otherwise: whether straight on and turn are allowed, of those permitted."""

    def may_move(self: MotionRules, drive: tuple[float, float], until_s: float) -> bool:
        right, left = drive
        if right * left <= 0.0 or right == left or self._permit is None:
            return MotionRules._may_move(self, drive, until_s)
        permit = forward, reverse, turn = self._permit
        straight, turn = is_allowed(forward if right > 0.0 else reverse, turn)
        self._permit = Permits(straight, straight, turn)
        found = MotionRules._may_move(self, drive, until_s)
        self._permit = permit
        return found

    return rules(_may_move=may_move)


CURVES = ("move-curve", "move-curve-back", "move-turn")
RULES = [
    Defect("ignores a drive of zero", "wheels-stop", ("wheels-stop", "move-turn"), modify=rules(drive=_goes_on)),
    Defect("knows no top speed", "move-clamp", MOVES[-1:],
            modify=lambda loop: setattr(loop.robot.rules, "_max_wheel_rad_s", math.inf)),
    Defect("clamps each wheel by itself", "move-clamp", MOVES, modify=rules(drive=_each_wheel)),
    Defect("stops at drives beyond the top speed", "move-clamp", MOVES[-1:], modify=rules(drive=_not_beyond)),
    Defect("remembers what was allowed", ALL_MOVES, MOVES, modify=_judging(_remembered)),
    Defect("allows each direction for its own time-to-live", ALL_MOVES, MOVES, modify=_judging(_while_it_lasts)),
    Defect("takes permits at rest only", ALL_MOVES, MOVES[:-1], modify=_judging(_until_it_stands)),
    Defect("forward and reverse exchanged", "move-forward move-reverse move-curve move-curve-back", MOVES[:-1],
            modify=_judging(lambda _, new, __: (new[1], new[0], new[2]))),
    Defect("takes no notice of permits", ALL_MOVES, MOVES[:-1], modify=_judging(lambda *_: (True, True, True))),
    Defect("curves need no turn", "move-curve", CURVES, modify=_curves(lambda straight, _: (straight, True))),
    Defect("curves need turn alone", "move-curve-back", CURVES, modify=_curves(lambda _, turn: (True, turn))),
]  # fmt: skip

STEPS = [
    Defect("does not wait for drives", "lockstep-drive", LOCKSTEP[:2], modify=_never_waits("controller")),
    Defect("does not wait for permits", "lockstep-permit", LOCKSTEP[:2], modify=_never_waits("monitor")),
    Defect("takes any ack", "lockstep-ack", LOCKSTEP, modify=around("command", _any_ack)),
    Defect("takes two steps", "lockstep-step", LOCKSTEP[3:4], modify=around("_advance", _two_steps)),
    Defect(
        "measures ages on the wall clock", "lockstep-ages lockstep-repeat", LOCKSTEP, sends=of("sensors", _wall_ages)
    ),
    Defect("sends no frame again", "lockstep-repeat", LOCKSTEP, modify=around("_send_frame", _only_once)),
    Defect("sends another frame of the same number", "lockstep-repeat", LOCKSTEP[-1:], sends=of("sensors", _emptied)),
    Defect("drives forward without permit", "move-forward", MOVES, modify=_allowing(forward=True)),
    Defect("reverses without permit", "move-reverse move-curve-back", MOVES, modify=_allowing(reverse=True)),
    Defect("turns without permit", "move-turn move-turn-back move-curve", MOVES, modify=_allowing(turn=True)),
    Defect("never reverses", "move-reverse move-curve-back move-clamp", MOVES, modify=_allowing(reverse=False)),
    Defect("says held and turns", ALL_MOVES, MOVES, modify=rules(set_points=_lie)),
    Defect("encoders on the wrong side", " ".join(MOVES[2:]), MOVES, sends=each(_sides)),
]  # fmt: skip

# -- in real time ------------------------------------------------------------------------------------------------


def _ageless(key: str) -> Callable[[SurveyLoop], None]:
    """Rules that take one key for new for ever."""

    def may_move(self: MotionRules, drive: tuple[float, float], until_s: float) -> bool:
        kept = self._drive_s, self._permit_s
        if key == "drive":
            self._drive_s = until_s
        elif self._permit is not None:
            self._permit_s = until_s
        result = MotionRules._may_move(self, drive, until_s)
        self._drive_s, self._permit_s = kept
        return result

    return rules(_may_move=may_move)


def _one_key(self: MotionRules, drive: tuple[float, float], until_s: float) -> bool:
    self.has_monitor_joined = False
    return MotionRules._may_move(self, drive, until_s)


def _free_without_drive(self: MotionRules, until_s: float) -> tuple[float, float]:
    found = MotionRules.set_points(self, until_s)
    self.is_held = self.is_held and self._drive is not None
    return found


def _short_lived(loop: SurveyLoop) -> None:
    loop.robot.rules._ttl_s = 0.1


def _noise_refreshes(data: bytes, middle: Middle) -> bytes:
    if b'"wl":"0"' in data:
        middle.owner.robot.rules._drive_s = middle.owner.robot.t_s
    return data


def _noise_keeps_the_role(data: bytes, middle: Middle) -> bytes:
    middle.received_s = max(middle.received_s, middle.owner.robot.t_s)
    return data


def _soon_taken_over(_: SurveyLoop, command: Any, session: Any, *args: Any) -> Any:
    result = command(session, *args)
    session.received_s -= 3.0
    return result


def _fans_stop_with_wheels(loop: SurveyLoop) -> None:
    set_points = loop.robot.rules.set_points

    def broken(_: MotionRules, until_s: float) -> tuple[float, float]:
        found = set_points(until_s)
        if loop.robot.rules._drive is not None and loop.robot.rules.is_held:
            loop.robot.fans.duty = (0.0, 0.0)
        return found

    rules(set_points=broken)(loop)


def _forgets(forgotten: Role) -> Callable[[SurveyLoop], None]:
    return around("robot.lose", lambda _, lose, role: None if role == forgotten else lose(role))


def _twice(message: Message, _: Middle) -> Message | bytes:
    is_again = message["type"] == "sensors" and message["seq"] % 10 == 0
    return (json.dumps(message).encode() + b"\n") * 2 if is_again else message


def _command(**values: Callable[[Message], object]) -> Callable[[Message, Middle], Message]:
    return each(lambda f: f["cmd"].update({name: of_cmd(f["cmd"]) for name, of_cmd in values.items()}))


def _loses_late(loop: SurveyLoop, lose: Any, role: Role) -> None:
    if role == "controller" and role not in loop._holders:
        ended = loop._last_session  # whoever joins meanwhile begins with nothing in force
        due_s = loop._robot_time_s(asyncio.get_running_loop().time()) + 0.15
        loop.each_frame.append(lambda: loop.robot.t_s < due_s or loop._last_session != ended or lose(role))
    else:
        lose(role)


def _fans_off_when_joined(loop: SurveyLoop, join: Any, role: Role) -> None:
    join(role)
    if role == "controller":
        loop.robot.fans.duty = (0.0, 0.0)


def _old_frames(loop: SurveyLoop) -> None:
    loop.robot.sensors_delay_frames = 30
    loop.robot._frames = deque(loop.robot._frames, maxlen=31)


def _inverted(frame: Message) -> None:
    frame["edge"] = [[t, *(1 - value for value in values)] for t, *values in frame["edge"]]


LOST = {role: f"lost-{role}-fin lost-{role}-rst" for role in ("controller", "monitor")}
REALTIME = [
    Defect("keeps a role for bad lines", "take-over", ("take-over",), receives=_noise_keeps_the_role),
    Defect("gives roles away too soon", "take-over", ("take-over",), modify=around("command", _soon_taken_over)),
    Defect("ignores the age of drives", "ttl-drive ttl-noise", TIMED, modify=_ageless("drive")),
    Defect("ignores the age of permits", "ttl-permit role-permit", TIMED, modify=_ageless("permit")),
    Defect("needs one key only", f"no-permit ttl-permit role-permit {LOST['monitor']}", TIMED,
            modify=rules(_may_move=_one_key)),
    Defect("is not held without a drive", f"no-drive {LOST['controller']}", TIMED,
            modify=rules(set_points=_free_without_drive)),
    Defect("forgets commands too soon", "ttl-drive ttl-permit ttl-noise role-permit", TIMED[:6], modify=_short_lived),
    Defect("lives on bad lines", "ttl-noise", TIMED, receives=_noise_refreshes),
    Defect("continues without its controller", LOST["controller"], TIMED[6:], modify=_forgets("controller")),
    Defect("continues without its monitor", LOST["monitor"], TIMED[6:], modify=_forgets("monitor")),
    Defect("stops fans with the wheels", "fans-ttl", ("fans-ttl", "fans", "fans-stop"), modify=_fans_stop_with_wheels),
    Defect("frames with numbers of their own", "frames-seq", FRAMES[:3],
            sends=each(lambda frame: frame["seq"] % 10 or frame.update(seq=frame["seq"] - 1))),
    Defect("frames that are left out", "frames-seq", FRAMES[:3],
            sends=lambda message, _: None if message.get("seq", 1) % 10 == 0 else message),
    Defect("frames that come twice", "frames-seq", FRAMES[:3], sends=_twice),
    Defect("frame numbers of a session", "seq-session", ("seq-session",),
            sends=of("sensors", lambda frame, middle: frame.update(seq=middle.count))),
    Defect("obeys permits of the controller", "role-permit", TIMED[:6], modify=_obey(Permit)),
    Defect("a time-to-live twice as long", "ttl-drive ttl-permit ttl-noise role-permit", TIMED[:6],
            modify=lambda loop: setattr(loop.robot.rules, "_ttl_s", 0.5)),
    Defect("never says held", "no-permit no-drive", TIMED[:2], sends=_command(held=lambda _: False)),
    Defect("the drive's age for the permit's", "ttl-permit", ("ttl-permit", "ttl-drive"),
            sends=_command(permit_age=lambda cmd: cmd["age"])),
    Defect("drives that do not age", "ttl-drive", ("ttl-permit", "ttl-drive"), sends=_command(age=lambda _: 0.0)),
    Defect("ages 0.1 s too long", "ttl-drive", ("ttl-drive",), sends=_command(age=lambda cmd: cmd["age"] + 0.1)),
    Defect("holds 0.15 s after its controller is lost", LOST["controller"], TIMED[6:],
            modify=around("robot.lose", _loses_late)),
    Defect("fans to their floor at each session", "fans-fin fans-rst", ("fans", "fans-fin", "fans-rst"),
            modify=around("robot.join", _fans_off_when_joined)),
    Defect("a clock at half the rate", "clock", ("clock",), sends=clock(lambda t_s: 0.5 * t_s)),
    Defect("a clock at three times the rate", "clock", ("clock",), sends=clock(lambda t_s: 3.0 * t_s)),
    Defect("frames that are 0.3 s old", "frames-age", ("frames-age", "echo"), modify=_old_frames),
    Defect("wheels keep turning without permits", "wheels-ttl-permit wheels-lost-monitor",
            ("wheels-ttl-permit", "wheels-lost-monitor"),
            modify=lambda loop: (rules(set_points=_lie)(loop), _forgets("monitor")(loop))),
    Defect("says held and turns", "wheels-ttl wheels-lost", ("wheels-ttl", "wheels-lost"),
            modify=lambda loop: (rules(set_points=_lie)(loop), _forgets("controller")(loop))),
]  # fmt: skip


MIRROR = [
    Defect("x and y of gravity exchanged", "mirror", AT_BASE, sends=_gravity(lambda t, x, y, z: [t, y, x, z])),
    Defect("y of gravity of the other sign", "mirror", AT_BASE, sends=_gravity(lambda t, x, y, z: [t, x, -y, z])),
    Defect("edge values inverted", "mirror", AT_BASE, sends=each(_inverted)),
]
# Nothing on the link shows these: where the robot stands is not known, or how fast a sensor should be.
UNSEEN = [
    Defect("x and y of gravity exchanged, at no known place", "", FRAMES, sends=MIRROR[0].sends),
    Defect("edge values inverted, at no known place", "", FRAMES, sends=MIRROR[2].sends),
    Defect("encoder samples left out", "", (*FRAMES, *STRAIGHT), sends=each(lambda f: f["enc"].__delitem__(slice(-1)))),
]
TABLES = {
    "Hello and join": SESSIONS, "Keys": MACS, "Frames": STREAMS, "Commands": [*COMMANDS, *FLOORS],
    "Lockstep, motion": STEPS, "Units and signs": QUANTITIES, "Rules of motion": RULES, "On the wall clock": REALTIME,
    "At the base of a mirror": MIRROR, "Not seen": UNSEEN,
}  # fmt: skip
