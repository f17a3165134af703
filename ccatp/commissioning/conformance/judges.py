"""Judges of a stretch of sensors frames, as messages in the order of their arrival.

How a check ends: by a line that says what was seen, or by one of these exceptions.

Lines of a server, read twice: leniently to go on with the story, strictly to judge the line itself.

Judges of the hello.

Judges of what the robot enforces by itself, on frames and the robot's own clock.

The ages in a frame tell on the robot's clock when a message arrived, so a slow network or a stalled client is never
taken for a fault of the robot.
"""

import json
import math
import re
from collections.abc import Sequence
from itertools import pairwise
from statistics import median
from typing import Any, Literal, NamedTuple, NoReturn

from ccatp.links.robot_messages import AUTH_HMAC, AUTH_NONE, PROTOCOL

Outcome = Literal["pass", "fail", "not applicable"]


class CheckFailed(Exception):
    """A promise of the page was not kept; the text says what was seen instead."""


class NotApplicable(Exception):
    """The server promises nothing here, or nothing that can be seen; the text says why."""


class Result(NamedTuple):
    """One check's end: its identity, what the page promises, how it ended, and what was seen."""

    check_id: str
    promise: str
    outcome: Outcome
    detail: str


def require(is_kept: bool, seen: str) -> None:
    """Go on if a promise is kept.

    Raises:
        Broken: it is not.
    """
    if not is_kept:
        raise CheckFailed(seen)


Message = dict[str, Any]


class CheckedFrame(NamedTuple):
    """What the stories need of a sensors frame.

    Attributes:
        enc: samples (t, right, left) of the wheels, rad/s.
    """

    seq: int
    t_s: float
    drive_seq: int
    age_s: float
    permit_age_s: float
    is_held: bool
    fans: tuple[float, float]
    enc: tuple[tuple[float, float, float], ...]

    @property
    def drive_arrival_s(self) -> float:
        """When the drive in force arrived, robot's clock."""
        return self.t_s - self.age_s

    @property
    def permit_arrival_s(self) -> float:
        """When the newest permit arrived, robot's clock."""
        return self.t_s - self.permit_age_s


def read_message(line: bytes) -> Message | None:
    """The object in a line, ``None`` if there is none. Lenient: the same key twice, NaN and the like pass."""
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def fault_of_line(line: bytes, limit_bytes: int) -> str | None:
    """What is wrong with a line as such: length, JSON, a key twice, a number that is none; ``None`` if nothing."""
    if len(line) > limit_bytes:
        return f"a line of {len(line)} bytes"
    try:
        value = json.loads(line.decode("utf-8"), object_pairs_hook=_once, parse_float=_finite, parse_constant=_constant)
    except (ValueError, RecursionError) as error:
        return f"{error} in {shorten(line)}"
    return None if isinstance(value, dict) else f"no object: {shorten(line)}"


def parse_frame(message: Message) -> CheckedFrame:
    """The frame in a sensors message.

    Raises:
        Broken: a field that every story needs is missing or of another type.
    """
    cmd: Any = message.get("cmd")
    require(isinstance(cmd, dict), f"a sensors frame with cmd = {cmd!r}")
    seq, drive_seq = (_whole(name, value) for name, value in (("seq", message.get("seq")), ("cmd.seq", cmd.get("seq"))))
    held: Any
    fans: Any
    enc: Any
    held, fans, enc = cmd.get("held"), message.get("fans"), message.get("enc")
    require(isinstance(held, bool), f"a sensors frame with cmd.held = {held!r}")
    require(is_numbers(fans, 2), f"a sensors frame with fans = {fans!r}")
    require(isinstance(enc, list), f"a sensors frame with enc = {enc!r}")
    return CheckedFrame(
        seq,
        _number("t", message.get("t")),
        drive_seq,
        _number("cmd.age", cmd.get("age")),
        _number("cmd.permit_age", cmd.get("permit_age")),
        held,
        (fans[0], fans[1]),
        tuple((sample[0], sample[1], sample[2]) for sample in enc if is_numbers(sample, 3)),
    )


