"""Glue. The controller's seat at the robot: the session, its numbers, its clock."""

from collections.abc import Callable

from ccatp.processes.joining import LastingLink
from ccatp.wire.robot import Hello


class Seat:
    """Sends drives and fans, and knows what the session is like.

    Args:
        link: the link, with the controller's role.
        is_taking_over: somebody else sat here before.
        frame_hz: rate of the frames, until the robot tells it.

    Attributes:
        on_drive: told of each drive that is sent: its number, and the rates of the right and the left wheel, rad/s.
        is_lockstep: the robot's clock is simulated.
        is_new_session: no frame of this session has been served yet.
    """

    def __init__(self, link: LastingLink, *, is_taking_over: bool, frame_hz: float) -> None:
        """Not joined."""
        self._link, self._is_taking_over, self._frame_hz = link, is_taking_over, frame_hz
        self._hello: Hello | None = None
        self._drive_seq = self._fans_seq = 0
        self.on_drive: Callable[[int, float, float], None] = lambda _seq, _right, _left: None
        self.is_lockstep = self.is_new_session = False

    def begin(self, hello: Hello, where: str) -> str:
        """A session begins, at an address; what people say of it."""
        before, self._hello, self.is_lockstep = self._hello, hello, hello.lockstep
        self.is_new_session = True
        return f"joined the robot at {where}{'' if before is None else ' again'}"

    def has_booted(self, hello: Hello) -> bool:
        """Whether the robot has started anew since the last session; to be asked before ``begin``."""
        return self._hello is not None and self._hello.boot != hello.boot

    @property
    def frame_period_s(self) -> float:
        """Time between two frames."""
        return 1.0 / (self._hello.frame_hz if self._hello is not None else self._frame_hz)

    @property
    def is_unjudged(self) -> bool:
        """Danger may have judged the first frame before this session began, and does so once: the next one will do."""
        return self.is_new_session and (self._is_taking_over or self._link.sessions > 1)

    def drive(self, ack: int, right: float, left: float, steer: float | None = None) -> None:
        """Send wheel rates, rad/s, and the steering angle, rad, where there is one, computed from frame ``ack``."""
        self._drive_seq += 1
        self.on_drive(self._drive_seq, right, left)
        link = self._link.link
        if steer is None:
            link.send_drive(self._drive_seq, max(ack, 0), right, left)
        else:
            link.send_drive(self._drive_seq, max(ack, 0), right, left, steer)

    def send_fans(self, duty: tuple[float, float]) -> None:
        """Send the fans' duties."""
        self._fans_seq += 1
        self._link.link.send_fans(self._fans_seq, duty)
