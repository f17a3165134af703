"""The drives that were sent: where the robot will be when the next one takes effect, and the span of their rates."""

from collections import deque
from math import cos, exp, sin

from ccatp.config.models import RobotConfig
from ccatp.core import Predicted

Pose = tuple[float, float, float]

# A delay below a thousandth of a frame is rounding of the robot's clock.
ROUNDING = 1e-3
# A robot whose echo is older than its own time-to-live holds its wheels: beyond that nothing is on the way any more.
REACH_S = 0.25


class SentDrives:
    """Carries a frame's estimate forward over the drives that are on their way to the wheels.

    The echo shows which drive was in force last and for how long; those sent after it follow one per frame. Each wheel
    is a first-order servo, so with a set point u over t

        v(t) = u + (v - u) exp(-t/T),    mean = u + (v - u) (T/t) (1 - exp(-t/T)).

    ``newest``, ``rates``: number and set points (right, left), rad/s, of the drive that was sent last.
    """

    def __init__(self, robot: RobotConfig, frame_s: float) -> None:
        self._radius_m, self._base_m, self._lag_s = robot.wheel_radius_m, robot.wheel_base_m, robot.wheel_lag_s
        self.newest = 0
        self.rates = (0.0, 0.0)
        self._right_low = self._right_high = self._left_low = self._left_high = 0.0
        self.begin_session(frame_s)

    def begin_session(self, frame_s: float) -> None:
        """Frames come every ``frame_s``; no drive of the last session is still to act."""
        if frame_s <= 0.0:
            raise ValueError(f"frame_s = {frame_s}: the period of the frames must be positive")
        self._frame_s = frame_s
        self._frame = frame_s, *_servo(self._lag_s, frame_s)
        self._sent: deque[tuple[int, float, float]] = deque(maxlen=max(1, round(REACH_S / frame_s)))

    def add(self, seq: int, right_rad_s: float, left_rad_s: float) -> None:
        """Drive ``seq`` was sent; a number that is not newer begins a new row."""
        sent = self._sent
        if sent and seq <= sent[-1][0]:
            sent.clear()
        v_m_s = 0.5 * self._radius_m * (right_rad_s + left_rad_s)
        sent.append((seq, v_m_s, self._radius_m * (right_rad_s - left_rad_s) / self._base_m))
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
        """Lowest and highest rate of right and left wheel since the last call, rad/s, the drive in force included."""
        span = self._right_low, self._right_high, self._left_low, self._left_high
        self._right_low = self._right_high = self.rates[0]
        self._left_low = self._left_high = self.rates[1]
        return span

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
        """The state in which the next command will find the robot; ``creep``: drift per metre in the plane of ``pose``.

        ``echo_seq`` is the drive in force (0: none) and ``echo_age_s`` its age; wheels of a robot that ``is_held`` run
        down whatever was sent.
        """
        sent, frame_s = self._sent, self._frame_s
        while len(sent) > 1 and sent[1][0] <= echo_seq:
            sent.popleft()
        (x, y, heading), v, omega = pose, v_m_s, omega_rad_s
        creep_x, creep_y = creep
        for seq, v_sent, omega_sent in sent:
            if seq > echo_seq:
                dt_s, keep, mean = self._frame
            else:  # the one in force
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
    """Shares of the difference to the set point: what is left after ``dt_s``, and its mean on the way."""
    if lag_s <= 0.0:
        return 0.0, 0.0
    keep = exp(-dt_s / lag_s)
    return keep, lag_s * (1.0 - keep) / dt_s
