"""Faults of wheels, fans and body: what the robot really does, whatever it is told.

What a fault does to a reading, type by type.

A reading is a tuple of numbers: one, or all components of gravity or of the fans. Every sample passes by: a sound one
through ``see``, so that a fault knows what was last, a faulty one through ``change``.

A fault on its way through the rows of a frame.

What "no sample" means depends on the list. A wheel without a sample is ``None``, and a row without any is left out.
The inertial unit, the edge sensors and gravity are read as a whole: without one of its numbers the row is left out.
Fans and battery stand in every frame: without a new reading the last one is repeated.
"""

from collections import deque
from collections.abc import Iterable
from math import inf, sqrt
from typing import Any, Protocol

import numpy as np

from ccatp.mirror.mirror import Mirror
from ccatp.sim.disturbances import LEVEL_SLOPE, Downhill
from ccatp.sim.fault_models import (
    SIGNALS,
    Blocked,
    Delayed,
    Drift,
    Garbage,
    InjectedFault,
    InjectionRecord,
    Intermittent,
    Kidnap,
    NonFinite,
    Off,
    Runaway,
    Saturated,
    Signal,
    Slip,
    Slow,
    Stuck,
    Weak,
    Wrong,
)
from ccatp.sim.plant import BodyStep, Plant
from ccatp.sim.rules import FanRules
from ccatp.sim.world import World


class _StepFault:
    """What one step of the world shall be like: right and left of each."""

    __slots__ = ("grip", "health", "rates_rad_s")

    def __init__(self, set_points_rad_s: tuple[float, float]) -> None:
        self.rates_rad_s, self.grip, self.health = [*set_points_rad_s], [1.0, 1.0], [1.0, 1.0]


class BodyFaults:
    """All faults of the body."""

    def __init__(self, faults: Iterable[InjectedFault], mirror: Mirror) -> None:
        self.records = [InjectionRecord(fault) for fault in faults]
        self.drifts = [
            _DriftFault(record, record.fault, mirror) for record in self.records if isinstance(record.fault, Drift)
        ]
        self._has_weak_fan = any(isinstance(record.fault, Weak) for record in self.records)

    def act(
        self, world: World, fans: FanRules, t_s: float, set_points_rad_s: tuple[float, float]
    ) -> tuple[float, float]:
        """Before a step of the world; what its wheels turn by, right and left.

        Args:
            world: the world; a kidnap moves its body, a slip takes its grip.
        """
        step = _StepFault(set_points_rad_s)
        for record in self.records:
            fault = record.fault
            if isinstance(fault, Kidnap):
                _kidnap(record, fault, world, t_s)
            elif fault.is_active(t_s):
                _befall(record, step, world.plant, fans, t_s)
        if self._has_weak_fan:
            right, left = step.health
            fans.health = left, right  # the fans' own order
        world.grip = step.grip[0], step.grip[1]
        return step.rates_rad_s[0], step.rates_rad_s[1]


def _kidnap(record: InjectionRecord, fault: Kidnap, world: World, t_s: float) -> None:
    if fault.has_begun(t_s) and not record.injected.samples:
        world.displace(fault.dx_m, fault.dy_m, fault.dheading_rad)
        record.add(t_s)


def _befall(record: InjectionRecord, step: _StepFault, plant: Plant, fans: FanRules, t_s: float) -> None:
    """Let one lasting fault act on the wheels or fans that it names, or on both."""
    fault, rates = record.fault, step.rates_rad_s
    sides = {"right": (0,), "left": (1,)}.get(fault.signal.partition("_")[0], (0, 1))
    match fault:
        case Blocked():
            is_turning = plant.block(right=0 in sides, left=1 in sides)
            record.add(t_s, is_changed=is_turning or any(rates[k] for k in sides))
            for k in sides:
                rates[k] = 0.0
        case Runaway():
            record.add(t_s, is_changed=any(rates[k] != fault.rate_rad_s for k in sides))
            for k in sides:
                rates[k] = fault.rate_rad_s
        case Slip():
            record.add(t_s, is_changed=not plant.are_wheels_still or any(rates))
            for k in sides:
                step.grip[k] *= fault.factor
        case Weak():
            record.add(t_s, is_changed=any(fans.duty[1 - k] for k in sides))
            for k in sides:
                step.health[k] *= fault.share


