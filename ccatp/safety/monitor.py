"""All monitors of the danger loop but the edge rule, frame by frame, and what they find together."""

from collections.abc import Callable, Sequence
from math import hypot

from ccatp.conditions import CLOCK_JUMPED, FRAMES_LOST, LINES_GARBLED, MonitorFinding
from ccatp.config.models import DangerConfig, HealthConfig, RobotConfig
from ccatp.control.motion_checks import ImuGate, MotionSum, SlidingWindow, WheelMeans
from ccatp.core import EdgeSample, ImuSample, WheelSample
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.mirror.mirror import Mirror
from ccatp.safety.escalation import FindingLatch
from ccatp.safety.sensor_monitors import (
    BatteryMonitor,
    FanMonitor,
    FlickerMonitor,
    LatencyMonitor,
    OwnFaults,
    RateMonitor,
    SeamMonitor,
)
from ccatp.safety.wheel_monitors import LATE_S, GyroscopeBias, WheelMonitor, YawMonitor, imu_finding

_STANDS_RAD_S = 0.02  # a wheel's mean over a frame below which it stands: 0.6 mm/s
_LOOK_FRAMES = 2  # the monitors judge one frame in so many while nothing is wrong; sums are kept in every one
_SLOW_LOOK_FRAMES = 10  # what changes slowly is looked at this often


