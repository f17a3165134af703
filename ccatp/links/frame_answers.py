"""Which frame is meant: its identity, the restart of the robot, and the drive or permit that answers it.

The rules are pure. ``DriveRule`` is that of main, ``PermitRule`` that of danger; the third part, what the robot does
with the answers, is ``ccatp.onboard.rules``. ``tests/property/test_two_keys.py`` explores the three together.
"""

from dataclasses import dataclass
from typing import NamedTuple

from ccatp.core import NO_MOTION, Permits, Verdict
from ccatp.links.robot_messages import Drive, Permit

# The rate of the robot's clock may be wrong by 1 % and may change; that of the host is much better.
MAX_DRIFT = 1.02e-2
# A robot that was away may answer late, and its first frame may wait: the clock of a restarted robot is behind by its
# whole time in service before, which is far more.
AWAY_SLACK_S = 1.0


class FrameStamp(NamedTuple):
    """Identity of a frame for one client: boot number, the client's own count of sessions, number and robot time."""

    boot: int
    session: int
    seq: int
    t_s: float


def is_restart(before: FrameStamp, first: FrameStamp, away_s: float = 0.0) -> bool:
    """Whether the robot restarted between the newest frame of the sessions ``before`` and the ``first`` of the next.

    The boot number alone does not tell, because firmware may have no counter in its flash. Numbers and time count
    within the boot, so neither can be lower. Nor can the robot's clock have advanced by less than ``away_s``, the
    host's time between the two frames, apart from drift (0 where the robot's time is simulated).
    """
    if first.boot != before.boot or first.seq < before.seq or first.t_s < before.t_s:
        return True
    return first.t_s - before.t_s < (1.0 - MAX_DRIFT) * away_s - AWAY_SLACK_S


class DriveRule:
    """The drives of main: their numbers, and the newest one of the session, to be repeated."""

    def __init__(self) -> None:
        self._seq = 0
        self.begin_session()

    def begin_session(self) -> None:
        """Forget frame and drive of the session before; the numbers continue."""
        self._frame_seq = -1
        self._newest: Drive | None = None

    def take(self, seq: int) -> None:
        """Take the newest frame of the session."""
        self._frame_seq = seq

    def drive(self, ack: int, right_rad_s: float, left_rad_s: float, steer_rad: float | None = None) -> Drive:
        """The drive that answers frame ``ack``; only one that answers the newest frame of the session may move."""
        if ack != self._frame_seq:
            right_rad_s = left_rad_s = 0.0
        self._seq += 1
        self._newest = drive = Drive(self._seq, max(ack, 0), right_rad_s, left_rad_s, steer_rad)
        return drive

    def repeat(self) -> Drive | None:
        """The newest drive of the session with a new number, ``None`` without one."""
        newest = self._newest
        if newest is None:
            return None
        return self.drive(newest.ack, newest.wr, newest.wl, newest.steer)


@dataclass(frozen=True, slots=True)
class JudgedFrame:
    """A frame that danger has judged, and the verdict on it. Only from this a permit of motion is made."""

    frame: FrameStamp
    verdict: Verdict


def permitted(newest: FrameStamp | None, judged: JudgedFrame | None) -> Permits:
    """The motion permitted on the newest frame: that of its own verdict, otherwise none."""
    if judged is None or judged.frame != newest:
        return NO_MOTION
    return judged.verdict.permits


class PermitRule:
    """The permits of danger: which frame is judged, and which permit answers it.

    A frame is judged once. A repetition of the newest frame of the session gets the permit by that frame's own verdict.
    Every other frame that is not judged, such as the last one of the session before, gets a permit without any motion.
    """

    def __init__(self) -> None:
        self._seq = 0
        self._highest_seq = -1  # of a frame that was judged since the robot's last restart
        self.begin_session()

    def begin_session(self) -> None:
        """Forget frame and verdict of the session before; the numbers continue."""
        self._newest: FrameStamp | None = None
        self._judged: JudgedFrame | None = None

    def restart(self) -> None:
        """Begin again, because the robot's frame numbers have restarted."""
        self._highest_seq = -1

    def take(self, frame: FrameStamp) -> bool:
        """Take a frame of the session; whether it is to be judged."""
        newest = self._newest
        if newest is not None and frame.seq <= newest.seq:
            return False
        self._newest, self._judged = frame, None
        if frame.seq <= self._highest_seq:
            return False
        self._highest_seq = frame.seq
        return True

    def judge(self, verdict: Verdict) -> None:
        """Take the verdict on the newest frame. A verdict on another frame, or at another time, is none on this one."""
        newest = self._newest
        is_own = newest is not None and verdict.seq == newest.seq and verdict.t_s == newest.t_s
        self._judged = JudgedFrame(newest, verdict) if newest is not None and is_own else None

    def permit(self) -> Permit | None:
        """The next permit, which answers the newest frame; ``None`` before the first frame of the session."""
        newest = self._newest
        if newest is None:
            return None
        self._seq += 1
        return Permit(self._seq, newest.seq, *permitted(newest, self._judged))
