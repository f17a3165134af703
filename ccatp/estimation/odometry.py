"""Dead reckoning: slope of the ground, arc of a step, recent path, blocks of frames, wheel angles."""

from collections import deque
from collections.abc import Sequence
from math import cos, hypot, inf, sin, sqrt
from operator import mul
from typing import NamedTuple

from ccatp.core import ImuSample, Vector3
from ccatp.mirror.mirror import Mirror
from ccatp.rest import NO_MOTION_M, NO_MOTION_RAD

# Third derivatives of these mirrors stay below 3e-3 1/m^2, so within this distance a slope is off by less than 1e-7.
_REACH_M = 5e-3
# Below this slope no downhill direction is defined.
_LEVEL = 1e-3


class Slope(NamedTuple):
    """Second derivatives of the surface at a deck point, 1/m, and the downhill unit tangent (gx, gy), deck frame."""

    fx: float
    fy: float
    fxx: float
    fxy: float
    fyy: float
    gx: float
    gy: float


class Terrain:
    """Slopes near the robot, at a fraction of the cost of the polynomial."""

    def __init__(self, mirror: Mirror) -> None:
        self._surface = mirror.surface
        self._gravity = mirror.gravity_deck
        self._x_m = self._y_m = float("inf")

    def at(self, x_m: float, y_m: float) -> Slope:
        """Slopes at a deck point."""
        dx, dy = x_m - self._x_m, y_m - self._y_m
        if not -_REACH_M < dx < _REACH_M or not -_REACH_M < dy < _REACH_M:
            return self._evaluate(x_m, y_m)
        fx, fy, fxx, fxy, fyy, gx, gy = self._slope
        return Slope(fx + fxx * dx + fxy * dy, fy + fxy * dx + fyy * dy, fxx, fxy, fyy, gx, gy)

    def height_m(self, x_m: float, y_m: float) -> float:
        """Height of the surface over a deck point."""
        dx, dy = x_m - self._x_m, y_m - self._y_m
        if not -_REACH_M < dx < _REACH_M or not -_REACH_M < dy < _REACH_M:
            self._evaluate(x_m, y_m)
            dx = dy = 0.0
        fx, fy, fxx, fxy, fyy, _, _ = self._slope
        return self._f_m + fx * dx + fy * dy + 0.5 * (fxx * dx * dx + fyy * dy * dy) + fxy * dx * dy

    def _evaluate(self, x_m: float, y_m: float) -> Slope:
        self._f_m, fx, fy, fxx, fxy, fyy = self._surface.jet(x_m, y_m)
        self._x_m = x_m
        self._y_m = y_m
        gx, gy, gz = self._gravity
        norm = 1.0 + fx * fx + fy * fy
        # g minus its component along n = (-fx, -fy, 1)/W.
        along = (gz - fx * gx - fy * gy) / norm
        tx, ty, tz = gx + along * fx, gy + along * fy, gz - along
        length = sqrt(tx * tx + ty * ty + tz * tz)
        downhill = (tx / length, ty / length) if length > _LEVEL else (0.0, 0.0)
        self._slope = Slope(fx, fy, fxx, fxy, fyy, *downhill)
        return self._slope


class BodyAxes(NamedTuple):
    """Deck components of the robot's x axis (h, to the front) and y axis (l, to the left)."""

    hx: float
    hy: float
    lx: float
    ly: float


def axes_on(slope: Slope, psi: float) -> BodyAxes:
    """The axes of a robot with heading ``psi``, as ``Mirror.body_axes``."""
    fx, fy = slope[0], slope[1]
    s2 = 1.0 + fx * fx
    s, norm = sqrt(s2), sqrt(s2 + fy * fy)
    ex, ey = -fx * fy / (norm * s), s / norm
    c, d = cos(psi), sin(psi)
    return BodyAxes(c / s + d * ex, d * ey, c * ex - d / s, c * ey)


