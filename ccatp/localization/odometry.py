"""Pure. Dead reckoning: the arc driven in one step, and the path driven lately.

The odometer's frame is arbitrary but rigid: neither a fix nor a hand-over between panels moves it, so displacements
and turns between two recent times can be read off it whatever happened to the pose in between.
"""

from collections import deque
from math import cos, hypot, sin
from typing import NamedTuple

_STILL_M = 2e-5
_STILL_RAD = 1e-4
_SMALL_RAD = 1e-4


class Place(NamedTuple):
    """Position (m) and heading (rad) in the odometer's frame."""

    x_m: float
    y_m: float
    heading_rad: float


def arc_step(v_m_s: float, heading_rad: float, turn_rad: float, dt_s: float) -> tuple[float, float]:
    """Displacement over one step at constant speed and rate.

    The chord of the arc: v dt sinc(turn/2) in the direction heading + turn/2. For a small step it becomes
    (v dt cos theta, v dt sin theta), which is what thesis eq. 2.14 means; the thesis prints ``v cos(theta dt)``, with
    the time step inside the cosine and missing on the speed.

    Args:
        v_m_s: mean forward speed, m/s.
        heading_rad: heading at the beginning, rad.
        turn_rad: turn over the step, rad.
        dt_s: duration, s.

    Returns:
        (dx, dy), m, in the frame of the heading.
    """
    half = 0.5 * turn_rad
    # Below _SMALL_RAD the series 1 - half^2/6 is exact to the last digit, and 0/0 is avoided.
    chord = v_m_s * dt_s * (sin(half) / half if abs(half) > _SMALL_RAD else 1.0 - half * half / 6.0)
    return chord * cos(heading_rad + half), chord * sin(heading_rad + half)


class Odometer:
    """The path of the last ``history_s``, and the whole of the standstill before it.

    A standstill keeps two entries however long it lasts, so a fix that took its time is still found.

    Args:
        history_s: how far back the path is kept while the robot moves.
    """

    def __init__(self, history_s: float) -> None:
        self._history_s = history_s
        self._path: deque[tuple[float, Place]] = deque()
        self.place = Place(0.0, 0.0, 0.0)

    def start(self, t_s: float) -> None:
        """Begin at ``t_s``; a second call moves the time base and keeps the path."""
        if not self._path:
            self._path.append((t_s, self.place))
            return
        shift = t_s - self._path[-1][0]
        self._path = deque((t + shift, place) for t, place in self._path)

    def advance(self, t_s: float, v_m_s: float, turn_rad: float, dt_s: float) -> None:
        """Drive one step that ends at ``t_s``: mean speed m/s, turn rad, duration s."""
        here = self.place
        dx, dy = arc_step(v_m_s, here.heading_rad, turn_rad, dt_s)
        self.place = Place(here.x_m + dx, here.y_m + dy, here.heading_rad + turn_rad)
        path = self._path
        if len(path) > 1 and _is_still(path[-2][1], self.place):
            path[-1] = (t_s, self.place)
        else:
            path.append((t_s, self.place))
        oldest = t_s - self._history_s
        while len(path) > 2 and path[1][0] < oldest:
            path.popleft()

    @property
    def oldest_s(self) -> float:
        """The earliest time that ``at`` knows."""
        return self._path[0][0] if self._path else float("inf")

    def at(self, t_s: float) -> Place:
        """Place at ``t_s``, linear between steps; outside the kept path its nearest end."""
        later = None
        for entry in reversed(self._path):
            if entry[0] <= t_s:
                return entry[1] if later is None else _between(entry, later, t_s)
            later = entry
        return later[1] if later is not None else self.place


def _is_still(a: Place, b: Place) -> bool:
    return hypot(b.x_m - a.x_m, b.y_m - a.y_m) < _STILL_M and abs(b.heading_rad - a.heading_rad) < _STILL_RAD


def _between(early: tuple[float, Place], late: tuple[float, Place], t_s: float) -> Place:
    (t0, a), (t1, b) = early, late
    part = (t_s - t0) / (t1 - t0)
    return Place(*(p + part * (q - p) for p, q in zip(a, b, strict=True)))
