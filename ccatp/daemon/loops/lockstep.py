"""Lockstep: simulated time waits for the answers of both loops, so an answer or a frame that is lost is repeated."""

from typing import Protocol

from ccatp.daemon.loops.robot_session import RobotSession

# In lockstep the robot sends the next frame as soon as it has its answers, or repeats the last one after a second.
REPEAT_S = 1.0
# A copy of a frame that arrives sooner is a duplicated line and needs no answer.
DUPLICATE_S = 0.5
# A missing frame is reported after the first time; after an invalid line, whose frame the robot repeats, after the
# second one.
OVERDUE_S, INVALID_S = 3.0, 0.5
LOCKSTEP_SILENCE_S = 30.0


class LockstepAnswers(Protocol):
    """The answers that a loop sends, as ``LoopWork``."""

    def answer_again(self) -> None:
        """Repeat the last answer of the session, if any, with a new number."""

    def is_frame_due(self) -> bool:
        """Whether the last frame was answered, so that the robot has to send the next one."""

    def report_overdue(self, text: str) -> None:
        """Report that a frame is missing, so that the robot stands."""


class LockstepWatch:
    """Repeats the answer of a loop, reports a missing frame, and drops the connection to a silent robot.

    All times are of the monotonic clock, s; ``frame_s``: arrival of the newest frame, or begin of the session.
    """

    def __init__(self, session: RobotSession, answers: LockstepAnswers) -> None:
        self._session = session
        self._answers = answers
        self._joined_s = 0.0  # begin of the session
        self._repeated_s = 0.0  # last repetition of a frame
        self._answered_again_s = 0.0
        self._invalid_s = 0.0  # last invalid line
        self._reported_s = 0.0  # the frame whose successor was reported as overdue
        self._counted_s = 0.0  # the frame until which ``_old_frames`` are counted
        self._old_frames = 0

    def begin_session(self, now_s: float) -> None:
        """A session begins."""
        self._joined_s = now_s

    def on_bad_line(self, now_s: float) -> None:
        """A line was not valid."""
        self._invalid_s = now_s

    def on_repeated(self, now_s: float, frame_s: float | None) -> None:
        """The robot repeats a frame when it has not received an answer of this or the other loop."""
        self._repeated_s = now_s
        self._answer_again_after(DUPLICATE_S, now_s, frame_s or 0.0)

    def check(self, now_s: float, frame_s: float) -> None:
        """Repeat the answer each second, report a missing frame, and drop the connection to a silent robot.

        The answer is also repeated while a newer one is withheld, to keep the session.
        """
        self._answer_again_after(REPEAT_S, now_s, frame_s)
        age_s = now_s - frame_s
        silent_s = now_s - max(frame_s, self._repeated_s)
        old = self._session.link.counts["repeated_frames"]
        if self._counted_s != frame_s:
            self._counted_s = frame_s
            self._old_frames = old
        is_invalid, is_repeated = self._invalid_s > frame_s, self._repeated_s > frame_s
        is_overdue = age_s > INVALID_S if is_invalid else age_s > OVERDUE_S and self._answers.is_frame_due()
        if is_overdue and self._reported_s != frame_s:
            self._reported_s = frame_s
            sends = (
                "a line that is not valid" if is_invalid
                else "its last frame again" if is_repeated
                else "frames with older numbers" if old > self._old_frames
                else "nothing"
            )  # fmt: skip
            text = f"the robot stands: no new frame for {age_s:.1f} s in lockstep; it sends {sends}"
            self._answers.report_overdue(text)
        # The monitor receives no frames before a controller has joined.
        if silent_s > LOCKSTEP_SILENCE_S and (self._session.role == "controller" or frame_s > self._joined_s):
            self._session.drop(f"no sensors frame for {silent_s:.0f} s in lockstep, not even the last one again")

    def _answer_again_after(self, quiet_s: float, now_s: float, frame_s: float) -> None:
        if now_s - max(frame_s, self._answered_again_s) >= quiet_s:
            self._answered_again_s = now_s
            self._answers.answer_again()
