"""Edge. Tells the service manager how the daemon fares: the datagrams of ``sd_notify(3)``."""

import contextlib
import os
import socket
from collections.abc import Mapping, MutableMapping

SOCKET, WATCHDOG_USEC, WATCHDOG_PID = "NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"


class Notifier:
    """Sends lines like ``READY=1`` to the service manager, or to nobody where none listens.

    Args:
        address: its datagram socket: a path, or a name in the abstract namespace behind ``@``; empty for none.
    """

    def __init__(self, address: str) -> None:
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.is_heard = address.startswith(("@", "/"))

    def send(self, *lines: str) -> None:
        """Send one datagram. A service manager that is gone or does not read holds nobody up."""
        if not self.is_heard:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as peer:
            peer.setblocking(False)
            with contextlib.suppress(OSError):
                peer.sendto("\n".join(lines).encode(), self._address)


def watchdog_period_s(environ: Mapping[str, str]) -> float | None:
    """How often the service manager wants to hear ``WATCHDOG=1`` from this process; ``None`` where it does not."""
    text = environ.get(WATCHDOG_USEC, "")
    if environ.get(WATCHDOG_PID, str(os.getpid())) != str(os.getpid()) or not text.isdecimal() or int(text) == 0:
        return None
    return int(text) * 1e-6


def take_from(environ: MutableMapping[str, str]) -> tuple[Notifier, float | None]:
    """Notifier and watchdog period, taken out of the environment: they are not the children's."""
    notifier, period_s = Notifier(environ.get(SOCKET, "")), watchdog_period_s(environ)
    for name in (SOCKET, WATCHDOG_USEC, WATCHDOG_PID):
        environ.pop(name, None)
    return notifier, period_s
