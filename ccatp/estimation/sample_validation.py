"""Which frames and samples are used: time stamps backward, repeated, late, jumping or not finite; robot time only."""

from collections import deque
from collections.abc import Iterable, Sequence
from enum import Enum
from math import hypot, inf, isfinite

from ccatp.core import ImuSample, WheelSample
from ccatp.estimation.measurements import MeasurementBuilder, Stack, WheelReading

WheelColumns = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]
"""Times (s) and the rates (rad/s) of the right and of the left wheel."""
MAX_FRAME_STEP_S = 0.1
"""A frame further than this from the last one is a jump of the robot's clock or a gap in the link."""
LONGEST_GAP_S = 0.4
"""After so long without a drive the robot stands whatever the last one was: its time-to-live and the run-down."""
BACKWARD_LIMIT = 5
"""This many backward time stamps in a row ask for a hold."""
_ROUNDING_S = 1e-6
_READABLE = 1e9  # rad/s or m/s^2: far beyond what any sensor shows; squares and products of it stay finite


class FrameKind(Enum):
    """What a frame's time makes of it."""

    NEXT = "next"
    STALE = "stale"  # not newer than the last one
    SUSPECT = "suspect"  # a jump, not yet confirmed by a second frame
    RESYNC = "resync"  # the first frame in a new time base


class FrameTimeCheck:
    """Orders frames by their time.

    A single frame from elsewhere (replayed, corrupted) changes nothing; the second one in a row that continues it shows
    that the robot's clock itself has jumped.
    """

    def __init__(self) -> None:
        self.t_s = -inf
        self.stale_run = 0
        self._suspect_s: float | None = None

    def admit(self, t_s: float) -> FrameKind:
        """Judge a frame of time ``t_s``; ``self.t_s`` is the newest admitted time afterwards."""
        step = t_s - self.t_s
        if 0.0 < step <= MAX_FRAME_STEP_S:
            self.stale_run = 0
            return self._admitted(t_s, FrameKind.NEXT)
        if not isfinite(t_s) or -MAX_FRAME_STEP_S <= step <= 0.0:
            self.stale_run += 1
            return FrameKind.STALE
        suspect, self._suspect_s = self._suspect_s, t_s
        if self.t_s == -inf or (suspect is not None and 0.0 < t_s - suspect <= MAX_FRAME_STEP_S):
            self.stale_run = 0
            return self._admitted(t_s, FrameKind.RESYNC)
        return FrameKind.SUSPECT

    def _admitted(self, t_s: float, kind: FrameKind) -> FrameKind:
        self.t_s = t_s
        self._suspect_s = None
        return kind


