"""Checks of lockstep, and the checks in which wheels turn: slowly, and for a moment."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import NamedTuple

from ccatp.commissioning.conformance.checks import (
    CheckedFrame,
    CheckFailed,
    CheckList,
    NotApplicable,
    mean_rates,
    require,
)
from ccatp.commissioning.conformance.connections import (
    ALL,
    STILL,
    Allowed,
    CheckContext,
    ControllerAndMonitor,
    Facts,
    Rates,
    steady_pair,
)

CHECKS = CheckList()
WAIT_S = 0.3  # wall time in which a frame would have come
BEYOND_TTL_S = 0.2
RATE_RAD_S = 0.5
MOVE_S = 0.8  # longest time in which a drive must show in the encoders
DENIED_S = 0.3
STOP_S = 0.7  # a servo comes to rest in this time
WINDOW = 5  # frames of one mean
SHARE = 0.3  # of the set point: above it turns, below it stands

# -- lockstep ---------------------------------------------------------------------------------------------------------


@CHECKS.add("lockstep-drive", "time waits for a drive with ack = k", "lockstep")
def waits_for_drive(context: CheckContext) -> str:
    """A permit alone, then both."""
    pair = steady_pair(context)
    pair.permit()
    require(not pair.pause(WAIT_S), "a frame without a drive for the one before")
    pair.rates = STILL
    _next_frame(pair, "drive and permit")
    return "no frame on a permit alone, one on permit and drive"


@CHECKS.add("lockstep-permit", "once a monitor has joined, time waits for a permit with ack = k", "lockstep")
def waits_for_permit(context: CheckContext) -> str:
    """A drive alone, then both."""
    pair = steady_pair(context)
    pair.drive()
    require(not pair.pause(WAIT_S), "a frame without a permit for the one before")
    _next_frame(pair, "permit and drive")
    return "no frame on a drive alone, one on drive and permit"


@CHECKS.add("lockstep-ack", "only answers to frame k advance the clock", "lockstep")
def waits_for_this_frame(context: CheckContext) -> str:
    """Answers to frame k-1."""
    pair = steady_pair(context)
    pair.run(2 * context.facts.frame_s)
    before = pair.newest.seq - 1
    pair.drive(ack=before)
    pair.permit(ack=before)
    require(not pair.pause(WAIT_S), f"a frame on answers to {before}, not to {before + 1}")
    _next_frame(pair, "answers to it")
    return "no frame on answers to an older one"


@CHECKS.add("lockstep-step", "the clock advances to k+1", "lockstep")
def one_step(context: CheckContext) -> str:
    """One drive and one permit."""
    pair = ControllerAndMonitor(context)
    before = pair.steady()
    require(not pair.pause(WAIT_S), "a second frame on one drive and one permit")
    pair.drive()
    pair.permit()
    frames = pair.pause(WAIT_S)
    require(len(frames) == 1, f"{len(frames)} frames on one drive and one permit")
    step_s = frames[0].t_s - before.t_s
    require(abs(step_s - context.facts.frame_s) < 0.5 * context.facts.frame_s, f"a step of {step_s:.4f} s")
    return f"one frame on one drive and one permit, {1e3 * step_s:.3g} ms on"


@CHECKS.add("lockstep-ages", "ages are measured on the simulated clock; a client may hold its answer back", "lockstep")
def time_stands_still(context: CheckContext) -> str:
    """An answer held back for longer than ttl_s."""
    pair = ControllerAndMonitor(context)
    before = pair.steady()
    wait_s = context.facts.ttl_s + BEYOND_TTL_S
    require(not pair.pause(wait_s), "frames while the answer is held back")
    pair.rates = STILL
    frame = _next_frame(pair, "an answer that was held back")
    require(
        not frame.is_held, f"held after {wait_s:.2f} s of waiting, ages {frame.age_s:.3f}, {frame.permit_age_s:.3f} s"
    )
    grown_s = max(frame.age_s - before.age_s, frame.permit_age_s - before.permit_age_s)
    require(grown_s < context.facts.frame_s * 1.5, f"ages grew by {grown_s:.3f} s while time stood still")
    return f"{wait_s:.2f} s of waiting, the ages {frame.age_s:.3f} and {frame.permit_age_s:.3f} s"


def _next_frame(pair: ControllerAndMonitor, what: str) -> CheckedFrame:
    newest = pair.newest.seq
    return pair.expect(lambda frame: frame.seq > newest, f"no frame on {what}")


# -- motion -----------------------------------------------------------------------------------------------------------


class Extent(NamedTuple):
    """The most that one check may move the robot: wheel rate, speed, time, way and angle."""

    rate_rad_s: float
    speed_m_s: float
    time_s: float
    way_m: float
    turn_rad: float


def extent(facts: Facts) -> Extent:
    """The most that each check of this file moves the robot."""
    rate_rad_s = _rate(facts)
    time_s = MOVE_S + facts.ttl_s
    speed_m_s = rate_rad_s * facts.wheel_radius_m
    turn_rad = 2.0 * speed_m_s / facts.wheel_base_m * time_s
    return Extent(rate_rad_s, speed_m_s, time_s, speed_m_s * time_s, turn_rad)


def _rate(facts: Facts) -> float:
    return min(RATE_RAD_S, 0.25 * facts.max_wheel_rad_s)


# Name, promise, (right, left) share of the rate, and the permits (forward, reverse, turn) that allow and deny it.
DIRECTIONS: tuple[tuple[str, str, Rates, Allowed, Allowed], ...] = (
    ("move-forward", "v > 0 needs forward", (1, 1), (True, False, False), (False, True, True)),
    ("move-reverse", "v < 0 needs reverse", (-1, -1), (False, True, False), (True, False, True)),
    ("move-turn", "different wheel rates need turn", (1, -1), (False, False, True), (True, True, False)),
    ("move-turn-back", "different wheel rates need turn", (-1, 1), (False, False, True), (True, True, False)),
    ("move-curve", "a curve forward needs forward and turn", (1, 0.5), (True, False, True), (True, False, False)),
    ("move-curve-back", "a curve in reverse needs reverse and turn", (-1, -0.5), (False, True, True),
     (False, False, True)),
)  # fmt: skip


def direction(shares: Rates, allowed: Allowed, denied: Allowed, context: CheckContext) -> str:
    """A drive that is denied, then the same allowed."""
    rate_rad_s = _rate(context.facts)
    rates = rate_rad_s * shares[0], rate_rad_s * shares[1]
    with _at_rest(context) as pair:
        pair.allowed = denied
        pair.settle()
        pair.rates = rates
        pair.settle()
        frames = pair.run(DENIED_S)
        is_held = all(frame.is_held for frame in frames)
        require(is_held, f"{rates[0]:g}, {rates[1]:g} rad/s not held although {_named(denied)} is allowed")
        require(_is_still(frames, rate_rad_s), f"wheels turn although only {_named(denied)} is allowed")
        pair.rates = STILL
        pair.settle()
        seen = _move(pair, rates, allowed)
        return f"held when denied; allowed, the wheels turn at {seen[0]:.2f}, {seen[1]:.2f} rad/s"


for _check_id, _promise, _shares, _allowed, _denied in DIRECTIONS:
    CHECKS.add(_check_id, _promise, "motion")(partial(direction, _shares, _allowed, _denied))


@CHECKS.add("wheels-ttl", "wheels stop when the drive is older than ttl_s", "motion", "real time")
def stops_after_ttl(context: CheckContext) -> str:
    """Forward, then no drive."""
    with _at_rest(context) as pair:
        rate_rad_s = _rate(context.facts)
        _move(pair, (rate_rad_s, rate_rad_s), ALL)
        pair.rates = None
        pair.run(context.facts.ttl_s)
        return _stopped(pair, "of the last drive's time-to-live")


@CHECKS.add("wheels-lost", "wheels stop when the controller's session is lost", "motion", "real time")
def stops_when_lost(context: CheckContext) -> str:
    """Reverse, then FIN."""
    with _at_rest(context) as pair:
        rate_rad_s = _rate(context.facts)
        _move(pair, (-rate_rad_s, -rate_rad_s), ALL)
        pair.rates = None
        pair.controller.end("FIN")
        return _stopped(pair, "of the controller's session")


@contextmanager
def _at_rest(context: CheckContext) -> Iterator[ControllerAndMonitor]:
    """Both sessions, with the wheels at rest before and after, whatever happens."""
    pair = ControllerAndMonitor(context)
    try:
        pair.steady()
        pair.expect(lambda _: _is_still(pair.frames[-WINDOW:], _rate(pair.facts)), "wheels turn at a drive of zero")
        yield pair
    finally:
        pair.rates = STILL
        with suppress(CheckFailed):
            if not pair.controller.is_ended:
                pair.steady()


def _move(pair: ControllerAndMonitor, rates: Rates, allowed: Allowed) -> Rates:
    pair.rates, pair.allowed = rates, allowed
    first = len(pair.frames)
    pair.find(lambda _: len(pair.frames) - first > WINDOW and _is_turning(pair.frames[-WINDOW:], rates), MOVE_S)
    frames = pair.frames[-WINDOW:]
    seen = _mean_rates(frames)
    require(not pair.newest.is_held, f"held although {_named(allowed)} is allowed")
    is_turning = _is_turning(frames, rates)
    require(is_turning, f"wheels at {seen[0]:.3f}, {seen[1]:.3f} rad/s, {rates[0]:g}, {rates[1]:g} allowed")
    return seen


def _stopped(pair: ControllerAndMonitor, end: str) -> str:
    pair.run(STOP_S)
    frames = pair.frames[-WINDOW:]
    right, left = _mean_rates(frames)
    seen = f"wheels at {right:.3f}, {left:.3f} rad/s"
    require(_is_still(frames, _rate(pair.facts)), f"{seen} after the end {end}")
    require(frames[-1].is_held, f"not held after the end {end}")
    return f"{seen} {STOP_S:g} s after the end {end}"


def _mean_rates(frames: list[CheckedFrame]) -> Rates:
    rates = mean_rates(frames)
    if rates is None:
        raise NotApplicable("no encoder samples")
    return rates


def _is_turning(frames: list[CheckedFrame], rates: Rates) -> bool:
    seen = mean_rates(frames)
    return seen is not None and all(a * b > SHARE * b * b or b == 0.0 for a, b in zip(seen, rates, strict=True))


def _is_still(frames: list[CheckedFrame], rate_rad_s: float) -> bool:
    seen = mean_rates(frames)
    return seen is None or max(map(abs, seen)) < SHARE * rate_rad_s


def _named(allowed: Allowed) -> str:
    return " and ".join(name for name, is_on in zip(("forward", "reverse", "turn"), allowed, strict=True) if is_on)
