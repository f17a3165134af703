"""Publisher and subscriber on inproc endpoints."""

from collections.abc import Iterator
from contextlib import ExitStack, closing

import pytest
import zmq

from ccatp.links.bus import Publisher, Subscriber
from ccatp.links.topics import Heartbeat, LogMessage

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


def test_a_subscriber_gets_its_topics_only_in_order(bus: Bus) -> None:
    publisher = bus.publisher()
    subscriber = bus.subscriber("heartbeat.main")
    assert publisher.has_subscriber("heartbeat.main")
    publisher.send("heartbeat.main", presence(1))
    publisher.send("log", LogMessage(seq=0, t_s=0.0, level="info", process="main", text="not for you"))
    publisher.send("heartbeat.main", presence(2))
    assert subscriber.receive(1.0) == ("heartbeat.main", presence(1))
    assert subscriber.receive(1.0) == ("heartbeat.main", presence(2))
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


def test_a_topic_is_not_a_prefix(bus: Bus) -> None:
    publisher = bus.publisher()
    subscriber = bus.subscriber("heartbeat.main")
    publisher.has_subscriber("heartbeat.main")
    publisher._socket.send(b"heartbeat.mainframe {}")
    assert subscriber.receive(0.05) is None
    assert subscriber.bad_messages == 0


def test_bad_messages_are_counted_and_dropped(bus: Bus) -> None:
    publisher = bus.publisher()
    subscriber = bus.subscriber("heartbeat.main")
    publisher.has_subscriber("heartbeat.main")
    publisher._socket.send(b"heartbeat.main nonsense")
    publisher.send("heartbeat.main", presence(3))
    assert subscriber.receive(1.0) == ("heartbeat.main", presence(3))
    assert subscriber.bad_messages == 1


def test_nobody_waits_for_an_onlooker_who_gets_it_all_the_same(bus: Bus) -> None:
    publisher = bus.publisher()
    onlooker = bus.subscriber("heartbeat.main", is_uncounted=True)
    other = bus.subscriber("log")
    while not publisher.has_subscriber("log"):
        pass
    received = None
    while received is None:  # until the other subscription has arrived as well
        publisher.send("heartbeat.main", presence(1))
        received = onlooker.receive(0.05)
    assert received == ("heartbeat.main", presence(1))
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
        assert isinstance(received[1], Heartbeat)
        seen.append(received[1].seq)
    assert len(seen) < 200
    assert newest.receive() is None
