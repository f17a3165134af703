"""Pure. Every seam is a proof test of the edge sensors: one that crosses it and sees nothing may be blind."""

from collections.abc import Callable
from math import hypot
from typing import NamedTuple, Protocol

from ccatp.config.models import HealthConfig
from ccatp.health.findings import Alarm, Finding
from ccatp.samples import Corner, PanelId, Severity

_CORNERS = tuple(corner.value for corner in Corner)


class PanelPlace(Protocol):
    """The place of a panel, deck frame."""

    @property
    def x_m(self) -> float:
        """Centre."""

    @property
    def y_m(self) -> float:
        """Centre."""

    @property
    def half_x_m(self) -> float:
        """Half the extent along x."""

    @property
    def half_y_m(self) -> float:
        """Half the extent along y."""


class Ground(NamedTuple):
    """The part of a mirror that the proof tests look at.

    Attributes:
        panels: all panels.
        nearest: the panel nearest to a deck point.
        place: deck place of a point of the robot at a pose (x, y, heading).
    """

    panels: dict[PanelId, PanelPlace]
    nearest: Callable[[float, float], PanelId]
    place: Callable[[tuple[float, float, float], tuple[float, float]], tuple[float, float]]


class SeamMonitor:
    """Counts the seams that each sensor crossed without going off.

    A sensor is on a panel for certain where the map has it further inside than the estimate may be wrong. When it is
    for certain on another panel than before, it has crossed a seam; if it has not been off in between, it has missed
    it. Any off sample proves the sensor sound. A pose that jumps (a fix) is no motion, and begins anew.

    Args:
        cfg: limits.
        ground: the map.
        sensors_m: places of the sensors, robot frame.
        sigmas: how many sigmas of the estimate to allow for.
        fastest_m_s: no sensor moves faster.

    Attributes:
        missed: seams in a row, per sensor.
        crossed: seams crossed by all sensors.
    """

    def __init__(
        self,
        cfg: HealthConfig,
        ground: Ground,
        sensors_m: tuple[tuple[float, float], ...],
        sigmas: float,
        fastest_m_s: float,
    ) -> None:
        """No seam crossed."""
        self._cfg, self._ground, self._sensors_m = cfg, ground, sensors_m
        self._sigmas, self._fastest_m_s = sigmas, fastest_m_s
        self.missed = [0, 0, 0, 0]
        self.crossed = 0
        self._blind = Alarm(cfg.retry_after_s)
        self.reset()

    def reset(self) -> None:
        """Where the sensors are is not known; what they have missed is."""
        self._panels: list[PanelId | None] = [None, None, None, None]
        self._seen = [False, False, False, False]
        self._pose: tuple[float, float, float, float] | None = None

    def went_off(self, sensor: int) -> None:
        """A sensor has gone off, or is off: it is not blind."""
        self._seen[sensor] = True
        self.missed[sensor] = 0

    def step(self, t_s: float, pose: tuple[float, float, float], sigma_m: float) -> None:
        """Take a new estimate: its time, (x, y, heading) on the deck, standard deviation of the place."""
        x, y, heading = pose
        self._blind.settle(t_s)
        before, self._pose = self._pose, (t_s, x, y, heading)
        margin_m = self._cfg.seam_margin_m + self._sigmas * sigma_m
        if before is not None:
            reach_m = self._fastest_m_s * abs(t_s - before[0]) + self._cfg.seam_margin_m
            if hypot(x - before[1], y - before[2]) > reach_m:
                self._panels = [None, None, None, None]
        for i, offset_m in enumerate(self._sensors_m):
            panel = self._panel_under(self._ground.place(pose, offset_m), margin_m)
            if panel is not None and panel != self._panels[i]:
                self._enter(i, panel)

    def _panel_under(self, place: tuple[float, float], margin_m: float) -> PanelId | None:
        x, y = place
        found = self._ground.nearest(x, y)
        panel = self._ground.panels[found]
        dx, dy = x - panel.x_m, y - panel.y_m
        is_inside = abs(dx) < panel.half_x_m - margin_m and abs(dy) < panel.half_y_m - margin_m
        return found if is_inside else None

    def _enter(self, i: int, panel: PanelId) -> None:
        if self._panels[i] is not None:
            self.crossed += 1
            if not self._seen[i]:
                self._miss(i)
        self._panels[i] = panel
        self._seen[i] = False

    def _miss(self, i: int) -> None:
        self.missed[i] = missed = self.missed[i] + 1
        limit = self._cfg.seams_failed
        if missed >= limit and self._pose is not None:
            # The pose may be wrong instead: the hold brings a fix, and one more seam shows which.
            cause = "an edge sensor sees no seams: blind"
            self._blind.see(self._pose[0], Finding(Severity.HOLD, cause, _CORNERS[i], missed, limit, retries=0))

    @property
    def finding(self) -> Finding | None:
        """What is thought of the sensor that has missed most seams in a row, if enough."""
        if self._blind.finding is not None:
            return self._blind.finding
        most, limit = max(self.missed), self._cfg.seams_suspect
        if most < limit:
            return None
        corner = _CORNERS[self.missed.index(most)]
        return Finding(Severity.SLOW, "an edge sensor did not see a seam", corner, most, limit)
