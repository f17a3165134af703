"""Applies a fault plan to the body, to the sensors and to what leaves the robot.

It draws from its own generator, so that a plan never changes what the world and the sensors draw: up to its first fault
a run with a plan equals the run without it.

A reading is a tuple of numbers: one, or all components of gravity or of the fans. The effect of "no sample" depends on
the list. A wheel without a sample is ``None``, and a row without both wheels is removed. In the lists of the inertial
unit, the edge sensors and gravity the whole row is removed. Fans and battery are in every frame: the last reading, if
any, is repeated.

After the sensors, the faults act on the time stamps and the line, then frames are lost, doubled or reordered. An
invalid line (a token that is not a number, a reading beyond the range of the link) is sent as it is, but counts as not
delivered: in lockstep no client can answer it, and simulated time must not wait for an answer.
"""

from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from functools import partial
from math import inf, sqrt
from typing import Any

import msgspec
import numpy as np

from ccatp.links.robot_codec import BadLine, RobotFrame, decode_from_robot, encode
from ccatp.links.robot_messages import Sensors
from ccatp.mirror.mirror import Mirror
from ccatp.onboard.rules import FanRules
from ccatp.sim.fault_plan import SENSOR_CLOCKS, SIGNALS, FaultPlan, Injected
from ccatp.sim.plant import LEVEL_SLOPE, BodyStep, Disturbance, Plant, downhill
from ccatp.sim.world import World

Reading = tuple[float, ...]
Row = tuple[Any, ...]
"""Time and readings; ``None`` is a wheel without a sample."""

# Numbers that no reading has; in the line each is replaced by its token, which cannot be encoded as a number.
TOKENS = {"NaN": 1.2345678901234567e201, "Infinity": 1.2345678901234567e202, "1e999": 1.2345678901234567e203}
_MARKS = [(msgspec.json.encode(mark), token.encode()) for token, mark in TOKENS.items()]
_BEYOND_DECADES = (3.0, 30.0)  # decades above the range
_LARGEST_INTEGER = 1_000_000
# A sensor fault takes readings from so long before its begin: ``stuck`` repeats the last one, ``delayed`` an old one.
_MEMORY_S = 60.0
_ALWAYS = ("fans", "soc")
_CATCH_UP = 3  # after the fault, rows that arrive late are sent at this multiple of their rate, to fit into a line
_LEAST_CATCH_UP = 10
_BODY_SIGNALS = ("right_wheel", "left_wheel", "right_fan", "left_fan", "body")


def _act_on_side(
    fault: Any, k: int, plant: Plant, fans: FanRules, rates: list[float], grip: list[float], health: list[float]
) -> bool:
    """Apply a lasting fault to the right (0) or left (1) wheel or fan; return whether that changes anything."""
    match fault.type:
        case "blocked":
            is_changed = plant.block(right=k == 0, left=k == 1) or rates[k] != 0.0
            rates[k] = 0.0
        case "runaway":
            is_changed = rates[k] != fault.rate_rad_s
            rates[k] = fault.rate_rad_s
        case "gain":
            is_changed = rates[k] != 0.0
            rates[k] *= fault.factor
        case "slip":
            is_changed = not plant.are_wheels_still or any(rates)
            grip[k] *= fault.factor
        case _:  # weak
            is_changed = fans.duty[1 - k] != 0.0
            health[k] *= fault.share
    return is_changed


class SensorFault:
    """A fault that changes readings; ``past`` contains the readings that it needs later, with their times."""

    def __init__(self, record: Injected, rng: np.random.Generator) -> None:
        self.record, self.fault = record, record.fault
        self._effect = EFFECTS[self.fault.type]
        self.signal, self.rng, self.count = SIGNALS[self.fault.signal], rng, 0
        self.past: deque[tuple[float, Reading]] = deque()
        self._delay_s = self.fault.by_s if self.fault.type == "delayed" else 0.0
        self._is_raw = not self.signal.is_binary or self.fault.type in {"garbage", "non_finite"}
        self._last: Reading | None = None
        self._sees_from_s = self.fault.at_s - _MEMORY_S - self._delay_s

    def apply(self, rows: list[Row], now_s: float) -> list[Row]:
        """The rows with the fault, in the frame of robot time ``now_s``."""
        if not rows or rows[0][0] >= self.fault.end_s or rows[-1][0] < self._sees_from_s:
            return rows
        return [row for row in map(self._row, rows) if row is not None]

    def remember(self, t_s: float, reading: Reading) -> Reading:
        """Store a reading; return the newest one that is at least ``by_s`` old, or else the oldest."""
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
            if self.fault.type in {"stuck", "delayed"}:
                self.remember(t_s, reading)
            self._last = reading
            return row
        found = self._effect(self, t_s, reading)
        if found is not None and not self._is_raw:
            found = tuple(int(x >= 0.5) for x in found)  # an edge sensor reads only 0 or 1
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


def _put(row: Row, columns: tuple[int, ...], values: tuple[Any, ...]) -> Row:
    found = list(row)
    for column, value in zip(columns, values, strict=True):
        found[column] = value
    return tuple(found)


