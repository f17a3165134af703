"""Pure. The clock of odometry beside that of readings: what is due, and where the vehicle was at a reading."""

from collections import deque
from dataclasses import replace
from math import cos, hypot, nan, sin
from typing import NamedTuple

from ccatp.filters.base import FloatArray
from ccatp.radio.motion import POSE, Increment, Odometry

SLIVER = 0.2
"""Part of an interval that is not worth a step of its own: the pose is carried over it."""


STANDS = (0.0, 0.0, 0.0)


class Carried(NamedTuple):
    """The pose at a reading's time: pose(t) = pose - back_s (vx, vy, turn).

    Attributes:
        pose: x_m, y_m, heading_rad.
        velocity: vx_m_s, vy_m_s in the frame of the map, turn_rad_s.
        back_s: the time it was carried back by; negative: forwards.
    """

    pose: list[float]
    velocity: tuple[float, float, float]
    back_s: float

    def by_heading(self) -> tuple[float, float]:
        """Derivatives of x and y by the heading of the state."""
        return self.back_s * self.velocity[1], -self.back_s * self.velocity[0]

    def by_delay(self) -> tuple[float, float, float]:
        """Derivatives of x, y and heading by the delay."""
        (vx, vy, turn), (x_heading, y_heading) = self.velocity, self.by_heading()
        return -vx - turn * x_heading, -vy - turn * y_heading, -turn


class DeadReckoning:
    """Odometry that tells what the vehicle will have done after a delay, which may be an estimate.

    Commanded speeds run ahead of the wheels; stamps of readings may come late or early. Steps wait until they are due:
    the state is the pose at t - delay by odometry's clock, which is the pose at t by that of the readings. Of a
    negative delay, odometry that comes late, only an interval can be made up for. What is left, less than an interval,
    the pose is carried over at constant speed, and the derivative by the delay is that speed (Li and Mourikis 2014).
    So readings between two steps are taken at their own time even where no delay is asked for.

    Args:
        is_delayed: False: every step is due at once.
    """

    def __init__(self, *, is_delayed: bool) -> None:
        self._is_delayed = is_delayed
        self._steps: deque[Odometry] = deque()
        self._until_s, self._interval_s = nan, 0.0
        self._rates = (0.0, 0.0, 0.0)  # forwards, to the left, turn

    def due(self, odometry: Odometry, delay_s: float) -> list[Odometry]:
        """The steps, or parts of one, to be taken when ``odometry`` arrives."""
        if not self._is_delayed:
            return [odometry]
        steps, found = self._steps, []
        steps.append(odometry)
        until_s = odometry.time_s - delay_s
        while steps and steps[0].time_s <= until_s:
            found.append(steps.popleft())
        if steps:
            first = steps[0]
            part = (until_s - first.time_s + first.interval_s) / first.interval_s if first.interval_s > 0.0 else 0.0
            if SLIVER < part < 1.0 - SLIVER:
                done, steps[0] = _split(first, part)
                found.append(done)
        return found

    def took(self, odometry: Odometry, before: FloatArray, after: FloatArray) -> float:
        """A step was taken, from one state to another; its length, m."""
        self._until_s, dt = odometry.time_s, odometry.interval_s
        self._interval_s = dt
        x, y, heading = before[:POSE].tolist()
        new_x, new_y, new_heading = after[:POSE].tolist()
        dx, dy, turn = new_x - x, new_y - y, new_heading - heading
        if dt > 0.0:
            c, s = cos(heading + 0.5 * turn), sin(heading + 0.5 * turn)
            self._rates = ((dx * c + dy * s) / dt, (dy * c - dx * s) / dt, turn / dt)
        return hypot(dx, dy)

    def at(self, pose: list[float], time_s: float, delay_s: float) -> Carried:
        """The pose, the first of some states, at a reading's time, carried no further than an interval."""
        limit_s = self._interval_s
        back_s = self._until_s + delay_s - time_s
        back_s = max(-limit_s, min(limit_s, back_s)) if limit_s > 0.0 else 0.0
        if back_s == 0.0 and not self._is_delayed:
            return Carried(pose[:POSE], STANDS, 0.0)  # its speed does not matter
        ahead, side, turn = self._rates
        heading = pose[2] - back_s * turn
        c, s = cos(heading), sin(heading)
        vx, vy = ahead * c - side * s, ahead * s + side * c
        return Carried([pose[0] - back_s * vx, pose[1] - back_s * vy, heading], (vx, vy, turn), back_s)


def _split(step: Odometry, part: float) -> tuple[Odometry, Odometry]:
    """A step in two."""
    first_s, rest_s = part * step.interval_s, (1.0 - part) * step.interval_s
    first = replace(step, time_s=step.time_s - rest_s, interval_s=first_s)
    rest = replace(step, interval_s=rest_s)
    if isinstance(first, Increment) and isinstance(rest, Increment):
        return _scaled(first, part), _scaled(rest, 1.0 - part)
    return first, rest


def _scaled(step: Increment, part: float) -> Increment:
    return replace(
        step,
        distance_m=part * step.distance_m,
        turn_rad=part * step.turn_rad,
        lateral_m=part * step.lateral_m,
        guess_m2=part * step.guess_m2,
        guess_rad2=part * step.guess_rad2,
    )
