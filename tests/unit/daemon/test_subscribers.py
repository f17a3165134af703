"""Which verdict is in force in a frame of main."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from threading import Timer

import msgspec
import pytest

from ccatp.core import EventCode, Verdict
from ccatp.daemon import subscribers
from ccatp.daemon.subscribers import VerdictSubscriber
from ccatp.links.bus import MAX_PACKET_BYTES, PeerSocket
from ccatp.links.topics import Heartbeat

FRAME_S, TIMEOUT_S = 0.01, 0.05


class Ends:
    """Danger's end and main's."""

    def __init__(self, danger: PeerSocket, main: PeerSocket) -> None:
        self.danger, self.main = danger, main
        self.verdicts = VerdictSubscriber(main, TIMEOUT_S)

    def judge(self, *seqs: int) -> None:
        for seq in seqs:
            verdict = Verdict(seq, FRAME_S * seq, EventCode.NORMAL, "", "", 0.0, 0.0, True, True, True)
            self.danger.send("verdict", verdict)

    def in_force(self, seq: int, *, is_lockstep: bool = True) -> int | None:
        verdict = self.verdicts.latest(seq, FRAME_S, is_lockstep=is_lockstep)
        return None if verdict is None else verdict.seq


@pytest.fixture
def ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ends]:
    monkeypatch.setattr(subscribers, "LOCKSTEP_WAIT_S", 0.1)
    path = tmp_path / "peer"
    with closing(PeerSocket(path, is_listening=True)) as danger, closing(PeerSocket(path)) as main:
        main.maintain()
        danger.maintain()
        yield Ends(danger, main)


def test_lockstep_goes_by_the_frame_before_though_later_ones_are_there(ends: Ends) -> None:
    ends.judge(10, 11, 12, 13)
    assert [ends.in_force(seq) for seq in (11, 12, 13)] == [10, 11, 12]


def test_lockstep_waits_for_the_frame_before(ends: Ends) -> None:
    ends.judge(10)
    assert ends.in_force(11) == 10
    later = Timer(0.03, ends.judge, (11, 12))
    later.start()
    assert ends.in_force(12) == 11
    later.join()


def test_a_second_verdict_on_a_frame_comes_into_force_with_the_next(ends: Ends) -> None:
    """As after a line that danger could not read."""
    ends.judge(10, 10, 11)
    assert [ends.in_force(seq) for seq in (11, 12)] == [10, 11]


def test_what_danger_did_not_judge_is_bridged_for_as_long_as_a_verdict_is_fresh(ends: Ends) -> None:
    ends.judge(10, 12, 17)
    assert [ends.in_force(seq) for seq in (11, 12, 13, 15, 16, 17, 18)] == [10, 10, 12, 12, 12, 12, 17]
    ends.judge(30)
    assert ends.in_force(30) is None  # of this very frame: it counts in the next one
    assert ends.in_force(31) == 30


def test_a_danger_loop_that_hangs_leaves_no_verdict(ends: Ends) -> None:
    ends.judge(10)
    assert ends.in_force(11) == 10
    assert ends.in_force(12) is None


def test_in_real_time_the_newest_that_is_fresh_counts(ends: Ends) -> None:
    ends.judge(10, 11, 12)
    assert ends.in_force(12, is_lockstep=False) == 12
    assert ends.in_force(17, is_lockstep=False) == 12
    assert ends.in_force(18, is_lockstep=False) is None


def heartbeat(seq: int) -> Heartbeat:
    return Heartbeat(seq=seq, t_s=0.0, process="danger", pid=1, phase="joined")


def test_main_joins_when_danger_reports_that_it_has(ends: Ends) -> None:
    assert not ends.verdicts.is_danger_joined()
    ends.danger.send("heartbeat.danger", msgspec.structs.replace(heartbeat(1), phase="ready"))
    assert not ends.verdicts.is_danger_joined()
    ends.danger.send("heartbeat.danger", heartbeat(2))
    assert ends.verdicts.is_danger_joined()


def test_a_danger_loop_that_died_is_not_waited_for(ends: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subscribers, "LOCKSTEP_WAIT_S", 60.0)
    ends.judge(10)
    ends.danger.disconnect()
    assert ends.in_force(11) == 10  # what it sent before counts
    assert ends.in_force(12) is None
    assert not ends.main.is_connected


def test_each_end_finds_the_other_again_after_a_restart(ends: Ends, tmp_path: Path) -> None:
    ends.danger.close()
    ends.main.maintain()  # nobody listens
    assert not ends.main.is_connected
    with closing(PeerSocket(tmp_path / "peer", is_listening=True)) as danger:
        ends.main.maintain()
        danger.maintain()
        assert (danger.is_new, ends.main.is_connected) == (True, True)
        danger.is_new = False
        danger.send("heartbeat.danger", heartbeat(3))
        assert ends.main.receive() == heartbeat(3)
        with closing(PeerSocket(tmp_path / "peer")) as main:  # takes the place of one that is still there
            main.maintain()
            danger.maintain()
            assert danger.is_new
            danger.send("heartbeat.danger", heartbeat(4))
            assert main.receive(0.1) == heartbeat(4)
            assert ends.main.receive() is None
            assert not ends.main.is_connected


def test_a_peer_that_does_not_read_costs_the_newest_messages_and_no_time(ends: Ends) -> None:
    count = 10_000
    for seq in range(count):
        ends.danger.send("heartbeat.danger", heartbeat(seq))
    received = 0
    while ends.main.receive() == heartbeat(received):
        received += 1
    assert received == count - ends.danger.dropped > 100


def test_a_packet_that_is_no_message_is_dropped_and_counted(ends: Ends) -> None:
    for frame in (b"nonsense", b"verdict {}", b"verdict " + b"x" * 2 * MAX_PACKET_BYTES):
        ends.danger.send_frame(frame)
    ends.judge(10)
    assert ends.in_force(11) == 10
    assert ends.main.bad_messages == 3
