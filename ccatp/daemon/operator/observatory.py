"""The observatory channel: a unix socket, and TCP for listed clients; its requests go to the danger rules."""

import asyncio
import time
from collections.abc import Callable
from contextlib import AsyncExitStack
from pathlib import Path

import structlog
import zmq.asyncio

from ccatp.config.models import ObservatoryConfig
from ccatp.links.auth import AuthorizedClient, ClientsFile, KeyPair, read_clients, read_pair
from ccatp.links.channels import format_error, parse_reply
from ccatp.links.liveness import LogRateLimit
from ccatp.links.rpc import Router, ZapHandler
from ccatp.safety.emergency_latch import EmergencyRules, answer_observatory

KEY_FILE, CLIENTS_FILE = "observatory.key_file", "observatory.clients_file"
# Only the daemon's own user can use the unix socket, and this user could also stop the daemon.
LOCAL = AuthorizedClient("local", "clear")
# Limits the log lines of repeated requests.
LOGGED_LINES, LOGGED_PERIOD_S = 10, 60.0


class ObservatoryServer:
    """Answers the observatory, and logs its requests.

    ``age_s``: returns the age of the last frame, ``None`` before the first. ConfigError: the keys or the list of
    clients cannot be used.
    """

    def __init__(
        self,
        local_endpoint: str,
        cfg: ObservatoryConfig,
        monitor: EmergencyRules,
        age_s: Callable[[], float | None],
        log: structlog.typing.FilteringBoundLogger,
    ) -> None:
        self._local_endpoint = local_endpoint
        self._cfg = cfg
        self._keys = check_observatory(cfg)
        self._monitor = monitor
        self._age_s = age_s
        self._log = log
        self._clients = ClientsFile(Path(cfg.clients_file), CLIENTS_FILE)
        self._accepted = LogRateLimit(LOGGED_LINES, LOGGED_PERIOD_S)
        self._refused = LogRateLimit(LOGGED_LINES, LOGGED_PERIOD_S)

    async def serve(self, context: zmq.asyncio.Context) -> None:
        """Bind, and answer until cancelled. Raises ``RouterError`` if an endpoint cannot be bound."""
        async with AsyncExitStack() as stack:
            local = await stack.enter_async_context(Router(self._local_endpoint, self.answer, context))
            work = [local.serve()]
            if self._keys is not None:
                zap = ZapHandler(context, lambda: self._clients.clients, self._log_unknown)
                remote = Router(self._cfg.endpoint, self._answer_remote, context, self._keys)
                work.append((await stack.enter_async_context(zap)).serve())
                work.append((await stack.enter_async_context(remote)).serve())
                clients = len(self._clients.clients)
                self._log.info("observatory_channel", endpoint=remote.bound, clients=clients)
            async with asyncio.TaskGroup() as tasks:
                for coroutine in work:
                    tasks.create_task(coroutine)

    def answer(self, frame: bytes, client: AuthorizedClient = LOCAL) -> bytes:
        """The reply to a request of a client."""
        monitor, may_clear = self._monitor, client.role == "clear"
        reply = answer_observatory(
            frame, monitor, at_base_or_held=monitor.at_base_or_held, age_s=self._age_s(), may_clear=may_clear
        )
        answer = parse_reply(reply)
        if not answer["ok"]:
            self._log_refusal(client.name, answer["error"])
        elif "id" in answer and (left_out := self._accepted.take(time.monotonic())) is not None:
            text, code = frame.decode("utf-8", "replace"), answer["code"]
            self._log.warning("observatory_request", client=client.name, request=text, code=code, left_out=left_out)
        return reply

    def _answer_remote(self, frame: bytes, user_id: str) -> bytes:
        """A client that was removed from the list loses its rights at once, even if it is connected."""
        client = self._clients.clients.get(user_id)
        if client is None:
            self._log_unknown(f"key {user_id} is not on the list any more")
            return format_error("this client is not on the list any more")
        return self.answer(frame, client)

    def _log_unknown(self, why: str) -> None:
        self._log_refusal("unknown", f"{why}; {self._clients.trouble}" if self._clients.trouble else why)

    def _log_refusal(self, client: str, why: str) -> None:
        left_out = self._refused.take(time.monotonic())
        if left_out is not None:
            self._log.warning("observatory_refused", client=client, why=why, left_out=left_out)


def check_observatory(cfg: ObservatoryConfig) -> KeyPair | None:
    """The server's keys, ``None`` without TCP. ConfigError: the keys or the list of clients cannot be used."""
    if not cfg.endpoint:
        return None
    read_clients(Path(cfg.clients_file), CLIENTS_FILE)
    return read_pair(Path(cfg.key_file), KEY_FILE)
