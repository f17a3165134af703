"""Checks of a stretch of sensors frames."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from statistics import median
from typing import Any

from ccatp.commissioning.conformance.checks import (
    CheckList,
    Message,
    NotApplicable,
    is_number,
    is_numbers,
    is_whole,
    line_fault,
    require,
)
from ccatp.commissioning.conformance.connections import CheckContext, ControllerAndMonitor, steady_pair
from ccatp.links.robot_messages import MAX_LINE_BYTES

CHECKS = CheckList()
FRAMES = 40  # each answered by a drive and a permit
FAULTS = ("imu", "encoder_left", "encoder_right", "edge", "fan_left", "fan_right", "battery_low", "stall")
# Values after the time of a sample, and most samples a second.
LISTS = {"imu": (2, 100.0), "enc": (2, 1000.0), "edge": (4, 1000.0)}
PERIOD_TOLERANCE = 0.2
RATE_TOLERANCE = 1.1
NORM_TOLERANCE = 0.02  # of a unit vector in a few decimals
TIME_TOLERANCE_S = 1e-6  # times printed with six decimals

Frames = Sequence[Message]
OfFrames = Callable[[Frames], str]


def _record(context: CheckContext) -> ControllerAndMonitor:
    pair = ControllerAndMonitor(context)
    pair.run(FRAMES * context.facts.frame_s)
    require(len(pair.messages[0]) > 2, "fewer than three frames for the controller")
    return pair


def _recorded(check_id: str, promise: str) -> Callable[[OfFrames], OfFrames]:
    """Decorator: a check of the frames that the controller received."""

    def append(check: OfFrames) -> OfFrames:
        CHECKS.add(check_id, promise)(lambda context: check(_record(context).messages[0]))
        return check

    return append


@CHECKS.add("frames-lines", "one JSON object a line, finite numbers, no key twice, at most 8192 bytes")
def lines(context: CheckContext) -> str:
    """The lines as such."""
    raw = _record(context).raw
    for line in raw:
        fault = line_fault(line, MAX_LINE_BYTES)
        require(fault is None, str(fault))
    return f"{len(raw)} lines, the longest of {max(map(len, raw))} bytes"


@_recorded("frames-seq", "seq of the frames increases")
def check_seq(frames: Frames) -> str:
    """Numbers of the frames."""
    numbers: list[Any] = [frame.get("seq") for frame in frames]
    for number in numbers:
        require(is_whole(number), f"seq = {number!r}")
    for before, after in pairwise(numbers):
        require(after > before, f"seq {after} after {before}")
    return f"{numbers[0]} to {numbers[-1]} in {len(frames)} frames"


@CHECKS.add("frames-clock", "t is a monotonic clock in seconds; frames come at frame_hz")
def clock(context: CheckContext) -> str:
    """Times of the frames."""
    return check_clock(_record(context).messages[0], context.facts.frame_hz)


def check_clock(frames: Frames, frame_hz: float) -> str:
    """Times of the frames increase, by the period of the hello."""
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


@_recorded("frames-samples", "imu, enc and edge are lists of samples, each with its time")
def check_samples(frames: Frames) -> str:
    """Lists of samples, each a time and so many finite numbers."""
    for frame in frames:
        for name, (values, _) in LISTS.items():
            samples = frame.get(name)
            require(isinstance(samples, list), f"{name} = {samples!r}" if name in frame else f"no {name}")
            for sample in samples or ():
                require(is_numbers(sample, values + 1), f"{name} sample {sample!r}")
    return ", ".join(f"{sum(len(frame[name]) for frame in frames)} {name}" for name in LISTS) + " samples"


@_recorded("frames-times", "a list holds the samples since the last frame, oldest first")
def check_times(frames: Frames) -> str:
    """Times of the samples: oldest first, each after the frame before and not after its own."""
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


@_recorded("frames-rates", "IMU up to 100 Hz, encoders and edge sensors up to 1000 Hz")
def check_rates(frames: Frames) -> str:
    """Samples a second."""
    span_s = frames[-1]["t"] - frames[0]["t"]
    seen = []
    for name, (_, most_hz) in LISTS.items():
        rate_hz = sum(len(_samples(frame, name)) for frame in frames[1:]) / span_s
        seen.append(f"{name} {rate_hz:.0f} Hz")
        require(rate_hz <= RATE_TOLERANCE * most_hz, f"{name} at {rate_hz:.0f} Hz, at most {most_hz:g}")
    return ", ".join(seen)


@_recorded("frames-edge", "edge values are 0 or 1")
def check_edges(frames: Frames) -> str:
    """Values of the edge sensors."""
    samples = [sample for frame in frames for sample in _samples(frame, "edge")]
    if not samples:
        raise NotApplicable("no edge samples in these frames")
    for sample in samples:
        require(all(value in {0, 1} for value in sample[1:]), f"edge sample {sample}")
    return f"{len(samples)} samples of 0 and 1, the last {samples[-1][1:]}"


@_recorded("frames-gravity", "gravity is null, or a time and a unit vector")
def check_gravity(frames: Frames) -> str:
    """Gravity: null, or a time and a unit vector."""
    found = [frame["gravity"] for frame in frames if frame.get("gravity") is not None]
    require(all("gravity" in frame for frame in frames), "a frame without gravity")
    for gravity in found:
        require(is_numbers(gravity, 4), f"gravity = {gravity!r}")
        norm = math.hypot(*gravity[1:])
        require(abs(norm - 1.0) <= NORM_TOLERANCE, f"gravity of length {norm:.4g}: {gravity}")
    return f"{len(found)} unit vectors in {len(frames)} frames"


@_recorded("frames-state", "fans and soc are within 0 and 1")
def check_state(frames: Frames) -> str:
    """Fan duties and state of charge."""
    for frame in frames:
        fans, soc = frame.get("fans"), frame.get("soc")
        require(is_numbers(fans, 2) and all(0.0 <= duty <= 1.0 for duty in fans or ()), f"fans = {fans!r}")
        require(is_number(soc) and 0.0 <= (soc or 0.0) <= 1.0, f"soc = {soc!r}")
    return f"fans {frames[-1]['fans']}, charge {frames[-1]['soc']:g}"


@_recorded("frames-faults", "faults holds names out of the page's list")
def check_faults(frames: Frames) -> str:
    """Names of the faults."""
    seen: set[str] = set()
    for frame in frames:
        faults = frame.get("faults")
        require(isinstance(faults, list), f"faults = {faults!r}")
        for name in faults or ():
            require(name in FAULTS, f"fault {name!r}")
            seen.add(name)
    return f"faults: {', '.join(sorted(seen)) or 'none'}"


@_recorded("frames-cmd", "cmd holds seq, age, permit_age and held")
def check_cmd(frames: Frames) -> str:
    """Types of the echo."""
    cmd: Any = None
    for frame in frames:
        cmd = frame.get("cmd")
        require(isinstance(cmd, dict), f"cmd = {cmd!r}")
        require(is_whole(cmd.get("seq")), f"cmd.seq = {cmd.get('seq')!r}")
        for name in ("age", "permit_age"):
            require(is_number(cmd.get(name)) and cmd[name] >= 0.0, f"cmd.{name} = {cmd.get(name)!r}")
        require(isinstance(cmd.get("held"), bool), f"cmd.held = {cmd.get('held')!r}")
    return f"the last {cmd}"


@CHECKS.add("frames-all", "every frame goes to every joined session")
def to_both(context: CheckContext) -> str:
    """Frames of both sessions."""
    return check_both(*_record(context).messages)


def check_both(of_controller: Frames, of_monitor: Frames) -> str:
    """Frames of two sessions in the stretch that both received."""
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


@CHECKS.add("frames-joined", "frames go to joined sessions only")
def before_join(context: CheckContext) -> str:
    """A client that does not join, beside two that have."""
    onlooker, _ = context.greet()
    pair = steady_pair(context)
    pair.run(10 * context.facts.frame_s)
    require(not any(b'"sensors"' in line for line in onlooker.lines), "sensors frames before the join")
    return f"none in {len(pair.frames)} frames"


@CHECKS.add("echo", "cmd echoes the newest drive in force and its age")
def echo(context: CheckContext) -> str:
    """20 frames, a new drive for each."""
    pair = steady_pair(context)
    frames = [*pair.run(20 * context.facts.frame_s), *pair.settle()]
    for before, after in pairwise(frames):
        require(after.drive_seq >= before.drive_seq, f"cmd.seq {after.drive_seq} after {before.drive_seq}")
    ages_s = [frame.age_s for frame in frames[-10:]]
    require(max(ages_s) < context.facts.ttl_s, f"cmd.age {max(ages_s):.3f} s with a new drive for each frame")
    return f"drive {pair.newest.drive_seq} in force, age {ages_s[-1]:.3f} s"
