"""Glue. The dashboard's process: of a run, at the socket that it inherits, or alone, attached to a running daemon."""

import asyncio
import logging
import os
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import structlog
import zmq

from ccatp.bus import Publisher
from ccatp.config.models import Config
from ccatp.config.radio_models import RadioConfig
from ccatp.dashboard.app import build_app
from ccatp.dashboard.beacon_ground import beacon_ground
from ccatp.dashboard.beacon_view import BeaconView
from ccatp.dashboard.commands import CommandDesk
from ccatp.dashboard.feed import BEACONS, SURVEY, Feed, Wants
from ccatp.dashboard.ground import ground as survey_ground
from ccatp.dashboard.hub import Hub
from ccatp.dashboard.server import serve
from ccatp.dashboard.survey_view import SurveyView
from ccatp.dashboard.token_file import read_token
from ccatp.dashboard.view import View
from ccatp.mirror.mirror import build_mirror
from ccatp.processes import spinning
from ccatp.processes.common import Endpoints, die_with_parent, open_log, parse_either, stop_on_signals
from ccatp.processes.observing import LOGGED_LINES, LOGGED_PERIOD_S
from ccatp.processes.pulse import Pulse
from ccatp.repetition import LineBudget
from ccatp.storage.store_reader import read_survey
from ccatp.storage.store_rows import StoreError

Logger = structlog.typing.FilteringBoundLogger
PULSE_PERIOD_S = 0.5


class Shown(NamedTuple):
    """What a page shows of one kind of mission: its view, its ground, and the topics that make them."""

    view: View
    ground: dict[str, Any]
    wants: Wants


class Dashboard:
    """The parts of a dashboard, put together.

    Args:
        cfg: the run's configuration; ``dashboard`` holds the limits.
        run_dir: what was measured before is read from there.
        endpoints: where the run's processes are.
        is_sim: robot and laser system are stand-ins.
        log: of the process.

    Raises:
        ConfigError: the token cannot be read.
    """

    def __init__(
        self, cfg: Config | RadioConfig, run_dir: Path, endpoints: Endpoints, *, is_sim: bool, log: Logger
    ) -> None:
        """Subscribe."""
        self._cfg, self._log, self._endpoints = cfg, log, endpoints
        token = read_token(cfg.dashboard)
        view, ground, wants = _shown(cfg, run_dir, is_sim=is_sim, needs_token=token is not None)
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._feed = Feed(self._context, endpoints.of, view, is_sim=is_sim, wants=wants)
        self._hub = Hub(self._feed, view, cfg.dashboard.rate_hz)
        self._app = build_app(
            self._hub,
            CommandDesk(self._context, endpoints.of("control"), cfg.dashboard.command_timeout_s),
            ground,
            host_names=cfg.dashboard.host_names,
            token=token,
            note=_sparing(log),
        )

    async def run(self, listener: socket.socket, stop: asyncio.Event, *, has_pulse: bool) -> None:
        """Serve until ``stop`` is set.

        Args:
            listener: a listening socket.
            stop: the end.
            has_pulse: tell the supervisor that we are there.
        """
        told = asyncio.Event()

        async def tell() -> None:
            await self._hub.run(stop)
            told.set()  # the pages know that this is the end

        async with asyncio.TaskGroup() as tasks:
            pulse = tasks.create_task(self._beat()) if has_pulse else None
            tasks.create_task(tell())
            await serve(self._app, listener, self._cfg.dashboard, told)
            if pulse is not None:
                pulse.cancel()

    async def _beat(self) -> None:
        publisher = Publisher(self._context, self._endpoints.of("dashboard"))
        pulse = Pulse(publisher, "dashboard")
        pulse.phase = "ready"
        try:
            while True:
                pulse.tell()
                await asyncio.sleep(PULSE_PERIOD_S)
        finally:
            publisher.close()

    def close(self) -> None:
        """Close the sockets."""
        self._feed.close()
        self._context.destroy(linger=0)


async def run_dashboard(
    cfg: Config | RadioConfig, run_dir: Path, endpoints: Endpoints, listener: socket.socket, *, is_sim: bool,
    log: Logger, has_pulse: bool,
) -> None:  # fmt: skip
    """A dashboard from its beginning to SIGTERM or SIGINT; arguments as of ``Dashboard`` and its ``run``."""
    stop = asyncio.Event()
    stop_on_signals(stop)
    _log_warnings(log)
    dashboard = Dashboard(cfg, run_dir, endpoints, is_sim=is_sim, log=log)
    try:
        await dashboard.run(listener, stop, has_pulse=has_pulse)
    finally:
        dashboard.close()


def _shown(cfg: Config | RadioConfig, run_dir: Path, *, is_sim: bool, needs_token: bool) -> Shown:
    """THE table of missions for the page."""
    if isinstance(cfg, RadioConfig):
        ground = beacon_ground(cfg, is_sim=is_sim, needs_token=needs_token)
        return Shown(BeaconView(cfg, is_sim=is_sim), ground, BEACONS)
    mirror = build_mirror(cfg.mirror)
    view = SurveyView(mirror, cfg, is_sim=is_sim)
    _remember(view, run_dir, mirror.name)
    return Shown(view, survey_ground(mirror, cfg, is_sim=is_sim, needs_token=needs_token), SURVEY)


def _remember(view: SurveyView, run_dir: Path, mirror: str) -> None:
    """What stands in the mission's database is on the page, whoever measured it; without one there is nothing yet."""
    try:
        survey = read_survey(run_dir / "mission.sqlite", mirror)
    except StoreError:
        return
    measured = [(stored.point, stored.fix.t_s, stored.fix.position_m) for stored in survey.fixes]
    view.begin_with(measured, [stored.point for stored in survey.points if stored.status == "skipped"])


def _sparing(log: Logger) -> Callable[[str, dict[str, object]], None]:
    """Lines for the log, at most so many in a minute: whoever reaches the port can cause them."""
    budget = LineBudget(LOGGED_LINES, LOGGED_PERIOD_S)

    def note(text: str, fields: dict[str, object]) -> None:
        left_out = budget.take(asyncio.get_running_loop().time())
        if left_out is not None:
            log.info(text, **fields, left_out=left_out)

    return note


class _Handler(logging.Handler):
    """Warnings of the HTTP server go where ours go."""

    def __init__(self, log: Logger) -> None:
        super().__init__(logging.WARNING)
        self._log, self._budget = log, LineBudget(LOGGED_LINES, LOGGED_PERIOD_S)

    def emit(self, record: logging.LogRecord) -> None:
        left_out = self._budget.take(record.created)
        if left_out is not None:
            self._log.log(record.levelno, record.getMessage().strip(), exc_info=record.exc_info, left_out=left_out)


def _log_warnings(log: Logger) -> None:
    for name in ("uvicorn.error", "asyncio"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [_Handler(log)], False
        logger.setLevel(logging.WARNING)


def main() -> int:
    """Entry of ``python -m ccatp.processes.dashboard``."""
    die_with_parent()
    args = parse_either().one
    if not args.is_realtime:
        spinning.leave_a_core(os.getppid())
    log = open_log(args.run_dir / "log.jsonl", "dashboard")
    listener = socket.socket(fileno=args.listen_fd)
    asyncio.run(
        run_dashboard(args.config, args.run_dir, args.endpoints, listener, is_sim=args.is_sim, log=log, has_pulse=True)
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
