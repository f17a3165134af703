"""Pure. What motes hear of each other: usable region, flight of the pulse, echoes, losses, thermometers."""

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np

from ccatp.config.cricket_models import CricketConfig, TransducerConfig
from ccatp.samples import FloatArray
from ccatp.sim.motes.layout import TrueMotes

_ABSOLUTE_ZERO_C = -273.15


class Heard(NamedTuple):
    """Readings of one pair.

    Attributes:
        transmitter, listener: indices of the motes.
        delays_s: pulse after message, shape (k,); as many as were heard.
        temperature_c: of the listener's thermometer.
    """

    transmitter: int
    listener: int
    delays_s: FloatArray
    temperature_c: float


class MoteField:
    """Motes that range among themselves.

    Args:
        cfg: transducer, air, the true faults.
        motes: where they are.
        rng: draws the errors of the thermometers, once for each mote.
    """

    def __init__(self, cfg: CricketConfig, motes: TrueMotes, rng: np.random.Generator) -> None:
        self.motes = motes
        self._cfg = cfg
        true = cfg.sim
        self._temperatures_c = true.temperature_c + rng.normal(0.0, true.thermometer_sigma_c, len(motes.names))
        ratio = (true.temperature_c - _ABSOLUTE_ZERO_C) / (cfg.air.temperature_c - _ABSOLUTE_ZERO_C)
        self._sound_m_s = cfg.air.sound_speed_m_s * sqrt(ratio)

    def hears(self, transmitter: int, listener: int) -> bool:
        """Whether a mote is in the usable region of another, and the other in its own."""
        places, facings = self.motes.positions_m, self.motes.facings
        way = places[listener] - places[transmitter]
        distance_m = float(np.linalg.norm(way))
        if self._cfg.layout == "random" and distance_m > self._cfg.random.reach_m:
            return False
        off = _off_axis(facings[transmitter], way), _off_axis(facings[listener], -way)
        return self._cfg.transducer.nearest_m <= distance_m <= usable_reach(self._cfg.transducer, *off)

    def listen(self, pairs: Sequence[tuple[int, int]], repeats: int, rng: np.random.Generator) -> list[Heard]:
        """Readings of pairs; a pair that hears nothing is left out.

        Args:
            pairs: transmitter and listener of each.
            repeats: pulses of each.
            rng: noise, losses, echoes.
        """
        heard = []
        for transmitter, listener in pairs:
            if not self.hears(transmitter, listener):
                continue
            delays_s = self._delays(transmitter, listener, repeats, rng)
            if delays_s.size:
                heard.append(Heard(transmitter, listener, delays_s, float(self._temperatures_c[listener])))
        return heard

    def _delays(self, transmitter: int, listener: int, repeats: int, rng: np.random.Generator) -> FloatArray:
        true = self._cfg.sim
        ways_m = np.full(repeats, float(np.linalg.norm(np.subtract(*self.motes.positions_m[[transmitter, listener]]))))
        is_echo = rng.random(repeats) < true.multipath_probability
        ways_m[is_echo] += rng.exponential(true.multipath_excess_m, int(is_echo.sum()))
        ways_m += rng.normal(0.0, true.sigma_m, repeats)
        delays_s = np.maximum(ways_m / self._sound_m_s + true.latency_s, 0.0)
        if true.tick_s > 0.0:
            delays_s = np.round(delays_s / true.tick_s) * true.tick_s
        return np.asarray(delays_s[rng.random(repeats) >= true.loss_probability])


def usable_reach(transducer: TransducerConfig, off_transmitter_rad: float, off_listener_rad: float) -> float:
    """How far a pulse is heard, m: reach(a) reach(b) / reach(0).

    Both transducers have the same directivity, and each takes its share of the reach on the axis.

    Args:
        transducer: the table of reaches; straight lines between its angles, nothing beyond.
        off_transmitter_rad: angle a between the transmitter's axis and the way.
        off_listener_rad: angle b between the listener's axis and the way.
    """
    on_axis_m = transducer.reach_m[0]
    if transducer.is_omnidirectional or on_axis_m <= 0.0:
        return on_axis_m
    off = np.interp((off_transmitter_rad, off_listener_rad), transducer.off_axis_rad, transducer.reach_m, right=0.0)
    return float(off[0] * off[1] / on_axis_m)


def _off_axis(facing: FloatArray, way: FloatArray) -> float:
    """Angle between an axis and a way; nought for a mote that is turned to the other."""
    length = float(np.linalg.norm(way))
    if not facing.any() or length <= 0.0:
        return 0.0
    return float(np.arccos(np.clip(facing @ way / length, -1.0, 1.0)))
