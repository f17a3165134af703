"""Monitors of wheels and encoders against the set points and the gyroscope."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from ccatp.conditions import MonitorFinding
from ccatp.conditions import danger as conditions
from ccatp.config.models import HealthConfig, RobotConfig
from ccatp.core import WheelSample
from ccatp.rest import AT_REST_M_S
from ccatp.safety.escalation import Since
from ccatp.safety.monitor import Monitor
from ccatp.safety.motion_sums import MotionSum, SlidingWindow

# The set points are known in steps of five frames, and reach the wheels two link delays later.
_LATENCY_S = 0.1
LATE_S = 0.1
"""If a drive has been in force for longer, later drives have not arrived: the link stalls."""
# A larger difference between wheels and gyroscope within ``stall_time_s`` means that they show different motions.
_SAME_TURN_RAD = 0.05
# With fewer encoder samples than usual a speed is inaccurate: the limits are multiplied by this factor, or a longer
# period is judged.
_SPARSE_FACTOR = 2.5
# A held wheel that creeps for longer than this does not stop by itself.
_CREEP_FAULT_S = 1.0
_SIDES = ("right", "left")
# No wheel changes its rate by more within a frame; two counts in a sample of 1 ms are 10 rad/s.
_WILD_RAD_S = 12.0
_FEW_SAMPLES = 5


class FrameSpan(NamedTuple):
    """What is known of the frames between two judgements.

    ``is_free``: in all of them the robot executed its commands, and all motion was permitted; ``is_held``: in all of
    them it held its wheels; ``is_late``: in one of them it executed an old command; ``is_sparse``: there were fewer
    encoder samples than usual.
    """

    is_free: bool = True
    is_held: bool = True
    is_late: bool = False
    is_sparse: bool = False

    def with_frame(self, *, is_permitted: bool, is_held: bool, drive_age_s: float) -> "FrameSpan":
        """The span with one more frame. ``drive_age_s``: how long the drive has been in force."""
        return FrameSpan(
            self.is_free and is_permitted and not is_held,
            self.is_held and is_held,
            self.is_late or (drive_age_s > LATE_S and not is_held),
            self.is_sparse,
        )


class SetPointSpan(NamedTuple):
    """Lowest and highest set points over several drives, m/s at the wheels' rims."""

    t_s: float
    right_low: float
    right_high: float
    left_low: float
    left_high: float

    def of(self, side: int) -> tuple[float, float]:
        """Lowest and highest of one wheel, by its index in ``_SIDES``."""
        return self[1 + 2 * side], self[2 + 2 * side]

    @property
    def is_zero(self) -> bool:
        """Whether all set points were zero."""
        return self[1:] == (0.0, 0.0, 0.0, 0.0)


