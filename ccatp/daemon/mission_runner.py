"""The interface of missions in the main loop, the clock of their frames, and the frames and drives between the two.

The process keeps links, clock, order and end; the mission keeps everything that depends on its kind. A new kind of
mission is a subclass of ``MissionRunner`` and a row in ``main_loop.open_runner``.
"""

# ruff: noqa: B027 - empty methods are for missions without such a peer, file or command

import asyncio
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, NamedTuple

from ccatp.core import Verdict
from ccatp.daemon.telemetry import Telemetry
from ccatp.errors import ExitStatus
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.links.topics import DisplayState, EstimateMessage, MissionStatus, is_estimate_due
from ccatp.safety.robot_clock import SteadyTime
from ccatp.survey.state import SurveyOutcome

if TYPE_CHECKING:  # each main loop imports its own
    from ccatp.beacons.mission import BeaconMission
    from ccatp.survey.statechart import Mission

EXIT_STATUS = {
    SurveyOutcome.COMPLETE: ExitStatus.COMPLETE,
    SurveyOutcome.AT_BASE: ExitStatus.ABORTED,
    SurveyOutcome.STOPPED: ExitStatus.HELD,
    SurveyOutcome.NONE: ExitStatus.INTERRUPTED,
}


class MissionClock:
    """Numbers and times of the frames.

    Args:
        jump_s: the robot's clock has jumped if a frame is further off.

    Attributes:
        seq: the newest frame.
        t_s: its time, without jumps.
        before_s: robot time of the mission before the first frame that is served here.
    """

    def __init__(self, jump_s: float) -> None:
        self._jump_s, self.before_s = jump_s, 0.0
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
        return self.before_s + (0.0 if self._first_s is None else self.t_s - self._first_s)

    @property
    def offset_s(self) -> float:
        """``t_s`` less the robot's time."""
        return self._steady.offset_s

    def time_of(self, seq: int, t_s: float, period_s: float) -> tuple[float, float]:
        """Time of a frame and time since the last one (``period_s`` without one), s; ``advance`` takes them over."""
        # Durations are counted by a time that does not jump; everything else by the robot's own.
        steady_s = self._steady.at(seq, t_s) if seq > self.seq else self.t_s
        return steady_s, steady_s - self.t_s if self._first_s is not None else period_s

    def advance(self, seq: int, steady_s: float) -> None:
        """The frame is served now."""
        if self._first_s is None:
            self._first_s = steady_s
        self.t_s, self.seq = steady_s, max(seq, self.seq)

    def reset(self) -> None:
        """The robot's frames and clock restarted."""
        self.before_s, self._first_s, self.seq = self.elapsed_s, None, -1
        self._steady = SteadyTime(self._jump_s)


class TimedFrame(NamedTuple):
    """A frame as it is served.

    Attributes:
        t_s: its time, without jumps; that of the robot stands in ``sensors``.
        dt_s: since the frame before; not positive where the robot's clock or frames went back.
        is_first: of a session.
    """

    sensors: Sensors
    raw: bytes
    t_s: float
    dt_s: float
    is_first: bool

    @property
    def is_estimate_due(self) -> bool:
        """That of the first frame of a session is always due, because the danger loop may wait for it."""
        return self.is_first or is_estimate_due(self.sensors.seq)


class DriveCommand(NamedTuple):
    """Set points of the wheels, rad/s, and of the steering, rad, where the robot has one."""

    right_rad_s: float
    left_rad_s: float
    steer_rad: float | None = None


STILL = DriveCommand(0.0, 0.0)


class MissionRunner(ABC):
    """A mission in the main-loop process."""

    def __init__(self, mission: "Mission | BeaconMission", telemetry: Telemetry) -> None:
        self.mission, self.telemetry = mission, telemetry

    @property
    def is_busy(self) -> bool:
        """Waits for a peer: in lockstep time stands still."""
        return False

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

    def on_drive(self, seq: int, right_rad_s: float, left_rad_s: float) -> None:
        """Drive ``seq`` is sent."""

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

    def publish_estimate(
        self,
        frame: TimedFrame,
        pose: tuple[float, float, float],
        sigma_m: float,
        commanded: tuple[float, float, float, float] | None = None,
        drive_seq: int = -1,
    ) -> None:
        """Publish the pose, m and rad, for the danger loop; the rest as of ``EstimateMessage``."""
        seq, t_s, (x_m, y_m, heading_rad) = frame.sensors.seq, frame.sensors.t, pose
        estimate = EstimateMessage(
            seq=seq,
            t_s=t_s,
            x_m=x_m,
            y_m=y_m,
            heading_rad=heading_rad,
            sigma_m=sigma_m,
            state=str(self.mission.state.mode),
            commanded=commanded,
            drive_seq=drive_seq,
        )
        self.telemetry.send("estimate", estimate)
