"""The running test of each channel over the fixes of a run: mean and drift of its residual, and the noise of all.

Input are the standardised errors of single channels (``length_integrity.standardised``), which are standard normal and
independent from fix to fix as long as nothing changes. Two cumulative sums a channel and sign (Page 1954), for a step
and for a slow drift, and the mean square of the last fixes. A deviation that exists from the first fix on, within the
priors of the network, is calibrated and is not found here.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from math import log
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ccatp.config.models import EtalonConfig
from ccatp.core import FloatArray
from ccatp.mirror.length_integrity import SURVEY_FIXES

WINDOW = 20  # fixes
_ALLOWANCES = (1.0, 0.25)  # per fix, in sigmas: a step of two sigmas, a drift that lags by half a sigma
_OVERSHOOT = 1.166  # of a cumulative sum beyond its limit in discrete time; Siegmund 1985


def sum_limit(cfg: EtalonConfig, count: int, allowance: float) -> float:
    """Limit of a cumulative sum, Siegmund's approximation, for a fifth of the false alarms of a survey.

    The sums of ``count`` channels, both signs and both allowances share it.
    """
    one = 0.2 * cfg.false_alarm / (SURVEY_FIXES * 2 * len(_ALLOWANCES) * count)
    return float(-log(one / (2.0 * allowance**2)) / (2.0 * allowance) - 2.0 * _OVERSHOOT / 2.0)


class ChannelWarning(NamedTuple):
    """What changed: the channel (``None``: the noise of all) and a text for operators."""

    channel: int | None
    text: str


class ChannelSums:
    """Cumulative sums of channels, shape (..., allowances, 2 signs, channels); pure numbers, for one run or many."""

    def __init__(self, cfg: EtalonConfig, count: int, runs: Sequence[int] = ()) -> None:
        self.sums: FloatArray = np.zeros((*runs, len(_ALLOWANCES), 2, count))
        self._allowances = np.array(_ALLOWANCES)[:, None, None]
        self._limits = np.array([sum_limit(cfg, count, one) for one in _ALLOWANCES])[:, None, None]

    def add(self, w: FloatArray) -> FloatArray:
        """Add standardised errors (..., channels), 0 for a channel without a value; whether each is beyond a limit."""
        signed = np.stack([w, -w], axis=-2)[..., None, :, :]
        self.sums = np.maximum(self.sums + signed - self._allowances, 0.0)
        return np.asarray((self.sums > self._limits).any(axis=(-3, -2)))

    def restart(self, column: int) -> None:
        """Begin again for one channel."""
        self.sums[..., column] = 0.0


class LengthWatch:
    """The running tests of one run; each channel warns once until ``WINDOW`` further fixes have passed."""

    def __init__(self, cfg: EtalonConfig, channels: Sequence[int]) -> None:
        self._cfg, self._columns = cfg, {channel: k for k, channel in enumerate(channels)}
        self._sums = ChannelSums(cfg, len(channels))
        self._squares: deque[tuple[float, int]] = deque(maxlen=WINDOW)
        self._quiet: dict[int | None, int] = {}

    def add(self, w: Mapping[int, float], chi2: float, dof: int) -> list[ChannelWarning]:
        """Add a fix without a located fault."""
        self._quiet = {channel: left - 1 for channel, left in self._quiet.items() if left > 1}
        values = np.zeros(len(self._columns))
        for channel, value in w.items():
            values[self._columns[channel]] = value
        beyond = self._sums.add(values)
        found = []
        for channel, column in self._columns.items():
            if beyond[column]:
                self._sums.restart(column)
                found.append(ChannelWarning(channel, f"the length of channel {channel} has changed against the others"))
        self._squares.append((chi2, dof))
        total, freedom = (sum(column) for column in zip(*self._squares, strict=True))
        if total > noise_limit(self._cfg, int(freedom)):
            ratio = (total / freedom) ** 0.5
            found.append(ChannelWarning(None, f"the lengths have {ratio:.1f} times the configured noise"))
        new = [one for one in found if one.channel not in self._quiet]
        self._quiet |= {one.channel: WINDOW for one in new}
        return new


def noise_limit(cfg: EtalonConfig, dof: int) -> float:
    """Limit of the sum of the chi-squares of the last fixes, for a quarter of the false alarms of a survey."""
    return float(chdtri(dof, cfg.false_alarm / (4.0 * SURVEY_FIXES)))
