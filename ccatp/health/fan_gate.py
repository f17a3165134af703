"""Pure. The last gate before the fans: on an overhanging mirror no command ever asks for less than the floor."""

from math import isfinite


class FanGate:
    """Lets through duties that are finite, within 0 and 1, and not below the floor; refuses all others whole.

    Args:
        floor: least duty of each fan; 0 where the robot does not hang.

    Attributes:
        refusals: commands refused.
    """

    def __init__(self, floor: float) -> None:
        """Nothing commanded yet."""
        self._floor = floor
        self.refusals = 0

    def pass_through(self, duty: tuple[float, float]) -> tuple[float, float] | None:
        """The duties (left, right), or ``None`` where they must not be sent: what is in force stays in force."""
        left, right = duty
        is_sound = isfinite(left) and isfinite(right) and self._floor <= min(left, right) and max(left, right) <= 1.0
        if not is_sound:
            self.refusals += 1
            return None
        return left, right
