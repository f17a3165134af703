"""Messages of the main loop: batches of lines, of estimates and of times; which verdict is in force in a frame."""

from collections.abc import Iterator
from contextlib import closing
from threading import Timer
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest
import structlog
import zmq

from ccatp.core import Verdict
from ccatp.daemon.loops.standstill import STANDS_REPEAT_S, STANDS_REPORT_S, StandstillReport
from ccatp.links import bus as bus_module
from ccatp.links.bus import BATCH_FRAMES, Publisher, Telemetry, VerdictSubscriber
from ccatp.links.topics import TrackMessage

Received = dict[str, list[Any]]


@pytest.fixture
def received() -> Received:
    return {}


@pytest.fixture
def telemetry(received: Received) -> Telemetry:
    def send(name: str, message: object) -> None:
        received.setdefault(name, []).append(message)

    return Telemetry(cast(Publisher, SimpleNamespace(send=send)), structlog.get_logger(), "track", TrackMessage)


def row(number: int) -> tuple[Any, ...]:
    return number, 0.01 * number, 1, 2, 0.1, 0.2, 0.3, 1e-3


def test_a_frame_that_is_not_newer_is_recorded_without_an_estimate(telemetry: Telemetry, received: Received) -> None:
    telemetry.add_frame(7, 1.0, b'{"seq":7}', row(7))
    telemetry.add_line(8, b'{"seq":8}')
    assert (telemetry.seq, telemetry.t_s, bytes(telemetry.newest_line)) == (8, 1.0, b'{"seq":7}')
    telemetry.add_frame(9, 1.01, b'{"seq":9}', row(9))
    telemetry.tick_us.append(250.0)
    telemetry.flush(60.0)  # the last time is not so long ago
    assert not received
    telemetry.flush()
    (lines,), (track,), (timing,) = received["sensors"], received["track"], received["timing"]
    assert [msgspec.json.decode(line)["seq"] for line in lines.lines] == [7, 8, 9]
    assert [one[0] for one in track.rows] == [7, 9]
    assert timing.tick_us == [250.0]
    telemetry.flush()  # nothing is sent twice
    assert [len(messages) for messages in received.values()] == [1, 1, 1]


def test_stale_frames_alone_are_no_batch_of_estimates(telemetry: Telemetry, received: Received) -> None:
    for seq in range(BATCH_FRAMES):
        telemetry.add_line(seq, b"{}")
    assert {name: len(messages) for name, messages in received.items()} == {"sensors": 1}


def test_recorded_numbers_continue_where_the_robot_begins_anew(telemetry: Telemetry) -> None:
    telemetry.continue_numbering()  # before any frame
    assert telemetry.frames_before == 0
    telemetry.add_frame(41, 1.0, b"{}", row(41))
    telemetry.continue_numbering()
    telemetry.continue_numbering()  # again before its first frame
    assert telemetry.frames_before == 41


def test_a_session_is_recorded_between_the_batches_of_its_neighbours(telemetry: Telemetry, received: Received) -> None:
    telemetry.begin_session(6, 1)
    telemetry.add_frame(41, 1.0, b"{}", row(41))
    telemetry.continue_numbering()
    telemetry.begin_session(7, 3)
    first, second = received["session"]
    assert (first.boot, first.session, first.frames_before) == (6, 1, 0)
    assert (second.boot, second.session, second.frames_before) == (7, 3, 41)
    assert [(batch.seq, len(batch.lines)) for batch in received["sensors"]] == [(41, 1)]


# -- a robot that stands still -----------------------------------------------------------------------------------------


def test_it_is_reported_after_half_a_minute_and_again_after_each_minute() -> None:
    report, said = StandstillReport(), dict[int, float]()
    for k in range(2000):
        lasts_s = report.lasts_s(0.1 * k, stands=k != 1500)
        if lasts_s is not None:
            said[k] = lasts_s
    first, again = 10.0 * STANDS_REPORT_S, 10.0 * STANDS_REPEAT_S
    assert list(said) == pytest.approx([first, first + again, 1501 + first], abs=1)  # a frame
    assert list(said.values()) == pytest.approx([30.0, 90.0, 30.0], abs=0.2)


# -- verdicts in force -------------------------------------------------------------------------------------------------

ENDPOINT, FRAME_S, TIMEOUT_S = "inproc://verdicts", 0.01, 0.05


class Bus:
    """Danger's end and main's."""

    def __init__(self, publisher: Publisher, verdicts: VerdictSubscriber) -> None:
        self._publisher, self._verdicts = publisher, verdicts

    def judge(self, *seqs: int) -> None:
        for seq in seqs:
            verdict = Verdict.normal(seq, FRAME_S * seq)
            self._publisher.send("verdict", verdict)

    def in_force(self, seq: int, *, is_lockstep: bool = True) -> int | None:
        verdict = self._verdicts.latest(seq, FRAME_S, is_lockstep=is_lockstep)
        return None if verdict is None else verdict.seq


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bus]:
    monkeypatch.setattr(bus_module, "LOCKSTEP_WAIT_S", 0.1)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    verdicts_of_main = VerdictSubscriber(context, ENDPOINT, TIMEOUT_S)
    with closing(Publisher(context, ENDPOINT)) as publisher, closing(verdicts_of_main) as verdicts:
        while not publisher.has_subscriber("verdict"):
            pass
        yield Bus(publisher, verdicts)
    context.destroy(linger=0)


@pytest.mark.parametrize(
    ("judged", "is_lockstep", "in_force"),
    [
        pytest.param(
            (10, 11, 12, 13), True, {11: 10, 12: 11, 13: 12}, id="lockstep goes by the frame before, not by later ones"
        ),
        pytest.param((10, 10, 11), True, {11: 10, 12: 11}, id="a line that danger could not read: the next frame"),
        pytest.param(
            (10, 12, 17, 30), True,
            {11: 10, 12: 10, 13: 12, 15: 12, 16: 12, 17: 12, 18: 17, 30: None, 31: 30},  # one counts in the next frame
            id="what danger did not judge is bridged for as long as a verdict is fresh",
        ),
        pytest.param((10,), True, {11: 10, 12: None}, id="a danger loop that hangs leaves no verdict"),
        pytest.param((10, 11, 12), False, {12: 12, 17: 12, 18: None}, id="in real time the newest that is fresh"),
    ],
)  # fmt: skip
def test_which_verdict_is_in_force(
    bus: Bus, judged: tuple[int, ...], is_lockstep: bool, in_force: dict[int, int | None]
) -> None:
    bus.judge(*judged)
    assert {seq: bus.in_force(seq, is_lockstep=is_lockstep) for seq in in_force} == in_force


def test_lockstep_waits_for_the_frame_before(bus: Bus) -> None:
    bus.judge(10)
    assert bus.in_force(11) == 10
    later = Timer(0.03, bus.judge, (11, 12))
    later.start()
    assert bus.in_force(12) == 11
    later.join()