class WheelMonitor(Monitor):
    """Finds runaway and stalled wheels, dead and frozen encoders, creeping wheels, and turns that disagree.

    The rules compare with the lowest and highest set points of a period, so they need no model of the servo: a wheel
    stalls if it stands although all set points were high, and runs away if it is faster than every set point.
    """

    def __init__(self, cfg: HealthConfig, robot: RobotConfig) -> None:
        super().__init__()
        self._cfg = cfg
        self._radius_m = robot.wheel_radius_m
        self._base_m = robot.wheel_base_m
        self.alarm = self.latch(cfg.retry_after_s)
        self.yaw = self.latch(cfg.retry_after_s)
        self._brief = SlidingWindow(cfg.runaway_time_s)
        self._stalling = SlidingWindow(cfg.stall_time_s)
        self._turning = SlidingWindow(cfg.yaw_time_s)
        self.set_points: deque[SetPointSpan] = deque(maxlen=64)
        self.reset()

    def reset(self) -> None:
        """See ``Monitor``."""
        super().reset()
        for window in (self._brief, self._stalling, self._turning):
            window.reset()
        self.set_points.clear()
        self.speed_m_s = 0.0  # of the faster wheel, over ``runaway_time_s``
        self._recent: SetPointSpan | None = None
        self._stall: SetPointSpan | None = None
        self._held_s: float | None = None
        self._held_since_s: float | None = None
        self._late_s: float | None = None
        self._sparse_s: float | None = None
        self._stood: MotionSum | None = None
        self._creeping = Since(), Since()

    def take_commands(self, t_s: float, commanded: tuple[float, float, float, float]) -> None:
        """Take the span (rad/s) of the drives up to ``t_s``."""
        r = self._radius_m
        a, b, c, d = commanded
        self.set_points.append(SetPointSpan(t_s, r * a, r * b, r * c, r * d))

    def learn(self, t_s: float) -> None:
        """Update the recent set points at ``t_s``, when a new span was taken or was due."""
        self._recent = self._commanded_over(t_s, self._cfg.stop_time_s)
        self._stall = self._commanded_over(t_s, self._cfg.stall_time_s + _LATENCY_S)

    def _commanded_over(self, t_s: float, memory_s: float) -> SetPointSpan | None:
        """The span of all drives of the last ``memory_s``; ``None`` unless all are known."""
        spans, since_s = self.set_points, t_s - memory_s
        if not spans or spans[0].t_s > since_s or t_s - spans[-1].t_s > _LATENCY_S:
            return None
        recent = []
        for span in reversed(spans):
            recent.append(span)
            if span.t_s <= since_s:
                break
        _, right_low, right_high, left_low, left_high = zip(*recent)  # noqa: B905 - of one length
        return SetPointSpan(t_s, min(right_low), max(right_high), min(left_low), max(left_high))

    def step(self, now: MotionSum, samples: Sequence[WheelSample], frames: FrameSpan) -> None:
        """Judge the frames since the last call by the running sums at their end; ``samples``: of the last one."""
        t_s = now.t_s
        brief, stalling, turning = self._brief.push(now), self._stalling.push(now), self._turning.push(now)
        self.speed_m_s = 0.0 if brief is None else max(abs(brief.right_m), abs(brief.left_m)) / brief.t_s
        if not frames.is_free:
            self._held_s = t_s
        if not frames.is_held:
            self._held_since_s = None
        elif self._held_since_s is None:
            self._held_since_s = t_s
        if frames.is_late:
            self._late_s = t_s
        if frames.is_sparse:
            self._sparse_s = t_s
        recent = self._commanded(t_s)
        is_sparse = self._sparse_s is not None and t_s - self._sparse_s < self._cfg.stall_time_s
        if recent is not None:
            limit = self._cfg.runaway_m_s
            if brief is not None:
                self._find_runaway(t_s, brief, recent, samples, _SPARSE_FACTOR * limit if is_sparse else limit)
            if is_sparse and stalling is not None:
                self._find_runaway(t_s, stalling, recent, samples, limit)
            if stalling is not None:
                self._find_stall(t_s, stalling)
                self._find_creep(now, stalling, recent, samples)
        if turning is not None:
            self._compare_turns(t_s, turning, _SPARSE_FACTOR if is_sparse else 1.0)

    def _commanded(self, t_s: float) -> SetPointSpan | None:
        """Recent set points of the wheels; ``None`` where they are not known."""
        recent = self._recent
        if recent is not None and t_s - recent.t_s <= _LATENCY_S:
            return recent
        # The commands since then are not known. If the robot has held its wheels for long enough, none has effect.
        is_held = self._held_since_s is not None and t_s - self._held_since_s >= self._cfg.stop_time_s
        return SetPointSpan(t_s, 0.0, 0.0, 0.0, 0.0) if is_held else None

    def _find_runaway(
        self, t_s: float, moved: MotionSum, commanded: SetPointSpan, samples: Sequence[WheelSample], limit_m_s: float
    ) -> None:
        over_s, right_m, left_m, _ = moved
        _, right_low, right_high, left_low, left_high = commanded
        above = _excess(right_m / over_s, right_low, right_high), _excess(left_m / over_s, left_low, left_high)
        worst_m_s = max(above)
        if worst_m_s <= limit_m_s:
            return
        k = above.index(worst_m_s)
        side = _SIDES[k]
        if broken := _what_is_broken(samples, k):
            self.alarm.see(t_s, self._broken(side, worst_m_s, limit_m_s, broken))
        else:
            self.alarm.see(t_s, conditions.WHEEL_RUNS_AWAY.found(f"{side}_wheel", worst_m_s, limit_m_s, side=side))

    @staticmethod
    def _broken(side: str, speed_m_s: float, limit_m_s: float, what: str) -> MonitorFinding:
        return conditions.ENCODER_BROKEN.found(f"encoder_{side}", speed_m_s, limit_m_s, side=side, what=what)

    def _find_stall(self, t_s: float, moved: MotionSum) -> None:
        commanded, cfg = self._stall, self._cfg
        if commanded is None or (self._held_s is not None and t_s - self._held_s < cfg.stall_time_s + _LATENCY_S):
            return
        over_s, right_m, left_m, turned_rad = moved
        speeds_m_s, limit_m_s = (abs(right_m) / over_s, abs(left_m) / over_s), cfg.stall_speed_m_s
        still = [k for k in range(2) if speeds_m_s[k] < limit_m_s and self._is_commanded(*commanded.of(k))]
        if not still:
            return
        disagreement = abs((right_m - left_m) / self._base_m - turned_rad)
        speed_m_s, side = min(speeds_m_s[k] for k in still), _SIDES[still[0]]
        if len(still) == len(_SIDES):
            finding = conditions.WHEELS_STAND.found("encoders", speed_m_s, limit_m_s)
        elif disagreement > _SAME_TURN_RAD:
            finding = conditions.ENCODER_COUNTS_NOTHING.found(f"encoder_{side}", speed_m_s, limit_m_s, side=side)
        else:
            finding = conditions.WHEEL_BLOCKED.found(f"{side}_wheel", speed_m_s, limit_m_s, side=side)
        self.alarm.see(t_s, finding)

    def _is_commanded(self, low: float, high: float) -> bool:
        limit = self._cfg.stall_command_m_s
        return low >= limit or high <= -limit

    def _find_creep(
        self, now: MotionSum, moved: MotionSum, commanded: SetPointSpan, samples: Sequence[WheelSample]
    ) -> None:
        """Find motion at a set point of zero, except while a robot behind a stalled link executes its last command."""
        runs_down_s = self._cfg.stop_time_s + self._cfg.stall_time_s
        is_running_down = self._late_s is not None and now.t_s - self._late_s < runs_down_s
        if is_running_down or not commanded.is_zero:
            self._stood = None
            return
        if self._stood is None:
            self._stood = now
            self._creeping = Since(), Since()
            return
        cfg, stood, t_s = self._cfg, self._stood, now.t_s
        for k, side in enumerate(_SIDES):
            speed_m_s, crept_m = abs(moved.of(k)) / moved.t_s, abs(now.of(k) - stood.of(k))
            creeps = crept_m > cfg.creep_m and speed_m_s > AT_REST_M_S
            is_moving = creeps or speed_m_s > cfg.stop_speed_m_s
            broken = _what_is_broken(samples, k) if is_moving else ""
            lasts_s = self._creeping[k].lasts(t_s, creeps and not broken)
            if not is_moving:
                continue
            limit_m_s, wheel = cfg.stop_speed_m_s, f"{side}_wheel"
            if broken:
                self._stood = now  # a broken encoder's travel does not count
                finding = self._broken(side, speed_m_s, limit_m_s, broken)
            elif creeps:
                condition = conditions.WHEEL_CREEPS_ON if lasts_s >= _CREEP_FAULT_S else conditions.WHEEL_CREEPS
                finding = condition.found(wheel, crept_m, cfg.creep_m, side=side)
            else:
                finding = conditions.WHEEL_DOES_NOT_STOP.found(wheel, speed_m_s, limit_m_s, side=side)
            self.alarm.see(t_s, finding)

    def _compare_turns(self, t_s: float, moved: MotionSum, factor: float) -> None:
        """Compare the turns of gyroscope, while plausible, and wheels; ``factor`` multiplies the limit."""
        cfg, (_, right_m, left_m, by_gyroscope) = self._cfg, moved
        by_wheels = (right_m - left_m) / self._base_m
        difference_rad = by_gyroscope - by_wheels
        limit_rad = factor * (cfg.yaw_limit_rad + cfg.yaw_share * max(abs(by_wheels), abs(by_gyroscope)))
        if not -limit_rad <= difference_rad <= limit_rad:
            self.yaw.see(t_s, conditions.YAW_DISAGREES.found("imu_wz", difference_rad, limit_rad))


def _what_is_broken(samples: Sequence[WheelSample], side: int) -> str:
    """What is wrong with an encoder, or an empty text if its samples are plausible."""
    rates = [rate for sample in samples if (rate := sample[1 + side]) is not None]
    if len(rates) < _FEW_SAMPLES:
        return ""
    low, high = min(rates), max(rates)
    if high - low > _WILD_RAD_S:
        return "gives garbage"
    return "is frozen" if low == high != 0.0 else ""


def _excess(speed: float, low: float, high: float) -> float:
    above = speed - high if high > 0.0 else speed
    below = low - speed if low < 0.0 else -speed
    return max(above, below)
