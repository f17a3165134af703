"""Edge. uvicorn for the dashboard: it ends when it is told to, and drops who holds it up."""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Iterator

import uvicorn
from starlette.types import ASGIApp

from ccatp.config.models import DashboardConfig
from ccatp.dashboard.guarded import guarded

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
        app: the application.
        listener: a listening socket; it is closed in the end.
        cfg: limits.
        stop: the end.
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
