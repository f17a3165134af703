"""The axis of a recording: numbers and times that rise over restarts, steps of the clock, and missing frames."""

from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ccatp.links.robot_codec import RobotFrame, encode
from ccatp.links.robot_messages import CommandEcho
from ccatp.links.topics import (
    ArrivalMessage,
    DangerEvent,
    Message,
    MissionStatus,
    Rest,
    SensorLines,
    SessionMessage,
    TrackMessage,
    TruthMessage,
)
from ccatp.records.recorder import Recorder, RobotClock, decode_recorded
from ccatp.records.timeline import FrameId, Timeline, common_rows, iter_places, read_timeline, row_before, rows_of
from tests.support.recorded import recorder_in

STILL = CommandEcho(-1, 0.0, 0.0, False)
PERIOD_S = 0.01
NS = 1_000_000_000


def lines(seqs: Sequence[int], t_s: Callable[[int], float] = lambda seq: PERIOD_S * seq) -> SensorLines:
    """A batch of the robot's lines; ``t_s``: its clock at each frame."""
    raw = [
        msgspec.Raw(encode(RobotFrame(seq, t_s(seq), [], [], [], None, (0.0, 0.0), 1.0, STILL, ())).strip())
        for seq in seqs
    ]
    return SensorLines(seq=seqs[-1], t_s=t_s(seqs[-1]), lines=raw)


def track(seqs: Sequence[int], before: int = 0) -> TrackMessage:
    """The estimates of a batch, which main numbers from ``before``."""
    rows = [(seq + before, PERIOD_S * seq, 1, 2, 0.001 * seq, 0.0, 0.0, 1e-3) for seq in seqs]
    return TrackMessage(seq=seqs[-1], t_s=PERIOD_S * seqs[-1], rows=rows)


def truth(numbers: Sequence[int], boots: Sequence[int] = ()) -> TruthMessage:
    rows = [(number, PERIOD_S * number, 0.001 * number, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0, 0) for number in numbers]
    return TruthMessage(seq=numbers[-1], t_s=PERIOD_S * numbers[-1], rows=rows, boots=[*boots])


def session(boot: int, number: int, before: int = 0) -> SessionMessage:
    return SessionMessage(seq=-1, t_s=0.0, boot=boot, session=number, frames_before=before)


TOPIC_OF = {
    SensorLines: "sensors", TrackMessage: "track", TruthMessage: "truth", SessionMessage: "session", Rest: "rest",
    MissionStatus: "mission", ArrivalMessage: "arrival", DangerEvent: "danger_event",
}  # fmt: skip


def recorded(folder: Path, *messages: Message, is_simulation: bool = True) -> Path:
    """A recording of messages in their order."""
    folder.mkdir(exist_ok=True)
    recorder = recorder_in(folder, is_simulation=is_simulation)
    for message in messages:
        recorder.write(TOPIC_OF[type(message)], max(message.t_s, 0.0), msgspec.json.encode(message))
    recorder.close()
    return recorder.path


def axis(folder: Path, *messages: Message) -> Timeline:
    return read_timeline(recorded(folder, *messages), is_simulation=True)


def on_axis(folder: Path, *messages: Message) -> list[Message]:
    """The messages as a reader gets them."""
    path = recorded(folder, *messages)
    timeline = read_timeline(path, is_simulation=True)
    return [timeline.on_axis(one.place, decode_recorded(one.topic, one.payload)) for one in iter_places(path)]


FIRST, SECOND = range(50), range(1, 40)


def is_rising(timeline: Timeline) -> bool:
    return bool((np.diff(timeline.number) > 0).all() and (np.diff(timeline.t_s) > 0.0).all())


def test_without_a_step_the_axis_is_the_robots_own(tmp_path: Path) -> None:
    found = axis(tmp_path, session(7, 3), track(FIRST), lines(FIRST))
    assert found.number.tolist() == [*FIRST]
    assert found.t_s.tolist() == [PERIOD_S * seq for seq in FIRST]  # to the last bit
    assert (found.steps, found.notes, found.missing) == ((), (), 0)
    assert found.frame_id(4) == FrameId(7, 3, 4)


@pytest.mark.parametrize("has_sessions", [True, False])
def test_after_a_restart_numbers_and_times_continue(tmp_path: Path, has_sessions: bool) -> None:
    begin, again = ([session(7, 3)], [session(8, 1, 49)]) if has_sessions else ([], [])
    found = axis(tmp_path, *begin, track(FIRST), lines(FIRST), *again, track(SECOND, 49), lines(SECOND))
    assert found.number.tolist() == [*range(89)]
    assert found.t_s == pytest.approx([PERIOD_S * number for number in range(89)], abs=1e-9)
    (step,) = found.steps
    assert (step.kind, step.number) == ("restart", 50)
    assert found.frame_id(50) == (FrameId(8, 1, 1) if has_sessions else FrameId(1, 0, 1))
    assert ("inferred from its frame numbers" in found.notes[0]) is not has_sessions


