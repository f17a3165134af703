"""Checks of lockstep, and the checks in which wheels turn."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial

from ccatp.commissioning.conformance.harness import (
    STILL,
    CheckContext,
    CheckFailed,
    CheckList,
    ControllerAndMonitor,
    Facts,
    Frame,
    Key,
    Need,
    NotApplicable,
    Pair,
    require,
    steady,
    whole_samples,
)
from ccatp.core import ALL_MOTION, Permits
from ccatp.links.robot_messages import Role

CHECKS = CheckList()
check_steady = partial(CHECKS.add, fixture=steady)
WAIT_S = 0.3  # wall time within which a frame would arrive
REPEATED_S = 1.7  # wall time within which a frame without answers is sent again
BEYOND_TTL_S = 0.2
RATE_RAD_S = 0.5
MOVE_S = 0.8  # longest time in which a drive must show in the encoders
SETTLE_S, MEAN_S = 0.3, 0.2  # time for the servo to settle after that; time of a mean
RAMP_S = 0.6  # from one set point to another
ATTEMPTS = 3  # answers of a busy machine may be too late
DENIED_S = 0.3
STOP_S = 0.7  # a servo comes to rest in this time
WINDOW = 5  # frames of one mean
SHARE = 0.3  # of the set point: above it a wheel turns, below it the wheel stands
RATE_TOLERANCE, RATIO_TOLERANCE = 0.25, 0.1  # of the set point; of the other wheel
BEYOND: Pair = (2.0, -1.5)  # times the top speed
IMU_SHARE = (0.6, 1.6)  # of the motion by the wheels, which may slip
LEAST_IMU_HZ = 45.0
G_M_S2, LEAST_SLOPE_M_S2 = 9.81, 1.0

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
    """Text for the operator: the largest motion in each check."""
    rate_rad_s, time_s = _rate(facts), MOVE_S + SETTLE_S + MEAN_S + facts.ttl_s
    speed_m_s = rate_rad_s * facts.robot.wheel_radius_m
    turn_rad = 2.0 * speed_m_s / facts.robot.wheel_base_m * time_s
    return (
        f"wheels will turn in {checks} checks, each at most {rate_rad_s:g} rad/s ({1e3 * speed_m_s:.0f} mm/s) for "
        f"{time_s:.2f} s: {1e3 * speed_m_s * time_s:.0f} mm, {math.degrees(turn_rad):.0f} degrees; "
        f"move-clamp turns a quarter and back at {facts.robot.max_wheel_rad_s:g} rad/s; --no-motion leaves them out"
    )


def _rate(facts: Facts) -> float:
    return min(RATE_RAD_S, 0.25 * facts.robot.max_wheel_rad_s)


# Name, requirement, (right, left) share of the rate, permits (forward, reverse, turn) that allow and deny it.
DIRECTIONS: tuple[tuple[str, str, Pair, Permits, Permits], ...] = (
    ("move-forward", "v > 0 needs forward", (1, 1), Permits(True, False, False), Permits(False, True, True)),
    ("move-reverse", "v < 0 needs reverse", (-1, -1), Permits(False, True, False), Permits(True, False, True)),
    ("move-turn", "different wheel rates need turn", (1, -1), Permits(False, False, True), Permits(True, True, False)),
    (
        "move-turn-back",
        "different wheel rates need turn",
        (-1, 1),
        Permits(False, False, True),
        Permits(True, True, False),
    ),
    (
        "move-curve",
        "a curve forward needs forward and turn",
        (1, 0.5),
        Permits(True, False, True),
        Permits(True, False, False),
    ),
    (
        "move-curve-back",
        "a curve in reverse needs reverse and turn",
        (-1, -0.5),
        Permits(False, True, True),
        Permits(False, False, True),
    ),
)


@contextmanager
def _at_rest(context: CheckContext) -> Iterator[ControllerAndMonitor]:
    """Both sessions, with the wheels at rest before the check and after it, also if it fails."""
    pair = ControllerAndMonitor(context)
    try:
        pair.steady()
        pair.expect(lambda _: _is_still(pair.frames[-WINDOW:], _rate(pair.facts)), "wheels turn at a drive of zero")
        yield pair
    finally:
        pair.rates = STILL
        with suppress(CheckFailed):
            if pair.controller.is_open and not (pair.controller.is_ended or pair.monitor.is_ended):
                pair.steady()


check_at_rest = partial(CHECKS.add, fixture=_at_rest)


def _direction(shares: Pair, allowed: Permits, denied: Permits, pair: ControllerAndMonitor) -> str:
    """The same drive denied, then allowed, then denied again."""
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
    seen = _seen_rates(_move(pair, rates, allowed))
    for frame in _denied_again(pair, denied):
        require(frame.cmd.held, f"not held {frame.cmd.permit_age:.3f} s after a permit of {_named(denied)} alone")
    pair.allowed = denied
    pair.run(STOP_S)
    require(
        _is_still(pair.frames[-WINDOW:], rate_rad_s), f"wheels keep turning although only {_named(denied)} is allowed"
    )
    return f"held when denied; allowed, the wheels turn at {seen[0]:.2f}, {seen[1]:.2f} rad/s"


def _denied_again(pair: ControllerAndMonitor, denied: Permits) -> list[Frame]:
    """Frames in which a permit that denies the motion is in force and its time-to-live is not over."""
    if pair.facts.lockstep:
        pair.allowed = denied
        pair.settle()
        return pair.run(DENIED_S)
    first = len(pair.frames)
    pair.allowed = None
    pair.permit(allowed=denied)
    pair.find(lambda frame: frame.cmd.permit_age > 0.7 * pair.facts.ttl_s)
    # It is the last permit, so the newest age gives its arrival time.
    since_s = pair.newest.arrival_s("permit") - 0.5 * pair.facts.frame_s
    in_force = [frame for frame in pair.frames[first:] if frame.arrival_s("permit") >= since_s]
    return [frame for frame in in_force[2:] if frame.cmd.permit_age < 0.9 * pair.facts.ttl_s]


for _check_id, _promise, _shares, _allowed, _denied in DIRECTIONS:
    _needs: tuple[Need, ...] = ("motion",) if _shares[0] == _shares[1] else ("motion", "turn")
    check_at_rest(_check_id, _promise, *_needs)(partial(_direction, _shares, _allowed, _denied))


@check_at_rest("wheels-stop", "a drive of zero stops the wheels at once", "motion", "turn")
def _stops_at_zero(pair: ControllerAndMonitor) -> str:
    rate_rad_s = _rate(pair.facts)
    seen = ""
    for rates in ((rate_rad_s, rate_rad_s), (-rate_rad_s, rate_rad_s)):
        _move(pair, rates, ALL_MOTION)
        pair.rates = STILL
        pair.run(STOP_S)
        right, left = _seen_rates(pair.frames[-WINDOW:])
        seen = f"wheels at {right:.3f}, {left:.3f} rad/s {STOP_S:g} s after a drive of zero"
        require(_is_still(pair.frames[-WINDOW:], rate_rad_s), seen)
    return seen


def _stops(key: Key, lost: Role | None, pair: ControllerAndMonitor) -> str:
    """The wheels stop without a newer drive or permit, or when the session that sends it is lost."""
    rate_rad_s = _rate(pair.facts) * (1.0 if lost is None else -1.0)
    _move(pair, (rate_rad_s, rate_rad_s), ALL_MOTION)
    pair.withhold(key)
    if lost is None:
        pair.run(pair.facts.ttl_s)
        return _stopped(pair, f"of the last {key}'s time-to-live")
    (pair.controller if lost == "controller" else pair.monitor).end("FIN")
    return _stopped(pair, f"of the {lost}'s session")


STOPS: tuple[tuple[str, str, Key, Role | None], ...] = (
    ("wheels-ttl", "wheels stop when the drive is older than ttl_s", "drive", None),
    ("wheels-ttl-permit", "wheels stop when the permit is older than ttl_s", "permit", None),
    ("wheels-lost", "wheels stop when the controller's session is lost", "drive", "controller"),
    ("wheels-lost-monitor", "wheels stop when the monitor's session is lost", "permit", "monitor"),
)
for _check_id, _promise, _key, _lost in STOPS:
    check_at_rest(_check_id, _promise, "motion", "real time")(partial(_stops, _key, _lost))


@check_at_rest("move-clamp", "set points beyond max_wheel_rad_s are clamped, their ratio kept", "motion", "turn")
def _clamp(pair: ControllerAndMonitor) -> str:
    most_rad_s = pair.facts.robot.max_wheel_rad_s
    seen = ""
    for sign in (1.0, -1.0):
        rates = sign * BEYOND[0] * most_rad_s, sign * BEYOND[1] * most_rad_s
        right, left = _seen_rates(_turning(pair, rates, ALL_MOTION))
        seen = f"wheels at {right:.3g}, {left:.3g} rad/s for {rates[0]:g}, {rates[1]:g}, at most {most_rad_s:g}"
        require(abs(abs(right) / most_rad_s - 1.0) <= RATE_TOLERANCE and right * sign > 0.0, seen)
        require(abs(left / right - BEYOND[1] / BEYOND[0]) <= RATIO_TOLERANCE, seen)
        pair.rates = STILL
        pair.run(STOP_S)
    return seen


@check_at_rest(
    "gyroscope", "wz is the angular rate about robot z in rad/s, left turns positive", "motion", "body", "turn"
)
def _gyroscope(pair: ControllerAndMonitor) -> str:
    """A turn in place and back; the bias cancels in the difference."""
    rate_rad_s, robot = _rate(pair.facts), pair.facts.robot
    seen = []
    for rates in ((rate_rad_s, -rate_rad_s), (-rate_rad_s, rate_rad_s)):
        frames = _move(pair, rates, ALL_MOTION)
        right, left = _seen_rates(frames)
        seen.append((robot.wheel_radius_m * (right - left) / robot.wheel_base_m, _imu_mean(frames, 2)))
        pair.rates = STILL
        pair.run(STOP_S)
    (wheels, gyroscope), (wheels_back, gyroscope_back) = seen
    by_wheels, by_gyroscope = 0.5 * (wheels - wheels_back), 0.5 * (gyroscope - gyroscope_back)
    text = f"a turn of {by_gyroscope:.3f} rad/s, {by_wheels:.3f} by the wheels"
    require(IMU_SHARE[0] <= by_gyroscope / by_wheels <= IMU_SHARE[1], text)
    return text


@check_at_rest("accelerometer", "ax is the acceleration along robot x in m/s2, gravity removed", "motion", "body")
def _accelerometer(pair: ControllerAndMonitor) -> str:
    """Forward and backward, each from rest to rest, so that the bias cancels in the sum."""
    rate_rad_s = _rate(pair.facts)
    frames = pair.run(RAMP_S)
    rest_m_s2, fall = _imu_mean(frames, 1), [f.gravity[1] for f in frames if whole_samples([f.gravity], 4)]
    slope_m_s2 = G_M_S2 * sum(fall) / len(fall) if fall else 0.0
    is_removed = abs(slope_m_s2) < LEAST_SLOPE_M_S2 or abs(rest_m_s2) < 0.5 * abs(slope_m_s2)
    require(is_removed, f"ax {rest_m_s2:.2f} m/s2 at rest, where gravity has {slope_m_s2:.2f} along x: not removed")
    by_imu, by_wheels = 0.0, 0.0
    for _ in range(ATTEMPTS):
        first, by_imu, by_wheels = len(pair.frames), 0.0, 0.0
        for share, before in ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)):
            pair.rates = share * rate_rad_s, share * rate_rad_s
            frames = pair.run(RAMP_S)
            by_imu += 0.25 * (share - before) * _imu_mean(frames, 1) * RAMP_S
            by_wheels += 0.5 * share * pair.facts.robot.wheel_radius_m * _seen_rates(frames[-2 * WINDOW :])[0]
        if not _is_held(pair.frames[first:]):
            break
    text = f"a change of {1e3 * by_imu:.1f} mm/s, {1e3 * by_wheels:.1f} by the wheels"
    require(by_wheels > 0.0 and IMU_SHARE[0] <= by_imu / by_wheels <= IMU_SHARE[1], text)
    return text


def _imu_mean(frames: Sequence[Frame], column: int) -> float:
    """Mean acceleration (column 1, m/s^2) or rate (column 2, rad/s); ``NotApplicable`` with too few samples."""
    samples = [sample for frame in frames[1:] for sample in whole_samples(frame.imu, 3)]
    if len(samples) < LEAST_IMU_HZ * (frames[-1].t - frames[0].t):
        raise NotApplicable(f"{len(samples)} IMU samples in {len(frames)} frames, at least {LEAST_IMU_HZ:g} Hz needed")
    return sum(sample[column] for sample in samples) / len(samples)


def _move(pair: ControllerAndMonitor, rates: Pair, allowed: Permits) -> list[Frame]:
    """Frames in which the wheels turn at the set points; ``CheckFailed`` if they do not."""
    frames = _turning(pair, rates, allowed)
    right, left = _seen_rates(frames)
    most_rad_s = RATE_TOLERANCE * max(map(abs, rates))
    is_right = abs(right - rates[0]) <= most_rad_s and abs(left - rates[1]) <= most_rad_s
    require(is_right, f"wheels at {right:.3f}, {left:.3f} rad/s, {rates[0]:g}, {rates[1]:g} allowed")
    return frames


def _turning(pair: ControllerAndMonitor, rates: Pair, allowed: Permits) -> list[Frame]:
    """Frames of a drive after the servo has settled, none of them held; ``CheckFailed`` if the robot is held."""
    pair.rates, pair.allowed = rates, allowed
    for _ in range(ATTEMPTS):
        pair.run_frames(WINDOW)
        pair.find(lambda _: _is_turning(pair.frames[-WINDOW:], rates), MOVE_S)
        pair.run(SETTLE_S)
        frames = pair.run(MEAN_S)
        if not _is_held(frames):
            return frames
    raise CheckFailed(f"held although {_named(allowed)} is allowed")


def _stopped(pair: ControllerAndMonitor, end: str) -> str:
    pair.run(STOP_S)
    frames = pair.frames[-WINDOW:]
    right, left = _seen_rates(frames)
    seen = f"wheels at {right:.3f}, {left:.3f} rad/s"
    require(_is_still(frames, _rate(pair.facts)), f"{seen} after the end {end}")
    require(frames[-1].cmd.held, f"not held after the end {end}")
    return f"{seen} {STOP_S:g} s after the end {end}"


def mean_rates(frames: Sequence[Frame]) -> Pair | None:
    """Mean (right, left) wheel rates of all complete encoder samples in the frames, rad/s; ``None`` without samples."""
    samples = [sample for frame in frames for sample in whole_samples(frame.enc, 3)]
    if not samples:
        return None
    return sum(right for _, right, _ in samples) / len(samples), sum(left for *_, left in samples) / len(samples)


def _seen_rates(frames: Sequence[Frame]) -> Pair:
    if (rates := mean_rates(frames)) is None:
        raise NotApplicable("no encoder samples")
    return rates


def _is_turning(frames: Sequence[Frame], rates: Pair) -> bool:
    seen = mean_rates(frames)
    return seen is not None and all(a * b > SHARE * b * b or b == 0.0 for a, b in zip(seen, rates, strict=True))


def _is_still(frames: Sequence[Frame], rate_rad_s: float) -> bool:
    seen = mean_rates(frames)
    return seen is None or max(map(abs, seen)) < SHARE * rate_rad_s


def _is_held(frames: Sequence[Frame]) -> bool:
    return any(frame.cmd.held for frame in frames)


def _named(allowed: Permits) -> str:
    return " and ".join(name for name, is_on in zip(("forward", "reverse", "turn"), allowed, strict=True) if is_on)
