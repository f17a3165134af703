"""Pure. What the robot's listener gets of motes: their pulses, and at first what they report of each other.

The motes send one after the other, round by round; who hears a pulse hears it at once. Reports are not lost.
"""

from math import hypot, sqrt

import numpy as np

from ccatp.config.beacon_models import ListenerConfig
from ccatp.config.cricket_models import CricketConfig
from ccatp.samples import FloatArray
from ccatp.sim.motes.layout import TrueMotes
from ccatp.sim.motes.ranging import MoteField, usable_reach
from ccatp.sim.radio.frame import TruePose
from ccatp.wire.beacon_frame import MoteBurst

_ABSOLUTE_ZERO_C = -273.15
_DIGITS = 9  # of a delay on the link: a nanosecond is a third of a micrometre


class RobotEars:
    """Hears frame by frame.

    Args:
        cfg: transducers, air, the true faults of ranging.
        listener: who the robot is to the motes, and how many send in a frame.
        motes: where they are.
        rng: of thermometers, noise, losses, echoes.
    """

    def __init__(
        self, cfg: CricketConfig, listener: ListenerConfig, motes: TrueMotes, rng: np.random.Generator
    ) -> None:
        self._cfg, self._listener, self._motes, self._rng = cfg, listener, motes, rng
        self._field = MoteField(cfg, motes, rng)
        true = cfg.sim
        self._temperature_c = true.temperature_c + float(rng.normal(0.0, true.thermometer_sigma_c))
        ratio = (true.temperature_c - _ABSOLUTE_ZERO_C) / (cfg.air.temperature_c - _ABSOLUTE_ZERO_C)
        self._sound_m_s = cfg.air.sound_speed_m_s * sqrt(ratio)
        self._sent = 0

    def hear(self, time_s: float, pose: TruePose) -> list[MoteBurst]:
        """Pulses of the frame that ends now."""
        count = len(self._motes.names)
        heard: list[MoteBurst] = []
        for _ in range(self._listener.pulses_per_frame):
            sender, round_number = self._sent % count, self._sent // count
            self._sent += 1
            if round_number < self._listener.mapping_rounds:
                heard += self._reports(time_s, sender)
            heard += self._own(time_s, pose, sender)
        return heard

    def _reports(self, time_s: float, sender: int) -> list[MoteBurst]:
        names = self._motes.names
        pairs = [(sender, other) for other in range(len(names)) if other != sender]
        found = self._field.listen(pairs, 1, self._rng)
        return [
            MoteBurst(time_s, names[sender], names[one.listener], round(one.temperature_c, 6), _rounded(one.delays_s))
            for one in found
        ]

    def _own(self, time_s: float, pose: TruePose, sender: int) -> list[MoteBurst]:
        """The robot's listener hears all round; the mote has its cone."""
        true, rng, cfg = self._cfg.sim, self._rng, self._cfg
        dx, dy = pose.x_m - self._motes.positions_m[sender, 0], pose.y_m - self._motes.positions_m[sender, 1]
        way_m = hypot(dx, dy)
        # Drawn whatever becomes of it, so that one pulse more or less does not change all that follow.
        noise, echo_m, is_echo, is_lost = rng.normal(), rng.exponential(), rng.random(), rng.random()
        reach_m = usable_reach(cfg.transducer, self._off_axis(sender, dx, dy), 0.0)
        if not cfg.transducer.nearest_m <= way_m <= reach_m or is_lost < true.loss_probability:
            return []
        if is_echo < true.multipath_probability:
            way_m += true.multipath_excess_m * float(echo_m)
        way_m += true.sigma_m * float(noise)
        delay_s = max(way_m / self._sound_m_s + true.latency_s, 0.0)
        if true.tick_s > 0.0:
            delay_s = round(delay_s / true.tick_s) * true.tick_s
        name = self._motes.names[sender]
        return [MoteBurst(time_s, name, self._listener.name, round(self._temperature_c, 6), [round(delay_s, _DIGITS)])]

    def _off_axis(self, sender: int, dx: float, dy: float) -> float:
        facing = self._motes.facings[sender]
        way_m = hypot(dx, dy)
        if not facing.any() or way_m <= 0.0:
            return 0.0
        return float(np.arccos(np.clip((facing[0] * dx + facing[1] * dy) / way_m, -1.0, 1.0)))


def _rounded(delays_s: FloatArray) -> list[float]:
    return [round(float(delay_s), _DIGITS) for delay_s in delays_s]
