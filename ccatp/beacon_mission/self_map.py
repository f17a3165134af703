"""Pure. The map that motes make of themselves before a robot drives by it: phase 1, phase 2, then what it is worth."""

import numpy as np

from ccatp.config.cricket_models import CricketConfig
from ccatp.filters.base import FloatArray
from ccatp.motes.mote_plan import network_plan
from ccatp.motes.mote_ranges import pair_range
from ccatp.motes.phase_one import map_by_plan
from ccatp.motes.range_network import build_network
from ccatp.motes.self_mapping import MoteMapper, mapper_settings, printed_prior
from ccatp.motes.tdoa import MoteRange
from ccatp.wire.beacon_frame import MoteBurst


class SelfMap:
    """Collects what motes report of each other until the map is good enough.

    Phase 1 begins when every pair of its plan has been read as often as configured, phase 2 takes the readings after
    that one by one (Patil et al., figure 8).

    Args:
        cfg: the motes, layout ``networks``; nothing of ``sim`` is used.

    Attributes:
        names: of the motes on the map, the first of each stand.
        notes: errors that are expected after each phase, m; updates of phase 2.
    """

    def __init__(self, cfg: CricketConfig) -> None:
        """Nothing heard."""
        self._cfg, self._plan = cfg, network_plan(cfg)
        names, heads = self._plan.names, self._plan.heads
        self._index = {name: mote for mote, name in enumerate(names)}
        self.names = tuple(names[mote] for mote in heads)
        self._row_of = {mote: row for row, mote in enumerate(heads)}
        self._wanted = {frozenset(pair) for pair in self._plan.phase1_pairs}
        self._second = {frozenset(pair) for pair in self._plan.phase2_pairs}
        self._delays: dict[frozenset[int], list[float]] = {}
        self._temperatures: dict[frozenset[int], list[float]] = {}
        self._mapper: MoteMapper | None = None
        self.notes: dict[str, float] = {}

    @property
    def is_done(self) -> bool:
        """Good enough, or as good as it gets with the readings there may be."""
        phase2, mapper = self._cfg.phase2, self._mapper
        if mapper is None:
            return False
        return mapper.expected_rms_m <= phase2.target_rms_m or self.notes["map_updates"] >= phase2.max_updates

    @property
    def places(self) -> tuple[FloatArray, FloatArray] | None:
        """Positions (n, 2) and their joint covariance (2 n, 2 n); ``None`` before phase 1."""
        return None if self._mapper is None else (self._mapper.positions_m, self._mapper.covariance_m2)

    def take(self, burst: MoteBurst) -> None:
        """A pulse from one mote to another; those of others are none of ours.

        Raises:
            MappingError: phase 1 cannot be made of these ranges.
            TdoaError: a delay or a temperature that none can be.
        """
        first, second = self._index.get(burst.sender), self._index.get(burst.listener)
        if first is None or second is None or self.is_done:
            return
        pair = frozenset((first, second))
        if self._mapper is not None:
            self._refine(self._mapper, pair, burst)
        elif pair in self._wanted:
            self._delays.setdefault(pair, []).extend(burst.delays_s)
            self._temperatures.setdefault(pair, []).extend([burst.temperature_c] * len(burst.delays_s))
            repeats = self._cfg.ranging.repeats
            if all(len(self._delays.get(wanted, ())) >= repeats for wanted in self._wanted):
                self._mapper = self._lay_out()

    def _lay_out(self) -> MoteMapper:
        """Phase 1: trilateration; then the prior of phase 2."""
        cfg, plan = self._cfg, self._plan
        rows: list[MoteRange] = []
        for i, j in plan.phase1_pairs:
            pair = frozenset((i, j))
            temperature_c = float(np.mean(self._temperatures[pair]))
            rows.append(pair_range(cfg, (plan.names[i], plan.names[j]), self._delays[pair], temperature_c))
        laid = map_by_plan(plan, build_network(rows, plan.dimension, plan.names), cfg.phase1.max_dop, cfg.phase1.draws)
        motes, d = list(plan.heads), plan.dimension
        at = (np.array(motes)[:, None] * d + np.arange(d)).ravel()
        known, covariance = plan.surveyed_m[motes], laid.covariance_m2[np.ix_(at, at)]
        mean = (laid.positions_m + laid.bias_m)[motes]
        if cfg.phase2.prior == "printed":
            fixed = np.flatnonzero(np.isfinite(known.ravel())).tolist()
            covariance = printed_prior(len(motes), d, fixed, cfg.phase2.printed_variance_m2)
        mapper = MoteMapper(mean, covariance, mapper_settings(cfg), known)
        self.notes = {"map_phase1_expected_m": mapper.expected_rms_m, "map_updates": 0.0}
        self._note(mapper)
        return mapper

    def _refine(self, mapper: MoteMapper, pair: frozenset[int], burst: MoteBurst) -> None:
        """Phase 2: each distance between first motes of two stands corrects the places of both."""
        if pair not in self._second:
            return
        i, j = sorted(pair)
        for delay_s in burst.delays_s:
            reading = pair_range(self._cfg, (burst.sender, burst.listener), [delay_s], burst.temperature_c)
            mapper.observe(self._row_of[i], self._row_of[j], reading.range_m, reading.sigma_m)
            self.notes["map_updates"] += 1.0
        self._note(mapper)

    def _note(self, mapper: MoteMapper) -> None:
        self.notes["map_expected_m"] = mapper.expected_rms_m
