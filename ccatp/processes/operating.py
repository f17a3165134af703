"""Glue. Answers the operator channel: each command is answered after it took effect or was refused."""

import asyncio
from collections.abc import Awaitable, Callable

import msgspec

from ccatp.processes.work import Obeying
from ccatp.wire.channels import BadRequest, OperatorCommand, format_error, format_ok, parse_operator
from ccatp.wire.topics import MissionStatus

# A robot at 0.1 m/s is at rest within half a second; a command that took no effect by then has failed.
EFFECT_TIMEOUT_S = 5.0
CAUSE = "operator"


class OperatorDesk:
    """Hands the commands of an operator to the mission.

    Args:
        mission: obeys or refuses.
        say: tells the log and the terminal (level, text).
        status: where the mission stands.
        settled: waits until the robot is held at rest.
        on_change: called after a command changed the mission.
    """

    def __init__(
        self,
        mission: Obeying,
        say: Callable[[str, str], None],
        status: Callable[[], MissionStatus],
        settled: Callable[[], Awaitable[None]],
        on_change: Callable[[], None],
    ) -> None:
        """Nothing asked yet."""
        self._mission, self._say, self._status = mission, say, status
        self._settled, self._on_change = settled, on_change

    async def handle(self, frame: bytes) -> bytes:
        """The reply to one request."""
        try:
            command = parse_operator(frame).cmd
        except BadRequest as error:
            return format_error(str(error))
        if command is OperatorCommand.STATUS:
            return format_ok(status=msgspec.to_builtins(self._status()))
        refusal = self._obey(command)
        if refusal is not None:
            return format_error(refusal)
        self._say("info", f"operator: {command}")
        self._on_change()
        try:
            if command in (OperatorCommand.PAUSE, OperatorCommand.STOP):
                async with asyncio.timeout(EFFECT_TIMEOUT_S):
                    await self._settled()
        except TimeoutError:
            return format_error(f"{command}: accepted, but the robot is not at rest after {EFFECT_TIMEOUT_S:.0f} s")
        return format_ok(status=msgspec.to_builtins(self._status()))

    def _obey(self, command: OperatorCommand) -> str | None:
        if command is OperatorCommand.PAUSE:
            return self._mission.pause(CAUSE)
        if command is OperatorCommand.RESUME:
            return self._mission.resume()
        if command is OperatorCommand.ABORT:
            return self._mission.abort(CAUSE)
        return self._mission.stop()
