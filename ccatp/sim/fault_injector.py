"""Applies a fault plan to the body, to the sensors and to what leaves the robot.

It draws from its own generator, so that a plan never changes what the world and the sensors draw: up to its first fault
a run with a plan is the run without.

A reading is a tuple of numbers: one, or all components of gravity or of the fans. What "no sample" means depends on the
list. A wheel without a sample is ``None``, and a row without any is left out. The inertial unit, the edge sensors and
gravity are read as a whole: without one of its numbers the row is left out. Fans and battery stand in every frame:
without a new reading the last one is repeated.

The last stage of a frame are its time stamps, its line, and lost, doubled or reordered frames. A line that no client
may take (a token that is no number, a reading beyond the range of the link) goes out as it is, but counts as not
delivered: in lockstep no client can answer it, and simulated time must not wait.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from math import inf, sqrt
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ccatp.links.robot_codec import BadLine, decode_from_robot
from ccatp.links.robot_messages import Sensors
from ccatp.mirror.mirror import Mirror
from ccatp.sim.fault_plan import (
    SIGNALS,
    Blocked,
    Delayed,
    Drift,
    Drop,
    Duplicate,
    FaultPlan,
    Garbage,
    Injected,
    InjectedFault,
    Intermittent,
    Jump,
    Kidnap,
    NonFinite,
    Off,
    Raise,
    Reboot,
    Reorder,
    Runaway,
    Saturated,
    Slip,
    Slow,
    Stuck,
    Weak,
    Wrap,
    Wrong,
)
from ccatp.sim.plant import LEVEL_SLOPE, BodyStep, Downhill, Plant
from ccatp.sim.rules import FanRules
from ccatp.sim.sensors import RobotFrame, as_line
from ccatp.sim.world import World

Reading = tuple[float, ...]
Row = tuple[Any, ...]
"""Time and readings; ``None`` is a wheel without a sample."""

# Stand-ins for what cannot be written as a number: no reading has these values, and the line gets the token instead.
TOKENS = {"NaN": 1.2345678901234567e201, "Infinity": 1.2345678901234567e202, "1e999": 1.2345678901234567e203}
_MARKS = [(msgspec.json.encode(mark), token.encode()) for token, mark in TOKENS.items()]
_BEYOND_DECADES = (3.0, 30.0)  # decades above the range
_LARGEST_INTEGER = 1_000_000
# A fault knows readings of so long before it begins: stuck it repeats the last one, late it gives an old one.
_MEMORY_S = 60.0
_ALWAYS = ("fans", "soc")
_CATCH_UP = 3  # rows that arrive late come this many times as fast as they are taken, so that a line can hold them
_LEAST_CATCH_UP = 10
_BODY_SIGNALS = ("right_wheel", "left_wheel", "right_fan", "left_fan", "body")


class InjectionRecord:
    """The record of one fault while it is written."""

    def __init__(self, fault: InjectedFault) -> None:
        self.fault: Any = fault
        self._from_s: float | None = None
        self._until_s: float | None = None
        self.samples = self._changed = self._reported = 0

    def add(self, t_s: float, *, is_changed: bool = True) -> None:
        """Count one sample, frame or step."""
        if self._from_s is None:
            self._from_s = t_s
        self._until_s = t_s
        self.samples += 1
        self._changed += is_changed

    @property
    def injected(self) -> Injected:
        """The record so far."""
        fault = self.fault
        return Injected(fault.signal, fault.type, fault.at_s, self._from_s, self._until_s, self.samples, self._changed)

    def change(self, t_s: float) -> str:
        """``begins`` or ``ended`` once each, else empty; a fault of an instant ends as it begins."""
        if self._reported == 0 and self._from_s is not None:
            self._reported = 1
            return "begins"
        if self._reported == 1 and t_s >= self.fault.end_s:
            self._reported = 2
            return "ended"
        return ""


class _StepFault:
    """Wheel rates, grip and fan thrust in one step of the world: right and left of each."""

    def __init__(self, set_points_rad_s: tuple[float, float]) -> None:
        self.rates_rad_s, self.grip, self.health = [*set_points_rad_s], [1.0, 1.0], [1.0, 1.0]


class BodyFaults:
    """All faults of the body."""

    def __init__(self, faults: Iterable[InjectedFault], mirror: Mirror) -> None:
        self.records = [InjectionRecord(fault) for fault in faults]
        self.drifts = [_DriftFault(record, mirror) for record in self.records if isinstance(record.fault, Drift)]
        self._has_weak_fan = any(isinstance(record.fault, Weak) for record in self.records)

    def act(
        self, world: World, fans: FanRules, t_s: float, set_points_rad_s: tuple[float, float]
    ) -> tuple[float, float]:
        """Wheel rates (right, left) of the next step, rad/s; a kidnap moves the world's body, a slip takes its grip."""
        step = _StepFault(set_points_rad_s)
        for record in self.records:
            fault = record.fault
            if isinstance(fault, Kidnap):
                if fault.has_begun(t_s) and not record.samples:
                    world.displace(fault.dx_m, fault.dy_m, fault.dheading_rad)
                    record.add(t_s)
            elif fault.is_active(t_s):
                _act_on_step(record, step, world.plant, fans, t_s)
        if self._has_weak_fan:
            right, left = step.health
            fans.health = left, right  # the fans' own order
        world.grip = step.grip[0], step.grip[1]
        return step.rates_rad_s[0], step.rates_rad_s[1]