def is_number(value: object) -> bool:
    """Whether it is a finite number; booleans are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def is_whole(value: object) -> bool:
    """Whether it is an integer; booleans are none."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_numbers(value: object, count: int) -> bool:
    """Whether it is a list of so many finite numbers."""
    return isinstance(value, list) and len(value) == count and all(map(is_number, value))


def shorten(line: bytes, most: int = 60) -> str:
    """A line for a message."""
    text = line[:most].decode("utf-8", "backslashreplace")
    return text if len(line) <= most else text + "..."


def _number(name: str, value: Any) -> float:
    require(is_number(value), f"a sensors frame with {name} = {value!r}")
    return float(value)


def _whole(name: str, value: Any) -> int:
    require(is_whole(value), f"a sensors frame with {name} = {value!r}")
    return int(value)


def _once(pairs: list[tuple[str, Any]]) -> Message:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a key stands twice")
    return found


def _finite(text: str) -> float:
    if not math.isfinite(float(text)):
        raise ValueError(f"number {text[:20]} is not finite")
    return float(text)


def _constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number of JSON")


FAULTS = ("imu", "encoder_left", "encoder_right", "edge", "fan_left", "fan_right", "battery_low", "stall")
# Values after the time of a sample, and most samples a second.
LISTS = {"imu": (2, 100.0), "enc": (2, 1000.0), "edge": (4, 1000.0)}
PERIOD_TOLERANCE = 0.2
RATE_TOLERANCE = 1.1
NORM_TOLERANCE = 0.02  # of a unit vector in a few decimals
TIME_TOLERANCE_S = 1e-6  # times printed with six decimals


def judge_seq(frames: Sequence[Message]) -> str:
    """Numbers of the frames.

    Raises:
        Broken: no integer, or not above the one before.
    """
    numbers: list[Any] = [frame.get("seq") for frame in frames]
    for number in numbers:
        require(is_whole(number), f"seq = {number!r}")
    for before, after in pairwise(numbers):
        require(after > before, f"seq {after} after {before}")
    return f"{numbers[0]} to {numbers[-1]} in {len(frames)} frames"


def judge_clock(frames: Sequence[Message], frame_hz: float) -> str:
    """Times of the frames: they grow, by the period that the hello names.

    Raises:
        Broken: they do not.
    """
    for frame in frames:
        require(is_number(frame.get("t")) and frame["t"] >= 0.0, f"t = {frame.get('t')!r}")
    steps_s = []
    for before, after in pairwise(frames):
        require(after["t"] > before["t"], f"t {after['t']} after {before['t']}")
        steps_s.append((after["t"] - before["t"]) / max(1, after["seq"] - before["seq"]))
    step_s = median(steps_s)
    seen = f"a frame each {1e3 * step_s:.3g} ms, frame_hz {frame_hz:g}"
    require(abs(step_s * frame_hz - 1.0) <= PERIOD_TOLERANCE, seen)
    return seen


def judge_shape(frames: Sequence[Message]) -> str:
    """Lists of samples, each a time and so many finite numbers.

    Raises:
        Broken: one is not.
    """
    for frame in frames:
        for name, (values, _) in LISTS.items():
            samples = frame.get(name)
            require(isinstance(samples, list), f"{name} = {samples!r}" if name in frame else f"no {name}")
            for sample in samples or ():
                require(is_numbers(sample, values + 1), f"{name} sample {sample!r}")
    return ", ".join(f"{sum(len(frame[name]) for frame in frames)} {name}" for name in LISTS) + " samples"


def judge_times(frames: Sequence[Message]) -> str:
    """Times of the samples: oldest first, each after the frame before and not after its own.

    Raises:
        Broken: one is not.
    """
    for name in LISTS:
        latest_s = -math.inf
        for before, after in pairwise(frames):
            for sample in _samples(after, name):
                t_s = sample[0]
                require(t_s > latest_s, f"{name} sample of {t_s} after one of {latest_s}")
                inside = before["t"] - TIME_TOLERANCE_S < t_s <= after["t"] + TIME_TOLERANCE_S
                require(inside, f"{name} sample of {t_s} in the frame from {before['t']} to {after['t']}")
                latest_s = t_s
    return f"in order and within their frames, {len(frames) - 1} frames"


