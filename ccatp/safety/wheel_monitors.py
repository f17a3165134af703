"""Wheels and encoders against the commanded set points, and against the gyroscope."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from ccatp.conditions import (
    ENCODER_BROKEN,
    ENCODER_COUNTS_NOTHING,
    IMU_LEFT_OUT,
    WHEEL_BLOCKED,
    WHEEL_CREEPS,
    WHEEL_CREEPS_ON,
    WHEEL_DOES_NOT_STOP,
    WHEEL_RUNS_AWAY,
    WHEELS_STAND,
    YAW_DISAGREES,
    MonitorFinding,
)
from ccatp.config.models import HealthConfig, RobotConfig
from ccatp.control.motion_checks import ImuGate, MotionSum
from ccatp.core import WheelSample
from ccatp.safety.escalation import FindingLatch, Since

# A servo of 0.1 s and a link of 40 ms have forgotten a command after this long, to within 2 %.
_MEMORY_S = 0.4
# What is commanded is known in steps of five frames, and reaches the wheels two delays of the link later.
_LATENCY_S = 0.1
LATE_S = 0.1
"""A drive that has been in force for longer was followed by others that have not arrived: the link stalls."""
# Wheels and gyroscope that differ by more than this within a stall's time do not show the same motion.
_SAME_TURN_RAD = 0.05
# A few samples of an encoder that counts steps are hardly a speed: with fewer than usual a wheel has to be
# faster than it may be by so many times, or for longer.
_VAGUE = 2.5
# A wheel that goes on creeping for this long while it is held will not stop by itself.
_CREEP_FAULT_S = 1.0
_SIDES = ("right", "left")
# No wheel changes its rate by this much within a frame; two counts in a sample of 1 ms are 10 rad/s.
_WILD_RAD_S = 12.0
_FEW_SAMPLES = 5
_STILL_M_S = 0.0005  # slower than this nothing creeps; noise of rate encoders over a stall's time is a tenth of it


class Span(NamedTuple):
    """Lowest and highest set points over some drives, m/s at the wheels' rims."""

    t_s: float
    right_low: float
    right_high: float
    left_low: float
    left_high: float


class Commands:
    """Recent set points of the wheels."""

    def __init__(self, wheel_radius_m: float) -> None:
        self._radius_m = wheel_radius_m
        self.reset()

    def reset(self) -> None:
        """Forget."""
        self._spans: deque[Span] = deque(maxlen=64)

    def push(self, t_s: float, commanded: tuple[float, float, float, float]) -> None:
        """Take the span (rad/s) of the drives up to ``t_s``."""
        r = self._radius_m
        a, b, c, d = commanded
        self._spans.append(Span(t_s, r * a, r * b, r * c, r * d))

    def over(self, t_s: float, memory_s: float) -> Span | None:
        """The span of all drives of the last ``memory_s``; ``None`` if they are not all known."""
        spans, since_s = self._spans, t_s - memory_s
        if not spans or spans[0][0] > since_s or t_s - spans[-1][0] > _LATENCY_S:
            return None
        recent = []
        for span in reversed(spans):
            recent.append(span)
            if span[0] <= since_s:
                break
        _, right_low, right_high, left_low, left_high = zip(*recent)  # noqa: B905 - of one length
        return Span(t_s, min(right_low), max(right_high), min(left_low), max(left_high))