class SampleSource:
    """The time stamps of one sensor: each is used once, in increasing order."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.newest_s = -inf
        self.backward_run = 0
        self._used: deque[Sequence[float]] = deque()

    def use(self, times_s: Sequence[float], oldest_s: float) -> None:
        """Note the times of a batch of used samples, oldest first, not empty; forget those before ``oldest_s``."""
        used = self._used
        self.newest_s = times_s[-1]
        self.backward_run = 0
        used.append(times_s)
        if used[0][-1] < oldest_s:
            used.popleft()
            if used[0][-1] < oldest_s:
                used.popleft()

    def refusal(self, t_s: float, frame_s: float, oldest_s: float) -> str | None:
        """Why a sample of time ``t_s`` is refused (a key of the counts), or None."""
        if t_s > frame_s + _ROUNDING_S:
            return "ahead"
        if t_s < oldest_s:
            return "late"
        if t_s > self.newest_s:
            return None
        if any(t_s in times for times in self._used):
            return "duplicate"
        self.backward_run += 1
        return "backward"


class SampleValidator:
    """Picks the usable IMU and encoder samples of a frame and counts the others by reason in ``counts``.

    The reasons: ahead, late (older than ``history_s``), duplicate, backward, nonfinite (or larger than any sensor can
    show), too_fast. ``backward_source`` names a sensor that has sent ``BACKWARD_LIMIT`` backward time stamps in a row,
    until it is emptied.
    """

    def __init__(self, history_s: float, counts: dict[str, int]) -> None:
        self._history_s = history_s
        self._counts = counts
        self.backward_source = ""
        self.largest_rate_rad_s = _READABLE
        self.restart()

    def stack(
        self, builder: MeasurementBuilder, t_s: float, imu: Sequence[ImuSample], encoders: Sequence[WheelSample]
    ) -> Stack:
        """z, H, R of the usable samples of a frame, for the state at ``t_s``."""
        usable = self.imu(t_s, imu) if imu else imu
        if self.are_clean(t_s, encoders):
            return builder.from_pairs(t_s, usable, encoders)
        return builder.from_wheels(t_s, usable, *self.wheels(t_s, encoders))

    def restart(self) -> None:
        """Forget every time stamp: the robot's clock has jumped."""
        self._imu, self._right, self._left = (
            SampleSource("imu"),
            SampleSource("right encoder"),
            SampleSource("left encoder"),
        )

    def are_clean(self, t_s: float, encoders: Sequence[WheelSample]) -> bool:
        """Take the encoder samples whole if nothing is wrong with them: both wheels, readable, in order, new."""
        return not encoders or self.columns(t_s, encoders) is not None

    def columns(self, t_s: float, encoders: Sequence[WheelSample]) -> WheelColumns | None:
        """The same, not empty, as columns; None if anything is wrong, and they have to be judged one by one."""
        times, right, left = zip(*encoders, strict=True)
        try:
            size = hypot(*right, *left)  # not a number as soon as one of them is none
        except TypeError:  # a wheel gave no sample
            return None
        oldest_s = t_s - self._history_s
        newest_s = max(self._right.newest_s, self._left.newest_s, oldest_s)
        if not (times[-1] <= t_s + _ROUNDING_S and size < _READABLE):
            return None
        largest = self.largest_rate_rad_s
        # The length of a vector is at least its largest number, so that hardly any frame has to be looked at closely.
        if size > largest and max(*right, *left, -min(right), -min(left)) > largest:
            return None
        before_s = newest_s
        for sample_s in times:
            if not before_s < sample_s:
                return None
            before_s = sample_s
        self._right.use(times, oldest_s)
        self._left.use(times, oldest_s)
        return times, right, left

    def wheels(self, t_s: float, encoders: Iterable[WheelSample]) -> tuple[list[WheelReading], list[WheelReading]]:
        """The usable readings of the right and of the left wheel, each sample judged by itself."""
        right: list[WheelReading] = []
        left: list[WheelReading] = []
        oldest_s = t_s - self._history_s
        for sample in encoders:
            sample_s, right_rad_s, left_rad_s = sample
            if not (isfinite(sample_s) and hypot(right_rad_s or 0.0, left_rad_s or 0.0) < _READABLE):
                self._counts["nonfinite"] += 1
                continue
            for source, rate, kept in ((self._right, right_rad_s, right), (self._left, left_rad_s, left)):
                if rate is not None and abs(rate) > self.largest_rate_rad_s:
                    self._counts["too_fast"] += 1
                elif rate is not None and self._is_usable(source, sample_s, t_s):
                    source.use((sample_s,), oldest_s)
                    kept.append((sample_s, rate))
        return right, left

    def imu(self, t_s: float, samples: Sequence[ImuSample]) -> Sequence[ImuSample]:
        """The usable IMU samples."""
        source, oldest_s = self._imu, t_s - self._history_s
        if len(samples) == 1:  # nearly always, and nearly always good
            t, ax, wz = samples[0]
            if source.newest_s < t <= t_s and oldest_s <= t and hypot(ax, wz) < _READABLE:
                source.use((t,), oldest_s)
                return samples
        kept: list[ImuSample] = []
        for sample in samples:
            t, ax, wz = sample
            if not (isfinite(t) and hypot(ax, wz) < _READABLE):
                self._counts["nonfinite"] += 1
            elif self._is_usable(source, t, t_s):
                source.use((t,), oldest_s)
                kept.append(sample)
        return kept

    def _is_usable(self, source: SampleSource, sample_s: float, frame_s: float) -> bool:
        refusal = source.refusal(sample_s, frame_s, frame_s - self._history_s)
        if refusal is None:
            return True
        self._counts[refusal] += 1
        if source.backward_run >= BACKWARD_LIMIT:
            self.backward_source = source.name
        return False
