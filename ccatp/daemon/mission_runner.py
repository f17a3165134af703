"""The interface of missions in the main loop, and the frames and drives between the two.

The process keeps links, clock, order and end; the mission keeps everything that depends on its kind. A new kind of
mission is a subclass of ``MissionRunner`` and a row in ``main_loop.open_runner``.
"""

# ruff: noqa: B027 - empty methods are for missions without such a peer, file or command

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec

from ccatp.core import Verdict
from ccatp.errors import ExitStatus
from ccatp.links.bus import Telemetry
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.links.topics import DisplayState, MissionStatus
from ccatp.survey.events import SurveyOutcome

if TYPE_CHECKING:  # each main loop imports its own
    from ccatp.beacons.mission import BeaconMission
    from ccatp.survey.statechart import Mission

EXIT_STATUS = {
    SurveyOutcome.COMPLETE: ExitStatus.COMPLETE,
    SurveyOutcome.AT_BASE: ExitStatus.ABORTED,
    SurveyOutcome.STOPPED: ExitStatus.HELD,
    SurveyOutcome.NONE: ExitStatus.INTERRUPTED,
}


class TimedFrame(msgspec.Struct, frozen=True):
    """A frame as it is served.

    Attributes:
        t_s: its time, without jumps; that of the robot stands in ``sensors``.
        dt_s: since the frame before; not positive where the robot's clock or frames went back.
        is_first: of a session.
        is_estimate_due: the danger loop is sent the estimate; of a first frame always, because it may wait for that.
    """

    sensors: Sensors
    raw: bytes
    t_s: float
    dt_s: float
    is_first: bool
    is_estimate_due: bool


class DriveCommand(msgspec.Struct, frozen=True):
    """Set points of the wheels, rad/s, and of the steering, rad, where the robot has one."""

    right_rad_s: float
    left_rad_s: float
    steer_rad: float | None = None


STILL = DriveCommand(0.0, 0.0)


class MissionRunner(ABC):
    """A mission in the main-loop process. ``on_drive``: called with number and set points of each drive sent."""

    def __init__(
        self,
        mission: "Mission | BeaconMission",
        telemetry: Telemetry,
        on_drive: Callable[[int, float, float], None] = lambda *_: None,
    ) -> None:
        self.mission, self.telemetry, self.on_drive = mission, telemetry, on_drive
        self.since_s = 0.0  # when the state began

    @property
    def is_busy(self) -> bool:
        """Waits for a peer: in lockstep time stands still."""
        return False

    @property
    def causes(self) -> list[str]:
        """What holds the mission, sends it home, or makes it wait, as it is shown."""
        state = self.mission.state
        return [cause for cause in (state.cause, state.abort_cause) if cause]

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
        """Connect to peers other than the robot; raises ``UnreachableError`` where one does not answer."""

    async def run(self) -> None:
        """Work beside the frames, until cancelled."""
        await asyncio.Event().wait()

    async def close(self) -> None:
        """Close the resources of ``connect`` and ``run``."""

    @abstractmethod
    def check_robot(self, hello: Hello) -> None:
        """Raise ``ConfigError`` for a robot whose own geometry contradicts the configuration."""

    def begin_session(self, hello: Hello) -> None:
        """A session begins; its first frame comes next."""

    def begin_drives(self) -> None:
        """The first frame of a session is here, and is answered next: send commands that are due once."""

    @abstractmethod
    def on_tracking_gap(self) -> None:
        """The robot booted, or moved without frames."""

    def save_checkpoint(self) -> None:
        """Save the state for a main loop that takes over."""

    @abstractmethod
    def publish_state(self) -> None:
        """Publish a new state, and end where that is the end."""

    @abstractmethod
    def log_statistics(self) -> None:
        """The process ends: log statistics."""

    # -- the frame, in this order -----------------------------------------------------------------------------------

    @abstractmethod
    def estimate(self, frame: TimedFrame) -> None:
        """Process the samples; the danger loop judges the same frame meanwhile."""

    @abstractmethod
    def plan(self, frame: TimedFrame, verdict: Verdict | None, lag_s: float) -> DriveCommand:
        """The drive that answers the frame, which is served ``lag_s`` late; no verdict where none is in force."""

    @abstractmethod
    def hold(self, frame: TimedFrame) -> DriveCommand:
        """In place of ``plan``: the robot stands, and nothing is decided in this frame."""

    @abstractmethod
    def publish(self, frame: TimedFrame) -> None:
        """The drive is sent: publish the estimate, keep records."""
