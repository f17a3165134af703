"""Pure. What a fault does to a reading, type by type.

A reading is a tuple of numbers: one, or all components of gravity or of the fans. Every sample passes by: a sound one
through ``see``, so that a fault knows what was last, a faulty one through ``change``.
"""

from collections import deque
from math import inf, sqrt
from typing import Protocol

import numpy as np

from ccatp.sim.faults.models import (
    Delayed,
    Fault,
    Garbage,
    Intermittent,
    NonFinite,
    Off,
    Saturated,
    Slow,
    Stuck,
    Wrong,
)
from ccatp.sim.faults.signals import Signal

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
    """An effect that needs no past."""

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


def make_effect(fault: Fault, signal: Signal, rng: np.random.Generator) -> Effect:
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
