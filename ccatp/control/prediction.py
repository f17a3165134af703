"""Pure. Where the robot will be when a command sent now takes effect.

The delay is counted in the sequence numbers of the drives; no clock takes part.
"""

from collections import deque
from math import cos, exp, sin
from typing import NamedTuple

Pose = tuple[float, float, float]

# A delay below a thousandth of a frame is rounding of the robot's clock.
ROUNDING = 1e-3
# A robot whose echo is older than its own time-to-live holds its wheels: beyond that nothing is on the way any more.
REACH_S = 0.25


class Predicted(NamedTuple):
    """Pose in a plane, (x_m, y_m, heading_rad), and the speeds there."""

    pose: Pose
    v_m_s: float
    omega_rad_s: float


class CommandPredictor:
    """Rolls a frame's estimate forward over the commands that are still on their way to the wheels.

    A frame tells which drive was in force last and for how long. The drives sent after it follow one per frame. Each
    wheel is a first-order servo, so with a set point u over t

        v(t) = u + (v - u) exp(-t/T),    mean = u + (v - u) (T/t) (1 - exp(-t/T)),

    and the body goes on along the mean heading, carried off by the drift per metre of travel.

    Args:
        wheel_lag_s: nominal time constant T of the wheel servo.
        frame_s: period of the frames.
    """

    __slots__ = ("_frame_keep", "_frame_mean", "_frame_s", "_lag_s", "_sent")

    def __init__(self, wheel_lag_s: float, frame_s: float) -> None:
        """Nothing is on the way."""
        if frame_s <= 0.0:
            raise ValueError(f"frame_s = {frame_s}: the period of the frames must be positive")
        self._lag_s, self._frame_s = wheel_lag_s, frame_s
        self._frame_keep, self._frame_mean = _servo(wheel_lag_s, frame_s)
        self._sent: deque[tuple[int, float, float]] = deque(maxlen=max(1, round(REACH_S / frame_s)))

    def reset(self) -> None:
        """Forget what was sent: a new session begins."""
        self._sent.clear()

    def sent(self, seq: int, v_m_s: float, omega_rad_s: float) -> None:
        """A drive has been sent: its number and the twist that its wheel rates mean."""
        if self._sent and seq <= self._sent[-1][0]:
            self._sent.clear()
        self._sent.append((seq, v_m_s, omega_rad_s))

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
        """The state in which the next command will find the robot.

        Args:
            pose: (x, y, heading) at the time of the frame, m and rad, in any plane.
            v_m_s, omega_rad_s: speeds then.
            echo_seq: number of the drive in force then; -1 = none.
            echo_age_s: how long it had been; less than a frame is still to act for the rest of one.
            is_held: the robot held its wheels by its own rules: they run down, whatever has been sent.
            creep: drift per metre of travel in the plane of ``pose``.
        """
        sent = self._sent
        acting: tuple[int, float, float] | None = None
        while sent and sent[0][0] <= echo_seq:
            acting = sent[0]
            if len(sent) == 1 or sent[1][0] > echo_seq:
                break
            sent.popleft()
        state = Predicted(pose, v_m_s, omega_rad_s)
        rest_s = self._frame_s - echo_age_s
        if acting is not None and rest_s > ROUNDING * self._frame_s:
            keep, mean = _servo(self._lag_s, rest_s)
            v, omega = (0.0, 0.0) if is_held else acting[1:]
            state = _rolled(state, v, omega, rest_s, keep, mean, creep)
        for seq, *twist in sent:
            if seq > echo_seq:
                v, omega = (0.0, 0.0) if is_held else twist
                state = _rolled(state, v, omega, self._frame_s, self._frame_keep, self._frame_mean, creep)
        return state


def _servo(lag_s: float, dt_s: float) -> tuple[float, float]:
    """Shares of the difference to the set point: what is left after ``dt_s``, and its mean on the way."""
    if lag_s <= 0.0:
        return 0.0, 0.0
    keep = exp(-dt_s / lag_s)
    return keep, lag_s * (1.0 - keep) / dt_s


def _rolled(
    state: Predicted, v_set: float, omega_set: float, dt_s: float, keep: float, mean: float, creep: tuple[float, float]
) -> Predicted:
    (x, y, heading), v, omega = state
    travel = (v_set + (v - v_set) * mean) * dt_s
    turn = (omega_set + (omega - omega_set) * mean) * dt_s
    middle = heading + 0.5 * turn
    length = abs(travel)
    pose = x + travel * cos(middle) + length * creep[0], y + travel * sin(middle) + length * creep[1], heading + turn
    return Predicted(pose, v_set + (v - v_set) * keep, omega_set + (omega - omega_set) * keep)
