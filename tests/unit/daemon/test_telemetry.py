"""Publications of the main loop: batches of lines, of estimates and of times."""

import re
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest
import structlog

from ccatp.conditions import DANGER, SURVEY, condition_of
from ccatp.daemon.main_loop import STANDS_REPEAT_S, STANDS_REPORT_S, StandstillReport
from ccatp.links.bus import BATCH_FRAMES, Publisher, Telemetry
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


def test_recorded_numbers_go_on_where_the_robot_begins_anew(telemetry: Telemetry) -> None:
    telemetry.continue_numbering()  # before any frame
    assert telemetry.frames_before == 0
    telemetry.add_frame(41, 1.0, b"{}", row(41))
    telemetry.continue_numbering()
    assert telemetry.frames_before == 41


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


@pytest.mark.parametrize(
    ("cause", "advice"),
    [
        pytest.param("no way on: walled in", "`ccatp abort`", id="a text that varies"),
        pytest.param("an edge sensor chatters, for 30 s", "Clean it", id="a hold that lasts"),
        pytest.param("an edge sensor chatters, again after 2 retries", "Clean it", id="a hold that comes again"),
        pytest.param("nobody has heard of this", "", id="unknown"),
    ],
)
def test_advice_is_that_of_the_row_whose_message_it_is(cause: str, advice: str) -> None:
    row = condition_of(cause)
    assert (row is not None) is bool(advice)
    assert row is None or row.advice.startswith(advice)


def test_each_row_is_found_by_its_message() -> None:
    for row in (*DANGER, *SURVEY):
        found = condition_of(re.sub(r"{.*?}", "left", row.message))
        assert found is not None
        assert found.message == row.message
