"""The operator channel: a unix socket for ``ccatp status``, ``pause``, ``resume``, ``abort``, ``stop``."""

import asyncio
from typing import Protocol

import zmq.asyncio

from ccatp.links.channels import (
    BadRequest,
    OperatorCommand,
    OperatorRequest,
    format_error,
    format_ok,
    parse_operator,
)
from ccatp.links.rpc import Router
from ccatp.links.topics import MissionStatus

# A robot at 0.1 m/s is at rest within half a second; a command without effect after this time has failed.
EFFECT_TIMEOUT_S = 5.0
EFFECT_POLL_S = 0.02


class CommandedLoop(Protocol):
    """What the channel needs of the main loop."""

    @property
    def is_settled(self) -> bool:
        """The robot is at rest, or the process ends."""

    def apply(self, request: OperatorRequest) -> str | None:
        """Give a command to the mission; the reason of a refusal, or ``None``."""

    def status(self) -> MissionStatus:
        """Progress of the mission."""


class OperatorServer:
    """Answers the commands of operators."""

    def __init__(self, endpoint: str, loop: CommandedLoop) -> None:
        self._endpoint = endpoint
        self._loop = loop

    async def serve(self, context: zmq.asyncio.Context) -> None:
        """Bind, and answer until cancelled. Raises ``RouterError`` if the endpoint cannot be bound."""
        async with Router(self._endpoint, self.answer, context) as router:
            await router.serve()

    async def answer(self, frame: bytes) -> bytes:
        """Answer a command after it took effect or was refused."""
        try:
            request = parse_operator(frame)
        except BadRequest as error:
            return format_error(str(error))
        command = request.cmd
        if command is not OperatorCommand.STATUS:
            refusal = self._loop.apply(request)
            if refusal is not None:
                return format_error(refusal)
        if command in (OperatorCommand.PAUSE, OperatorCommand.STOP):
            try:
                async with asyncio.timeout(EFFECT_TIMEOUT_S):
                    while not self._loop.is_settled:  # noqa: ASYNC110 - no event each frame
                        await asyncio.sleep(EFFECT_POLL_S)
            except TimeoutError:
                return format_error(f"{command}: accepted, but the robot is not at rest after {EFFECT_TIMEOUT_S:.0f} s")
        return format_ok(status=self._loop.status())
