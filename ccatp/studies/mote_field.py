"""Pure. One simulated field of motes: the truth, and all ranges that phases 1 and 2 are given."""

from dataclasses import dataclass
from itertools import cycle, islice

import numpy as np

from ccatp.config.cricket_models import CricketConfig
from ccatp.motes.mote_plan import MotePlan, loose_plan, network_plan
from ccatp.motes.mote_ranges import pair_range
from ccatp.motes.range_network import FloatArray, MappingError, RangeNetwork, build_network
from ccatp.motes.tdoa import MoteRange
from ccatp.sim.motes.layout import true_motes
from ccatp.sim.motes.ranging import Heard, MoteField

_LAYOUT, _FIELD, _READINGS = 0, 1, 2  # streams of random numbers of one seed


@dataclass(frozen=True, slots=True)
class SimulatedField:
    """What happened in one field.

    Attributes:
        plan: what the operator knows.
        true_m: places of all motes, shape (n, d).
        first: ranges of phase 1, repeated as configured.
        second: single ranges in the order of phase 2, first, second, range_m, sigma_m.
    """

    plan: MotePlan
    true_m: FloatArray
    first: tuple[MoteRange, ...]
    second: tuple[tuple[int, int, float, float], ...]

    def network(self, *, with_second: bool = False, with_shapes: bool = False) -> RangeNetwork:
        """The graph of phase 1, with what phase 2 measured and the shapes of the stands where asked.

        Raises:
            MappingError: of these ranges no map can be made.
        """
        names = self.plan.names
        rows = list(self.first)
        if with_second:
            rows += [MoteRange(names[i], names[j], range_m, sigma_m) for i, j, range_m, sigma_m in self.second]
        return build_network(rows, self.plan.dimension, names, self.plan.bodies if with_shapes else ())


def simulate_field(cfg: CricketConfig, seed: int) -> SimulatedField:
    """Draw the errors of one field and everything that its motes hear.

    Args:
        cfg: the motes.
        seed: of everything that is drawn.

    Raises:
        MappingError: no pair of phase 2 hears each other.
    """
    motes = true_motes(cfg, np.random.default_rng((seed, _LAYOUT)))
    plan = network_plan(cfg) if cfg.layout == "networks" else loose_plan(cfg, motes.names)
    field = MoteField(cfg, motes, np.random.default_rng((seed, _FIELD)))
    rng = np.random.default_rng((seed, _READINGS))
    first = tuple(_range(cfg, plan, heard) for heard in field.listen(plan.phase1_pairs, cfg.ranging.repeats, rng))
    pairs = [pair for pair in plan.phase2_pairs if field.hears(*pair)]
    if not pairs:
        raise MappingError("no pair of phase 2 hears each other; enlarge cricket.transducer or turn the motes")
    second = []
    for heard in field.listen(list(islice(cycle(pairs), cfg.phase2.max_updates)), 1, rng):
        reading = _range(cfg, plan, heard)
        second.append((heard.transmitter, heard.listener, reading.range_m, reading.sigma_m))
    return SimulatedField(plan, motes.positions_m, first, tuple(second))


def _range(cfg: CricketConfig, plan: MotePlan, heard: Heard) -> MoteRange:
    names = plan.names[heard.transmitter], plan.names[heard.listener]
    return pair_range(cfg, names, heard.delays_s, heard.temperature_c)