def test_a_restart_is_known_by_its_boot_where_the_numbers_rise(tmp_path: Path) -> None:
    """The robot was away for longer than it had been on before."""
    late = range(300, 340)
    found = axis(tmp_path, session(7, 3), lines(FIRST), session(8, 1, 49), lines(late))
    assert [step.kind for step in found.steps] == ["restart"]
    assert found.frame_id(50) == FrameId(8, 1, 300)
    assert found.number[50] == 349
    assert is_rising(found)


def test_a_restart_in_a_batch_parts_it(tmp_path: Path) -> None:
    """Older recordings have both boots in one batch."""
    mixed = SensorLines(seq=9, t_s=0.09, lines=[*lines(range(40, 50)).lines, *lines(range(1, 10)).lines])
    rows = [*track(range(40, 50)).rows, *track(range(1, 10), 49).rows]
    estimates = TrackMessage(seq=9, t_s=0.09, rows=rows)
    *_, placed, _ = on_axis(tmp_path, track(range(40)), lines(range(40)), estimates, mixed)
    assert isinstance(placed, TrackMessage)
    assert [row[0] for row in placed.rows] == [*range(40, 59)]
    assert [row[1] for row in placed.rows] == pytest.approx([PERIOD_S * k for k in range(40, 59)], abs=1e-9)


def test_a_restart_in_lost_frames_is_known_by_the_estimates(tmp_path: Path) -> None:
    late = range(70, 90)
    found = axis(tmp_path, track(FIRST), lines(FIRST), track(late, 60), lines(late))
    assert [step.kind for step in found.steps] == ["restart"]
    assert found.number[-1] == 149
    assert found.missing == 80


def test_a_robot_that_counts_from_zero_gets_other_numbers(tmp_path: Path) -> None:
    found = axis(tmp_path, lines(FIRST), lines(range(20)))
    assert found.number.tolist() == [*range(70)]
    assert is_rising(found)


def test_main_that_restarted_after_the_robot_counts_from_its_beginning(tmp_path: Path) -> None:
    later = range(40, 60)
    messages = on_axis(
        tmp_path, session(7, 1), track(FIRST), lines(FIRST), session(8, 1, 49), track(SECOND, 49), lines(SECOND),
        session(8, 2, 0), ArrivalMessage(seq=45, t_s=0.45, point=(1, 2, 3), error_mm=0.1), track(later, 0), lines(later)
    )  # fmt: skip
    arrival, estimates = messages[-3], messages[-2]
    assert isinstance(estimates, TrackMessage)
    assert [row[0] for row in estimates.rows] == [seq + 49 for seq in later]
    assert arrival.seq == 45 + 49


def test_events_belong_to_the_boot_of_their_batch(tmp_path: Path) -> None:
    rests = on_axis(
        tmp_path,
        Rest(seq=5, t_s=0.05), lines(FIRST), Rest(seq=49, t_s=0.49), Rest(seq=5, t_s=0.05), lines(SECOND),
        Rest(seq=39, t_s=0.39),
    )  # fmt: skip
    found = [(one.seq, round(one.t_s, 6)) for one in rests if isinstance(one, Rest)]
    assert found == [(5, 0.05), (49, 0.49), (54, 0.54), (88, 0.88)]


@pytest.mark.parametrize("has_sessions", [True, False])
def test_an_event_whose_frame_is_lost_after_a_restart_is_not_of_the_boot_before(
    tmp_path: Path, has_sessions: bool
) -> None:
    again = [session(8, 1, 49)] if has_sessions else []
    begin = [session(7, 3)] if has_sessions else []
    later = range(30, 60)
    found = on_axis(
        tmp_path, *begin, track(FIRST), lines(FIRST), *again, Rest(seq=5, t_s=0.05), track(later, 49), lines(later)
    )
    (rest,) = [one for one in found if isinstance(one, Rest)]
    assert rest.seq == 54


def test_an_event_of_danger_may_be_older_than_the_restart(tmp_path: Path) -> None:
    event = DangerEvent(seq=49, t_s=0.49, code=0, cause="", signal="", value=0.0, limit=0.0, off=(False,) * 4)
    found = on_axis(tmp_path, session(7, 3), lines(FIRST), session(8, 1, 49), event, lines(SECOND))
    assert found[3].seq == 49


def test_a_status_between_restart_and_first_frame_has_the_time_of_the_last_frame_before_it(tmp_path: Path) -> None:
    status = MissionStatus(seq=-1, t_s=0.0, state="held")
    early, *_, late, _ = on_axis(tmp_path, status, lines(FIRST), status, lines(SECOND))
    assert (early.seq, early.t_s) == (-1, 0.0)
    assert late.seq == 49
    assert late.t_s == pytest.approx(0.49)