class HealthMonitor:
    """All monitors but the edge rule's.

    ``is_explained``: whether the map has an edge of a panel near a sensor, by its index.
    """

    def __init__(
        self,
        cfg: HealthConfig,
        danger: DangerConfig,
        robot: RobotConfig,
        mirror: Mirror,
        is_explained: Callable[[int], bool],
    ) -> None:
        self._cfg, self._radius_m, self._base = cfg, robot.wheel_radius_m, mirror.base_pose
        self._means = WheelMeans(robot)
        self._gate = ImuGate(cfg)
        self._bias = GyroscopeBias()
        self._shortly, self._stalling = SlidingWindow(cfg.runaway_time_s), SlidingWindow(cfg.stall_time_s)
        self._turning = SlidingWindow(cfg.yaw_time_s)
        self._wheels, self._yaw = WheelMonitor(cfg, robot), YawMonitor(cfg, robot)
        self._rates, self._latency = RateMonitor(cfg), LatencyMonitor(cfg)
        self._fans, self._battery = FanMonitor(cfg, robot.fan_duty, mirror.overhang), BatteryMonitor(cfg)
        self._own = OwnFaults(cfg)
        self.seams = SeamMonitor(cfg, mirror, robot, danger.map_sigmas)
        self.flicker = FlickerMonitor(cfg, is_explained)
        self._clock, self._gap = FindingLatch(cfg.imu_quarantine_s), FindingLatch(cfg.imu_quarantine_s)
        self._garbled = FindingLatch(cfg.retry_after_s)
        self._alarms = (
            *(self._wheels.alarm, self._yaw.alarm, self._fans.alarm, self._latency.alarm),
            *(self._clock, self._gap, self._garbled, self.flicker.chatter, self.flicker.flash),
        )
        self.reset()

    def reset(self) -> None:
        """Another boot of the robot."""
        self._t_s: float | None = None
        self._sums = MotionSum(0.0, 0.0, 0.0, 0.0)
        for part in (
            *(self._gate, self._shortly, self._stalling, self._turning, self._wheels, self._yaw, self._rates),
            *(self._latency, self._fans, self._battery, self._own, self.seams, self.flicker),
            *(self._clock, self._gap, self._garbled),
        ):
            part.reset()
        self._estimate_seq = self._commands_seq = -1
        self._opened = (0, 0, 0, 0)
        self._home_m = 0.0
        self._frames = 0
        self._counts = [0, 0, 0]
        self._is_free, self._is_held, self._is_late = True, True, False
        self._speed_m_s = 0.0
        self.findings: list[MonitorFinding] = []

    # -- frames ---------------------------------------------------------------------------------------------------

    def jumped(self, t_s: float, by_s: float) -> None:
        """The robot's clock has jumped before the frame at ``t_s``."""
        finding = CLOCK_JUMPED.found("clock", by_s, self._cfg.clock_jump_s)
        self._clock.see(t_s, finding)
        self._gate.reset()
        self.findings = [finding]

    def garbled(self) -> MonitorFinding:
        """Too many lines that are no frames came since the last frame; what is found stays until frames come again."""
        lines = float(self._cfg.garbled_lines)
        finding = LINES_GARBLED.found("lines", lines, lines)
        self._garbled.see(self._t_s or 0.0, finding)
        self.findings = [finding]
        return finding

    def step(
        self,
        t_s: float,
        frame: Sensors,
        wheels: Sequence[WheelSample],
        edges: Sequence[EdgeSample],
        *,
        is_permitted: bool,
        is_any_off: bool,
    ) -> None:
        """Look at a frame; ``is_any_off``: an edge sensor is off, or has just been."""
        dt_s = 0.0 if self._t_s is None else t_s - self._t_s
        self._t_s = t_s
        is_gap = dt_s > self._cfg.gap_s
        if is_gap:
            self._gap.see(t_s, FRAMES_LOST.found("frames", dt_s, self._cfg.gap_s))
        imu = frame.imu
        self._means.take(wheels, dt_s)
        self._sums = self._added(imu, dt_s)
        self._counts[0] += len(imu)
        self._counts[1] += len(wheels)
        self._counts[2] += len(edges)
        self._is_free = self._is_free and is_permitted and not frame.cmd.held
        self._is_held = self._is_held and frame.cmd.held
        self._is_late = self._is_late or (frame.cmd.age > LATE_S and not frame.cmd.held)
        is_flickering = is_any_off or not self.flicker.is_quiet
        self._frames += 1
        if (
            self._frames % _LOOK_FRAMES == 0
            or is_flickering
            or is_gap
            or frame.faults
            or self.findings
            or self._gate.cause
        ):
            self._judge(t_s, frame, wheels)
            if is_flickering:
                self.flicker.step(t_s, edges, self._speed_m_s)
            self.findings = self._found(t_s)

    def _judge(self, t_s: float, frame: Sensors, wheels: Sequence[WheelSample]) -> None:
        now = self._sums
        shortly, stalling = self._shortly.push(now), self._stalling.push(now)
        turning = self._turning.push(now)
        self._rates.step(t_s, *self._counts)
        self._counts = [0, 0, 0]
        self._wheels.step(
            *(now, shortly, stalling, wheels),
            is_free=self._is_free,
            is_held=self._is_held,
            is_late=self._is_late,
            is_sparse=self._rates.are_encoders_sparse,
        )
        self._is_free, self._is_held, self._is_late = True, True, False
        self._speed_m_s = 0.0
        if shortly is not None:
            self._speed_m_s = max(abs(shortly.right_m), abs(shortly.left_m)) / shortly.t_s
        if turning is not None:
            self._yaw.step(t_s, turning)
        self._latency.step(t_s, frame.cmd.seq)
        faults = frame.faults
        if faults or self._own.alarms:
            self._own.step(t_s, faults)
        self._fans.step(t_s, frame.fans, faults)
        if self._frames % _SLOW_LOOK_FRAMES < _LOOK_FRAMES:
            self._battery.step(t_s, frame.soc, "battery_low" in faults, self._home_m)

    def _added(self, imu: Sequence[ImuSample], dt_s: float) -> MotionSum:
        """The sums with this frame's motion. What is not known of it is taken to be none, of all."""
        means, sums = self._means, self._sums
        right, left = means.right_rad_s, means.left_rad_s
        usable = self._gate.admit(imu, means.yaw_rad_s) if imu else imu
        t_s = self._t_s or 0.0
        if right is None or left is None:
            # Without one of them none is counted, so that they do not disagree about what is not known.
            return MotionSum(t_s, *sums[1:])
        rolled_m = self._radius_m * dt_s
        if usable:
            wz = usable[-1][2]
            if -_STANDS_RAD_S < right < _STANDS_RAD_S and -_STANDS_RAD_S < left < _STANDS_RAD_S:
                self._bias.stand(wz, dt_s)
                turned = 0.0
            else:
                turned = (wz - self._bias.rad_s) * dt_s
        else:
            turned = means.yaw_rad_s * dt_s
        return MotionSum(t_s, sums[1] + right * rolled_m, sums[2] + left * rolled_m, sums[3] + turned)

    def take_commands(self, t_s: float, estimate: EstimateMessage) -> None:
        """Take the set points from an estimate that may be too old for anything else.

        A repeated one changes nothing.
        """
        if estimate.seq == self._commands_seq:
            return
        self._commands_seq = estimate.seq
        if estimate.commanded is not None:
            self._wheels.commands.push(t_s, estimate.commanded)

    def learn(self, t_s: float, estimate: EstimateMessage, opened: Sequence[int], is_off: Sequence[object]) -> None:
        """Take a fresh estimate of main's; a repeated one changes nothing.

        ``opened``: how often each edge sensor went off.
        """
        if estimate.seq == self._estimate_seq:
            return
        self._estimate_seq = estimate.seq
        self.take_commands(t_s, estimate)
        self._wheels.learn(t_s)
        if estimate.drive_seq >= 0:
            self._latency.sent(estimate.drive_seq, t_s)
        for i, count in enumerate(opened):
            if is_off[i] or count != self._opened[i]:
                self.seams.went_off(i)
        self._opened = (opened[0], opened[1], opened[2], opened[3])
        x, y = estimate.x_m, estimate.y_m
        self.seams.step(t_s, (x, y, estimate.heading_rad), estimate.sigma_m)
        self._home_m = hypot(x - self._base.x_m, y - self._base.y_m)

    def _found(self, t_s: float) -> list[MonitorFinding]:
        found = []
        for alarm in self._alarms:
            if alarm.finding is not None and (finding := alarm.settle(t_s)) is not None:
                found.append(finding)
        for other in (self._rates.finding, self._battery.finding, self.seams.finding):
            if other is not None:
                found.append(other)
        if self._gate.cause:
            found.append(imu_finding(self._gate))
        if self._own.alarms:
            found += [alarm.finding for alarm in self._own.alarms.values() if alarm.finding is not None]
        return found
