"""The interface between main loop and mission, and the frames and drives that they exchange.

The main loop handles links, clock, order and end; the mission everything that depends on its kind. A new kind of
mission has a subclass of ``MissionRunner``, which its ``ccatp.missions.MissionKind`` names.
"""

# ruff: noqa: B027 - empty methods are for missions without such a peer, file or command

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import msgspec
import structlog

from ccatp.clocks import MissionClock
from ccatp.core import NO_CAUSE, Cause, Verdict
from ccatp.errors import ExitStatus
from ccatp.links.bus import Publisher, Telemetry
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.links.topics import DisplayState, MissionStatus
from ccatp.survey.engagement import EngagedMission
from ccatp.survey.events import SurveyOutcome

EXIT_STATUS = {
    SurveyOutcome.COMPLETE: ExitStatus.COMPLETE,
    SurveyOutcome.AT_BASE: ExitStatus.ABORTED,
    SurveyOutcome.STOPPED: ExitStatus.HELD,
    SurveyOutcome.NONE: ExitStatus.INTERRUPTED,
}


class TimedFrame(msgspec.Struct, frozen=True):
    """A frame to be served.

    ``t_s``: its time without jumps (``sensors`` has the robot's time). ``dt_s``: since the frame before; <= 0 if the
    robot's clock or frames went back. ``is_first``: of a session. ``is_estimate_due``: send the estimate to the danger
    loop; always in a first frame, because the danger loop may wait for it.
    """

    sensors: Sensors
    raw: bytes
    t_s: float
    dt_s: float
    is_first: bool
    is_estimate_due: bool


class DriveCommand(msgspec.Struct, frozen=True):
    """Set points of the wheels, rad/s, and of the steering, rad, ``None`` without a steered wheel."""

    right_rad_s: float
    left_rad_s: float
    steer_rad: float | None = None


STILL = DriveCommand(0.0, 0.0)


class LoopLimits(NamedTuple):
    """Limits of the main loop, s: steps of the robot's clock beyond the first are left out of the mission's time.

    A pause that the main loop finds itself is a fault after ``hold_s``, if its row does not make it one before.
    """

    clock_jump_s: float
    hold_s: float


def usual_limits(_cfg: object) -> LoopLimits:
    """Limits for a robot that cannot relocalize: its configuration has no limit after which a pause needs a fix."""
    return LoopLimits(clock_jump_s=0.1, hold_s=30.0)


class MissionHost(Protocol):
    """What a mission's runner needs of the main loop, which holds the runner."""

    publisher: Publisher
    log: structlog.typing.FilteringBoundLogger
    clock: MissionClock
    frame_period_s: float  # of the present session

    @property
    def is_lockstep(self) -> bool:
        """Simulated time waits for the answers."""

    def release_time(self) -> None:
        """After a change between two frames, such as the end of a measurement: continue lockstep time."""

    def send_fans(self, seq: int, duty: tuple[float, float]) -> None:
        """Send fan duties (left, right), 0 to 1."""

    def finish(self, status: ExitStatus) -> None:
        """End the process with a status, after the last messages are sent."""


class MissionRunner(ABC):
    """A mission in the main-loop process. ``on_drive``: called with number and set points of each drive sent."""

    def __init__(
        self,
        mission: EngagedMission[Any],
        telemetry: Telemetry,
        on_drive: Callable[[int, float, float], None] = lambda *_: None,
    ) -> None:
        self.mission, self.telemetry, self.on_drive = mission, telemetry, on_drive
        self.since_s = 0.0  # start of the present state

    @property
    def is_busy(self) -> bool:
        """Waits for a peer; meanwhile lockstep time stands still."""
        return False

    @property
    def causes(self) -> list[Cause]:
        """The causes why the mission is held, goes home, or waits."""
        state = self.mission.state
        return [cause for cause in (state.cause, state.abort_cause) if cause]

    @property
    def wait_cause(self) -> Cause:
        """Why a robot that works stands and waits, beside the causes in its state."""
        return NO_CAUSE

    @property
    @abstractmethod
    def is_at_rest(self) -> bool:
        """The robot is at rest."""

    @abstractmethod
    def status(self) -> MissionStatus:
        """Progress of the mission; the process adds times, verdict code, lateness and exit status."""

    @abstractmethod
    def display_state(self) -> DisplayState:
        """The newest values for a display, after the first frame."""

    async def connect(self) -> None:
        """Connect to peers other than the robot. Raises ``DaemonUnreachableError`` if one does not answer."""

    async def run(self) -> None:
        """Background work between the frames, until cancelled."""
        await asyncio.Event().wait()

    async def close(self) -> None:
        """Close the resources of ``connect`` and ``run``."""

    @abstractmethod
    def check_robot(self, hello: Hello) -> None:
        """Raise ``ConfigError`` for a robot whose own geometry contradicts the configuration."""

    def begin_session(self, hello: Hello) -> None:
        """Begin a session, before its first frame."""

    def begin_drives(self) -> None:
        """Send commands that are due once per session, before the answer to its first frame."""

    @abstractmethod
    def on_tracking_gap(self) -> None:
        """Handle a boot of the robot, or a motion without frames."""

    def save_checkpoint(self) -> None:
        """Save the state for another main loop that takes over."""

    @abstractmethod
    def publish_state(self) -> None:
        """Publish a changed state, and end the process if it is the last one."""

    @abstractmethod
    def log_statistics(self) -> None:
        """Log statistics at the end of the process."""

    # -- the frame, in this order -----------------------------------------------------------------------------------

    @abstractmethod
    def estimate(self, frame: TimedFrame) -> None:
        """Process the samples; the danger loop judges the same frame meanwhile."""

    @abstractmethod
    def decide(self, frame: TimedFrame, verdict: Verdict | None, lag_s: float) -> DriveCommand:
        """The drive that answers the frame, served ``lag_s`` late; ``verdict``: in force, or ``None``."""

    @abstractmethod
    def hold(self, frame: TimedFrame) -> DriveCommand:
        """Called instead of ``plan``: the robot stands, and the mission does not step in this frame."""

    @abstractmethod
    def publish(self, frame: TimedFrame) -> None:
        """After the drive is sent: publish the estimate, write records."""
