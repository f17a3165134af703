"""Glue. The drives of a differential drive on their way: what will come of them, and what main had the wheels do."""

from ccatp.config.models import RobotConfig
from ccatp.control.kinematics import twist_of
from ccatp.control.prediction import CommandPredictor
from ccatp.health.commanded import CommandSpan


class Commanded:
    """Hears of each drive that is sent.

    Args:
        cfg: the robot.
        frame_hz: rate of the frames, until the robot tells it.

    Attributes:
        predictor: of what is on its way.
    """

    def __init__(self, cfg: RobotConfig, frame_hz: float) -> None:
        """Nothing sent."""
        self._cfg = cfg
        self._span = CommandSpan()
        self._newest, self._driven = 0, (0.0, 0.0)
        self.begin(frame_hz)

    def begin(self, frame_hz: float) -> None:
        """A session begins: nothing of the one before is on its way."""
        self.predictor = CommandPredictor(self._cfg.wheel_lag_s, 1.0 / frame_hz)

    def sent(self, seq: int, right: float, left: float) -> None:
        """Drive ``seq``, wheel rates in rad/s, is sent."""
        self._newest, self._driven = seq, (right, left)
        self._span.add(right, left)
        twist = twist_of(right, left, self._cfg.wheel_radius_m, self._cfg.wheel_base_m)
        self.predictor.sent(seq, twist.v_m_s, twist.omega_rad_s)

    def told(self) -> tuple[tuple[float, float, float, float], int]:
        """Span of the set points since it was asked for last, rad/s, and the number of the newest drive."""
        return self._span.take(*self._driven), self._newest