def judge_rates(frames: Sequence[Message]) -> str:
    """Samples a second.

    Raises:
        Broken: more than the page allows.
    """
    span_s = frames[-1]["t"] - frames[0]["t"]
    seen = []
    for name, (_, most_hz) in LISTS.items():
        rate_hz = sum(len(_samples(frame, name)) for frame in frames[1:]) / span_s
        seen.append(f"{name} {rate_hz:.0f} Hz")
        require(rate_hz <= RATE_TOLERANCE * most_hz, f"{name} at {rate_hz:.0f} Hz, at most {most_hz:g}")
    return ", ".join(seen)


def judge_edges(frames: Sequence[Message]) -> str:
    """Values of the edge sensors.

    Raises:
        Broken: one is neither 0 nor 1.
    """
    samples = [sample for frame in frames for sample in _samples(frame, "edge")]
    if not samples:
        raise NotApplicable("no edge samples in these frames")
    for sample in samples:
        require(all(value in {0, 1} for value in sample[1:]), f"edge sample {sample}")
    return f"{len(samples)} samples of 0 and 1, the last {samples[-1][1:]}"


def judge_cmd(frames: Sequence[Message]) -> str:
    """Types of the echo.

    Raises:
        Broken: a field is missing or of another type.
    """
    cmd: Any = None
    for frame in frames:
        cmd = frame.get("cmd")
        require(isinstance(cmd, dict), f"cmd = {cmd!r}")
        require(is_whole(cmd.get("seq")), f"cmd.seq = {cmd.get('seq')!r}")
        for name in ("age", "permit_age"):
            require(is_number(cmd.get(name)) and cmd[name] >= 0.0, f"cmd.{name} = {cmd.get(name)!r}")
        require(isinstance(cmd.get("held"), bool), f"cmd.held = {cmd.get('held')!r}")
    return f"the last {cmd}"


def judge_gravity(frames: Sequence[Message]) -> str:
    """Gravity: nothing, or a time and a unit vector.

    Raises:
        Broken: something else.
    """
    found = [frame["gravity"] for frame in frames if frame.get("gravity", 0) is not None and "gravity" in frame]
    require(all("gravity" in frame for frame in frames), "a frame without gravity")
    for gravity in found:
        require(is_numbers(gravity, 4), f"gravity = {gravity!r}")
        norm = math.hypot(*gravity[1:])
        require(abs(norm - 1.0) <= NORM_TOLERANCE, f"gravity of length {norm:.4g}: {gravity}")
    return f"{len(found)} unit vectors in {len(frames)} frames"


def judge_state(frames: Sequence[Message]) -> str:
    """Fan duties and state of charge.

    Raises:
        Broken: not within 0 to 1.
    """
    for frame in frames:
        fans, soc = frame.get("fans"), frame.get("soc")
        require(is_numbers(fans, 2) and all(0.0 <= duty <= 1.0 for duty in fans or ()), f"fans = {fans!r}")
        require(is_number(soc) and 0.0 <= (soc or 0.0) <= 1.0, f"soc = {soc!r}")
    return f"fans {frames[-1]['fans']}, charge {frames[-1]['soc']:g}"


def judge_faults(frames: Sequence[Message]) -> str:
    """Names of the faults.

    Raises:
        Broken: no list, or a name the page does not know.
    """
    seen: list[str] = []
    for frame in frames:
        faults = frame.get("faults")
        require(isinstance(faults, list), f"faults = {faults!r}")
        for name in faults or ():
            require(name in FAULTS, f"fault {name!r}")
            seen.append(name)
    return f"faults: {', '.join(sorted(set(seen))) or 'none'}"


def judge_both(of_controller: Sequence[Message], of_monitor: Sequence[Message]) -> str:
    """Frames of two sessions in the stretch that both saw.

    Raises:
        Broken: one got a frame that the other did not.
    """
    one, other = ([frame["seq"] for frame in frames] for frames in (of_controller, of_monitor))
    require(bool(other), "no frames for the monitor")
    first, last = max(one[0], other[0]), min(one[-1], other[-1])
    one, other = ([seq for seq in seqs if first <= seq <= last] for seqs in (one, other))
    lacking = sorted(set(one) ^ set(other))
    require(not lacking, f"frame {lacking[0] if lacking else ''} reached one session only")
    require(bool(one), "controller and monitor saw no frame in common")
    return f"{len(one)} frames, the same for both"