class _DriftFault:
    """A disturbance of the plant: downhill while the wheels are held at zero."""

    def __init__(self, record: InjectionRecord, fault: Drift, mirror: Mirror) -> None:
        self._record, self._fault, self._downhill = record, fault, Downhill(mirror)

    def displace(
        self, plant: Plant, t_s: float, dt_s: float, forward_m: float, left_m: float, turn_rad: float
    ) -> BodyStep:
        right_set, _, left_set, _ = plant.servo
        if right_set or left_set or not self._fault.is_active(t_s):
            return forward_m, left_m, turn_rad
        ahead, aside, slope = self._downhill.of(plant)
        is_level = slope < LEVEL_SLOPE
        self._record.add(t_s, is_changed=not is_level)
        if is_level:
            return forward_m, left_m, turn_rad
        glide_m = self._fault.speed_m_s * dt_s / slope
        return forward_m + glide_m * ahead, left_m + glide_m * aside, turn_rad


Reading = tuple[float, ...]

# Stand-ins for what cannot be written as a number: no reading has these values, and the line gets the token instead.
TOKENS = {"NaN": 1.2345678901234567e201, "Infinity": 1.2345678901234567e202, "1e999": 1.2345678901234567e203}
_BEYOND_DECADES = (3.0, 30.0)  # decades above the range
_LARGEST_INTEGER = 1_000_000


class Effect(Protocol):
    """One fault at work on one signal."""

    def see(self, t_s: float, reading: Reading) -> None:
        """A sample that it leaves alone."""

    def change(self, t_s: float, reading: Reading) -> Reading | None:
        """What comes out in place of a reading; ``None``: no sample."""


class _Unseeing:
    def see(self, t_s: float, reading: Reading) -> None:
        """Nothing to remember."""


class _Off(_Unseeing):
    def change(self, t_s: float, reading: Reading) -> Reading | None:
        return None


class _Stuck:
    def __init__(self, value: float | None) -> None:
        self._value = value
        self._last: Reading | None = None

    def see(self, t_s: float, reading: Reading) -> None:
        self._last = reading

    def change(self, t_s: float, reading: Reading) -> Reading | None:
        if self._value is not None:
            return (self._value,) * len(reading)
        if self._last is None:
            self._last = reading
        return self._last


class _Garbage(_Unseeing):
    def __init__(self, beyond: float, signal: Signal, rng: np.random.Generator) -> None:
        self._beyond, self._signal, self._rng = beyond, signal, rng

    def change(self, t_s: float, reading: Reading) -> Reading | None:
        rng, signal, count = self._rng, self._signal, len(reading)
        if rng.random() < self._beyond:
            if signal.is_binary:
                return tuple(rng.integers(2, _LARGEST_INTEGER, count).tolist())
            sizes = signal.high * 10.0 ** rng.uniform(*_BEYOND_DECADES, count)
            return tuple((sizes * rng.choice((-1.0, 1.0), count)).tolist())
        if signal.is_binary:
            return tuple(rng.integers(0, 2, count).tolist())
        if signal.rows == "gravity":  # any direction: a vector of another length would not be within the range
            direction = rng.standard_normal(count)
            return tuple((direction / sqrt(float(direction @ direction))).tolist())
        return tuple(rng.uniform(signal.low, signal.high, count).tolist())


class _Wrong(_Unseeing):
    def __init__(self, fault: Wrong, signal: Signal) -> None:
        self._offset = fault.offset or 0.0
        self._factor = 1.0 if fault.factor is None else fault.factor
        self._is_negated, self._is_binary = fault.sign == -1, signal.is_binary

    def change(self, t_s: float, reading: Reading) -> Reading | None:
        if self._is_negated:  # what is 0 or 1 is inverted
            reading = tuple(1.0 - x for x in reading) if self._is_binary else tuple(-x for x in reading)
        return tuple(self._factor * x + self._offset for x in reading)


