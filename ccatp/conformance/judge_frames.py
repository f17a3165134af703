"""Pure. Judges of a stretch of sensors frames, as messages in the order of their arrival."""

import math
from collections.abc import Sequence
from itertools import pairwise
from statistics import median
from typing import Any

from ccatp.conformance.reading import Message, is_number, is_numbers, is_whole
from ccatp.conformance.verdict import NotApplicable, require

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
