"""A map from measured ranges by filter or batch, with warnings, the error if the true positions are known, a report."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc

from ccatp.beacons.config.models import CricketConfig
from ccatp.beacons.cricket.map_fit import (
    MapFitSettings,
    MapModel,
    MapState,
    agreement_of,
    bound_rms_m,
    fit_map,
    map_rms_m,
)
from ccatp.beacons.cricket.mote_map import Mirrors, MoteMap, map_motes, plain_frame
from ccatp.beacons.cricket.range_network import (
    MappingError,
    MoteRange,
    PairMeans,
    RangeNetwork,
    RigidBody,
    build_network,
    coordinates_of,
    every_pair,
)
from ccatp.beacons.cricket.rigidity import find_fold_over, find_freedom, generic_state
from ccatp.beacons.cricket.self_mapping import MoteMapper, run_phase_two
from ccatp.beacons.estimation.track_review import next_range
from ccatp.beacons.rigid_motion import aligned_rms_m, best_motion
from ccatp.core import FloatArray
from ccatp.errors import listed

_SIGNIFICANT = 12.0  # decrease of chi-squared by one offset; by chance once in two thousand
_CHANCE = 1e-4  # probability over all pairs that correct ranges of one pair disagree as much
_SCATTER = 1.5  # factor of the sigmas above which a warning is given
_MOST_ADVISED = 200  # largest number of motes for which the next pair is advised: every pair is evaluated
_FOLDS = 5  # sets of motes that are listed
_SHAPES = ", or the places of --tags are wrong"
_IN_SPACE = ", or the motes are not in a plane: --dimension 3 maps them in space"


def _disagreeing(network: RangeNetwork) -> Iterator[str]:
    """A warning that names the pair whose repeated ranges contradict each other most, if more than by chance."""
    means = PairMeans(network)
    squares = np.bincount(means.pair_of, ((network.ranges_m - means.ranges_m[means.pair_of]) / network.sigmas_m) ** 2)
    chances = chdtrc(np.maximum(np.bincount(means.pair_of) - 1, 1), squares)
    if not (bad := np.flatnonzero(chances < _CHANCE / len(means.pairs))).size:
        return
    worst = int(bad[np.argmax(squares[bad])])
    is_worst = means.pair_of == worst
    ranges_m, more = network.ranges_m[is_worst], f" and {bad.size - 1} more pairs" if bad.size > 1 else ""
    first, second = (network.names[mote] for mote in means.pairs[worst])
    yield (
        f"ranges between {first} and {second}{more} disagree among themselves: {ranges_m.min():.4g} to "
        f"{ranges_m.max():.4g} m with a sigma of {network.sigmas_m[is_worst].min():.3g} m"
    )


def _doubts(found: MoteMap, network: RangeNetwork, factor: float) -> Iterator[str]:
    """Warnings of folds, contradictions, scatter and outliers of a batch map.

    ``factor``: sigmas found from the residuals, over the given ones.
    """
    for fold in found.folds[:_FOLDS]:
        motes = listed([network.names[mote] for mote in fold.motes])
        yield f"{motes}: the mirror image fits almost as well (chi-squared {fold.cost_gap:.1f} more)"
    in_space = _SHAPES if network.bodies else ""
    in_space += _IN_SPACE if network.dimension == 2 else ""
    rows, count = found.agreement.outlying, len(network.ranges_m)
    if found.agreement.is_denied:
        yield (
            f"the map contradicts its ranges: {len(rows)} of {count} far off it, chi-squared "
            f"{found.agreement.factor:.1f} for each degree of freedom of the others; it is folded, or the sigmas are "
            f"too small{in_space}"
        )
    elif rows:
        pairs = [f"{network.names[network.first[row]]} to {network.names[network.second[row]]}" for row in rows]
        yield f"{len(rows)} of {count} ranges contradict the others and count for little: {listed(pairs)}"
    if factor > _SCATTER:
        yield (
            f"ranges scatter by {1e3 * found.sigma_m:.3g} mm, {factor:.1f} times what they were taken for: they are "
            f"worse{in_space}"
        )


def _hidden_offset(found: MoteMap, network: RangeNetwork, settings: MapFitSettings) -> Iterator[str]:
    """A warning that the ranges have a common offset, for a map that estimates none.

    ``network``: with the estimated sigmas.
    """
    model = MapModel(network, with_offset=True)
    dof = len(network.ranges_m) - model.size
    if dof <= 0:
        return
    state = model.state(found.positions_m, 0.0, found.fit.state.scale)
    without, shown = fit_map(MapModel(network), state, settings), fit_map(model, state, settings)
    agreement = agreement_of(shown, network.sigmas_m, dof)
    if found.agreement.is_denied:
        # The offset may have bent the map so far that a fit from there does not find it.
        again = map_motes(network, settings, with_offset=True)
        shown, agreement = again.fit, again.agreement
    # If the map with an offset still contradicts its ranges, the better fit proves nothing: any extra unknown helps.
    if without.cost - shown.cost > _SIGNIFICANT and not agreement.is_denied:
        yield (
            f"all ranges look {1e3 * shown.state.offset_m:.0f} mm long in common (chi-squared {without.cost:.0f}, "
            f"{shown.cost:.0f} with an offset); --offset estimates it"
        )


def _left_out_heights(
    option: str, places_m: Mapping[str, tuple[float, ...]], dimension: int, least_m: float
) -> Iterator[str]:
    """A warning that a planar map ignores third coordinates, if these differ by more than ``least_m``."""
    heights_m = [place[2] for place in places_m.values() if len(place) > dimension]
    if heights_m and (spread_m := max(heights_m) - min(heights_m)) > least_m:
        yield (
            f"{option}: z_m, which differs by {spread_m:.3g} m, is not used for a map in 2 dimensions; --dimension 3 "
            "maps in space"
        )


def _is_flat(error_m: float | None, places_m: FloatArray) -> bool:
    """Whether the expected error exceeds the least extent of the map (root mean square); positions of shape (n, d)."""
    extents_m = np.linalg.svd(places_m - places_m.mean(axis=0), compute_uv=False) / np.sqrt(len(places_m))
    return error_m is not None and bool((extents_m[: len(places_m) - 1] < error_m).any())


_WIDER = 1e4  # factor of the prior variances: ranges are used twice, and their first use then counts a ten-thousandth

Places = Mapping[str, tuple[float, ...]]


class MeasuredRanges(NamedTuple):
    """Ranges as they were recorded.

    ``groups``: for each pose of a trolley, the names of its tags there; they form a rigid body. ``tags``: the tag of
    each such name.
    """

    readings: tuple[MoteRange, ...]
    groups: Mapping[str, tuple[str, ...]]
    tags: Mapping[str, str]


class MeasuredMap(NamedTuple):
    """A map of real motes."""

    names: tuple[str, ...]
    positions_m: FloatArray
    covariance_m2: FloatArray
    true_m: FloatArray | None  # shape (n, d), or None
    data: dict[str, Any]  # as ``ccatp radio map --json`` prints it


class _Found(NamedTuple):
    state: MapState
    covariance_m2: FloatArray
    network: RangeNetwork
    iterations: int
    is_trusted: bool
    warnings: tuple[str, ...]


def map_measured(
    cfg: CricketConfig, method: str, file: MeasuredRanges, tags_m: Places | None, truth_m: Places | None
) -> MeasuredMap:
    """Map the motes of a file of ranges.

    The poses of a trolley are estimated together with the anchors; the result reports only the anchors. ``method``:
    ``ekf`` or ``batch``. Raises MappingError: the ranges give no map, or the files contradict each other.
    """
    network = _network(cfg, file, tags_m)
    rng = np.random.default_rng(0)
    model = MapModel(network, with_offset=cfg.batch.estimates_offset, with_scale=cfg.batch.estimates_scale)
    freedom = find_freedom(model, generic_state(model, rng))
    folds = find_fold_over(network, rng)
    _check_enough(model, network)
    if method == "ekf" and network.bodies:
        raise MappingError("the filter maps no trolleys: leave --tags out, or take --method batch")
    found = _batch(cfg, network, folds.mirrors)
    found = _filter(cfg, network, found) if method == "ekf" else found
    motes = [row for row, name in enumerate(network.names) if name not in file.tags]
    names = tuple(network.names[mote] for mote in motes)
    true_m = None if truth_m is None else _truth(truth_m, names, network.dimension)
    places, at = found.state.positions_m[motes], coordinates_of(motes, network.dimension)
    motion = plain_frame(places) if true_m is None else best_motion(places, true_m, mirrors=True)
    places, covariance = motion.moved(places), motion.turned_map(found.covariance_m2[np.ix_(at, at)])
    at_found = MapModel(found.network, with_offset=model.with_offset, with_scale=model.with_scale)
    error_m = None if true_m is None else aligned_rms_m(places, true_m, mirrors=True)
    expected_m = map_rms_m(found.covariance_m2, found.state.positions_m, motes, aligned=True)
    bound_m = bound_rms_m(at_found, found.state.positions_m, motes, aligned=True)
    warnings = [
        word
        for option, given in (("--tags", tags_m), ("--truth", truth_m))
        if given
        for word in _left_out_heights(option, given, network.dimension, cfg.ranging.sigma_m)
    ]
    warnings += [*_disagreeing(network), *folds.warnings, *found.warnings]
    warnings += [
        f"no {name} can be determined from these ranges: the map takes it up, and its own size is free; "
        f"leave --{name} out"
        for name in freedom.undetermined
    ]
    # If the motes are in line, the derivatives across it vanish. The large error there means only: undetermined.
    if is_thin := _is_flat(bound_m, places) or (found.is_trusted and _is_flat(expected_m, places)):
        shape = "in a line" if network.dimension == 2 else "in a plane"
        warnings.append(f"the motes lie {shape}, or nearly: the ranges do not determine how far each is off it")
    is_known = found.is_trusted and bound_m is not None and not is_thin
    data = {
        "rms_m": {"p10": error_m, "p50": error_m, "p90": error_m},
        "crlb_m": None if is_thin else bound_m,
        "rank_deficiency": freedom.deficiency,
        "fold_over_risk": not folds.is_unique,
        "phase1_rms_m": None,
        "iterations": found.iterations,
        "method": method,
        "seeds": 1,
        "motes": len(motes),
        "frame": "aligned",
        "expected_rms_m": expected_m if is_known else None,
        "measure_next": _next_pair(names, places, covariance, cfg.ranging.sigma_m) if is_known else None,
        "offset_m": None if "offset" in freedom.undetermined else found.state.offset_m,
        "scale": None if "scale" in freedom.undetermined else 1.0 + found.state.scale,
        "frame_directions": list(freedom.frame),
        "free_directions": freedom.lines,
        "warnings": warnings,
    }
    return MeasuredMap(names, places, covariance, true_m, data)


def _next_pair(
    names: Sequence[str], places: FloatArray, covariance: FloatArray, sigma_m: float
) -> dict[str, Any] | None:
    """The pair whose range would reduce the expected error most."""
    if len(names) > _MOST_ADVISED:
        return None
    ends = every_pair(np.arange(len(names)))
    found = next_range(places, covariance, ends, places[ends[:, 0]] - places[ends[:, 1]], np.full(len(ends), sigma_m))
    if found is None:
        return None
    return {"pair": [names[end] for end in found.ends], "map_m": found.before_m, "after_m": found.after_m}


def _network(cfg: CricketConfig, file: MeasuredRanges, tags_m: Places | None) -> RangeNetwork:
    names = tuple(dict.fromkeys(name for row in file.readings for name in (row.first, row.second)))
    if tags_m is None:
        return build_network(file.readings, cfg.dimension, names)
    if not file.groups:
        raise MappingError("--tags: these ranges are of no trolley; columns session, pos, deg, anchor, tag make one")
    index = {name: row for row, name in enumerate(names)}
    bodies = []
    for pose, motes in file.groups.items():
        if unknown := [file.tags[mote] for mote in motes if file.tags[mote] not in tags_m]:
            raise MappingError(f"--tags: no place of {unknown[0]}; there are {listed(list(tags_m))}")
        local = np.array([tags_m[file.tags[mote]][: cfg.dimension] for mote in motes], dtype=np.float64)
        bodies.append(RigidBody(pose, tuple(index[mote] for mote in motes), local))
    return build_network(file.readings, cfg.dimension, names, bodies)


def _check_enough(model: MapModel, network: RangeNetwork) -> None:
    d = network.dimension
    wanted = model.size - d * (d + 1) // 2
    measured = len(np.unique(network.pairs, axis=0))
    if network.count > 2 and measured < min(wanted, network.count):
        raise MappingError(
            f"{measured} pairs of {network.count} motes were measured, a map in {d} dimensions has {wanted} unknowns; "
            "measure more pairs"
        )


def _batch(cfg: CricketConfig, network: RangeNetwork, mirrors: Mirrors) -> _Found:
    settings = MapFitSettings(cfg.batch.robust_scale, cfg.batch.max_iterations)
    found = map_motes(
        network, settings, with_offset=cfg.batch.estimates_offset, with_scale=cfg.batch.estimates_scale,
        mirrors=mirrors, finds_sigma=len(network.ranges_m) > 2 * network.count * network.dimension,
    )  # fmt: skip
    factor = found.sigma_m / float(np.median(network.sigmas_m))
    scaled = replace(network, sigmas_m=network.sigmas_m * factor)
    warnings = [*_hidden_offset(found, scaled, settings)] if not cfg.batch.estimates_offset else []
    warnings += _doubts(found, network, factor)
    is_denied = found.agreement.is_denied
    # If the map contradicts its ranges, its covariance is at least scaled by the residuals.
    inflation = float(((found.fit.residuals_m / scaled.sigmas_m) ** 2).sum()) / found.dof if is_denied else 1.0
    covariance = inflation * found.covariance_m2
    return _Found(found.fit.state, covariance, scaled, found.iterations, not is_denied, tuple(warnings))


def _filter(cfg: CricketConfig, network: RangeNetwork, first: _Found) -> _Found:
    places_m = first.state.positions_m
    if _is_flat(map_rms_m(first.covariance_m2, places_m, range(network.count), aligned=True), places_m):
        shape = "in a line" if network.dimension == 2 else "in a plane"
        raise MappingError(f"the motes lie {shape}, or nearly: the filter has no beginning; take --method batch")
    # The first map was made from the same ranges. So only its shape is used: the prior covariance is made very large.
    mapper = MoteMapper(places_m, _WIDER * first.covariance_m2, cfg.phase2)
    columns = (network.first, network.second, network.ranges_m, network.sigmas_m)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    went = run_phase_two(mapper, rows, 0.0)
    refused = (f"{went.refused} of {len(went.nis)} ranges were refused by the gate",) if went.refused else ()
    state, warnings = MapState(mapper.positions_m), (*first.warnings, *refused)
    return _Found(state, mapper.covariance_m2, network, len(went.nis), first.is_trusted, warnings)


def _truth(truth_m: Places, names: tuple[str, ...], dimension: int) -> FloatArray:
    if lost := [name for name in names if name not in truth_m]:
        raise MappingError(f"--truth: no place of {listed(lost)}; there are {listed(list(truth_m))}")
    if short := [name for name in names if len(truth_m[name]) < dimension]:
        raise MappingError(f"--truth: {short[0]} has {len(truth_m[short[0]])} coordinates, wanted {dimension}")
    return np.array([truth_m[name][:dimension] for name in names], dtype=np.float64)


def report_lines(data: dict[str, Any]) -> Iterator[str]:
    """What ``ccatp radio map`` prints without ``--json``: first what the ranges determine, then what was found.

    ``data``: as ``--json`` prints it.
    """
    yield f"{data['motes']} motes, {data['method']}, frame {data['frame']}, {data['seeds']} runs"
    yield ""
    yield "what the ranges determine"
    yield f"  free directions of the frame       {', '.join(data['frame_directions']) or 'none'}"
    yield f"  free directions beyond the frame   {data['rank_deficiency']}"
    for line in data["free_directions"]:
        yield f"    {line}"
    yield f"  other maps fit as well             {'yes' if data['fold_over_risk'] else 'no'}"
    yield f"  least error (Cramér-Rao)           {_mm(data['crlb_m'])}"
    yield ""
    yield "what was found"
    yield f"  after phase 1                      {_mm(data['phase1_rms_m'])}"
    rms = data["rms_m"]
    yield f"  error, median (10 to 90 %)         {_mm(rms['p50'])} ({_mm(rms['p10'])} to {_mm(rms['p90'])})"
    if data.get("motes_in_doubt"):
        yield f"  uncertain motes                    {data['motes_in_doubt']}"
        yield f"  error of the others                {_mm(data['rms_of_others_m'])}"
    yield f"  expected by the estimator          {_mm(data['expected_rms_m'])}"
    if (advice := data.get("measure_next")) is not None:
        pair, after_m = " to ".join(advice["pair"]), advice["after_m"]
        yield f"  measure next                       {pair}: {_mm(advice['map_m'])} expected becomes {_mm(after_m)}"
    yield f"  updates or steps                   {data['iterations']}"
    if data["offset_m"] != 0.0:
        yield f"  common offset of the ranges        {_mm(data['offset_m'])}"
    if data["scale"] != 1.0:
        scale = "unknown" if data["scale"] is None else f"{data['scale']:.6f}"
        yield f"  common scale of the ranges         {scale}"


def _mm(value_m: float | None) -> str:
    return "unknown" if value_m is None else f"{1e3 * value_m:.3g} mm"
