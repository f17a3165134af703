"""Keeps the list of alarms up to date: what danger finds, and why the mission is held, goes home or waits."""

from collections.abc import Iterable

import zmq

from ccatp.conditions import Owner, find_condition
from ccatp.core import Cause, Severity, Verdict
from ccatp.daemon.operator.alarms import ActiveCause, AlarmList, active_cause
from ccatp.links.bus import Subscriber
from ccatp.links.topics import DangerEvent


class AlarmWatch:
    """Raises and ends the alarms of ``alarms``; receives the findings of danger at its ``endpoint``."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, alarms: AlarmList) -> None:
        self.alarms = alarms
        # Separate from the verdicts, which are read with the frames, because findings are reported without frames, too.
        self._events = Subscriber(context, [endpoint], ["danger_event"], is_uncounted=True)
        # Danger reports changes. What it had found when this process began lasts until it reports something else.
        self._danger_active = [
            ActiveCause(one.name, one.cause, Severity[one.severity.upper()])
            for one in alarms.alarms
            if not one.ended and (row := find_condition(one.name)) is not None and row.owner is Owner.DANGER
        ]

    def update(self, causes: Iterable[Cause], verdict: Verdict | None, t_s: float) -> None:
        """Take the causes of the mission at robot time ``t_s``, the newest verdict, and danger's events so far."""
        own = [active_cause(cause) for cause in causes]
        if verdict is not None and not verdict.cause and not verdict.raised:
            self._danger_active = []
        while (received := self._events.receive()) is not None:
            event = received[2]
            if isinstance(event, DangerEvent):
                self._danger_active = [ActiveCause(name, cause, Severity(grave)) for name, cause, grave in event.active]
                self.alarms.update([*own, *self._danger_active], event.t_s)
        self.alarms.update([*own, *self._danger_active], t_s)

    def close(self) -> None:
        """Close the socket."""
        self._events.close()
