"""How late and how old the frames of the robot are."""

from math import inf

from ccatp.links.frame_answers import MAX_DRIFT
from ccatp.links.robot_messages import CommandEcho

# Number of drives whose times are stored: ten seconds at 100 Hz.
SENT_DRIVES = 1024


class LatenessStatistics:
    """Measures the lag of each frame relative to the most prompt recent one.

    The difference of host and robot clock is smallest for a frame that was served at once. It may grow by the drift of
    the clocks; the rest is the lag. A constant delay, or a queue that grows as slowly as the clocks may drift, is not
    measured here but by ``FrameAge``. ``missed_deadlines``: frames served later than ``late_after_s``.
    """

    __slots__ = ("_late_after_s", "_least_s", "_t_s", "missed_deadlines", "worst_s")

    def __init__(self, late_after_s: float) -> None:
        self._late_after_s = late_after_s
        self._t_s, self._least_s = inf, 0.0
        self.missed_deadlines = 0
        self.worst_s = 0.0

    def reset(self) -> None:
        """Restart for another session or boot."""
        self._t_s = inf

    def add(self, t_s: float, wall_s: float) -> float:
        """The lag of a frame, s; ``t_s``: robot time, ``wall_s``: the host's monotonic clock when it is served.

        If the robot's time runs backward, its clock was set, and the measurement restarts.
        """
        offset_s = wall_s - t_s
        if t_s < self._t_s:
            self._least_s = offset_s
        else:
            self._least_s = min(offset_s, self._least_s + MAX_DRIFT * (t_s - self._t_s))
        self._t_s = t_s
        lag_s = offset_s - self._least_s
        if lag_s > self._late_after_s:
            self.missed_deadlines += 1
        self.worst_s = max(self.worst_s, lag_s)
        return lag_s


class FrameAge:
    """Upper bound of the age of a frame from the echo of a drive, without synchronised clocks.

    The robot received the drive after it was sent, and made the frame ``cmd.age`` later. The rest of the time until now
    is the delay of the drive plus that of the frame; how it is divided between them is not known.
    """

    def __init__(self) -> None:
        self._sent: list[tuple[int, float]] = [(-1, 0.0)] * SENT_DRIVES

    def add_drive(self, seq: int, wall_s: float) -> None:
        """Record the time of a sent drive."""
        self._sent[seq % SENT_DRIVES] = seq, wall_s

    def largest_s(self, echo: CommandEcho, wall_s: float) -> float:
        """The largest possible age of a frame served now, s; 0 if it echoes no drive of this process."""
        seq, sent_s = self._sent[echo.seq % SENT_DRIVES]
        return max(wall_s - sent_s - echo.age, 0.0) if seq == echo.seq >= 0 else 0.0
