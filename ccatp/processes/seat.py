"""Glue. The controller's seat at the robot: the session, its numbers, its clock, and the drives on their way."""

from ccatp.config.models import RobotConfig
from ccatp.control.kinematics import twist_of
from ccatp.control.prediction import CommandPredictor
from ccatp.health.commanded import CommandSpan
from ccatp.processes.joining import LastingLink
from ccatp.wire.robot import Hello


class Seat:
    """Sends drives and fans, and knows what the session is like.

    Args:
        cfg: the robot.
        link: the link, with the controller's role.
        is_taking_over: somebody else sat here before.
        frame_hz: rate of the frames, until the robot tells it.

    Attributes:
        predictor: of what is on its way.
        is_lockstep: the robot's clock is simulated.
        is_new_session: no frame of this session has been served yet.
    """

    def __init__(self, cfg: RobotConfig, link: LastingLink, *, is_taking_over: bool, frame_hz: float) -> None:
        """Not joined."""
        self._cfg, self._link, self._is_taking_over = cfg, link, is_taking_over
        self.predictor = CommandPredictor(cfg.wheel_lag_s, 1.0 / frame_hz)
        self._hello: Hello | None = None
        self._drive_seq = self._fans_seq = 0
        self._span, self._driven = CommandSpan(), (0.0, 0.0)
        self.is_lockstep = self.is_new_session = False

    def begin(self, hello: Hello) -> str:
        """A session begins; what people say of it."""
        before, self._hello, self.is_lockstep = self._hello, hello, hello.lockstep
        self.is_new_session = True
        self.predictor = CommandPredictor(self._cfg.wheel_lag_s, 1.0 / hello.frame_hz)
        where = f"the robot at {self._cfg.host}:{self._cfg.port}"
        return f"joined {where}{'' if before is None else ' again'}"

    def has_booted(self, hello: Hello) -> bool:
        """Whether the robot has started anew since the last session; to be asked before ``begin``."""
        return self._hello is not None and self._hello.boot != hello.boot

    @property
    def frame_period_s(self) -> float:
        """Time between two frames."""
        return 1.0 / self._hello.frame_hz if self._hello is not None else 0.01

    @property
    def is_unjudged(self) -> bool:
        """Danger may have judged the first frame before this session began, and does so once: the next one will do."""
        return self.is_new_session and (self._is_taking_over or self._link.sessions > 1)

    def drive(self, ack: int, right: float, left: float) -> None:
        """Send wheel rates, rad/s, computed from frame ``ack``."""
        self._drive_seq += 1
        self._driven = right, left
        self._span.add(right, left)
        twist = twist_of(right, left, self._cfg.wheel_radius_m, self._cfg.wheel_base_m)
        self.predictor.sent(self._drive_seq, twist.v_m_s, twist.omega_rad_s)
        self._link.link.send_drive(self._drive_seq, max(ack, 0), right, left)

    def told(self) -> tuple[tuple[float, float, float, float], int]:
        """Span of the set points since it was asked for last, rad/s, and the number of the newest drive."""
        return self._span.take(*self._driven), self._drive_seq

    def send_fans(self, duty: tuple[float, float]) -> None:
        """Send the fans' duties."""
        self._fans_seq += 1
        self._link.link.send_fans(self._fans_seq, duty)
