"""Motion of the wheels, predicted from the sent drives."""

from collections import deque
from math import cos, exp, sin, sqrt
from typing import NamedTuple

from ccatp.config.models import RobotConfig
from ccatp.core import Predicted

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


class SentSpan(NamedTuple):
    """Lowest and highest set points of the right and the left wheel, rad/s."""

    right_low: float
    right_high: float
    left_low: float
    left_high: float


class SentDrives:
    """Predicts the state of a frame over the drives that were sent but have not acted yet; tells which ones acted.

    The echo shows the drive in force and its age; the drives sent after it follow one per frame. Each wheel is a
    first-order servo, so with a set point u for a time t

        v(t) = u + (v - u) exp(-t/T),    mean = u + (v - u) (T/t) (1 - exp(-t/T)).

    ``newest``, ``rates``: number and set points (right, left), rad/s, of the last drive sent.
    """

    def __init__(self, robot: RobotConfig, frame_s: float) -> None:
        self._radius_m = robot.wheel_radius_m
        self._base_m = robot.wheel_base_m
        self._lag_s = robot.wheel_lag_s
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
        self.newest = seq
        self.rates = (right_rad_s, left_rad_s)
        if right_rad_s < self._right_low:
            self._right_low = right_rad_s
        elif right_rad_s > self._right_high:
            self._right_high = right_rad_s
        if left_rad_s < self._left_low:
            self._left_low = left_rad_s
        elif left_rad_s > self._left_high:
            self._left_high = left_rad_s

    def take_span(self) -> SentSpan:
        """The set points since the last call; the drive in force then is included."""
        span = SentSpan(self._right_low, self._right_high, self._left_low, self._left_high)
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
        self._acting = now
        self._was_held = is_held
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
