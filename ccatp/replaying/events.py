"""Pure. What happened to the localizer in a run, and in which order."""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from ccatp.samples import Fix
from ccatp.wire.robot import Sensors
from ccatp.wire.topics import FixMessage, Treatment


@dataclass(frozen=True, slots=True)
class Marked:
    """A frame was taken, and what else was done to the localizer in it.

    Attributes:
        sensors: the frame.
        at_rest: the mission took the robot to be at rest.
        begun: before the frame the localizer began anew, with these values of ``Treatment``.
        is_deaf: whatever wheels and inertial unit say, the robot stands.
        doubted: after the samples its pose was doubted by this much, m and rad.
    """

    sensors: Sensors
    at_rest: bool
    begun: tuple[float, ...] | None = None
    is_deaf: bool = False
    doubted: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Fixed:
    """A fix was measured after the frame before it.

    Attributes:
        fix: as measured.
        was_fused: the localizer took it then.
        was_set_aside: the localizer never saw it: it was doubted, and measured again.
    """

    fix: Fix
    was_fused: bool
    was_set_aside: bool = False


Event = Marked | Fixed


class Stood(NamedTuple):
    """The mission takes the robot to be at rest from frame ``seq`` on."""

    seq: int


class FixGiven(NamedTuple):
    """A fix was measured after frame ``seq``; the others as in ``Fixed``."""

    seq: int
    fix: Fix
    was_fused: bool
    was_set_aside: bool = False


Message = Sensors | Stood | FixGiven | Treatment


def fix_given(message: FixMessage) -> FixGiven:
    """The recorded fix as it was measured, and what became of it."""
    fix = Fix(
        t_s=message.t_s,
        position_m=message.position_m,
        covariance_m2=tuple(message.covariance_m2),
        dop=message.dop,
        channels=tuple(message.channels),
        residual_rms_m=message.residual_rms_m,
    )
    return FixGiven(message.seq, fix, message.is_fused, message.is_set_aside)


def in_order(messages: Iterable[Message]) -> Iterator[Event]:
    """Frames, rests, treatments and fixes in the order in which the localizer met them.

    Frames are recorded in batches, rests and fixes at once and with the number of their frame: they come at any time
    before the batch of the frame after it. A rest belongs into its frame, a fix behind it. What belongs behind a frame
    beyond the end of the record is left out. A treatment belongs into its frame, too.

    Args:
        messages: in the order of recording; the numbers of the frames grow.
    """
    rests: set[int] = set()
    treatments: dict[tuple[int, str], tuple[float, ...]] = {}
    is_deaf = False
    fixes: deque[FixGiven] = deque()
    last = -1
    for message in messages:
        if isinstance(message, Stood):
            rests.add(message.seq)
        elif isinstance(message, FixGiven):
            fixes.append(message)
        elif isinstance(message, Treatment):
            treatments[message.seq, message.kind] = message.values
        else:
            while fixes and fixes[0].seq < message.seq:
                yield Fixed(*fixes.popleft()[1:])
            last = message.seq
            at_rest = last in rests
            rests.discard(last)
            begun = treatments.pop((last, "begun"), None)
            if (last, "deaf") in treatments or (last, "hearing") in treatments or begun is not None:
                is_deaf = (last, "deaf") in treatments
            yield Marked(message, at_rest, begun, is_deaf, treatments.pop((last, "doubted"), None))
    while fixes and fixes[0].seq <= last:
        yield Fixed(*fixes.popleft()[1:])
