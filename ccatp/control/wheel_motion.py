"""Motion of the wheels: prediction from the sent drives, means of the encoder samples, plausibility of the IMU."""

from collections import deque
from collections.abc import Sequence
from math import cos, exp, inf, sin, sqrt
from typing import NamedTuple

from ccatp.config.models import HealthConfig, RobotConfig
from ccatp.core import ImuSample, Predicted, WheelSample

Pose = tuple[float, float, float]
_HELD = (0.0, 0.0)
_UNIFORM = 1.0 / sqrt(12.0)  # standard deviation of a uniform distribution over its width

# A delay below a thousandth of a frame is a rounding error of the robot's clock.
ROUNDING = 1e-3
# Longest time for which a sent drive can still take effect: after its time-to-live the robot holds its wheels.
REACH_S = 0.25


class SetPoints(NamedTuple):
    """Mean set points of the wheels in a frame, rad/s.

    ``right_doubt_rad``, ``left_doubt_rad``: standard deviations of their integrals by the unknown moment at which the
    robot held its wheels; the two errors have the same cause.
    """

    right_rad_s: float
    left_rad_s: float
    right_doubt_rad: float = 0.0
    left_doubt_rad: float = 0.0


class SentDrives:
    """Predicts the state of a frame over the drives that were sent but have not acted yet; tells which ones acted.

    The echo shows the drive in force and its age; the drives sent after it follow one per frame. Each wheel is a
    first-order servo, so with a set point u for a time t

        v(t) = u + (v - u) exp(-t/T),    mean = u + (v - u) (T/t) (1 - exp(-t/T)).

    ``newest``, ``rates``: number and set points (right, left), rad/s, of the last drive sent.
    """

    def __init__(self, robot: RobotConfig, frame_s: float) -> None:
        self._radius_m, self._base_m, self._lag_s = robot.wheel_radius_m, robot.wheel_base_m, robot.wheel_lag_s
        self._max_rad_s = robot.max_wheel_rad_s
        self.newest = 0
        self.rates = (0.0, 0.0)
        self._right_low = self._right_high = self._left_low = self._left_high = 0.0
        self.begin_session(frame_s)

    def begin_session(self, frame_s: float, ttl_s: float = REACH_S) -> None:
        """Begin a session with frames every ``frame_s``, and drop the drives of the last one.

        ``ttl_s``: time-to-live of drives and permits.
        """
        if frame_s <= 0.0:
            raise ValueError(f"frame_s = {frame_s}: the period of the frames must be positive")
        self._frame_s = frame_s
        self._frame = frame_s, *_servo(self._lag_s, frame_s)
        self._sent: deque[tuple[int, float, float, tuple[float, float]]] = deque(
            maxlen=max(1, round(REACH_S / frame_s))
        )
        self._ttl_s = ttl_s
        # Set points at the end of the last frame, None: unknown. Without a session the robot holds its wheels.
        self._acting: tuple[float, float] | None = _HELD
        self._was_held = True

    def add(self, seq: int, right_rad_s: float, left_rad_s: float) -> None:
        """Record drive ``seq``; a number that is not newer drops the earlier drives."""
        sent = self._sent
        if sent and seq <= sent[-1][0]:
            sent.clear()
        v_m_s = 0.5 * self._radius_m * (right_rad_s + left_rad_s)
        fastest = max(abs(right_rad_s), abs(left_rad_s))
        scale = self._max_rad_s / fastest if fastest > self._max_rad_s else 1.0  # as the robot does it
        wheels = scale * right_rad_s, scale * left_rad_s
        sent.append((seq, v_m_s, self._radius_m * (right_rad_s - left_rad_s) / self._base_m, wheels))
        self.newest, self.rates = seq, (right_rad_s, left_rad_s)
        if right_rad_s < self._right_low:
            self._right_low = right_rad_s
        elif right_rad_s > self._right_high:
            self._right_high = right_rad_s
        if left_rad_s < self._left_low:
            self._left_low = left_rad_s
        elif left_rad_s > self._left_high:
            self._left_high = left_rad_s

    def take_span(self) -> tuple[float, float, float, float]:
        """Lowest and highest set points of the right, then the left wheel since the last call, rad/s.

        The drive in force at the last call is included.
        """
        span = self._right_low, self._right_high, self._left_low, self._left_high
        self._right_low = self._right_high = self.rates[0]
        self._left_low = self._left_high = self.rates[1]
        return span

    def acted(
        self, dt_s: float, echo_seq: int, echo_age_s: float, permit_age_s: float, is_held: bool
    ) -> SetPoints | None:
        """Set points in the last ``dt_s``, from the echo at their end; ``None``: the drive in force is not known.

        Call it once in each frame, before ``ahead``. ``permit_age_s``: age of the newest permit.
        """
        before, was_held = self._acting, self._was_held
        now: tuple[float, float] | None = None
        if is_held or echo_seq == 0:
            now = _HELD
        else:
            for seq, _, _, wheels in self._sent:
                if seq == echo_seq:
                    now = wheels
                    break
        self._acting, self._was_held = now, is_held
        if now is None or before is None or now == before or dt_s <= 0.0:
            return None if now is None else SetPoints(*now)
        off_right, off_left = now[0] - before[0], now[1] - before[1]
        right_doubt = left_doubt = 0.0
        if not is_held:
            since_s = min(echo_age_s, permit_age_s) if was_held else echo_age_s
        elif was_held:
            since_s = dt_s
        elif (late_s := max(echo_age_s, permit_age_s) - self._ttl_s) > 0.0:
            since_s = late_s
        elif permit_age_s <= dt_s + ROUNDING * dt_s:
            since_s = permit_age_s  # the newest permit denies this direction
        else:  # by a rule of its own, at any time in the frame
            since_s, doubt_s = 0.5 * dt_s, dt_s * _UNIFORM
            right_doubt, left_doubt = doubt_s * off_right, doubt_s * off_left
        share = min(max(since_s / dt_s, 0.0), 1.0)
        right, left = before[0] + share * off_right, before[1] + share * off_left
        return SetPoints(right, left, right_doubt, left_doubt)

    def ahead(
        self,
        pose: Pose,
        v_m_s: float,
        omega_rad_s: float,
        echo_seq: int,
        echo_age_s: float,
        is_held: bool,
        creep: tuple[float, float] = (0.0, 0.0),
    ) -> Predicted:
        """The state when the next command takes effect. ``creep``: drift per metre, in the plane of ``pose``.

        ``echo_seq``: the drive in force (0: none); ``echo_age_s``: its age. If ``is_held``, the wheels run down
        whatever was sent.
        """
        sent, frame_s = self._sent, self._frame_s
        while len(sent) > 1 and sent[1][0] <= echo_seq:
            sent.popleft()
        (x, y, heading), v, omega = pose, v_m_s, omega_rad_s
        creep_x, creep_y = creep
        for seq, v_sent, omega_sent, _ in sent:
            if seq > echo_seq:
                dt_s, keep, mean = self._frame
            else:  # the drive in force
                dt_s = frame_s - echo_age_s
                if dt_s <= ROUNDING * frame_s:
                    continue
                keep, mean = _servo(self._lag_s, dt_s)
            v_set, omega_set = (0.0, 0.0) if is_held else (v_sent, omega_sent)
            travel = (v_set + (v - v_set) * mean) * dt_s
            turn = (omega_set + (omega - omega_set) * mean) * dt_s
            middle, length = heading + 0.5 * turn, abs(travel)
            x, y = x + travel * cos(middle) + length * creep_x, y + travel * sin(middle) + length * creep_y
            heading, v, omega = heading + turn, v_set + (v - v_set) * keep, omega_set + (omega - omega_set) * keep
        return Predicted((x, y, heading), v, omega)