def gravity_on(slope: Slope, psi: float, gravity: Vector3) -> Vector3:
    """Gravity, given in the deck frame, in the frame of a robot with heading ``psi``."""
    fx, fy = slope[0], slope[1]
    gx, gy, gz = gravity
    hx, hy, lx, ly = axes_on(slope, psi)
    along = (gz - fx * gx - fy * gy) / sqrt(1.0 + fx * fx + fy * fy)
    return hx * gx + hy * gy + (fx * hx + fy * hy) * gz, lx * gx + ly * gy + (fx * lx + fy * ly) * gz, along


_SMALL_RAD = 1e-4


class OdometryPose(NamedTuple):
    """Position (m) and heading (rad) in the odometer's frame."""

    x_m: float
    y_m: float
    heading_rad: float


def arc_step(v_m_s: float, heading_rad: float, turn_rad: float, dt_s: float) -> tuple[float, float]:
    """Chord (dx, dy), m, of an arc from ``heading_rad`` on: v dt sinc(turn/2) at heading + turn/2.

    Thesis eq. 2.14, corrected: the printed form has the time step inside the cosine and not on the speed.
    """
    half = 0.5 * turn_rad
    # Below _SMALL_RAD the series 1 - half^2/6 is exact to the last digit, and avoids 0/0.
    chord = v_m_s * dt_s * (sin(half) / half if abs(half) > _SMALL_RAD else 1.0 - half * half / 6.0)
    return chord * cos(heading_rad + half), chord * sin(heading_rad + half)


class Odometer:
    """The path of the last ``history_s`` and the whole standstill before it, in a frame that fixes do not move."""

    def __init__(self, history_s: float) -> None:
        self._history_s = history_s
        self._path: deque[tuple[float, OdometryPose]] = deque()
        self.place = OdometryPose(0.0, 0.0, 0.0)

    def start(self, t_s: float) -> None:
        """Begin at ``t_s``; a second call shifts the time base and keeps the path."""
        if not self._path:
            self._path.append((t_s, self.place))
            return
        shift = t_s - self._path[-1][0]
        self._path = deque((t + shift, place) for t, place in self._path)

    def advance(self, t_s: float, v_m_s: float, turn_rad: float, dt_s: float) -> None:
        """Add a step that ends at ``t_s``: mean speed, turn, duration."""
        here = self.place
        dx, dy = arc_step(v_m_s, here.heading_rad, turn_rad, dt_s)
        self.place = OdometryPose(here.x_m + dx, here.y_m + dy, here.heading_rad + turn_rad)
        path = self._path
        if len(path) > 1:
            before, now = path[-2][1], self.place
            way_m, turned_rad = hypot(now.x_m - before.x_m, now.y_m - before.y_m), now.heading_rad - before.heading_rad
            if way_m < NO_MOTION_M and abs(turned_rad) < NO_MOTION_RAD:
                path.pop()
        path.append((t_s, self.place))
        oldest = t_s - self._history_s
        while len(path) > 2 and path[1][0] < oldest:
            path.popleft()

    @property
    def oldest_s(self) -> float:
        """The earliest time in the path."""
        return self._path[0][0] if self._path else float("inf")

    def at(self, t_s: float) -> OdometryPose:
        """Place at ``t_s``, linear between steps; outside the stored path its nearest end."""
        later = None
        for entry in reversed(self._path):
            if entry[0] <= t_s:
                if later is None:
                    return entry[1]
                part = (t_s - entry[0]) / (later[0] - entry[0])
                return OdometryPose(*(p + part * (q - p) for p, q in zip(entry[1], later[1], strict=True)))
            later = entry
        return later[1] if later is not None else self.place


class PreintegratedMotion(NamedTuple):
    """Mean angular rate of a block of frames, and mean acceleration from the middle of the block before."""

    dt_s: float
    turning_s: float
    rate_rad_s: float | None
    acceleration_m_s2: float | None
    samples: int


