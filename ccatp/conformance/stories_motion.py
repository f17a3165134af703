"""Edge. Stories in which wheels turn: slowly, and for a moment."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple

from ccatp.conformance.judge_rules import mean_rates
from ccatp.conformance.pair import ALL, STILL, Allowed, Pair, Rates
from ccatp.conformance.reading import Frame
from ccatp.conformance.stage import Facts, Stage
from ccatp.conformance.verdict import Broken, NotApplicable, require

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


def direction(right: float, left: float, allowed: Allowed, denied: Allowed) -> Callable[[Stage], str]:
    """A drive that is denied, then the same allowed.

    Args:
        right: sign of the right wheel, or its share of the rate.
        left: of the left.
        allowed: the permit that is just enough.
        denied: the one that lacks just this.
    """

    def story(stage: Stage) -> str:
        rate_rad_s = _rate(stage.facts)
        rates = rate_rad_s * right, rate_rad_s * left
        with _at_rest(Pair(stage)) as pair:
            _stays(pair, rates, denied)
            pair.rates = STILL
            pair.settle()
            seen = _moves(pair, rates, allowed)
            return f"held when denied; allowed, the wheels turn at {seen[0]:.2f}, {seen[1]:.2f} rad/s"

    return story


def stops_after_ttl(stage: Stage) -> str:
    """Wheels turn, then drives end."""
    with _at_rest(Pair(stage)) as pair:
        _moves(pair, _forward(stage), ALL)
        pair.rates = None
        pair.run(stage.facts.ttl_s)
        return _stopped(pair, "of the last drive's time-to-live")


def stops_when_lost(stage: Stage) -> str:
    """Wheels turn, then the controller is gone."""
    with _at_rest(Pair(stage)) as pair:
        right, left = _forward(stage)
        _moves(pair, (-right, -left), ALL)
        pair.rates = None
        pair.controller.finish()
        return _stopped(pair, "of the controller's session")


@contextmanager
def _at_rest(pair: Pair) -> Iterator[Pair]:
    """Wheels at rest before and after, whatever happens."""
    try:
        pair.steady()
        pair.expect(
            lambda _: _is_still(pair.frames[-WINDOW:], _rate(pair.stage.facts)), "wheels turn at a drive of zero"
        )
        yield pair
    finally:
        pair.rates = STILL
        with suppress(Broken):
            if not pair.controller.is_ended:
                pair.steady()


def _moves(pair: Pair, rates: Rates, allowed: Allowed) -> Rates:
    """Drive until the encoders show it, then stop."""
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


def _stays(pair: Pair, rates: Rates, allowed: Allowed) -> None:
    """Drive for a moment against the permit."""
    pair.allowed = allowed
    pair.settle()
    pair.rates = rates
    pair.settle()
    frames = pair.run(DENIED_S)
    require(
        all(frame.is_held for frame in frames), f"{_shown(rates)} rad/s not held although {_named(allowed)} is allowed"
    )
    require(_is_still(frames, _rate(pair.stage.facts)), f"wheels turn although only {_named(allowed)} is allowed")


def _stopped(pair: Pair, end: str) -> str:
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


def _is_turning(frames: list[Frame], rates: Rates) -> bool:
    seen = mean_rates(frames)
    return seen is not None and all(a * b > SHARE * b * b or b == 0.0 for a, b in zip(seen, rates, strict=True))


def _is_still(frames: list[Frame], rate_rad_s: float) -> bool:
    seen = mean_rates(frames)
    return seen is None or max(map(abs, seen)) < SHARE * rate_rad_s


def _rate(facts: Facts) -> float:
    return min(RATE_RAD_S, 0.25 * facts.max_wheel_rad_s)


def _forward(stage: Stage) -> Rates:
    return _rate(stage.facts), _rate(stage.facts)


def _named(allowed: Allowed) -> str:
    return " and ".join(name for name, is_on in zip(("forward", "reverse", "turn"), allowed, strict=True) if is_on)


def _shown(rates: Rates) -> str:
    return f"{rates[0]:g}, {rates[1]:g}"