def _act_on_step(record: InjectionRecord, step: _StepFault, plant: Plant, fans: FanRules, t_s: float) -> None:
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

    def __init__(self, record: InjectionRecord, mirror: Mirror) -> None:
        self._record, self._downhill = record, Downhill(mirror)

    def displace(
        self, plant: Plant, t_s: float, dt_s: float, forward_m: float, left_m: float, turn_rad: float
    ) -> BodyStep:
        right_set, _, left_set, _ = plant.servo
        fault: Drift = self._record.fault
        if right_set or left_set or not fault.is_active(t_s):
            return forward_m, left_m, turn_rad
        ahead, aside, slope = self._downhill.of(plant)
        is_level = slope < LEVEL_SLOPE
        self._record.add(t_s, is_changed=not is_level)
        if is_level:
            return forward_m, left_m, turn_rad
        glide_m = fault.speed_m_s * dt_s / slope
        return forward_m + glide_m * ahead, left_m + glide_m * aside, turn_rad


class SensorFault:
    """A fault that changes readings; ``past`` holds the readings that it needs later, with their times."""

    def __init__(self, fault: InjectedFault, rng: np.random.Generator) -> None:
        if type(fault) not in EFFECTS:
            raise TypeError(f"no effect on readings: {type(fault).__name__}")
        self._effect = EFFECTS[type(fault)]
        self.fault: Any = fault
        self.signal, self.rng, self.count = SIGNALS[fault.signal], rng, 0
        self.past: deque[tuple[float, Reading]] = deque()
        self._needs_past = isinstance(fault, Stuck | Delayed)
        self._delay_s = fault.by_s if isinstance(fault, Delayed) else 0.0
        self._is_raw = not self.signal.is_binary or isinstance(fault, Garbage | NonFinite)
        self._last: Reading | None = None
        self._sees_from_s = fault.at_s - _MEMORY_S - self._delay_s
        self.rows_name = self.signal.rows
        self.record = InjectionRecord(fault)

    def apply(self, rows: list[Row], now_s: float) -> list[Row]:
        """The rows as they come out, in the frame of robot time ``now_s``."""
        if not rows or rows[0][0] >= self.fault.end_s or rows[-1][0] < self._sees_from_s:
            return rows
        return [row for row in map(self._row, rows) if row is not None]

    def remember(self, t_s: float, reading: Reading) -> Reading:
        """Keep a reading, and of those that are old enough only the newest; returns the oldest."""
        past, then_s = self.past, t_s - self._delay_s
        past.append((t_s, reading))
        while len(past) > 1 and past[1][0] <= then_s:
            past.popleft()
        return past[0][1]

    def _row(self, row: Row) -> Row | None:
        t_s, columns = row[0], self.signal.columns
        reading = tuple(row[c] for c in columns)
        if None in reading:
            return row
        if not self.fault.is_active(t_s):
            if self._needs_past:
                self.remember(t_s, reading)
            self._last = reading
            return row
        found = self._effect(self, t_s, reading)
        if found is not None and not self._is_raw:
            found = tuple(int(x >= 0.5) for x in found)  # an edge sensor has no value between 0 and 1
        self.record.add(t_s, is_changed=found != reading)
        if found is None:
            return self._without(row)
        self._last = found
        return _put(row, columns, found)

    def _without(self, row: Row) -> Row | None:
        name, columns = self.signal.rows, self.signal.columns
        if name in _ALWAYS:
            return row if self._last is None else _put(row, columns, self._last)
        if name == "enc":
            left = _put(row, columns, (None,))
            return None if left[1] is None is left[2] else left
        return None


