"""Pure. What main had the wheels do between two estimates, for the monitors that compare it with what they did."""


class CommandSpan:
    """Lowest and highest set points of both wheels since they were last taken."""

    __slots__ = ("_left_high", "_left_low", "_right_high", "_right_low")

    def __init__(self) -> None:
        """Standing."""
        self._right_low = self._right_high = self._left_low = self._left_high = 0.0

    def add(self, right_rad_s: float, left_rad_s: float) -> None:
        """A drive was sent."""
        if right_rad_s < self._right_low:
            self._right_low = right_rad_s
        elif right_rad_s > self._right_high:
            self._right_high = right_rad_s
        if left_rad_s < self._left_low:
            self._left_low = left_rad_s
        elif left_rad_s > self._left_high:
            self._left_high = left_rad_s

    def take(self, right_rad_s: float, left_rad_s: float) -> tuple[float, float, float, float]:
        """The span up to now; the next one begins with the drive in force.

        Args:
            right_rad_s, left_rad_s: that drive.
        """
        span = self._right_low, self._right_high, self._left_low, self._left_high
        self._right_low = self._right_high = right_rad_s
        self._left_low = self._left_high = left_rad_s
        return span