def _samples(frame: Message, name: str) -> list[list[float]]:
    values = LISTS[name][0]
    samples = frame.get(name)
    return [sample for sample in samples if is_numbers(sample, values + 1)] if isinstance(samples, list) else []


_NONCE = re.compile(r"[0-9a-fA-F]{32}")
_POSITIVE = ("wheel_radius_m", "wheel_base_m", "max_wheel_rad_s")


def judge_fields(hello: Message) -> str:
    """Fields of the hello beside ``robot``, with their types.

    Raises:
        Broken: one is not as promised.
    """
    _right(hello, "protocol", hello.get("protocol") == PROTOCOL)
    _right(hello, "boot", is_whole(hello.get("boot")))
    _right(hello, "nonce", isinstance(hello.get("nonce"), str) and bool(_NONCE.fullmatch(hello["nonce"])))
    _right(hello, "auth", hello.get("auth") in {AUTH_NONE, AUTH_HMAC})
    _right(hello, "lockstep", isinstance(hello.get("lockstep"), bool))
    for name in ("frame_hz", "ttl_s"):
        _right(hello, name, is_positive(hello.get(name)))
    return f"{hello['protocol']}, auth {hello['auth']}, {hello['frame_hz']:g} Hz, ttl {hello['ttl_s']:g} s"


def judge_robot(hello: Message) -> str:
    """What the robot says of itself.

    Raises:
        Broken: a field is missing, of another shape, or the edge sensors stand in another order.
    """
    robot: Any = hello.get("robot")
    require(isinstance(robot, dict), f"robot = {robot!r}")
    for name in _POSITIVE:
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


def judge_nonces(hellos: Sequence[Message]) -> str:
    """Nonces of several connections.

    Raises:
        Broken: one comes twice.
    """
    nonces = [hello.get("nonce") for hello in hellos]
    again = next((nonce for k, nonce in enumerate(nonces) if nonce in nonces[:k]), None)
    require(again is None, f"nonce {again} twice in {len(nonces)} connections")
    return f"{len(nonces)} connections, {len(nonces)} nonces"


def judge_boots(hellos: Sequence[Message]) -> str:
    """Boot numbers of several connections to one boot.

    Raises:
        Broken: they differ.
    """
    boots = [hello.get("boot") for hello in hellos]
    require(boots.count(boots[0]) == len(boots), f"boot changes without a power-up: {boots}")
    return f"boot {boots[0]} on {len(boots)} connections"


def is_positive(value: Any) -> bool:
    """Whether it is a finite number over 0."""
    return is_number(value) and value > 0.0


def _right(message: Message, name: str, is_right: bool) -> None:
    require(is_right, f"{name} = {message[name]!r}" if name in message else f"no {name}")


Key = Literal["drive", "permit"]
LOST_S = 0.05
EARLY_FRAMES, LATE_FRAMES = 2, 3  # a robot acts from frame to frame


def judge_ttl(frames: Sequence[CheckedFrame], key: Key, ttl_s: float, frame_s: float) -> str:
    """Frames from the last drive or permit on, the other key being renewed all the while.

    Raises:
        Broken: held too early, too late or never.
    """
    held_s: float | None = None
    has_moved, age_s = False, 0.0
    for frame in frames:
        age_s, other_s = (frame.age_s, frame.permit_age_s) if key == "drive" else (frame.permit_age_s, frame.age_s)
        if frame.is_held:
            early = has_moved and max(age_s, other_s) < ttl_s - EARLY_FRAMES * frame_s
            require(not early, f"held at a {key} age of {age_s:.3f} s, ttl_s {ttl_s:g}")
            held_s = age_s if held_s is None else held_s
        else:
            has_moved, held_s = True, None
            require(
                age_s <= ttl_s + LATE_FRAMES * frame_s, f"not held at a {key} age of {age_s:.3f} s, ttl_s {ttl_s:g}"
            )
    span_s = frames[-1].t_s - frames[0].t_s
    require(held_s is not None, f"not held {span_s:.2f} s after the last {key}, its age said to be {age_s:.3f} s")
    return f"held at a {key} age of {held_s:.3f} s, ttl_s {ttl_s:g}"


