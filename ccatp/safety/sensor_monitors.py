"""Monitors of edge sensors (chatter, flashes, missed seams), sample rates, link latency, fans and battery."""

from collections import deque
from collections.abc import Callable, Sequence
from math import hypot, inf

from ccatp import conditions
from ccatp.conditions import SAMPLE_RATES, MonitorFinding
from ccatp.config.models import HealthConfig, RobotConfig
from ccatp.core import Corner, DeckPose, EdgeSample, PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.safety.escalation import FindingLatch, Since

_CORNERS = tuple(corner.value for corner in Corner)
# Below this speed no sensor crosses an edge.
_STILL_M_S = 0.002
_CLEAR_S = 0.2


class FlickerMonitor:
    """Judges the transitions of the edge sensors, in frames in which a sensor is off or was off a moment ago.

    * More transitions than allowed in a short time, where the map has no edge of a panel: chatter, a hold.
    * A sensor that goes off while the wheels stand, where the map has no edge: a pause until it is on again, for at
      most ``pause_limit_s``; then the edge rule decides, and the robot drives slowly.

    Near an edge of a panel, vibration makes a sensor chatter, so that is ignored. ``is_explained``: whether the map, at
    the newest estimate, has an edge of a panel near the i-th sensor.
    """

    def __init__(self, cfg: HealthConfig, is_explained: Callable[[int], bool]) -> None:
        self._cfg, self._is_explained = cfg, is_explained
        self.chatter, self.flash = FindingLatch(cfg.retry_after_s), FindingLatch(_CLEAR_S)
        self._last: tuple[int, ...] = (1, 1, 1, 1)
        self._changes: tuple[deque[float], ...] = (deque(), deque(), deque(), deque())
        self._flashing_s: list[float | None] = [None, None, None, None]

    @property
    def is_quiet(self) -> bool:
        """Whether there is nothing to judge as long as all sensors are on."""
        return self._last == (1, 1, 1, 1) and self.chatter.finding is None and self.flash.finding is None

    def step(self, t_s: float, samples: Sequence[EdgeSample], speed_m_s: float) -> None:
        """Judge a frame; ``speed_m_s``: of the faster wheel."""
        since_s = t_s - self._cfg.chatter_time_s
        for sample in samples:
            state = sample[1:]
            if state != self._last:
                self._change(sample[0], state, is_still=speed_m_s < _STILL_M_S)
        for i, changes in enumerate(self._changes):
            while changes and changes[0] < since_s:
                changes.popleft()
            if len(changes) > self._cfg.chatter_transitions and not self._is_explained(i):
                limit = self._cfg.chatter_transitions
                self.chatter.see(t_s, conditions.EDGE_SENSOR_CHATTERS.found(_CORNERS[i], len(changes), limit))
        self._judge_flashes(t_s)

    def _change(self, t_s: float, state: tuple[int, ...], *, is_still: bool) -> None:
        for i, (before, now) in enumerate(zip(self._last, state, strict=True)):
            if before == now:
                continue
            self._changes[i].append(t_s)
            if now == 1:
                self._flashing_s[i] = None
            elif is_still and not self._is_explained(i):
                self._flashing_s[i] = t_s
        self._last = state

    def _judge_flashes(self, t_s: float) -> None:
        off = [i for i, since_s in enumerate(self._flashing_s) if since_s is not None]
        if not off:
            return
        longest_s = max(t_s - (self._flashing_s[i] or t_s) for i in off)
        limit_s = self._cfg.pause_limit_s
        is_short = longest_s < limit_s - _CLEAR_S
        condition = conditions.EDGE_SENSOR_FLASHES if is_short else conditions.EDGE_SENSOR_STAYS_DARK
        self.flash.see(t_s, condition.found(_CORNERS[off[0]], len(off), 0.0))
        if condition is conditions.EDGE_SENSOR_STAYS_DARK and self.flash.finding is not None:
            self.flash.finding = self.flash.finding._replace(condition=condition, severity=condition.severity)


