"""Where the robot will be when a command sent now takes effect.

The delay is counted in drive numbers, not by a clock.
"""

from collections import deque
from math import cos, exp, sin

from ccatp.core import Predicted

Pose = tuple[float, float, float]

# A delay below a thousandth of a frame is rounding of the robot's clock.
ROUNDING = 1e-3
# A robot whose echo is older than its own time-to-live holds its wheels: beyond that nothing is on the way any more.
REACH_S = 0.25


class CommandPredictor:
    """Carries a frame's estimate forward over the commands that are on their way to the wheels.

    The echo tells which drive was in force last and for how long; those sent after it follow one per frame. Each wheel
    is a first-order servo, so with a set point u over t

        v(t) = u + (v - u) exp(-t/T),    mean = u + (v - u) (T/t) (1 - exp(-t/T)),

    and the body goes on along the mean heading, carried off by the drift per metre of travel.
    """

    __slots__ = ("_frame", "_frame_s", "_lag_s", "_sent")

    def __init__(self, wheel_lag_s: float, frame_s: float) -> None:
        if frame_s <= 0.0:
            raise ValueError(f"frame_s = {frame_s}: the period of the frames must be positive")
        self._lag_s, self._frame_s = wheel_lag_s, frame_s
        self._frame = frame_s, *_servo(wheel_lag_s, frame_s)
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

        ``pose`` is (x, y, heading) in any plane, ``creep`` the drift per metre in it. ``echo_seq`` is the drive in
        force (-1: none) and ``echo_age_s`` its age; ``is_held``: the robot holds its wheels whatever was sent, and they
        run down.
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
