"""Pure. How often a point was approached, and whether it has to be approached again."""

from ccatp.samples import PointId

# A puck is within the tolerance when it is so by more than the fix may be wrong (guard band, ISO 14253-1); but a laser
# system of little precision cannot make a robot approach a point again and again.
_GUARD_SIGMAS = 3.0
_MOST_GUARD = 0.1  # of the tolerance


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

    def is_too_far(self, point: PointId, error_m: float, sigma_m: float) -> bool:
        """Whether ``point`` has to be approached again; call once for each fix taken there.

        Args:
            point: that was measured.
            error_m: distance of the puck from it, by the fix.
            sigma_m: standard deviation of the robot's place after the fix, along its worst direction.
        """
        self.count = self.count + 1 if point == self._point else 1
        self._point = point
        guard_m = min(_GUARD_SIGMAS * sigma_m, _MOST_GUARD * self._tolerance_m)
        return error_m > self._tolerance_m - guard_m and self.count < self._limit
