"""Edge. Stories of the fans. Duties change by a few hundredths, never below the floor but where the floor is tested."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from ccatp.conformance.judge_rules import is_duty, judge_untouched
from ccatp.conformance.link import Link
from ccatp.conformance.pair import NOTHING, Pair
from ccatp.conformance.stage import Stage
from ccatp.conformance.stories_rules import AFTER_TTL_S, Ending
from ccatp.conformance.verdict import Broken, NotApplicable, require

Duty = tuple[float, float]
STEP = 0.05
TOLERANCE = 0.01  # a duty in eight bits


def obeyed(stage: Stage) -> str:
    """A new duty."""
    with _changed(Pair(stage)) as (pair, duty):
        pair.settle()
        judge_untouched(pair.settle(), duty, TOLERANCE, "by themselves")
        return f"fans at {_shown(duty)}"


def newest(stage: Stage) -> str:
    """An older command, and one with the same number."""
    with _changed(Pair(stage)) as (pair, duty):
        last = pair.fans(duty)
        pair.settle()
        other = _other(duty, stage.facts.fan_floor)
        for seq in (last - 1, last):
            pair.fans(other, seq)
            frames = [*pair.settle(), *pair.run(2 * stage.facts.frame_s)]
            judge_untouched(frames, duty, TOLERANCE, f"by command {seq} after {last}")
        return f"commands {last - 1} and {last} after {last} dropped"


def of_the_monitor(stage: Stage) -> str:
    """A command of the wrong role."""
    with _changed(Pair(stage)) as (pair, duty):
        left, right = _other(duty, stage.facts.fan_floor)
        seq = stage.next_seq()
        pair.monitor.send(b'{"type":"fans","seq":%d,"duty":[%.3f,%.3f]}\n' % (seq, left, right))
        frames = [*pair.run(10 * stage.facts.frame_s), *pair.settle()]
        judge_untouched(frames, duty, TOLERANCE, "by a command of the monitor")
        return "a command of the monitor does nothing"


def after_time_out(stage: Stage) -> str:
    """Neither drives nor permits for longer than they live."""
    with _changed(Pair(stage)) as (pair, duty):
        pair.rates = pair.allowed = None
        judge_untouched(pair.run(stage.facts.ttl_s + AFTER_TTL_S), duty, TOLERANCE, "by a time-out")
        return f"{_shown(duty)} over {stage.facts.ttl_s + AFTER_TTL_S:.2f} s without drive and permit"


def after_stop(stage: Stage) -> str:
    """A permit that allows nothing."""
    with _changed(Pair(stage)) as (pair, duty):
        pair.allowed = NOTHING
        judge_untouched(pair.run(10 * stage.facts.frame_s), duty, TOLERANCE, "by a permit that allows nothing")
        return f"{_shown(duty)} while nothing is allowed"


def after_lost(ending: Ending) -> Callable[[Stage], str]:
    """Both sessions end, one after the other, and come again."""

    def story(stage: Stage) -> str:
        with _changed(Pair(stage)) as (pair, duty):
            _end(pair.controller, ending)
            if not stage.facts.is_lockstep:  # there the monitor sees no frame without the controller
                pair.rates = None
                judge_untouched(pair.run(10 * stage.facts.frame_s), duty, TOLERANCE, f"by a lost controller ({ending})")
            _end(pair.monitor, ending)
            pair.rejoin()
            first = len(pair.frames)
            pair.steady()
            judge_untouched(pair.frames[first:], duty, TOLERANCE, f"by lost sessions ({ending})")
            return f"{_shown(duty)} after {ending}"

    return story


def floor(stage: Stage) -> str:
    """A duty a little below the floor."""
    lowest = stage.facts.fan_floor
    if lowest <= 0.0:
        raise NotApplicable("fan_floor 0")
    with _changed(Pair(stage)) as (pair, _):
        below = max(0.0, lowest - STEP)
        pair.fans((below, below))
        frames = [*pair.settle(), *pair.run(2 * stage.facts.frame_s)]
        for frame in frames:
            require(min(frame.fans) >= lowest - TOLERANCE, f"fans at {_shown(frame.fans)}, floor {lowest:g}")
        require(is_duty(pair.newest.fans, (lowest, lowest), TOLERANCE), f"fans at {_shown(pair.newest.fans)}")
        faults = pair.messages[0][-1].get("faults", [])
        require("fan_left" not in faults and "fan_right" not in faults, f"faults {faults} for a duty below the floor")
        return f"duty {below:g} clamped to {lowest:g}"


@contextmanager
def _changed(pair: Pair) -> Iterator[tuple[Pair, Duty]]:
    """Fans at another duty than they were found at; put back at the end."""
    found = pair.steady().fans
    duty = _other(found, pair.stage.facts.fan_floor)
    try:
        pair.fans(duty)
        pair.expect(lambda frame: is_duty(frame.fans, duty, TOLERANCE), f"fans never went to {_shown(duty)}")
        yield pair, duty
    finally:
        with suppress(Broken):
            if pair.controller.is_ended or not pair.controller.is_open:
                pair.rejoin()
            pair.steady()
            pair.fans(found)
            pair.expect(lambda frame: is_duty(frame.fans, found, TOLERANCE), "")


def _end(link: Link, ending: Ending) -> None:
    if ending == "RST":
        link.reset()
    else:
        link.finish()


def _other(duty: Duty, lowest: float) -> Duty:
    """Duties that differ from these, and are allowed.

    Raises:
        NotApplicable: there are none.
    """
    if lowest > 1.0 - STEP:
        raise NotApplicable(f"a floor of {lowest:g} leaves no room")
    left, right = (value + STEP if value <= 1.0 - STEP else value - STEP for value in duty)
    return left, right


def _shown(duty: Duty) -> str:
    return f"[{duty[0]:.3g}, {duty[1]:.3g}]"
