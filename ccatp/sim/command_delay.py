"""Pure. The way of commands to the wheels: what arrives takes effect a whole number of frames later.

A command that arrives while frame n is the newest takes effect in the frame that follows n + delay. Its age counts from
its arrival, so the time-to-live covers the delay, too. Without a delay nothing waits. Whether a command is newer than
the one before is judged when it arrives.
"""

from collections import deque
from math import isfinite
from typing import Literal

from ccatp.sim.rules import Fans, MotionRules

Kind = Literal["drive", "permit", "fans"]
_Order = tuple[float, float] | tuple[bool, bool, bool]


class CommandDelay:
    """Takes commands and hands them to the rules and the fans when they are due.

    Args:
        rules: decides on drives and permits.
        fans: decides on duties.
        frames: length of the delay.
    """

    __slots__ = ("_fans", "_frames", "_newest", "_rules", "_waiting")

    def __init__(self, rules: MotionRules, fans: Fans, frames: int) -> None:
        self._rules, self._fans, self._frames = rules, fans, frames
        self._waiting: deque[tuple[int, Kind, int, _Order, float]] = deque()
        self._newest: dict[Kind, int] = {"drive": -1, "permit": -1, "fans": -1}

    def drive(self, frame: int, seq: int, right_rad_s: float, left_rad_s: float, now_s: float) -> bool:
        """Take a drive; false for an old or equal ``seq`` and for numbers not finite."""
        if not self._frames:
            return self._rules.drive(seq, right_rad_s, left_rad_s, now_s)
        is_finite = isfinite(right_rad_s) and isfinite(left_rad_s)
        return is_finite and self._wait(frame, "drive", seq, (right_rad_s, left_rad_s), now_s)

    def permit(self, frame: int, seq: int, allowed: tuple[bool, bool, bool], now_s: float) -> bool:
        """Take a permit (forward, reverse, turn); false for an old or equal ``seq``."""
        if not self._frames:
            return self._rules.permit(seq, *allowed, now_s)
        return self._wait(frame, "permit", seq, allowed, now_s)

    def fans(self, frame: int, seq: int, left: float, right: float) -> bool:
        """Take fan duties; false for an old or equal ``seq`` and for numbers not finite."""
        if not self._frames:
            return self._fans.command(seq, left, right)
        return isfinite(left) and isfinite(right) and self._wait(frame, "fans", seq, (left, right), 0.0)

    def release(self, frame: int) -> None:
        """Hand on what is due when the step after ``frame`` begins."""
        waiting = self._waiting
        while waiting and waiting[0][0] <= frame:
            self._hand_on(*waiting.popleft()[1:])

    def join_controller(self) -> None:
        """A new session: drives of the one before are forgotten; its fan duties, already accepted, come into force."""
        for _, kind, seq, order, now_s in self._waiting:
            if kind == "fans":
                self._hand_on(kind, seq, order, now_s)
        self._forget("drive", "fans")

    def join_monitor(self) -> None:
        """A new session: permits of the one before are forgotten."""
        self._forget("permit")

    def lose_controller(self) -> None:
        """Drives on their way are forgotten; fan duties are not."""
        self._forget("drive")

    def lose_monitor(self) -> None:
        """Permits on their way are forgotten."""
        self._forget("permit")

    def _wait(self, frame: int, kind: Kind, seq: int, order: _Order, now_s: float) -> bool:
        if seq <= self._newest[kind]:
            return False
        self._newest[kind] = seq
        self._waiting.append((frame + self._frames, kind, seq, order, now_s))
        return True

    def _hand_on(self, kind: Kind, seq: int, order: _Order, now_s: float) -> None:
        if len(order) == 3:
            self._rules.permit(seq, *order, now_s)
        elif kind == "drive":
            self._rules.drive(seq, *order, now_s)
        else:
            self._fans.command(seq, *order)

    def _forget(self, *kinds: Kind) -> None:
        self._waiting = deque(entry for entry in self._waiting if entry[1] not in kinds)
        for kind in kinds:
            self._newest[kind] = -1
