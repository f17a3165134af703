"""Pure. Edge sensors that change where the map has nothing to see: chatter, flashes of light."""

from collections import deque
from collections.abc import Callable, Sequence

from ccatp.config.models import HealthConfig
from ccatp.health.findings import Alarm, Finding
from ccatp.samples import Corner, EdgeSample, Severity

_CORNERS = tuple(corner.value for corner in Corner)
# Slower than this nothing crosses an edge; vibration moves a sensor by less in a frame.
_STILL_M_S = 0.002
_CLEAR_S = 0.2


class FlickerMonitor:
    """Judges the changes of the edge sensors, in frames in which any of them is off or has been.

    * More transitions than allowed in a short time where the map has no edge of a panel: chatter, a hold.
    * A sensor that goes off while the wheels stand where the map has no edge: a pause until it is on again, for at
      most ``pause_limit_s``; then the edge rule has the last word, and the robot goes slowly.

    Standing at an edge of a panel a sensor may chatter as it likes: vibration does that.

    Args:
        cfg: limits.
        is_explained: whether the map, at the newest estimate, has an edge of a panel near a sensor (by its index).

    Attributes:
        chatter, flash: what was found.
    """

    def __init__(self, cfg: HealthConfig, is_explained: Callable[[int], bool]) -> None:
        """All sensors on."""
        self._cfg, self._is_explained = cfg, is_explained
        self.chatter, self.flash = Alarm(cfg.retry_after_s), Alarm(_CLEAR_S)
        self.reset()

    def reset(self) -> None:
        """Forget."""
        self.chatter.reset()
        self.flash.reset()
        self._last: tuple[int, ...] = (1, 1, 1, 1)
        self._changes: tuple[deque[float], ...] = (deque(), deque(), deque(), deque())
        self._flashing_s: list[float | None] = [None, None, None, None]

    @property
    def is_quiet(self) -> bool:
        """Nothing to look at as long as all sensors are on."""
        return self._last == (1, 1, 1, 1) and self.chatter.finding is None and self.flash.finding is None

    def step(self, t_s: float, samples: Sequence[EdgeSample], speed_m_s: float) -> None:
        """Judge a frame.

        Args:
            t_s: its time.
            samples: its edge samples, oldest first.
            speed_m_s: of the faster wheel.
        """
        since_s = t_s - self._cfg.chatter_time_s
        for sample in samples:
            state = sample[1:]
            if state != self._last:
                self._change(sample[0], state, is_still=speed_m_s < _STILL_M_S)
        for i, changes in enumerate(self._changes):
            while changes and changes[0] < since_s:
                changes.popleft()
            if len(changes) > self._cfg.chatter_transitions and not self._is_explained(i):
                self.chatter.see(t_s, self._chattering(i, len(changes)))
        self._judge_flashes(t_s)
        self.chatter.settle(t_s)
        self.flash.settle(t_s)

    def _chattering(self, i: int, count: int) -> Finding:
        limit = self._cfg.chatter_transitions
        return Finding(Severity.HOLD, "an edge sensor chatters", _CORNERS[i], count, limit)

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
        severity = Severity.PAUSE if longest_s < limit_s - _CLEAR_S else Severity.SLOW
        cause = "an edge sensor went off though nothing moved"
        self.flash.see(t_s, Finding(severity, cause, _CORNERS[off[0]], len(off), 0.0))
        if severity is Severity.SLOW and self.flash.finding is not None:
            self.flash.finding = self.flash.finding._replace(severity=Severity.SLOW)
