"""Pure. The injector: applies a plan to what the body does, to what the sensors give and to what leaves the robot.

It draws from a generator of its own, so that a plan never changes what the world and the sensors draw: up to its first
fault a run with a plan is the run without.
"""

from collections.abc import Iterator

import numpy as np

from ccatp.mirror.mirror import Mirror
from ccatp.sim.faults.body import BodyFaults
from ccatp.sim.faults.delivery import NOTHING, Delivery, Stamping
from ccatp.sim.faults.models import (
    SENSOR_SIGNALS,
    Drop,
    Duplicate,
    Jump,
    Raise,
    Reboot,
    Reorder,
    Wrap,
)
from ccatp.sim.faults.plan import FaultPlan
from ccatp.sim.faults.record import Injected, Record
from ccatp.sim.faults.sensing import Row, make_sensor_fault
from ccatp.sim.frame import Frame

_BODY_SIGNALS = ("right_wheel", "left_wheel", "right_fan", "left_fan", "body")


class Injector:
    """A plan at work.

    Args:
        plan: the plan; its faults of the link are none of the robot's.
        mirror: the mirror.
        rng: parent of one generator per fault.

    Attributes:
        body: the faults of the body.
        outgoing: what leaves the robot at this instant.
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
        self._reboots = [Record(fault) for fault in faults if isinstance(fault, Reboot)]
        own = [*(one.record for one in self._sensing), *self.body.records, *self._stamping.records]
        own += [*self._delivery.records, *self._reboots]
        self._records = [next(record for record in own if record.fault is fault) for fault in faults]
        self._seq_0, self._boot_s = 0, 0.0
        self.outgoing = NOTHING

    @property
    def injected(self) -> tuple[Injected, ...]:
        """What became of each fault of the robot, in the order of the plan."""
        return tuple(record.injected for record in self._records)

    def news(self, t_s: float) -> Iterator[tuple[str, Injected]]:
        """Faults that began or ended since the last call: ``begins`` or ``ended``, and the record."""
        for record in self._records:
            if what := record.has_news(t_s):
                yield what, record.injected

    def is_rebooting(self, t_s: float) -> bool:
        """Whether the robot starts anew now; true once for each reboot."""
        due = [r for r in self._reboots if r.fault.has_begun(t_s) and not r.injected.samples]
        for record in due:
            record.add(t_s)
        return bool(due)

    def reboot(self, seq: int, t_s: float) -> None:
        """From now on frames count from this one, times from this time."""
        self._seq_0, self._boot_s = seq, t_s
        self._delivery.forget()

    def sense(self, frame: Frame) -> Frame:
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

    def _stamped(self, frame: Frame, rows: dict[str, list[Row]]) -> Frame:
        stamping, t_s, boot_s = self._stamping, frame.t, self._boot_s
        imu, enc, edge, gravity = (
            stamping.stamp_rows(t_s, rows[name], boot_s) for name in ("imu", "enc", "edge", "gravity")
        )
        _, *fans = rows["fans"][-1]
        return Frame(
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

    def deliver(self, t_s: float, frame: Frame | None) -> None:
        """Let ``frame`` leave, if one is due."""
        self.outgoing = NOTHING if frame is None else self._delivery.send(t_s, frame)
