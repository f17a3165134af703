"""Notifications to the service manager, by the datagrams of ``sd_notify(3)``."""

import contextlib
import os
import socket
from collections.abc import Mapping, MutableMapping

SOCKET, WATCHDOG_USEC, WATCHDOG_PID = "NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"
# For one process; its children must not use them.
VARIABLES = SOCKET, WATCHDOG_USEC, WATCHDOG_PID


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
    """Period in which the service manager expects ``WATCHDOG=1`` from this process; ``None``: it does not."""
    text = environ.get(WATCHDOG_USEC, "")
    if environ.get(WATCHDOG_PID, str(os.getpid())) != str(os.getpid()) or not text.isdecimal() or int(text) == 0:
        return None
    return int(text) * 1e-6


def is_journal(descriptor: int, environ: Mapping[str, str]) -> bool:
    """Whether a descriptor is connected to the journal, which others can read."""
    with contextlib.suppress(OSError):  # closed
        info = os.fstat(descriptor)
        return environ.get("JOURNAL_STREAM") == f"{info.st_dev}:{info.st_ino}"
    return False


def take_from(environ: MutableMapping[str, str]) -> tuple[Notifier, float | None]:
    """Notifier and watchdog period; their variables are removed."""
    notifier, period_s = Notifier(environ.get(SOCKET, "")), watchdog_period_s(environ)
    for name in VARIABLES:
        environ.pop(name, None)
    return notifier, period_s