_SOURCES = ("imu", "enc", "edge")


class RateMonitor:
    """Compares the sample rate of each sensor with the required rate and with the rate of the first period.

    ``finding``: about the worst sensor. A sensor without any samples is left out, because other rules report it.
    """

    def __init__(self, cfg: HealthConfig) -> None:
        self._cfg = cfg
        self.finding: MonitorFinding | None = None
        self.are_encoders_sparse = False
        self._begin_s: float | None = None
        self._last_s = 0.0
        self._counts = [0, 0, 0]
        self._usual_hz: list[float] | None = None
        self._before_hz: list[float] = []

    def step(self, t_s: float, imu: int, encoders: int, edges: int) -> None:
        """Take the numbers of samples of a frame; judged once per ``rate_time_s``."""
        elapsed_s, self._last_s = t_s - self._last_s, t_s
        if self._begin_s is None:
            self._begin_s = t_s
            return
        if self._usual_hz is not None:
            self.are_encoders_sparse = encoders < self._cfg.rate_share * self._usual_hz[1] * elapsed_s
        counts = self._counts
        counts[0] += imu
        counts[1] += encoders
        counts[2] += edges
        span_s = t_s - self._begin_s
        if span_s >= self._cfg.rate_time_s - 1e-6:
            self._judge(span_s)
            self._begin_s, self._counts = t_s, [0, 0, 0]

    def _judge(self, span_s: float) -> None:
        rates = [count / span_s for count in self._counts]
        if self._usual_hz is None:
            self._usual_hz = self._before_hz = rates
            return
        before, self._before_hz = self._before_hz, rates
        self.finding = self._too_slow(span_s, before, rates) or self._fewer_than_usual(self._usual_hz, rates)

    def _too_slow(self, span_s: float, before: list[float], rates: list[float]) -> MonitorFinding | None:
        """Judge the better of two periods, so that a sensor that was silent for a while does not count as slow."""
        slowest, found = 1.0, None
        for name, one_hz, other_hz in zip(_SOURCES, before, rates, strict=True):
            sensor, least_hz, hold_hz = SAMPLE_RATES[name]
            rate_hz = max(one_hz, other_hz)
            if min(one_hz, other_hz) > 0.0 and rate_hz + 1.0 / span_s < slowest * least_hz:
                slowest = rate_hz / least_hz
                row = conditions.SENSOR_MUCH_TOO_SLOW if rate_hz < hold_hz else conditions.SENSOR_TOO_SLOW
                varies = {"rate": f"{rate_hz:.0f}", "least": f"{least_hz:.0f}"}
                found = row.found(name, rate_hz, least_hz, sensor=sensor, **varies)
        return found

    def _fewer_than_usual(self, usual_hz: list[float], rates: list[float]) -> MonitorFinding | None:
        shares = [rate / usual if usual else 1.0 for rate, usual in zip(rates, usual_hz, strict=True)]
        least, limit = min(shares), self._cfg.rate_share
        if least >= limit:
            return None
        return conditions.SAMPLES_TOO_FEW.found(_SOURCES[shares.index(least)], least, limit)


class LatencyMonitor:
    """Latency from a drive to its echo. Above a limit the robot slows down, so that its stopping distance stays."""

    def __init__(self, cfg: HealthConfig) -> None:
        self._cfg = cfg
        self.alarm = FindingLatch(cfg.rate_time_s)
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


