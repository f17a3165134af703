"""Pure. How often a point was approached, and whether it has to be approached again."""

from ccatp.samples import PointId


class Approaches:
    """Decides on a correction move after each fix.

    Args:
        tolerance_m: a puck further than this from its point has to come nearer.
        limit: approaches of one point before it is measured wherever the robot stands.
    """

    def __init__(self, tolerance_m: float, limit: int) -> None:
        """No point approached yet."""
        self._tolerance_m, self._limit = tolerance_m, limit
        self._point: PointId | None = None
        self.count = 0

    def is_too_far(self, point: PointId, error_m: float) -> bool:
        """Whether ``point`` has to be approached again; call once for each fix taken there."""
        self.count = self.count + 1 if point == self._point else 1
        self._point = point
        return error_m > self._tolerance_m and self.count < self._limit