def _stuck(one: SensorFault, t_s: float, reading: Reading) -> Reading | None:
    if one.fault.value is not None:
        return (one.fault.value,) * len(reading)
    return one.past[0][1] if one.past else one.remember(t_s, reading)


def _garbage(one: SensorFault, t_s: float, reading: Reading) -> Reading | None:
    rng, signal, count = one.rng, one.signal, len(reading)
    if rng.random() < one.fault.beyond:
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


def _wrong(one: SensorFault, t_s: float, reading: Reading) -> Reading | None:
    fault = one.fault
    if fault.sign == -1:  # what is 0 or 1 is inverted
        reading = tuple(1.0 - x for x in reading) if one.signal.is_binary else tuple(-x for x in reading)
    factor, offset = 1.0 if fault.factor is None else fault.factor, fault.offset or 0.0
    return tuple(factor * x + offset for x in reading)


def _slow(one: SensorFault, t_s: float, reading: Reading) -> Reading | None:
    one.count += 1
    return None if one.count % one.fault.every else reading


def _intermittent(one: SensorFault, t_s: float, reading: Reading) -> Reading | None:
    fault = one.fault
    if (t_s - fault.at_s) % fault.period_s < fault.duty * fault.period_s:
        return reading
    return None if fault.value is None else (fault.value,) * len(reading)


def _saturated(one: SensorFault, t_s: float, reading: Reading) -> Reading | None:
    low = -inf if one.fault.low is None else one.fault.low
    high = inf if one.fault.high is None else one.fault.high
    return tuple(min(max(x, low), high) for x in reading)


# What comes out in place of a reading; ``None``: no sample.
EFFECTS: dict[type[InjectedFault], Callable[[SensorFault, float, Reading], Reading | None]] = {
    Off: lambda one, t_s, reading: None,
    Stuck: _stuck,
    Garbage: _garbage,
    Wrong: _wrong,
    Slow: _slow,
    Delayed: SensorFault.remember,  # the reading of ``by_s`` ago; before there is one, the oldest
    Intermittent: _intermittent,
    Saturated: _saturated,
    NonFinite: lambda one, t_s, reading: (TOKENS[one.fault.token],) * len(reading),
}


class LateRows:
    """Rows that arrive late under the times at which they were taken; they keep their order.

    The fault takes the whole row of its signal.
    """

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
    # Fans and battery are reported in every frame and have no time of their own: late they are old readings.
    if isinstance(fault, Delayed) and fault.stamps == "old" and fault.signal not in _ALWAYS:
        return LateRows(fault)
    return SensorFault(fault, rng)


def _put(row: Row, columns: tuple[int, ...], values: tuple[Any, ...]) -> Row:
    found = list(row)
    for column, value in zip(columns, values, strict=True):
        found[column] = value
    return tuple(found)


class Outgoing(NamedTuple):
    """What leaves the robot at one instant: none, one or several lines, and the newest frame that a client can take."""

    line: bytes
    message: Sensors | None


NOTHING = Outgoing(b"", None)