class SeamMonitor:
    """Counts the seams that each edge sensor crossed without going off: every seam is a proof test.

    A sensor is certainly on a panel if the map shows it further inside than the error of the estimate. If it is then on
    another panel than before and was not off in between, it has missed the seam. Any off sample proves that the sensor
    works. A pose that jumps (a fix) is no motion: the panels are determined again.
    """

    def __init__(self, cfg: HealthConfig, mirror: Mirror, robot: RobotConfig, sigmas: float) -> None:
        self._cfg, self._mirror, self._sensors_m, self._sigmas = cfg, mirror, robot.edge_sensors_m, sigmas
        self._fastest_m_s = robot.wheel_radius_m * robot.max_wheel_rad_s
        self._reach_m = max(hypot(*offset_m) for offset_m in robot.edge_sensors_m)
        self.missed = [0, 0, 0, 0]
        self._blind = FindingLatch(cfg.retry_after_s)
        self.reset()

    def reset(self) -> None:
        """Drop the places of the sensors; keep the numbers of missed seams."""
        self._panels: list[PanelId | None] = [None, None, None, None]
        self._seen = [False, False, False, False]
        self._pose: tuple[float, float, float, float] | None = None
        self._inside_m = 0.0  # lower bound of the distance of all sensors from their panels' edges; 0: look up again

    def went_off(self, sensor: int) -> None:
        """Report that a sensor went off or is off: it is not blind."""
        self._seen[sensor] = True
        self.missed[sensor] = 0

    def step(self, t_s: float, pose: tuple[float, float, float], sigma_m: float) -> None:
        """Take a new estimate: its time, (x, y, heading) in the deck frame, standard deviation of the position."""
        x, y, heading = pose
        self._blind.settle(t_s)
        before, self._pose = self._pose, (t_s, x, y, heading)
        margin_m = self._cfg.seam_margin_m + self._sigmas * sigma_m
        if before is not None:
            reach_m = self._fastest_m_s * abs(t_s - before[0]) + self._cfg.seam_margin_m
            moved_m = hypot(x - before[1], y - before[2])
            if moved_m > reach_m:
                self._panels = [None, None, None, None]
            # Twice the largest motion, because the robot's axes in the deck plane also change with the slope.
            self._inside_m -= 2.0 * (moved_m + self._reach_m * abs(heading - before[3]))
            if margin_m < self._inside_m and moved_m <= reach_m:
                return
        least_m = inf
        hx, hy, lx, ly = self._mirror.body_axes(DeckPose(x, y, heading))
        for i, (ox, oy) in enumerate(self._sensors_m):
            found, inside_m = self._panel_under(x + ox * hx + oy * lx, y + ox * hy + oy * ly)
            least_m = min(least_m, inside_m)
            panel = found if inside_m > margin_m else None
            if panel is not None and panel != self._panels[i]:
                self._enter(i, panel)
        self._inside_m = least_m if least_m > margin_m else 0.0

    def _panel_under(self, x: float, y: float) -> tuple[PanelId, float]:
        """The panel nearest to a place, and how far inside its edges the place is, m."""
        found = self._mirror.nearest_panel(x, y)
        panel = self._mirror.panels[found]
        return found, min(panel.half_x_m - abs(x - panel.x_m), panel.half_y_m - abs(y - panel.y_m))

    def _enter(self, i: int, panel: PanelId) -> None:
        if self._panels[i] is not None and not self._seen[i]:
            self._miss(i)
        self._panels[i] = panel
        self._seen[i] = False

    def _miss(self, i: int) -> None:
        self.missed[i] = missed = self.missed[i] + 1
        limit = self._cfg.seams_failed
        if missed >= limit and self._pose is not None:
            # The pose may be wrong instead. The hold brings a fix, and the next seam shows which of them is wrong.
            self._blind.see(self._pose[0], conditions.EDGE_SENSOR_BLIND.found(_CORNERS[i], missed, limit))

    @property
    def finding(self) -> MonitorFinding | None:
        """The finding about the sensor that missed most seams in a row, if these are enough."""
        if self._blind.finding is not None:
            return self._blind.finding
        most, limit = max(self.missed), self._cfg.seams_suspect
        if most < limit:
            return None
        corner = _CORNERS[self.missed.index(most)]
        return conditions.SEAM_MISSED.found(corner, most, limit)