class WheelMonitor:
    """Runaway, stall, dead and frozen encoders, wheels that creep.

    The rules use the lowest and highest set points of a while, so they need no model of the servo: a wheel that was
    commanded to go fast all the while and stands, or that is faster than any set point.
    """

    def __init__(self, cfg: HealthConfig, robot: RobotConfig) -> None:
        self._cfg, self._base_m = cfg, robot.wheel_base_m
        self.commands = Commands(robot.wheel_radius_m)
        self.alarm = FindingLatch(cfg.retry_after_s)
        self.reset()

    def reset(self) -> None:
        """Forget."""
        self.alarm.reset()
        self.commands.reset()
        self._lately: Span | None = None
        self._stall: Span | None = None
        self._held_s: float | None = None
        self._held_since_s: float | None = None
        self._late_s: float | None = None
        self._sparse_s: float | None = None
        self._stood: MotionSum | None = None
        self._creeping = Since(), Since()

    def learn(self, t_s: float) -> None:
        """Look at the commands again: at ``t_s`` a new span has been pushed, or should have been."""
        self._lately = self.commands.over(t_s, _MEMORY_S)
        self._stall = self.commands.over(t_s, self._cfg.stall_time_s + _LATENCY_S)

    def step(
        self,
        now: MotionSum,
        shortly: MotionSum | None,
        stalling: MotionSum | None,
        samples: Sequence[WheelSample],
        *,
        is_free: bool,
        is_held: bool,
        is_late: bool,
        is_sparse: bool,
    ) -> None:
        """Judge a frame; ``shortly`` and ``stalling``.

        Change of the sums over ``runaway_time_s`` and over ``stall_time_s``.

        Since the last look, ``is_free``: the robot executed its commands, and was permitted to go anywhere;
        ``is_late``: it executed an old command; ``is_sparse``: the encoders gave fewer samples than usual.
        """
        t_s = now.t_s
        if not is_free:
            self._held_s = t_s
        if not is_held:
            self._held_since_s = None
        elif self._held_since_s is None:
            self._held_since_s = t_s
        if is_late:
            self._late_s = t_s
        if is_sparse:
            self._sparse_s = t_s
        lately = self._commanded(t_s)
        if lately is not None:
            limit = self._cfg.runaway_m_s
            is_vague = self._sparse_s is not None and t_s - self._sparse_s < self._cfg.stall_time_s
            if shortly is not None:
                self._find_runaway(t_s, shortly, lately, samples, _VAGUE * limit if is_vague else limit)
            if is_vague and stalling is not None:
                self._find_runaway(t_s, stalling, lately, samples, limit)
            if stalling is not None:
                self._find_stall(t_s, stalling)
                self._find_creep(now, stalling, lately, samples)

    def _commanded(self, t_s: float) -> Span | None:
        """Recent set points of the wheels; ``None`` where they are not known."""
        lately = self._lately
        if lately is not None and t_s - lately.t_s <= _LATENCY_S:
            return lately
        # Main may have commanded anything since. Where the robot holds its wheels, whatever it was has been forgotten.
        is_held = self._held_since_s is not None and t_s - self._held_since_s >= _MEMORY_S
        return Span(t_s, 0.0, 0.0, 0.0, 0.0) if is_held else None

    def _find_runaway(
        self, t_s: float, moved: MotionSum, commanded: Span, samples: Sequence[WheelSample], limit: float
    ) -> None:
        right, left = moved.right_m / moved.t_s, moved.left_m / moved.t_s
        above = (
            _excess(right, commanded.right_low, commanded.right_high),
            _excess(left, commanded.left_low, commanded.left_high),
        )
        worst = max(above)
        if worst <= limit:
            return
        k = 0 if above[0] >= above[1] else 1
        side = _SIDES[k]
        if broken := _what_is_broken(samples, k):
            self.alarm.see(t_s, ENCODER_BROKEN.found(f"encoder_{side}", worst, limit, side=side, what=broken))
        else:
            self.alarm.see(t_s, WHEEL_RUNS_AWAY.found(f"{side}_wheel", worst, limit, side=side))

    def _find_stall(self, t_s: float, moved: MotionSum) -> None:
        commanded, cfg = self._stall, self._cfg
        if commanded is None or (self._held_s is not None and t_s - self._held_s < cfg.stall_time_s + _LATENCY_S):
            return
        right, left = moved.right_m / moved.t_s, moved.left_m / moved.t_s
        stands = (
            self._is_commanded(commanded.right_low, commanded.right_high) and abs(right) < cfg.stall_speed_m_s,
            self._is_commanded(commanded.left_low, commanded.left_high) and abs(left) < cfg.stall_speed_m_s,
        )
        if not any(stands):
            return
        disagreement = abs((moved.right_m - moved.left_m) / self._base_m - moved.turned_rad)
        speed = min(abs(rate) for rate, is_still in ((right, stands[0]), (left, stands[1])) if is_still)
        side = "right" if stands[0] else "left"
        if all(stands):
            finding = WHEELS_STAND.found("encoders", speed, cfg.stall_speed_m_s)
        elif disagreement > _SAME_TURN_RAD:
            finding = ENCODER_COUNTS_NOTHING.found(f"encoder_{side}", speed, cfg.stall_speed_m_s, side=side)
        else:
            finding = WHEEL_BLOCKED.found(f"{side}_wheel", speed, cfg.stall_speed_m_s, side=side)
        self.alarm.see(t_s, finding)

    def _is_commanded(self, low: float, high: float) -> bool:
        limit = self._cfg.stall_command_m_s
        return low >= limit or high <= -limit

    def _find_creep(self, now: MotionSum, moved: MotionSum, commanded: Span, samples: Sequence[WheelSample]) -> None:
        """Motion against a set point of zero. While the link stalls the robot keeps its last command, then stops."""
        runs_down_s = _MEMORY_S + self._cfg.stall_time_s
        is_running_down = self._late_s is not None and now.t_s - self._late_s < runs_down_s
        if is_running_down or commanded[1:] != (0.0, 0.0, 0.0, 0.0):
            self._stood = None
            return
        if self._stood is None:
            self._stood = now
            self._creeping = Since(), Since()
            return
        cfg, stood, t_s = self._cfg, self._stood, now.t_s
        for k, side in enumerate(_SIDES):
            speed_m_s, crept_m = abs(moved[1 + k]) / moved.t_s, abs(now[1 + k] - stood[1 + k])
            creeps = crept_m > cfg.creep_m and speed_m_s > _STILL_M_S
            is_moving = creeps or speed_m_s > cfg.stop_speed_m_s
            broken = _what_is_broken(samples, k) if is_moving else ""
            lasts_s = self._creeping[k].lasts(t_s, creeps and not broken)
            if not is_moving:
                continue
            if broken:
                self._stood = now  # what it says it went, it did not
                limit_m_s = cfg.stop_speed_m_s
                finding = ENCODER_BROKEN.found(f"encoder_{side}", speed_m_s, limit_m_s, side=side, what=broken)
            elif creeps:
                condition = WHEEL_CREEPS_ON if lasts_s >= _CREEP_FAULT_S else WHEEL_CREEPS
                finding = condition.found(f"{side}_wheel", crept_m, cfg.creep_m, side=side)
            else:
                finding = WHEEL_DOES_NOT_STOP.found(f"{side}_wheel", speed_m_s, cfg.stop_speed_m_s, side=side)
            self.alarm.see(t_s, finding)


