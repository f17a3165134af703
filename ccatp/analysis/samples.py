"""The samples of a robot's sensors, as they were received, on the axis of mission time."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from ccatp.analysis.table import Table, table_of_rows
from ccatp.core import EdgeSample, GravitySample, ImuSample, WheelSample
from ccatp.records.run_reader import RecordedFrame

Row = Sequence[Any]


class SampleKind(NamedTuple):
    """Samples of one kind: the names of their values, and the values of each sample in a frame.

    The first value is the time of the sample by the robot's clock, s.
    """

    names: tuple[str, ...]
    rows: Callable[[RecordedFrame], Iterable[Row]]
    texts: tuple[str, ...] = ()  # those of the values that are texts


class SessionFrames(NamedTuple):
    """The frames of one recording.

    ``number``: of the recording, from 1. ``offset_s``: time of the run less that of the recording.
    """

    number: int
    offset_s: float
    frames: Iterable[RecordedFrame]


def _gravity(frame: RecordedFrame) -> Iterator[Row]:
    if frame.sensors.gravity is not None:
        yield frame.sensors.gravity


def _state(frame: RecordedFrame) -> Iterator[Row]:
    sensors = frame.sensors
    command = sensors.cmd
    yield (
        sensors.t, *sensors.fans, sensors.soc, command.seq, command.age, command.permit_age, command.held,
        sensors.sliding, " ".join(sensors.faults),
    )  # fmt: skip


_STATE = (
    "t_s", "fan_left", "fan_right", "state_of_charge", "drive_seq", "drive_age_s", "permit_age_s", "is_held",
    "is_sliding", "faults",
)  # fmt: skip
# Of every robot. ``frame``: the state of the robot, a row for each frame.
KINDS: Mapping[str, SampleKind] = {
    "imu": SampleKind(ImuSample._fields, lambda frame: frame.sensors.imu),
    "enc": SampleKind(WheelSample._fields, lambda frame: frame.sensors.enc),
    "edge": SampleKind(EdgeSample._fields, lambda frame: frame.sensors.edge),
    "gravity": SampleKind(GravitySample._fields, _gravity),
    "frame": SampleKind(_STATE, _state),
}
_DESCRIPTIONS = {
    "session": "number of the recording, from 1; a run that was resumed has several",
    "frame": "number of the frame in its recording, which grows also where the robot restarts",
    "t_s": "mission time of the run at the sample",
}


def samples(name: str, sessions: Iterable[SessionFrames], kinds: Mapping[str, SampleKind]) -> Table:
    """The samples of one kind, in the order in which they were received, with session, frame and mission time.

    Raises ValueError: there is no such kind.
    """
    kind = kinds.get(name)
    if kind is None:
        raise ValueError(f"no samples named {name!r}; there are {', '.join(kinds)}")
    rows = (
        (session.number, frame.number, session.offset_s + frame.t_s + t_s - frame.sensors.t, *values)
        for session in sessions
        for frame in session.frames
        for t_s, *values in kind.rows(frame)
    )
    return table_of_rows(("session", "frame", "t_s", *kind.names[1:]), rows, _DESCRIPTIONS, kind.texts)
