"""Self-mapping of simulated fields of motes by filter or batch: one field, or many of one configuration."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import cycle, islice
from typing import Any, NamedTuple

import numpy as np

from ccatp.beacons.config.models import CricketConfig
from ccatp.beacons.cricket.map_fit import MapFitSettings, MapModel, bound_rms_m, map_rms_m
from ccatp.beacons.cricket.mote_map import MoteMap, map_motes, pinned_map, plain_frame
from ccatp.beacons.cricket.mote_plan import MotePlan, loose_plan, network_plan
from ccatp.beacons.cricket.range_network import (
    MappingError,
    MoteRange,
    RangeNetwork,
    build_network,
    coordinates_of,
    pair_range,
)
from ccatp.beacons.cricket.rigidity import FoldOver, Freedom, find_fold_over, find_freedom, generic_state
from ccatp.beacons.cricket.self_mapping import begin_phase_two, complete_stands, run_phase_two
from ccatp.beacons.cricket.trilateration import FirstMap, map_by_plan
from ccatp.beacons.report.plots import MapPicture, Traces
from ccatp.beacons.rigid_motion import RigidMotion, aligned_rms_m, best_motion, rms_m
from ccatp.beacons.sim.motes import MoteField, MotePulse, true_motes
from ccatp.core import FloatArray

_LAYOUT, _FIELD, _READINGS = 0, 1, 2  # streams of random numbers of one seed
_GENERIC = 0  # seed of the random positions for rank and fold-over, which must not depend on the run
_KNOWN_M2 = 1e-14  # variance below which a coordinate is known
_LINED = 100  # largest number of motes for which the figure shows the measured pairs


@dataclass(frozen=True, slots=True)
class SimulatedField:
    """One simulated field of motes: the truth, and all ranges for phases 1 and 2."""

    plan: MotePlan
    true_m: FloatArray  # places of all motes, shape (n, d)
    first: tuple[MoteRange, ...]  # of phase 1, repeated as configured
    second: tuple[MoteRange, ...]  # of phase 2, in its order

    def network(self, *, with_second: bool = False, with_shapes: bool = False) -> RangeNetwork:
        """The graph of phase 1, optionally with phase 2 and known stands. Raises MappingError: they give no map."""
        rows = [*self.first, *(self.second if with_second else ())]
        return build_network(rows, self.plan.dimension, self.plan.names, self.plan.bodies if with_shapes else ())


def simulate_field(cfg: CricketConfig, seed: int) -> SimulatedField:
    """Draw the errors and all ranges of one field. Raises MappingError: no pair of phase 2 has a range."""
    motes = true_motes(cfg, np.random.default_rng((seed, _LAYOUT)))
    plan = network_plan(cfg) if cfg.layout == "networks" else loose_plan(cfg, motes.names)
    field = MoteField(cfg, motes, np.random.default_rng((seed, _FIELD)))
    rng = np.random.default_rng((seed, _READINGS))

    def reading(pulse: MotePulse) -> MoteRange:
        names = plan.names[pulse.transmitter], plan.names[pulse.listener]
        return pair_range(cfg, names, pulse.delays_s, pulse.temperature_c)

    first = tuple(reading(pulse) for pulse in field.listen(plan.phase1_pairs, cfg.ranging.repeats, rng))
    pairs = [pair for pair in plan.phase2_pairs if field.receives(*pair)]
    if not pairs:
        raise MappingError("no pair of phase 2 receives each other; enlarge cricket.transducer or turn the motes")
    pulses = field.listen(list(islice(cycle(pairs), cfg.phase2.max_updates)), 1, rng)
    return SimulatedField(plan, motes.positions_m, first, tuple(map(reading, pulses)))


@dataclass(frozen=True, slots=True)
class MoteRun:
    """One self-mapping: the estimated and the true positions in the same frame."""

    names: tuple[str, ...]
    positions_m: FloatArray
    covariance_m2: FloatArray
    true_m: FloatArray
    phase1_rms_m: float | None  # error of phase 1; None where it could not place all motes
    trace_m: FloatArray  # error after phase 1 and after each update; of the batch after phase 1 and at the end
    expected_trace_m: FloatArray
    is_aligned: bool  # whether the frame was free: all errors are those after the best rigid motion
    iterations: int
    offset_m: float
    scale: float
    nis: FloatArray = field(default_factory=lambda: np.zeros(0))
    doubtful: tuple[int, ...] = ()  # rows of motes whose mirror image fits as well, or that have too few ranges
    whole: tuple[tuple[str, ...], FloatArray, FloatArray] | None = None  # all motes of the stands, if there are others

    @property
    def rms_m(self) -> float:
        """Final error."""
        return float(self.trace_m[-1])

    @property
    def expected_rms_m(self) -> float:
        """Final error that the covariance of the map predicts."""
        return float(self.expected_trace_m[-1])

    @property
    def nees(self) -> float | None:
        """NEES per degree of freedom of all unknown coordinates; None if the frame was free."""
        if self.is_aligned:
            return None
        values, vectors = np.linalg.eigh(self.covariance_m2)
        is_open = values > _KNOWN_M2
        across = (self.positions_m - self.true_m).ravel() @ vectors[:, is_open]
        return float((across**2 / values[is_open]).mean())


@dataclass(frozen=True, slots=True)
class MoteOutlook:
    """Rank and folds of the ranges, and the Cramér-Rao bound at the true positions; None if a direction is free."""

    freedom: Freedom
    folds: FoldOver
    bound_rms_m: float | None


def first_map(cfg: CricketConfig, field: SimulatedField, draws: int = 0) -> FirstMap:
    """Phase 1: trilateration of the stands, with bias and covariance from ``draws``; without stands the batch map.

    Raises MappingError: a step fails.
    """
    plan, network = field.plan, field.network()
    if plan.bodies:
        return map_by_plan(plan, network, cfg.phase1.max_dop, draws)
    mirrors = find_fold_over(network, np.random.default_rng(_GENERIC)).mirrors
    found = map_motes(network, _settings(cfg), **_calibration(cfg), mirrors=mirrors)
    nowhere, doubtful = np.zeros_like(found.positions_m), found.doubtful(mirrors)
    return FirstMap(found.positions_m, found.covariance_m2, nowhere, doubtful=doubtful)


def run_filter(cfg: CricketConfig, field: SimulatedField) -> MoteRun:
    """Phases 1 and 2: a first map, then the filter over distances between the first motes of the stands.

    Raises MappingError: phase 1 cannot place a mote.
    """
    plan, first = field.plan, first_map(cfg, field, cfg.phase1.draws)
    motes = list(plan.heads or plan.mapped)
    mapper = begin_phase_two(cfg, plan, first)
    index = {plan.names[mote]: row for row, mote in enumerate(motes)}
    readings = [(index[one.first], index[one.second], one.range_m, one.sigma_m) for one in field.second]
    went = run_phase_two(mapper, readings, cfg.phase2.target_rms_m)
    aligned = bool(np.isnan(plan.surveyed_m[motes]).all())
    true_m = field.true_m[motes]
    whole = None
    if plan.bodies:
        every = complete_stands(plan, first, mapper)
        whole = tuple(plan.names[mote] for mote in every.motes), every.positions_m, every.covariance_m2
    return MoteRun(
        names=tuple(plan.names[mote] for mote in motes),
        positions_m=mapper.positions_m,
        covariance_m2=mapper.covariance_m2,
        true_m=true_m,
        phase1_rms_m=_error_m(first.positions_m[motes], true_m, aligned),
        trace_m=np.array([_error_m(found, true_m, aligned) for found in went.positions_m]),
        expected_trace_m=went.expected_rms_m,
        is_aligned=aligned,
        iterations=len(went.nis),
        offset_m=mapper.offset_m,
        scale=mapper.scale,
        nis=went.nis,
        doubtful=tuple(motes.index(mote) for mote in first.doubtful),
        whole=whole,
    )


def run_batch(cfg: CricketConfig, field: SimulatedField, outlook: MoteOutlook | None = None) -> MoteRun:
    """The batch map from all ranges of both phases, with its error after the best rigid motion.

    ``outlook``: of the same graph; it has the sets of motes that may be mirrored. Raises MappingError: the ranges give
    no map.
    """
    plan = field.plan
    network = batch_network(cfg, field)
    first = None
    with suppress(MappingError):  # the batch needs no trilateration
        first = first_map(cfg, field) if plan.bodies else None
    start_m = None if first is None else first.positions_m
    mirrors = () if outlook is None else outlook.folds.mirrors
    found = map_motes(network, _settings(cfg), **_calibration(cfg), start_m=start_m, mirrors=mirrors)
    motes = list(plan.mapped)
    true_m = field.true_m[motes]
    phase1_m = None
    if first is not None:
        phase1_m = aligned_rms_m(first.positions_m[motes], true_m, mirrors=not plan.anchors)
    positions, covariance = _in_field(field, found, has_shapes=bool(network.bodies))
    positions, covariance = positions[motes], _block(covariance, motes, plan.dimension)
    error_m = aligned_rms_m(positions, true_m, mirrors=not plan.bodies)
    lost = found.doubtful(mirrors)
    return MoteRun(
        names=tuple(plan.names[mote] for mote in motes),
        positions_m=positions,
        covariance_m2=covariance,
        true_m=true_m,
        phase1_rms_m=phase1_m,
        trace_m=np.array([error_m if phase1_m is None else phase1_m, error_m]),
        expected_trace_m=np.array([map_rms_m(found.covariance_m2, found.positions_m, motes, aligned=True)]),
        is_aligned=True,
        iterations=found.iterations,
        offset_m=found.fit.state.offset_m,
        scale=found.fit.state.scale,
        doubtful=tuple(row for row, mote in enumerate(motes) if mote in lost),
    )


def _settings(cfg: CricketConfig) -> MapFitSettings:
    return MapFitSettings(cfg.batch.robust_scale, cfg.batch.max_iterations)


def _calibration(cfg: CricketConfig) -> Any:
    return {"with_offset": cfg.batch.estimates_offset, "with_scale": cfg.batch.estimates_scale}


def _block(covariance_m2: FloatArray, motes: list[int], dimension: int) -> FloatArray:
    at = coordinates_of(motes, dimension)
    return covariance_m2[np.ix_(at, at)]


def batch_network(cfg: CricketConfig, field: SimulatedField) -> RangeNetwork:
    """The graph for the batch; the configuration selects the ranges of phase 2 and the shapes of the stands."""
    return field.network(with_second=cfg.batch.uses_phase2, with_shapes=cfg.batch.uses_shapes)


def look_ahead(cfg: CricketConfig, field: SimulatedField, method: str, updates: int | None = None) -> MoteOutlook:
    """Rank, folds and bound for the data of a method, ``ekf`` or ``batch``, up to ``updates`` ranges of phase 2.

    For the filter, rank and folds are those of phase 2 alone. Its bound includes the ranges of phase 1, unless the
    printed prior discards their information.
    """
    plan = field.plan
    rng = np.random.default_rng(_GENERIC)
    options = _calibration(cfg)
    if method == "batch":
        network = batch_network(cfg, field)
        model = MapModel(network, **options)
        bound = bound_rms_m(model, field.true_m, plan.mapped, aligned=True)
        return MoteOutlook(find_freedom(model, generic_state(model, rng)), find_fold_over(network, rng), bound)
    motes = list(plan.heads or plan.mapped)
    known = plan.surveyed_m
    rows, names = field.second[:updates], [plan.names[mote] for mote in motes]
    second = build_network(rows, plan.dimension, names, (), known[motes], is_whole=False)
    model = MapModel(second, **options)
    freedom, folds = find_freedom(model, generic_state(model, rng)), find_fold_over(second, rng)
    aligned = bool(np.isnan(known).all())
    if cfg.phase2.prior == "printed":
        return MoteOutlook(freedom, folds, bound_rms_m(model, field.true_m[motes], range(len(motes)), aligned=aligned))
    both = replace(field, second=field.second[:updates]).network(with_second=True)
    whole = MapModel(replace(both, bodies=(), known_m=known), **options)
    return MoteOutlook(freedom, folds, bound_rms_m(whole, field.true_m, motes, aligned=aligned))


def _in_field(field: SimulatedField, found: MoteMap, *, has_shapes: bool) -> tuple[FloatArray, FloatArray]:
    """The map in the frame of the field, as far as an operator knows this frame.

    Without shapes, ranges cannot distinguish a map from its mirror image. Then the first stand is to the right of the
    axis from A to B, as in phase 1.
    """
    plan, places_m, covariance_m2 = field.plan, found.positions_m, found.covariance_m2
    if not plan.anchors:
        motion = plain_frame(places_m)
        return motion.moved(places_m), motion.turned_map(covariance_m2)
    up = plan.axes_m[1] / np.linalg.norm(plan.axes_m[1])
    origin, axis = plan.anchors
    way, head = places_m[[axis, plan.heads[0]]] - places_m[origin]
    if not has_shapes and way[0] * head[1] > way[1] * head[0]:
        mirror = RigidMotion(np.diag((-1.0, 1.0)), np.zeros(2))
        places_m, covariance_m2 = mirror.moved(places_m), mirror.turned_map(covariance_m2)
    wanted = np.array([plan.axes_m[0], plan.axes_m[0] + up * np.linalg.norm(way)])
    motion = best_motion(places_m[[origin, axis]], wanted)
    positions, covariance = motion.moved(places_m), motion.turned_map(covariance_m2)
    if np.isfinite(plan.surveyed_m).sum() == 3:
        return pinned_map(positions, covariance, plan.surveyed_m)
    return positions, covariance


def _error_m(found_m: FloatArray, true_m: FloatArray, aligned: bool) -> float:
    return aligned_rms_m(found_m, true_m, mirrors=True) if aligned else rms_m(found_m, true_m)


# -- many fields of one configuration ---------------------------------------------------------------------------------


class MoteCampaign(NamedTuple):
    """Runs of one configuration; ``outlook`` is of the first seed's graph, bounds at the median number of updates."""

    method: str
    runs: tuple[MoteRun, ...]
    outlook: MoteOutlook
    field: SimulatedField


