"""Handlers of the operator channel and of the observatory channel (unix socket, and TCP for listed clients).

A command is answered after it took effect or was refused.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import msgspec
import structlog
import zmq.asyncio

from ccatp.config.models import ObservatoryConfig
from ccatp.daemon.mission_runner import OperableMission
from ccatp.links.auth import AuthorizedClient, ClientsFile, KeyPair, Role, read_clients, read_pair
from ccatp.links.channels import (
    BadRequest,
    EmergencyHandler,
    OperatorCommand,
    answer_observatory,
    format_error,
    format_ok,
    parse_operator,
    parse_reply,
)
from ccatp.links.liveness import LogRateLimit
from ccatp.links.rpc import Router, ZapHandler
from ccatp.links.topics import MissionStatus

# A robot at 0.1 m/s is at rest within half a second; a command that took no effect by then has failed.
EFFECT_TIMEOUT_S = 5.0
CAUSE = "operator"


@dataclass(frozen=True, slots=True)
class OperatorCommandHandler:
    """Applies the commands of an operator to the mission.

    Attributes:
        notify_operator: writes to log and terminal (level, text).
        settled: waits until the robot is at rest.
        on_change: called after a command changed the mission.
    """

    mission: OperableMission
    notify_operator: Callable[[str, str], None]
    status: Callable[[], MissionStatus]
    settled: Callable[[], Awaitable[None]]
    on_change: Callable[[], None]

    async def handle(self, frame: bytes) -> bytes:
        """The reply to one request."""
        try:
            command = parse_operator(frame).cmd
        except BadRequest as error:
            return format_error(str(error))
        if command is not OperatorCommand.STATUS:
            refusal = self._apply(command)
            if refusal is not None:
                return format_error(refusal)
            self.notify_operator("info", f"operator: {command}")
            self.on_change()
        try:
            if command in (OperatorCommand.PAUSE, OperatorCommand.STOP):
                async with asyncio.timeout(EFFECT_TIMEOUT_S):
                    await self.settled()
        except TimeoutError:
            return format_error(f"{command}: accepted, but the robot is not at rest after {EFFECT_TIMEOUT_S:.0f} s")
        return format_ok(status=msgspec.to_builtins(self.status()))

    def _apply(self, command: OperatorCommand) -> str | None:
        if command is OperatorCommand.PAUSE:
            return self.mission.pause(CAUSE)
        if command is OperatorCommand.RESUME:
            return self.mission.resume()
        if command is OperatorCommand.ABORT:
            return self.mission.abort(CAUSE)
        return self.mission.stop()


KEY_FILE, CLIENTS_FILE = "observatory.key_file", "observatory.clients_file"
# Access to the unix socket takes the daemon's own user, who might as well stop the daemon.
LOCAL = AuthorizedClient("local", Role.CLEAR)
# Repeated requests must not fill the log.
LOGGED_LINES, LOGGED_PERIOD_S = 10, 60.0


class EmergencyReceiver(EmergencyHandler, Protocol):
    """Danger rules that receive emergencies; ``ccatp.danger.DangerMonitor`` is one."""

    @property
    def at_base_or_held(self) -> bool:
        """Whether the robot is at base or held, by a fresh estimate."""


class EmergencyCommandHandler:
    """Applies the requests of the observatory to the danger rules, and logs them.

    ``age_s`` returns the age of the last frame, ``None`` before the first.
    """

    def __init__(
        self, monitor: EmergencyReceiver, age_s: Callable[[], float | None], log: structlog.typing.FilteringBoundLogger
    ) -> None:
        self._monitor, self._age_s, self.log = monitor, age_s, log
        self._accepted = LogRateLimit(LOGGED_LINES, LOGGED_PERIOD_S)
        self._refused = LogRateLimit(LOGGED_LINES, LOGGED_PERIOD_S)

    def answer(self, frame: bytes, client: AuthorizedClient = LOCAL) -> bytes:
        """The reply to a request of a client."""
        reply = answer_observatory(
            frame,
            self._monitor,
            at_base_or_held=self._monitor.at_base_or_held,
            age_s=self._age_s(),
            may_clear=client.role is Role.CLEAR,
        )
        answer = parse_reply(reply)
        if not answer["ok"]:
            self.log_refusal(client.name, answer["error"])
        elif "id" in answer and (left_out := self._accepted.take(time.monotonic())) is not None:
            text = frame.decode("utf-8", "replace")
            self.log.warning(
                "observatory_request", client=client.name, request=text, code=answer["code"], left_out=left_out
            )
        return reply

    def log_refusal(self, client: str, why: str) -> None:
        """Log a refused request."""
        left_out = self._refused.take(time.monotonic())
        if left_out is not None:
            self.log.warning("observatory_refused", client=client, why=why, left_out=left_out)


class ObservatoryServer:
    """The observatory channel: a unix socket, and TCP where it is configured.

    Raises:
        ConfigError: the keys or the list of clients cannot be used.
    """

    def __init__(self, local_endpoint: str, cfg: ObservatoryConfig, handler: EmergencyCommandHandler) -> None:
        self._local_endpoint, self._cfg, self._handler = local_endpoint, cfg, handler
        self._keys = check_observatory(cfg)
        self._clients = ClientsFile(Path(cfg.clients_file), CLIENTS_FILE)

    async def serve(self, context: zmq.asyncio.Context) -> None:
        """Bind, and answer until cancelled; raises ``RouterError`` where an endpoint cannot be bound."""
        async with AsyncExitStack() as stack:
            local = await stack.enter_async_context(Router(self._local_endpoint, self._handler.answer, context))
            work = [local.serve()]
            if self._keys is not None:
                zap = ZapHandler(context, lambda: self._clients.clients, self._on_refused_client)
                remote = Router(self._cfg.endpoint, self._answer_remote, context, self._keys)
                work.append((await stack.enter_async_context(zap)).serve())
                work.append((await stack.enter_async_context(remote)).serve())
                clients = len(self._clients.clients)
                self._handler.log.info("observatory_channel", endpoint=remote.bound, clients=clients)
            async with asyncio.TaskGroup() as tasks:
                for coroutine in work:
                    tasks.create_task(coroutine)

    def _answer_remote(self, frame: bytes, user_id: str) -> bytes:
        """A client that is taken off the list loses its rights at once, connected or not."""
        client = self._clients.clients.get(bytes.fromhex(user_id))
        if client is None:
            self._on_refused_client(f"key {user_id} is not on the list any more")
            return format_error("this client is not on the list any more")
        return self._handler.answer(frame, client)

    def _on_refused_client(self, why: str) -> None:
        self._handler.log_refusal("unknown", f"{why}; {self._clients.trouble}" if self._clients.trouble else why)


def check_observatory(cfg: ObservatoryConfig) -> KeyPair | None:
    """The server's keys, ``None`` where TCP is not configured.

    Raises:
        ConfigError: the keys or the list of clients cannot be used.
    """
    if not cfg.endpoint:
        return None
    read_clients(Path(cfg.clients_file), CLIENTS_FILE)
    return read_pair(Path(cfg.key_file), KEY_FILE)
