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
