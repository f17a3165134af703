"""Glue. The time of the frames that a main loop serves: steady, from the first one on, over boots of the robot."""

from ccatp.health.steady_time import SteadyTime


class FrameClock:
    """Numbers and times of the frames.

    Args:
        jump_s: the robot's clock has jumped if a frame is further off.
        elapsed_s: of the mission, before the first frame that we serve.

    Attributes:
        seq: the newest frame.
        t_s: its time, without jumps.
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

    def begin_with(self, elapsed_s: float) -> None:
        """So much of the mission was over before we came."""
        self._before_s = elapsed_s

    def look(self, seq: int, t_s: float, period_s: float) -> tuple[float, float]:
        """Time of a frame and time since the last one, s; nothing is changed before ``serve``.

        Args:
            seq: its number.
            t_s: its time by the robot's clock.
            period_s: time since the frame before where there is none.
        """
        # What counts durations goes by a time that does not jump; everything else by the robot's own.
        steady_s = self._steady.at(seq, t_s) if seq > self.seq else self.t_s
        return steady_s, steady_s - self.t_s if self._first_s is not None else period_s

    def serve(self, seq: int, steady_s: float) -> bool:
        """The frame is served now; whether it is the first in this boot of the robot."""
        is_first = self._first_s is None
        if self._first_s is None:
            self._first_s = steady_s
        self.t_s, self.seq = steady_s, max(seq, self.seq)
        return is_first

    def boot(self) -> None:
        """The robot's frames and clock count anew."""
        self._before_s, self._first_s, self.seq = self.elapsed_s, None, -1
        self._steady = SteadyTime(self._jump_s)