def _stuck(one: SensorFault, t_s: float, reading: Reading) -> Reading:
    if one.fault.value is not None:
        return (one.fault.value,) * len(reading)
    return one.past[0][1] if one.past else one.remember(t_s, reading)


def _garbage(one: SensorFault, t_s: float, reading: Reading) -> Reading:
    rng, signal, count = one.rng, one.signal, len(reading)
    if rng.random() < one.fault.beyond:
        if signal.is_binary:
            return tuple(rng.integers(2, _LARGEST_INTEGER, count).tolist())
        sizes = signal.high * 10.0 ** rng.uniform(*_BEYOND_DECADES, count)
        return tuple((sizes * rng.choice((-1.0, 1.0), count)).tolist())
    if signal.is_binary:
        return tuple(rng.integers(0, 2, count).tolist())
    if signal.rows == "gravity":  # a random direction; only a unit vector is within the range
        direction = rng.standard_normal(count)
        return tuple((direction / sqrt(float(direction @ direction))).tolist())
    return tuple(rng.uniform(signal.low, signal.high, count).tolist())


def _wrong(one: SensorFault, t_s: float, reading: Reading) -> Reading:
    fault = one.fault
    if fault.sign == -1:  # 0 and 1 are exchanged
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


def _saturated(one: SensorFault, t_s: float, reading: Reading) -> Reading:
    low = -inf if one.fault.low is None else one.fault.low
    high = inf if one.fault.high is None else one.fault.high
    return tuple(min(max(x, low), high) for x in reading)


# Functions that replace a reading; ``None``: no sample.
EFFECTS: dict[str, Callable[[SensorFault, float, Reading], Reading | None]] = {
    "off": lambda one, t_s, reading: None,
    "stuck": _stuck,
    "garbage": _garbage,
    "wrong": _wrong,
    "slow": _slow,
    "delayed": SensorFault.remember,  # the reading of ``by_s`` ago, or else the oldest
    "intermittent": _intermittent,
    "saturated": _saturated,
    "non_finite": lambda one, t_s, reading: (TOKENS[one.fault.token],) * len(reading),
}


class LateRows:
    """Delays whole rows of a signal, which keep their own time stamps and their order."""

    def __init__(self, record: Injected) -> None:
        self.record, self.signal = record, SIGNALS[record.fault.signal]
        self._waiting: deque[Row] = deque()

    def apply(self, rows: list[Row], now_s: float) -> list[Row]:
        """As ``SensorFault.apply``."""
        waiting, fault = self._waiting, self.record.fault
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


