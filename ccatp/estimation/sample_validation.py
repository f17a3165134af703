"""Which frames and samples are used: time stamps backward, repeated, late, jumping or not finite; robot time only."""

from collections import deque
from collections.abc import Iterable
from enum import Enum
from math import hypot, inf, isfinite

from ccatp.core import ImuSample, WheelSample

WheelReadings = tuple[list[float], list[float]]
"""Times (s) and rates (rad/s) of one wheel."""
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
        self.backward_run = 0
        self._newest_s = -inf
        self._used: deque[float] = deque()

    def refusal(self, t_s: float, frame_s: float, oldest_s: float) -> str | None:
        """Why a sample of time ``t_s`` is refused (a key of the counts); None: it is used, and noted."""
        if t_s > frame_s + _ROUNDING_S:
            return "ahead"
        if t_s < oldest_s:
            return "late"
        used = self._used
        if t_s <= self._newest_s:
            if t_s in used:
                return "duplicate"
            self.backward_run += 1
            return "backward"
        self._newest_s, self.backward_run = t_s, 0
        used.append(t_s)
        while used[0] < oldest_s:
            used.popleft()
        return None


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

    def restart(self) -> None:
        """Forget every time stamp: the robot's clock has jumped."""
        self._imu = SampleSource("imu")
        self._right, self._left = SampleSource("right encoder"), SampleSource("left encoder")

    def wheels(self, t_s: float, encoders: Iterable[WheelSample]) -> tuple[WheelReadings, WheelReadings]:
        """The usable readings of the right and of the left wheel, each sample judged by itself."""
        right: WheelReadings = [], []
        left: WheelReadings = [], []
        largest = self.largest_rate_rad_s
        for sample_s, right_rad_s, left_rad_s in encoders:
            if not (isfinite(sample_s) and hypot(right_rad_s or 0.0, left_rad_s or 0.0) < _READABLE):
                self._counts["nonfinite"] += 1
                continue
            for source, rate, (times, rates) in ((self._right, right_rad_s, right), (self._left, left_rad_s, left)):
                if rate is None:
                    continue
                if not -largest <= rate <= largest:
                    self._counts["too_fast"] += 1
                elif self._is_usable(source, sample_s, t_s):
                    times.append(sample_s)
                    rates.append(rate)
        return right, left

    def imu(self, t_s: float, samples: Iterable[ImuSample]) -> list[ImuSample]:
        """The usable IMU samples."""
        kept: list[ImuSample] = []
        for sample in samples:
            sample_s, ax, wz = sample
            if not (isfinite(sample_s) and hypot(ax, wz) < _READABLE):
                self._counts["nonfinite"] += 1
            elif self._is_usable(self._imu, sample_s, t_s):
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
