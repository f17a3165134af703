"""When the main loop answers a frame: in lockstep simulated time waits for the answer, in real time frames may be late.

The first session selects one of the two; the statements of a frame are the same with both.
"""

import time
from collections.abc import Callable
from math import inf
from typing import Protocol

from ccatp.conditions import text_of
from ccatp.conditions.mission import FRAME_LATE, FRAMES_OLD
from ccatp.config.models import LinkConfig
from ccatp.core import Verdict
from ccatp.daemon.loops.frame_lateness import FrameAge, LatenessStatistics
from ccatp.daemon.loops.mission_runner import STILL, DriveCommand, MissionRunner, TimedFrame
from ccatp.daemon.loops.pauses import PauseWatch
from ccatp.daemon.loops.robot_session import RobotSession
from ccatp.links.frame_answers import DriveRule

# Frames that arrive while a path is planned for a standing robot are late; they are served within this time.
CATCH_UP_S = 0.5


class DriveSender:
    """Numbers and sends the drives of this process. ``on_drive``: called with number and set points of each one."""

    def __init__(self, session: RobotSession, on_drive: Callable[[int, float, float], None]) -> None:
        self._session = session
        self._on_drive = on_drive
        self._rule = DriveRule()
        self.take = self._rule.take
        self.begin_session = self._rule.begin_session

    def send(self, ack: int, drive: DriveCommand) -> int:
        """Send the drive that was computed from frame ``ack``; returns its number."""
        sent = self._rule.drive(ack, drive.right_rad_s, drive.left_rad_s, drive.steer_rad)
        self._session.link.send_drive(sent.seq, sent.ack, sent.wr, sent.wl, steer_rad=sent.steer)
        self._on_drive(sent.seq, sent.wr, sent.wl)
        return sent.seq

    def send_again(self) -> None:
        """Repeat the newest drive of the session, if any, with a new number."""
        sent = self._rule.repeat()
        if sent is not None:
            self._session.link.send_drive(sent.seq, sent.ack, sent.wr, sent.wl, steer_rad=sent.steer)


class FrameTime(Protocol):
    """Plans and sends the answers of the frames. ``withheld``: number of the frame that waits for its answer."""

    withheld: int | None

    def decide(self, frame: TimedFrame, verdict: Verdict | None) -> DriveCommand:
        """The drive that answers a frame; ``verdict``: in force, or ``None``."""

    def answer(self, seq: int, drive: DriveCommand) -> None:
        """Send the drive that answers frame ``seq``, or withhold it."""

    def answer_withheld(self) -> None:
        """Answer the withheld frame, if any, with a zero drive."""

    def release(self) -> None:
        """After a change between two frames, such as the end of a measurement or a pause: let time continue."""

    def hold(self, seq: int) -> None:
        """Hold the wheels without a new frame; ``seq``: of the newest one."""


class LockstepTime:
    """Simulated time stops while a peer is awaited, and almost stops in a pause: its frames are answered later."""

    def __init__(self, runner: MissionRunner, drives: DriveSender) -> None:
        self._runner = runner
        self._drives = drives
        self.withheld: int | None = None

    def decide(self, frame: TimedFrame, verdict: Verdict | None) -> DriveCommand:
        """No frame is late."""
        return self._runner.decide(frame, verdict, 0.0)

    def answer(self, seq: int, drive: DriveCommand) -> None:
        """Send the drive. Only a standing robot waits for its answer."""
        is_still = not (drive.right_rad_s or drive.left_rad_s)
        if is_still and self._stops():
            self.withheld = seq
        else:
            self._drives.send(seq, drive)

    def answer_withheld(self) -> None:
        """Answer the withheld frame, if any, with a zero drive."""
        seq, self.withheld = self.withheld, None
        if seq is not None:
            self._drives.send(seq, STILL)

    def release(self) -> None:
        """Answer the withheld frame, unless time has to stand still."""
        if not self._stops():
            self.answer_withheld()

    def hold(self, seq: int) -> None:
        """The last frame has been answered; a second answer would be a race."""

    def _stops(self) -> bool:
        runner = self._runner
        return runner.is_busy or (runner.mission.state.is_paused and runner.is_at_rest)


class RealTime:
    """Each frame is answered at once. A late one pauses the mission until frames are prompt again."""

    withheld: int | None = None

    def __init__(
        self,
        runner: MissionRunner,
        drives: DriveSender,
        pauses: PauseWatch,
        lateness: LatenessStatistics,
        limits: LinkConfig,
    ) -> None:
        self._runner = runner
        self._drives = drives
        self._pauses = pauses
        self._lateness = lateness
        self._limits = limits
        self._age = FrameAge()
        self._catches_up_until_s = -inf
        self.frame_period_s = 0.0  # of the present session

    def decide(self, frame: TimedFrame, verdict: Verdict | None) -> DriveCommand:
        """The drive that answers a frame; zero if the frame is too late."""
        runner, limits, begun_s = self._runner, self._limits, time.monotonic()
        lag_s = self._lateness.add(frame.sensors.t, begun_s)
        age_s = self._age.largest_s(frame.sensors.cmd, begun_s)
        is_old = age_s > limits.sensors_timeout_s
        if is_old or lag_s > limits.lag_limit_s:
            if begun_s < self._catches_up_until_s:
                return runner.hold(frame)
            verdict = None
            self._pause(frame.sensors.seq, lag_s, age_s)
        drive = runner.decide(frame, verdict, lag_s)
        now_s = time.monotonic()
        is_slow, is_still = now_s - begun_s > self.frame_period_s, drive == STILL
        # No hold for the delay of planning: it would cause new planning, and so on without end on a slow machine.
        self._catches_up_until_s = now_s + CATCH_UP_S if is_slow and is_still else -inf
        return drive

    def answer(self, seq: int, drive: DriveCommand) -> None:
        """Send the drive, and remember when, for the age of the frames that echo it."""
        self._age.add_drive(self._drives.send(seq, drive), time.monotonic())

    def answer_withheld(self) -> None:
        """No frame is withheld."""

    def release(self) -> None:
        """Time is real."""

    def hold(self, seq: int) -> None:
        """Send a zero drive."""
        self.answer(seq, STILL)

    def _pause(self, seq: int, lag_s: float, age_s: float) -> None:
        """Pause the mission until frames are prompt again."""
        limits, telemetry = self._limits, self._runner.telemetry
        is_old = age_s > limits.sensors_timeout_s
        row, late_ms, limit_ms = FRAME_LATE, 1e3 * lag_s, 1e3 * limits.lag_limit_s
        if is_old:
            row, late_ms, limit_ms = FRAMES_OLD, 1e3 * age_s, 1e3 * limits.sensors_timeout_s
        if self._pauses.interrupt(row, late_ms=late_ms, limit_ms=limit_ms):
            telemetry.log.warning("frame_late", seq=seq, lateness_ms=late_ms, limit_ms=limit_ms)
            if is_old:
                telemetry.notify_operator("warning", text_of(self._runner.mission.state.cause))
