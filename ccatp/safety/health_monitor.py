"""The monitors of the danger loop except the edge rule: one step per frame, and their findings."""

from collections import deque
from collections.abc import Callable, Sequence
from math import inf

from ccatp import conditions
from ccatp.conditions import SAMPLE_RATES, MonitorFinding
from ccatp.config.models import DangerConfig, HealthConfig, RobotConfig
from ccatp.core import EdgeSample, ImuSample, WheelSample
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.mirror.mirror import Mirror
from ccatp.safety.edge_monitors import FlickerMonitor, SeamMonitor
from ccatp.safety.escalation import FindingLatch
from ccatp.safety.grip_monitor import GripMonitor
from ccatp.safety.link_monitors import LatencyMonitor
from ccatp.safety.motion_sums import MotionSum
from ccatp.safety.rate_monitor import RateMonitor
from ccatp.safety.robot_state_monitors import FANS, REPORTED, BatteryMonitor, FanMonitor
from ccatp.safety.speed_ratio import SpeedRatioMonitor
from ccatp.safety.wheel_monitor import LATE_S, WheelMonitor
from ccatp.sensing.imu_gate import ImuGate
from ccatp.sensing.sample_times import LATEST_S, OLDEST_S, worst_offset_s
from ccatp.sensing.wheel_means import WheelMeans

_STANDS_RAD_S = 0.02  # a wheel's mean over a frame below which it stands: 0.6 mm/s
_LOOK_FRAMES = 2  # while nothing is wrong, the monitors judge every second frame; the sums take all frames
_SLOW_LOOK_FRAMES = 10  # period of the monitors of slow quantities
# The gyroscope's bias, averaged at rest. Readings are bounded, so that garbage cannot move it far.
_BIAS_TIME_S = 0.5
_LARGEST_BIAS_RAD_S = 0.35


def _kinds(frame: Sensors) -> tuple[tuple[str, Sequence[ImuSample | WheelSample | EdgeSample]], ...]:
    return ("imu", frame.imu), ("enc", frame.enc), ("edge", frame.edge)