class Injector:
    """The faults of the robot in a plan at work."""

    def __init__(self, plan: FaultPlan, mirror: Mirror, rng: np.random.Generator) -> None:
        faults = plan.faults
        children = rng.spawn(len(faults)) if faults else []
        self._sensing = [
            make_sensor_fault(fault, child)
            for fault, child in zip(faults, children, strict=True)
            if fault.signal in SIGNALS
        ]
        self.body = BodyFaults((f for f in faults if f.signal in _BODY_SIGNALS), mirror)
        own = [*(one.record for one in self._sensing), *self.body.records]
        own += [InjectionRecord(f) for f in faults if f.signal not in SIGNALS and f.signal not in _BODY_SIGNALS]
        self._records = [next(record for record in own if record.fault is fault) for fault in faults]
        self._stamping, self._raising = self._of(Jump | Wrap), self._of(Raise)
        self._delivery, self._reboots = self._of(Drop | Duplicate | Reorder), self._of(Reboot)
        self._counts = [0] * len(self._delivery)
        self._withheld = b""
        self._seq_0, self._boot_s = 0, 0.0
        self.outgoing = NOTHING

    def _of(self, kinds: Any) -> list[InjectionRecord]:
        return [record for record in self._records if isinstance(record.fault, kinds)]

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
        due = [record for record in self._reboots if record.fault.has_begun(t_s) and not record.samples]
        for record in due:
            record.add(t_s)
        return bool(due)

    def reboot(self, seq: int, t_s: float) -> None:
        """From now on frames count from this one, times from this time."""
        self._seq_0, self._boot_s = seq, t_s
        self._withheld = b""

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
        stamped = {name: self._stamp_rows(t_s, rows[name]) for name in ("imu", "enc", "edge", "gravity")}
        _, *fans = rows["fans"][-1]
        return RobotFrame(
            frame.seq - self._seq_0,
            self._stamp(t_s, t_s - self._boot_s, is_frame=True),
            stamped["imu"],
            stamped["enc"],
            stamped["edge"],
            stamped["gravity"][-1] if stamped["gravity"] else None,
            (fans[0], fans[1]),
            rows["soc"][-1][1],
            frame.cmd,
            self._raised(t_s),
        )

    def _stamp_rows(self, t_s: float, rows: list[Row]) -> list[Row]:
        """The rows under the times that are written, counted from the boot."""
        return [(self._stamp(t_s, row[0] - self._boot_s, is_frame=False), *row[1:]) for row in rows]

    def _stamp(self, t_s: float, at_s: float, *, is_frame: bool) -> float:
        """The time that is written for ``at_s`` at the time ``t_s`` of the plan."""
        for record in self._stamping:
            fault = record.fault
            if not fault.is_active(t_s):
                continue
            before_s = at_s
            at_s = at_s + fault.by_s if isinstance(fault, Jump) else at_s % fault.modulo_s
            if is_frame:
                record.add(t_s, is_changed=at_s != before_s)
        return at_s

    def _raised(self, t_s: float) -> tuple[str, ...]:
        """The names that the frame reports, each once."""
        names: dict[str, None] = {}
        for record in self._raising:
            if record.fault.is_active(t_s):
                record.add(t_s)
                names.update(dict.fromkeys(record.fault.names))
        return tuple(names)

    def deliver(self, t_s: float, frame: RobotFrame | None) -> None:
        """Let ``frame`` leave, if one is due."""
        self.outgoing = NOTHING if frame is None else self._send(t_s, frame)

    def _send(self, t_s: float, frame: RobotFrame) -> Outgoing:
        line = as_line(frame)
        for mark, token in _MARKS:
            line = line.replace(mark, token)
        withheld, self._withheld = self._withheld, b""
        is_lost = is_late = False
        for k, record in enumerate(self._delivery):
            fault = record.fault
            if not fault.is_active(t_s):
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


def _taken(line: bytes) -> Sensors | None:
    """What a client makes of a line, or of its first copy."""
    try:
        message = decode_from_robot(line[: line.index(b"\n")])
    except BadLine:
        return None
    return message if isinstance(message, Sensors) else None
