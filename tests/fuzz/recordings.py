"""Recordings of one survey as they would be if the robot had restarted, its clock had stepped, or a chunk was damaged.

What the robot measured, and what main did with it, stays the same: only the robot's own numbers and times change, as
the robot and the main loop would have written them. So every reader has to give the values of the whole recording.
"""

import json
import random
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from mcap.opcode import Opcode

from ccatp.records.recorder import MAGIC, TELEMETRY, Recorder, iter_messages, read_metadata
from tests.support.recorded import recorder_in

KINDS = ("reboot", "wrap", "back", "ahead", "damage")
_BYTES = 9  # of a record's head: opcode and length
FIRST_BOOT = 41
EVENTS = frozenset(("rest", "fix", "treatment", "arrival", "mission"))


class Event(NamedTuple):
    """After frame ``number`` the robot restarts or its clock steps by ``by_s``; a wrap has the period ``by_s``."""

    kind: str
    number: int
    by_s: float = 0.0


@dataclass(frozen=True)
class Spoiling:
    """One case: events in the order of their frames, damaged chunks by their share of the file, old or new format."""

    events: tuple[Event, ...]
    damaged: tuple[float, ...] = ()
    has_sessions: bool = True
    is_batch_split: bool = True  # old recordings have batches that go over a restart

    @property
    def name(self) -> str:
        """For a list of cases."""
        kinds = [f"{one.kind}@{one.number}" for one in self.events] + [f"damage@{at:.2f}" for at in self.damaged]
        return "+".join(kinds) + ("" if self.has_sessions else ", old")


def cases(frames: int, seed: int, count: int) -> list[Spoiling]:
    """Random combinations of one to three kinds; every kind and every pair of kinds comes in the first cases."""
    rng = random.Random(seed)
    pairs = [(one, other) for k, one in enumerate(KINDS) for other in KINDS[k:]]
    wanted: list[tuple[str, ...]] = [*((kind,) for kind in KINDS), *pairs]
    while len(wanted) < count:
        wanted.append(tuple(rng.choice(KINDS) for _ in range(3)))
    return [_case(kinds, frames, rng, is_old=bool(k % 2)) for k, kinds in enumerate(wanted[:count])]


