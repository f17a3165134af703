"""Pure. How old a frame is when it is served, from the robot's clock and the host's."""

from math import inf

# The clocks' rates may differ by this much: two crystals of 100 parts in a million each.
DRIFT = 2e-4


class FrameAge:
    """Age against the quickest frames so far: what comes late, in a burst after a stall, is older than they were.

    The delay that every frame has is not seen; the robot's own echo of a drive's age shows that.
    """

    __slots__ = ("_least_s", "_t_s")

    def __init__(self) -> None:
        """No frame seen."""
        self._least_s, self._t_s = inf, 0.0

    def of(self, t_s: float, now_s: float) -> float:
        """Age of a frame, s, >= 0.

        Args:
            t_s: its robot time; where it goes back, the count begins anew.
            now_s: the host's monotonic time.
        """
        offset_s, since_s = now_s - t_s, t_s - self._t_s
        self._t_s = t_s
        if since_s <= 0.0:
            self._least_s = offset_s
            return 0.0
        self._least_s = least_s = min(offset_s, self._least_s + DRIFT * since_s)
        return offset_s - least_s
