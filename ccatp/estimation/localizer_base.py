"""The common part of the localizers: order of frames, validation of samples, edge transitions, divergence."""

from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Sequence
from math import hypot, inf, isfinite, sqrt
from operator import lt
from typing import NamedTuple

import numpy as np

from ccatp.conditions.mission import FILTER_DIVERGED, FRAMES_BACKWARD, SENSOR_BACKWARD
from ccatp.config.models import Config
from ccatp.core import NO_CAUSE, Cause, EdgeSample, Fix, GravitySample, ImuSample, WheelSample
from ccatp.estimation.fixes import DeckFoot, check_fix, deck_foot
from ccatp.estimation.wheel_coast import CoastedMotion, WheelCoast, WheelInput
from ccatp.filters import FILTERS
from ccatp.filters.base import Filter, FilterDiverged
from ccatp.mirror.mirror import Mirror
from ccatp.sensing.imu_gate import ImuGate
from ccatp.sensing.sample_times import LATEST_S, possible_gravity, possible_samples
from ccatp.sensing.wheel_means import WheelMeans, largest_rate_rad_s

ImuReadings = Sequence[ImuSample]
Edges = Sequence[EdgeSample]
Gravity = GravitySample | None
WheelReadings = tuple[Sequence[float], Sequence[float]]
"""Times (s) and rates (rad/s) of one wheel."""
HEADING = 2
"""Index of the heading in the states of both localizers."""
MAX_FRAME_STEP_S = 0.1
"""A longer time between two frames is a jump of the robot's clock or a gap in the link."""
LONGEST_GAP_S = 0.4
"""After this time without a drive the robot stands: time-to-live of the last drive, and run-down of the wheels."""
BACKWARD_LIMIT = 5
"""Number of backward time stamps in a row that requests a hold."""
_LONGEST_INTERVAL_S = 0.05  # of two edge samples around a transition; later the place of the sensor in between is open
_READABLE = 1e9  # rad/s or m/s^2: far beyond every sensor's range; its squares and products stay finite


class SampleSource:
    """The time stamps of one sensor. Each is used once, in increasing order."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.newest_s = -inf
        self.backward_run = 0
        self.used: deque[Sequence[float]] = deque()


def use_samples(times_s: Sequence[float], oldest_s: float, *sources: SampleSource) -> None:
    """Record these time stamps, newer than all before and increasing, as used; drop those before ``oldest_s``."""
    newest_s = times_s[-1]
    for source in sources:
        source.newest_s = newest_s
        source.backward_run = 0
        used = source.used
        used.append(times_s)
        while used[0][-1] < oldest_s:
            used.popleft()


class SampleValidator:
    """Selects the usable IMU and encoder samples of a frame, and counts the others by reason in ``counts``.

    ``backward_source``: a sensor that sent ``BACKWARD_LIMIT`` backward time stamps in a row; cleared by its reader.
    """

    def __init__(self, history_s: float, largest_rate_rad_s: float, counts: dict[str, int]) -> None:
        self._history_s = history_s
        self._largest_rad_s = largest_rate_rad_s
        self._counts = counts
        self.backward_source = ""
        self.restart()

    def restart(self) -> None:
        """Drop all time stamps, because the robot's clock has jumped."""
        self._imu = SampleSource("imu")
        self._right = SampleSource("right encoder")
        self._left = SampleSource("left encoder")

    def wheels(self, frame_s: float, encoders: Sequence[WheelSample]) -> tuple[WheelReadings, WheelReadings]:
        """The usable readings of the right and of the left wheel."""
        if not encoders:
            return ((), ()), ((), ())
        times, right, left = zip(*encoders)  # noqa: B905 - of one length; checking that takes longer
        newest_right_s, newest_left_s = self._right.newest_s, self._left.newest_s
        first_s, oldest_s, largest = times[0], frame_s - self._history_s, self._largest_rad_s
        if (
            newest_right_s < first_s > newest_left_s
            and oldest_s <= first_s
            and times[-1] <= frame_s + LATEST_S
            and all(map(lt, times, times[1:]))
            and None not in right
            and None not in left
            # hypot is at least each absolute rate; the comparison is false for NaN.
            and hypot(*right) <= largest >= hypot(*left)
        ):
            use_samples(times, oldest_s, self._right, self._left)
            return (times, right), (times, left)
        return self._judged_wheels(frame_s, encoders)

    def _judged_wheels(self, frame_s: float, encoders: Sequence[WheelSample]) -> tuple[WheelReadings, WheelReadings]:
        """Judge each sample by itself."""
        right: tuple[list[float], list[float]] = [], []
        left: tuple[list[float], list[float]] = [], []
        largest = self._largest_rad_s
        for sample_s, right_rad_s, left_rad_s in encoders:
            if not (isfinite(sample_s) and hypot(right_rad_s or 0.0, left_rad_s or 0.0) < _READABLE):
                self._counts["nonfinite"] += 1
                continue
            for source, rate, (times, rates) in ((self._right, right_rad_s, right), (self._left, left_rad_s, left)):
                if rate is None:
                    continue
                if not -largest <= rate <= largest:
                    self._counts["too_fast"] += 1
                elif self._is_usable(source, sample_s, frame_s):
                    times.append(sample_s)
                    rates.append(rate)
        return right, left

    def imu(self, frame_s: float, samples: Sequence[ImuSample]) -> Sequence[ImuSample]:
        """The usable IMU samples."""
        if len(samples) == 1:
            (sample_s, ax, wz), source, oldest_s = samples[0], self._imu, frame_s - self._history_s
            is_in_time = source.newest_s < sample_s >= oldest_s and sample_s <= frame_s + LATEST_S
            if is_in_time and hypot(ax, wz) < _READABLE:
                use_samples((sample_s,), oldest_s, source)
                return samples
        kept: list[ImuSample] = []
        for sample in samples:
            sample_s, ax, wz = sample
            if not (isfinite(sample_s) and hypot(ax, wz) < _READABLE):
                self._counts["nonfinite"] += 1
            elif self._is_usable(self._imu, sample_s, frame_s):
                kept.append(sample)
        return kept

    def _is_usable(self, source: SampleSource, sample_s: float, frame_s: float) -> bool:
        oldest_s = frame_s - self._history_s
        if sample_s > frame_s + LATEST_S:
            reason = "ahead"
        elif sample_s < oldest_s:
            reason = "late"
        elif sample_s > source.newest_s:
            use_samples((sample_s,), oldest_s, source)
            return True
        elif any(sample_s in times_s for times_s in source.used):
            reason = "duplicate"
        else:
            reason = "backward"
            source.backward_run += 1
        self._counts[reason] += 1
        if source.backward_run >= BACKWARD_LIMIT:
            self.backward_source = source.name
        return False


