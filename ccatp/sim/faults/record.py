"""Pure. The record of what was injected: which fault, from when to when, and how many samples it changed."""

from typing import NamedTuple

from ccatp.sim.faults.models import Fault


class Injected(NamedTuple):
    """What became of one fault of the plan.

    Attributes:
        signal, type: of the fault.
        at_s: when it was to begin; ``None`` for a fault of the link that waits for something else.
        from_s, until_s: the first and last sample, frame or step that it acted on, robot time; ``None``: none yet.
        samples: how many it acted on.
        changed: how many of them came out different, or not at all.
    """

    signal: str
    type: str
    at_s: float | None
    from_s: float | None
    until_s: float | None
    samples: int
    changed: int


class Record:
    """The record of one fault while it is written.

    Args:
        fault: the fault.
    """

    __slots__ = ("_changed", "_from_s", "_is_told", "_samples", "_until_s", "fault")

    def __init__(self, fault: Fault) -> None:
        self.fault = fault
        self._from_s: float | None = None
        self._until_s: float | None = None
        self._samples = self._changed = 0
        self._is_told = 0

    def add(self, t_s: float, *, is_changed: bool = True) -> None:
        """Count one sample, frame or step."""
        if self._from_s is None:
            self._from_s = t_s
        self._until_s = t_s
        self._samples += 1
        self._changed += is_changed

    @property
    def injected(self) -> Injected:
        """What it says so far."""
        fault = self.fault
        return Injected(fault.signal, fault.type, fault.at_s, self._from_s, self._until_s, self._samples, self._changed)

    def has_news(self, t_s: float) -> str:
        """``begins`` or ``ended`` once each, else empty; a fault of an instant ends as it begins."""
        if self._is_told == 0 and self._from_s is not None:
            self._is_told = 1
            return "begins"
        is_over = t_s >= self.fault.end_s
        if self._is_told == 1 and is_over:
            self._is_told = 2
            return "ended"
        return ""
