"""Publisher and subscriber on inproc endpoints."""

from collections.abc import Iterator
from contextlib import ExitStack, closing

import msgspec
import pytest
import zmq

from ccatp.core import Cause, EventCode, Verdict
from ccatp.links.bus import Publisher, Subscriber
from ccatp.links.bus_codec import BadMessage, unpack
from ccatp.links.topics import (
    ESTIMATE_FRAMES,
    EstimateMessage,
    Heartbeat,
    LogMessage,
    SensorLines,
    all_topics,
    is_estimate_due,
    last_estimate_before,
)
from ccatp.records.recorder import decode_recorded

ENDPOINT = "inproc://bus"
Context = zmq.Context[zmq.Socket[bytes]]


class Bus:
    """Makes the two ends and closes them."""

    def __init__(self, context: Context, ends: ExitStack) -> None:
        self._context, self._ends = context, ends

    def publisher(self) -> Publisher:
        return self._ends.enter_context(closing(Publisher(self._context, ENDPOINT)))

    def subscriber(self, *topics: str, is_uncounted: bool = False, keeps_newest: bool = False) -> Subscriber:
        made = Subscriber(self._context, [ENDPOINT], topics, is_uncounted=is_uncounted, keeps_newest=keeps_newest)
        return self._ends.enter_context(closing(made))


@pytest.fixture
def bus() -> Iterator[Bus]:
    context: Context = zmq.Context()
    with ExitStack() as ends:
        yield Bus(context, ends)
    context.destroy(linger=0)


def presence(seq: int) -> Heartbeat:
    return Heartbeat(seq=seq, t_s=0.0, process="main", pid=1, phase="ready")


def next_of(subscriber: Subscriber) -> tuple[str, object]:
    name, _, message = subscriber.receive(1.0) or ("", b"", None)
    return name, message


def test_a_subscriber_gets_its_topics_only_in_order(bus: Bus) -> None:
    publisher = bus.publisher()
    subscriber = bus.subscriber("heartbeat.main")
    assert publisher.has_subscriber("heartbeat.main")
    publisher.send("heartbeat.main", presence(1))
    publisher.send("log", LogMessage(seq=0, t_s=0.0, level="info", process="main", text="not for you"))
    publisher.send("heartbeat.main", presence(2))
    assert next_of(subscriber) == ("heartbeat.main", presence(1))
    assert next_of(subscriber) == ("heartbeat.main", presence(2))
    assert subscriber.receive() is None


def test_a_publisher_knows_who_listens(bus: Bus) -> None:
    publisher = bus.publisher()
    assert not publisher.has_subscriber("log")
    subscriber = bus.subscriber("log")
    assert publisher.has_subscriber("log")
    assert not publisher.has_subscriber("estimate")
    subscriber.close()
    while publisher.has_subscriber("log"):  # the news of it travels through another thread
        pass


def test_a_topic_is_not_a_prefix_and_bad_messages_are_counted_and_dropped(bus: Bus) -> None:
    publisher = bus.publisher()
    subscriber = bus.subscriber("heartbeat.main")
    publisher.has_subscriber("heartbeat.main")
    publisher._socket.send(b"heartbeat.mainframe {}")
    assert subscriber.receive(0.05) is None
    assert subscriber.bad_messages == 0
    publisher._socket.send(b"heartbeat.main nonsense")
    publisher.send("heartbeat.main", presence(3))
    assert next_of(subscriber) == ("heartbeat.main", presence(3))
    assert subscriber.bad_messages == 1


def test_nobody_waits_for_an_observer_and_it_receives_every_message(bus: Bus) -> None:
    publisher = bus.publisher()
    onlooker = bus.subscriber("heartbeat.main", is_uncounted=True)
    other = bus.subscriber("log")
    while not publisher.has_subscriber("log"):
        pass
    received = None
    while received is None:  # until the other subscription has arrived as well
        publisher.send("heartbeat.main", presence(1))
        received = onlooker.receive(0.05)
    assert (received[0], received[2]) == ("heartbeat.main", presence(1))
    assert not publisher.has_subscriber("heartbeat.main")
    assert other.receive() is None


