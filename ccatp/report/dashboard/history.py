"""What grows while a run lasts, bounded: series of the plots, the driven path, messages, errors against the truth."""

from math import dist, hypot
from typing import Any

from ccatp.links.liveness import kind_of

Row = tuple[Any, ...]

# Not visible on a map of six metres.
PATH_STEP_M = 0.02


class Growing:
    """Rows in the order of their arrival, and the new ones; beyond ``limit`` the older half is thinned."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self.rows: list[Row] = []
        self._new: list[Row] = []

    def add(self, *row: Any) -> None:
        """Add a row."""
        self.rows.append(row)
        self._new.append(row)
        if len(self.rows) > self._limit:
            half = self._limit // 2
            self.rows[:half] = self.rows[:half:2]

    def take_new(self) -> list[Row]:
        """The rows since the last call, at most ``limit``."""
        new, self._new = self._new[-self._limit :], []
        return new


class Trail(Growing):
    """The driven path: rows of x and y, m, in steps of at least ``PATH_STEP_M``."""

    def add(self, *row: float) -> None:
        """Add the position of the robot, unless it is too near to the last row."""
        if not self.rows or dist(row, self.rows[-1]) >= PATH_STEP_M:
            super().add(*(round(value, 3) for value in row))


class Lines:
    """The newest message of each kind to the operator: robot time (s), level, text, count and number of its kind."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._rows: dict[tuple[str, str], Row] = {}
        self._new: dict[tuple[str, str], Row] = {}
        self._kinds = 0

    def add(self, t_s: float, level: str, text: str) -> None:
        """Add a message."""
        key = level, kind_of(text)
        before = self._rows.pop(key, None)
        self._new.pop(key, None)
        self._kinds += before is None
        times, kind = (1, self._kinds) if before is None else (before[3] + 1, before[4])
        self._rows[key] = self._new[key] = (t_s, level, text, times, kind)
        for rows in (self._rows, self._new):
            if len(rows) > self._limit:
                del rows[next(iter(rows))]

    @property
    def rows(self) -> list[Row]:
        """All rows, the newest last."""
        return list(self._rows.values())

    def take_new(self) -> list[Row]:
        """The rows since the last call."""
        new, self._new = list(self._new.values()), {}
        return new


# Frames between two that are compared: ten a second are.
EVERY = 10
# Frames without a counterpart: batches of a second, and some reserve.
WAITING = 500


class TruthCompare:
    """Joins estimates with the simulated truth of the same frame; either may arrive first.

    The largest error of each second is a row of ``errors``: robot time (s), error and three sigma of the position (mm).
    """

    def __init__(self, errors: Growing) -> None:
        self._errors = errors
        self._waiting: tuple[dict[int, tuple[float, ...]], dict[int, tuple[float, ...]]] = ({}, {})
        self._worst: tuple[float, float, float] | None = None

    @staticmethod
    def is_compared(seq: int) -> bool:
        """Whether a frame is one of those that are compared."""
        return seq % EVERY == 0

    def estimate(self, seq: int, x_m: float, y_m: float, sigma_m: float) -> None:
        """Add the estimate after frame ``seq``, deck frame."""
        self._join(seq, 0, (x_m, y_m, sigma_m))

    def truth(self, seq: int, t_s: float, x_m: float, y_m: float) -> None:
        """Add the true position in frame ``seq``."""
        if self.is_compared(seq):
            self._join(seq, 1, (t_s, x_m, y_m))

    def _join(self, seq: int, side: int, value: tuple[float, ...]) -> None:
        own = self._waiting[side]
        own[seq] = value
        if len(own) > WAITING:
            del own[next(iter(own))]
        if not all(seq in waiting for waiting in self._waiting):
            return
        (x_m, y_m, sigma_m), (t_s, true_x_m, true_y_m) = (waiting.pop(seq) for waiting in self._waiting)
        here, before = (t_s, 1e3 * hypot(x_m - true_x_m, y_m - true_y_m), 3e3 * sigma_m), self._worst
        if before is not None and int(t_s) == int(before[0]):
            self._worst = max(before, here, key=lambda second: second[1])
            return
        self._worst = here
        if before is not None:
            self._errors.add(round(before[0], 2), round(before[1], 3), round(before[2], 3))
