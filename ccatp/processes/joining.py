"""Glue. A link to the robot that lasts: joined, lost, joined again, until the robot stays away for too long."""

import asyncio
import random
from collections.abc import Callable

from ccatp.config.models import LinkConfig
from ccatp.errors import UnreachableError
from ccatp.robot_link import RobotLink, RobotLinkError, RobotRefused, RobotTimeout, read_key
from ccatp.wire.robot import Hello, Role, Sensors

FIRST_DELAY_S, LONGEST_DELAY_S = 0.05, 1.0
# A robot that accepts a connection and does not answer is not there yet: rather ask anew.
ATTEMPT_S = 2.0
# What will be refused the next time, too.
FINAL = ("bad mac",)


def delay_s(failures: int, share: float) -> float:
    """How long to wait before the next attempt: twice as long each time, spread so that two clients do not collide.

    Args:
        failures: attempts that failed so far.
        share: random, 0 to 1.
    """
    return max(FIRST_DELAY_S, min(LONGEST_DELAY_S, FIRST_DELAY_S * 2.0 ** min(failures, 10)) * (0.5 + 0.5 * share))


class LastingLink:
    """Keeps a role at the robot.

    Args:
        cfg: where it is, and for how long to try.
        role: what to join as.
        client: name of this client.
        on_sensors: called with each frame and its line; in lockstep a new session begins with the last frame again.
        on_lost: called with the reason when a session ends.
        on_joined: called with the robot's hello when a session begins, before its first frame.
        on_bad_line: called after each line that fails a check.

    Attributes:
        link: the present session, or the last one.
    """

    def __init__(
        self,
        cfg: LinkConfig,
        *,
        role: Role,
        client: str,
        on_sensors: Callable[[Sensors, bytes], None],
        on_lost: Callable[[str], None],
        on_joined: Callable[[Hello], None],
        on_bad_line: Callable[[], None] = lambda: None,
    ) -> None:
        """Read the key; nothing is connected yet."""
        self._cfg, self._role, self._client = cfg, role, client
        self._key = read_key(cfg.key_file)
        self._on_sensors, self._on_lost, self._on_joined = on_sensors, on_lost, on_joined
        self._on_bad_line = on_bad_line
        self._lost = asyncio.Event()
        self._is_joined = False
        # A robot that lets join and then says nothing is as far away as one that does not answer.
        self._failures = 0
        self._deadline_s: float | None = None
        self.sessions = 0
        self.link = self._make()

    def _make(self) -> RobotLink:
        return RobotLink(
            host=self._cfg.host,
            port=self._cfg.port,
            role=self._role,
            client=self._client,
            key=self._key,
            on_sensors=self._heed_frame,
            on_lost=self._heed_loss,
            on_joined=self._heed_join,
            on_bad_line=self._on_bad_line,
        )

    async def join(self, *, is_patient: bool) -> None:
        """Join for the first time.

        Args:
            is_patient: try for as long as after a loss, because the robot may still hold a dead session's role.

        Raises:
            UnreachableError: the robot is not there, or refuses.
        """
        if is_patient:
            await self._join_again()
        else:
            await self.link.connect(self._cfg.connect_timeout_s)

    async def serve(self) -> None:
        """Join again after each loss, for ever.

        Raises:
            UnreachableError: the robot stayed away for ``reconnect_timeout_s``, or refuses for good.
        """
        while True:
            await self._lost.wait()
            await self._join_again()

    async def _join_again(self) -> None:
        loop = asyncio.get_running_loop()
        if self._deadline_s is None:
            self._deadline_s = loop.time() + self._cfg.reconnect_timeout_s
        elif self._failures:
            await asyncio.sleep(delay_s(self._failures, random.random()))
        self._failures += 1
        why: UnreachableError | str = "it lets join, and sends no frame that is one"
        while (left_s := self._deadline_s - loop.time()) > 0.0:
            self._lost.clear()
            self.link = self._make()
            try:
                await self.link.connect(min(ATTEMPT_S, left_s))
            except RobotLinkError as error:
                if isinstance(error, RobotRefused) and error.reason in FINAL:
                    raise
                why = error
            else:
                return
            await asyncio.sleep(min(delay_s(self._failures - 1, random.random()), left_s))
            self._failures += 1
        raise RobotTimeout(f"the robot did not come back within {self._cfg.reconnect_timeout_s:g} s: {why}")

    def _heed_frame(self, frame: Sensors, line: bytes) -> None:
        self._failures, self._deadline_s = 0, None
        self._on_sensors(frame, line)

    def _heed_join(self, hello: Hello) -> None:
        self._is_joined = True
        self.sessions += 1
        self._on_joined(hello)

    def _heed_loss(self, reason: str) -> None:
        self._is_joined = False
        self._lost.set()
        self._on_lost(reason)

    def give_up(self, reason: str) -> None:
        """The connection is open and dead: begin anew."""
        if self._is_joined:
            self.link.abort(reason)

    def close(self) -> None:
        """End the session; nobody is told."""
        self.link.close()
