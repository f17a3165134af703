"""uvicorn for the dashboard: it ends when it is told to, and drops who holds it up.

HTTP connections with limits: so many of them, and each only as long as its other end takes part.
"""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from ccatp.config.models import DashboardConfig

# Of what a client does not take no more than this waits in the kernel: a page that stands still shows within seconds.
SEND_BUFFER_BYTES = 65_536


class GuardedProtocol(H11Protocol):
    """One connection. Newcomers beyond the limit are turned away, those who are in stay.

    Attributes:
        slow_client_s: dropped is who has sent no whole request for this long, or takes nothing of an answer.
    """

    limit: ClassVar[int]
    slow_client_s: ClassVar[float]
    _slow: asyncio.TimerHandle | None = None
    _is_turned_away = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Somebody connects."""
        if len(self.connections) >= self.limit:
            self._is_turned_away = True
            transport.abort()
            return
        peer = transport.get_extra_info("socket")
        if peer is not None:
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        super().connection_made(transport)
        self._watch(self._drop_without_request)

    def connection_lost(self, exc: Exception | None) -> None:
        """They are gone."""
        self._unwatch()
        if not self._is_turned_away:
            super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Part of a request; the rest of it has to follow."""
        super().data_received(data)
        if not self._is_without_request():
            if not self.flow.write_paused:
                self._unwatch()  # between requests the server's own patience counts
        elif self._slow is None:
            self._watch(self._drop_without_request)

    def pause_writing(self) -> None:
        """They take nothing."""
        super().pause_writing()
        self._watch(self.transport.abort)

    def resume_writing(self) -> None:
        """They have taken something."""
        super().resume_writing()
        self._unwatch()

    def _is_without_request(self) -> bool:
        return not self.headers or self.cycle.response_complete

    def _drop_without_request(self) -> None:
        self._slow = None
        if self._is_without_request():
            self.transport.abort()

    def _watch(self, drop: Callable[[], Any]) -> None:
        self._unwatch()
        self._slow = self.loop.call_later(self.slow_client_s, drop)

    def _unwatch(self) -> None:
        if self._slow is not None:
            self._slow.cancel()
            self._slow = None


def guarded(connections: int, silence_s: float) -> type[GuardedProtocol]:
    """The protocol with these limits.

    Args:
        silence_s: see ``GuardedProtocol``.
    """

    class Limited(GuardedProtocol):
        limit, slow_client_s = connections, silence_s

    return Limited


# Answers on their way when the end comes have this long; pages are told the end before that.
GRACE_S = 1
KEEP_ALIVE_S = 5
MAX_REQUEST_BYTES = 16_384


class _Server(uvicorn.Server):
    """Without handlers of signals: they are the process's own business."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


async def serve(app: ASGIApp, listener: socket.socket, cfg: DashboardConfig, stop: asyncio.Event) -> None:
    """Serve until ``stop`` is set; then within ``GRACE_S``, whoever is connected.

    Args:
        listener: a listening socket; it is closed in the end.
    """
    logging.getLogger("uvicorn.access").disabled = True
    config = uvicorn.Config(
        app,
        http=guarded(cfg.max_connections, cfg.slow_client_s),
        ws="none",
        loop="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        proxy_headers=False,
        server_header=False,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=GRACE_S,
        h11_max_incomplete_event_size=MAX_REQUEST_BYTES,
    )
    server = _Server(config)

    async def end() -> None:
        await stop.wait()
        server.should_exit = True

    async with asyncio.TaskGroup() as tasks:
        ending = tasks.create_task(end())
        await server.serve(sockets=[listener])
        ending.cancel()
