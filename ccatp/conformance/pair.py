"""Edge. A controller and a monitor that answer every frame, as long as they are told to."""

import time
from collections.abc import Callable

from ccatp.conformance.link import Link
from ccatp.conformance.reading import Frame, Message, parse_frame, read_message
from ccatp.conformance.stage import POLL_S, Stage
from ccatp.conformance.verdict import Broken, require
from ccatp.wire.robot import Fans, encode, format_drive, format_permit

Rates = tuple[float, float]
Allowed = tuple[bool, bool, bool]
STILL: Rates = (0.0, 0.0)
ALL: Allowed = (True, True, True)
NOTHING: Allowed = (False, False, False)
PATIENCE_S = 2.0  # robot's time in which a command must have come into force


class Pair:
    """Two sessions, played together.

    Args:
        stage: where they are.

    Attributes:
        controller, monitor: the sessions.
        rates: (right, left) set points of the drive that answers each frame, rad/s; ``None`` sends none.
        allowed: (forward, reverse, turn) of the permit that answers each frame; ``None`` sends none.
        frames: all so far.
        messages: the same as they came, of the controller and of the monitor.
        raw: their lines.
    """

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self._join()
        self.rates: Rates | None = STILL
        self.allowed: Allowed | None = ALL
        self.frames: list[Frame] = []
        self.messages: tuple[list[Message], list[Message]] = ([], [])
        self.raw: list[bytes] = []

    def _join(self) -> None:
        # The monitor first: from its join on the robot needs both keys, so it never waits for one alone.
        self.monitor: Link = self.stage.join("monitor")
        self.controller: Link = self.stage.join("controller")
        self._driven = self._permitted = -1

    def rejoin(self) -> None:
        """End both sessions, and begin new ones.

        Raises:
            Broken: refused.
        """
        self._take()
        self.controller.close()
        self.monitor.close()
        self._join()

    @property
    def newest(self) -> Frame:
        """The newest frame."""
        return self.frames[-1]

    # -- commands -------------------------------------------------------------------------------------------------

    def drive(self, seq: int | None = None, rates: Rates = STILL, ack: int | None = None, before: bytes = b"") -> int:
        """Send a drive that answers the newest frame (or another), with other bytes in front; returns its number."""
        seq = self.stage.next_seq() if seq is None else seq
        self.controller.send(before + format_drive(seq, self.newest.seq if ack is None else ack, *rates))
        if ack is None:
            self.mark_driven()
        return seq

    def permit(self, seq: int | None = None, allowed: Allowed = ALL, ack: int | None = None) -> int:
        """Send a permit now that answers the newest frame (or another); returns its number."""
        seq = self.stage.next_seq() if seq is None else seq
        self.monitor.send(format_permit(seq, self.newest.seq if ack is None else ack, *allowed))
        if ack is None:
            self._permitted = self.newest.seq
        return seq

    def fans(self, duty: tuple[float, float], seq: int | None = None) -> int:
        """Send fan duties now; returns their number."""
        seq = self.stage.next_seq() if seq is None else seq
        self.controller.send(encode(Fans(seq=seq, duty=duty)))
        return seq

    # -- frames ---------------------------------------------------------------------------------------------------

    def find(self, is_wanted: Callable[[Frame], bool], robot_s: float = PATIENCE_S) -> Frame | None:
        """Answer frames until one is wanted; ``None`` after so much of the robot's time, or silence.

        The wanted frame itself is not answered yet.
        """
        start = len(self.frames)
        begin_s: float | None = None  # of the first frame that comes: before it may have been a long pause
        quiet_s = time.monotonic()
        while True:
            self._answer()
            self.stage.poll()
            if self._take():
                quiet_s = time.monotonic()
            for k in range(start, len(self.frames)):
                begin_s = self.frames[k].t_s if begin_s is None else begin_s
                if is_wanted(self.frames[k]):
                    return self.frames[k]
                if self.frames[k].t_s - begin_s > robot_s:
                    return None
            start = len(self.frames)
            if time.monotonic() - quiet_s > self.stage.timeout_s:
                return None

    def expect(self, is_wanted: Callable[[Frame], bool], otherwise: str) -> Frame:
        """Answer frames until one is wanted.

        Raises:
            Broken: none is; ``otherwise`` says so.
        """
        frame = self.find(is_wanted)
        if frame is None:
            self._check_sessions()
            raise Broken(otherwise)
        return frame

    def run(self, robot_s: float) -> list[Frame]:
        """Answer frames for so much of the robot's time; these frames.

        Raises:
            Broken: no more frames come.
        """
        start = len(self.frames)
        if not self.frames:
            self.expect(lambda _: True, "no frames after the join")
        self._take()
        end_s = self.newest.t_s + robot_s
        if self.find(lambda frame: frame.t_s >= end_s, 2.0 * robot_s) is None:
            self._check_sessions()
            raise Broken(f"no more frames after frame {self.newest.seq}")
        return self.frames[start:]

    def pause(self, wall_s: float) -> list[Frame]:
        """Answer nothing for so much time of this machine; the frames that come all the same."""
        start = len(self.frames)
        end_s = time.monotonic() + wall_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            self.stage.poll(min(left_s, POLL_S))
            self._take()
        return self.frames[start:]

    def echoed(self, *seqs: int, otherwise: str) -> Frame:
        """Send nothing newer, until the robot echoes one of these drives.

        Where time waits for answers newer drives have to follow; there each is in force for a frame.

        Raises:
            Broken: it echoes none; ``otherwise`` says so.
        """
        self.rates = STILL if self.stage.facts.is_lockstep else None
        return self.expect(lambda frame: frame.drive_seq in seqs, otherwise)

    def steady(self) -> Frame:
        """Both keys turned: standing still by command, not held.

        Raises:
            Broken: the robot holds all the same.
        """
        self.rates, self.allowed = STILL, ALL
        first = self.stage.next_seq()
        return self.expect(
            lambda frame: not frame.is_held and frame.drive_seq > first,
            "held in spite of a new drive and a new permit for each frame",
        )

    def settle(self) -> list[Frame]:
        """Answer frames until all that was sent before is in force; these frames."""
        start = len(self.frames)
        mark = self.stage.next_seq()
        self.expect(lambda frame: frame.drive_seq > mark, "drives no longer come into force")
        return self.frames[start:]

    def mark_driven(self) -> None:
        """The newest frame has been answered by a drive that was sent some other way."""
        self._driven = self.newest.seq

    def answer_again(self) -> None:
        """Take the newest frame for unanswered: what was sent may have been dropped."""
        self._driven = self._permitted = -1

    def _check_sessions(self) -> None:
        for name, link in (("controller", self.controller), ("monitor", self.monitor)):
            require(not (link.is_open and link.is_ended), f"the {name}'s session was closed")

    def _answer(self) -> None:
        if not self.frames:
            return
        newest = self.newest.seq
        if self.rates is not None and self._driven < newest:
            self._driven = newest
            self.drive(rates=self.rates)
        if self.allowed is not None and self._permitted < newest:
            self._permitted = newest
            self.permit(allowed=self.allowed)

    def _take(self) -> bool:
        """Read what came; whether any of it is a new frame."""
        before = len(self.frames)
        for link, messages in zip((self.controller, self.monitor), self.messages, strict=True):
            while link.lines:
                line = link.lines.popleft()
                self.raw.append(line)
                message = read_message(line)
                if message is None or message.get("type") != "sensors":
                    continue
                messages.append(message)
                frame = parse_frame(message)
                if not self.frames or frame.seq > self.newest.seq:
                    self.frames.append(frame)
        return len(self.frames) > before
