"""Stories in which wheels turn: slowly, and for a moment.

One stretch of sensors frames for all judges of them.

Stories of a server whose clock waits for its clients.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from typing import NamedTuple

from ccatp.commissioning.conformance.connections import (
    ALL,
    STILL,
    Allowed,
    CheckContext,
    ControllerAndMonitor,
    Facts,
    Rates,
)
from ccatp.commissioning.conformance.judges import (
    CheckedFrame,
    CheckFailed,
    Message,
    NotApplicable,
    fault_of_line,
    mean_rates,
    require,
)
from ccatp.links.robot_messages import MAX_LINE_BYTES

RATE_RAD_S = 0.5
MOVE_S = 0.8  # longest time in which a drive must show in the encoders
DENIED_S = 0.3
STOP_S = 0.7  # a servo comes to rest in this time
WINDOW = 5  # frames of one mean
SHARE = 0.3  # of the set point: above it turns, below it stands


class Extent(NamedTuple):
    """The most that one check may move the robot: wheel rate, speed, time, way and angle."""

    rate_rad_s: float
    speed_m_s: float
    time_s: float
    way_m: float
    turn_rad: float


def extent(facts: Facts) -> Extent:
    """What the stories of this file do at most, at one go."""
    rate_rad_s = _rate(facts)
    time_s = MOVE_S + facts.ttl_s
    speed_m_s = rate_rad_s * facts.wheel_radius_m
    turn_rad = 2.0 * speed_m_s / facts.wheel_base_m * time_s
    return Extent(rate_rad_s, speed_m_s, time_s, speed_m_s * time_s, turn_rad)


def direction(right: float, left: float, allowed: Allowed, denied: Allowed) -> Callable[[CheckContext], str]:
    """A drive that is denied, then the same allowed."""

    def story(stage: CheckContext) -> str:
        rate_rad_s = _rate(stage.facts)
        rates = rate_rad_s * right, rate_rad_s * left
        with _at_rest(ControllerAndMonitor(stage)) as pair:
            _stays(pair, rates, denied)
            pair.rates = STILL
            pair.settle()
            seen = _moves(pair, rates, allowed)
            return f"held when denied; allowed, the wheels turn at {seen[0]:.2f}, {seen[1]:.2f} rad/s"

    return story


def stops_after_ttl(stage: CheckContext) -> str:
    """Wheels turn, then drives end."""
    with _at_rest(ControllerAndMonitor(stage)) as pair:
        _moves(pair, _forward(stage), ALL)
        pair.rates = None
        pair.run(stage.facts.ttl_s)
        return _stopped(pair, "of the last drive's time-to-live")


def stops_when_lost(stage: CheckContext) -> str:
    """Wheels turn, then the controller is gone."""
    with _at_rest(ControllerAndMonitor(stage)) as pair:
        right, left = _forward(stage)
        _moves(pair, (-right, -left), ALL)
        pair.rates = None
        pair.controller.finish()
        return _stopped(pair, "of the controller's session")


@contextmanager
def _at_rest(pair: ControllerAndMonitor) -> Iterator[ControllerAndMonitor]:
    """Wheels at rest before and after, whatever happens."""
    try:
        pair.steady()
        pair.expect(
            lambda _: _is_still(pair.frames[-WINDOW:], _rate(pair.stage.facts)), "wheels turn at a drive of zero"
        )
        yield pair
    finally:
        pair.rates = STILL
        with suppress(CheckFailed):
            if not pair.controller.is_ended:
                pair.steady()


def _moves(pair: ControllerAndMonitor, rates: Rates, allowed: Allowed) -> Rates:
    pair.rates, pair.allowed = rates, allowed
    first = len(pair.frames)
    pair.find(lambda _: len(pair.frames) - first > WINDOW and _is_turning(pair.frames[-WINDOW:], rates), MOVE_S)
    frames = pair.frames[-WINDOW:]
    seen = mean_rates(frames)
    if seen is None:
        raise NotApplicable("no encoder samples")
    require(not pair.newest.is_held, f"held although {_named(allowed)} is allowed")
    require(_is_turning(frames, rates), f"wheels at {seen[0]:.3f}, {seen[1]:.3f} rad/s, {_shown(rates)} allowed")
    return seen


def _stays(pair: ControllerAndMonitor, rates: Rates, allowed: Allowed) -> None:
    pair.allowed = allowed
    pair.settle()
    pair.rates = rates
    pair.settle()
    frames = pair.run(DENIED_S)
    require(
        all(frame.is_held for frame in frames), f"{_shown(rates)} rad/s not held although {_named(allowed)} is allowed"
    )
    require(_is_still(frames, _rate(pair.stage.facts)), f"wheels turn although only {_named(allowed)} is allowed")


def _stopped(pair: ControllerAndMonitor, end: str) -> str:
    pair.run(STOP_S)
    frames = pair.frames[-WINDOW:]
    seen = mean_rates(frames)
    if seen is None:
        raise NotApplicable("no encoder samples")
    require(
        _is_still(frames, _rate(pair.stage.facts)), f"wheels at {seen[0]:.3f}, {seen[1]:.3f} rad/s after the end {end}"
    )
    require(frames[-1].is_held, f"not held after the end {end}")
    return f"wheels at {seen[0]:.3f}, {seen[1]:.3f} rad/s {STOP_S:g} s after the end {end}"


def _is_turning(frames: list[CheckedFrame], rates: Rates) -> bool:
    seen = mean_rates(frames)
    return seen is not None and all(a * b > SHARE * b * b or b == 0.0 for a, b in zip(seen, rates, strict=True))


def _is_still(frames: list[CheckedFrame], rate_rad_s: float) -> bool:
    seen = mean_rates(frames)
    return seen is None or max(map(abs, seen)) < SHARE * rate_rad_s


def _rate(facts: Facts) -> float:
    return min(RATE_RAD_S, 0.25 * facts.max_wheel_rad_s)


def _forward(stage: CheckContext) -> Rates:
    return _rate(stage.facts), _rate(stage.facts)


def _named(allowed: Allowed) -> str:
    return " and ".join(name for name, is_on in zip(("forward", "reverse", "turn"), allowed, strict=True) if is_on)


def _shown(rates: Rates) -> str:
    return f"{rates[0]:g}, {rates[1]:g}"


FRAMES = 40
JoinedFrames = Sequence[Message]


def judged(judge: Callable[[JoinedFrames], str]) -> Callable[[CheckContext], str]:
    """A story: record a stretch, and judge what the controller got."""

    def story(stage: CheckContext) -> str:
        return judge(_record(stage).messages[0])

    return story


def clocked(judge: Callable[[JoinedFrames, float], str]) -> Callable[[CheckContext], str]:
    """The same for a judge that asks for the rate of the frames."""

    def story(stage: CheckContext) -> str:
        return judge(_record(stage).messages[0], stage.facts.frame_hz)

    return story


def compared(judge: Callable[[JoinedFrames, JoinedFrames], str]) -> Callable[[CheckContext], str]:
    """The same for a judge of both sessions' frames."""

    def story(stage: CheckContext) -> str:
        return judge(*_record(stage).messages)

    return story


