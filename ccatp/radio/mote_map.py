"""Pure. The batch map from ranges alone: starts, the robust fit, a look for folds, covariance."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ccatp.radio.map_batch import BatchFit, BatchSettings, fit_from_afar, position_covariance
from ccatp.radio.map_flips import Fold, unfold
from ccatp.radio.map_model import MapModel
from ccatp.radio.map_patches import stitched
from ccatp.radio.map_repair import repaired
from ccatp.radio.pair_means import PairMeans
from ccatp.radio.range_network import FloatArray, IntArray, RangeNetwork
from ccatp.radio.rigid_alignment import best_motion
from ccatp.radio.unfolding import unfolded

_SMALL = 130  # motes up to which the whole map is unfolded at once; beyond, it is stitched from patches
_NORMAL_MAD = 1.4826  # standard deviation over the median absolute deviation of a normal distribution
_SURE = 2.0  # a map whose cost per degree of freedom is less needs no other start
_CORRECTIONS = 3  # times that the unfolding is repeated with ranges corrected by the offset found


@dataclass(frozen=True, slots=True)
class MoteMap:
    """A map of motes.

    Attributes:
        names: of the n motes.
        positions_m: shape (n, d).
        covariance_m2: of all coordinates, shape (n d, n d); of the aligned map where nothing pins the frame.
        offset_m: common offset of the ranges.
        scale: common scale of the ranges, less one.
        cost: of all ranges, in units of chi-squared.
        dof: ranges less unknowns that they determine.
        residuals_m: measured less computed ranges, shape (m,).
        sigma_m: median of the sigmas in the end.
        iterations: steps of all fits.
        outliers: ranges of which the loss left less than half.
        free: directions that no range sees, the frame's included.
        folds: sets of motes whose mirror image fits almost as well.
    """

    names: tuple[str, ...]
    positions_m: FloatArray
    covariance_m2: FloatArray
    offset_m: float
    scale: float
    cost: float
    dof: int
    residuals_m: FloatArray
    sigma_m: float
    iterations: int
    outliers: int
    free: int
    folds: tuple[Fold, ...]

    @property
    def variance_factor(self) -> float:
        """Cost by degree of freedom: 1 where the sigmas are right."""
        return self.cost / self.dof if self.dof > 0 else 1.0


def map_motes(
    network: RangeNetwork,
    settings: BatchSettings,
    *,
    with_offset: bool = False,
    with_scale: bool = False,
    start_m: FloatArray | None = None,
    mirrors: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...] = (),
    finds_sigma: bool = False,
) -> MoteMap:
    """The map that fits all ranges best.

    A fit goes down to the nearest minimum, and most of them are folded maps. So it begins with the map unfolded from
    more dimensions (``unfolded``) or stitched from patches (``stitched``), and its mirror image where bodies tell them
    apart; then places that contradict their ranges are mapped anew (``repaired``), and motes that could stand on the
    other side are tried there (``unfold``).

    Args:
        network: the ranges.
        settings: of the fits.
        with_offset: estimate a common offset.
        with_scale: estimate a common scale.
        start_m: one more place to begin, shape (n, d), nan where unknown.
        mirrors: sets of motes that the graph lets fold, from ``find_fold_over``.
        finds_sigma: the sigmas are right up to a factor, which the residuals of a first map without robust loss tell.
    """
    if not finds_sigma:
        return _mapped(network, settings, with_offset, with_scale, start_m, mirrors)
    first = _mapped(network, settings._replace(robust_scale=float("inf")), with_offset, with_scale, start_m, mirrors)
    share = np.sqrt(len(network.ranges_m) / max(first.dof, 1))
    factor = share * _NORMAL_MAD * float(np.median(np.abs(first.residuals_m) / network.sigmas_m))
    scaled = replace(network, sigmas_m=network.sigmas_m * max(factor, 1e-9))
    return _mapped(scaled, settings, with_offset, with_scale, first.positions_m, mirrors)


def _mapped(
    network: RangeNetwork,
    settings: BatchSettings,
    with_offset: bool,
    with_scale: bool,
    start_m: FloatArray | None,
    mirrors: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...],
) -> MoteMap:
    model = MapModel(network, with_offset=with_offset, with_scale=with_scale)
    fits: list[BatchFit] = []
    for start in _starts(network, start_m):
        fits.append(fit_from_afar(model, model.state(start), settings))
        if _is_sure(model, fits[-1]):
            break
    for _ in range(_CORRECTIONS if with_offset or with_scale else 0):
        best = min(fits, key=lambda fit: fit.cost)
        if _is_sure(model, best):
            break
        # An offset bends the map that the unfolding begins with: once more, with what is known of it by now.
        ranges_m = np.maximum((network.ranges_m - best.state.offset_m) / (1.0 + best.state.scale), 0.0)
        for start in _starts(replace(network, ranges_m=ranges_m), None):
            state = model.state(start, best.state.offset_m, best.state.scale)
            fits.append(fit_from_afar(model, state, settings))
    best = min(fits, key=lambda fit: fit.cost)
    steps = sum(fit.iterations for fit in fits)
    found = unfold(model, repaired(model, best, settings), settings, mirrors)
    fit = found.fit
    covariance, free = position_covariance(model, fit)
    dof = len(network.ranges_m) - (model.size - free)
    return MoteMap(
        names=network.names,
        positions_m=fit.state.positions_m,
        covariance_m2=covariance,
        offset_m=fit.state.offset_m,
        scale=fit.state.scale,
        cost=fit.cost,
        dof=dof,
        residuals_m=fit.residuals_m,
        sigma_m=float(np.median(network.sigmas_m)),
        iterations=steps,
        outliers=int((fit.weights < 0.5).sum()),
        free=free,
        folds=found.doubtful,
    )


def _is_sure(model: MapModel, fit: BatchFit) -> bool:
    return fit.cost < _SURE * max(len(model.network.ranges_m) - model.size, 1)


def _starts(network: RangeNetwork, given_m: FloatArray | None) -> Iterator[FloatArray]:
    """Places to begin, the most promising first."""
    means = PairMeans(network)
    if network.count > _SMALL and not network.bodies:
        yield _filled(stitched(network.count, means, network.dimension), means)
    pairs, distances_m, sigmas_m = _with_bodies(network, means)
    whole = unfolded(network.count, pairs, distances_m, sigmas_m, network.dimension)
    flip = np.ones(network.dimension)
    flip[0] = -1.0
    known = np.isfinite(network.known_m).all(axis=1)
    if known.sum() > network.dimension:
        yield best_motion(whole[known], network.known_m[known], mirrors=True).apply(whole)
    else:
        yield whole
        yield whole * flip
    if given_m is not None:
        yield _filled(given_m, means)


def _filled(places_m: FloatArray, means: PairMeans) -> FloatArray:
    """Places with those that are missing put where their partners are on the average."""
    places = places_m.copy()
    for _ in range(len(places)):
        missing = np.flatnonzero(np.isnan(places[:, 0]))
        if missing.size == 0:
            break
        for mote in missing.tolist():
            partners = places[means.partners(mote)]
            known = partners[np.isfinite(partners[:, 0])] if len(partners) else partners
            if len(known):
                # Beside the mean: two motes in one place would have no direction between them.
                places[mote] = known.mean(axis=0) + 1e-3 * (1.0 + mote % 7)
    return np.nan_to_num(places)


def _with_bodies(network: RangeNetwork, means: PairMeans) -> tuple[IntArray, FloatArray, FloatArray]:
    """Pairs, distances and sigmas, the pairs of bodies among them as ranges of the best sigma there is."""
    pairs, distances, sigmas = [means.pairs], [means.ranges_m], [means.sigmas_m]
    for body in network.bodies:
        motes = np.array(body.motes, dtype=np.intp)
        a, b = np.triu_indices(len(motes), 1)
        pairs.append(np.column_stack([motes[a], motes[b]]))
        distances.append(np.linalg.norm(body.local_m[a] - body.local_m[b], axis=1))
        sigmas.append(np.full(len(a), float(means.sigmas_m.min())))
    return np.concatenate(pairs), np.concatenate(distances), np.concatenate(sigmas)
