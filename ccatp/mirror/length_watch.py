"""The running tests over the fixes of a run: mean and drift of each channel's residual, and the noise of all.

Input are the standardised errors of single channels (``length_integrity.standardised``), which are standard normal and
independent from fix to fix as long as nothing changes. Cumulative sums (Page 1954): two a channel and sign, for a step
and for a slow drift, and one for noise larger than configured. A deviation that exists from the first fix on is
calibrated and does not show in them; beyond the priors it is found by ``NetworkCalibration.constant_errors``.
"""

from collections.abc import Collection, Mapping, Sequence
from math import log
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from ccatp.config.models import EtalonConfig
from ccatp.core import FloatArray
from ccatp.mirror.length_integrity import LOCATED_FROM, SURVEY_FIXES

WINDOW = 20  # fixes without a second warning of the same
_ALLOWANCES = (1.0, 0.25)  # per fix, in sigmas: a step of two sigmas, a drift that lags by half a sigma
_OVERSHOOT = 1.166  # of a cumulative sum beyond its limit in discrete time; Siegmund 1985
_NOISIER = 1.5  # ratio to the configured noise that the sum of the noise finds first
# Least difference of twice the log-likelihoods for naming one channel, a hundred times as likely as any other. With few
# valid channels their standardised errors are nearly equal, whichever of them is wrong.
_CLEAR = 9.2
_LOOKS = 10  # independent values of a standardised constant error in a survey: its information grows by less than 2^10


def sum_limit(cfg: EtalonConfig, count: int, allowance: float) -> float:
    """Limit of a cumulative sum, Siegmund's approximation, for a fifth of the false alarms of a survey.

    The sums of ``count`` channels, both signs and both allowances share it.
    """
    one = 0.2 * cfg.false_alarm / (SURVEY_FIXES * 2 * len(_ALLOWANCES) * count)
    return float(-log(one / (2.0 * allowance**2)) / (2.0 * allowance) - 2.0 * _OVERSHOOT / 2.0)


class ChannelWarning(NamedTuple):
    """What changed: the channels of which one is wrong (empty: the noise of all), and a text for operators."""

    channels: tuple[int, ...]
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

    def likelihoods(self) -> FloatArray:
        """Twice the log-likelihood ratio of a change of each channel (..., channels), by a shift of two allowances."""
        return np.asarray((4.0 * self._allowances * self.sums).max(axis=(-3, -2)))

    def restart(self) -> None:
        """Begin again."""
        self.sums = np.zeros_like(self.sums)


class NoiseSum:
    """Cumulative sum of the log-likelihood ratio of ``_NOISIER`` times the configured noise, for one run or many."""

    def __init__(self, cfg: EtalonConfig, runs: Sequence[int] = ()) -> None:
        # A sum of log-likelihood ratios passes h less often than once in exp(h) fixes (Lorden 1971).
        self._limit = -log(0.25 * cfg.false_alarm / SURVEY_FIXES)
        self.sum: FloatArray = np.zeros(runs)

    def add(self, chi2: FloatArray | float, dof: int) -> FloatArray:
        """Add a chi-square, (runs,); whether each sum is beyond the limit."""
        ratio = 0.5 * (1.0 - _NOISIER**-2) * np.asarray(chi2) - dof * log(_NOISIER)
        self.sum = np.maximum(self.sum + ratio, 0.0)
        return np.asarray(self.sum > self._limit)


def constant_limit(cfg: EtalonConfig, count: int) -> float:
    """Limit of the standardised constant error of each of ``count`` channels, for 0.15 of the false alarms."""
    return float(-ndtri(0.15 * cfg.false_alarm / (2 * count * _LOOKS)))


class LengthWatch:
    """The running tests of one run; each channel warns once until ``WINDOW`` further fixes have passed."""

    def __init__(self, cfg: EtalonConfig, channels: Sequence[int]) -> None:
        self._cfg, self._channels = cfg, tuple(channels)
        self._sums, self._noise = ChannelSums(cfg, len(channels)), NoiseSum(cfg)
        self._constant_limit = constant_limit(cfg, len(channels))
        self._is_constant_known = False
        self._since: list[tuple[float, int]] = []  # chi-squares since the noise last was as configured
        self._quiet: dict[int | None, int] = {}

    def add(
        self, w: Mapping[int, float], chi2: float, dof: int, constant: tuple[FloatArray, FloatArray]
    ) -> list[ChannelWarning]:
        """Add a fix whose used lengths agree; ``constant``: of ``NetworkCalibration``, in the order of the channels."""
        self._quiet = {channel: left - 1 for channel, left in self._quiet.items() if left > 1}
        values = np.array([w.get(channel, 0.0) for channel in self._channels])
        found = []
        if self._sums.add(values).any():
            channels = self._likely(self._sums.likelihoods(), w)
            # All begin again: an error of one channel raises the sums of the others, too.
            self._sums.restart()
            self._is_constant_known = True  # an error that began later would be taken for one since the first fix
            found.append(ChannelWarning(channels, f"the length of {_named(channels)} has changed against the others"))
        new = [one for one in (*found, *self._noisy(chi2, dof)) if not self._quiet.keys() >= {*_keys(one)}]
        self._quiet |= {key: WINDOW for one in new for key in _keys(one)}
        return [*new, *self._constant(*constant, w)]

    def _likely(self, likelihoods: FloatArray, valid: Collection[int]) -> tuple[int, ...]:
        """The channels that cannot be distinguished from the most likely one.

        All valid ones if they are too few to locate a fault: a change that is not as assumed then seems to be of a
        certain channel.
        """
        least, unlocated = float(np.max(likelihoods)) - _CLEAR, valid if len(valid) < LOCATED_FROM else ()
        of_channel = zip(self._channels, likelihoods.tolist(), strict=True)
        return tuple(channel for channel, one in of_channel if (0.0 < one >= least) or channel in unlocated)

    def _noisy(self, chi2: float, dof: int) -> list[ChannelWarning]:
        is_noisy = bool(self._noise.add(chi2, dof))
        self._since = [*self._since, (chi2, dof)] if self._noise.sum > 0.0 else []
        if not is_noisy:
            return []
        total, freedom = (sum(column) for column in zip(*self._since, strict=True))
        return [ChannelWarning((), f"the lengths have {(total / freedom) ** 0.5:.1f} times the configured noise")]

    def _constant(self, standardised: FloatArray, errors_m: FloatArray, valid: Collection[int]) -> list[ChannelWarning]:
        """Once a run, because an error since the first fix stays."""
        worst = int(np.argmax(np.abs(standardised)))
        if self._is_constant_known or abs(standardised[worst]) <= self._constant_limit:
            return []
        self._is_constant_known = True
        channels, error_um = self._likely(standardised**2, valid), 1e6 * errors_m[worst]
        by = f"{error_um:+.3g} um" if len(channels) == 1 else f"{error_um:+.3g} um (if it is {self._channels[worst]})"
        text = f"{_named(channels)} has read {by} from the others since the first fix, beyond its prior"
        return [ChannelWarning(channels, text)]


def _keys(warning: ChannelWarning) -> tuple[int | None, ...]:
    return warning.channels or (None,)


def _named(channels: Sequence[int]) -> str:
    if len(channels) == 1:
        return f"channel {channels[0]}"
    return f"one of the channels {', '.join(map(str, channels))}"
