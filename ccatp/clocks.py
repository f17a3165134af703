"""Time that rises steadily, from a robot's clock that may jump or be reset."""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

from ccatp.core import EdgeSample, GravitySample, ImuSample, WheelSample

_Sample = TypeVar("_Sample", ImuSample, WheelSample, EdgeSample, GravitySample)


class ClockJump(NamedTuple):
    """A jump of the robot's clock before frame ``seq``, by ``by_s`` against the expected time; < 0 backward."""

    seq: int
    by_s: float


class SteadyTime:
    """Gives each frame a time that never jumps. ``jump``: the newest jump, ``None`` before the first.

    From frame to frame the robot's clock has to advance by the period of the frames, times the frames lost in between.
    If it differs by more than ``limit_s``, or goes backward, it has jumped, and the steady time advances by the period.
    A pause of the frames with consecutive numbers looks like a jump, and is treated the same way.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._seq = -1
        self._t_s = 0.0
        self._period_s = 0.0
        self.offset_s = self._before_s = 0.0
        self.jump: ClockJump | None = None

    def at(self, seq: int, t_s: float) -> float:
        """The steady time of the newest frame ``seq`` at robot time ``t_s``, s."""
        if self._seq < 0:
            self._seq = seq
            self._t_s = t_s
            return t_s
        frames, step_s = seq - self._seq, t_s - self._t_s
        expected_s = frames * self._period_s if self._period_s else step_s
        if step_s <= 0.0 or step_s - expected_s > self._limit_s:
            self._before_s = self.offset_s
            self.offset_s += expected_s - step_s
            self.jump = ClockJump(seq, step_s - expected_s)
        elif frames == 1:
            self._period_s = step_s
        self._seq = seq
        self._t_s = t_s
        return t_s + self.offset_s

    def of(self, seq: int, t_s: float) -> float:
        """The steady time of an older frame ``seq`` at robot time ``t_s``, s; at most one jump lies in between."""
        is_before = self.jump is not None and seq < self.jump.seq
        return t_s + (self._before_s if is_before else self.offset_s)

    def of_samples(self, samples: Sequence[_Sample], t_s: float) -> list[_Sample]:
        """Samples of the newest frame at steady times; each uses the time base that is nearer to the frame."""
        now_s, before_s, limit_s = self.offset_s, self._before_s, self._limit_s
        found = []
        for sample in samples:
            own_s, other_s = sample.t_s + now_s, sample.t_s + before_s
            is_other = abs(own_s - t_s) > limit_s and abs(other_s - t_s) < abs(own_s - t_s)
            found.append(sample._replace(t_s=other_s if is_other else own_s))
        return found


class MissionClock:
    """Numbers and times of the frames of a mission.

    ``jump_s``: limit of ``SteadyTime``. ``seq``: the newest frame; ``t_s``: its time without jumps; ``before_s``: time
    of the mission before the first frame served here.
    """

    def __init__(self, jump_s: float) -> None:
        self._jump_s = jump_s
        self.before_s = 0.0
        self._steady = SteadyTime(jump_s)
        self._first_s: float | None = None
        self.seq = -1
        self.t_s = 0.0

    @property
    def has_begun(self) -> bool:
        """Whether a frame was served since the robot's last boot."""
        return self._first_s is not None

    @property
    def elapsed_s(self) -> float:
        """Robot time of the mission, s."""
        return self.before_s + (0.0 if self._first_s is None else self.t_s - self._first_s)

    @property
    def offset_s(self) -> float:
        """``t_s`` minus the robot's time."""
        return self._steady.offset_s

    def take(self, seq: int, t_s: float, period_s: float) -> tuple[float, float]:
        """Take a served frame; returns its time, and the time since the last one (``period_s`` for the first), s."""
        # Durations use a time that does not jump; everything else uses the robot's own time.
        before_s, steady_s = self.t_s, self.t_s
        if seq > self.seq:
            self.seq = seq
            steady_s = self._steady.at(seq, t_s)
        self.t_s = steady_s
        if self._first_s is None:
            self._first_s = steady_s
            return steady_s, period_s
        return steady_s, steady_s - before_s

    def reset(self) -> None:
        """Begin again, because the robot's frame numbers and clock have restarted."""
        self.before_s = self.elapsed_s
        self._first_s = None
        self.seq = -1
        self._steady = SteadyTime(self._jump_s)
