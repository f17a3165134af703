"""Monitors of the edge sensors: chatter, flashes, missed seams."""

from collections import deque
from collections.abc import Callable, Sequence
from math import hypot, inf

from ccatp.conditions import MonitorFinding
from ccatp.conditions import danger as conditions
from ccatp.config.models import HealthConfig, RobotConfig
from ccatp.core import Corner, DeckPose, EdgeSample, PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.rest import ALMOST_AT_REST_M_S
from ccatp.safety.escalation import FindingLatch
from ccatp.safety.monitor import Monitor

_CORNERS = tuple(corner.value for corner in Corner)


_CLEAR_S = 0.2


class FlickerMonitor(Monitor):
    """Judges the transitions of the edge sensors, in frames in which a sensor is off or was off a moment ago.

    * More transitions than allowed in a short time, where the map has no edge of a panel: chatter, a hold.
    * A sensor that goes off while the wheels stand, where the map has no edge: a pause until it is on again, for at
      most ``pause_limit_s``; then the edge rule decides, and the robot drives slowly.

    Near an edge of a panel, vibration makes a sensor chatter, so that is ignored. ``is_explained``: whether the map, at
    the newest estimate, has an edge of a panel near the i-th sensor.
    """

    def __init__(self, cfg: HealthConfig, is_explained: Callable[[int], bool]) -> None:
        super().__init__()
        self._cfg = cfg
        self._is_explained = is_explained
        self.chatter = self.latch(cfg.retry_after_s)
        self.flash = self.latch(_CLEAR_S)
        self.reset()

    def reset(self) -> None:
        """See ``Monitor``."""
        super().reset()
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
                self._change(sample[0], state, is_still=speed_m_s < ALMOST_AT_REST_M_S)
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


class SeamMonitor(Monitor):
    """Counts the seams that each edge sensor crossed without going off: every seam is a proof test.

    A sensor is certainly on a panel if the map shows it further inside than the error of the estimate. If it is then on
    another panel than before and was not off in between, it has missed the seam. Any off sample proves that the sensor
    works. A pose that jumps (a fix) is no motion: the panels are determined again.
    """

    def __init__(self, cfg: HealthConfig, mirror: Mirror, robot: RobotConfig, sigmas: float) -> None:
        super().__init__()
        self._cfg = cfg
        self._mirror = mirror
        self._sensors_m = robot.edge_sensors_m
        self._sigmas = sigmas
        self._fastest_m_s = robot.wheel_radius_m * robot.max_wheel_rad_s
        self._reach_m = max(hypot(*offset_m) for offset_m in robot.edge_sensors_m)
        self.missed = [0, 0, 0, 0]
        self._blind = FindingLatch(cfg.retry_after_s)  # settles with the estimates, and stays after a reset
        self.reset()

    def reset(self) -> None:
        """Drop the places of the sensors; keep the numbers of missed seams."""
        super().reset()
        self._panels: list[PanelId | None] = [None, None, None, None]
        self._seen = [False, False, False, False]
        self._pose: tuple[float, float, float, float] | None = None
        self._inside_m = 0.0  # lower bound of the distance of all sensors from their panels' edges; 0: look up again

    def findings(self, t_s: float) -> list[MonitorFinding]:
        """See ``Monitor``; and about the sensor that missed most seams in a row, if these are enough."""
        found, blindest = super().findings(t_s), self._blindest()
        return found if blindest is None else [*found, blindest]

    def went_off(self, sensor: int) -> None:
        """Report that a sensor went off or is off: it is not blind."""
        self._seen[sensor] = True
        self.missed[sensor] = 0

    def step(self, t_s: float, pose: DeckPose, sigma_m: float) -> None:
        """Take a new estimate: its time, pose, and standard deviation of the position."""
        x, y, heading = pose.x_m, pose.y_m, pose.heading_rad
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
        hx, hy, lx, ly = self._mirror.body_axes(pose)
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

    def _blindest(self) -> MonitorFinding | None:
        if self._blind.finding is not None:
            return self._blind.finding
        most, limit = max(self.missed), self._cfg.seams_suspect
        if most < limit:
            return None
        corner = _CORNERS[self.missed.index(most)]
        return conditions.SEAM_MISSED.found(corner, most, limit)