class HealthMonitor:
    """All monitors except the edge rule. ``is_explained``: whether the map has a panel's edge near the i-th sensor."""

    def __init__(
        self,
        cfg: HealthConfig,
        danger: DangerConfig,
        robot: RobotConfig,
        mirror: Mirror,
        is_explained: Callable[[int], bool],
    ) -> None:
        self._cfg, self._robot, self._mirror, self._is_explained = cfg, robot, mirror, is_explained
        self._means = WheelMeans(robot)
        self._bias_rad_s = 0.0
        self._battery, self._seams = BatteryMonitor(cfg), SeamMonitor(cfg, mirror, robot, danger.map_sigmas)
        self._garbled_s = deque([-inf] * cfg.garbled_lines, maxlen=cfg.garbled_lines)
        self.reset()

    def reset(self) -> None:
        """Begin again after a boot of the robot. Battery, gyroscope bias and missed seams are kept."""
        cfg, robot = self._cfg, self._robot
        self._gate = ImuGate(cfg)
        self._wheels, self._rates, self._latency = WheelMonitor(cfg, robot), RateMonitor(cfg), LatencyMonitor(cfg)
        self._grip, self._ratio = GripMonitor(cfg, robot), SpeedRatioMonitor(cfg, robot)
        self._fans = FanMonitor(cfg, robot.fan_duty, self._mirror.overhang)
        self._flicker = FlickerMonitor(cfg, self._is_explained)
        self._clock, self._gap = FindingLatch(cfg.imu_quarantine_s), FindingLatch(cfg.imu_quarantine_s)
        self._garbled, self._misdated = FindingLatch(cfg.retry_after_s), FindingLatch(cfg.retry_after_s)
        self._reported: dict[str, FindingLatch] = {}
        self._latches = (
            *(self._grip.alarm, self._wheels.alarm, self._wheels.yaw, self._ratio.alarm, self._fans.alarm),
            self._latency.alarm,
            *(self._clock, self._gap, self._garbled, self._misdated, self._flicker.chatter, self._flicker.flash),
        )
        self._battery.reset()
        self._seams.reset()
        self._t_s: float | None = None
        self._sums: MotionSum = (0.0, 0.0, 0.0, 0.0)
        self._estimate_seq = self._commands_seq = -1
        self._opened = (0, 0, 0, 0)
        self._home_m = 0.0
        self._frames = 0
        self._counts = [0, 0, 0]
        self._is_free, self._is_held, self._is_late = True, True, False
        self.findings: list[MonitorFinding] = []

    # -- frames ---------------------------------------------------------------------------------------------------

    def limit_wheels(self, max_wheel_rad_s: float) -> None:
        """Take the robot's own limit for the wheels' rates, to which it clamps set points."""
        self._ratio.largest_rad_s = max_wheel_rad_s

    def jumped(self, t_s: float, by_s: float) -> None:
        """Report that the robot's clock jumped before the frame at ``t_s``."""
        finding = conditions.CLOCK_JUMPED.found("clock", by_s, self._cfg.clock_jump_s)
        self._clock.see(t_s, finding)
        self._gate.reset()
        self.findings = [finding]

    def misdated(self, t_s: float, frame: Sensors) -> None:
        """Report a frame, at ``t_s``, with samples of impossible times; the one furthest from the frame is named."""
        offsets_s = {kind: worst_offset_s(frame.t, samples) for kind, samples in _kinds(frame)}
        kind = max(offsets_s, key=lambda kind: abs(offsets_s[kind]))
        offset_s = offsets_s[kind]
        limit_s, side = (LATEST_S, "later than") if offset_s > 0.0 else (OLDEST_S, "older than")
        sensor = SAMPLE_RATES[kind].sensor
        finding = conditions.SAMPLES_MISDATED.found(kind, abs(offset_s), limit_s, sensor=sensor, side=side)
        self._misdated.see(t_s, finding)
        self.findings = [finding]

    def garbled(self, at_s: float) -> MonitorFinding | None:
        """Count a line that is not a frame, at ``at_s`` on any monotonic clock; the finding if there are too many."""
        times_s, lines = self._garbled_s, float(self._cfg.garbled_lines)
        times_s.append(at_s)
        if at_s - times_s[0] > self._cfg.garbled_window_s:
            return None
        finding = conditions.LINES_GARBLED.found("lines", lines, lines)
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
        """Take a frame; ``is_any_off``: an edge sensor is off, or was off a moment ago."""
        dt_s = 0.0 if self._t_s is None else t_s - self._t_s
        self._t_s = t_s
        is_gap = dt_s > self._cfg.gap_s
        if is_gap:
            self._gap.see(t_s, conditions.FRAMES_LOST.found("frames", dt_s, self._cfg.gap_s))
        imu = frame.imu
        self._means.take(wheels, dt_s)
        if is_permitted and not frame.cmd.held and frame.cmd.age <= LATE_S:
            self._ratio.add(dt_s, self._means.right_rad_s, self._means.left_rad_s)
        else:
            self._ratio.reset()
        self._sums = self._added(imu, dt_s)
        self._counts[0] += len(imu)
        self._counts[1] += len(wheels)
        self._counts[2] += len(edges)
        self._is_free = self._is_free and is_permitted and not frame.cmd.held
        self._is_held = self._is_held and frame.cmd.held
        self._is_late = self._is_late or (frame.cmd.age > LATE_S and not frame.cmd.held)
        is_flickering = is_any_off or not self._flicker.is_quiet
        self._frames += 1
        is_sliding = self._grip.step(t_s, dt_s, imu, self._means, frame.gravity, self._bias_rad_s)
        if frame.sliding:
            is_sliding = self._grip.report(t_s, self._cfg.grip_slip_m_s)
        is_due = self._frames % _LOOK_FRAMES == 0 or is_flickering or is_gap or is_sliding
        if is_due or frame.faults or self.findings or self._gate.cause:
            self._judge(t_s, frame, wheels)
            if is_flickering:
                self._flicker.step(t_s, edges, self._wheels.speed_m_s)
            self.findings = self._found(t_s)

    def _judge(self, t_s: float, frame: Sensors, wheels: Sequence[WheelSample]) -> None:
        self._rates.step(t_s, *self._counts)
        self._counts = [0, 0, 0]
        self._wheels.step(
            *(self._sums, wheels),
            is_free=self._is_free,
            is_held=self._is_held,
            is_late=self._is_late,
            is_sparse=self._rates.are_encoders_sparse,
        )
        self._is_free, self._is_held, self._is_late = True, True, False
        self._latency.step(t_s, frame.cmd.seq)
        for name in frame.faults:
            if name not in FANS and name != "battery_low":
                latch = self._reported.setdefault(name, FindingLatch(self._cfg.retry_after_s))
                condition = REPORTED.get(name, conditions.UNKNOWN_REPORTED)
                latch.see(t_s, condition.found(name, 1.0, 0.0, side=name.removeprefix("encoder_")))
        self._fans.step(t_s, frame.fans, frame.faults)
        if self._frames % _SLOW_LOOK_FRAMES < _LOOK_FRAMES:
            self._battery.step(t_s, frame.soc, "battery_low" in frame.faults, self._home_m)

    def _added(self, imu: Sequence[ImuSample], dt_s: float) -> MotionSum:
        """The sums with this frame's motion; all unchanged if a wheel's rate is unknown, to keep them consistent.

        Without a usable inertial unit the turn is that of the wheels.
        """
        means, (_, right_m, left_m, turned_rad) = self._means, self._sums
        right, left = means.right_rad_s, means.left_rad_s
        usable = self._gate.admit(imu, means.yaw_rad_s) if imu else imu
        t_s = self._t_s or 0.0
        if right is None or left is None:
            return t_s, right_m, left_m, turned_rad
        rolled_m = self._robot.wheel_radius_m * dt_s
        if usable:
            wz = usable[-1][2]
            if -_STANDS_RAD_S < right < _STANDS_RAD_S and -_STANDS_RAD_S < left < _STANDS_RAD_S:
                bounded = min(max(wz, -_LARGEST_BIAS_RAD_S), _LARGEST_BIAS_RAD_S)
                self._bias_rad_s += dt_s / (_BIAS_TIME_S + dt_s) * (bounded - self._bias_rad_s)
                turned = 0.0
            else:
                turned = (wz - self._bias_rad_s) * dt_s
        else:
            turned = means.yaw_rad_s * dt_s
        return t_s, right_m + right * rolled_m, left_m + left * rolled_m, turned_rad + turned

    def take_commands(self, t_s: float, estimate: EstimateMessage) -> None:
        """Take the set points from an estimate of any age; a repeated one has no effect."""
        if estimate.seq == self._commands_seq:
            return
        self._commands_seq = estimate.seq
        if estimate.commanded is not None:
            self._wheels.take_commands(t_s, estimate.commanded)
            self._ratio.take(t_s, estimate.commanded)

    def learn(self, t_s: float, estimate: EstimateMessage, opened: Sequence[int], is_off: Sequence[object]) -> None:
        """Take a fresh estimate; a repeated one has no effect. ``opened``: how often each edge sensor went off."""
        if estimate.seq == self._estimate_seq:
            return
        self._estimate_seq = estimate.seq
        self.take_commands(t_s, estimate)
        self._wheels.learn(t_s)
        self._grip.take_margin(estimate.grip)
        if estimate.drive_seq >= 0:
            self._latency.sent(estimate.drive_seq, t_s)
        for i, count in enumerate(opened):
            if is_off[i] or count != self._opened[i]:
                self._seams.went_off(i)
        self._opened = (opened[0], opened[1], opened[2], opened[3])
        x, y = estimate.x_m, estimate.y_m
        self._seams.step(t_s, (x, y, estimate.heading_rad), estimate.sigma_m)
        self._home_m = self._mirror.home_way_m(x, y)

    def _found(self, t_s: float) -> list[MonitorFinding]:
        found = []
        for latch in self._latches:
            if latch.finding is not None and (finding := latch.settle(t_s)) is not None:
                found.append(finding)
        for other in (
            self._grip.finding,
            self._grip.noise,
            self._rates.finding,
            self._battery.finding,
            self._seams.finding,
        ):
            if other is not None:
                found.append(other)
        gate = self._gate
        if gate.cause:
            found.append(conditions.IMU_LEFT_OUT.found("imu", gate.value, gate.limit, what=gate.cause))
        for name, latch in list(self._reported.items()):
            if (finding := latch.settle(t_s)) is None:
                del self._reported[name]
            else:
                found.append(finding)
        return found