def lines(stage: CheckContext) -> str:
    """The lines as such."""
    pair = _record(stage)
    for line in pair.raw:
        fault = fault_of_line(line, MAX_LINE_BYTES)
        require(fault is None, str(fault))
    return f"{len(pair.raw)} lines, the longest of {max(map(len, pair.raw))} bytes"


def before_join(stage: CheckContext) -> str:
    """A client that does not join, beside two that have."""
    onlooker, _ = stage.greet()
    pair = ControllerAndMonitor(stage)
    pair.steady()
    pair.run(10 * stage.facts.frame_s)
    require(not any(b'"sensors"' in line for line in onlooker.lines), "sensors frames before the join")
    return f"none in {len(pair.frames)} frames"


def echo(stage: CheckContext) -> str:
    """Drives one by one: each is echoed by its number."""
    pair = ControllerAndMonitor(stage)
    pair.steady()
    frames = [*pair.run(20 * stage.facts.frame_s), *pair.settle()]
    for before, after in pairwise(frames):
        require(after.drive_seq >= before.drive_seq, f"cmd.seq {after.drive_seq} after {before.drive_seq}")
    ages_s = [frame.age_s for frame in frames[-10:]]
    require(max(ages_s) < stage.facts.ttl_s, f"cmd.age {max(ages_s):.3f} s with a new drive for each frame")
    return f"drive {pair.newest.drive_seq} in force, age {ages_s[-1]:.3f} s"