def _servo(lag_s: float, dt_s: float) -> tuple[float, float]:
    """Part of the difference from the set point after ``dt_s``, and its mean over ``dt_s``."""
    if lag_s <= 0.0:
        return 0.0, 0.0
    keep = exp(-dt_s / lag_s)
    return keep, lag_s * (1.0 - keep) / dt_s


MotionSum = tuple[float, float, float, float]
"""Time, s; sums since the start: travel of right and left wheel, m, turn by the gyroscope where plausible, rad."""


class SlidingWindow:
    """The change of running sums over a period."""

    __slots__ = ("_kept", "_span_s")

    def __init__(self, span_s: float) -> None:
        self._span_s = span_s - 1e-6
        self._kept: deque[MotionSum] = deque()

    def reset(self) -> None:
        """Drop all sums."""
        self._kept.clear()

    def push(self, now: MotionSum) -> MotionSum | None:
        """Take the newest sums; returns the change over the period, with its length, ``None`` while it is too short."""
        kept, since_s = self._kept, now[0] - self._span_s
        kept.append(now)
        while len(kept) > 1 and kept[1][0] <= since_s:
            kept.popleft()
        t_s, right_m, left_m, turned_rad = kept[0]
        if t_s > since_s:
            return None
        return now[0] - t_s, now[1] - right_m, now[2] - left_m, now[3] - turned_rad


