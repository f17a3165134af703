"""Client of the MultiLine server: reads lengths over TCP and computes the position of the puck from them.

After a failed request or unexpected data the connection is closed, and the next request opens a new one. So a late
reply can never answer another request. A fix depends only on the replies and the arguments.
"""

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from math import dist
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ccatp.config.models import EtalonConfig
from ccatp.core import Fix, Vector3
from ccatp.errors import CcatpError, ExitStatus
from ccatp.links import multiline
from ccatp.links.multiline import ChannelData, Command, Connected, Environment, LaserReady, MultilineRequest, Remark
from ccatp.mirror.fix_judgement import FixJudge
from ccatp.mirror.multilateration import MultilaterationError


class EtalonError(CcatpError):
    """Base: there is no fix. The message is one line with problem, server and advice."""

    exit_status = ExitStatus.UNREACHABLE


class EtalonUnreachable(EtalonError):
    """There is no connection, or it was lost."""


class EtalonTimeout(EtalonError):
    """No reply within the deadline."""


class EtalonBadReply(EtalonError):
    """A reply has a wrong format, is too long, or is for another request."""


class EtalonServerError(EtalonError):
    """The server reports an error number, or refuses the request."""


class TooFewChannels(EtalonError):
    """There are fewer than four valid lengths."""


class StaleLengths(EtalonError):
    """The server repeats the lengths of the robot's last place."""


class BadSolution(EtalonError):
    """The lengths give no valid position. ``__cause__``: error of the multilateration; ``lengths_m``: by channel."""

    def __init__(self, message: str, lengths_m: dict[int, float]) -> None:
        super().__init__(message)
        self.lengths_m = lengths_m


_NEEDED_CHANNELS = 4
_MOVED_M = 0.005  # places further apart than this have different lengths

_ReplyT = TypeVar("_ReplyT", Connected, LaserReady, Environment, ChannelData)
_T = TypeVar("_T")


class Readiness(NamedTuple):
    """State of the server."""

    connected: bool
    laser_ready: bool
    environment: Environment