class Preintegrator:
    """Collects frames into blocks, in which the path is an arc.

    The mean rate follows from the samples by the trapezoidal rule, and the mean acceleration is that from the middle of
    one block to the middle of the next. A frame without a sample lengthens the trapezoid to the next sample, because
    the inertial unit may be slower than the frames.
    """

    def __init__(self) -> None:
        self._last: tuple[float, float] | None = None  # acceleration and rate at the end of the last frame
        self._before: float | None = None  # mean acceleration of the last block
        self._missed = 0  # frames without a sample since the last one
        self._clear()

    def _clear(self) -> None:
        self.dt_s = self._turning_s = self._rates = self._accelerations = 0.0
        self._samples = self._frames = 0

    def restart(self) -> None:
        """Drop all samples, because the robot's clock has jumped, or the robot was relocated."""
        self._last = self._before = None
        self._missed = 0
        self._clear()

    def stand(self, imu: Sequence[ImuSample]) -> None:
        """Take a frame at rest; its sample begins the trapezoid of the first moving frame."""
        self._last = (imu[-1][1], imu[-1][2]) if imu else None
        self._before = None
        self._missed = 0

    def add(self, dt_s: float, imu: Sequence[ImuSample], *, is_turning: bool) -> None:
        """Take a frame of length ``dt_s`` with the last of its inertial samples."""
        self.dt_s += dt_s
        if is_turning:
            self._turning_s += dt_s
        if not imu:
            self._missed += 1
            if self._missed > _MOST_MISSED:
                self._last = None
            return
        _, ax, wz = imu[-1]
        last, frames = self._last, self._missed + 1
        self._missed = 0
        if last is not None:
            self._accelerations += frames * (last[0] + ax)
            self._rates += frames * (last[1] + wz)
            self._frames += frames
            self._samples += 1
        self._last = (ax, wz)

    def take(self) -> PreintegratedMotion:
        """The block so far; the next one begins."""
        n = self._frames
        rate = acceleration = None
        if n:
            rate, acceleration = 0.5 * self._rates / n, 0.5 * self._accelerations / n
        before, self._before = self._before, acceleration
        if acceleration is not None and before is not None:
            acceleration = 0.5 * (before + acceleration)
        block = PreintegratedMotion(self.dt_s, self._turning_s, rate, acceleration, self._samples)
        self._clear()
        return block


# Largest number of frames without an inertial sample in a trapezoid: samples at 20 Hz, frames at 100 Hz.
_MOST_MISSED = 4
# Number of exact zeros in a row that shows a counting encoder; an analogue one never gives exact zeros.
_ZEROS_OF_A_COUNTER = 8
_COUNTER_NOISE = 1.0 / 12.0  # variance of a uniform distribution over one count
MIN_VARIANCE_RAD2 = 1e-10  # a third of a micrometre of travel; less would only cost the filter digits
# After this time without a sample the wheel's motion in between is uncertain.
_GAP_S = 0.02
# A sample at most this long before the end of its frame counts as taken at its end.
_SAME_S = 1e-4
_WHEEL_ACCELERATION_RAD_S2 = 10.0  # limits.a_max_m_s2 and alpha_max_rad_s2 together, on wheels of 30 mm
# For this time a wheel without samples is assumed to keep its recent rate.
_BRIDGED_S = 0.1
_LEARNED = 0.05  # weight of a frame in the usual period
_LEAST_COVER = 0.5  # least part of a frame that the samples of a counter have to cover
_LOST = 1.5  # number of periods between two samples of a counter beyond which a sample is missing
_LATELY_S = 0.05
_EVEN = 0.05  # part of a period by which the periods of a frame may exceed the shortest one, in sum
_ENOUGH = 200  # number of frames, or of counts of a counter, after which period and count are known


