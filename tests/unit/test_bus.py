"""Publisher and subscriber on inproc endpoints."""

from collections.abc import Iterator
from contextlib import ExitStack, closing

import pytest
import zmq

from ccatp.bus import Publisher, Subscriber
from ccatp.wire.topics import Log, Presence

ENDPOINT = "inproc://bus"
Context = zmq.Context[zmq.Socket[bytes]]


class Bus:
    """Makes the two ends and closes them."""

    def __init__(self, context: Context, ends: ExitStack) -> None:
        self._context, self._ends = context, ends

    def publisher(self) -> Publisher:
        return self._ends.enter_context(closing(Publisher(self._context, ENDPOINT)))

    def subscriber(self, *topics: str) -> Subscriber:
        return self._ends.enter_context(closing(Subscriber(self._context, [ENDPOINT], topics)))


@pytest.fixture
def bus() -> Iterator[Bus]:
    context: Context = zmq.Context()
    with ExitStack() as ends:
        yield Bus(context, ends)
    context.destroy(linger=0)


def presence(seq: int) -> Presence:
    return Presence(seq=seq, t_s=0.0, process="main", pid=1, phase="ready")


def test_a_subscriber_gets_its_topics_only_in_order(bus: Bus) -> None:
    publisher = bus.publisher()
    subscriber = bus.subscriber("presence.main")
    assert publisher.has_subscriber("presence.main")
    publisher.send("presence.main", presence(1))
    publisher.send("log", Log(seq=0, t_s=0.0, level="info", process="main", text="not for you"))
    publisher.send("presence.main", presence(2))
    assert subscriber.receive(1.0) == ("presence.main", presence(1))
    assert subscriber.receive(1.0) == ("presence.main", presence(2))
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
    subscriber = bus.subscriber("presence.main")
    publisher.has_subscriber("presence.main")
    publisher._socket.send(b"presence.mainframe {}")
    assert subscriber.receive(0.05) is None
    assert subscriber.bad_messages == 0


def test_bad_messages_are_counted_and_dropped(bus: Bus) -> None:
    publisher = bus.publisher()
    subscriber = bus.subscriber("presence.main")
    publisher.has_subscriber("presence.main")
    publisher._socket.send(b"presence.main nonsense")
    publisher.send("presence.main", presence(3))
    assert subscriber.receive(1.0) == ("presence.main", presence(3))
    assert subscriber.bad_messages == 1