def _what_is_broken(samples: Sequence[WheelSample], side: int) -> str:
    """What shows that it is the encoder and not the wheel, or nothing."""
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


_BIAS_TIME_S = 0.5
_LARGEST_BIAS_RAD_S = 0.35


class GyroscopeBias:
    """What the gyroscope shows at rest, from samples whose size is bounded: garbage must not move it far."""

    def __init__(self) -> None:
        self.rad_s = 0.0

    def stand(self, wz_rad_s: float, dt_s: float) -> None:
        """Take a sample at rest."""
        bounded = min(max(wz_rad_s, -_LARGEST_BIAS_RAD_S), _LARGEST_BIAS_RAD_S)
        self.rad_s += dt_s / (_BIAS_TIME_S + dt_s) * (bounded - self.rad_s)


class YawMonitor:
    """Compares the turn of the gyroscope with that of the wheels while the robot moves."""

    def __init__(self, cfg: HealthConfig, robot: RobotConfig) -> None:
        self._cfg, self._base_m = cfg, robot.wheel_base_m
        self.alarm = FindingLatch(cfg.retry_after_s)

    def reset(self) -> None:
        """Forget."""
        self.alarm.reset()

    def step(self, t_s: float, moved: MotionSum) -> None:
        """Judge a frame; ``moved`` is the change of the sums over ``yaw_time_s``, while the unit was believed."""
        cfg = self._cfg
        by_wheels = (moved.right_m - moved.left_m) / self._base_m
        by_gyroscope = moved.turned_rad
        difference = by_gyroscope - by_wheels
        limit = cfg.yaw_limit_rad + cfg.yaw_share * max(abs(by_wheels), abs(by_gyroscope))
        if not -limit <= difference <= limit:
            self.alarm.see(t_s, YAW_DISAGREES.found("imu_wz", difference, limit))


def imu_finding(gate: ImuGate) -> MonitorFinding:
    """What the gate has against the inertial unit: it is left out, and the robot goes slowly by its wheels."""
    return IMU_LEFT_OUT.found("imu", gate.value, gate.limit, what=gate.cause)