class EtalonClient:
    """Measures the position of the puck with k >= 4 different channels; their collimators: world frame, (k, 3), m.

    ``on_retry`` is called before each retry with the error and the number of retries left. ``counts``: connects,
    requests, retries, drained (connections closed because of unexpected bytes). Raises ``ValueError`` if channels and
    collimators do not fit each other or are too few.
    """

    def __init__(
        self,
        cfg: EtalonConfig,
        channels: Sequence[int],
        collimators_m: NDArray[np.float64],
        on_retry: Callable[[EtalonError, int], None] = lambda _error, _left: None,
    ) -> None:
        if np.shape(collimators_m) != (len(set(channels)), 3) or len(set(channels)) < _NEEDED_CHANNELS:
            raise ValueError(f"channels {tuple(channels)}, collimators {np.shape(collimators_m)}: need (k, 3), k >= 4")
        self.counts: Counter[str] = Counter()
        self._cfg, self._on_retry = cfg, on_retry
        self._where = f"Etalon server {cfg.host}:{cfg.port}"
        self._channels = tuple(channels)
        self._collimators = dict(zip(self._channels, np.asarray(collimators_m, dtype=np.float64), strict=True))
        self._judge = FixJudge(cfg, self._collimators)
        self._request = MultilineRequest(Command.LATEST_LENGTH_VALID, self._channels)
        self._connection: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._turn = asyncio.Lock()
        self._last: tuple[dict[int, float], Vector3] | None = None  # lengths and expected position of the last fix

    async def connect(self) -> None:
        """Connect, unless connected. Raises ``EtalonUnreachable`` after the configured retries."""
        async with self._turn:
            await self._retry(self._usable_connection)

    async def close(self) -> None:
        """Close the connection after the current request."""
        async with self._turn:
            self._drop()

    async def isready(self) -> Readiness:
        """Read whether the lasers are connected and warm, and the environment data. Raises as ``measure``."""
        async with self._turn:
            return await self._retry(self._ask_readiness)

    async def is_laser_ready(self) -> bool:
        """Read whether the lasers are warm; before that the lengths are not valid. Raises as ``measure``."""
        async with self._turn:
            reply = await self._retry(lambda: self._ask(MultilineRequest(Command.LASER_READY), LaserReady))
        return reply.value

    async def measure(self, t_s: float, expected_position_m: Vector3) -> Fix:
        """Measure the puck of a robot that stands still; ``t_s`` becomes the time of the fix.

        The solution starts at ``expected_position_m``, world frame. If all collimators lie in one plane, this also
        selects one of the two mirror images. Raises the ``EtalonError`` of the last retry.
        """
        async with self._turn:
            return await self._retry(lambda: self._measure_once(t_s, expected_position_m))

    async def _retry(self, attempt: Callable[[], Awaitable[_T]]) -> _T:
        """Call ``attempt`` with up to ``retries`` retries, after a wait for the server or for a new measurement.

        For an unreachable server, which may be restarting, it retries for at least ``reconnect_for_s``.
        """
        left = self._cfg.retries
        clock = asyncio.get_running_loop().time
        wait_until_s: float | None = None
        while True:
            try:
                return await attempt()
            except EtalonError as error:
                if isinstance(error, EtalonUnreachable) and wait_until_s is None:
                    wait_until_s = clock() + self._cfg.reconnect_for_s
                if left == 0 and not (isinstance(error, EtalonUnreachable) and clock() < (wait_until_s or 0.0)):
                    raise
                left = max(left - 1, 0)
                self.counts["retries"] += 1
                self._on_retry(error, left)
                if isinstance(error, EtalonUnreachable | EtalonBadReply):
                    await asyncio.sleep(self._cfg.reconnect_delay_s)
                elif not isinstance(error, EtalonTimeout):
                    await asyncio.sleep(self._cfg.measuring_time_s)

    async def _usable_connection(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """The connection, or a new one if there is none or if it has received bytes since the last reply."""
        if self._connection is not None:
            # Two cycles of the event loop deliver the bytes that the socket has received.
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            if await _next_byte(self._connection[0]) is None:
                return self._connection
            self.counts["drained"] += 1
            self._drop()
        try:
            async with asyncio.timeout(self._cfg.connect_timeout_s):
                self._connection = await asyncio.open_connection(
                    self._cfg.host, self._cfg.port, limit=multiline.MAX_LINE_BYTES
                )
        except (OSError, TimeoutError) as error:
            reason = str(error) or f"no connection within {self._cfg.connect_timeout_s} s"
            raise EtalonUnreachable(f"{self._where}: {reason}; is it running, are [etalon] host, port right?") from None
        self.counts["connects"] += 1
        return self._connection

    def _drop(self) -> None:
        if self._connection is not None:
            self._connection[1].transport.abort()
            self._connection = None

    async def _ask(self, request: MultilineRequest, expected: type[_ReplyT]) -> _ReplyT:
        """Send one request and return its reply of the expected type. After any failure the connection is closed."""
        reader, writer = await self._usable_connection()
        self.counts["requests"] += 1
        is_answered = False
        try:
            writer.write(multiline.format_request(request))
            async with asyncio.timeout(self._cfg.request_timeout_s):
                line = await reader.readuntil(b"\n")
            reply = multiline.parse_reply(line.rstrip(b"\r\n"))
            if await _next_byte(reader):
                raise multiline.BadReply("more than one line in reply to one request")
            if isinstance(reply, Remark) and reply.name == "error":
                raise EtalonServerError(f"{self._where}: refused {request.command}: {reply.text[:80]!r}; see its log")
            if not isinstance(reply, expected):
                raise multiline.BadReply(f"{type(reply).__name__} in reply to {request.command}")
            is_answered = True
            return reply
        except TimeoutError:
            raise EtalonTimeout(
                f"{self._where}: no reply to {request.command} within {self._cfg.request_timeout_s} s; restart its "
                "laser driver or raise [etalon] request_timeout_s"
            ) from None
        except (multiline.BadReply, asyncio.LimitOverrunError) as error:
            is_long = isinstance(error, asyncio.LimitOverrunError)
            why = f"line of more than {multiline.MAX_LINE_BYTES} bytes" if is_long else error
            raise EtalonBadReply(f"{self._where}: {why}; is this a MultiLine server?") from None
        except (ConnectionError, asyncio.IncompleteReadError):
            raise EtalonUnreachable(f"{self._where}: server closed the connection; is it running?") from None
        finally:
            if not is_answered:
                self._drop()

    async def _ask_readiness(self) -> Readiness:
        connected = await self._ask(MultilineRequest(Command.IS_CONNECTED), Connected)
        laser_ready = await self._ask(MultilineRequest(Command.LASER_READY), LaserReady)
        environment = await self._ask(MultilineRequest(Command.ENVIRONMENT_DATA), Environment)
        return Readiness(connected.value, laser_ready.value, environment)

    async def _measure_once(self, t_s: float, expected_m: Vector3) -> Fix:
        data = await self._ask(self._request, ChannelData)
        if data.server_error:
            raise EtalonServerError(f"{self._where}: server error {data.server_error}; see its log")
        lengths_m, reasons = multiline.valid_lengths(data, self._channels)
        valid = tuple(lengths_m)
        if len(valid) < _NEEDED_CHANNELS:
            dropped = ", ".join(f"{channel}: {reason}" for channel, reason in reasons.items())
            raise TooFewChannels(
                f"{self._where}: {len(valid)} valid channels, {_NEEDED_CHANNELS} needed ({dropped}); clear the beams"
            )
        self._refuse_old(lengths_m, expected_m)
        try:
            fix = self._judge.fix(t_s, expected_m, lengths_m)
        except (MultilaterationError, ValueError) as error:  # numbers without a solution
            raise BadSolution(
                f"{self._where}: {error}; channels {valid}: check beams, collimators and [etalon] limits", lengths_m
            ) from error
        self._last = lengths_m, expected_m
        return fix

    def _refuse_old(self, lengths_m: dict[int, float], expected_m: Vector3) -> None:
        """Refuse lengths that equal the last ones to the last digit although the robot moved: they are not measured."""
        if self._last is None:
            return
        before_m, there_m = self._last
        moved_m = dist(there_m, expected_m)
        if before_m == lengths_m and moved_m > _MOVED_M:
            raise StaleLengths(
                f"{self._where}: the lengths are those of the last place, {1e3 * moved_m:.0f} mm from here, to the "
                "last digit; restart its laser driver"
            )


async def _next_byte(reader: asyncio.StreamReader) -> bytes | None:
    """A byte received already, empty if the connection has ended, ``None`` otherwise."""
    try:
        async with asyncio.timeout(0.0):
            return await reader.read(1)
    except TimeoutError:
        return None
    except ConnectionError:
        return b""
