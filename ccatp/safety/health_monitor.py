"""All health monitors of the danger loop: one step per frame, and their findings."""

from collections.abc import Callable, Sequence
from typing import TypeVar

from ccatp.conditions import MonitorFinding
from ccatp.config.models import DangerConfig, HealthConfig, RobotConfig
from ccatp.core import DeckPose, EdgeSample, WheelSample
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.mirror.mirror import Mirror
from ccatp.safety.edge_monitors import FlickerMonitor, SeamMonitor
from ccatp.safety.grip_monitor import GripMonitor
from ccatp.safety.imu_monitor import ImuMonitor
from ccatp.safety.link_monitors import FrameMonitor, LatencyMonitor
from ccatp.safety.monitor import Monitor
from ccatp.safety.motion_sums import MotionSum
from ccatp.safety.rate_monitor import RateMonitor
from ccatp.safety.robot_state_monitors import BATTERY_LOW, BatteryMonitor, FanMonitor, ReportMonitor
from ccatp.safety.speed_ratio import SpeedRatioMonitor
from ccatp.safety.turn_timing import TurnTimingMonitor
from ccatp.safety.wheel_monitor import LATE_S, FrameSpan, WheelMonitor
from ccatp.sensing.wheel_means import WheelMeans

_LOOK_FRAMES = 2  # while nothing is wrong, the monitors judge every second frame; the sums take all frames
_SLOW_LOOK_FRAMES = 10  # period of the monitors of slow quantities

_M = TypeVar("_M", bound=Monitor)


