"""Sessions with the robot over a link that reconnects."""

import asyncio
import random
from collections.abc import Callable
from dataclasses import dataclass

from ccatp.config.files import read_key
from ccatp.config.models import LinkConfig
from ccatp.errors import DaemonUnreachableError
from ccatp.links.frame_answers import FrameStamp, is_restart
from ccatp.links.robot_link import (
    ImpossibleRobot,
    LinkHandler,
    RobotLink,
    RobotLinkError,
    RobotRefused,
    RobotTimeout,
)
from ccatp.links.robot_messages import Hello, Role, Sensors

FIRST_DELAY_S, LONGEST_DELAY_S = 0.05, 1.0
# An attempt to connect without an answer ends after the first time. The last attempt has at least the second one, so
# that it fails for a reason of the robot and not for lack of time.
ATTEMPT_S, SHORTEST_ATTEMPT_S = 2.0, 0.25
# Refusals that another attempt does not change.
FINAL = ("bad mac", "bad protocol")


def delay_s(failures: int, share: float) -> float:
    """Backoff before the next attempt, s: doubled each time, with jitter by the random ``share`` (0 to 1)."""
    return max(FIRST_DELAY_S, min(LONGEST_DELAY_S, FIRST_DELAY_S * 2.0 ** min(failures, 10)) * (0.5 + 0.5 * share))


@dataclass(frozen=True, slots=True)
class SessionHandler:
    """What is called on the events of the sessions.

    Attributes:
        on_sensors: serve one frame, with its line. In lockstep a session begins with a repetition of the last frame.
        on_joined: begin a session, before its first frame.
        on_lost: the session is lost, with the reason; the robot holds itself.
        on_restarted: the robot restarted since the last session: its numbers and clock began again. Before the first
            frame.
        on_bad_line: a line is not valid.
        on_repeated: the newest frame came again.
    """

    on_sensors: Callable[[Sensors, bytes], None]
    on_joined: Callable[[Hello], None]
    on_lost: Callable[[str], None]
    on_restarted: Callable[[], None] = lambda: None
    on_bad_line: Callable[[], None] = lambda: None
    on_repeated: Callable[[], None] = lambda: None


class RobotSession:
    """Keeps a role at the robot over successive sessions.

    ``count``: their number so far. ``hello``: of the newest session. ``is_lockstep``: simulated time waits for the
    answers; false before the first session.
    """

    def __init__(self, cfg: LinkConfig, role: Role, client: str, handler: SessionHandler) -> None:
        self.cfg = cfg
        self.role: Role = role
        self._client = client
        self._handler = handler
        self._key = read_key(cfg.key_file)
        self._lost = asyncio.Event()
        self._is_joined = False
        self.is_lockstep = False
        self.count = 0
        self._failures = 0  # a session without a valid frame counts as one
        self._deadline_s: float | None = None
        self.hello: Hello | None = None
        # The newest frame of the last session that had frames, and when this session was lost.
        self._before: FrameStamp | None = None
        self._lost_s = 0.0
        self.link = self._make()

    def _make(self) -> RobotLink:
        return RobotLink(
            host=self.cfg.host,
            port=self.cfg.port,
            role=self.role,
            client=self._client,
            key=self._key,
            handler=LinkHandler(
                on_sensors=self._handler.on_sensors,
                on_lost=self._handle_loss,
                on_joined=self._handle_join,
                on_first=self._handle_first,
                on_bad_line=self._handler.on_bad_line,
                on_repeated=self._handler.on_repeated,
            ),
        )

    def frame_id(self, sensors: Sensors) -> FrameStamp:
        """The identity of a frame of the present session."""
        return FrameStamp(-1 if self.hello is None else self.hello.boot, self.count, sensors.seq, sensors.t)

    async def join(self, *, is_patient: bool) -> None:
        """Join for the first time. Raises ``DaemonUnreachableError``: the robot does not answer, or refuses.

        ``is_patient``: try for as long as after a loss, because the robot may still keep the role of a dead session.
        """
        if is_patient:
            await self._join_again()
        else:
            await self.link.connect(self.cfg.connect_timeout_s)

    async def serve(self) -> None:
        """Join again after each loss, until cancelled.

        Raises ``DaemonUnreachableError``: no session with frames for ``reconnect_timeout_s``, or a final refusal.
        """
        while True:
            await self._lost.wait()
            await self._join_again()

    async def _join_again(self) -> None:
        loop = asyncio.get_running_loop()
        if self.link.has_frames:
            self._failures, self._deadline_s = 0, None
        if self._deadline_s is None:
            self._deadline_s = loop.time() + self.cfg.reconnect_timeout_s
        elif self._failures:
            await asyncio.sleep(delay_s(self._failures, random.random()))
        self._failures += 1
        why: DaemonUnreachableError | str = "it accepts the session and sends no valid frame"
        while (left_s := self._deadline_s - loop.time()) > 0.0:
            self._lost.clear()
            self.link = self._make()
            try:
                await self.link.connect(min(ATTEMPT_S, max(left_s, SHORTEST_ATTEMPT_S)))
            except RobotLinkError as error:
                if isinstance(error, ImpossibleRobot) or (isinstance(error, RobotRefused) and error.reason in FINAL):
                    raise
                why = error
            else:
                return
            await asyncio.sleep(min(delay_s(self._failures - 1, random.random()), left_s))
            self._failures += 1
        raise RobotTimeout(f"the robot did not come back within {self.cfg.reconnect_timeout_s:g} s: {why}")

    def _handle_join(self, hello: Hello) -> None:
        self.hello = hello
        self.is_lockstep = hello.lockstep
        self._is_joined = True
        self.count += 1
        self._handler.on_joined(hello)

    def _handle_first(self, sensors: Sensors) -> None:
        """Compare the first frame of a session with the newest one before: only now a restart shows for certain."""
        away_s = 0.0 if self.is_lockstep else asyncio.get_running_loop().time() - self._lost_s
        if self._before is not None and is_restart(self._before, self.frame_id(sensors), away_s):
            self._handler.on_restarted()

    def _handle_loss(self, reason: str) -> None:
        self._is_joined = False
        if self.link.newest is not None:
            self._before, self._lost_s = self.frame_id(self.link.newest), asyncio.get_running_loop().time()
        self._lost.set()
        self._handler.on_lost(reason)

    def drop(self, reason: str) -> None:
        """Close a silent connection; ``serve`` opens another one."""
        if self._is_joined:
            self.link.abort(reason)

    def leave(self) -> None:
        """End the session; ``on_lost`` is not called."""
        self.link.close()