class _Slow(_Unseeing):
    def __init__(self, every: int) -> None:
        self._every, self._count = every, 0

    def change(self, t_s: float, reading: Reading) -> Reading | None:
        self._count += 1
        return None if self._count % self._every else reading


class _Delayed:
    """Readings of ``by_s`` ago; before there are any, the oldest."""

    def __init__(self, by_s: float) -> None:
        self._by_s = by_s
        self._past: deque[tuple[float, Reading]] = deque()

    def see(self, t_s: float, reading: Reading) -> None:
        past, then_s = self._past, t_s - self._by_s
        past.append((t_s, reading))
        while len(past) > 1 and past[1][0] <= then_s:
            past.popleft()

    def change(self, t_s: float, reading: Reading) -> Reading | None:
        self.see(t_s, reading)
        return self._past[0][1]


class _Intermittent(_Unseeing):
    def __init__(self, fault: Intermittent) -> None:
        self._fault = fault

    def change(self, t_s: float, reading: Reading) -> Reading | None:
        fault = self._fault
        if (t_s - fault.at_s) % fault.period_s < fault.duty * fault.period_s:
            return reading
        return None if fault.value is None else (fault.value,) * len(reading)


class _Saturated(_Unseeing):
    def __init__(self, fault: Saturated) -> None:
        self._low = -inf if fault.low is None else fault.low
        self._high = inf if fault.high is None else fault.high

    def change(self, t_s: float, reading: Reading) -> Reading | None:
        return tuple(min(max(x, self._low), self._high) for x in reading)


class _NonFinite(_Unseeing):
    def __init__(self, token: str) -> None:
        self._mark = TOKENS[token]

    def change(self, t_s: float, reading: Reading) -> Reading | None:
        return (self._mark,) * len(reading)


def make_effect(fault: InjectedFault, signal: Signal, rng: np.random.Generator) -> Effect:
    """The effect of a fault on a signal.

    Raises:
        TypeError: the fault is none of a sensor's reading.
    """
    made: Effect
    match fault:
        case Off():
            made = _Off()
        case Stuck():
            made = _Stuck(fault.value)
        case Garbage():
            made = _Garbage(fault.beyond, signal, rng)
        case Wrong():
            made = _Wrong(fault, signal)
        case Slow():
            made = _Slow(fault.every)
        case Delayed():
            made = _Delayed(fault.by_s)
        case Intermittent():
            made = _Intermittent(fault)
        case Saturated():
            made = _Saturated(fault)
        case NonFinite():
            made = _NonFinite(fault.token)
        case _:
            raise TypeError(f"no effect on readings: {type(fault).__name__}")
    return made


Row = tuple[Any, ...]
"""Time and readings; ``None`` is a wheel without a sample."""

# A fault knows readings of so long before it begins: stuck it repeats the last one, late it gives an old one.
_MEMORY_S = 60.0
_ALWAYS = ("fans", "soc")
_CATCH_UP = 3  # rows that arrive late come this many times as fast as they are taken, so that a line can hold them
_LEAST_CATCH_UP = 10


class SensorFault:
    """A fault that changes readings."""

    __slots__ = ("_effect", "_fault", "_is_raw", "_last", "_sees_from_s", "_signal", "record", "rows_name")

    def __init__(self, fault: InjectedFault, rng: np.random.Generator) -> None:
        self._fault, self._signal = fault, SIGNALS[fault.signal]
        self._effect: Effect = make_effect(fault, self._signal, rng)
        self._is_raw = not self._signal.is_binary or isinstance(fault, Garbage | NonFinite)
        self._last: Reading | None = None
        self._sees_from_s = fault.at_s - _MEMORY_S - (fault.by_s if isinstance(fault, Delayed) else 0.0)
        self.rows_name = self._signal.rows
        self.record = InjectionRecord(fault)

    def apply(self, rows: list[Row], now_s: float) -> list[Row]:
        """The rows as they come out.

        Args:
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
        self.record = InjectionRecord(fault)

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


def make_sensor_fault(fault: InjectedFault, rng: np.random.Generator) -> SensorFault | LateRows:
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
