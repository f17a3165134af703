"""The axis of a recording: one time that always rises, and one identity for each frame.

The robot's own numbers and times do not always rise: it restarts, its clock is set, and a 32-bit counter of
microseconds wraps every 71.6 minutes. Readers join, sort and subtract by the numbers and times given here.

* The *number* of a frame rises over the whole recording. It equals the robot's ``seq`` until the robot restarts, and
  counts on from there.
* *Mission time* equals the robot's clock until it first steps or restarts, and goes on from there by the period of the
  frames. The time in which the robot was off is not part of it. UTC is a label that may step, see ``utc_ns``.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np

from ccatp.core import FloatArray, IntArray, Verdict
from ccatp.links import topics
from ccatp.links.bus_codec import BadMessage
from ccatp.records.recorder import decode_recorded, iter_logged

# A step of the clock differs from the period of the frames by more than this, s, and by more than twice the greatest
# error of the robot's clock rate (1 %) over the frames in between. The mission's own clock has the same limit.
STEP_S, STEP_SHARE = 0.1, 0.02
# Events are recorded at once and frames in batches of a hundred: an event and its frame are closer than this.
NEAR_FRAMES = 512
# No sample is older than its frame by more than this, s, or later by more than the rounding of its time.
OLDEST_SAMPLE_S, ROUNDING_S = 1.0, 1.5e-3
# The recorder corrects UTC by the drift of ten seconds; a larger correction follows a step of the robot's clock.
_UTC_DRIFT_NS = 200_000_000
_NS = 1e9
_NAMED = 3  # steps that are named one by one


class FrameId(NamedTuple):
    """Identity of a frame.

    ``boot`` and ``session`` are the robot's own numbers. In a recording that does not hold them, ``boot`` counts the
    restarts from 0, and ``session`` is 0.
    """

    boot: int
    session: int
    seq: int


class ClockStep(NamedTuple):
    """The robot restarted, or its clock stepped by ``by_s``, before frame ``number`` at mission time ``t_s``."""

    kind: Literal["restart", "clock"]
    number: int
    t_s: float
    by_s: float


class LoggedMessage(NamedTuple):
    """A recorded message with its place in the recording, from which its frame is found."""

    place: int
    topic: str
    t_s: float
    payload: bytes


def iter_places(path: Path, on_damage: Callable[[str], None] | None = None) -> Iterator[LoggedMessage]:
    """All intact messages of a recording in their order; as ``iter_logged``."""
    for place, (_, message) in enumerate(iter_logged(path, on_damage)):
        yield LoggedMessage(place, *message)


class _Stamp(msgspec.Struct):
    """What a sensors line says of itself."""

    seq: int
    t: float


_decode_stamp = msgspec.json.Decoder(_Stamp).decode


@cache
def _is_batch(topic: str) -> bool:
    """Whether a topic has estimates, a row for each frame."""
    row = topics.find_topic(topic)
    return row is not None and issubclass(row.message, topics.TrackBatch)


@cache
def _is_read(topic: str) -> bool:
    """Whether the first pass reads a topic."""
    row = topics.find_topic(topic)
    read = topics.SensorLines, topics.SessionMessage, topics.TrackBatch, topics.TruthBatch
    return row is not None and issubclass(row.message, read)


@dataclass(slots=True)
class _Found:
    """What the first pass collects: lines of the robot, batches of estimates, sessions, labels of UTC."""

    places: list[int] = field(default_factory=list)  # of the message with the line, for each line
    seq: list[int] = field(default_factory=list)
    t_s: list[float] = field(default_factory=list)
    # Of each batch of estimates: place, seq of the newest frame, its recorded number.
    batches: list[tuple[int, int, int]] = field(default_factory=list)
    sessions: list[tuple[int, topics.SessionMessage]] = field(default_factory=list)
    utc: list[tuple[int, int]] = field(default_factory=list)  # number of lines so far, UTC of the last one, ns
    boots: list[int] = field(default_factory=list)  # recorded numbers at which the simulated robot booted

    def take(self, place: int, topic: str, payload: bytes, utc_ns: int | None) -> None:
        """Add a message; ``BadMessage``: it cannot be read."""
        message = decode_recorded(topic, payload)
        if isinstance(message, topics.SensorLines):
            try:
                stamps = [_decode_stamp(line) for line in message.lines]
            except msgspec.MsgspecError as error:
                raise BadMessage(str(error)) from error
            self.places += [place] * len(stamps)
            self.seq += [stamp.seq for stamp in stamps]
            self.t_s += [stamp.t for stamp in stamps]
            if utc_ns is not None and stamps:
                self.utc.append((len(self.seq), utc_ns))
        elif isinstance(message, topics.TrackBatch) and message.rows:
            self.batches.append((place, message.seq, message.rows[-1][0]))
        elif isinstance(message, topics.SessionMessage):
            self.sessions.append((place, message))
        elif isinstance(message, topics.TruthMessage):
            self.boots = message.boots or self.boots

    def use_tracks(self, path: Path) -> None:
        """Take the frames from the estimates, where no line of the robot is left."""
        for place, topic, _, payload in iter_places(path):
            if _is_batch(topic):
                try:
                    message: Any = decode_recorded(topic, payload)
                except BadMessage:
                    continue
                self.places += [place] * len(message.rows)
                self.seq += [row[0] for row in message.rows]
                self.t_s += [row[1] for row in message.rows]
        self.batches, self.sessions = [], []


class Timeline:
    """Numbers and times of the frames of one recording.

    ``number`` and ``t_s``: of each frame once, both rising, shape (k,); ``robot_t_s``: its time by the robot's clock.
    ``steps``: restarts of the robot and steps of its clock. ``missing``: frames that the recording lacks in between.
    ``unknown_from``: number from which frames cannot be joined to the simulated truth, or None. ``notes``: what a
    reader has to know about the axis, one line each. ``damages``: where the file is damaged, one line each.
    """

    def __init__(self, found: _Found, *, is_simulation: bool, damages: Sequence[str] = ()) -> None:
        self.damages = tuple(damages)
        self._places, self._seq = found.places, np.array(found.seq, dtype=np.int64)
        raw_s = np.array(found.t_s, dtype=np.float64)
        offsets = [(self._index(place, seq), number - seq) for place, seq, number in found.batches]
        offsets += [
            (bisect_right(self._places, place), message.frames_before)
            for place, message in found.sessions
            if place < (self._places[-1] if self._places else -1)
        ]
        self._offsets = sorted((index, offset) for index, offset in offsets if index is not None)
        self._session_places = [place for place, _ in found.sessions]
        self._starts = self._find_starts(raw_s, found)
        self.unknown_from: int | None = None
        self._base = self._bases(found)
        part = np.searchsorted(self._starts, np.arange(len(self._seq)), side="right") - 1
        self._number = self._seq + np.array(self._base, dtype=np.int64)[part] if len(part) else self._seq
        self._ids = self._identities(found)
        newest = np.maximum.accumulate(self._number) if len(part) else self._number
        is_new = np.diff(newest, prepend=-1 if not len(part) else newest[0] - 1) > 0
        self.number, self.robot_t_s = self._number[is_new], raw_s[is_new]
        self.steps: tuple[ClockStep, ...]
        self.period_s, self.t_s, self.steps = _risen(self.number, self.robot_t_s, self._first_numbers())
        self.missing = self._count_missing()
        self._shifts = self._track_shifts(found)
        self._utc = self._anchors(found, is_simulation=is_simulation)
        self._utc_s = np.array([at_s for at_s, _ in self._utc])
        self._utc_past_ns = np.array([zero_ns - self._utc[0][1] for _, zero_ns in self._utc], dtype=np.float64)
        self.notes = tuple(self._say(is_inferred=not found.sessions))

    @property
    def has_restart(self) -> bool:
        """The robot restarted within the recording, so its own numbers do not name a frame."""
        return any(step.kind == "restart" for step in self.steps)

    # -- the frame of a message -----------------------------------------------------------------------------------

    def _index(self, place: int, seq: int) -> int | None:
        """Index of the line of frame ``seq`` that is near to a message at ``place``; None if there is none."""
        at = bisect_right(self._places, place)
        if at and self._seq[at - 1] == seq:
            return at - 1
        ahead = np.flatnonzero(self._seq[at : at + NEAR_FRAMES] == seq)
        if len(ahead):
            return at + int(ahead[0])
        behind = np.flatnonzero(self._seq[max(at - NEAR_FRAMES, 0) : at] == seq)
        return max(at - NEAR_FRAMES, 0) + int(behind[-1]) if len(behind) else None

    def number_at(self, place: int, seq: int, *, is_main: bool = True) -> int:
        """Number of frame ``seq`` of the robot, as a message at ``place`` of the recording names it.

        ``is_main``: main sent it, so it follows the batches and sessions that were recorded before it. A message of
        another process may be a little older.
        """
        count = len(self._seq)
        if not count:
            return seq
        at = bisect_right(self._places, place)
        if seq < 0 and not at:
            return -1
        if seq < 0:  # no frame since the robot restarted
            later = [start for start in self._starts if at <= start < at + NEAR_FRAMES]
            return int(self._number[(later[0] if later else at) - 1])
        session = bisect_right(self._session_places, place)
        begin, end = (self._first_line(session - 1) if session else 0), self._first_line(session)
        if begin < at and self._seq[at - 1] == seq:
            return int(self._number[at - 1])
        ahead = np.flatnonzero(self._seq[max(at, begin) : min(at + NEAR_FRAMES, end)] == seq)
        if len(ahead):
            return int(self._number[max(at, begin) + int(ahead[0])])
        index = None if is_main else self._index(place, seq)
        if index is not None:
            return int(self._number[index])
        # Its line is lost. It is of the boot of its session; without sessions it is not older than the last batch.
        part = bisect_right(self._starts, min(max(begin, at - 1, 0), count - 1)) - 1
        is_next = not session and at > 0 and seq < self._seq[at - 1] and is_main
        return int(self._base[min(part + is_next, len(self._base) - 1)] + seq)

    def _first_line(self, session: int) -> int:
        """Index of the first line after a session began."""
        if session >= len(self._session_places):
            return len(self._places)
        return bisect_right(self._places, self._session_places[session])

    def line_numbers(self, place: int, seqs: Sequence[int]) -> list[int]:
        """Numbers of the frames whose lines are in the message at ``place``, in their order."""
        begin, end = bisect_left(self._places, place), bisect_right(self._places, place)
        if self._seq[begin:end].tolist() == list(seqs):
            return [int(number) for number in self._number[begin:end].tolist()]
        return [self.number_at(place, seq) for seq in seqs]

    def frame_id(self, index: int) -> FrameId:
        """Identity of the frame ``number[index]``."""
        line = int(np.searchsorted(np.maximum.accumulate(self._number), self.number[index]))
        return self._ids(line)

    # -- time -----------------------------------------------------------------------------------------------------

    def at(self, number: int) -> float:
        """Mission time of a frame, s."""
        at = int(self.number.searchsorted(number))
        if at < len(self.number) and self.number[at] == number:
            return float(self.t_s[at])
        return float(self.times(np.array([number], dtype=np.float64))[0])

    def times(self, numbers: IntArray | FloatArray) -> FloatArray:
        """Mission times of frames, s, shape (k,); those between and beyond the recorded ones by the frame period."""
        if not len(self.number):
            return np.asarray(numbers * self.period_s, dtype=np.float64)
        found = np.interp(numbers, self.number, self.t_s)
        early, late = np.minimum(numbers - self.number[0], 0), np.maximum(numbers - self.number[-1], 0)
        return np.asarray(found + (early + late) * self.period_s)

    def sample_s(self, number: int, frame_s: float, sample_s: float) -> float | None:
        """Mission time of a sample of a frame, from both robot times; None for a time that cannot be.

        A sample from before a step of the clock still has the time of before it.
        """
        at = int(self.number.searchsorted(number))
        now_s = self.at(number)
        own_s = now_s + (sample_s - frame_s)
        if not -OLDEST_SAMPLE_S <= own_s - now_s <= ROUNDING_S:
            if not at or at >= len(self.number):
                return None
            own_s = sample_s + float(self.t_s[at - 1] - self.robot_t_s[at - 1])
        return own_s if -OLDEST_SAMPLE_S <= own_s - now_s <= ROUNDING_S else None

    def utc_ns(self, t_s: float) -> int | None:
        """UTC of a mission time, ns since 1970, which rises with it; None in recordings without UTC.

        It goes on by mission time where the robot's clock steps, and by the labels of the recording where the robot
        restarts.
        """
        if not self._utc:
            return None
        if len(self._utc) == 1:
            return round(t_s * _NS) + self._utc[0][1]
        past_ns = np.interp(t_s, self._utc_s, self._utc_past_ns)
        return round(t_s * _NS) + self._utc[0][1] + round(float(past_ns))

    # -- messages on the axis -------------------------------------------------------------------------------------

    def on_axis(self, place: int, message: topics.Message | Verdict) -> Any:
        """The message with the frame's number as ``seq`` and its mission time as ``t_s``, in its rows, too.

        Rows of the simulated truth that cannot be joined to a frame are left out.
        """
        if not isinstance(message, topics.Message):
            return message
        if isinstance(message, topics.TrackBatch | topics.TruthBatch):
            is_truth = isinstance(message, topics.TruthBatch)
            if not message.rows:
                return message
            numbers = self.row_numbers(place, [row[0] for row in message.rows], is_truth=is_truth)
            times_s = self.times(numbers).tolist()
            rows = [
                (number, t_s, *row[2:])
                for number, t_s, row in zip(numbers.tolist(), times_s, message.rows, strict=True)
                if number >= 0
            ]
            newest = rows[-1][:2] if rows else (message.seq, message.t_s)
            return msgspec.structs.replace(message, rows=rows, seq=newest[0], t_s=newest[1])
        if isinstance(message, topics.Reached):  # with the number that main recorded
            number = int(self.row_numbers(place, [message.seq])[0])
        else:
            number = self.number_at(place, message.seq, is_main=not isinstance(message, topics.DangerEvent))
        if number < 0 or not len(self.number):
            return message
        return msgspec.structs.replace(message, seq=number, t_s=self.at(number))

    def row_numbers(self, place: int, recorded: Sequence[float], *, is_truth: bool = False) -> IntArray:
        """Numbers of frames from those that main or the simulation recorded in rows; -1 for those that no frame has."""
        numbers = np.array(recorded, dtype=np.float64)
        if is_truth:
            if self.unknown_from is not None:
                numbers[numbers >= self.unknown_from] = -1
            return np.asarray(numbers, dtype=np.int64)
        if self._shifts:
            after = bisect_left(self._shifts, (place,))
            shift, before = self._shifts[min(after, len(self._shifts) - 1)][1], self._shifts[max(after - 1, 0)][1]
            if shift == before:
                return np.asarray(numbers + shift, dtype=np.int64)
            # The batch of a restart: rows from before it, which end where the numbers meet, have the earlier shift.
            firsts = self._first_numbers()
            first = max((one for one in firsts if one <= numbers[-1] + shift), default=0)
            descents = np.flatnonzero(np.diff(numbers) <= 0)
            cut = int(descents[-1]) + 1 if len(descents) else int(np.searchsorted(numbers + shift, first))
            numbers[:cut] += before
            numbers[cut:] += shift
        return np.asarray(numbers, dtype=np.int64)

    # -- construction ---------------------------------------------------------------------------------------------

    def _find_starts(self, raw_s: FloatArray, found: _Found) -> list[int]:
        """Indices of the first line of each boot of the robot."""
        seq = self._seq
        if not len(seq):
            return [0]
        steps = np.diff(seq)
        starts = {0, *(np.flatnonzero((steps < 0) | ((steps == 0) & (np.diff(raw_s) != 0.0))) + 1).tolist()}
        for (_, one), (place, other) in zip(found.sessions, found.sessions[1:], strict=False):
            first = bisect_right(self._places, place)
            if one.boot != other.boot and 0 < first < len(seq):
                starts.add(first)
        for (one_at, one_offset), (at, offset) in zip(self._offsets, self._offsets[1:], strict=False):
            # Main counted on after a restart that is not seen in the lines, because those around it are missing.
            if offset > one_offset and at > one_at and not any(one_at < start <= at for start in starts):
                starts.add(one_at + 1 + int(np.argmax(steps[one_at:at])))
        return sorted(starts)

    def _first_numbers(self) -> list[int]:
        return [int(self._number[start]) for start in self._starts] if len(self._seq) else []

    def _offset_of(self, part: int) -> int | None:
        """The number of frames that main counted before a boot of the robot; None if no batch of it is left."""
        ends = [*self._starts[1:], len(self._seq)]
        inside = [offset for index, offset in self._offsets if self._starts[part] <= index < ends[part]]
        return inside[-1] if inside else None

    def _bases(self, found: _Found) -> list[int]:
        """Number of a frame less its ``seq``, for each boot of the robot."""
        first = self._offset_of(0) if len(self._seq) else 0
        bases, before = [first or 0], first
        for part, start in enumerate(self._starts[1:], 1):
            last = int(self._seq[start - 1]) + bases[-1]
            offset = self._offset_of(part)
            if part < len(found.boots) and found.boots[0] == 0 and len(found.boots) == len(self._starts):
                base = found.boots[part]
            elif offset is not None and before is not None and offset > before:
                base = bases[-1] + offset - before
            else:
                base = last
                if self.unknown_from is None:
                    self.unknown_from = last + 1
            before = offset if offset is not None else before
            bases.append(max(base, last + 1 - int(self._seq[start])))
        return bases

    def _identities(self, found: _Found) -> Callable[[int], FrameId]:
        firsts = [bisect_right(self._places, place) for place, _ in found.sessions]

        def identity(line: int) -> FrameId:
            seq, at = int(self._seq[line]), bisect_right(firsts, line) - 1
            if at < 0:
                return FrameId(bisect_right(self._starts, line) - 1, 0, seq)
            return FrameId(found.sessions[at][1].boot, found.sessions[at][1].session, seq)

        return identity

    def _track_shifts(self, found: _Found) -> list[tuple[int, int]]:
        """Place of each batch of estimates, and the number of its frames less the recorded one."""
        return [(place, self.number_at(place, seq) - recorded) for place, seq, recorded in found.batches]

    def _count_missing(self) -> int:
        steps = np.diff(self.number) - 1
        unknown = self.unknown_from
        known = steps if unknown is None else steps[self.number[1:] != unknown]
        return int(known.sum())

    def _anchors(self, found: _Found, *, is_simulation: bool) -> list[tuple[float, int]]:
        """Mission times, and the UTC of mission time 0 there, ns."""
        anchors: list[tuple[float, int]] = []
        part = 0
        for lines, utc_ns in found.utc:
            t_s = self.at(int(self._number[lines - 1]))
            zero_ns = utc_ns - round(t_s * _NS)
            own = bisect_right(self._starts, lines - 1) - 1
            if not anchors:
                anchors.append((t_s, zero_ns))
            elif is_simulation:
                continue
            elif own != part:
                begin_s = self.at(int(self._number[self._starts[own]]))
                anchors.append((begin_s - self.period_s, anchors[-1][1]))
                anchors.append((begin_s, max(anchors[-1][1], zero_ns)))
            elif zero_ns != anchors[-1][1] and abs(zero_ns - anchors[-1][1]) <= _UTC_DRIFT_NS and t_s > anchors[-1][0]:
                anchors.append((t_s, zero_ns))
            part = own
        return anchors

    def _say(self, *, is_inferred: bool) -> Iterator[str]:
        for step in self.steps[:_NAMED]:
            where = f"before frame {step.number} ({step.t_s:.2f} s of mission time)"
            if step.kind == "restart":
                how = ", inferred from its frame numbers" if is_inferred else ""
                yield f"the robot restarted {where}{how}; times continue there without the time that it was off"
            else:
                yield f"the robot's clock stepped by {step.by_s:+.3f} s {where}; times continue without the step"
        if len(self.steps) > _NAMED:
            yield f"{len(self.steps) - _NAMED} more restarts and steps of the robot's clock; times continue likewise"
        if self.unknown_from is not None:
            yield f"the frames from number {self.unknown_from} on cannot be joined to a truth, which is not used there"


def first_of_each(numbers: IntArray | FloatArray) -> IntArray:
    """Indices of the rows with the first occurrence of each frame, in the order of the frames, shape (k,)."""
    return np.asarray(np.unique(numbers, return_index=True)[1])


def rows_of(numbers: IntArray | FloatArray, wanted: Sequence[float] | IntArray | FloatArray) -> IntArray:
    """Index of each wanted frame among rising numbers, -1 where it is missing, shape (k,)."""
    sought = np.asarray(wanted)
    if not len(numbers):
        return np.full(len(sought), -1)
    at = np.minimum(np.searchsorted(numbers, sought), len(numbers) - 1)
    return np.where(np.asarray(numbers)[at] == sought, at, -1)


def row_before(numbers: IntArray | FloatArray, wanted: float) -> int:
    """Index of the newest frame up to ``wanted`` among rising numbers; -1 if all are newer."""
    return int(np.searchsorted(numbers, wanted, side="right")) - 1


def common_rows(one: IntArray | FloatArray, other: IntArray | FloatArray) -> tuple[IntArray, IntArray]:
    """Indices of the frames that two tables have in common, in the order of the frames, each shape (k,)."""
    _, here, there = np.intersect1d(one, other, return_indices=True)
    return here, there


def _risen(
    number: IntArray, robot_s: FloatArray, firsts: Sequence[int]
) -> tuple[float, FloatArray, tuple[ClockStep, ...]]:
    """Period of the frames, their mission times, and the steps between them."""
    frames, passed_s = np.diff(number), np.diff(robot_s)
    usual = passed_s[(frames == 1) & (passed_s > 0.0)]
    period_s = float(np.median(usual)) if len(usual) else 0.01
    expected_s = frames * period_s
    is_restart = np.isin(number[1:], firsts)
    is_step = (passed_s <= 0.0) | (np.abs(passed_s - expected_s) > STEP_S + STEP_SHARE * expected_s)
    is_step |= is_restart
    offset_s = np.concatenate([np.zeros(min(1, len(number))), np.cumsum(np.where(is_step, expected_s - passed_s, 0.0))])
    t_s = robot_s + offset_s
    steps = tuple(
        ClockStep(
            "restart" if is_restart[at] else "clock",
            int(number[at + 1]),
            float(t_s[at + 1]),
            float(passed_s[at] - expected_s[at]),
        )
        for at in np.flatnonzero(is_step).tolist()
    )
    return period_s, t_s, steps


def read_timeline(path: Path, *, is_simulation: bool) -> Timeline:
    """The axis of a recording; ``OSError``: it cannot be read. Messages that cannot be read are left out."""
    found, damages = _Found(), list[str]()
    for place, (utc_offset_ns, (topic, t_s, payload)) in enumerate(iter_logged(path, damages.append)):
        if _is_read(topic):
            utc_ns = None if utc_offset_ns is None else utc_offset_ns + round(t_s * _NS)
            try:
                found.take(place, topic, payload, utc_ns)
            except BadMessage:
                continue  # a reader of the message says so
    if not found.seq:
        found.use_tracks(path)
    return Timeline(found, is_simulation=is_simulation, damages=damages)
