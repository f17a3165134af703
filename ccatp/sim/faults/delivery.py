"""Pure. The last stage of a frame with faults: time stamps, its line, and frames lost, doubled or out of order.

A line that no client may take (a token that is no number, a reading beyond the range of the link) goes out as it is,
but counts as not delivered: in lockstep nobody can answer it, and simulated time must not wait.
"""

from collections.abc import Iterable
from typing import NamedTuple

import msgspec

from ccatp.sim.faults.effects import TOKENS
from ccatp.sim.faults.models import Drop, Duplicate, Fault, Jump, Raise, Reorder, Wrap
from ccatp.sim.faults.record import Record
from ccatp.sim.faults.sensing import Row
from ccatp.sim.frame import Frame, as_line
from ccatp.wire.robot import BadLine, Sensors, decode_from_robot

_MARKS = [(msgspec.json.encode(mark), token.encode()) for token, mark in TOKENS.items()]


class Outgoing(NamedTuple):
    """What leaves the robot at one instant.

    Attributes:
        line: its bytes; none, one or several lines.
        message: the newest frame in them that a client can take, if there is one.
    """

    line: bytes
    message: Sensors | None


NOTHING = Outgoing(b"", None)


class Stamping:
    """Faults of the clock, and names that the robot raises.

    Args:
        faults: jump, wrap and raise.
    """

    def __init__(self, faults: Iterable[Fault]) -> None:
        self.records = [Record(fault) for fault in faults]

    def stamp(self, t_s: float, at_s: float, *, is_frame: bool) -> float:
        """The time that is written for ``at_s``, where the clock of the faults says ``t_s``."""
        for record in self.records:
            fault = record.fault
            if not isinstance(fault, Jump | Wrap) or not fault.is_active(t_s):
                continue
            before_s = at_s
            at_s = at_s + fault.by_s if isinstance(fault, Jump) else at_s % fault.modulo_s
            if is_frame:
                record.add(t_s, is_changed=at_s != before_s)
        return at_s

    def raised(self, t_s: float) -> tuple[str, ...]:
        """The names that the frame reports, each once."""
        names: dict[str, None] = {}
        for record in self.records:
            fault = record.fault
            if isinstance(fault, Raise) and fault.is_active(t_s):
                record.add(t_s)
                names.update(dict.fromkeys(fault.names))
        return tuple(names)

    def stamp_rows(self, t_s: float, rows: list[Row], since_s: float) -> list[Row]:
        """The rows under the times that are written, counted from ``since_s``."""
        if not any(record.fault.is_active(t_s) for record in self.records):
            return [(row[0] - since_s, *row[1:]) for row in rows]
        return [(self.stamp(t_s, row[0] - since_s, is_frame=False), *row[1:]) for row in rows]


class Delivery:
    """Frames on their way out.

    Args:
        faults: drop, duplicate and reorder.
    """

    def __init__(self, faults: Iterable[Fault]) -> None:
        self.records = [Record(fault) for fault in faults]
        self._counts = [0] * len(self.records)
        self._withheld = b""

    def send(self, t_s: float, frame: Frame) -> Outgoing:
        """What leaves when ``frame`` is due.

        Args:
            t_s: robot time.
            frame: the frame.
        """
        line = _raw_line(frame)
        withheld, self._withheld = self._withheld, b""
        is_lost = is_late = False
        for k, record in enumerate(self.records):
            fault = record.fault
            if not isinstance(fault, Drop | Duplicate | Reorder) or not fault.is_active(t_s):
                continue
            self._counts[k] += 1
            is_hit = self._counts[k] % fault.every == 0
            record.add(t_s, is_changed=is_hit)
            if is_hit and isinstance(fault, Drop):
                is_lost = True
            elif is_hit and isinstance(fault, Duplicate):
                line += line
            elif is_hit:
                is_late = not withheld
        if is_lost:
            return Outgoing(withheld, None)
        if is_late:
            self._withheld = line
            return NOTHING
        return Outgoing(line + withheld, _taken(line))

    def forget(self) -> None:
        """What was withheld is gone: the robot started anew."""
        self._withheld = b""


def _raw_line(frame: Frame) -> bytes:
    line = as_line(frame)
    for mark, token in _MARKS:
        line = line.replace(mark, token)
    return line


def _taken(line: bytes) -> Sensors | None:
    """What a client makes of a line, or of its first copy."""
    try:
        message = decode_from_robot(line[: line.index(b"\n")])
    except BadLine:
        return None
    return message if isinstance(message, Sensors) else None