def test_of_what_waits_the_newest_is_kept(bus: Bus) -> None:
    publisher = bus.publisher()
    newest = bus.subscriber("heartbeat.main", keeps_newest=True)
    while not publisher.has_subscriber("heartbeat.main"):
        pass
    seen: list[int] = []
    for seq in range(200):
        publisher.send("heartbeat.main", presence(seq))
    while 199 not in seen:
        received = newest.receive(5.0)
        assert received is not None
        assert isinstance(received[2], Heartbeat)
        seen.append(received[2].seq)
    assert len(seen) < 200
    assert newest.receive() is None


ESTIMATE = EstimateMessage(seq=5, t_s=0.05, x_m=1.0, y_m=-2.0, heading_rad=0.5, sigma_m=1e-3, state="driving")


def test_golden_frame_and_round_trip() -> None:
    body = (
        b'{"x_m":1.0,"y_m":-2.0,"heading_rad":0.5,"sigma_m":0.001,"state":"driving","commanded":null,'
        b'"drive_seq":-1,"grip":0.0,"seq":5,"t_s":0.05}'
    )
    assert msgspec.json.encode(ESTIMATE) == body
    assert unpack(b"estimate " + body) == ("estimate", body, ESTIMATE)


def test_a_batch_of_lines_holds_them_as_they_came() -> None:
    line = b'{"type":"sensors","seq":1}'
    body = unpack(b"sensors " + msgspec.json.encode(SensorLines(seq=1, t_s=0.0, lines=[msgspec.Raw(line)])))[1]
    assert line in body


@pytest.mark.parametrize(
    ("frame", "why"),
    [
        (b"", "unknown topic"),
        (b"estimate", "topic estimate"),
        (b"rumour {}", "unknown topic b'rumour'"),
        (b"\xff\xfe {}", "unknown topic"),
        (b'estimate {"seq":1}', "missing required field"),
        (b'estimate {"seq":1.5,"t_s":0}', "Expected `int`"),
        (b"estimate {", "topic estimate"),
    ],
)
def test_what_is_not_of_the_table_is_refused(frame: bytes, why: str) -> None:
    with pytest.raises(BadMessage, match=why):
        unpack(frame)


def test_names_are_unique_and_levels_have_an_age() -> None:
    assert len({topic.name for topic in all_topics()}) == len(all_topics())
    for topic in all_topics():
        is_level = topic.rate_hz > 1.0
        assert (topic.stale_after_s > 0.0) == is_level, topic.name
        assert topic.stale_after_s == 0.0 or topic.stale_after_s >= 2.0 / topic.rate_hz  # one may be late


def test_verdicts_survive_the_bus() -> None:
    cause = Cause("leg_overdue", {"x_m": 1.5}, besides=Cause("no_estimate"))
    verdict = Verdict(7, 0.07, EventCode.NEAR_EDGE, cause, "front_left", 0.01, 0.005, False, True, False, (True,) * 4)
    name, _, message = unpack(b"verdict " + msgspec.json.encode(verdict))
    assert (name, message) == ("verdict", verdict)
    assert isinstance(message, Verdict)
    assert message.code is EventCode.NEAR_EDGE


def test_danger_waits_for_an_estimate_that_main_publishes() -> None:
    for seq in range(1, 30):
        wanted = last_estimate_before(seq)
        assert is_estimate_due(wanted)
        assert 0 < seq - wanted <= ESTIMATE_FRAMES
    assert last_estimate_before(0) < 0


@pytest.mark.parametrize(
    ("topic", "payload", "field", "value"),
    [
        ("treatment", b'{"seq":1,"t_s":0.1,"kind":"deaf","values":[]}', "kind", "odometry_off"),
        ("treatment", b'{"seq":1,"t_s":0.1,"kind":"hearing"}', "kind", "odometry_on"),
        ("treatment", b'{"seq":1,"t_s":0.1,"kind":"odometry_on"}', "kind", "odometry_on"),
        ("mission", b'{"seq":1,"t_s":0.1,"state":"idle","slips":3}', "missed_deadlines", 3),
        ("mission", b'{"seq":1,"t_s":0.1,"state":"idle","lag_ms":21.5}', "worst_lateness_ms", 21.5),
    ],
)
def test_recordings_of_older_formats_are_read(topic: str, payload: bytes, field: str, value: object) -> None:
    assert getattr(decode_recorded(topic, payload), field) == value


def test_a_recorded_message_of_no_format_is_refused() -> None:
    with pytest.raises(BadMessage, match="topic treatment"):
        decode_recorded("treatment", b'{"seq":1,"t_s":0.1,"kind":"numb"}')