class SensorTransition(NamedTuple):
    """A change of an edge sensor's value between two samples; ``t_s``: their middle; ``corner``: as ``core.Corner``."""

    t_s: float
    interval_s: float
    corner: int
    is_on: bool


class EdgeScanner:
    """Finds the transitions in the stream of edge samples. Samples not newer than the last one are skipped.

    A transition in a gap of the samples is none: where the sensor was at that moment is not known.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Drop the last sample, because the robot's clock has jumped."""
        self._t_s = -inf
        self._values: tuple[int, ...] = ()

    def scan(self, edges: Sequence[EdgeSample]) -> list[SensorTransition]:
        """Transitions of a frame, oldest first; normally none."""
        found: list[SensorTransition] = []
        last, values = self._t_s, self._values
        for sample in edges:
            t = sample[0]
            if not last < t < inf:
                continue
            if sample[1:] != values:
                for corner, (old, new) in enumerate(zip(values, sample[1:], strict=bool(values))):
                    if old != new and t - last <= _LONGEST_INTERVAL_S:
                        found.append(SensorTransition(0.5 * (last + t), t - last, corner, bool(new)))
                values = sample[1:]
            last = t
        self._t_s = last
        self._values = values
        return found


FilterWrap = Callable[[Filter], Filter]
"""Returns a filter that wraps the given one, to record or replace it."""


def unwrapped(filter_: Filter) -> Filter:
    """The filter itself."""
    return filter_


_IMPOSSIBLE = 2.0  # multiple of the wheels' largest speed beyond which an estimate has diverged


