"""The dashboard process: of a run, at a socket that the supervisor has bound, or beside a daemon (``ccatp dashboard``).

The supervisor binds the socket, so that a restarted dashboard has the same address.
"""

import asyncio
import errno
import logging
import os
import socket
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import structlog
import zmq

from ccatp.config.beacon_models import RadioConfig
from ccatp.config.models import Config, DashboardConfig
from ccatp.daemon.command_handlers import LOGGED_LINES, LOGGED_PERIOD_S
from ccatp.daemon.process import (
    RUN_DIR_FILE,
    Endpoints,
    listen_at,
    open_log,
    read_config,
    run_until_stopped,
    start_process,
)
from ccatp.daemon.subscribers import HeartbeatPublisher
from ccatp.errors import ConfigError, DaemonUnreachableError
from ccatp.links.bus import Publisher
from ccatp.links.liveness import LogRateLimit
from ccatp.links.runtime_dir import runtime_dir_path
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.records.recorder import TELEMETRY, read_metadata
from ccatp.records.store import StoreError, read_survey
from ccatp.report.dashboard.access import read_token
from ccatp.report.dashboard.app import CommandEndpoint, build_app, serve
from ccatp.report.dashboard.beacon_view import BeaconView, beacon_ground
from ccatp.report.dashboard.hub import BEACONS, SURVEY, BusReader, StateBroadcaster
from ccatp.report.dashboard.survey_view import SurveyView
from ccatp.report.dashboard.survey_view import ground as survey_ground
from ccatp.report.dashboard.view import RunStateView

Logger = structlog.typing.FilteringBoundLogger
HEARTBEAT_PERIOD_S = 0.5
ROOT = "dashboard."


class Dashboard:
    """A dashboard; points that were measured before are read from the database in ``run_dir``.

    Raises:
        ConfigError: the token cannot be read.
    """

    def __init__(
        self, cfg: Config | RadioConfig, run_dir: Path, endpoints: Endpoints, *, is_sim: bool, log: Logger
    ) -> None:
        self._cfg, self._endpoints = cfg, endpoints
        token = read_token(cfg.dashboard)
        view: RunStateView
        if isinstance(cfg, RadioConfig):
            view, wants = BeaconView(cfg, is_sim=is_sim), BEACONS
            ground = beacon_ground(cfg, is_sim=is_sim, needs_token=token is not None)
        else:
            mirror = build_mirror(cfg.mirror)
            view, wants = _survey_view(mirror, cfg, run_dir, is_sim=is_sim), SURVEY
            ground = survey_ground(mirror, cfg, is_sim=is_sim, needs_token=token is not None)
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._reader = BusReader(self._context, endpoints.of, view, is_sim=is_sim, wants=wants)
        self._hub = StateBroadcaster(self._reader, view, cfg.dashboard.rate_hz)
        self._app = build_app(
            self._hub,
            CommandEndpoint(self._context, endpoints.of("control"), cfg.dashboard.command_timeout_s),
            ground,
            host_names=cfg.dashboard.host_names,
            token=token,
            note=_rate_limited(log),
        )

    async def run(self, listener: socket.socket, stop: asyncio.Event, *, has_heartbeat: bool) -> None:
        """Serve until ``stop`` is set and the open pages have got the last state."""
        is_over = asyncio.Event()

        async def broadcast() -> None:
            await self._hub.run(stop)
            is_over.set()

        async with asyncio.TaskGroup() as tasks:
            heartbeat = tasks.create_task(self._send_heartbeats()) if has_heartbeat else None
            tasks.create_task(broadcast())
            await serve(self._app, listener, self._cfg.dashboard, is_over)
            if heartbeat is not None:
                heartbeat.cancel()

    async def _send_heartbeats(self) -> None:
        publisher = Publisher(self._context, self._endpoints.of("dashboard"))
        heartbeat = HeartbeatPublisher(publisher, "dashboard")
        heartbeat.phase = "ready"
        try:
            while True:
                heartbeat.publish()
                await asyncio.sleep(HEARTBEAT_PERIOD_S)
        finally:
            publisher.close()

    def close(self) -> None:
        """Close the sockets."""
        self._reader.close()
        self._context.destroy(linger=0)


def _survey_view(mirror: Mirror, cfg: Config, run_dir: Path, *, is_sim: bool) -> SurveyView:
    view = SurveyView(mirror, cfg, is_sim=is_sim)
    with suppress(StoreError):  # nothing has been measured yet
        survey = read_survey(run_dir / "mission.sqlite", mirror.name)
        measured = [(stored.point, stored.fix.t_s, stored.fix.position_m) for stored in survey.fixes]
        view.begin_with(measured, [stored.point for stored in survey.points if stored.status == "skipped"])
    return view


