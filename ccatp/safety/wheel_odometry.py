"""Wheel odometry between any two times, from the encoder samples of the frames."""

from collections import deque
from collections.abc import Sequence
from math import cos, inf, sin
from typing import NamedTuple

from ccatp.core import DeckPose, WheelSample

# A frame may be as short as an encoder period.
HISTORY_FRAMES = 256
KNOTS_KEPT = 512
LARGEST = 1e9  # rad/s; a check for finite values


class Knot(NamedTuple):
    """The robot's velocity at the time of an encoder sample."""

    t_s: float
    v_m_s: float
    omega_rad_s: float


class WheelTrack:
    """The velocity of the robot over the last frames.

    ``v = r (wr + wl) / 2``, ``omega = r (wr - wl) / L`` (inverse of thesis eq. 3.3), linear between samples. To keep
    the cost of a frame low, ``push`` only stores the samples; ``update`` reads those of the last ``reach_s``. A rate
    that is not a number or exceeds ``limit_rad_s`` is ignored.
    """

    def __init__(
        self, wheel_radius_m: float, wheel_base_m: float, hold_s: float, reach_s: float, limit_rad_s: float = LARGEST
    ) -> None:
        self._limit_rad_s = limit_rad_s
        self._half_radius_m = 0.5 * wheel_radius_m
        self._radius_per_base = wheel_radius_m / wheel_base_m
        self._hold_s = hold_s
        self._reach_s = reach_s
        self._frames: deque[Sequence[WheelSample]] = deque(maxlen=HISTORY_FRAMES)
        self._right = self._left = 0.0
        self._right_t_s = self._left_t_s = self._usable_t_s = -inf
        self.knots: list[Knot] = []
        self.dropped = 0

    def push(self, samples: Sequence[WheelSample]) -> None:
        """Take the encoder samples of a frame, oldest first."""
        if not samples:
            return
        frames = self._frames
        frames.append(samples)
        t_s, right, left = samples[-1]
        if frames[0][-1][0] < t_s - self._reach_s:  # too old to be read; dropped early to avoid cache misses
            frames.popleft()
        limit = self._limit_rad_s
        if right is None or left is None or not (-limit <= right <= limit and -limit <= left <= limit):
            self.update(t_s)
            t_s = min(self._right_t_s, self._left_t_s)
        self._usable_t_s = max(self._usable_t_s, t_s)

    def update(self, t_s: float) -> None:
        """Read the frames pushed since the last call. Samples that are not newer or not finite are dropped."""
        frames, since_s = self._frames, t_s - self._reach_s
        while frames:
            samples = frames.popleft()
            if samples[-1][0] >= since_s:
                self._read(samples)
        if len(self.knots) > 2 * KNOTS_KEPT:
            self.dropped += len(self.knots) - KNOTS_KEPT
            del self.knots[:-KNOTS_KEPT]

    def _read(self, samples: Sequence[WheelSample]) -> None:
        half_radius_m, radius_per_base, hold_s = self._half_radius_m, self._radius_per_base, self._hold_s
        limit = self._limit_rad_s
        for t_s, right, left in samples:
            if t_s <= self._right_t_s or t_s <= self._left_t_s:
                continue
            if right is not None and -limit <= right <= limit:
                self._right = right
                self._right_t_s = t_s
            if left is not None and -limit <= left <= limit:
                self._left = left
                self._left_t_s = t_s
            if t_s - self._right_t_s <= hold_s and t_s - self._left_t_s <= hold_s:
                both, turning = self._right + self._left, self._right - self._left
                self.knots.append(Knot(t_s, half_radius_m * both, radius_per_base * turning))

    def silence_s(self, t_s: float) -> float:
        """Time without a usable sample of a wheel, s; 0 up to ``hold_s``. Without any sample: time since the boot."""
        if self._usable_t_s == -inf:
            return max(t_s, self._hold_s)
        silent_s = t_s - self._usable_t_s
        return silent_s if silent_s > self._hold_s else 0.0


class Odometry:
    """A pose in a plane, advanced by the travel of the wheels."""

    __slots__ = ("_next", "_track", "heading_rad", "omega_rad_s", "t_s", "v_m_s", "x_m", "y_m")

    def __init__(self, track: WheelTrack, t_s: float, pose: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        """Start at ``pose`` = (x, y, heading) at ``t_s``. Call ``track.update`` before."""
        self.t_s = t_s
        self.x_m, self.y_m, self.heading_rad = pose
        self._track = track
        knots = track.knots
        following = len(knots)
        while following and knots[following - 1].t_s > t_s:
            following -= 1
        self._next = following + track.dropped
        before = knots[following - 1] if following else (knots[0] if knots else Knot(t_s, 0.0, 0.0))
        self.v_m_s, self.omega_rad_s = self._velocity_at(t_s, before, following)

    def _velocity_at(self, t_s: float, before: Knot, following: int) -> tuple[float, float]:
        """Velocity between ``before`` and the following knot; that of ``before`` if there is no following one."""
        knots = self._track.knots
        if following >= len(knots):
            return before.v_m_s, before.omega_rad_s
        after = knots[following]
        if after.t_s <= before.t_s or t_s <= before.t_s:
            return before.v_m_s, before.omega_rad_s
        share = (t_s - before.t_s) / (after.t_s - before.t_s)
        v = before.v_m_s + share * (after.v_m_s - before.v_m_s)
        return v, before.omega_rad_s + share * (after.omega_rad_s - before.omega_rad_s)

    def advance_to(self, t_s: float) -> None:
        """Advance the pose to ``t_s`` by the trapezoidal rule; an earlier time has no effect."""
        knots, dropped = self._track.knots, self._track.dropped
        following, count = max(self._next - dropped, 0), len(knots)
        while following < count:
            knot = knots[following]
            if knot[0] > t_s:
                break
            self._move(*knot)
            following += 1
        self._next = following + dropped
        if t_s > self.t_s:
            here = Knot(self.t_s, self.v_m_s, self.omega_rad_s)
            self._move(t_s, *self._velocity_at(t_s, here, following))

    def _move(self, t_s: float, v_m_s: float, omega_rad_s: float) -> None:
        dt = t_s - self.t_s
        if dt > 0.0:
            turn = 0.5 * (self.omega_rad_s + omega_rad_s) * dt
            step = 0.5 * (self.v_m_s + v_m_s) * dt
            middle = self.heading_rad + 0.5 * turn
            self.x_m += step * cos(middle)
            self.y_m += step * sin(middle)
            self.heading_rad += turn
            self.t_s = t_s
        self.v_m_s = v_m_s
        self.omega_rad_s = omega_rad_s


def pose_at(track: WheelTrack, t_s: float, known_t_s: float, pose: DeckPose) -> DeckPose:
    """The pose at ``t_s`` from ``pose`` at ``known_t_s``, forward or backward along the track."""
    if t_s >= known_t_s:
        forward = Odometry(track, known_t_s, (pose.x_m, pose.y_m, pose.heading_rad))
        forward.advance_to(t_s)
        return DeckPose(forward.x_m, forward.y_m, forward.heading_rad)
    back = Odometry(track, t_s)
    back.advance_to(known_t_s)
    heading = pose.heading_rad - back.heading_rad
    c, s = cos(heading), sin(heading)
    x_m = pose.x_m - c * back.x_m + s * back.y_m
    return DeckPose(x_m, pose.y_m - s * back.x_m - c * back.y_m, heading)
