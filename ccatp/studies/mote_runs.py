"""Self-mapping of one simulated field by filter or batch, and its error against the truth.

One simulated field of motes: the truth, and all ranges that phases 1 and 2 are given.
"""

from dataclasses import dataclass
from itertools import cycle, islice
from typing import NamedTuple

import numpy as np

from ccatp.beacons.cricket.map_fit import MapFitSettings, MapModel, bound_rms_m, map_rms_m
from ccatp.beacons.cricket.mote_map import MoteMap, map_motes, pinned_map, plain_frame
from ccatp.beacons.cricket.range_network import MappingError, MoteRange, RangeNetwork, build_network, pair_range
from ccatp.beacons.cricket.rigidity import FoldOver, Freedom, find_fold_over, find_freedom, generic_state
from ccatp.beacons.cricket.self_mapping import (
    MoteMapper,
    MotePlan,
    complete_stands,
    loose_plan,
    mapper_settings,
    network_plan,
    printed_prior,
    run_phase_two,
)
from ccatp.beacons.cricket.trilateration import FirstMap, map_as_possible, map_by_plan
from ccatp.config.beacon_models import CricketConfig
from ccatp.core import FloatArray
from ccatp.filters.metrics import aligned_rms_m, best_motion, rms_m
from ccatp.sim.motes import MoteField, MotePulse, true_motes

_LAYOUT, _FIELD, _READINGS = 0, 1, 2  # streams of random numbers of one seed


@dataclass(frozen=True, slots=True)
class SimulatedField:
    """What happened in one field.

    Attributes:
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

    Raises:
        MappingError: no pair of phase 2 hears each other.
    """
    motes = true_motes(cfg, np.random.default_rng((seed, _LAYOUT)))
    plan = network_plan(cfg) if cfg.layout == "networks" else loose_plan(cfg, motes.names)
    field = MoteField(cfg, motes, np.random.default_rng((seed, _FIELD)))
    rng = np.random.default_rng((seed, _READINGS))
    first = tuple(_range(cfg, plan, heard) for heard in field.listen(plan.phase1_pairs, cfg.ranging.repeats, rng))
    pairs = [pair for pair in plan.phase2_pairs if field.receives(*pair)]
    if not pairs:
        raise MappingError("no pair of phase 2 hears each other; enlarge cricket.transducer or turn the motes")
    second = []
    for heard in field.listen(list(islice(cycle(pairs), cfg.phase2.max_updates)), 1, rng):
        reading = _range(cfg, plan, heard)
        second.append((heard.transmitter, heard.listener, reading.range_m, reading.sigma_m))
    return SimulatedField(plan, motes.positions_m, first, tuple(second))


def _range(cfg: CricketConfig, plan: MotePlan, heard: MotePulse) -> MoteRange:
    names = plan.names[heard.transmitter], plan.names[heard.listener]
    return pair_range(cfg, names, heard.delays_s, heard.temperature_c)


_GENERIC = 0  # seed of the random places of rank and fold-over: they must not depend on the run


@dataclass(frozen=True, slots=True)
class MoteRun:
    """One self-mapping.

    Attributes:
        names, positions_m, covariance_m2, true_m: of the motes that were mapped; the truth in the same frame.
        rms_m: error; after the best rigid motion where ``is_aligned``.
        phase1_rms_m: the same of phase 1; None where it could not place all motes.
        trace_m: error after each update, phase 1 first; of the batch just both.
        is_aligned: whether the frame was free.
        doubtful: rows of motes whose mirror image fits as well, or that hang on too few ranges.
        whole: the map with all motes of the stands, by name; the same motes where there are no others.
    """

    names: tuple[str, ...]
    positions_m: FloatArray
    covariance_m2: FloatArray
    true_m: FloatArray
    rms_m: float
    phase1_rms_m: float | None
    expected_rms_m: float
    iterations: int
    trace_m: FloatArray
    expected_trace_m: FloatArray
    is_aligned: bool
    offset_m: float
    scale: float
    nis: FloatArray
    doubtful: tuple[int, ...]
    whole: "NamedMap"


class NamedMap(NamedTuple):
    """Motes with names: what a beacon file holds."""

    names: tuple[str, ...]
    positions_m: FloatArray
    covariance_m2: FloatArray


@dataclass(frozen=True, slots=True)
class MoteOutlook:
    """What the ranges can tell, said before anything is estimated.

    Attributes:
        bound_rms_m: Cramér-Rao bound at the true places; None where something stays free.
    """

    freedom: Freedom
    folds: FoldOver
    bound_rms_m: float | None


def first_map(cfg: CricketConfig, field: SimulatedField, draws: int = 0) -> FirstMap:
    """Phase 1; where its bias and covariance are of use, by so many draws.

    Raises:
        MappingError: a step that cannot be made.
    """
    network = field.network()
    if field.plan.networks:
        return map_by_plan(field.plan, network, cfg.phase1.max_dop, draws)
    return map_as_possible(network, cfg.phase1.max_dop, draws)


