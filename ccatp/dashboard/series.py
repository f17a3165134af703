"""Pure. What grows while a run goes on: samples of plots, the driven path, messages; bounded, and what of it is new."""

from math import hypot
from typing import Any

from ccatp.repetition import kind_of

Row = tuple[Any, ...]

# Nobody sees less than this on a map of six metres.
PATH_STEP_M = 0.02


class Growing:
    """Rows in the order in which they came.

    Args:
        limit: when there are more, every second one of the older half is dropped.
    """

    def __init__(self, limit: int) -> None:
        """Empty."""
        self._limit = limit
        self._rows: list[Row] = []
        self._new: list[Row] = []

    def add(self, *row: Any) -> None:
        """One more row."""
        self._rows.append(row)
        self._new.append(row)
        if len(self._rows) > self._limit:
            half = self._limit // 2
            self._rows[:half] = self._rows[:half:2]

    @property
    def rows(self) -> list[Row]:
        """All that are kept."""
        return self._rows

    @property
    def newest(self) -> Row | None:
        """The last one."""
        return self._rows[-1] if self._rows else None

    def take_new(self) -> list[Row]:
        """Those since the last time; nobody who has no page is told, so they are bounded as well."""
        new, self._new = self._new[-self._limit :], []
        return new


class Trail:
    """The driven path, as far as anybody looked; straight from stop to stop where nobody did.

    Args:
        limit: points kept.
    """

    def __init__(self, limit: int) -> None:
        """Nowhere yet."""
        self.points = Growing(limit)

    def add(self, x_m: float, y_m: float) -> None:
        """The robot is, or was, here; what is nearer to the last point than anybody sees is left out."""
        last = self.points.newest
        if last is None or hypot(x_m - last[0], y_m - last[1]) >= PATH_STEP_M:
            self.points.add(round(x_m, 3), round(y_m, 3))


class Lines:
    """The last lines told to the operator: of each kind the newest, and how often it was said.

    A row is the robot's time (s), the level, the text, how often lines of its kind were said, and the kind's number.

    Args:
        limit: so many kinds are kept.
    """

    def __init__(self, limit: int) -> None:
        """None yet."""
        self._limit = limit
        self._rows: dict[tuple[str, str], Row] = {}
        self._new: dict[tuple[str, str], Row] = {}
        self._kinds = 0

    def add(self, t_s: float, level: str, text: str) -> None:
        """One more line."""
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
        """All that are kept, the newest last."""
        return list(self._rows.values())

    def take_new(self) -> list[Row]:
        """Those since the last time."""
        new, self._new = list(self._new.values()), {}
        return new