class Injector:
    """Applies the robot's faults of a plan. ``injected``: their records, in the order of the plan.

    ``drifts``: disturbances of the plant.
    """

    def __init__(self, plan: FaultPlan, mirror: Mirror, rng: np.random.Generator) -> None:
        self.injected = records = tuple(map(Injected, plan.faults))
        self._on: defaultdict[str, list[Injected]] = defaultdict(list)
        self._sensing: list[SensorFault | LateRows] = []
        children = rng.spawn(len(records)) if records else []
        for record, child in zip(records, children, strict=True):
            fault = record.fault
            if fault.signal == "laser":
                continue  # by the simulated laser server
            if fault.signal not in SIGNALS:
                self._on["body" if fault.signal in _BODY_SIGNALS else fault.signal].append(record)
            # Fans and battery are in every frame, without a time of their own, so a delay gives old readings.
            elif fault.type == "delayed" and fault.stamps == "old" and fault.signal not in _ALWAYS:
                self._sensing.append(LateRows(record))
            else:
                self._sensing.append(SensorFault(record, child))
        self._gravity = mirror.gravity_deck
        self.drifts: list[Disturbance] = [
            partial(self._drift, one) for one in self._on["body"] if one.fault.type == "drift"
        ]
        self._has_weak_fan = any(one.fault.type == "weak" for one in records)
        self._begun: set[Injected] = set()
        self._ended: set[Injected] = set()
        self._withheld = b""
        self._seq_0, self._boot_s = 0, 0.0

    def changes(self, t_s: float) -> Iterator[tuple[str, Injected]]:
        """Faults that began or ended since the last call: ``begins`` or ``ended``, and the record.

        A fault without ``for_s``, for example a kidnap or a reboot, never ends.
        """
        for record in self.injected:
            if record not in self._begun:
                if record.from_s is not None:
                    self._begun.add(record)
                    yield "begins", record
            elif record not in self._ended and t_s >= record.fault.end_s:
                self._ended.add(record)
                yield "ended", record

    def act(
        self, world: World, fans: FanRules, t_s: float, set_points_rad_s: tuple[float, float]
    ) -> tuple[float, float]:
        """Wheel rates (right, left) of the next step, rad/s. Also sets body pose, grip and fan health by the faults."""
        rates, grip, health = [*set_points_rad_s], [1.0, 1.0], [1.0, 1.0]  # right, left
        for record in self._on["body"]:
            fault = record.fault
            if fault.type == "kidnap":
                if fault.has_begun(t_s) and not record.samples:
                    world.displace(fault.dx_m, fault.dy_m, fault.dheading_rad)
                    record.add(t_s)
            elif fault.type != "drift" and fault.is_active(t_s):
                is_changed = False
                for k in {"right": (0,), "left": (1,)}.get(fault.signal.partition("_")[0], (0, 1)):
                    is_changed |= _act_on_side(fault, k, world.plant, fans, rates, grip, health)
                record.add(t_s, is_changed=is_changed)
        if self._has_weak_fan:
            fans.health = health[1], health[0]  # the fans' own order
        world.grip = grip[0], grip[1]
        return rates[0], rates[1]

    def _drift(self, record: Injected, plant: Plant, t_s: float, dt_s: float, *moved: float) -> BodyStep:
        """A disturbance of the plant: motion downhill while both set points are zero."""
        forward_m, left_m, turn_rad = moved
        right_set, _, left_set, _ = plant.servo
        if right_set or left_set or not record.fault.is_active(t_s):
            return forward_m, left_m, turn_rad
        ahead, aside, slope = downhill(plant, self._gravity)
        is_level = slope < LEVEL_SLOPE
        record.add(t_s, is_changed=not is_level)
        if is_level:
            return forward_m, left_m, turn_rad
        glide_m = record.fault.speed_m_s * dt_s / slope
        return forward_m + glide_m * ahead, left_m + glide_m * aside, turn_rad

    def reboots(self, t_s: float) -> list[Any]:
        """The planned reboots that are due now; each is due once."""
        due = [record for record in self._on["robot"] if record.fault.has_begun(t_s) and not record.samples]
        for record in due:
            record.add(t_s)
        return [record.fault for record in due]

    def reboot(self, seq: int, t_s: float) -> None:
        """Count frames from ``seq`` and times from ``t_s`` from now on."""
        self._seq_0, self._boot_s = seq, t_s
        self._withheld = b""

    def sense(self, frame: RobotFrame) -> RobotFrame:
        """The frame with the faults of sensors, clock and reported names."""
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
            rows[one.signal.rows] = one.apply(rows[one.signal.rows], t_s)
        for name in ("imu", "enc", "edge", "gravity"):
            rows[name] = [(self._stamp(t_s, row[0] - self._boot_s, is_frame=False), *row[1:]) for row in rows[name]]
        for signal, name in SENSOR_CLOCKS.items():
            for record in self._on[signal]:
                if record.fault.is_active(t_s):
                    record.add(t_s, is_changed=bool(rows[name]))
                    rows[name] = [(max(row[0] + record.fault.by_s, 0.0), *row[1:]) for row in rows[name]]
        _, left, right = rows["fans"][-1]
        return RobotFrame(
            frame.seq - self._seq_0,
            self._stamp(t_s, t_s - self._boot_s, is_frame=True),
            imu=rows["imu"],
            enc=rows["enc"],
            edge=rows["edge"],
            gravity=rows["gravity"][-1] if rows["gravity"] else None,
            fans=(left, right),
            soc=rows["soc"][-1][1],
            cmd=frame.cmd,
            faults=self._raised(t_s),
        )

    def _stamp(self, t_s: float, at_s: float, *, is_frame: bool) -> float:
        """The time stamp for ``at_s``, which counts from the boot, at the time ``t_s`` of the plan."""
        for record in self._on["clock"]:
            fault = record.fault
            if not fault.is_active(t_s):
                continue
            before_s = at_s
            at_s = at_s + fault.by_s if fault.type == "jump" else at_s % fault.modulo_s
            if is_frame:
                record.add(t_s, is_changed=at_s != before_s)
        return at_s

    def _raised(self, t_s: float) -> tuple[str, ...]:
        """The fault names that the frame reports, each once."""
        names: dict[str, None] = {}
        for record in self._on["faults"]:
            if record.fault.is_active(t_s):
                record.add(t_s)
                names.update(dict.fromkeys(record.fault.names))
        return tuple(names)

    def deliver(self, t_s: float, frame: RobotFrame | None) -> tuple[bytes, Sensors | None]:
        """The bytes that leave when ``frame`` is due (no, one or several lines), and its message if it is valid."""
        if frame is None:
            return b"", None
        line = encode(frame)
        for mark, token in _MARKS:
            line = line.replace(mark, token)
        withheld, self._withheld = self._withheld, b""
        is_lost = is_late = False
        for record in self._on["frames"]:
            fault = record.fault
            if not fault.is_active(t_s):
                continue
            is_hit = (record.samples + 1) % fault.every == 0
            record.add(t_s, is_changed=is_hit)
            if is_hit and fault.type == "drop":
                is_lost = True
            elif is_hit and fault.type == "duplicate":
                line += line
            elif is_hit:
                is_late = not withheld
        if is_lost:
            return withheld, None
        if is_late:
            self._withheld = line
            return b"", None
        try:
            message = decode_from_robot(line[: line.index(b"\n")])
        except BadLine:
            message = None
        return line + withheld, message if isinstance(message, Sensors) else None
