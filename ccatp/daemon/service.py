"""The daemon as a systemd service: readiness, watchdog and status by the datagrams of ``sd_notify(3)``."""

import contextlib
import os
import socket
from collections.abc import Mapping, MutableMapping

from ccatp.links.liveness import STALE_AFTER_S, Liveness
from ccatp.links.topics import Heartbeat, MissionStatus

SOCKET, WATCHDOG_USEC, WATCHDOG_PID = "NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"


class Notifier:
    """Sends lines like ``READY=1`` to the service manager, if there is one.

    ``address`` is its datagram socket: a path, or a name in the abstract namespace behind ``@``; empty for none.
    """

    def __init__(self, address: str) -> None:
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.has_listener = address.startswith(("@", "/"))

    def send(self, *lines: str) -> None:
        """Send one datagram, without waiting for a service manager that does not read."""
        if not self.has_listener:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as peer:
            peer.setblocking(False)
            with contextlib.suppress(OSError):
                peer.sendto("\n".join(lines).encode(), self._address)


def watchdog_period_s(environ: Mapping[str, str]) -> float | None:
    """Period in which the service manager expects ``WATCHDOG=1`` from this process; ``None`` where it does not."""
    text = environ.get(WATCHDOG_USEC, "")
    if environ.get(WATCHDOG_PID, str(os.getpid())) != str(os.getpid()) or not text.isdecimal() or int(text) == 0:
        return None
    return int(text) * 1e-6


def is_journal(descriptor: int, environ: Mapping[str, str]) -> bool:
    """Whether what is written to a descriptor goes to the journal, which keeps it and shows it to others."""
    with contextlib.suppress(OSError):  # closed
        info = os.fstat(descriptor)
        return environ.get("JOURNAL_STREAM") == f"{info.st_dev}:{info.st_ino}"
    return False


def take_from(environ: MutableMapping[str, str]) -> tuple[Notifier, float | None]:
    """Notifier and watchdog period; their variables are removed, because the children must not use them."""
    notifier, period_s = Notifier(environ.get(SOCKET, "")), watchdog_period_s(environ)
    for name in (SOCKET, WATCHDOG_USEC, WATCHDOG_PID):
        environ.pop(name, None)
    return notifier, period_s


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
