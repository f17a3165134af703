"""Edge. What the dashboard receives: the rare messages always, the frequent ones only while somebody looks."""

from collections.abc import Callable
from typing import NamedTuple

import zmq

from ccatp.bus import Subscriber
from ccatp.dashboard.view import View


class Wants(NamedTuple):
    """The topics of one kind of mission.

    Attributes:
        main: what makes the page's history, and costs nothing to speak of; besides that of every mission.
        track: of the estimates, while somebody looks.
        truth: of the simulated truth, likewise.
        once: of the simulated truth, what is told once.
    """

    main: tuple[str, ...]
    track: str
    truth: str
    once: tuple[str, ...]


SURVEY = Wants(("arrival", "fix", "scene"), "track", "truth", ())
BEACONS = Wants(("beacon_arrival", "beacon_map", "scene"), "beacon_track", "beacon_truth", ("beacon_places",))
_OF_MAIN = ("presence.main", "mission", "log")
_OF_DANGER = ("presence.danger", "danger_event")
# Taken at a time: a publisher that never pauses must not keep the pages waiting.
MOST = 2_000


class Feed:
    """Subscriptions of the dashboard.

    Nobody waits for them: a run begins when its own processes listen, whoever looks on.

    Args:
        context: ZeroMQ context of the process.
        endpoint_of: where main, danger and truth publish.
        view: what hears it.
        is_sim: there is a truth.
        wants: what there is to hear of the mission.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoint_of: Callable[[str], str],
        view: View,
        *,
        is_sim: bool,
        wants: Wants = SURVEY,
    ) -> None:
        """Subscribe to what is always received."""
        self._context, self._endpoint_of, self._view, self._is_sim = context, endpoint_of, view, is_sim
        self._wants = wants
        always = {"main": (*_OF_MAIN, *wants.main), "danger": _OF_DANGER}
        self._always = {
            name: Subscriber(context, [endpoint_of(name)], topics, is_watching=True, is_onlooking=True)
            for name, topics in always.items()
        }
        if is_sim and wants.once:
            self._always["truth"] = self._onlooker("truth", *wants.once)
        self._glancing: list[Subscriber] = []
        self._looking: list[Subscriber] = []

    def glance(self, wanted: bool) -> None:
        """Receive the levels, of which the newest counts, or do not any more."""
        if wanted and not self._glancing:
            self._glancing = [
                # Main puts a picture together for those who ask; a verdict must not be waited for in our place.
                Subscriber(self._context, [self._endpoint_of("main")], ["picture"], keeps_newest=True),
                Subscriber(
                    self._context, [self._endpoint_of("danger")], ["verdict"], keeps_newest=True, is_onlooking=True
                ),
            ]
        elif not wanted and self._glancing:
            _close(self._glancing)
            self._view.look_away()

    def look(self, wanted: bool) -> None:
        """Receive the path as it is driven and, in simulation, the truth, or do not any more."""
        self._view.is_tracking = wanted
        if wanted and not self._looking:
            self._looking = [self._onlooker("main", self._wants.track)]
            if self._is_sim:
                self._looking.append(self._onlooker("truth", self._wants.truth))
        elif not wanted and self._looking:
            _close(self._looking)

    def drain(self, now_s: float) -> None:
        """Hand on what has come.

        Args:
            now_s: time of the machine's monotonic clock.
        """
        for name, subscriber in self._always.items():
            if subscriber.is_cut:
                self._view.links.cut(name, now_s)
        for subscriber in (*self._always.values(), *self._glancing, *self._looking):
            for _ in range(MOST):
                received = subscriber.receive()
                if received is None:
                    break
                self._view.hear(received[1], now_s)

    def close(self) -> None:
        """Close the sockets."""
        for subscribers in (self._glancing, self._looking):
            _close(subscribers)
        for subscriber in self._always.values():
            subscriber.close()

    def _onlooker(self, publisher: str, *topics: str) -> Subscriber:
        return Subscriber(self._context, [self._endpoint_of(publisher)], topics, is_onlooking=True)


def _close(subscribers: list[Subscriber]) -> None:
    for subscriber in subscribers:
        subscriber.close()
    subscribers.clear()
