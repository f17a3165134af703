"""Applies a fault plan to the body, to the sensors and to what leaves the robot.

It draws from its own generator, so that a plan never changes what the world and the sensors draw: up to its first fault
a run with a plan is the run without.

The last stage of a frame are its time stamps, its line, and lost, doubled or reordered frames. A line that no client
may take (a token that is no number, a reading beyond the range of the link) goes out as it is, but counts as not
delivered: in lockstep no client can answer it, and simulated time must not wait.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import msgspec
import numpy as np

from ccatp.links.robot_codec import BadLine, decode_from_robot
from ccatp.links.robot_messages import Sensors
from ccatp.mirror.mirror import Mirror
from ccatp.sim.fault_effects import TOKENS, BodyFaults, Row, make_sensor_fault
from ccatp.sim.fault_models import (
    SENSOR_SIGNALS,
    Drop,
    Duplicate,
    Injected,
    InjectedFault,
    InjectionRecord,
    Jump,
    Raise,
    Reboot,
    Reorder,
    Wrap,
)
from ccatp.sim.fault_plan import FaultPlan
from ccatp.sim.sensors import RobotFrame, as_line

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
    """Faults of the clock, and names that the robot raises."""

    def __init__(self, faults: Iterable[InjectedFault]) -> None:
        self.records = [InjectionRecord(fault) for fault in faults]

    def stamp(self, t_s: float, at_s: float, *, is_frame: bool) -> float:
        """The time that is written for ``at_s`` at the time ``t_s`` of the plan."""
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
    """Frames on their way out."""

    def __init__(self, faults: Iterable[InjectedFault]) -> None:
        self.records = [InjectionRecord(fault) for fault in faults]
        self._counts = [0] * len(self.records)
        self._withheld = b""

    def send(self, t_s: float, frame: RobotFrame) -> Outgoing:
        """What leaves when ``frame`` is due.

        Args:
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
        """Drop what was withheld: the robot rebooted."""
        self._withheld = b""


def _raw_line(frame: RobotFrame) -> bytes:
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


_BODY_SIGNALS = ("right_wheel", "left_wheel", "right_fan", "left_fan", "body")


class Injector:
    """A plan at work.

    Args:
        plan: the plan; its faults of the link are none of the robot's.
    """

    def __init__(self, plan: FaultPlan, mirror: Mirror, rng: np.random.Generator) -> None:
        faults = plan.faults
        children = rng.spawn(len(faults)) if faults else []
        self._sensing = [
            make_sensor_fault(fault, child)
            for fault, child in zip(faults, children, strict=True)
            if fault.signal in SENSOR_SIGNALS
        ]
        self.body = BodyFaults((f for f in faults if f.signal in _BODY_SIGNALS), mirror)
        self._stamping = Stamping(f for f in faults if isinstance(f, Jump | Wrap | Raise))
        self._delivery = Delivery(f for f in faults if isinstance(f, Drop | Duplicate | Reorder))
        self._reboots = [InjectionRecord(fault) for fault in faults if isinstance(fault, Reboot)]
        own = [*(one.record for one in self._sensing), *self.body.records, *self._stamping.records]
        own += [*self._delivery.records, *self._reboots]
        self._records = [next(record for record in own if record.fault is fault) for fault in faults]
        self._seq_0, self._boot_s = 0, 0.0
        self.outgoing = NOTHING

    @property
    def injected(self) -> tuple[Injected, ...]:
        """What became of each fault of the robot, in the order of the plan."""
        return tuple(record.injected for record in self._records)

    def changes(self, t_s: float) -> Iterator[tuple[str, Injected]]:
        """Faults that began or ended since the last call: ``begins`` or ``ended``, and the record."""
        for record in self._records:
            if what := record.change(t_s):
                yield what, record.injected

    def is_rebooting(self, t_s: float) -> bool:
        """Whether the robot reboots now; true once for each reboot."""
        due = [r for r in self._reboots if r.fault.has_begun(t_s) and not r.injected.samples]
        for record in due:
            record.add(t_s)
        return bool(due)

    def reboot(self, seq: int, t_s: float) -> None:
        """From now on frames count from this one, times from this time."""
        self._seq_0, self._boot_s = seq, t_s
        self._delivery.forget()

    def sense(self, frame: RobotFrame) -> RobotFrame:
        """The frame as the robot reads it."""
        t_s, gravity = frame.t, frame.gravity
        rows: dict[str, list[Row]] = {
            "imu": list(frame.imu),
            "enc": list(frame.enc),
            "edge": list(frame.edge),
            "gravity": [] if gravity is None else [gravity],
            "fans": [(t_s, *frame.fans)],
            "soc": [(t_s, frame.soc)],
        }
        for one in self._sensing:
            rows[one.rows_name] = one.apply(rows[one.rows_name], t_s)
        return self._stamped(frame, rows)

    def _stamped(self, frame: RobotFrame, rows: dict[str, list[Row]]) -> RobotFrame:
        stamping, t_s, boot_s = self._stamping, frame.t, self._boot_s
        imu, enc, edge, gravity = (
            stamping.stamp_rows(t_s, rows[name], boot_s) for name in ("imu", "enc", "edge", "gravity")
        )
        _, *fans = rows["fans"][-1]
        return RobotFrame(
            frame.seq - self._seq_0,
            stamping.stamp(t_s, t_s - boot_s, is_frame=True),
            imu,
            enc,
            edge,
            gravity[-1] if gravity else None,
            (fans[0], fans[1]),
            rows["soc"][-1][1],
            frame.cmd,
            stamping.raised(t_s),
        )

    def deliver(self, t_s: float, frame: RobotFrame | None) -> None:
        """Let ``frame`` leave, if one is due."""
        self.outgoing = NOTHING if frame is None else self._delivery.send(t_s, frame)
