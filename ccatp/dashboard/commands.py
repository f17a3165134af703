"""Edge. Hands the commands of a page to the operator channel, and its answer back."""

import asyncio
from typing import NamedTuple

import zmq
import zmq.asyncio

from ccatp.router import MAX_REPLY_BYTES
from ccatp.wire.channels import BadRequest, OperatorCommand, format_request, parse_reply

COMMANDS = (OperatorCommand.PAUSE, OperatorCommand.RESUME, OperatorCommand.ABORT, OperatorCommand.STOP)
# Of all pages together; an operator has one at a time.
MOST = 8


class Answer(NamedTuple):
    """What became of a command: the HTTP status, and the refusal or nothing."""

    http_status: int
    refusal: str


class CommandDesk:
    """Asks the main loop.

    Args:
        context: ZeroMQ context of the process.
        endpoint: the operator channel.
        timeout_s: longest wait for the answer, which comes when the command took effect.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, timeout_s: float) -> None:
        """Nothing asked yet."""
        self._context: zmq.asyncio.Context = zmq.asyncio.Context.shadow(context)
        self._endpoint, self._timeout_s = endpoint, timeout_s
        self._asking = 0

    async def ask(self, command: OperatorCommand) -> Answer:
        """Hand on one command; never raises for what the daemon does or does not."""
        if self._asking >= MOST:
            return Answer(503, f"{command}: {MOST} commands wait for their answers already")
        self._asking += 1
        try:
            async with asyncio.timeout(self._timeout_s):
                return await self._exchange(command)
        except TimeoutError:
            return Answer(504, f"{command}: no answer from the main loop within {self._timeout_s:g} s")
        finally:
            self._asking -= 1

    async def _exchange(self, command: OperatorCommand) -> Answer:
        with self._context.socket(zmq.DEALER) as peer:
            peer.setsockopt(zmq.LINGER, 0)
            peer.setsockopt(zmq.MAXMSGSIZE, MAX_REPLY_BYTES)
            peer.connect(self._endpoint)
            await peer.send_multipart([b"", format_request(command)])
            *_, frame = await peer.recv_multipart()
        try:
            reply = parse_reply(frame)
        except BadRequest as error:
            return Answer(502, f"{command}: the main loop answered with {error}")
        return Answer(200, "") if reply["ok"] else Answer(409, f"{command}: {reply.get('error', 'refused')}")