class WheelMeans:
    """Mean wheel rates of a frame (``None`` without samples), and the smoothed yaw rate of the wheels."""

    _SMOOTH_S = 0.05

    __slots__ = ("_limit_rad_s", "_per_base", "left_rad_s", "right_rad_s", "yaw_rad_s")

    def __init__(self, robot: RobotConfig) -> None:
        self._per_base = robot.wheel_radius_m / robot.wheel_base_m
        self._limit_rad_s = largest_rate_rad_s(robot)
        self.right_rad_s: float | None = 0.0
        self.left_rad_s: float | None = 0.0
        self.yaw_rad_s = 0.0

    def take(self, samples: Sequence[WheelSample], dt_s: float) -> None:
        """Take a frame's samples; ``dt_s`` after the last frame."""
        if not samples:
            self.right_rad_s = self.left_rad_s = None
            return
        _, right, left = zip(*samples)  # noqa: B905 - of one length; checking that takes longer
        count = len(right)
        try:
            right_rad_s, left_rad_s = sum(right) / count, sum(left) / count
        except TypeError:  # a wheel gave no sample
            self._take_some(right, left)
            return
        limit = self._limit_rad_s
        if not (-limit <= right_rad_s <= limit and -limit <= left_rad_s <= limit):
            self._take_some(right, left)
            return
        self.right_rad_s, self.left_rad_s = right_rad_s, left_rad_s
        share = dt_s / (self._SMOOTH_S + dt_s)
        self.yaw_rad_s += share * (self._per_base * (right_rad_s - left_rad_s) - self.yaw_rad_s)

    def _take_some(self, right: Sequence[float | None], left: Sequence[float | None]) -> None:
        self.right_rad_s, self.left_rad_s = self._mean(right), self._mean(left)

    def _mean(self, rates: Sequence[float | None]) -> float | None:
        limit = self._limit_rad_s
        usable = [rate for rate in rates if rate is not None and -limit <= rate <= limit]
        return sum(usable) / len(usable) if usable else None


def as_standing(samples: Sequence[WheelSample]) -> list[WheelSample]:
    """Samples of standing wheels, for a held robot whose encoders are not trusted."""
    return [WheelSample(sample.t_s, 0.0, 0.0) for sample in samples]


def largest_rate_rad_s(robot: RobotConfig) -> float:
    """Largest plausible encoder rate, rad/s; it allows for one count too many per sample."""
    return 3.0 * robot.max_wheel_rad_s


_STILL_RAD_S = 0.02  # yaw rate of wheels that stand


class ImuGate:
    """Rejects the inertial unit while its readings are impossible, and for a quarantine time afterwards.

    Impossible are: an acceleration or rate that the robot cannot reach; a rate that jumps away from that of the wheels
    (``ccatp.safety.wheel_monitors`` judges a slow drift); exact repetition by a unit that has shown noise at rest.
    While the unit is used, ``cause`` is empty and ``out_since_s`` infinite.
    """

    def __init__(self, cfg: HealthConfig) -> None:
        self._rate, self._share = cfg.imu_rate_rad_s, cfg.imu_rate_share
        self._largest, self._jump = cfg.imu_largest_rad_s, cfg.imu_jump_rad_s
        self._acceleration, self._identical = cfg.imu_acceleration_m_s2, cfg.identical_samples
        self._quarantine_s = cfg.imu_quarantine_s
        self.reset()

    def reset(self) -> None:
        """The clock was reset."""
        self._ax = self._wz = inf
        self._same_ax = self._same_wz = self._different = 0
        self._is_noisy = False
        self._bad_s = -inf
        self.cause, self.value, self.limit = "", 0.0, 0.0
        self.out_since_s = inf

    def admit(self, samples: Sequence[ImuSample], yaw_rad_s: float) -> Sequence[ImuSample]:
        """The usable samples of a frame, oldest first: all or none."""
        limit = self._rate + self._share * (yaw_rad_s if yaw_rad_s >= 0.0 else -yaw_rad_s)
        is_good = True
        for t_s, ax, wz in samples:
            if ax == self._ax or wz == self._wz or not self._is_noisy:
                self._compare(ax, wz, yaw_rad_s)
            off, jump, largest = wz - yaw_rad_s, wz - self._wz, self._largest
            # The first reading is not a repetition.
            self._same_ax = self._same_ax + 1 if ax == self._ax else 0
            self._same_wz = self._same_wz + 1 if wz == self._wz else 0
            self._ax, self._wz = ax, wz
            if not -largest <= wz <= largest or (not -limit <= off <= limit and not -self._jump <= jump <= self._jump):
                self._blame(t_s, "the gyroscope's rate is impossible", off, limit)
            elif not -self._acceleration <= ax <= self._acceleration:
                self._blame(t_s, "the acceleration is impossible", ax, self._acceleration)
            elif self._is_noisy and max(self._same_ax, self._same_wz) >= self._identical - 1:
                repeats = max(self._same_ax, self._same_wz) + 1
                self._blame(t_s, "the inertial unit repeats itself", repeats, self._identical)
            if -self._quarantine_s < t_s - self._bad_s < self._quarantine_s:
                is_good = False
            elif self.cause:
                self.cause, self.out_since_s = "", inf
        return samples if is_good else ()

    def _compare(self, ax: float, wz: float, yaw_rad_s: float) -> None:
        if -_STILL_RAD_S < yaw_rad_s < _STILL_RAD_S and ax != self._ax and wz != self._wz:
            self._different += 1
            self._is_noisy = self._is_noisy or self._different >= self._identical
        else:
            self._different = 0

    def _blame(self, t_s: float, cause: str, value: float, limit: float) -> None:
        self._bad_s = t_s
        if not self.cause:
            self.cause, self.value, self.limit, self.out_since_s = cause, float(value), float(limit), t_s