class WheelAngle:
    """The angle of one wheel since ``rebase``, the sum of its rate samples.

    For a counting encoder the sum of rate times period is exact to one count. The noisy rate of an analogue encoder is
    integrated by the trapezoidal rule. ``noise_rad2_s2``: variance of a sample at rest, None before the first rest.
    ``is_coasting``: it takes predicted turns; ``has_lost``: samples of the last gap were lost.
    """

    def __init__(self) -> None:
        self.angle_rad = self._gap_rad = self._bridged_s = self._bridged_rad = self._mean_rate = self._rate = 0.0
        self.is_fresh = self.is_counter = self.is_coasting = self.has_lost = False
        self.quantum_rad = self._period_s = inf
        self._usual_s = 0.0  # mean period of the first samples; the shortest one may be a jitter of the time stamps
        self._t_s = -inf
        self._seen = self._zeros = 0
        self._coasted_rad = 0.0
        self.noise_rad2_s2: float | None = None

    def restart(self) -> None:
        """Begin again with the next sample, because the robot's clock has jumped."""
        self._t_s = -inf
        self._bridged_s = self._bridged_rad = 0.0
        self._coasted_rad = 0.0

    def rebase(self) -> None:
        """Set the angle to zero."""
        self.angle_rad = 0.0

    def add(self, times_s: Sequence[float], rates_rad_s: Sequence[float], dt_s: float = 0.0) -> float:
        """Add the samples of a frame of ``dt_s``, oldest first; returns the turn of the wheel, rad.

        Without samples it assumes the recent rate for a while, so that the pose does not jump when samples come again.
        """
        self.is_fresh = bool(times_s)
        if not times_s:
            return self._bridge(dt_s)
        if self._t_s == -inf:
            self._t_s = times_s[0]
            self._rate = rates_rad_s[0]
        is_counter = self.is_counter
        if not is_counter:
            if 0.0 in rates_rad_s:
                is_counter = self._is_counting(rates_rad_s)
            else:
                self._zeros = 0
        elapsed_s = times_s[-1] - self._t_s
        if self._seen < _ENOUGH and elapsed_s > 0.0:
            period_s = elapsed_s / len(times_s)
            self._usual_s += (period_s - self._usual_s) * (_LEARNED if self._usual_s else 1.0)
        if self._seen >= _ENOUGH and elapsed_s < (len(times_s) + _EVEN) * self._period_s:
            # No sample is missing and the periods are equal, so the sum of the rates is enough.
            total = sum(rates_rad_s)
            turned = elapsed_s / len(times_s) * (total if is_counter else total + 0.5 * (self._rate - rates_rad_s[-1]))
        else:
            turned = self._counted(times_s, rates_rad_s) if is_counter else self._integrated(times_s, rates_rad_s)
        if elapsed_s > 0.0:
            self._mean_rate += (turned - self._mean_rate * elapsed_s) / (elapsed_s + _LATELY_S)
        self._t_s = times_s[-1]
        self._rate = rates_rad_s[-1]
        if self._bridged_s:
            turned -= self._bridged_rad
            self._bridged_s = self._bridged_rad = 0.0
        self.angle_rad += turned
        return turned

    def is_sparse(self, times_s: Sequence[float], dt_s: float) -> bool:
        """Whether most samples of a frame of ``dt_s`` are lost. A count is that of its own period only."""
        return self.is_counter and 0.0 < len(times_s) * self._usual_s < _LEAST_COVER * dt_s

    def is_silent(self, t_s: float) -> bool:
        """Whether a frame at ``t_s`` without samples is a gap: the encoder is not merely slower than the frames."""
        limit_s = _LOST * self._period_s
        return t_s - self._t_s > (limit_s if limit_s < inf else _GAP_S)

    def coast(self, turned_rad: float) -> None:
        """Take a predicted turn in place of the samples of a frame."""
        self.is_fresh = False
        self.is_coasting = True
        self._coasted_rad += turned_rad
        self.angle_rad += turned_rad

    def end_coasting(
        self, since_s: float, rate_rad_s: float, times_s: Sequence[float], rates_rad_s: Sequence[float]
    ) -> tuple[Sequence[float], Sequence[float]]:
        """End a gap with the samples of a frame after ``since_s``; returns those that are to be added.

        If all samples of the gap have come, only late, they replace the predicted turns. Otherwise the prediction stays
        (``has_lost``), ``rate_rad_s`` at its end included, and samples count from ``since_s`` on.
        """
        self.is_coasting = False
        coasted_rad, self._coasted_rad = self._coasted_rad, 0.0
        period_s = self._period_s if self._period_s < inf else _GAP_S
        self.has_lost = times_s[0] - self._t_s > _LOST * period_s
        if not self.has_lost:
            self._bridged_s = self._bridged_s + period_s
            self._bridged_rad = self._bridged_rad + coasted_rad
            return times_s, rates_rad_s
        self._bridged_s = self._bridged_rad = 0.0
        self._t_s = since_s
        self._rate = rate_rad_s
        self._mean_rate = rate_rad_s
        first = next((k for k, t_s in enumerate(times_s) if t_s > since_s), len(times_s))
        return times_s[first:], rates_rad_s[first:]

    def _bridge(self, dt_s: float) -> float:
        if self._t_s == -inf or self._bridged_s >= _BRIDGED_S:
            return 0.0
        turned = self._mean_rate * dt_s
        self._bridged_s += dt_s
        self._bridged_rad += turned
        self._gap_rad += abs(turned)
        self.angle_rad += turned
        return turned

    def _integrated(self, times_s: Sequence[float], rates_rad_s: Sequence[float]) -> float:
        turned, t0, before = 0.0, self._t_s, self._rate
        for t, rate in zip(times_s, rates_rad_s, strict=True):
            dt = t - t0
            if dt > _GAP_S:
                self._gap_rad += abs(rate) * dt
            if 0.0 < dt < self._period_s:
                self._period_s = dt
            turned += (before + rate) * dt
            t0, before = t, rate
        self._seen += 1
        return 0.5 * turned

    def _counted(self, times_s: Sequence[float], rates_rad_s: Sequence[float]) -> float:
        turned, t0, least, period = 0.0, self._t_s, self.quantum_rad, self._period_s
        for t, rate in zip(times_s, rates_rad_s, strict=True):
            dt = t - t0
            if dt > _LOST * period:
                # A rate is valid only for its own period; before that the recent mean rate is assumed.
                lost_s = dt - period
                turned += self._mean_rate * lost_s
                self._gap_rad += abs(self._mean_rate) * lost_s + (least if least < inf else 0.0)
                dt = period
            elif 0.0 < dt < period:
                period = dt
            if rate:
                step = rate * dt
                turned += step
                self._seen += 1
                if -least < step < least and step:
                    least = abs(step)
            t0 = t
        self.quantum_rad = least
        self._period_s = period
        return turned

    def _is_counting(self, rates_rad_s: Sequence[float]) -> bool:
        for rate in rates_rad_s:
            self._zeros = self._zeros + 1 if rate == 0.0 else 0
        if self._zeros >= _ZEROS_OF_A_COUNTER:
            self.is_counter = True
            self.noise_rad2_s2 = 0.0
            self._seen = 0
        return self.is_counter

    def take_gap(self) -> float:
        """Possible error of the angle by missing samples, rad; reset by the call."""
        gap_rad, self._gap_rad = self._gap_rad, 0.0
        return gap_rad

    def angle_at(self, t_s: float) -> tuple[float, float]:
        """The angle at the end of a frame, rad, and the additional variance if the last sample is older."""
        lag_s = t_s - self._t_s
        if not self.is_fresh or not _SAME_S < lag_s < _BRIDGED_S:
            return self.angle_rad, 0.0
        return self.angle_rad + self._rate * lag_s, (_WHEEL_ACCELERATION_RAD_S2 * lag_s * lag_s) ** 2

    def rest(self, rates_rad_s: Sequence[float]) -> None:
        """Estimate the noise from the samples of a standing wheel."""
        if self.is_counter or not rates_rad_s:
            return
        squares = sum(map(mul, rates_rad_s, rates_rad_s)) / len(rates_rad_s)
        # A slow mean, so that the residual motion after a stop is averaged out.
        old = self.noise_rad2_s2
        self.noise_rad2_s2 = squares if old is None else old + 0.02 * (squares - old)

    def variance_rad2(self) -> float:
        """Variance of the angle's bounded error: that of one count, or almost zero for an analogue encoder."""
        if self.is_counter and self.quantum_rad < inf:
            return self.quantum_rad * self.quantum_rad * _COUNTER_NOISE
        return MIN_VARIANCE_RAD2
