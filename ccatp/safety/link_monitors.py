"""Monitors of the link to the robot: lost, damaged and misdated frames, jumps of the clock, latency of the drives."""

from collections import deque
from collections.abc import Sequence
from math import inf

from ccatp.conditions import MonitorFinding
from ccatp.conditions import danger as conditions
from ccatp.conditions.danger import SAMPLE_RATES
from ccatp.config.models import HealthConfig
from ccatp.core import EdgeSample, GravitySample, ImuSample, WheelSample
from ccatp.links.robot_messages import Sensors
from ccatp.safety.monitor import Monitor
from ccatp.sensing.sample_times import LATEST_S, OLDEST_S, worst_offset_s


def _kinds(frame: Sensors) -> tuple[tuple[str, Sequence[ImuSample | WheelSample | EdgeSample | GravitySample]], ...]:
    gravity = () if frame.gravity is None else (frame.gravity,)
    return ("imu", frame.imu), ("enc", frame.enc), ("edge", frame.edge), ("gravity", gravity)


class FrameMonitor(Monitor):
    """Lost frames, lines that are no frames, samples of impossible times, jumps of the robot's clock."""

    def __init__(self, cfg: HealthConfig) -> None:
        super().__init__()
        self._cfg = cfg
        self._clock = self.latch(cfg.imu_quarantine_s)
        self._gap = self.latch(cfg.imu_quarantine_s)
        self._garbled = self.latch(cfg.retry_after_s)
        self._misdated = self.latch(cfg.retry_after_s)
        # Not by the robot's clock: a boot does not restart it.
        self._garbled_s = deque([-inf] * cfg.garbled_lines, maxlen=cfg.garbled_lines)
        self.reset()

    def step(self, t_s: float, dt_s: float) -> bool:
        """Take a frame, ``dt_s`` after the last one; whether frames between them are lost."""
        is_gap = dt_s > self._cfg.gap_s
        if is_gap:
            self._gap.see(t_s, conditions.FRAMES_LOST.found("frames", dt_s, self._cfg.gap_s))
        return is_gap

    def jumped(self, t_s: float, by_s: float) -> MonitorFinding:
        """The robot's clock jumped before the frame at ``t_s``."""
        finding = conditions.CLOCK_JUMPED.found("clock", by_s, self._cfg.clock_jump_s)
        self._clock.see(t_s, finding)
        return finding

    def misdated(self, t_s: float, frame: Sensors) -> MonitorFinding:
        """A frame, at ``t_s``, has samples of impossible times; the one furthest from the frame is named."""
        offsets_s = {kind: worst_offset_s(frame.t, samples) for kind, samples in _kinds(frame)}
        kind = max(offsets_s, key=lambda kind: abs(offsets_s[kind]))
        offset_s = offsets_s[kind]
        limit_s, side = (LATEST_S, "later than") if offset_s > 0.0 else (OLDEST_S, "older than")
        sensor = SAMPLE_RATES[kind].sensor
        finding = conditions.SAMPLES_MISDATED.found(kind, abs(offset_s), limit_s, sensor=sensor, side=side)
        self._misdated.see(t_s, finding)
        return finding

    def garbled(self, t_s: float, at_s: float) -> MonitorFinding | None:
        """Count a line that is not a frame, at ``at_s`` on any monotonic clock; the finding if there are too many.

        ``t_s``: time of the last frame.
        """
        times_s, lines = self._garbled_s, float(self._cfg.garbled_lines)
        times_s.append(at_s)
        if at_s - times_s[0] > self._cfg.garbled_window_s:
            return None
        finding = conditions.LINES_GARBLED.found("lines", lines, lines)
        self._garbled.see(t_s, finding)
        return finding


class LatencyMonitor(Monitor):
    """Latency from a drive to its echo. Above a limit the robot slows down, so that its stopping distance stays."""

    def __init__(self, cfg: HealthConfig) -> None:
        super().__init__()
        self._cfg = cfg
        self.alarm = self.latch(cfg.rate_time_s)
        self.reset()

    def reset(self) -> None:
        """See ``Monitor``."""
        super().reset()
        self._sent: deque[tuple[int, float]] = deque(maxlen=64)

    def sent(self, number: int, t_s: float) -> None:
        """Drive ``number`` was sent by ``t_s``."""
        self._sent.append((number, t_s))

    def step(self, t_s: float, echoed: int) -> None:
        """Take the number of the drive in force."""
        sent = self._sent
        while len(sent) > 1 and sent[1][0] <= echoed:
            sent.popleft()
        if len(sent) > 1 and echoed > 0:
            # The second drive is not in force yet.
            latency_s, cfg = t_s - sent[1][1], self._cfg
            if latency_s > cfg.latency_pause_s:
                self.alarm.see(t_s, conditions.DRIVES_TOO_LATE.found("latency", latency_s, cfg.latency_pause_s))
            elif latency_s > cfg.latency_slow_s:
                self.alarm.see(t_s, conditions.DRIVES_LATE.found("latency", latency_s, cfg.latency_slow_s))