@pytest.mark.parametrize(
    ("clock", "by_s"),
    [
        pytest.param(lambda seq: PERIOD_S * seq - 5.0 * (seq >= 600), -5.0, id="back"),
        pytest.param(lambda seq: PERIOD_S * seq + 0.2 * (seq >= 600), 0.2, id="ahead"),
        pytest.param(lambda seq: PERIOD_S * seq % 6.0, -6.0, id="wrap"),
    ],
)
def test_a_step_of_the_clock_is_no_step_of_the_mission(
    tmp_path: Path, clock: Callable[[int], float], by_s: float
) -> None:
    found = axis(tmp_path, lines(range(550), clock), lines(range(550, 900), clock))
    assert found.t_s == pytest.approx([PERIOD_S * number for number in range(900)], abs=1e-9)
    (step,) = found.steps
    assert (step.kind, step.number) == ("clock", 600)
    assert step.by_s == pytest.approx(by_s, abs=1e-9)
    assert f"{by_s:+.3f} s before frame 600" in found.notes[0]


def test_a_clock_of_another_rate_does_not_step_over_lost_frames(tmp_path: Path) -> None:
    found = axis(
        tmp_path, lines(range(100), lambda seq: 0.0101 * seq), lines(range(5000, 5100), lambda seq: 0.01 * seq)
    )
    assert found.steps == ()
    assert found.missing == 4900


def test_a_sample_from_before_a_step_has_the_time_of_before_it(tmp_path: Path) -> None:
    found = axis(tmp_path, lines(range(900), lambda seq: PERIOD_S * seq % 6.0))
    assert found.sample_s(600, 0.0, 5.995) == pytest.approx(5.995)
    assert found.sample_s(601, 0.01, 0.005) == pytest.approx(6.005)
    assert found.sample_s(300, 3.0, 2.1) == pytest.approx(2.1)
    assert found.sample_s(300, 3.0, 1.9) is None  # older than a second
    assert found.sample_s(300, 3.0, 3.01) is None  # after its frame


def test_a_truth_that_cannot_be_joined_is_not_used(tmp_path: Path) -> None:
    """Main was down when the robot restarted, so nobody counted the frames between."""
    first, second = lines(range(30)), lines(SECOND)
    found = on_axis(tmp_path / "old", first, second, truth(range(90)))[-1]
    assert isinstance(found, TruthMessage)
    assert [row[0] for row in found.rows] == [*range(30)]
    timeline = axis(tmp_path / "again", first, second, truth(range(90)))
    assert any("cannot be joined to a truth" in note for note in timeline.notes)
    found = on_axis(tmp_path / "new", first, second, truth(range(90), (0, 49)))[-1]
    assert isinstance(found, TruthMessage)
    assert [row[0] for row in found.rows] == [*range(90)]


def test_utc_rises_with_the_mission(tmp_path: Path) -> None:
    """A real robot whose clock is set back, which restarts, and is off for half a minute."""
    now_ns = 1_800_000_000 * NS
    clock = RobotClock(is_simulation=False, now_ns=lambda: now_ns)
    recorder = Recorder(tmp_path / "telemetry.mcap", [("sensors", {})], is_simulation=False, clock=clock)
    for first, offset_s, off_s in ((1, 100.0, 0.0), (501, 92.0, 0.0), (1, 0.0, 30.0)):
        now_ns += round(off_s * NS)
        for begin in range(first, first + 500, 100):
            now_ns += NS
            batch = lines(range(begin, begin + 100), lambda seq, o=offset_s: o + PERIOD_S * seq)  # type: ignore[misc]
            recorder.write("sensors", batch.t_s, msgspec.json.encode(batch))
    recorder.close()
    found = read_timeline(recorder.path, is_simulation=False)
    utc = [found.utc_ns(t_s) for t_s in found.t_s.tolist()]
    steps_s = np.diff(np.array(utc, dtype=np.int64)) / NS
    assert steps_s.min() > 0.0
    assert steps_s[:998] == pytest.approx(PERIOD_S, abs=1e-6)
    assert steps_s[999] == pytest.approx(30.0 + PERIOD_S, abs=0.1)


def test_utc_of_times_by_several_clocks_at_once() -> None:
    """A clock that wraps: lines of the robot go back, times of the mission and of the truth go on."""
    now_ns = 1_800_000_000 * NS
    clock = RobotClock(is_simulation=True, now_ns=lambda: now_ns)
    zero_ns = clock.utc_ns(0.01) - NS // 100
    for step in range(2, 20_000, 7):
        t_s = 0.01 * step
        labels = [clock.utc_ns(t_s), clock.utc_ns(t_s % 40.0)]
        # 20 ms: a clock that begins again does so at the newest time.
        assert [label - zero_ns for label in labels] == pytest.approx([t_s * NS] * 2, abs=0.08 * NS * (1 + step / 4000))


def test_joins_are_by_number() -> None:
    one, other = np.array([1, 2, 5, 9]), np.array([2, 3, 9])
    here, there = common_rows(one, other)
    assert (here.tolist(), there.tolist()) == ([1, 3], [0, 2])
    assert rows_of(one, [9, 4, 1]).tolist() == [3, -1, 0]
    assert rows_of(np.empty(0), [1]).tolist() == [-1]
    assert [row_before(one, number) for number in (0, 1, 6)] == [-1, 0, 2]


def test_an_empty_recording_has_no_frames(tmp_path: Path) -> None:
    status = MissionStatus(seq=4, t_s=0.25, state="idle")
    (found,) = on_axis(tmp_path, status)
    assert (found.seq, found.t_s) == (4, 0.25)