def _run(make: Callable[[Logger], Dashboard], run_dir: Path, listener: socket.socket, *, has_heartbeat: bool) -> int:
    """Serve a dashboard until SIGTERM or SIGINT."""

    async def run(stop: asyncio.Event) -> int:
        log = open_log(run_dir / "log.jsonl", "dashboard")
        for name in ("uvicorn.error", "asyncio"):
            logger = logging.getLogger(name)
            logger.handlers, logger.propagate = [_Handler(log)], False
            logger.setLevel(logging.WARNING)
        dashboard = make(log)
        try:
            await dashboard.run(listener, stop, has_heartbeat=has_heartbeat)
        finally:
            dashboard.close()
        return 0

    return run_until_stopped(run)


def _rate_limited(log: Logger) -> Callable[[str, dict[str, object]], None]:
    # Every client of the port can cause these lines.
    budget = LogRateLimit(LOGGED_LINES, LOGGED_PERIOD_S)

    def note(text: str, fields: dict[str, object]) -> None:
        left_out = budget.take(asyncio.get_running_loop().time())
        if left_out is not None:
            log.info(text, **fields, left_out=left_out)

    return note


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
    """Entry of ``python -m ccatp.daemon.dashboard``."""
    args = start_process()

    def make(log: Logger) -> Dashboard:
        return Dashboard(args.config, args.run_dir, args.endpoints, is_sim=args.is_sim, log=log)

    return _run(make, args.run_dir, socket.socket(fileno=args.listen_fd), has_heartbeat=True)


class PageSocket(NamedTuple):
    """The listening socket, ``None`` without a dashboard, and the message for the operator, which may be empty."""

    socket: socket.socket | None
    config: DashboardConfig
    level: str
    text: str


def open_page_socket(cfg: DashboardConfig) -> PageSocket:
    """Listen at the configured address, or at another port if that one is in use; a survey runs without a page, too."""
    if not cfg.enabled:
        return PageSocket(None, cfg, "info", "")
    level, before = "info", "dashboard: "
    try:
        try:
            listener = listen_at(cfg.host, cfg.port)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            level, before = "warning", f"dashboard: port {cfg.port} is in use, so it is at "
            listener = listen_at(cfg.host, 0)
    except OSError as error:
        where = f"{cfg.host}:{cfg.port}"
        text = f"no dashboard: cannot listen on {where}: {error.strerror}; choose another dashboard.host"
        return PageSocket(None, cfg, "warning", text)
    port = listener.getsockname()[1]
    return PageSocket(listener, cfg.model_copy(update={"port": port}), level, before + page_url(cfg.host, port))


def page_url(host: str, port: int) -> str:
    """The page's address."""
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/"


def attach(runtime_dir: Path | None, settings: Mapping[str, object], say: Callable[[str], None]) -> int:
    """Serve a dashboard beside a running daemon until SIGINT or SIGTERM; ``settings`` replace keys of ``dashboard``.

    Raises:
        DaemonUnreachableError: no daemon runs in the runtime directory.
        ConfigError: a key outside ``dashboard``, a token that cannot be read, or no address to listen on.
    """
    for key in settings:
        if not key.startswith(ROOT):
            raise ConfigError(f"--set: {key} is no key of the page; the daemon runs with what it has, see {ROOT}*")
    folder = runtime_dir_path(str(runtime_dir or ""), os.environ)
    run_dir = _run_dir_of(folder)
    cfg = read_config(run_dir / "config.toml", {**settings, f"{ROOT}enabled": True})
    page = open_page_socket(cfg.dashboard)
    if page.socket is None:
        raise ConfigError(page.text)
    is_sim = read_metadata(run_dir / TELEMETRY).get("simulation") == "true"

    def make(log: Logger) -> Dashboard:
        return Dashboard(cfg, run_dir, Endpoints(folder), is_sim=is_sim, log=log)

    with page.socket:
        say(page.text)
        return _run(make, run_dir, page.socket, has_heartbeat=False)


def _run_dir_of(runtime_dir: Path) -> Path:
    try:
        run_dir = Path((runtime_dir / RUN_DIR_FILE).read_text(encoding="utf-8").strip())
    except OSError:
        run_dir = None
    if run_dir is None or not (runtime_dir / "control").exists():
        raise DaemonUnreachableError(
            f"no daemon in {runtime_dir}; start one with ccatp run, or name its folder with --runtime-dir"
        )
    return run_dir


if __name__ == "__main__":
    sys.exit(main())
