"""Edge. One stretch of sensors frames for all judges of them."""

from collections.abc import Callable, Sequence
from itertools import pairwise

from ccatp.conformance.pair import Pair
from ccatp.conformance.reading import Message, fault_of_line
from ccatp.conformance.stage import Stage
from ccatp.conformance.verdict import require
from ccatp.wire.lines import MAX_LINE_BYTES

FRAMES = 40
JoinedFrames = Sequence[Message]


def judged(judge: Callable[[JoinedFrames], str]) -> Callable[[Stage], str]:
    """A story: record a stretch, and judge what the controller got."""

    def story(stage: Stage) -> str:
        return judge(_record(stage).messages[0])

    return story


def clocked(judge: Callable[[JoinedFrames, float], str]) -> Callable[[Stage], str]:
    """The same for a judge that asks for the rate of the frames."""

    def story(stage: Stage) -> str:
        return judge(_record(stage).messages[0], stage.facts.frame_hz)

    return story


def compared(judge: Callable[[JoinedFrames, JoinedFrames], str]) -> Callable[[Stage], str]:
    """The same for a judge of both sessions' frames."""

    def story(stage: Stage) -> str:
        return judge(*_record(stage).messages)

    return story


def lines(stage: Stage) -> str:
    """The lines as such."""
    pair = _record(stage)
    for line in pair.raw:
        fault = fault_of_line(line, MAX_LINE_BYTES)
        require(fault is None, str(fault))
    return f"{len(pair.raw)} lines, the longest of {max(map(len, pair.raw))} bytes"


def before_join(stage: Stage) -> str:
    """A client that does not join, beside two that have."""
    onlooker, _ = stage.greet()
    pair = Pair(stage)
    pair.steady()
    pair.run(10 * stage.facts.frame_s)
    require(not any(b'"sensors"' in line for line in onlooker.lines), "sensors frames before the join")
    return f"none in {len(pair.frames)} frames"


def echo(stage: Stage) -> str:
    """Drives one by one: each is echoed by its number."""
    pair = Pair(stage)
    pair.steady()
    frames = [*pair.run(20 * stage.facts.frame_s), *pair.settle()]
    for before, after in pairwise(frames):
        require(after.drive_seq >= before.drive_seq, f"cmd.seq {after.drive_seq} after {before.drive_seq}")
    ages_s = [frame.age_s for frame in frames[-10:]]
    require(max(ages_s) < stage.facts.ttl_s, f"cmd.age {max(ages_s):.3f} s with a new drive for each frame")
    return f"drive {pair.newest.drive_seq} in force, age {ages_s[-1]:.3f} s"


def _record(stage: Stage) -> Pair:
    pair = Pair(stage)
    pair.run(FRAMES * stage.facts.frame_s)
    require(len(pair.messages[0]) > 2, "fewer than three frames for the controller")
    return pair
