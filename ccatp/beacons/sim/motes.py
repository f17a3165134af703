"""The motes of a simulated field: their positions, the pulses they receive, and what the robot's listener receives.

A pulse has a usable region, a time of flight, echoes, losses and a temperature. The motes send one after the other,
round by round; a pulse is received in the frame in which it is sent. Reports are not lost.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, sqrt
from typing import NamedTuple

import numpy as np

from ccatp.beacons.config.models import CricketConfig, ListenerConfig, MotePlaceConfig, TransducerConfig
from ccatp.beacons.links.messages import MoteBurst
from ccatp.beacons.sim.radio import TruePose
from ccatp.core import FloatArray


@dataclass(frozen=True, slots=True)
class TrueMotes:
    """Positions and unit vectors of facing, shape (n, d); a facing of zero: the mote always faces its peer."""

    names: tuple[str, ...]
    positions_m: FloatArray
    facings: FloatArray


def true_motes(cfg: CricketConfig, rng: np.random.Generator) -> TrueMotes:
    """The motes of a configuration; ``rng`` draws the positions of the layout ``random``."""
    if cfg.layout == "networks":
        return _stands(cfg)
    if cfg.layout == "motes":
        places = np.array([mote.place_m for mote in cfg.motes.values()], dtype=np.float64)
        return TrueMotes(tuple(cfg.motes), places, np.array([_unit(mote) for mote in cfg.motes.values()]))
    size = np.array(cfg.random.size_m)
    places = rng.uniform(0.0, 1.0, (cfg.random.count, cfg.dimension)) * size
    names = tuple(f"M{number + 1}" for number in range(cfg.random.count))
    return TrueMotes(names, places, np.zeros_like(places))


def _stands(cfg: CricketConfig) -> TrueMotes:
    stand = np.array(cfg.stand_m, dtype=np.float64)
    places, facings = [np.array(list(cfg.anchors.values()), dtype=np.float64)], [np.zeros((len(cfg.anchors), 2))]
    names = list(cfg.anchors)
    for name, network in cfg.networks.items():
        x, y = _unit(network)
        places.append(np.array(network.place_m) + stand @ np.array([[x, y], [-y, x]]))
        facings.append(np.tile((x, y), (len(stand), 1)))
        names += [f"{name}-{mote + 1}" for mote in range(len(stand))]
    return TrueMotes(tuple(names), np.concatenate(places), np.concatenate(facings))


def _unit(mote: MotePlaceConfig) -> FloatArray:
    facing = np.array(mote.facing, dtype=np.float64)
    return np.asarray(facing / np.linalg.norm(facing))


_ABSOLUTE_ZERO_C = -273.15


class MotePulse(NamedTuple):
    """Readings of one pair: delays of pulse after message, shape (k,), with k received pulses."""

    transmitter: int
    listener: int
    delays_s: FloatArray
    temperature_c: float


class MoteField:
    """Motes that range to each other; ``rng`` draws the errors of the thermometers, once for each mote."""

    def __init__(self, cfg: CricketConfig, motes: TrueMotes, rng: np.random.Generator) -> None:
        self.motes = motes
        self._cfg = cfg
        true = cfg.sim
        self._temperatures_c = true.temperature_c + rng.normal(0.0, true.thermometer_sigma_c, len(motes.names))
        ratio = (true.temperature_c - _ABSOLUTE_ZERO_C) / (cfg.air.temperature_c - _ABSOLUTE_ZERO_C)
        self._sound_m_s = cfg.air.sound_speed_m_s * sqrt(ratio)
        self._distances_m = dict[tuple[int, int], float | None]()

    def receives(self, transmitter: int, listener: int) -> bool:
        """Whether the distance of two motes is within the usable range of their transducers and directions."""
        return self._received_from_m(transmitter, listener) is not None

    def _received_from_m(self, transmitter: int, listener: int) -> float | None:
        """Distance of two motes; None if it is not within the usable range."""
        pair = transmitter, listener
        if pair not in self._distances_m:  # motes stand still
            places, facings = self.motes.positions_m, self.motes.facings
            way = places[listener] - places[transmitter]
            distance_m = float(np.linalg.norm(way))
            off = _off_axis(facings[transmitter], way), _off_axis(facings[listener], -way)
            reach_m = usable_reach(self._cfg.transducer, *off)
            if self._cfg.layout == "random":
                reach_m = min(reach_m, self._cfg.random.reach_m)
            is_within = self._cfg.transducer.nearest_m <= distance_m <= reach_m
            self._distances_m[pair] = distance_m if is_within else None
        return self._distances_m[pair]

    def listen(self, pairs: Sequence[tuple[int, int]], repeats: int, rng: np.random.Generator) -> list[MotePulse]:
        """Readings of pairs; a pair without reception is left out."""
        received = []
        for transmitter, listener in pairs:
            distance_m = self._received_from_m(transmitter, listener)
            if distance_m is None:
                continue
            delays_s = self._delays(distance_m, repeats, rng)
            if delays_s.size:
                received.append(MotePulse(transmitter, listener, delays_s, float(self._temperatures_c[listener])))
        return received

    def _delays(self, distance_m: float, repeats: int, rng: np.random.Generator) -> FloatArray:
        true = self._cfg.sim
        ways_m = np.full(repeats, distance_m)
        is_echo = rng.random(repeats) < true.multipath_probability
        ways_m[is_echo] += rng.exponential(true.multipath_excess_m, int(is_echo.sum()))
        ways_m += rng.normal(0.0, true.sigma_m, repeats)
        delays_s = self.delays_s(ways_m)
        return np.asarray(delays_s[rng.random(repeats) >= true.loss_probability])

    def delays_s(self, ways_m: FloatArray) -> FloatArray:
        """Delay of each pulse after its message, for path lengths ``ways_m``, rounded to the listener's clock."""
        true = self._cfg.sim
        delays_s = np.maximum(ways_m / self._sound_m_s + true.latency_s, 0.0)
        return np.asarray(np.round(delays_s / true.tick_s) * true.tick_s if true.tick_s > 0.0 else delays_s)


