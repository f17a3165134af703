"""The interface between the main-loop process and the mission that it runs, and the clock of the frames.

The process keeps links, clock, order and end; the mission keeps everything that depends on its kind. A new kind of
mission is a class with these methods and a row in ``main_loop.open_runner``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import structlog

from ccatp.config.models import LinkConfig
from ccatp.core import Verdict
from ccatp.daemon.robot_session import ControllerSession
from ccatp.daemon.telemetry import TelemetryPublisher
from ccatp.errors import ExitStatus
from ccatp.links.bus import Publisher
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.links.topics import MissionStatus
from ccatp.safety.robot_clock import SteadyTime


class MissionClock:
    """Numbers and times of the frames.

    Args:
        jump_s: the robot's clock has jumped if a frame is further off.
        elapsed_s: of the mission, before the first frame that we serve.

    Attributes:
        seq: the newest frame.
        has_begun: a frame was served, in this boot of the robot.
    """

    def __init__(self, jump_s: float, elapsed_s: float = 0.0) -> None:
        """No frame yet."""
        self._jump_s, self._before_s = jump_s, elapsed_s
        self._steady = SteadyTime(jump_s)
        self._first_s: float | None = None
        self.seq, self.t_s = -1, 0.0

    @property
    def has_begun(self) -> bool:
        """A frame was served, in this boot of the robot."""
        return self._first_s is not None

    @property
    def elapsed_s(self) -> float:
        """Robot time of the mission, s."""
        return self._before_s + (0.0 if self._first_s is None else self.t_s - self._first_s)

    @property
    def offset_s(self) -> float:
        """Our time less the robot's."""
        return self._steady.offset_s

    def resume_at(self, elapsed_s: float) -> None:
        """So much of the mission was over before we came."""
        self._before_s = elapsed_s

    def time_of(self, seq: int, t_s: float, period_s: float) -> tuple[float, float]:
        """Time of a frame and time since the last one, s; nothing is changed before ``advance``.

        Args:
            period_s: time since the frame before where there is none.
        """
        # What counts durations goes by a time that does not jump; everything else by the robot's own.
        steady_s = self._steady.at(seq, t_s) if seq > self.seq else self.t_s
        return steady_s, steady_s - self.t_s if self._first_s is not None else period_s

    def advance(self, seq: int, steady_s: float) -> bool:
        """The frame is served now; whether it is the first in this boot of the robot."""
        is_first = self._first_s is None
        if self._first_s is None:
            self._first_s = steady_s
        self.t_s, self.seq = steady_s, max(seq, self.seq)
        return is_first

    def reset(self) -> None:
        """The robot's frames and clock count anew."""
        self._before_s, self._first_s, self.seq = self.elapsed_s, None, -1
        self._steady = SteadyTime(self._jump_s)


class RunnerConfig(NamedTuple):
    """What the process itself needs of a configuration.

    Attributes:
        realtime_priority: of the process; 0 = ordinary scheduling.
        clock_jump_s: the robot's clock has jumped if a frame is further off.
    """

    link: LinkConfig
    realtime_priority: int
    verdict_timeout_s: float
    clock_jump_s: float
    frame_hz: float


class TimedFrame(NamedTuple):
    """A frame as it is served.

    Attributes:
        t_s: its time, without jumps; that of the robot stands in ``sensors``.
        dt_s: since the frame before; not positive where the robot's clock or frames went back.
    """

    sensors: Sensors
    raw: bytes
    t_s: float
    dt_s: float
    is_first: bool


class DriveCommand(NamedTuple):
    """Set points of the wheels, rad/s, and of the steering, rad, where the robot has one."""

    right_rad_s: float
    left_rad_s: float
    steer_rad: float | None = None


STILL = DriveCommand(0.0, 0.0)


class CommandHandler(Protocol):
    """Takes the commands of an operator; each returns why it was refused, or ``None``."""

    def pause(self, cause: str) -> str | None:
        """Hold until ``resume``."""

    def resume(self) -> str | None:
        """Go on after a hold."""

    def abort(self, cause: str) -> str | None:
        """Return to base and end there."""

    def stop(self) -> str | None:
        """Hold the wheels and end here."""


@dataclass(frozen=True, slots=True)
class RunnerContext:
    """What the process gives to its mission.

    Attributes:
        finish: ends the process with a status, once the last messages are out.
        answer: something changed between two frames: lockstep time may go on.
    """

    run_dir: Path
    publisher: Publisher
    log: structlog.typing.FilteringBoundLogger
    session: ControllerSession
    clock: MissionClock
    is_patient: bool
    finish: Callable[[ExitStatus], None]
    answer: Callable[[], None]


class MissionRunner(CommandHandler, Protocol):
    """A mission in the main-loop process."""

    @property
    def telemetry(self) -> TelemetryPublisher:
        """Tells the others."""

    @property
    def cause(self) -> str:
        """Why it is held."""

    @property
    def is_paused(self) -> bool:
        """Held until somebody resumes: in lockstep time all but stands still."""

    @property
    def is_busy(self) -> bool:
        """Waits for a peer: in lockstep time stands still."""

    @property
    def is_at_rest(self) -> bool:
        """The robot is at rest."""

    def status(self) -> MissionStatus:
        """Progress of the mission; the process adds times, verdict code, lateness and exit status."""

    # -- beside the frames ----------------------------------------------------------------------------------------

    async def connect(self) -> None:
        """Connect to peers other than the robot.

        Raises:
            UnreachableError: one does not answer.
        """

    async def run(self) -> None:
        """Whatever is to be done beside the frames, for ever."""

    async def close(self) -> None:
        """Close what ``connect`` and ``run`` have opened."""

    def check_robot(self, hello: Hello) -> None:
        """Refuse a robot that is not of the configuration.

        Raises:
            ConfigError: it is another one.
        """

    def begin_session(self, hello: Hello) -> None:
        """A session begins; its first frame comes next."""

    def begin_drives(self) -> None:
        """The first frame of a session is here, and is answered next: what the robot has to be told once."""

    def on_tracking_gap(self) -> None:
        """The robot booted, or moved while nobody looked."""

    def interrupt(self, cause: str) -> bool:
        """Hold until frames and verdicts are fresh again; returns whether that was news."""

    def save_checkpoint(self) -> None:
        """Write down what a successor needs."""

    def publish_state(self) -> None:
        """Something changed between two frames: tell it, and end where that is the end."""

    def log_statistics(self) -> None:
        """The process ends: last words for the log."""

    # -- the frame, in this command ---------------------------------------------------------------------------------

    def estimate(self, frame: TimedFrame) -> None:
        """Take what the robot says; the danger loop judges the same frame meanwhile."""

    def plan(self, frame: TimedFrame, verdict: Verdict | None, lag_s: float) -> DriveCommand:
        """The drive that answers the frame.

        Args:
            verdict: of the danger loop, ``None`` where there is none in force.
            lag_s: how late the frame is served.
        """

    def hold(self, frame: TimedFrame) -> DriveCommand:
        """In place of ``plan``: the robot stands, and nothing is decided in this frame."""

    def publish(self, frame: TimedFrame) -> None:
        """The drive is on its way: publish the estimate, keep records."""


RunnerFactory = Callable[[RunnerContext], MissionRunner]
