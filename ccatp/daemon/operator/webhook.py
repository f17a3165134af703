"""Posts the events of the alarms of a run to ``alarms.webhook_url``, from a thread of its own."""

import threading
import time
import urllib.error
import urllib.request
from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from http import HTTPStatus
from typing import NamedTuple

import msgspec
import structlog

from ccatp.config.models import AlarmsConfig
from ccatp.links.topics import Alarm, MissionStatus

# Largest number of waiting posts. Older ones are left out, and the next post has their number.
MOST_WAITING = 100
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0
# Client errors after which a repetition may succeed; the others are final.
_PASSING = {HTTPStatus.REQUEST_TIMEOUT, HTTPStatus.TOO_MANY_REQUESTS}


class AlarmPost(msgspec.Struct, frozen=True):
    """Body of a post: event of an alarm, run, state of the mission; ``left_out``: number of posts left out before."""

    event: str
    run: str
    state: str
    alarm: Alarm
    left_out: int = 0


class PostFailure(NamedTuple):
    """Why a post was not accepted; ``is_final``: a repetition cannot succeed."""

    why: str
    is_final: bool


def changes(before: dict[str, Alarm], after: dict[str, Alarm]) -> list[tuple[str, Alarm]]:
    """The events between two lists, by name: ``raised`` (also to a higher severity), ``acknowledged``, ``ended``."""
    found = []
    for name, alarm in after.items():
        old = before.get(name)
        if old is None or (alarm.count, alarm.severity) != (old.count, old.severity):
            found.append(("raised", alarm))
        if alarm.acknowledged_by and (old is None or not old.acknowledged_by):
            found.append(("acknowledged", alarm))
        if alarm.ended and (old is None or not old.ended):
            found.append(("ended", alarm))
    return found + [("ended", old) for name, old in before.items() if name not in after and not old.ended]


class AlarmWebhook:
    """Posts the changes of the list of alarms; does nothing without a configured address.

    ``known``: the list at the end of the earlier session of the run, which has posted it.
    """

    def __init__(
        self, cfg: AlarmsConfig, run: str, log: structlog.typing.FilteringBoundLogger, known: Iterable[Alarm] = ()
    ) -> None:
        self._cfg = cfg
        self._run = run
        self._log = log
        self._alarms = {alarm.name: alarm for alarm in known}
        self._waiting: deque[AlarmPost] = deque()
        self._left_out = 0
        self._changed, self._is_over = threading.Condition(), False
        self._thread = threading.Thread(target=self._work, name="webhook", daemon=True)
        if cfg.webhook_url:
            self._thread.start()

    def update(self, status: MissionStatus | None) -> None:
        """Take the newest status; returns at once."""
        if not self._cfg.webhook_url or status is None:
            return
        alarms = {alarm.name: alarm for alarm in status.alarms}
        if alarms == self._alarms:
            return
        with self._changed:
            for event, alarm in changes(self._alarms, alarms):
                self._waiting.append(AlarmPost(event, self._run, status.state, alarm, left_out=self._left_out))
                self._left_out = 0
            while len(self._waiting) > MOST_WAITING:
                self._left_out += 1 + self._waiting[1].left_out
                del self._waiting[1]  # the first one is being posted
            self._changed.notify()
        self._alarms = alarms

    def close(self, patience_s: float) -> None:
        """End the thread; posts that cannot be sent within ``patience_s`` are logged as left out."""
        if not self._thread.is_alive():
            return
        with self._changed:
            self._is_over = True
            self._changed.notify()
        self._thread.join(patience_s)
        if left := self._left_out + sum(1 + post.left_out for post in list(self._waiting)):
            self._log.warning("alarm_posts_left_out", count=left)

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._waiting:
                    if self._is_over:
                        return
                    self._changed.wait()
                post = self._waiting[0]
            if not self._deliver(post):
                return
            with self._changed:
                self._waiting.popleft()

    def _deliver(self, post: AlarmPost) -> bool:
        """Post until it is accepted, finally refused, or too old; False: the run ended before."""
        begun_s, pause_s = time.monotonic(), FIRST_PAUSE_S
        while failure := self._post(post):
            if failure.is_final or time.monotonic() - begun_s + pause_s > self._cfg.webhook_give_up_s:
                self._log.warning("alarm_not_posted", name=post.alarm.name, what=post.event, why=failure.why)
                break
            with self._changed:
                if self._changed.wait_for(lambda: self._is_over, pause_s):
                    return False
            pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)
        return True

    def _post(self, post: AlarmPost) -> PostFailure | None:
        """Send a post; returns why it was not accepted, or ``None``."""
        headers = {"content-type": "application/json", "user-agent": "ccatp"}
        url, body = self._cfg.webhook_url, msgspec.json.encode(post)
        try:
            request = urllib.request.Request(url, body, headers, method="POST")  # noqa: S310 - http(s) by the configuration
            with urllib.request.urlopen(request, timeout=self._cfg.webhook_timeout_s):  # noqa: S310
                return None
        except urllib.error.HTTPError as error:
            with suppress(OSError):
                error.close()
            is_final = error.code < HTTPStatus.INTERNAL_SERVER_ERROR and error.code not in _PASSING
            return PostFailure(f"{'refused' if is_final else 'not taken'}: status {error.code}", is_final)
        except (OSError, ValueError) as error:
            return PostFailure(f"no answer: {error}", is_final=False)