def judge_lost(frames: Sequence[CheckedFrame], witness: Key, ttl_s: float, frame_s: float) -> str | None:
    """Frames after one session ended and the other sent a last message right behind.

    Args:
        frames: from the end of the session on, of some 0.2 s.
        witness: the message that the other session sent; its arrival is the moment at which the loss was there, too.

    Returns:
        What was seen; ``None`` if the frames do not reach over the time in question.

    Raises:
        Broken: wheels not held in time.
        NotApplicable: the time-to-live is so short that it would hold them as soon.
    """
    if ttl_s < LOST_S + 4 * frame_s:
        raise NotApplicable(f"ttl_s {ttl_s:g} holds the wheels as soon")
    arrival_s = max(_arrival_s(frame, witness) for frame in frames)
    due_s, expiry_s = arrival_s + LOST_S + frame_s, arrival_s + ttl_s - frame_s
    judged = [frame for frame in frames if due_s < frame.t_s < expiry_s]
    for frame in judged:
        require(frame.is_held, f"not held {1e3 * (frame.t_s - arrival_s):.0f} ms after the end of the session")
    first = next((frame for frame in frames if frame.is_held), None)
    if not judged or first is None:
        return None
    return f"held {max(0.0, 1e3 * (first.t_s - arrival_s)):.0f} ms after the end of the session"


def judge_newest(frames: Sequence[CheckedFrame], newest: int, old: int) -> None:
    """Frames from when a drive and then an older one were sent.

    Raises:
        Broken: the older came into force, or the newer never did.
    """
    require(all(frame.drive_seq != old for frame in frames), f"drive {old} came into force after {newest}")
    require(any(frame.drive_seq == newest for frame in frames), f"drive {newest} never came into force")


def judge_once(frames: Sequence[CheckedFrame], seq: int, frame_s: float) -> None:
    """Frames in which a drive was sent, and sent again under the same number.

    Raises:
        Broken: the second came into force, too: the age starts anew.
    """
    in_force = [frame for frame in frames if frame.drive_seq == seq]
    require(bool(in_force), f"drive {seq} never came into force")
    # A robot that makes up for late frames says 0 of what arrived after their time: that tells no arrival.
    arrivals_s = [frame.drive_arrival_s for frame in in_force if frame.age_s > 0.0]
    spread_s = max(arrivals_s) - min(arrivals_s) if arrivals_s else 0.0
    require(spread_s <= 0.5 * frame_s, f"a second drive {seq} came into force {1e3 * spread_s:.0f} ms after the first")


def judge_untouched(frames: Sequence[CheckedFrame], fans: tuple[float, float], tolerance: float, cause: str) -> None:
    """Fan duties of all frames.

    Raises:
        Broken: they differ from ``fans``.
    """
    for frame in frames:
        require(is_duty(frame.fans, fans, tolerance), f"fans went from {list(fans)} to {list(frame.fans)} {cause}")


def is_duty(seen: tuple[float, float], wanted: tuple[float, float], tolerance: float) -> bool:
    """Whether duties are those."""
    return all(abs(a - b) <= tolerance for a, b in zip(seen, wanted, strict=True))


def mean_rates(frames: Sequence[CheckedFrame]) -> tuple[float, float] | None:
    """Mean (right, left) wheel rates of all encoder samples in the frames, rad/s; ``None`` without samples."""
    samples = [sample for frame in frames for sample in frame.enc]
    if not samples:
        return None
    return sum(wr for _, wr, _ in samples) / len(samples), sum(wl for _, _, wl in samples) / len(samples)


def _arrival_s(frame: CheckedFrame, key: Key) -> float:
    return frame.drive_arrival_s if key == "drive" else frame.permit_arrival_s
