"""The drives of the main loop: numbered, sent on the present session, repeated when the robot asks again."""

from collections.abc import Callable

from ccatp.daemon.loops.mission_runner import DriveCommand
from ccatp.daemon.loops.robot_session import RobotSession
from ccatp.links.frame_answers import DriveRule


class DriveSender:
    """Sends drives. ``on_drive``: called with number and set points of each one."""

    def __init__(self, session: RobotSession, on_drive: Callable[[int, float, float], None]) -> None:
        self._session = session
        self._on_drive = on_drive
        self._rule = DriveRule()
        self.take = self._rule.take
        self.begin_session = self._rule.begin_session

    def send(self, ack: int, drive: DriveCommand) -> int:
        """Send the drive that was computed from frame ``ack``; returns its number."""
        sent = self._rule.drive(ack, drive.right_rad_s, drive.left_rad_s, drive.steer_rad)
        self._session.link.send_drive(sent.seq, sent.ack, sent.wr, sent.wl, steer_rad=sent.steer)
        self._on_drive(sent.seq, sent.wr, sent.wl)
        return sent.seq

    def send_again(self) -> None:
        """Repeat the newest drive of the session, if any, with a new number."""
        sent = self._rule.repeat()
        if sent is not None:
            self._session.link.send_drive(sent.seq, sent.ack, sent.wr, sent.wl, steer_rad=sent.steer)
