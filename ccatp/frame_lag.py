"""Pure. How late frames are served: what a blocked event loop, a busy machine or a slow link costs."""

# The robot's clock and the host's drift apart by less than this share; a quartz is ten times better.
MAX_DRIFT = 2e-4
_NEVER_S = float("inf")


class FrameLag:
    """Measures the lag of each frame against the promptest one lately.

    The difference of the host's clock to the robot's is least for a frame that was served at once. It may grow by the
    drift of the clocks; whatever it is above that, the frame is late. What always takes the same time does not show.

    Args:
        slip_s: a frame served later than this is a slip of the cycle.

    Attributes:
        slips: frames served later than ``slip_s``.
        worst_s: the largest lag so far, s.
    """

    __slots__ = ("_least_s", "_slip_s", "_t_s", "_wall_s", "slips", "worst_s")

    def __init__(self, slip_s: float) -> None:
        """Nothing served yet."""
        self._slip_s = slip_s
        self._t_s, self._wall_s, self._least_s = _NEVER_S, 0.0, 0.0
        self.slips = 0
        self.worst_s = 0.0

    def forget(self) -> None:
        """Begin anew: another session, or another boot."""
        self._t_s = _NEVER_S

    def served(self, t_s: float, wall_s: float) -> float:
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
        if lag_s > self._slip_s:
            self.slips += 1
        self.worst_s = max(self.worst_s, lag_s)
        return lag_s