def _record(stage: CheckContext) -> ControllerAndMonitor:
    pair = ControllerAndMonitor(stage)
    pair.run(FRAMES * stage.facts.frame_s)
    require(len(pair.messages[0]) > 2, "fewer than three frames for the controller")
    return pair


LOOK_S = 0.3  # wall time in which a frame would have come
BEYOND_TTL_S = 0.2


def waits_for_drive(stage: CheckContext) -> str:
    """A permit alone."""
    pair = ControllerAndMonitor(stage)
    pair.steady()
    pair.permit()
    require(not pair.pause(LOOK_S), "a frame without a drive for the one before")
    pair.rates = STILL
    _comes(pair, "drive and permit")
    return "no frame on a permit alone, one on permit and drive"


def waits_for_permit(stage: CheckContext) -> str:
    """A drive alone."""
    pair = ControllerAndMonitor(stage)
    pair.steady()
    pair.drive()
    require(not pair.pause(LOOK_S), "a frame without a permit for the one before")
    _comes(pair, "permit and drive")
    return "no frame on a drive alone, one on drive and permit"


def waits_for_this_frame(stage: CheckContext) -> str:
    """Answers to the frame before."""
    pair = ControllerAndMonitor(stage)
    pair.steady()
    pair.run(2 * stage.facts.frame_s)
    before = pair.newest.seq - 1
    pair.drive(ack=before)
    pair.permit(ack=before)
    require(not pair.pause(LOOK_S), f"a frame on answers to {before}, not to {before + 1}")
    _comes(pair, "answers to it")
    return "no frame on answers to an older one"


def one_step(stage: CheckContext) -> str:
    """One frame for each pair of answers, one period on."""
    pair = ControllerAndMonitor(stage)
    before = pair.steady()
    require(not pair.pause(LOOK_S), "a second frame on one drive and one permit")
    pair.drive()
    pair.permit()
    frames = pair.pause(LOOK_S)
    require(len(frames) == 1, f"{len(frames)} frames on one drive and one permit")
    step_s = frames[0].t_s - before.t_s
    require(abs(step_s - stage.facts.frame_s) < 0.5 * stage.facts.frame_s, f"a step of {step_s:.4f} s")
    return f"one frame on one drive and one permit, {1e3 * step_s:.3g} ms on"


def time_stands_still(stage: CheckContext) -> str:
    """An answer held back for longer than it would live."""
    pair = ControllerAndMonitor(stage)
    before = pair.steady()
    wait_s = stage.facts.ttl_s + BEYOND_TTL_S
    require(not pair.pause(wait_s), "frames while the answer is held back")
    pair.rates = STILL
    frame = _comes(pair, "an answer that was held back")
    require(
        not frame.is_held, f"held after {wait_s:.2f} s of waiting, ages {frame.age_s:.3f}, {frame.permit_age_s:.3f} s"
    )
    grown_s = max(frame.age_s - before.age_s, frame.permit_age_s - before.permit_age_s)
    require(grown_s < stage.facts.frame_s * 1.5, f"ages grew by {grown_s:.3f} s while time stood still")
    return f"{wait_s:.2f} s of waiting, the ages {frame.age_s:.3f} and {frame.permit_age_s:.3f} s"


def _comes(pair: ControllerAndMonitor, what: str) -> CheckedFrame:
    newest = pair.newest.seq
    return pair.expect(lambda frame: frame.seq > newest, f"no frame on {what}")
