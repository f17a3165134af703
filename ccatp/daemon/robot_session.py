"""The controller's session at the robot: reconnecting link, numbered commands, command history, lateness of frames."""

import asyncio
import random
from collections.abc import Callable

from ccatp.config.models import LinkConfig, RobotConfig
from ccatp.control.prediction import CommandPredictor
from ccatp.core import twist_of
from ccatp.errors import DaemonUnreachableError
from ccatp.links.robot_link import RobotLink, RobotLinkError, RobotRefused, RobotTimeout, read_key
from ccatp.links.robot_messages import Hello, Role, Sensors
from ccatp.safety.wheel_monitors import CommandSpan

FIRST_DELAY_S, LONGEST_DELAY_S = 0.05, 1.0
# A robot that accepts a connection and does not answer is not there yet: rather ask anew.
ATTEMPT_S = 2.0
# What will be refused the next time, too.
FINAL = ("bad mac",)


def delay_s(failures: int, share: float) -> float:
    """How long to wait before the next attempt: twice as long each time, spread so that two clients do not collide.

    Args:
        share: random, 0 to 1.
    """
    return max(FIRST_DELAY_S, min(LONGEST_DELAY_S, FIRST_DELAY_S * 2.0 ** min(failures, 10)) * (0.5 + 0.5 * share))


class ReconnectingRobotLink:
    """Keeps a role at the robot.

    Args:
        on_sensors: called with each frame and its line; in lockstep a new session begins with the last frame again.
        on_lost: called with the reason when a session ends.
        on_joined: called with the robot's hello when a session begins, before its first frame.
        on_bad_line: called after each line that fails a check.
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
            on_sensors=self._handle_frame,
            on_lost=self._handle_loss,
            on_joined=self._handle_join,
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
        why: DaemonUnreachableError | str = "it accepts the session and sends no valid frame"
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

    def _handle_frame(self, frame: Sensors, line: bytes) -> None:
        self._failures, self._deadline_s = 0, None
        self._on_sensors(frame, line)

    def _handle_join(self, hello: Hello) -> None:
        self._is_joined = True
        self.sessions += 1
        self._on_joined(hello)

    def _handle_loss(self, reason: str) -> None:
        self._is_joined = False
        self._lost.set()
        self._on_lost(reason)

    def drop(self, reason: str) -> None:
        """The connection is open and dead: begin anew."""
        if self._is_joined:
            self.link.abort(reason)

    def close(self) -> None:
        """End the session; nobody is told."""
        self.link.close()


class ControllerSession:
    """Sends drives and fans, and knows what the session is like.

    Args:
        is_taking_over: somebody else sat here before.

    Attributes:
        on_drive: told of each drive that is sent: its number, and the rates of the right and the left wheel, rad/s.
        is_new_session: no frame of this session has been served yet.
    """

    def __init__(self, link: ReconnectingRobotLink, *, is_taking_over: bool, frame_hz: float) -> None:
        self._link, self._is_taking_over, self._frame_hz = link, is_taking_over, frame_hz
        self._hello: Hello | None = None
        self._drive_seq = self._fans_seq = 0
        self.on_drive: Callable[[int, float, float], None] = lambda _seq, _right, _left: None
        self.is_lockstep = self.is_new_session = False

    def begin(self, hello: Hello, where: str) -> str:
        """A session begins, at an address; what people say of it."""
        before, self._hello, self.is_lockstep = self._hello, hello, hello.lockstep
        self.is_new_session = True
        return f"joined the robot at {where}{'' if before is None else ' again'}"

    def has_rebooted(self, hello: Hello) -> bool:
        """Whether the robot has restarted since the last session; to be asked before ``begin``."""
        return self._hello is not None and self._hello.boot != hello.boot

    @property
    def frame_period_s(self) -> float:
        """Time between two frames."""
        return 1.0 / (self._hello.frame_hz if self._hello is not None else self._frame_hz)

    @property
    def may_lack_verdict(self) -> bool:
        """Danger may have judged the first frame before this session began, and does so once: the next one will do."""
        return self.is_new_session and (self._is_taking_over or self._link.sessions > 1)

    def send_drive(self, ack: int, right: float, left: float, steer: float | None = None) -> None:
        """Send wheel rates, rad/s, and the steering angle, rad, where there is one, computed from frame ``ack``."""
        self._drive_seq += 1
        self.on_drive(self._drive_seq, right, left)
        link = self._link.link
        if steer is None:
            link.send_drive(self._drive_seq, max(ack, 0), right, left)
        else:
            link.send_drive(self._drive_seq, max(ack, 0), right, left, steer)

    def send_fans(self, duty: tuple[float, float]) -> None:
        """Send the fans' duties."""
        self._fans_seq += 1
        self._link.link.send_fans(self._fans_seq, duty)


class CommandHistory:
    """Hears of each drive that is sent."""

    def __init__(self, cfg: RobotConfig, frame_hz: float) -> None:
        self._cfg = cfg
        self._span = CommandSpan()
        self._newest, self._driven = 0, (0.0, 0.0)
        self.begin(frame_hz)

    def begin(self, frame_hz: float) -> None:
        """A session begins: nothing of the one before is on its way."""
        self.predictor = CommandPredictor(self._cfg.wheel_lag_s, 1.0 / frame_hz)

    def add(self, seq: int, right: float, left: float) -> None:
        """Drive ``seq``, wheel rates in rad/s, is sent."""
        self._newest, self._driven = seq, (right, left)
        self._span.add(right, left)
        twist = twist_of(right, left, self._cfg.wheel_radius_m, self._cfg.wheel_base_m)
        self.predictor.sent(seq, twist.v_m_s, twist.omega_rad_s)

    def since_last_estimate(self) -> tuple[tuple[float, float, float, float], int]:
        """Span of the set points since it was asked for last, rad/s, and the number of the newest drive."""
        return self._span.take(*self._driven), self._newest


# The robot's clock and the host's drift apart by less than this share; a quartz is ten times better.
MAX_DRIFT = 2e-4
_NEVER_S = float("inf")


class LatenessStatistics:
    """Measures the lag of each frame against the promptest one lately.

    The difference of the host's clock to the robot's is least for a frame that was served at once. It may grow by the
    drift of the clocks; whatever it is above that, the frame is late. What always takes the same time does not show.

    Args:
        late_after_s: a frame served later than this misses its deadline.

    Attributes:
        missed_deadlines: frames served later than ``late_after_s``.
    """

    __slots__ = ("_late_after_s", "_least_s", "_t_s", "_wall_s", "missed_deadlines", "worst_s")

    def __init__(self, late_after_s: float) -> None:
        self._late_after_s = late_after_s
        self._t_s, self._wall_s, self._least_s = _NEVER_S, 0.0, 0.0
        self.missed_deadlines = 0
        self.worst_s = 0.0

    def reset(self) -> None:
        """Begin anew: another session, or another boot."""
        self._t_s = _NEVER_S

    def add(self, t_s: float, wall_s: float) -> float:
        """The lag of a frame, s.

        Args:
            t_s: the robot's time of the frame; where it runs backwards, the clock was set and lags count anew.
            wall_s: the host's monotonic clock when the frame is served.
        """
        offset_s = wall_s - t_s
        if t_s < self._t_s:
            self._least_s = offset_s
        else:
            self._least_s = min(offset_s, self._least_s + MAX_DRIFT * (wall_s - self._wall_s))
        self._t_s, self._wall_s = t_s, wall_s
        lag_s = offset_s - self._least_s
        if lag_s > self._late_after_s:
            self.missed_deadlines += 1
        self.worst_s = max(self.worst_s, lag_s)
        return lag_s
