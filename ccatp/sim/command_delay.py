"""Pure. The way of commands to the wheels: what arrives takes effect a whole number of frames later.

A command that arrives while frame n is the newest takes effect in the frame that follows n + delay. Its age counts from
its arrival, so the time-to-live covers the delay, too. Without a delay nothing waits. Whether a command is newer than
the one before is judged when it arrives. Drives, permits and duties do not overtake their own kind, and no kind matters
to another: each waits in a line of its own.
"""

from collections import deque
from math import isfinite

from ccatp.sim.rules import Fans, MotionRules


class CommandDelay:
    """Takes commands and hands them to the rules and the fans when they are due.

    Args:
        rules: decides on drives and permits.
        fans: decides on duties.
        frames: length of the delay.
    """

    __slots__ = ("_drives", "_duties", "_fans", "_frames", "_newest_drive", "_newest_duty", "_newest_permit",
                 "_permits", "_rules")  # fmt: skip

    def __init__(self, rules: MotionRules, fans: Fans, frames: int) -> None:
        self._rules, self._fans, self._frames = rules, fans, frames
        # (frame in which it is due, what the rules or the fans take)
        self._drives: deque[tuple[int, int, float, float, float]] = deque()
        self._permits: deque[tuple[int, int, tuple[bool, bool, bool], float]] = deque()
        self._duties: deque[tuple[int, int, float, float]] = deque()
        self._newest_drive = self._newest_permit = self._newest_duty = -1

    def drive(self, frame: int, seq: int, right_rad_s: float, left_rad_s: float, now_s: float) -> bool:
        """Take a drive; false for an old or equal ``seq`` and for numbers not finite."""
        if not self._frames:
            return self._rules.drive(seq, right_rad_s, left_rad_s, now_s)
        if seq <= self._newest_drive or not (isfinite(right_rad_s) and isfinite(left_rad_s)):
            return False
        self._newest_drive = seq
        self._drives.append((frame + self._frames, seq, right_rad_s, left_rad_s, now_s))
        return True

    def permit(self, frame: int, seq: int, allowed: tuple[bool, bool, bool], now_s: float) -> bool:
        """Take a permit (forward, reverse, turn); false for an old or equal ``seq``."""
        if not self._frames:
            return self._rules.permit(seq, *allowed, now_s)
        if seq <= self._newest_permit:
            return False
        self._newest_permit = seq
        self._permits.append((frame + self._frames, seq, allowed, now_s))
        return True

    def fans(self, frame: int, seq: int, left: float, right: float) -> bool:
        """Take fan duties; false for an old or equal ``seq`` and for numbers not finite."""
        if not self._frames:
            return self._fans.command(seq, left, right)
        if seq <= self._newest_duty or not (isfinite(left) and isfinite(right)):
            return False
        self._newest_duty = seq
        self._duties.append((frame + self._frames, seq, left, right))
        return True

    def release(self, frame: int) -> None:
        """Hand on what is due when the step after ``frame`` begins."""
        drives, permits, duties = self._drives, self._permits, self._duties
        while drives and drives[0][0] <= frame:
            _, seq, right_rad_s, left_rad_s, now_s = drives.popleft()
            self._rules.drive(seq, right_rad_s, left_rad_s, now_s)
        while permits and permits[0][0] <= frame:
            _, seq, (forward, reverse, turn), now_s = permits.popleft()
            self._rules.permit(seq, forward, reverse, turn, now_s)
        while duties and duties[0][0] <= frame:
            _, seq, left, right = duties.popleft()
            self._fans.command(seq, left, right)

    def join_controller(self) -> None:
        """A new session: drives of the one before are forgotten; its fan duties, already accepted, come into force."""
        self.lose_controller()
        for _, seq, left, right in self._duties:
            self._fans.command(seq, left, right)
        self._duties.clear()
        self._newest_duty = -1

    def join_monitor(self) -> None:
        """A new session: permits of the one before are forgotten."""
        self.lose_monitor()

    def lose_controller(self) -> None:
        """Drives on their way are forgotten; fan duties are not."""
        self._drives.clear()
        self._newest_drive = -1

    def lose_monitor(self) -> None:
        """Permits on their way are forgotten."""
        self._permits.clear()
        self._newest_permit = -1
