"""Glue. The daemon as a service: ready when the loops have joined, the watchdog stroked while all is well, an end."""

from ccatp.liveness import STALE_AFTER_S, Liveness
from ccatp.supervision.service_notify import Notifier
from ccatp.wire.topics import MissionStatus, Presence

STATUS_PERIOD_S = 1.0
# Strokes in a watchdog period, and the part of it after which silence of a loop withholds them.
STROKES, STALE_SHARE = 4.0, 0.5


class Service:
    """Tells the service manager what the supervisor hears.

    Args:
        notifier: to the service manager.
        watchdog_s: its watchdog's period, ``None`` without one.
    """

    def __init__(self, notifier: Notifier, watchdog_s: float | None) -> None:
        """Nothing told yet."""
        self._notifier, self._watchdog_s = notifier, watchdog_s
        self._liveness = Liveness(min(STALE_AFTER_S, STALE_SHARE * (watchdog_s or STALE_AFTER_S / STALE_SHARE)))
        self._is_ready = self._is_troubled = False
        self._stroked_s = self._told_s = float("-inf")
        self._text = ""

    def heard(self, presence: Presence) -> None:
        """A loop is there."""
        self._liveness.heard(presence)

    def beat(self, now_s: float, status: MissionStatus | None, *, is_recovering: bool = False) -> None:
        """Tell what is due.

        Args:
            now_s: time of the machine's monotonic clock.
            status: where the mission stands, once it is known.
            is_recovering: the supervisor has just started a process anew; the manager is not to end all of it.
        """
        if not self._notifier.is_heard:
            return
        if not self._is_ready:
            if self._liveness.has_joined:
                self._is_ready = True
                self._notifier.send("READY=1")
            return
        trouble = self._liveness.trouble(now_s)
        may_stroke = is_recovering or not trouble
        if self._watchdog_s is not None and may_stroke and now_s - self._stroked_s >= self._watchdog_s / STROKES:
            self._stroked_s = now_s
            self._notifier.send("WATCHDOG=1")
        has_turned, self._is_troubled = bool(trouble) != self._is_troubled, bool(trouble)
        text = f"trouble: {trouble}" if trouble else _told(status)
        if text != self._text and (has_turned or now_s - self._told_s >= STATUS_PERIOD_S):
            self._text, self._told_s = text, now_s
            self._notifier.send(f"STATUS={text}")

    def stopping(self) -> None:
        """The run ends."""
        self._notifier.send("STOPPING=1", "STATUS=holding the wheels and saving")


def _told(status: MissionStatus | None) -> str:
    if status is None:
        return "joined the robot"
    cause = f" ({status.cause})" if status.cause else ""
    return f"{status.state}{cause}, {status.done} of {status.total} points"