class HealthMonitor:
    """All monitors except the edge rule. ``is_explained``: whether the map has a panel's edge near the i-th sensor.

    ``monitors`` are reset together and asked together for their findings: a monitor is made by ``_register``.
    """

    def __init__(
        self,
        cfg: HealthConfig,
        danger: DangerConfig,
        robot: RobotConfig,
        mirror: Mirror,
        is_explained: Callable[[int], bool],
    ) -> None:
        self.cfg = cfg
        self._wheel_radius_m = robot.wheel_radius_m
        self._mirror = mirror
        self._means = WheelMeans(robot)
        self.monitors: list[Monitor] = []
        self._grip = self._register(GripMonitor(cfg, robot))
        self._wheels = self._register(WheelMonitor(cfg, robot))
        self._ratio = self._register(SpeedRatioMonitor(cfg, robot))
        self._fans = self._register(FanMonitor(cfg, robot.fan_duty, mirror.overhang))
        self._latency = self._register(LatencyMonitor(cfg))
        self._link = self._register(FrameMonitor(cfg))
        self._flicker = self._register(FlickerMonitor(cfg, is_explained))
        self._rates = self._register(RateMonitor(cfg))
        self._battery = self._register(BatteryMonitor(cfg))
        self._seams = self._register(SeamMonitor(cfg, mirror, robot, danger.map_sigmas))
        self._imu = self._register(ImuMonitor(cfg))
        self._timing = self._register(TurnTimingMonitor(cfg))
        self._reports = self._register(ReportMonitor(cfg))
        self.reset()

    def _register(self, monitor: _M) -> _M:
        self.monitors.append(monitor)
        return monitor

    def reset(self) -> None:
        """Begin again after a boot of the robot. Battery, gyroscope bias and missed seams are kept."""
        for monitor in self.monitors:
            monitor.reset()
        self._t_s: float | None = None
        self._sums = MotionSum(0.0, 0.0, 0.0, 0.0)
        self._estimate_seq = self._commands_seq = -1
        self._opened = (0, 0, 0, 0)
        self._home_m = 0.0
        self._frames = 0
        self._counts = [0, 0, 0]
        self._span = FrameSpan()
        self.findings: list[MonitorFinding] = []

    # -- frames ---------------------------------------------------------------------------------------------------

    def limit_wheels(self, max_wheel_rad_s: float) -> None:
        """Take the robot's own limit for the wheels' rates, to which it clamps set points."""
        self._ratio.largest_rad_s = max_wheel_rad_s

    def jumped(self, t_s: float, by_s: float) -> None:
        """Report that the robot's clock jumped before the frame at ``t_s``."""
        self._imu.reset()
        self._timing.restart()
        self.findings = [self._link.jumped(t_s, by_s)]

    def misdated(self, t_s: float, frame: Sensors) -> None:
        """Report a frame, at ``t_s``, with samples of impossible times."""
        self.findings = [self._link.misdated(t_s, frame)]

    def garbled(self, at_s: float) -> MonitorFinding | None:
        """Count a line that is not a frame, at ``at_s`` on any monotonic clock; the finding if there are too many."""
        finding = self._link.garbled(self._t_s or 0.0, at_s)
        if finding is not None:
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
        cmd, imu = frame.cmd, frame.imu
        age_s = frame.t - imu[-1][0] if imu else 0.0
        is_gap = self._link.step(t_s, dt_s)
        self._means.take(wheels, dt_s)
        if is_permitted and not cmd.held and cmd.age <= LATE_S:
            self._ratio.add(dt_s, self._means.right_rad_s, self._means.left_rad_s)
        else:
            self._ratio.restart()
        self._sums = self._added(t_s, dt_s, self._imu.step(dt_s, imu, self._means, age_s))
        usable = () if self._imu.is_left_out else imu
        self._timing.step(t_s, usable, wheels, self._means.mean_yaw_rad_s)
        self._counts[0] += len(imu)
        self._counts[1] += len(wheels)
        self._counts[2] += len(edges)
        self._span = self._span.with_frame(is_permitted=is_permitted, is_held=cmd.held, drive_age_s=cmd.age)
        is_flickering = is_any_off or not self._flicker.is_quiet
        self._frames += 1
        is_sliding = self._grip.step(t_s, dt_s, imu, self._means, frame.gravity, self._imu.bias_rad_s)
        if frame.sliding:
            is_sliding = self._grip.report(t_s, self.cfg.grip_slide_m_s)
        is_due = self._frames % _LOOK_FRAMES == 0 or is_flickering or is_gap or is_sliding
        if is_due or frame.faults or self.findings or self._imu.is_left_out:
            self._judge(t_s, frame, wheels)
            if is_flickering:
                self._flicker.step(t_s, edges, self._wheels.speed_m_s)
            self.findings = [finding for monitor in self.monitors for finding in monitor.findings(t_s)]

    def _judge(self, t_s: float, frame: Sensors, wheels: Sequence[WheelSample]) -> None:
        self._rates.step(t_s, *self._counts)
        self._counts = [0, 0, 0]
        self._wheels.step(self._sums, wheels, self._span._replace(is_sparse=self._rates.are_encoders_sparse))
        self._span = FrameSpan()
        self._latency.step(t_s, frame.cmd.seq)
        self._reports.step(t_s, frame.faults)
        self._fans.step(t_s, frame.fans, frame.faults)
        if self._frames % _SLOW_LOOK_FRAMES < _LOOK_FRAMES:
            self._battery.step(t_s, frame.soc, BATTERY_LOW in frame.faults, self._home_m)

    def _added(self, t_s: float, dt_s: float, turned_rad: float) -> MotionSum:
        """The sums with this frame's motion; all unchanged if a wheel's rate is unknown, to keep them consistent."""
        sums, right, left = self._sums, self._means.right_rad_s, self._means.left_rad_s
        if right is None or left is None:
            return MotionSum(t_s, sums.right_m, sums.left_m, sums.turned_rad)
        rolled_m = self._wheel_radius_m * dt_s
        right_m, left_m = sums.right_m + right * rolled_m, sums.left_m + left * rolled_m
        return MotionSum(t_s, right_m, left_m, sums.turned_rad + turned_rad)

    # -- main's estimate ------------------------------------------------------------------------------------------

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
        pose = DeckPose(estimate.x_m, estimate.y_m, estimate.heading_rad)
        self._seams.step(t_s, pose, estimate.sigma_m)
        self._home_m = self._mirror.home_way_m(pose.x_m, pose.y_m)
