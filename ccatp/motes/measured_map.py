"""Pure. A map from measured ranges: graph, outlook, filter or batch, and the error where the truth is known."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ccatp.config.cricket_models import CricketConfig
from ccatp.motes.fold_over import find_fold_over
from ccatp.motes.map_batch import BatchSettings
from ccatp.motes.map_model import MapModel
from ccatp.motes.map_warnings import disagreeing, doubts, flat, hidden_offset, is_flat, left_out_heights, untold
from ccatp.motes.mote_frame import plain_frame
from ccatp.motes.mote_map import map_motes
from ccatp.motes.phase_one import map_as_possible
from ccatp.motes.range_bound import bound_rms_m, map_rms_m
from ccatp.motes.range_network import (
    FloatArray,
    MappingError,
    RangeNetwork,
    RigidBody,
    TooFewRanges,
    UnknownMote,
    build_network,
    list_names,
)
from ccatp.motes.rigidity import find_freedom, generic_state
from ccatp.motes.self_mapping import MapperSettings, MoteMapper, run_phase_two
from ccatp.motes.tdoa import MoteRange
from ccatp.radio.rigid_alignment import aligned_rms_m, best_motion

_WIDER = 1e4  # of variances: what a range that is used twice adds by its first use is then a ten-thousandth

Places = Mapping[str, tuple[float, ...]]


class MeasuredRanges(NamedTuple):
    """Ranges as they were recorded.

    Attributes:
        readings: in their order.
        groups: names of motes that move together, by the name of their pose: tags of a trolley that stood there.
        tags: the tag that each of those motes is.
    """

    readings: tuple[MoteRange, ...]
    groups: Mapping[str, tuple[str, ...]]
    tags: Mapping[str, str]


class MeasuredMap(NamedTuple):
    """A map of real motes.

    Attributes:
        names, positions_m, covariance_m2: the map; moved onto the truth where that is known.
        true_m: shape (n, d), or None.
        data: as ``ccatp radio map --json`` prints it.
    """

    names: tuple[str, ...]
    positions_m: FloatArray
    covariance_m2: FloatArray
    true_m: FloatArray | None
    data: dict[str, Any]


class _Found(NamedTuple):
    positions_m: FloatArray
    covariance_m2: FloatArray
    network: RangeNetwork
    offset_m: float
    scale: float
    iterations: int
    is_trusted: bool
    warnings: tuple[str, ...]


def map_measured(
    cfg: CricketConfig, method: str, file: MeasuredRanges, tags_m: Places | None, truth_m: Places | None
) -> MeasuredMap:
    """Map what a file of ranges holds.

    Places of a trolley that stood somewhere are mapped along with the anchors, which are what the result is about.

    Args:
        cfg: dimension, sigma, settings of filter and batch.
        method: ``ekf`` or ``batch``.
        file: the ranges.
        tags_m: places of tags on their trolley, where known.
        truth_m: true places, where known, of any of the motes.

    Raises:
        MappingError: the ranges make no map, or the files do not fit each other.
    """
    network = _network(cfg, file, tags_m)
    rng = np.random.default_rng(0)
    model = MapModel(network, with_offset=cfg.batch.estimates_offset, with_scale=cfg.batch.estimates_scale)
    freedom = find_freedom(model, generic_state(model, rng))
    folds = find_fold_over(network, rng)
    _check_enough(model, network)
    found = _batch(cfg, network, folds.mirrors) if method == "batch" else _filter(cfg, network)
    motes = [row for row, name in enumerate(network.names) if name not in file.tags]
    names = tuple(network.names[mote] for mote in motes)
    true_m = None if truth_m is None else _truth(truth_m, names, network.dimension)
    places, covariance = _framed(found, motes, true_m)
    at_found = MapModel(found.network, with_offset=model.with_offset, with_scale=model.with_scale)
    error_m = None if true_m is None else aligned_rms_m(places, true_m, mirrors=True)
    expected_m = map_rms_m(found.covariance_m2, found.positions_m, motes, aligned=True)
    bound_m = bound_rms_m(at_found, found.positions_m, motes, aligned=True)
    warnings = [
        word
        for option, given in (("--tags", tags_m), ("--truth", truth_m))
        if given
        for word in left_out_heights(option, given, network.dimension, cfg.ranging.sigma_m)
    ]
    warnings += [*disagreeing(network), *folds.warnings, *found.warnings, *map(untold, freedom.untold)]
    # Derivatives at a place where they vanish: what comes out is large, and means that nothing is known.
    if is_thin := is_flat(bound_m, places) or (found.is_trusted and is_flat(expected_m, places)):
        warnings.append(flat(network.dimension))
    is_known = found.is_trusted and bound_m is not None and not is_thin
    data = {
        "rms_m": {"p10": error_m, "p50": error_m, "p90": error_m},
        "crlb_m": None if is_thin else bound_m,
        "rank_deficiency": freedom.deficiency,
        "fold_over_risk": not folds.is_unique,
        "phase1_rms_m": _phase1_error_m(cfg, network, motes, true_m),
        "iterations": found.iterations,
        "method": method,
        "seeds": 1,
        "motes": len(motes),
        "frame": "aligned",
        "expected_rms_m": expected_m if is_known else None,
        "offset_m": None if "offset" in freedom.untold else found.offset_m,
        "scale": None if "scale" in freedom.untold else 1.0 + found.scale,
        "free_directions": [*freedom.frame, *freedom.flexes, *freedom.calibration],
        "warnings": warnings,
    }
    return MeasuredMap(names, places, covariance, true_m, data)


def _network(cfg: CricketConfig, file: MeasuredRanges, tags_m: Places | None) -> RangeNetwork:
    names = tuple(dict.fromkeys(name for row in file.readings for name in (row.first, row.second)))
    if tags_m is None:
        return build_network(file.readings, cfg.dimension, names)
    if not file.groups:
        raise MappingError("--tags: these ranges are of no trolley; columns session, pos, deg, anchor, tag tell one")
    index = {name: row for row, name in enumerate(names)}
    bodies = []
    for pose, motes in file.groups.items():
        if unknown := [file.tags[mote] for mote in motes if file.tags[mote] not in tags_m]:
            raise UnknownMote(f"--tags: no place of {unknown[0]}; there are {list_names(list(tags_m))}")
        local = np.array([tags_m[file.tags[mote]][: cfg.dimension] for mote in motes], dtype=np.float64)
        bodies.append(RigidBody(pose, tuple(index[mote] for mote in motes), local))
    return build_network(file.readings, cfg.dimension, names, bodies)


def _check_enough(model: MapModel, network: RangeNetwork) -> None:
    d = network.dimension
    wanted = model.size - d * (d + 1) // 2
    measured = len(np.unique(np.sort(np.column_stack([network.first, network.second]), axis=1), axis=0))
    if network.count > 2 and measured < min(wanted, network.count):
        raise TooFewRanges(
            f"{measured} pairs of {network.count} motes were measured, a map in {d} dimensions has {wanted} unknowns; "
            "measure more pairs"
        )


def _batch(cfg: CricketConfig, network: RangeNetwork, mirrors: Any) -> _Found:
    settings = BatchSettings(cfg.batch.robust_scale, cfg.batch.max_iterations)
    found = map_motes(
        network,
        settings,
        with_offset=cfg.batch.estimates_offset,
        with_scale=cfg.batch.estimates_scale,
        mirrors=mirrors,
        finds_sigma=len(network.ranges_m) > 2 * network.count * network.dimension,
    )
    factor = found.sigma_m / float(np.median(network.sigmas_m))
    scaled = RangeNetwork(
        network.names, network.dimension, network.first, network.second,
        network.ranges_m, network.sigmas_m * factor, network.bodies, network.known_m,
    )  # fmt: skip
    warnings = [*hidden_offset(found, scaled, settings)] if not cfg.batch.estimates_offset else []
    warnings += doubts(found, network, factor)
    is_denied = found.agreement.is_denied
    # Of a map that its ranges deny, at least what they miss it by.
    inflation = float(((found.residuals_m / scaled.sigmas_m) ** 2).sum()) / found.dof if is_denied else 1.0
    return _Found(
        found.positions_m, inflation * found.covariance_m2, scaled, found.offset_m, found.scale, found.iterations,
        not is_denied, tuple(warnings),
    )  # fmt: skip


def _filter(cfg: CricketConfig, network: RangeNetwork) -> _Found:
    """Trilateration, then every range once."""
    if network.bodies:
        raise MappingError("the filter knows no trolleys: leave --tags out, or take --method batch")
    first = map_as_possible(network, cfg.phase1.max_dop)
    if first.unplaced:
        lost = list_names([network.names[mote] for mote in first.unplaced])
        raise MappingError(f"trilateration cannot place {lost}; take --method batch, which needs no such start")
    # The ranges have made the first map already: its shape is a start, and its covariance, taken wide, hardly counts.
    settings = MapperSettings(
        cfg.phase2.linearisations, cfg.phase2.pools, cfg.phase2.gate_probability, cfg.phase2.target_rms_m
    )
    mapper = MoteMapper(first.positions_m, _WIDER * first.covariance_m2, settings)
    rows = zip(
        network.first.tolist(),
        network.second.tolist(),
        network.ranges_m.tolist(),
        network.sigmas_m.tolist(),
        strict=True,
    )
    went = run_phase_two(mapper, rows, 0.0)
    warnings = (f"{went.refused} of {len(went.nis)} ranges were refused by the gate",) if went.refused else ()
    return _Found(mapper.positions_m, mapper.covariance_m2, network, 0.0, 0.0, len(went.nis), True, warnings)


def _phase1_error_m(
    cfg: CricketConfig, network: RangeNetwork, motes: list[int], true_m: FloatArray | None
) -> float | None:
    if true_m is None:
        return None
    try:
        first = map_as_possible(network, cfg.phase1.max_dop)
    except MappingError:
        return None
    if set(first.unplaced) & set(motes):
        return None
    return aligned_rms_m(first.positions_m[motes], true_m, mirrors=True)


def _framed(found: _Found, motes: list[int], true_m: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """The motes that count, moved onto the truth or into a frame of their own."""
    d = found.positions_m.shape[1]
    places = found.positions_m[motes]
    at = (np.array(motes)[:, None] * d + np.arange(d)).ravel()
    motion = plain_frame(places) if true_m is None else best_motion(places, true_m, mirrors=True)
    return motion.moved(places), motion.turned_map(found.covariance_m2[np.ix_(at, at)])


def _truth(truth_m: Places, names: tuple[str, ...], dimension: int) -> FloatArray:
    if lost := [name for name in names if name not in truth_m]:
        raise UnknownMote(f"--truth: no place of {list_names(lost)}; there are {list_names(list(truth_m))}")
    if short := [name for name in names if len(truth_m[name]) < dimension]:
        raise MappingError(f"--truth: {short[0]} has {len(truth_m[short[0]])} coordinates, wanted {dimension}")
    return np.array([truth_m[name][:dimension] for name in names], dtype=np.float64)