# A fan command is in force at the latest two link delays after it was sent.
_FIRST_COMMAND_S = 1.0
REPORTED = {
    "imu": conditions.IMU_REPORTED,
    "encoder_left": conditions.ENCODER_REPORTED,
    "encoder_right": conditions.ENCODER_REPORTED,
    "edge": conditions.EDGE_REPORTED,
    "stall": conditions.STALL_REPORTED,
}
FANS, _SIDES = ("fan_left", "fan_right"), ("left", "right")


class FanMonitor:
    """Compares the echo of the fans' duties with the commanded ``duty`` (left, right), where the mirror overhangs.

    The echo is only a set point. Thrust and rotation are not on the link, so the robot itself has to report a fan that
    fails (``fan_left``, ``fan_right``).
    """

    def __init__(self, cfg: HealthConfig, duty: tuple[float, float], overhang: bool) -> None:
        self._cfg, self._overhang = cfg, overhang
        self._enough = cfg.fan_early_share * duty[0], cfg.fan_early_share * duty[1]
        self._least = cfg.fan_share * duty[0], cfg.fan_share * duty[1]
        self.alarm = FindingLatch(cfg.retry_after_s)
        self._low, self._weak = Since(), Since()
        self._first_s: float | None = None
        self._was_right = False
        self._sound: tuple[float, float] | None = None  # the newest duties, if they are high enough

    def step(self, t_s: float, fans: tuple[float, float], faults: Sequence[str]) -> None:
        """Judge a frame."""
        if fans == self._sound and not faults:
            return
        left, right = self._least
        is_weak = False
        is_low = fans[0] < left or fans[1] < right
        self._was_right = self._was_right or not is_low
        if self._first_s is None:
            self._first_s = t_s
        is_due = self._was_right or t_s - self._first_s > _FIRST_COMMAND_S
        lasts_s = self._low.lasts(t_s, is_low and is_due)
        if lasts_s >= self._cfg.fan_time_s - 1e-6 and self._overhang:
            k = 0 if fans[0] / left < fans[1] / right else 1
            self.alarm.see(t_s, conditions.FAN_TOO_LITTLE.found(FANS[k], fans[k], self._least[k], side=_SIDES[k]))
        elif self._overhang:
            is_weak = fans[0] < self._enough[0] or fans[1] < self._enough[1]
            if self._weak.lasts(t_s, is_weak and is_due) >= self._cfg.fan_time_s - 1e-6:
                k = 0 if fans[0] - self._enough[0] < fans[1] - self._enough[1] else 1
                finding = conditions.FAN_WEAK.found(FANS[k], fans[k], self._enough[k], side=_SIDES[k])
                self.alarm.see(t_s, finding)
        for name in faults:
            if name in FANS:
                reported = conditions.FAN_REPORTED if self._overhang else conditions.FAN_REPORTED_ON_THE_FLAT
                self.alarm.see(t_s, reported.found(name, 1.0, 0.0, side=name[4:]))
        self._sound = None if is_low or is_weak else fans


class BatteryMonitor:
    """Checks that the charge is enough for the way home. A finding stays, because the battery does not recharge."""

    def __init__(self, cfg: HealthConfig) -> None:
        self._cfg = cfg
        self.finding: MonitorFinding | None = None
        self.reset()

    def reset(self) -> None:
        """Begin the durations again, because the robot's clock has restarted."""
        self._low, self._reported = Since(), Since()

    def step(self, t_s: float, soc: float, is_reported: bool, home_m: float) -> None:
        """Judge a frame; ``soc`` from 0 to 1, ``home_m``: length of the way home."""
        cfg = self._cfg
        least = cfg.battery_reserve
        least += cfg.battery_margin * home_m / cfg.slow_speed_m_s / cfg.battery_life_s
        if self._low.lasts(t_s, soc < least) >= cfg.battery_time_s:
            self.finding = conditions.BATTERY_LOW.found("soc", soc, least)
        if self._reported.lasts(t_s, is_reported) >= cfg.battery_time_s:
            self.finding = conditions.BATTERY_REPORTED.found("battery_low", soc, least)
