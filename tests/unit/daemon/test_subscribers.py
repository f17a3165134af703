"""Which verdict is in force in a frame of main."""

from collections.abc import Iterator
from contextlib import closing
from threading import Timer

import pytest
import zmq

from ccatp.core import EventCode, Verdict
from ccatp.links import bus as bus_module
from ccatp.links.bus import Publisher, VerdictSubscriber

ENDPOINT, FRAME_S, TIMEOUT_S = "inproc://verdicts", 0.01, 0.05


class Bus:
    """Danger's end and main's."""

    def __init__(self, publisher: Publisher, verdicts: VerdictSubscriber) -> None:
        self._publisher, self._verdicts = publisher, verdicts

    def judge(self, *seqs: int) -> None:
        for seq in seqs:
            verdict = Verdict(seq, FRAME_S * seq, EventCode.NORMAL, "", "", 0.0, 0.0, True, True, True)
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


def test_lockstep_goes_by_the_frame_before_though_later_ones_are_there(bus: Bus) -> None:
    bus.judge(10, 11, 12, 13)
    assert [bus.in_force(seq) for seq in (11, 12, 13)] == [10, 11, 12]


def test_lockstep_waits_for_the_frame_before(bus: Bus) -> None:
    bus.judge(10)
    assert bus.in_force(11) == 10
    later = Timer(0.03, bus.judge, (11, 12))
    later.start()
    assert bus.in_force(12) == 11
    later.join()


def test_a_second_verdict_on_a_frame_comes_into_force_with_the_next(bus: Bus) -> None:
    """As after a line that danger could not read."""
    bus.judge(10, 10, 11)
    assert [bus.in_force(seq) for seq in (11, 12)] == [10, 11]


def test_what_danger_did_not_judge_is_bridged_for_as_long_as_a_verdict_is_fresh(bus: Bus) -> None:
    bus.judge(10, 12, 17)
    assert [bus.in_force(seq) for seq in (11, 12, 13, 15, 16, 17, 18)] == [10, 10, 12, 12, 12, 12, 17]
    bus.judge(30)
    assert bus.in_force(30) is None  # of this very frame: it counts in the next one
    assert bus.in_force(31) == 30


def test_a_danger_loop_that_hangs_leaves_no_verdict(bus: Bus) -> None:
    bus.judge(10)
    assert bus.in_force(11) == 10
    assert bus.in_force(12) is None


def test_in_real_time_the_newest_that_is_fresh_counts(bus: Bus) -> None:
    bus.judge(10, 11, 12)
    assert bus.in_force(12, is_lockstep=False) == 12
    assert bus.in_force(17, is_lockstep=False) == 12
    assert bus.in_force(18, is_lockstep=False) is None