def run_filter(cfg: CricketConfig, field: SimulatedField) -> MoteRun:
    """Phases 1 and 2: trilateration, then the filter over distances between the first motes of the stands.

    Raises:
        MappingError: phase 1 cannot place a mote.
    """
    plan, first = field.plan, first_map(cfg, field, cfg.phase1.draws)
    motes = list(plan.heads or plan.mapped)
    if lost := [plan.names[mote] for mote in motes if mote in first.unplaced]:
        raise MappingError(f"phase 1 cannot place {lost[0]} (and {len(lost) - 1} more); the batch needs no such start")
    d = plan.dimension
    at = (np.array(motes)[:, None] * d + np.arange(d)).ravel()
    known, places = plan.surveyed_m[motes], first.positions_m[motes]
    mean = places + first.bias_m[motes]
    covariance = first.covariance_m2[np.ix_(at, at)]
    if cfg.phase2.prior == "printed":
        covariance = printed_prior(
            len(motes), d, np.flatnonzero(np.isfinite(known.ravel())).tolist(), cfg.phase2.printed_variance_m2
        )
        mean = places
    mapper = MoteMapper(mean, covariance, mapper_settings(cfg), known)
    index = {mote: row for row, mote in enumerate(motes)}
    readings = [(index[i], index[j], range_m, sigma_m) for i, j, range_m, sigma_m in field.second]
    went = run_phase_two(mapper, readings, cfg.phase2.target_rms_m)
    aligned = bool(np.isnan(known).all())
    true_m = field.true_m[motes]
    trace = np.array([_error_m(found, true_m, aligned) for found in went.positions_m])
    return MoteRun(
        names=tuple(plan.names[mote] for mote in motes),
        positions_m=mapper.positions_m,
        covariance_m2=mapper.covariance_m2,
        true_m=true_m,
        rms_m=float(trace[-1]),
        phase1_rms_m=_error_m(places, true_m, aligned),
        expected_rms_m=float(went.expected_rms_m[-1]),
        iterations=len(went.nis),
        trace_m=trace,
        expected_trace_m=went.expected_rms_m,
        is_aligned=aligned,
        offset_m=mapper.offset_m,
        scale=mapper.scale,
        nis=went.nis,
        doubtful=(),
        whole=_whole(field, first, mapper),
    )


def _whole(field: SimulatedField, first: FirstMap, mapper: MoteMapper) -> NamedMap:
    plan = field.plan
    if not plan.networks:
        return NamedMap(plan.names, mapper.positions_m, mapper.covariance_m2)
    whole = complete_stands(plan, first.positions_m, first.covariance_m2, mapper.positions_m, mapper.covariance_m2)
    names = tuple(plan.names[mote] for mote in whole.motes)
    return NamedMap(names, whole.positions_m, whole.covariance_m2)


def run_batch(cfg: CricketConfig, field: SimulatedField, outlook: MoteOutlook | None = None) -> MoteRun:
    """The batch over all ranges of both phases; its error after the best rigid motion.

    Args:
        outlook: of the same graph, for the sets of motes that may fold.

    Raises:
        MappingError: the ranges make no map.
    """
    plan = field.plan
    network = batch_network(cfg, field)
    try:
        first = first_map(cfg, field)
    except MappingError:  # the batch needs no trilateration
        first = None
    found = map_motes(
        network,
        batch_settings(cfg),
        with_offset=cfg.batch.estimates_offset,
        with_scale=cfg.batch.estimates_scale,
        start_m=None if first is None else first.positions_m,
        mirrors=() if outlook is None else outlook.folds.mirrors,
    )
    motes = list(plan.mapped)
    true_m = field.true_m[motes]
    laid = None
    if first is not None and not set(motes) & set(first.unplaced):
        laid = aligned_rms_m(first.positions_m[motes], true_m, mirrors=not plan.anchors)
    positions, covariance = _in_field(cfg, field, found)
    d = plan.dimension
    at = (np.array(motes)[:, None] * d + np.arange(d)).ravel()
    error_m = aligned_rms_m(positions[motes], true_m, mirrors=not plan.bodies)
    expected_m = map_rms_m(found.covariance_m2, found.positions_m, motes, aligned=True)
    names = tuple(plan.names[mote] for mote in motes)
    return MoteRun(
        names=names,
        positions_m=positions[motes],
        covariance_m2=covariance[np.ix_(at, at)],
        true_m=true_m,
        rms_m=error_m,
        phase1_rms_m=laid,
        expected_rms_m=expected_m,
        iterations=found.iterations,
        trace_m=np.array([error_m if laid is None else laid, error_m]),
        expected_trace_m=np.array([expected_m]),
        is_aligned=True,
        offset_m=found.offset_m,
        scale=found.scale,
        nis=np.zeros(0),
        doubtful=_doubtful(found, outlook, motes),
        whole=NamedMap(names, positions[motes], covariance[np.ix_(at, at)]),
    )


