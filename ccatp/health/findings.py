"""Pure. What a monitor finds, and how long a finding stays after its evidence is gone."""

from math import inf
from typing import NamedTuple

from ccatp.samples import Severity


class Finding(NamedTuple):
    """Something is wrong.

    Attributes:
        severity: what has to be done.
        cause: why, in one short phrase.
        signal: what gave cause.
        value: its value, in the unit of ``limit``.
        limit: the limit that it passed.
        full_fans: the fans shall give all they can.
        retries: how often it may come again before it is a fault; ``None``: as often as the configuration says.
        patience_s: a hold that lasts longer is a fault; ``None``: as the configuration says.
    """

    severity: Severity
    cause: str
    signal: str
    value: float
    limit: float
    full_fans: bool = False
    retries: int | None = None
    patience_s: float | None = None


class Alarm:
    """A finding that stays until there has been no evidence of it for a while.

    Args:
        clear_s: that while.

    Attributes:
        finding: the finding, or ``None``.
    """

    __slots__ = ("_clear_s", "_seen_s", "finding")

    def __init__(self, clear_s: float) -> None:
        """Nothing found."""
        self._clear_s = clear_s
        self.reset()

    def reset(self) -> None:
        """Forget."""
        self.finding: Finding | None = None
        self._seen_s = -inf

    def see(self, t_s: float, finding: Finding) -> None:
        """There is evidence at ``t_s``. The first values are kept, unless it has become graver."""
        if self.finding is None or finding.severity > self.finding.severity:
            self.finding = finding
        self._seen_s = t_s

    def settle(self, t_s: float) -> None:
        """Let the finding go if its last evidence is long ago at ``t_s``."""
        if self.finding is not None and t_s - self._seen_s >= self._clear_s:
            self.finding = None


class Since:
    """Since when something has been so without interruption.

    Attributes:
        t_s: since then; ``None`` while it is not so.
    """

    __slots__ = ("t_s",)

    def __init__(self) -> None:
        """It is not so."""
        self.t_s: float | None = None

    def lasts(self, t_s: float, is_so: bool) -> float:
        """For how long it has been so at ``t_s``, s; < 0 while it is not."""
        if not is_so:
            self.t_s = None
            return -1.0
        if self.t_s is None:
            self.t_s = t_s
        return t_s - self.t_s
