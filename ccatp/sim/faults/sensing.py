"""Pure. A fault on its way through the rows of a frame.

What "no sample" means depends on the list. A wheel without a sample is ``None``, and a row without any is left out.
The inertial unit, the edge sensors and gravity are read as a whole: without one of its numbers the row is left out.
Fans and battery stand in every frame: without a new reading the last one is repeated.
"""

from collections import deque
from typing import Any

import numpy as np

from ccatp.sim.faults.effects import Effect, Reading, make_effect
from ccatp.sim.faults.models import Delayed, Fault, Garbage, NonFinite
from ccatp.sim.faults.record import Record
from ccatp.sim.faults.signals import SIGNALS

Row = tuple[Any, ...]
"""Time and readings; ``None`` is a wheel without a sample."""

# A fault knows readings of so long before it begins: stuck it repeats the last one, late it gives an old one.
_MEMORY_S = 60.0
_ALWAYS = ("fans", "soc")
_CATCH_UP = 3  # rows that arrive late come this many times as fast as they are taken, so that a line can hold them
_LEAST_CATCH_UP = 10


class SensorFault:
    """A fault that changes readings.

    Args:
        fault: the fault.
        rng: its own generator.

    Attributes:
        rows_name: the list that it acts on.
        record: what it did.
    """

    __slots__ = ("_effect", "_fault", "_is_raw", "_last", "_sees_from_s", "_signal", "record", "rows_name")

    def __init__(self, fault: Fault, rng: np.random.Generator) -> None:
        self._fault, self._signal = fault, SIGNALS[fault.signal]
        self._effect: Effect = make_effect(fault, self._signal, rng)
        self._is_raw = not self._signal.is_binary or isinstance(fault, Garbage | NonFinite)
        self._last: Reading | None = None
        self._sees_from_s = fault.at_s - _MEMORY_S - (fault.by_s if isinstance(fault, Delayed) else 0.0)
        self.rows_name = self._signal.rows
        self.record = Record(fault)

    def apply(self, rows: list[Row], now_s: float) -> list[Row]:
        """The rows as they come out.

        Args:
            rows: as they come in.
            now_s: robot time of the frame.
        """
        if not rows or rows[0][0] >= self._fault.end_s or rows[-1][0] < self._sees_from_s:
            return rows
        return [row for row in map(self._row, rows) if row is not None]

    def _row(self, row: Row) -> Row | None:
        t_s, columns = row[0], self._signal.columns
        reading = tuple(row[c] for c in columns)
        if None in reading:
            return row
        if not self._fault.is_active(t_s):
            self._effect.see(t_s, reading)
            self._last = reading
            return row
        found = self._effect.change(t_s, reading)
        if found is not None and not self._is_raw:
            found = tuple(int(x >= 0.5) for x in found)  # a sensor of light and dark knows nothing in between
        self.record.add(t_s, is_changed=found != reading)
        if found is None:
            return self._without(row)
        self._last = found
        return _put(row, columns, found)

    def _without(self, row: Row) -> Row | None:
        name, columns = self._signal.rows, self._signal.columns
        if name in _ALWAYS:
            return row if self._last is None else _put(row, columns, self._last)
        if name == "enc":
            left = _put(row, columns, (None,))
            return None if left[1] is None is left[2] else left
        return None


class LateRows:
    """Rows that arrive late under the times at which they were taken; they do not overtake each other.

    Args:
        fault: the fault; it takes the whole row of its signal.
    """

    __slots__ = ("_fault", "_waiting", "record", "rows_name")

    def __init__(self, fault: Delayed) -> None:
        self._fault = fault
        self._waiting: deque[Row] = deque()
        self.rows_name = SIGNALS[fault.signal].rows
        self.record = Record(fault)

    def apply(self, rows: list[Row], now_s: float) -> list[Row]:
        """As ``SensorFault.apply``."""
        waiting, fault = self._waiting, self._fault
        if not waiting and not fault.is_active(now_s):
            return rows
        for row in rows:
            if fault.is_active(row[0]):
                self.record.add(row[0])
            waiting.append(row)
        if fault.is_active(now_s):
            due = sum(row[0] <= now_s - fault.by_s for row in waiting)
        else:
            due = max(_CATCH_UP * len(rows), _LEAST_CATCH_UP)
        return [waiting.popleft() for _ in range(min(due, len(waiting)))]


def make_sensor_fault(fault: Fault, rng: np.random.Generator) -> SensorFault | LateRows:
    """A fault of a sensor's signal, ready to act."""
    # Fans and battery are told in every frame and have no time of their own: late they are old readings.
    if isinstance(fault, Delayed) and fault.stamps == "old" and fault.signal not in _ALWAYS:
        return LateRows(fault)
    return SensorFault(fault, rng)


def _put(row: Row, columns: tuple[int, ...], values: tuple[Any, ...]) -> Row:
    found = list(row)
    for column, value in zip(columns, values, strict=True):
        found[column] = value
    return tuple(found)