def _doubtful(found: MoteMap, outlook: MoteOutlook | None, motes: list[int]) -> tuple[int, ...]:
    sets = [fold.motes for fold in found.folds]
    sets += [moved for _, moved in outlook.folds.mirrors] if outlook is not None else []
    lost = {mote for moved in sets for mote in moved}
    return tuple(row for row, mote in enumerate(motes) if mote in lost)


def batch_network(cfg: CricketConfig, field: SimulatedField) -> RangeNetwork:
    """The graph that the batch uses: ranges of phases 1 and 2 and shapes of the stands, as the configuration says."""
    return field.network(with_second=cfg.batch.uses_phase2, with_shapes=cfg.batch.uses_shapes)


def batch_settings(cfg: CricketConfig) -> MapFitSettings:
    """How the batch fits."""
    return MapFitSettings(cfg.batch.robust_scale, cfg.batch.max_iterations)


def look_ahead(cfg: CricketConfig, field: SimulatedField, method: str, updates: int | None = None) -> MoteOutlook:
    """Rank, folds and bound of what a method is given.

    For the filter, rank and folds are those of phase 2 alone, as the stands see each other; its bound takes in what
    phase 1 measured too, unless the printed prior throws that away.

    Args:
        field: the ranges; their values are not looked at.
        method: ``ekf`` or ``batch``.
        updates: ranges of phase 2 that count; all if ``None``.
    """
    plan = field.plan
    rng = np.random.default_rng(_GENERIC)
    options = {"with_offset": cfg.batch.estimates_offset, "with_scale": cfg.batch.estimates_scale}
    if method == "batch":
        network = batch_network(cfg, field)
        model = MapModel(network, **options)
        bound = bound_rms_m(model, field.true_m, plan.mapped, aligned=True)
        return MoteOutlook(find_freedom(model, generic_state(model, rng)), find_fold_over(network, rng), bound)
    motes = list(plan.heads or plan.mapped)
    known = plan.surveyed_m
    second = _part(field, motes, known, updates)
    model = MapModel(second, **options)
    freedom, folds = find_freedom(model, generic_state(model, rng)), find_fold_over(second, rng)
    aligned = bool(np.isnan(known).all())
    if cfg.phase2.prior == "printed":
        return MoteOutlook(freedom, folds, bound_rms_m(model, field.true_m[motes], range(len(motes)), aligned=aligned))
    whole = MapModel(_with_known(field, updates), **options)
    return MoteOutlook(freedom, folds, bound_rms_m(whole, field.true_m, motes, aligned=aligned))


def _part(field: SimulatedField, motes: list[int], known: FloatArray, updates: int | None) -> RangeNetwork:
    """The graph of phase 2 alone. Motes that it does not tie together are no error here: that is what is asked."""
    index = {mote: row for row, mote in enumerate(motes)}
    rows = field.second[:updates]
    return RangeNetwork(
        names=tuple(field.plan.names[mote] for mote in motes),
        dimension=field.plan.dimension,
        first=np.array([index[row[0]] for row in rows], dtype=np.intp),
        second=np.array([index[row[1]] for row in rows], dtype=np.intp),
        ranges_m=np.array([row[2] for row in rows]),
        sigmas_m=np.array([row[3] for row in rows]),
        bodies=(),
        known_m=known[motes],
    )


def _with_known(field: SimulatedField, updates: int | None) -> RangeNetwork:
    cut = SimulatedField(field.plan, field.true_m, field.first, field.second[:updates])
    whole = cut.network(with_second=True)
    return RangeNetwork(
        whole.names,
        whole.dimension,
        whole.first,
        whole.second,
        whole.ranges_m,
        whole.sigmas_m,
        (),
        field.plan.surveyed_m,
    )


def _in_field(cfg: CricketConfig, field: SimulatedField, found: MoteMap) -> tuple[FloatArray, FloatArray]:
    """The map in the field's frame, as far as the operator knows it."""
    plan = field.plan
    if not plan.anchors:
        motion = plain_frame(found.positions_m)
        return motion.moved(found.positions_m), motion.turned_map(found.covariance_m2)
    up = plan.axes_m[1] / np.linalg.norm(plan.axes_m[1])
    origin, axis = plan.anchors
    way = found.positions_m[axis] - found.positions_m[origin]
    wanted = np.array([plan.axes_m[0], plan.axes_m[0] + up * np.linalg.norm(way)])
    motion = best_motion(found.positions_m[[origin, axis]], wanted)
    positions, covariance = motion.moved(found.positions_m), motion.turned_map(found.covariance_m2)
    if np.isfinite(plan.surveyed_m).sum() == 3:
        return pinned_map(positions, covariance, plan.surveyed_m)
    return positions, covariance


def _error_m(found_m: FloatArray, true_m: FloatArray, aligned: bool) -> float:
    return aligned_rms_m(found_m, true_m, mirrors=True) if aligned else rms_m(found_m, true_m)