def _case(kinds: Sequence[str], frames: int, rng: random.Random, *, is_old: bool) -> Spoiling:
    numbers = sorted(rng.sample(range(frames // 10, 9 * frames // 10), len(kinds)))
    events, damaged = list[Event](), list[float]()
    for kind, number in zip(kinds, numbers, strict=True):
        if kind == "damage":
            damaged.append(rng.uniform(0.1, 0.9))
        else:
            by_s = {
                "reboot": 0.0,
                "wrap": rng.uniform(0.2, 0.7) * 0.01 * frames,
                "back": -rng.uniform(0.2, 20.0),
                "ahead": rng.uniform(0.2, 600.0),
            }[kind]
            events.append(Event(kind, number, by_s))
    is_split = not is_old or rng.random() < 0.5
    return Spoiling(tuple(events), tuple(damaged), has_sessions=not is_old, is_batch_split=is_split)


class Clock:
    """Boot, ``seq`` and time of the robot for the frames of the whole recording, and the mission's time in a boot."""

    def __init__(self, spoiling: Spoiling, time_of: Mapping[int, float]) -> None:
        self._events, self._time_of = spoiling.events, time_of
        self.restarts = [event.number for event in spoiling.events if event.kind == "reboot"]

    def boot(self, number: int) -> int:
        """Restarts before a frame."""
        return sum(number > at for at in self.restarts)

    def seq(self, number: int) -> int:
        """The robot's number of a frame."""
        return number - max((at for at in self.restarts if number > at), default=0)

    def begin_s(self, number: int) -> float:
        """When the boot of a frame began, by the clock of the whole recording."""
        return max((self._time_of[at] for at in self.restarts if number > at), default=-1.0)

    def steady_s(self, number: int, t_s: float) -> float:
        """Time of the mission's clock, which begins again with each boot."""
        return t_s - max((self._time_of[at] for at in self.restarts if number > at), default=0.0)

    def robot_s(self, t_s: float) -> float:
        """The robot's clock; a sample has the time of its own instant."""
        found_s, period_s = t_s, 0.0
        for kind, number, by_s in self._events:
            if t_s <= self._time_of[number] + 1e-9:
                break
            if kind == "reboot":
                found_s = t_s - self._time_of[number]
                period_s = 0.0
            elif kind == "wrap":
                period_s = by_s
            else:  # a clock is not set to before its beginning
                found_s += max(by_s, -(self._now(found_s, t_s, number) - 0.05))
        return found_s % period_s if period_s else found_s

    def _now(self, found_s: float, t_s: float, number: int) -> float:
        return found_s - t_s + self._time_of[number]


def spoil(source: Path, target: Path, spoiling: Spoiling) -> Path:
    """A run directory with the recording of ``source`` as the robot of ``spoiling`` would have left it."""
    shutil.copytree(source, target, ignore=lambda *_: [TELEMETRY])
    path = source / TELEMETRY
    messages = [(topic, json.loads(payload)) for topic, _, payload in iter_messages(path)]
    time_of = {line["seq"]: line["t"] for topic, one in messages if topic == "sensors" for line in one["lines"]}
    clock = Clock(spoiling, time_of)
    metadata = read_metadata(path)
    simulation = metadata.pop("simulation") == "true"
    recorder = recorder_in(target, metadata, is_simulation=simulation)
    _Main(recorder, clock, spoiling).write(messages)
    recorder.close()
    for share in spoiling.damaged:
        _damage(target / TELEMETRY, share)
    return target


class _Main:
    """Writes what main would have sent, in its order."""

    def __init__(self, recorder: Recorder, clock: Clock, spoiling: Spoiling) -> None:
        self._recorder, self._clock, self._spoiling = recorder, clock, spoiling
        self._session = -1
        self._events: list[tuple[str, dict[str, Any]]] = []

    def write(self, messages: Sequence[tuple[str, dict[str, Any]]]) -> None:
        """All messages of the whole recording."""
        tracks = iter([one["rows"] for topic, one in messages if topic == "track"])
        for topic, message in messages:
            if topic == "sensors":
                self._batch(message["lines"], next(tracks))
            elif topic in EVENTS:
                self._events.append((topic, message))
            elif topic == "truth":
                boots = {"boots": [0, *self._clock.restarts]} if self._spoiling.has_sessions else {}
                self._send(topic, {**message, **boots})
            elif topic != "track":
                self._send(topic, message)
        self._send_events(max(message["seq"] for _, message in messages))

    def _send(self, topic: str, message: Mapping[str, Any]) -> None:
        payload = json.dumps(message, separators=(",", ":")).encode()
        self._recorder.write(topic, max(message["t_s"], 0.0), payload)

    def _batch(self, lines: list[dict[str, Any]], rows: list[list[Any]]) -> None:
        clock = self._clock
        for part in _parts([line["seq"] for line in lines], clock, is_split=self._spoiling.is_batch_split):
            own = [line for line in lines if line["seq"] in part]
            # Events are recorded at once, batches later; main begins a session after the batch before it.
            self._begin(part[0])
            self._send_events(part[-1])
            newest = {"seq": clock.seq(part[-1]), "t_s": clock.robot_s(own[-1]["t"])}
            track = [[row[0], clock.robot_s(row[1]), *row[2:]] for row in rows if row[0] in part]
            if track:
                self._send("track", {**newest, "rows": track})
            self._send("sensors", {**newest, "lines": [_line(line, clock) for line in own]})

    def _begin(self, number: int) -> None:
        while self._spoiling.has_sessions and self._session < self._clock.boot(number):
            self._session += 1
            before = ([0, *self._clock.restarts])[self._session]
            ids = {"boot": FIRST_BOOT + self._session, "session": 7, "frames_before": before}
            self._send("session", {"seq": self._clock.seq(before), "t_s": 0.0, **ids})

    def _send_events(self, number: int) -> None:
        for topic, message in self._events:
            if message["seq"] <= number:
                self._send(topic, _event(topic, message, self._clock))
        self._events = [one for one in self._events if one[1]["seq"] > number]


def _parts(numbers: Sequence[int], clock: Clock, *, is_split: bool) -> list[list[int]]:
    """Frames of a batch; one for each boot where the batch ends with it."""
    if not is_split:
        return [list(numbers)]
    boots = dict.fromkeys(clock.boot(number) for number in numbers)
    return [[number for number in numbers if clock.boot(number) == boot] for boot in boots]


def _event(topic: str, message: Mapping[str, Any], clock: Clock) -> dict[str, Any]:
    number, t_s = message["seq"], message["t_s"]
    found = {**message, "t_s": clock.steady_s(number, t_s), "seq": clock.seq(number)}
    if topic == "arrival":
        found["seq"] = number
    if topic in {"fix", "treatment"}:
        found["t_s"] = clock.robot_s(t_s)
    return found


def _line(line: Mapping[str, Any], clock: Clock) -> dict[str, Any]:
    begin_s = clock.begin_s(line["seq"])
    rows = {
        name: [[clock.robot_s(row[0]), *row[1:]] for row in line[name] if row[0] > begin_s]
        for name in ("imu", "enc", "edge")
    }
    gravity = line["gravity"] and [clock.robot_s(line["gravity"][0]), *line["gravity"][1:]]
    return {**line, **rows, "gravity": gravity, "seq": clock.seq(line["seq"]), "t": clock.robot_s(line["t"])}


def _damage(path: Path, share: float) -> None:
    """Change a byte in the middle of the chunk at this share of the file."""
    data = bytearray(path.read_bytes())
    chunks = [(at, end) for at, end, opcode in _records(data) if opcode == Opcode.CHUNK]
    begin, end = chunks[min(int(share * len(chunks)), len(chunks) - 1)]
    data[(begin + end) // 2] ^= 0xFF
    path.write_bytes(data)


def _records(data: bytes | bytearray) -> Iterator[tuple[int, int, int]]:
    at = len(MAGIC)
    while at + _BYTES <= len(data) - len(MAGIC):
        end = at + _BYTES + int.from_bytes(data[at + 1 : at + _BYTES], "little")
        yield at, end, data[at]
        at = end
