"""Verdicts from the danger loop to the main loop: datagrams, in lockstep that of the frame, else the newest."""

import socket
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
import zmq

from ccatp.core import EventCode, Verdict
from ccatp.daemon.subscribers import VerdictSocket, VerdictSubscriber

FRAME_S, TIMEOUT_S = 0.01, 0.15
Open = Callable[[], VerdictSubscriber]


def verdict(seq: int) -> Verdict:
    return Verdict(seq, seq * FRAME_S, EventCode.NORMAL, "", "", 0.0, 0.0, True, True, True)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "verdicts"


@pytest.fixture
def open_main(path: Path) -> Iterator[Open]:
    opened: list[VerdictSubscriber] = []
    with zmq.Context() as context:

        def open_one() -> VerdictSubscriber:
            opened.append(VerdictSubscriber(context, "inproc://danger", path, TIMEOUT_S))
            return opened[-1]

        yield open_one
        for one in opened:
            one.close()


@pytest.fixture
def danger(path: Path) -> Iterator[VerdictSocket]:
    with closing(VerdictSocket(path)) as one:
        yield one


def test_lockstep_takes_the_verdict_of_the_frame_and_real_time_the_newest(
    open_main: Open, danger: VerdictSocket
) -> None:
    main = open_main()
    for seq in (4, 5, 6):
        danger.send(verdict(seq))
    assert main.latest(5, FRAME_S, is_lockstep=True) == verdict(5)
    assert main.latest(5, FRAME_S, is_lockstep=False) == verdict(6)
    assert main.latest(6 + 15, FRAME_S, is_lockstep=False) == verdict(6)
    assert main.latest(6 + 16, FRAME_S, is_lockstep=False) is None


def test_what_is_no_verdict_or_of_the_last_boot_is_dropped(open_main: Open, danger: VerdictSocket, path: Path) -> None:
    main = open_main()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
        for text in (b"", b"{}", b'{"seq":"x"}', b"\xff" * 5000):
            other.sendto(text, str(path))
            assert main.latest(1, FRAME_S, is_lockstep=False) is None
    danger.send(verdict(1000))
    assert main.latest(1, FRAME_S, is_lockstep=False) is None


def test_danger_goes_on_without_main_and_reaches_one_that_was_restarted(open_main: Open, danger: VerdictSocket) -> None:
    danger.send(verdict(1))
    open_main()
    for seq in range(2000):  # it does not receive
        danger.send(verdict(seq))
    danger.send(verdict(2000))
    again = open_main()
    danger.send(verdict(2001))
    assert again.latest(2001, FRAME_S, is_lockstep=True) == verdict(2001)
    assert again.latest(2002, FRAME_S, is_lockstep=False) == verdict(2001)