class LocalizerBase(ABC):
    """Admits frames in order of time, and requests a hold if time stamps or the filter are wrong.

    ``wrap`` wraps the filter of ``run.filter``. ``t_s``: robot time of the pose, that of the last frame used; -inf
    before the first. ``hold_cause``: why the mission should hold, until ``clear_hold``. ``is_frozen``: the filter has
    diverged, and the pose is constant until the next fix. ``notices``: for the operator, cleared by their reader.
    Refused are samples of impossible times, inertial and encoder samples older than ``localizer.history_s``, inertial
    samples that contradict the wheels, and impossible wheel rates. ``gap_s``: time without encoder samples since the
    last fix that was used, s; then the odometry is predicted from the drives. ``coasted``: the motion that was
    predicted for the newest frame, ``None`` without a gap.
    """

    def __init__(self, cfg: Config, mirror: Mirror, states: int, wrap: FilterWrap) -> None:
        self.t_s = -inf
        self.hold_cause = NO_CAUSE
        self.is_frozen = False
        self.gap_s = 0.0
        self.coasted: CoastedMotion | None = None
        self._coast = WheelCoast(cfg.robot.wheel_lag_s)
        self.counts: dict[str, int] = Counter()
        self.notices: list[str] = []
        # Subclasses re-initialise the filter at once; only its size matters here.
        self._filter = wrap(FILTERS[cfg.run.filter](np.zeros(states), np.eye(states)))
        self._mirror = mirror
        self._puck_height_m = cfg.robot.puck_height_m
        self._v_limit_m_s = _IMPOSSIBLE * cfg.robot.wheel_radius_m * cfg.robot.max_wheel_rad_s
        self._omega_limit_rad_s = 2.0 * self._v_limit_m_s / cfg.robot.wheel_base_m
        self._stale_run = 0
        self._suspect_s: float | None = None
        self._intake = SampleValidator(cfg.localizer.history_s, largest_rate_rad_s(cfg.robot), self.counts)
        self._imu_gate = ImuGate(cfg.health)
        self._wheel_means = WheelMeans(cfg.robot)

    @property
    def heading_sigma_rad(self) -> float:
        """Standard deviation of the heading, at the last step of the filter."""
        return sqrt(max(float(self._filter.covariance[HEADING, HEADING]), 0.0))

    def clear_hold(self) -> None:
        """Clear the cause for a hold; a cause that persists is set again."""
        self.hold_cause = NO_CAUSE

    def step(
        self,
        t_s: float,
        imu: ImuReadings,
        encoders: Sequence[WheelSample],
        edges: Edges,
        gravity: Gravity = None,
        set_points: WheelInput = None,
    ) -> None:
        """Take one sensors frame at robot time ``t_s``: any number of samples of each kind, oldest first.

        ``set_points``: those of the wheels since the last frame, ``None``: unknown; in a replay ``coasted`` of this
        frame, if there was one. Unusable samples are dropped and
        counted. A frame that is not newer than the last one has no effect.
        """
        last_s = self.t_s
        dt_s = t_s - last_s
        is_next = 0.0 < dt_s <= MAX_FRAME_STEP_S
        if not (is_next or self._is_new_time_base(t_s)):
            return
        self.t_s = t_s
        self._stale_run = 0
        self._suspect_s = None
        intake, means = self._intake, self._wheel_means
        if not is_next:
            dt_s = 0.0
            self._imu_gate.reset()
            if last_s > -inf:
                self.counts["resyncs"] += 1
                intake.restart()
            self._resync(t_s, last_s)
        means.take(encoders, dt_s)
        timely, (right, left) = intake.imu(t_s, imu), intake.wheels(t_s, encoders)
        edges_in_time = possible_samples(t_s, edges)
        if edges_in_time is not edges:
            self.counts["edge_misdated"] += len(edges) - len(edges_in_time)
        if gravity is not None and possible_gravity(t_s, gravity) is None:
            self.counts["gravity_misdated"] += 1
            gravity = None
        if imu and not self._imu_gate.admit(imu, means.yaw_rad_s, t_s - imu[-1][0] - dt_s):
            self.counts["imu_doubted"] += len(imu)
            timely = ()
        if intake.backward_source:
            self._request_hold(SENSOR_BACKWARD.cause(sensor=intake.backward_source))
            intake.backward_source = ""
        self.coasted = None
        try:
            self._use(dt_s, timely, right, left, edges_in_time, gravity, set_points)
        except FilterDiverged as error:
            self._freeze(error)

    def _is_new_time_base(self, t_s: float) -> bool:
        """Whether a frame that does not continue the last one begins a new time base; otherwise it is counted.

        A single frame with another time has no effect. A second frame that continues it shows that the clock jumped.
        """
        if not isfinite(t_s) or -MAX_FRAME_STEP_S <= t_s - self.t_s <= 0.0:
            self._stale_run += 1
            self.counts["stale_frames"] += 1
        else:
            suspect_s, self._suspect_s = self._suspect_s, t_s
            if self.t_s == -inf or (suspect_s is not None and 0.0 < t_s - suspect_s <= MAX_FRAME_STEP_S):
                return True
            self.counts["suspect_frames"] += 1
        if self._stale_run >= BACKWARD_LIMIT:
            self._request_hold(FRAMES_BACKWARD.cause())
        return False

    def _check_speeds(self, v_m_s: float, omega_rad_s: float) -> None:
        if abs(v_m_s) > self._v_limit_m_s or abs(omega_rad_s) > self._omega_limit_rad_s:
            raise FilterDiverged(f"{v_m_s:.3g} m/s and {omega_rad_s:.3g} rad/s are more than the wheels can do")

    def _foot_of(self, fix: Fix, oldest_s: float) -> DeckFoot:
        """Foot of a fix; ``FixRefused``: not finite, older than ``oldest_s``, in the future, or far from the mirror."""
        check_fix(fix, oldest_s, self.t_s + MAX_FRAME_STEP_S)
        return deck_foot(self._mirror, fix, self._puck_height_m)

    def _freeze(self, error: FilterDiverged) -> None:
        self.is_frozen = True
        self.counts["diverged"] += 1
        self._request_hold(FILTER_DIVERGED.cause(why=error))

    def _request_hold(self, cause: Cause) -> None:
        self.hold_cause = self.hold_cause or cause

    @abstractmethod
    def _resync(self, t_s: float, last_s: float) -> None:
        """Begin a time base at ``t_s``, after ``last_s`` of the old one (-inf: none). The pose does not change."""

    @abstractmethod
    def _use(
        self,
        dt_s: float,
        imu: ImuReadings,
        right: WheelReadings,
        left: WheelReadings,
        edges: Edges,
        gravity: Gravity,
        set_points: WheelInput,
    ) -> None:
        """Advance the filter, unless frozen, by ``dt_s`` (0 in a new time base); may raise ``FilterDiverged``."""
