"""Pure. Refused readings, counted: whether they accuse the pose or a beacon."""


class Doubts:
    """One reading that is not believed is an outlier. Several in a row, of whichever beacons, accuse the pose.

    Args:
        after: refusals in a row that accuse the pose.
    """

    def __init__(self, after: int) -> None:
        self._after, self._refused = after, 0

    def clear(self) -> None:
        """A reading was believed."""
        self._refused = 0

    def refuse(self) -> bool:
        """A reading was not believed; True if the pose is to be doubted now."""
        self._refused += 1
        if self._refused < self._after:
            return False
        self._refused = 0
        return True
