"""The dashboard process: started by the supervisor of a run, or separately (``ccatp dashboard``).

The supervisor binds the socket of the former, so that a restarted dashboard has the same address.
"""

import asyncio
import logging
import os
import socket
import sys
from collections.abc import Callable, Coroutine, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import structlog
import zmq

from ccatp.config.load import load_mission
from ccatp.daemon.operator.observatory import LOGGED_LINES, LOGGED_PERIOD_S
from ccatp.daemon.supervision.child_processes import open_page_socket, token_query
from ccatp.daemon.supervision.process import (
    Endpoints,
    RunContext,
    open_log,
    run_dir_in,
    run_until_stopped,
    start_process,
)
from ccatp.errors import ConfigError, DaemonUnreachableError
from ccatp.links.bus import HeartbeatPublisher, Publisher
from ccatp.links.liveness import LogRateLimit
from ccatp.links.runtime_dir import runtime_dir_path
from ccatp.missions import kind_of
from ccatp.records.recorder import TELEMETRY, read_metadata, recordings
from ccatp.report.dashboard.access import page_tokens
from ccatp.report.dashboard.app import CommandEndpoint, build_app, serve
from ccatp.report.dashboard.history import replay
from ccatp.report.dashboard.hub import BusReader, Page, StateBroadcaster
from ccatp.report.dashboard.view import run_ground

Logger = structlog.typing.FilteringBoundLogger
HEARTBEAT_PERIOD_S = 0.5
ROOT = "dashboard."


async def serve_page(
    run: RunContext, listener: socket.socket, stop: asyncio.Event, log: Logger, *, has_heartbeat: bool
) -> None:
    """Serve a dashboard until ``stop`` is set and the open pages have received the last state.

    The past of the run is read from its directory: points from the database, path and plots from the recording.
    ConfigError: the tokens cannot be read.
    """
    cfg, run_dir, endpoints, is_sim = run.config, run.run_dir, run.endpoints, run.is_sim
    settings, is_over = cfg.dashboard, asyncio.Event()
    tokens = page_tokens(settings, endpoints.runtime_dir)
    kind = kind_of(cfg)
    if kind.page is None:
        raise ConfigError(f"a {kind.title} has no page; see ccatp status")
    make: Callable[[Any, Path, bool], Page] = kind.page.get()
    view, past, ground, wants = make(cfg, run_dir, is_sim)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    reader = BusReader(context, endpoints.of, view, is_sim=is_sim, wants=wants)
    hub = StateBroadcaster(reader, view, settings.rate_hz)
    commands = CommandEndpoint(context, endpoints.of, settings.command_timeout_s)
    app = build_app(hub, commands, ground | run_ground(run_dir), settings, tokens=tokens, log=log)

    async def broadcast() -> None:
        await hub.run(stop)
        is_over.set()

    async def read_past() -> None:
        topics = ("mission", *wants.main, *wants.once, wants.track, wants.truth)
        await replay(recordings(run_dir / TELEMETRY), topics, lambda message: past.receive(message, 0.0))
        view.prepend(past)
        hub.send_everything()

    try:
        async with asyncio.TaskGroup() as tasks:
            heartbeat = tasks.create_task(_send_heartbeats(context, endpoints)) if has_heartbeat else None
            tasks.create_task(broadcast())
            reading = tasks.create_task(read_past())
            await serve(app, listener, settings, is_over)
            reading.cancel()
            if heartbeat is not None:
                heartbeat.cancel()
    finally:
        reader.close()
        context.destroy(linger=0)


async def _send_heartbeats(context: zmq.Context[zmq.Socket[bytes]], endpoints: Endpoints) -> None:
    heartbeat = HeartbeatPublisher(Publisher(context, endpoints.of("dashboard")), "dashboard")
    heartbeat.phase = "ready"
    while True:
        heartbeat.publish()
        await asyncio.sleep(HEARTBEAT_PERIOD_S)


def _run(run_dir: Path, serve_until: Callable[[asyncio.Event, Logger], Coroutine[Any, Any, None]]) -> int:
    async def run(stop: asyncio.Event) -> int:
        log = open_log(run_dir / "log.jsonl", "dashboard")
        for name in ("uvicorn.error", "asyncio"):
            logger = logging.getLogger(name)
            logger.handlers, logger.propagate = [_Handler(log)], False
            logger.setLevel(logging.WARNING)
        await serve_until(stop, log)
        return 0

    return run_until_stopped(run)


class _Handler(logging.Handler):
    def __init__(self, log: Logger) -> None:
        super().__init__(logging.WARNING)
        self._log, self._budget = log, LogRateLimit(LOGGED_LINES, LOGGED_PERIOD_S)

    def emit(self, record: logging.LogRecord) -> None:
        left_out = self._budget.take(record.created)
        if left_out is not None:
            self._log.log(
                record.levelno,
                "library_message",
                text=record.getMessage().strip(),
                exc_info=record.exc_info,
                left_out=left_out,
            )


def main() -> int:
    """Entry of ``python -m ccatp.daemon.operator.dashboard``."""
    args = start_process()
    listener = socket.socket(fileno=args.listen_fd)
    return _run(args.run_dir, partial(serve_page, args.run, listener, has_heartbeat=True))


def attach(runtime_dir: Path | None, settings: Mapping[str, object], report: Callable[[str], None]) -> int:
    """Serve a dashboard for a running daemon until SIGINT or SIGTERM; ``settings`` replace keys of ``dashboard``.

    DaemonUnreachableError: no daemon runs in the runtime directory; ConfigError: a key outside ``dashboard``, a token
    that cannot be read, or no address to listen on.
    """
    for key in settings:
        if not key.startswith(ROOT):
            raise ConfigError(f"--set: {key} is no key of the page; the daemon runs with what it has, see {ROOT}*")
    folder = runtime_dir_path(str(runtime_dir or ""), os.environ)
    run_dir = run_dir_in(folder)
    if run_dir is None or not (folder / "control").exists():
        raise DaemonUnreachableError(
            f"no daemon in {folder}; start one with ccatp run, or name its folder with --runtime-dir"
        )
    cfg = load_mission(run_dir / "config.toml", {**settings, f"{ROOT}enabled": True})
    page = open_page_socket(cfg.dashboard)
    if page.socket is None:
        raise ConfigError(page.text)
    is_sim = read_metadata(run_dir / TELEMETRY).get("simulation") == "true"
    with page.socket:
        report(page.text + token_query(cfg.dashboard, folder))
        context = RunContext(cfg, run_dir, Endpoints(folder), is_sim)
        return _run(run_dir, partial(serve_page, context, page.socket, has_heartbeat=False))


if __name__ == "__main__":
    sys.exit(main())
