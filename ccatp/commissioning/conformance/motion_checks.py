"""Checks of lockstep, and the checks in which wheels turn: slowly, and for a moment."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial

from ccatp.commissioning.conformance.harness import (
    ALL,
    STILL,
    Allowed,
    CheckContext,
    CheckFailed,
    CheckList,
    ControllerAndMonitor,
    Facts,
    Frame,
    NotApplicable,
    Pair,
    require,
    steady,
    whole_samples,
)

CHECKS = CheckList()
check_steady = partial(CHECKS.add, fixture=steady)
WAIT_S = 0.3  # wall time in which a frame would have come
REPEATED_S = 1.7  # wall time in which a frame without answers comes again
BEYOND_TTL_S = 0.2
RATE_RAD_S = 0.5
MOVE_S = 0.8  # longest time in which a drive must show in the encoders
DENIED_S = 0.3
STOP_S = 0.7  # a servo comes to rest in this time
WINDOW = 5  # frames of one mean
SHARE = 0.3  # of the set point: above it turns, below it stands

# -- lockstep ---------------------------------------------------------------------------------------------------------


@check_steady("lockstep-drive", "time waits for a drive with ack = k", "lockstep")
def _waits_for_drive(pair: ControllerAndMonitor) -> str:
    pair.permit()
    require(not pair.pause(WAIT_S), "a frame without a drive for the one before")
    pair.next_frame("no frame on drive and permit")
    return "no frame on a permit alone, one on permit and drive"


@check_steady("lockstep-permit", "once a monitor has joined, time waits for a permit with ack = k", "lockstep")
def _waits_for_permit(pair: ControllerAndMonitor) -> str:
    pair.drive()
    require(not pair.pause(WAIT_S), "a frame without a permit for the one before")
    pair.next_frame("no frame on permit and drive")
    return "no frame on a drive alone, one on drive and permit"


@check_steady("lockstep-ack", "only answers to frame k advance the clock", "lockstep")
def _waits_for_this_frame(pair: ControllerAndMonitor) -> str:
    pair.run_frames(2)
    before = pair.newest.seq - 1
    pair.drive(ack=before)
    pair.permit(ack=before)
    require(not pair.pause(WAIT_S), f"a frame on answers to {before}, not to {before + 1}")
    pair.next_frame("no frame on answers to it")
    return "no frame on answers to an older one"


@check_steady("lockstep-step", "the clock advances to k+1", "lockstep")
def _one_step(pair: ControllerAndMonitor) -> str:
    before_s = pair.newest.t
    require(not pair.pause(WAIT_S), "a second frame on one drive and one permit")
    pair.drive()
    pair.permit()
    frames = pair.pause(WAIT_S)
    require(len(frames) == 1, f"{len(frames)} frames on one drive and one permit")
    step_s = frames[0].t - before_s
    require(abs(step_s - pair.facts.frame_s) < 0.5 * pair.facts.frame_s, f"a step of {step_s:.4f} s")
    return f"one frame on one drive and one permit, {1e3 * step_s:.3g} ms on"


@check_steady(
    "lockstep-ages", "ages are measured on the simulated clock; a client may hold its answer back", "lockstep"
)
def _time_stands_still(pair: ControllerAndMonitor) -> str:
    before = pair.newest.cmd
    wait_s = pair.facts.ttl_s + BEYOND_TTL_S
    require(not pair.pause(wait_s), "frames while the answer is held back")
    after = pair.next_frame("no frame on an answer that was held back").cmd
    ages = f"{after.age:.3f} and {after.permit_age:.3f} s"
    require(not after.held, f"held after {wait_s:.2f} s of waiting, ages {ages}")
    grown_s = max(after.age - before.age, after.permit_age - before.permit_age)
    require(grown_s < pair.facts.frame_s * 1.5, f"ages grew by {grown_s:.3f} s while time stood still")
    return f"{wait_s:.2f} s of waiting, the ages {ages}"


@check_steady("lockstep-repeat", "a frame without answers is sent again after 1 s of wall time, unchanged", "lockstep")
def _sends_again(pair: ControllerAndMonitor) -> str:
    pair.pause(WAIT_S)  # both clients have the newest frame
    counts = [len(messages) for messages in pair.messages]
    require(not pair.pause(REPEATED_S), "a frame without answers to the one before")
    for role, messages, count in zip(("controller", "monitor"), pair.messages, counts, strict=True):
        again = messages[count:]
        require(bool(again), f"the {role} does not get the frame again within {WAIT_S + REPEATED_S:g} s")
        require(all(one == messages[count - 1] for one in again), f"the {role} gets another frame of the same number")
    pair.next_frame("no frame on answers to a frame that was sent again")
    return "the same frame to both clients, and the next one on their answers"


# -- motion -----------------------------------------------------------------------------------------------------------


def notice(facts: Facts, checks: int) -> str:
    """The most that each of so many checks moves the robot, for its operator."""
    rate_rad_s, time_s = _rate(facts), MOVE_S + facts.ttl_s
    speed_m_s = rate_rad_s * facts.robot.wheel_radius_m
    turn_rad = 2.0 * speed_m_s / facts.robot.wheel_base_m * time_s
    return (
        f"wheels will turn in {checks} checks, each at most {rate_rad_s:g} rad/s ({1e3 * speed_m_s:.0f} mm/s) for "
        f"{time_s:.2f} s: {1e3 * speed_m_s * time_s:.0f} mm, {math.degrees(turn_rad):.0f} degrees; "
        "--no-motion leaves them out"
    )


def _rate(facts: Facts) -> float:
    return min(RATE_RAD_S, 0.25 * facts.robot.max_wheel_rad_s)


# Name, promise, (right, left) share of the rate, and the permits (forward, reverse, turn) that allow and deny it.
DIRECTIONS: tuple[tuple[str, str, Pair, Allowed, Allowed], ...] = (
    ("move-forward", "v > 0 needs forward", (1, 1), (True, False, False), (False, True, True)),
    ("move-reverse", "v < 0 needs reverse", (-1, -1), (False, True, False), (True, False, True)),
    ("move-turn", "different wheel rates need turn", (1, -1), (False, False, True), (True, True, False)),
    ("move-turn-back", "different wheel rates need turn", (-1, 1), (False, False, True), (True, True, False)),
    ("move-curve", "a curve forward needs forward and turn", (1, 0.5), (True, False, True), (True, False, False)),
    ("move-curve-back", "a curve in reverse needs reverse and turn", (-1, -0.5), (False, True, True),
     (False, False, True)),
)  # fmt: skip


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


check_at_rest = partial(CHECKS.add, fixture=_at_rest)


def _direction(shares: Pair, allowed: Allowed, denied: Allowed, pair: ControllerAndMonitor) -> str:
    """A drive that is denied, then the same allowed."""
    rate_rad_s = _rate(pair.facts)
    rates = rate_rad_s * shares[0], rate_rad_s * shares[1]
    pair.allowed = denied
    pair.settle()
    pair.rates = rates
    pair.settle()
    frames = pair.run(DENIED_S)
    is_held = all(frame.cmd.held for frame in frames)
    require(is_held, f"{rates[0]:g}, {rates[1]:g} rad/s not held although {_named(denied)} is allowed")
    require(_is_still(frames, rate_rad_s), f"wheels turn although only {_named(denied)} is allowed")
    pair.rates = STILL
    pair.settle()
    seen = _move(pair, rates, allowed)
    return f"held when denied; allowed, the wheels turn at {seen[0]:.2f}, {seen[1]:.2f} rad/s"


for _check_id, _promise, _shares, _allowed, _denied in DIRECTIONS:
    check_at_rest(_check_id, _promise, "motion")(partial(_direction, _shares, _allowed, _denied))


@check_at_rest("wheels-ttl", "wheels stop when the drive is older than ttl_s", "motion", "real time")
def _stops_after_ttl(pair: ControllerAndMonitor) -> str:
    rate_rad_s = _rate(pair.facts)
    _move(pair, (rate_rad_s, rate_rad_s), ALL)
    pair.rates = None
    pair.run(pair.facts.ttl_s)
    return _stopped(pair, "of the last drive's time-to-live")


@check_at_rest("wheels-lost", "wheels stop when the controller's session is lost", "motion", "real time")
def _stops_when_lost(pair: ControllerAndMonitor) -> str:
    rate_rad_s = _rate(pair.facts)
    _move(pair, (-rate_rad_s, -rate_rad_s), ALL)
    pair.rates = None
    pair.controller.end("FIN")
    return _stopped(pair, "of the controller's session")


def _move(pair: ControllerAndMonitor, rates: Pair, allowed: Allowed) -> Pair:
    pair.rates, pair.allowed = rates, allowed
    first = len(pair.frames)
    pair.find(lambda _: len(pair.frames) - first > WINDOW and _is_turning(pair.frames[-WINDOW:], rates), MOVE_S)
    frames = pair.frames[-WINDOW:]
    right, left = _seen_rates(frames)
    require(not pair.newest.cmd.held, f"held although {_named(allowed)} is allowed")
    wanted = f"{rates[0]:g}, {rates[1]:g} allowed"
    require(_is_turning(frames, rates), f"wheels at {right:.3f}, {left:.3f} rad/s, {wanted}")
    return right, left


def _stopped(pair: ControllerAndMonitor, end: str) -> str:
    pair.run(STOP_S)
    frames = pair.frames[-WINDOW:]
    right, left = _seen_rates(frames)
    seen = f"wheels at {right:.3f}, {left:.3f} rad/s"
    require(_is_still(frames, _rate(pair.facts)), f"{seen} after the end {end}")
    require(frames[-1].cmd.held, f"not held after the end {end}")
    return f"{seen} {STOP_S:g} s after the end {end}"


def mean_rates(frames: Sequence[Frame]) -> Pair | None:
    """Mean (right, left) wheel rates of all whole encoder samples in the frames, rad/s; ``None`` without samples."""
    samples = [sample for frame in frames for sample in whole_samples(frame.enc, 3)]
    if not samples:
        return None
    return sum(right for _, right, _ in samples) / len(samples), sum(left for *_, left in samples) / len(samples)


def _seen_rates(frames: Sequence[Frame]) -> Pair:
    rates = mean_rates(frames)
    if rates is None:
        raise NotApplicable("no encoder samples")
    return rates


def _is_turning(frames: Sequence[Frame], rates: Pair) -> bool:
    seen = mean_rates(frames)
    return seen is not None and all(a * b > SHARE * b * b or b == 0.0 for a, b in zip(seen, rates, strict=True))


def _is_still(frames: Sequence[Frame], rate_rad_s: float) -> bool:
    seen = mean_rates(frames)
    return seen is None or max(map(abs, seen)) < SHARE * rate_rad_s


def _named(allowed: Allowed) -> str:
    return " and ".join(name for name, is_on in zip(("forward", "reverse", "turn"), allowed, strict=True) if is_on)
