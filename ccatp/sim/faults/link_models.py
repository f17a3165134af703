"""Pure. The faults of the robot link that a plan may hold: what the proxy between robot and clients shall do."""

from typing import Annotated, Literal

from pydantic import Field

from ccatp.config.models import Model, NonNegative, Positive
from ccatp.sim.faults.models import EveryNth

Direction = Literal["to_client", "to_robot", "both"]
ByteCount = Annotated[int, Field(ge=1, le=65536)]


class LinkFault(Model):
    """A fault of the link.

    Attributes:
        type: what happens.
        at_s: robot time at which it begins; or else
        after_lines, after_bytes: it begins once so much has gone to the clients, counted over all connections.
    """

    type: str
    at_s: NonNegative | None = None
    after_lines: Annotated[int, Field(ge=1)] | None = None
    after_bytes: Annotated[int, Field(ge=1)] | None = None


class LastingLinkFault(LinkFault):
    """One that lasts for ``for_s`` of robot time, or until the end, in one direction or both."""

    direction: Direction
    for_s: Positive | None = None


class Reset(LinkFault):
    """Every connection is broken by RST."""


class Close(LinkFault):
    """Every connection is ended by FIN."""


class BlackHole(LastingLinkFault):
    """What is sent disappears, and so does the news that a side has closed: a half-open connection."""


class Stall(LastingLinkFault):
    """Nothing is passed on; at the end everything at once."""


class Delay(LastingLinkFault):
    """Everything comes ``delay_s`` late, and up to ``jitter_s`` more, drawn for each piece; the order stays."""

    delay_s: NonNegative
    jitter_s: NonNegative


class ReorderLines(LastingLinkFault):
    """Every n-th line is passed on after the one that follows it."""

    every: Annotated[int, Field(ge=2)]


class DuplicateLines(LastingLinkFault):
    """Every n-th line is passed on twice."""

    every: EveryNth


class Fragment(LastingLinkFault):
    """Passed on in writes of so many bytes."""

    write_bytes: ByteCount


class Flood(LastingLinkFault):
    """Further lines at a rate: random ones, or copies of the last line that passed."""

    rate_hz: Positive
    lines: Literal["garbage", "copies"]


class Slowloris(LastingLinkFault):
    """Passed on byte by byte, at a rate."""

    bytes_per_s: Positive


class GarbageBytes(LastingLinkFault):
    """A line of so many random bytes before every n-th line."""

    garbage_bytes: ByteCount
    every: EveryNth


class Corrupt(LastingLinkFault):
    """One byte of every n-th line is another one."""

    every: EveryNth


LINK_TYPES: dict[str, type[LinkFault]] = {
    "reset": Reset,
    "close": Close,
    "black_hole": BlackHole,
    "stall": Stall,
    "delay": Delay,
    "reorder": ReorderLines,
    "duplicate": DuplicateLines,
    "fragment": Fragment,
    "flood": Flood,
    "slowloris": Slowloris,
    "garbage": GarbageBytes,
    "corrupt": Corrupt,
}

LOCKSTEP_TYPES = ("reset", "close", "duplicate", "fragment", "garbage")
"""What makes sense where simulated time waits for every line: the others would only make it wait, some for ever."""
