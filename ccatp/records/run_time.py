"""The time of a run: one axis for all its recordings, also of a run that was resumed."""

from collections.abc import Iterable, Sequence
from math import nan
from typing import NamedTuple

from ccatp.links.topics import MissionStatus
from ccatp.records.timeline import Timeline


class RecordingPlace(NamedTuple):
    """A recording on the axis of its run.

    ``number``: from 1, in the order of the recordings. ``offset_s``: time of the run less that of the recording.
    """

    name: str
    number: int
    offset_s: float


def places_of(timelines: Iterable[tuple[str, Timeline | None]]) -> tuple[RecordingPlace, ...]:
    """Put recordings, the oldest first, on the axis of their run; no timeline: one that cannot be read.

    The axis is the mission time of the first recording with frames. Each later one begins a frame after the end of the
    one before it: the time in which no program ran is not part of it.
    """
    found: list[RecordingPlace] = []
    end_s: float | None = None
    for number, (name, timeline) in enumerate(timelines, start=1):
        offset_s = 0.0
        if timeline is not None and len(timeline.t_s):
            if end_s is not None:
                offset_s = end_s + timeline.period_s - float(timeline.t_s[0])
            end_s = float(timeline.t_s[-1]) + offset_s
        found.append(RecordingPlace(name, number, offset_s))
    return tuple(found)


class AlarmTimes:
    """When alarms began and ended by the time of a run, as the recorded statuses show it.

    ``statuses``: each with its time, s, in their order. An alarm has a time from the first status that lists it.
    """

    def __init__(self, statuses: Sequence[tuple[float, MissionStatus]]) -> None:
        self._raised_s: dict[tuple[str, str], float] = {}
        self._ended_s: dict[tuple[str, str], float] = {}
        active = set[tuple[str, str]]()
        for t_s, status in statuses:
            if status.seq < 0:  # no frame yet
                continue
            listed = {(alarm.name, alarm.since): bool(alarm.ended) for alarm in status.alarms}
            for key in listed:
                self._raised_s.setdefault(key, t_s)
            now_active = {key for key, is_over in listed.items() if not is_over}
            for key in (listed.keys() | active) - now_active:
                self._ended_s.setdefault(key, t_s)
            active = now_active

    def raised_s(self, name: str, utc: str) -> float:
        """Time at which the alarm that was raised at ``utc`` was first listed, s; NaN if no status lists it."""
        return self._raised_s.get((name, utc), nan)

    def ended_s(self, name: str, utc: str) -> float:
        """Time at which it was first listed as over, or no longer, s; NaN if no status shows that."""
        return self._ended_s.get((name, utc), nan)
