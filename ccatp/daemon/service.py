"""The daemon as a systemd service: when it says that it is ready, that it lives, and what it does."""

from ccatp.links.liveness import STALE_AFTER_S, Liveness
from ccatp.links.service_manager import Notifier
from ccatp.links.topics import Heartbeat, MissionStatus

STATUS_PERIOD_S = 1.0
# Messages in a watchdog period, and the part of it after which silence of a loop withholds them.
STROKES, STALE_SHARE = 4.0, 0.5


class Service:
    """Reports the state of the run to the service manager; ``watchdog_s`` is None without a watchdog."""

    def __init__(self, notifier: Notifier, watchdog_s: float | None) -> None:
        self._notifier, self._watchdog_s = notifier, watchdog_s
        self._liveness = Liveness(min(STALE_AFTER_S, STALE_SHARE * (watchdog_s or STALE_AFTER_S / STALE_SHARE)))
        self._is_ready = self._is_troubled = False
        self._stroked_s = self._sent_s = float("-inf")
        self._text = ""

    def on_heartbeat(self, heartbeat: Heartbeat) -> None:
        """A heartbeat was received."""
        self._liveness.update(heartbeat)

    def update(self, now_s: float, status: MissionStatus | None, *, is_recovering: bool = False) -> None:
        """Send due messages; while ``is_recovering`` from a restart the watchdog is served in any case."""
        if not self._notifier.has_listener:
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
        text = f"trouble: {trouble}" if trouble else _status_text(status)
        if text != self._text and (has_turned or now_s - self._sent_s >= STATUS_PERIOD_S):
            self._text, self._sent_s = text, now_s
            self._notifier.send(f"STATUS={text}")

    def stopping(self) -> None:
        """The run ends."""
        self._notifier.send("STOPPING=1", "STATUS=holding the wheels and saving")


def _status_text(status: MissionStatus | None) -> str:
    if status is None:
        return "joined the robot"
    cause = f" ({status.cause})" if status.cause else ""
    return f"{status.state}{cause}, {status.done} of {status.total} points"
