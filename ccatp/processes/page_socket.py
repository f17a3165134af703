"""Glue. Where the dashboard listens: bound by the supervisor, so that one that is started anew is found there again."""

import errno
import socket
from typing import NamedTuple

from ccatp.config.models import DashboardConfig

BACKLOG = 64


class PageSocket(NamedTuple):
    """What came of the wish to listen.

    Attributes:
        socket: it listens; ``None`` where there is no dashboard.
        config: with the port that it has.
        level, text: what the operator is told; empty when there is nothing to tell.
    """

    socket: socket.socket | None
    config: DashboardConfig
    level: str
    text: str


def open_page_socket(cfg: DashboardConfig) -> PageSocket:
    """Listen at the configured address, or at another port when that one is in use; a survey goes on without a page.

    Args:
        cfg: address, and whether a page is wanted at all.
    """
    if not cfg.enabled:
        return PageSocket(None, cfg, "info", "")
    try:
        listener = _listen(cfg.host, cfg.port)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            return PageSocket(None, cfg, "warning", _without(cfg, error))
    else:
        return _told(listener, cfg, "info", "dashboard: ")
    try:
        listener = _listen(cfg.host, 0)
    except OSError as error:
        return PageSocket(None, cfg, "warning", _without(cfg, error))
    return _told(listener, cfg, "warning", f"dashboard: port {cfg.port} is in use, so it is at ")


def page_url(host: str, port: int) -> str:
    """The page's address."""
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/"


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.create_server((host, port), family=family, backlog=BACKLOG)


def _told(listener: socket.socket, cfg: DashboardConfig, level: str, before: str) -> PageSocket:
    port = listener.getsockname()[1]
    return PageSocket(listener, cfg.model_copy(update={"port": port}), level, before + page_url(cfg.host, port))


def _without(cfg: DashboardConfig, error: OSError) -> str:
    why = str(error.strerror).partition(" (while")[0]  # Python appends the address once more
    return f"no dashboard: cannot listen on {cfg.host}:{cfg.port}: {why}; choose another dashboard.host"
