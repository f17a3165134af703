"""Pure. From delays that motes heard to ranges of pairs."""

from collections.abc import Sequence

import numpy as np

from ccatp.config.cricket_models import CricketConfig
from ccatp.motes.range_network import FloatArray
from ccatp.motes.tdoa import Air, MoteRange, range_from_delay, range_sigma

_MEDIAN_COST = np.sqrt(np.pi / 2.0)  # of the median's standard deviation against the mean's, for normal noise


def air_of(cfg: CricketConfig) -> Air:
    """What the motes know of the speed of sound."""
    return Air(cfg.air.sound_speed_m_s, cfg.air.temperature_c)


def pair_range(
    cfg: CricketConfig, names: tuple[str, str], delays_s: FloatArray | Sequence[float], temperature_c: float
) -> MoteRange:
    """The range of a pair from its readings.

    Args:
        cfg: air, sigma of a reading, mean or median.
        names: of transmitter and listener.
        delays_s: pulse after message, one for each reading, shape (k,), k >= 1.
        temperature_c: of the listener's thermometer.

    Raises:
        TdoaError: a delay or a temperature that none can be.
    """
    delay_s = float(np.median(delays_s) if cfg.ranging.combine == "median" else np.mean(delays_s))
    range_m = range_from_delay(air_of(cfg), delay_s, temperature_c)
    count = len(delays_s)
    sigma_m = range_sigma(cfg.ranging.sigma_m, range_m, cfg.ranging.thermometer_sigma_c, temperature_c, count)
    if cfg.ranging.combine == "median" and count > 2:
        sigma_m *= float(_MEDIAN_COST)
    return MoteRange(*names, range_m, sigma_m)