def usable_reach(transducer: TransducerConfig, off_transmitter_rad: float, off_listener_rad: float) -> float:
    """Largest distance of reception, m: reach(a) reach(b) / reach(0), with the angles a and b between axes and path.

    Both transducers have the same directivity: each multiplies the reach on the axis by reach(angle) / reach(0).
    Between the angles of the table the reach is linear, beyond them 0.
    """
    on_axis_m = transducer.reach_m[0]
    if transducer.is_omnidirectional or on_axis_m <= 0.0:
        return on_axis_m
    off = np.interp((off_transmitter_rad, off_listener_rad), transducer.off_axis_rad, transducer.reach_m, right=0.0)
    return float(off[0] * off[1] / on_axis_m)


def _off_axis(facing: FloatArray, way: FloatArray) -> float:
    """Angle between an axis and a path, rad; 0 for a mote that faces its peer."""
    length = float(np.linalg.norm(way))
    if not facing.any() or length <= 0.0:
        return 0.0
    return float(np.arccos(np.clip(facing @ way / length, -1.0, 1.0)))


_DIGITS = 9  # decimals of a delay, s, on the link: sound travels a third of a micrometre in a nanosecond


class MoteListener:
    """The listener on the robot; its configuration has its name and the number of motes that send in a frame."""

    def __init__(
        self, cfg: CricketConfig, listener: ListenerConfig, motes: TrueMotes, rng: np.random.Generator
    ) -> None:
        self._cfg, self._listener, self._motes, self._rng = cfg, listener, motes, rng
        self._field = MoteField(cfg, motes, rng)
        self._temperature_c = cfg.sim.temperature_c + float(rng.normal(0.0, cfg.sim.thermometer_sigma_c))
        self._sent = 0

    def receive(self, time_s: float, pose: TruePose) -> list[MoteBurst]:
        """Pulses of the frame that ends at ``time_s``."""
        count = len(self._motes.names)
        received: list[MoteBurst] = []
        for _ in range(self._listener.pulses_per_frame):
            sender, round_number = self._sent % count, self._sent // count
            self._sent += 1
            if round_number < self._listener.mapping_rounds:
                received += self._reports(time_s, sender)
            received += self._own(time_s, pose, sender)
        return received

    def _reports(self, time_s: float, sender: int) -> list[MoteBurst]:
        names = self._motes.names
        pairs = [(sender, other) for other in range(len(names)) if other != sender]
        found = self._field.listen(pairs, 1, self._rng)
        bursts = []
        for one in found:
            delays_s = [round(delay_s, _DIGITS) for delay_s in one.delays_s.tolist()]
            bursts.append(MoteBurst(time_s, names[sender], names[one.listener], round(one.temperature_c, 6), delays_s))
        return bursts

    def _own(self, time_s: float, pose: TruePose, sender: int) -> list[MoteBurst]:
        """The pulse at the robot's listener, which is omnidirectional; the mote is directional."""
        true, rng, cfg = self._cfg.sim, self._rng, self._cfg
        way = np.array((pose.x_m, pose.y_m)) - self._motes.positions_m[sender, :2]
        way_m = hypot(*way)
        # Always drawn, so that a pulse that is not received does not change the numbers of the following ones.
        noise, echo_m, is_echo, is_lost = rng.normal(), rng.exponential(), rng.random(), rng.random()
        reach_m = usable_reach(cfg.transducer, _off_axis(self._motes.facings[sender, :2], way), 0.0)
        if not cfg.transducer.nearest_m <= way_m <= reach_m or is_lost < true.loss_probability:
            return []
        if is_echo < true.multipath_probability:
            way_m += true.multipath_excess_m * float(echo_m)
        way_m += true.sigma_m * float(noise)
        delay_s = float(self._field.delays_s(np.array(way_m)))
        name = self._motes.names[sender]
        return [MoteBurst(time_s, name, self._listener.name, round(self._temperature_c, 6), [round(delay_s, _DIGITS)])]