def run_campaign(
    cfg: CricketConfig, method: str, seeds: Sequence[int], on_done: Callable[[int], None] = lambda _: None
) -> MoteCampaign:
    """Map the motes once for each seed, by ``ekf`` or ``batch``. Raises MappingError: a field gives no map."""
    field = simulate_field(cfg, seeds[0])
    outlook = look_ahead(cfg, field, method)
    runs = []
    for done, seed in enumerate(seeds, start=1):
        drawn = field if seed == seeds[0] else simulate_field(cfg, seed)
        # Random layouts differ between seeds, and so do their folds.
        known = outlook if cfg.layout != "random" or seed == seeds[0] else look_ahead(cfg, drawn, method)
        runs.append(run_filter(cfg, drawn) if method == "ekf" else run_batch(cfg, drawn, known))
        on_done(done)
    if method == "ekf":
        updates = int(np.median([run.iterations for run in runs]))
        outlook = look_ahead(cfg, field, method, max(updates, 1))
    return MoteCampaign(method, tuple(runs), outlook, field)


def campaign_data(campaign: MoteCampaign) -> dict[str, Any]:
    """What ``ccatp radio map --json`` prints."""
    runs, outlook = campaign.runs, campaign.outlook

    def median(of: Callable[[MoteRun], float | None]) -> float | None:
        known = [value for run in runs if (value := of(run)) is not None]
        return float(np.median(known)) if known else None

    return {
        "rms_m": percentiles([run.rms_m for run in runs]),
        "crlb_m": outlook.bound_rms_m,
        "rank_deficiency": outlook.freedom.deficiency,
        "fold_over_risk": not outlook.folds.is_unique,
        "phase1_rms_m": median(lambda run: run.phase1_rms_m),
        "iterations": int(np.median([run.iterations for run in runs])),
        "method": campaign.method,
        "seeds": len(runs),
        "motes": len(runs[0].names),
        "frame": "aligned" if runs[0].is_aligned else "surveyed",
        "rms_of_all_m": float(np.sqrt(np.mean([run.rms_m**2 for run in runs]))),
        "motes_in_doubt": int(np.median([len(run.doubtful) for run in runs])),
        "rms_of_others_m": median(sure_rms_m),
        "expected_rms_m": median(lambda run: run.expected_rms_m),
        "offset_m": median(lambda run: run.offset_m),
        "scale": 1.0 + float(np.median([run.scale for run in runs])),
        "frame_directions": list(outlook.freedom.frame),
        "free_directions": outlook.freedom.lines,
        "warnings": list(outlook.folds.warnings),
    }


