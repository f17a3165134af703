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
from pathlib import Path
from typing import Any, NamedTuple

import structlog
import zmq

from ccatp.config.beacon_models import RadioConfig
from ccatp.config.load import is_radio_file, load_config, load_radio_config
from ccatp.config.models import Config, DashboardConfig
from ccatp.daemon import realtime as spinning
from ccatp.daemon.command_handlers import LOGGED_LINES, LOGGED_PERIOD_S
from ccatp.daemon.process import RUN_DIR_FILE, Endpoints, die_with_parent, open_log, parse_either, stop_on_signals
from ccatp.daemon.subscribers import HeartbeatPublisher
from ccatp.errors import ConfigError, DaemonUnreachableError
from ccatp.links.bus import Publisher
from ccatp.links.liveness import LogRateLimit
from ccatp.links.runtime_dir import runtime_dir_path
from ccatp.mirror.mirror import build_mirror
from ccatp.records.recorder import read_metadata
from ccatp.records.store import read_survey
from ccatp.records.store_rows import StoreError
from ccatp.report.dashboard.access import read_token
from ccatp.report.dashboard.app import CommandEndpoint, build_app, serve
from ccatp.report.dashboard.beacon_view import BeaconView, beacon_ground
from ccatp.report.dashboard.hub import BEACONS, SURVEY, BusReader, StateBroadcaster, Wants
from ccatp.report.dashboard.survey_view import SurveyView
from ccatp.report.dashboard.survey_view import ground as survey_ground
from ccatp.report.dashboard.view import RunStateView

Logger = structlog.typing.FilteringBoundLogger
HEARTBEAT_PERIOD_S = 0.5
BACKLOG = 64
ROOT = "dashboard."


class Dashboard:
    """The parts of a dashboard, put together.

    Args:
        run_dir: points that were measured before are read from its database.
        is_sim: robot and laser system are simulated.

    Raises:
        ConfigError: the token cannot be read.
    """

    def __init__(
        self, cfg: Config | RadioConfig, run_dir: Path, endpoints: Endpoints, *, is_sim: bool, log: Logger
    ) -> None:
        self._cfg, self._endpoints = cfg, endpoints
        token = read_token(cfg.dashboard)
        view, ground, wants = _view_of(cfg, run_dir, is_sim=is_sim, needs_token=token is not None)
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


async def run_dashboard(
    cfg: Config | RadioConfig, run_dir: Path, endpoints: Endpoints, listener: socket.socket, *, is_sim: bool,
    log: Logger, has_heartbeat: bool,
) -> None:  # fmt: skip
    """Serve a dashboard until SIGTERM or SIGINT; arguments as of ``Dashboard`` and its ``run``."""
    stop = asyncio.Event()
    stop_on_signals(stop)
    _log_warnings(log)
    dashboard = Dashboard(cfg, run_dir, endpoints, is_sim=is_sim, log=log)
    try:
        await dashboard.run(listener, stop, has_heartbeat=has_heartbeat)
    finally:
        dashboard.close()


def _view_of(
    cfg: Config | RadioConfig, run_dir: Path, *, is_sim: bool, needs_token: bool
) -> tuple[RunStateView, dict[str, Any], Wants]:
    if isinstance(cfg, RadioConfig):
        ground = beacon_ground(cfg, is_sim=is_sim, needs_token=needs_token)
        return BeaconView(cfg, is_sim=is_sim), ground, BEACONS
    mirror = build_mirror(cfg.mirror)
    view = SurveyView(mirror, cfg, is_sim=is_sim)
    _load_points(view, run_dir, mirror.name)
    return view, survey_ground(mirror, cfg, is_sim=is_sim, needs_token=needs_token), SURVEY


def _load_points(view: SurveyView, run_dir: Path, mirror: str) -> None:
    try:
        survey = read_survey(run_dir / "mission.sqlite", mirror)
    except StoreError:
        return  # nothing has been measured yet
    measured = [(stored.point, stored.fix.t_s, stored.fix.position_m) for stored in survey.fixes]
    view.begin_with(measured, [stored.point for stored in survey.points if stored.status == "skipped"])


def _rate_limited(log: Logger) -> Callable[[str, dict[str, object]], None]:
    # Everybody who reaches the port can cause these lines.
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


def _log_warnings(log: Logger) -> None:
    for name in ("uvicorn.error", "asyncio"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [_Handler(log)], False
        logger.setLevel(logging.WARNING)


def main() -> int:
    """Entry of ``python -m ccatp.daemon.dashboard``."""
    die_with_parent()
    args = parse_either().one
    if not args.is_realtime:
        spinning.leave_a_core(os.getppid())
    log = open_log(args.run_dir / "log.jsonl", "dashboard")
    listener = socket.socket(fileno=args.listen_fd)
    asyncio.run(
        run_dashboard(
            args.config, args.run_dir, args.endpoints, listener, is_sim=args.is_sim, log=log, has_heartbeat=True
        )
    )
    return 0


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
    try:
        listener = _listen(cfg.host, cfg.port)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            return PageSocket(None, cfg, "warning", _without(cfg, error))
    else:
        return _listening(listener, cfg, "info", "dashboard: ")
    try:
        listener = _listen(cfg.host, 0)
    except OSError as error:
        return PageSocket(None, cfg, "warning", _without(cfg, error))
    return _listening(listener, cfg, "warning", f"dashboard: port {cfg.port} is in use, so it is at ")


def page_url(host: str, port: int) -> str:
    """The page's address."""
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/"


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.create_server((host, port), family=family, backlog=BACKLOG)


def _listening(listener: socket.socket, cfg: DashboardConfig, level: str, before: str) -> PageSocket:
    port = listener.getsockname()[1]
    return PageSocket(listener, cfg.model_copy(update={"port": port}), level, before + page_url(cfg.host, port))


def _without(cfg: DashboardConfig, error: OSError) -> str:
    why = str(error.strerror).partition(" (while")[0]  # Python appends the address again
    return f"no dashboard: cannot listen on {cfg.host}:{cfg.port}: {why}; choose another dashboard.host"


def attach(runtime_dir: Path | None, settings: Mapping[str, object], say: Callable[[str], None]) -> int:
    """Serve a dashboard beside a running daemon until SIGINT or SIGTERM.

    Args:
        runtime_dir: of the daemon, if not the default one.
        settings: keys of ``dashboard`` that replace those of the run.

    Raises:
        DaemonUnreachableError: no daemon runs there.
        ConfigError: a key outside ``dashboard``, a token that cannot be read, or no address to listen on.
    """
    for key in settings:
        if not key.startswith(ROOT):
            raise ConfigError(f"--set: {key} is no key of the page; the daemon runs with what it has, see {ROOT}*")
    folder = runtime_dir_path(str(runtime_dir or ""), os.environ)
    run_dir = _run_dir_of(folder)
    path, wanted = run_dir / "config.toml", {**settings, f"{ROOT}enabled": True}
    cfg = load_radio_config(path, wanted) if is_radio_file(path) else load_config(path, wanted)
    page = open_page_socket(cfg.dashboard)
    if page.socket is None:
        raise ConfigError(page.text)
    is_sim = read_metadata(run_dir / "telemetry.mcap").get("simulation") == "true"
    log = open_log(run_dir / "log.jsonl", "dashboard")
    with page.socket:
        say(page.text)
        asyncio.run(
            run_dashboard(cfg, run_dir, Endpoints(folder), page.socket, is_sim=is_sim, log=log, has_heartbeat=False)
        )
    return 0


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