def sure_rms_m(run: MoteRun) -> float:
    """Error of the motes that are not doubtful, in the frame of the run; NaN if there are too few."""
    sure = [row for row in range(len(run.names)) if row not in run.doubtful]
    found, true = run.positions_m[sure], run.true_m[sure]
    if not run.is_aligned:
        return rms_m(found, true)
    return aligned_rms_m(found, true, mirrors=True) if len(sure) > true.shape[1] else float("nan")


def percentiles(values: Sequence[float]) -> dict[str, float]:
    """The 10, 50 and 90 % quantiles."""
    return dict(zip(("p10", "p50", "p90"), np.percentile(values, (10, 50, 90)).tolist(), strict=True))


def pictured(campaign: MoteCampaign, seed: int) -> tuple[MapPicture, Traces | None]:
    """The map of the first run and, for the filter, the errors against updates."""
    run = campaign.runs[0]
    title = f"{campaign.method}, {len(run.names)} motes, seed {seed}, error {1e3 * run.rms_m:.3g} mm"
    positions_m, covariance_m2 = run.positions_m, run.covariance_m2
    if run.is_aligned:  # its frame is arbitrary: move it onto the truth for display
        motion = best_motion(run.positions_m, run.true_m, mirrors=True)
        positions_m, covariance_m2 = motion.moved(positions_m), motion.turned_map(covariance_m2)
    pairs = np.array(_pairs(campaign, run), dtype=np.intp).reshape(-1, 2)
    picture = MapPicture(run.names, positions_m, covariance_m2, run.true_m, pairs, run.doubtful, title)
    if campaign.method != "ekf":
        return picture, None
    # A run that ended early keeps its last error.
    longest = max(len(one.trace_m) for one in campaign.runs)
    errors, expected = (
        np.array([np.pad(trace, (0, longest - len(trace)), mode="edge") for trace in traces])
        for traces in ([one.trace_m for one in campaign.runs], [one.expected_trace_m for one in campaign.runs])
    )
    low, middle, high = np.percentile(errors, (10, 50, 90), axis=0)
    bound_m = campaign.outlook.bound_rms_m
    return picture, Traces(low, middle, high, np.median(expected, axis=0), bound_m, len(campaign.runs))


def _pairs(campaign: MoteCampaign, run: MoteRun) -> list[tuple[int, int]]:
    """Pairs of mapped motes with ranges, in phase 2 for the filter, in phase 1 for the batch."""
    field = campaign.field
    if len(run.names) > _LINED:
        return []
    row = {name: number for number, name in enumerate(run.names)}
    readings = field.second if campaign.method == "ekf" else field.first
    ends = {(reading.first, reading.second) for reading in readings}
    return sorted((row[a], row[b]) for a, b in ends if a in row and b in row)
