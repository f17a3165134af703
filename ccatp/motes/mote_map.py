"""Pure. The batch map from ranges alone: starts, the robust fit, a look for folds, covariance."""

from dataclasses import dataclass, replace

import numpy as np

from ccatp.motes.map_agreement import Agreement, agreement_of
from ccatp.motes.map_batch import BatchFit, BatchSettings, fit_from_afar, fit_map, position_covariance
from ccatp.motes.map_flips import Fold, unfold
from ccatp.motes.map_model import MapModel, MapState
from ccatp.motes.map_repair import repaired
from ccatp.motes.map_search import scaled, searched
from ccatp.motes.map_starts import FEW, map_starts
from ccatp.motes.range_network import FloatArray, RangeNetwork

_SURE = 2.0  # a map whose cost per degree of freedom is less needs no other start
_SAME = 1e-6  # relative difference of costs that are the same minimum's
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
        agreement: of the ranges with the map.
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
    agreement: Agreement
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
        finds_sigma: the sigmas are right up to a factor, which the residuals tell (``scaled``).
    """
    model = MapModel(network, with_offset=with_offset, with_scale=with_scale)
    if finds_sigma:
        plain = settings._replace(robust_scale=float("inf"))
        first = min(_all_fits(model, start_m, plain), key=lambda fit: fit.cost)
        _, model, fit = scaled(model, first, settings)
        fits = [fit]
        if not _is_sure(model, fit) and not _is_sound(model, fit):
            fits += _all_fits(model, fit.state.positions_m, settings)
    else:
        fits = _all_fits(model, start_m, settings)
    return _unfolded_map(model, fits, settings, mirrors)


def _all_fits(model: MapModel, start_m: FloatArray | None, settings: BatchSettings) -> list[BatchFit]:
    """Fits from all starts that it takes, with an offset or a scale known better and better."""
    network = model.network
    fits = _fits(model, network, start_m, settings)
    best: BatchFit | None = None
    for _ in range(_CORRECTIONS if model.with_offset or model.with_scale else 0):
        before, best = best, min(fits, key=lambda fit: fit.cost)
        if _is_sure(model, best) or (before is not None and best.cost >= before.cost * (1.0 - _SAME)):
            break
        # An offset bends the map that the unfolding begins with: once more, with what is known of it by now.
        ranges_m = np.maximum((network.ranges_m - best.state.offset_m) / (1.0 + best.state.scale), 0.0)
        fits += _fits(model, replace(network, ranges_m=ranges_m), None, settings, best.state)
    return fits


def _unfolded_map(
    model: MapModel,
    fits: list[BatchFit],
    settings: BatchSettings,
    mirrors: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...],
) -> MoteMap:
    """The best of some fits, looked through for folds, with its covariance."""
    network = model.network
    best = min(fits, key=lambda fit: fit.cost)
    steps = sum(fit.iterations for fit in fits)
    best = repaired(model, best, settings)
    if not _is_sure(model, best) and np.isfinite(settings.robust_scale):
        best, is_settled = searched(model, best, settings)
        if not (is_settled and _is_sound(model, best)):
            # To a robust loss a folded map is a good one with a few outliers: look for folds by least squares first.
            plain = settings._replace(robust_scale=float("inf"))
            open_map = unfold(model, fit_map(model, best.state, plain), plain, mirrors).fit
            best = min(best, fit_map(model, open_map.state, settings), key=lambda fit: fit.cost)
    found = unfold(model, best, settings, mirrors)
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
        agreement=agreement_of(fit, network.sigmas_m, dof),
        free=free,
        folds=found.doubtful,
    )


def _fits(
    model: MapModel,
    network: RangeNetwork,
    start_m: FloatArray | None,
    settings: BatchSettings,
    at: MapState | None = None,
) -> list[BatchFit]:
    """Fits from one start after the other, until one is sure, or where there are many motes, came out twice.

    Args:
        model: what is fitted.
        network: what the starts are made of: the model's own, or with corrected ranges.
        start_m: a start of the caller's.
        settings: of the fits.
        at: offset and scale to begin with.
    """
    fits: list[BatchFit] = []
    offset_m, scale = (0.0, 0.0) if at is None else (at.offset_m, at.scale)
    for images in map_starts(network, start_m):
        ends = [fit_from_afar(model, model.state(image, offset_m, scale), settings) for image in images]
        before = min((fit.cost for fit in fits), default=float("inf"))
        found = min(ends, key=lambda fit: fit.cost)
        fits += ends
        is_repeated = network.count > FEW and abs(found.cost - before) <= _SAME * before < float("inf")
        if _is_sure(model, found) or is_repeated:
            break
        if len(fits) == len(images) and _may_be_grown(network, settings):
            # Wrong ranges would lead all starts by least squares astray, one after the other.
            found, is_settled = searched(model, found, settings)
            fits.append(found)
            if _is_sure(model, found) or (is_settled and _is_sound(model, found)):
                break
    return fits


def _may_be_grown(network: RangeNetwork, settings: BatchSettings) -> bool:
    """Whether growing is quick, and tells more than the shapes of bodies do."""
    return network.count <= FEW and not network.bodies and bool(np.isfinite(settings.robust_scale))


def _is_sure(model: MapModel, fit: BatchFit) -> bool:
    return fit.cost < _SURE * max(len(model.network.ranges_m) - model.size, 1)


def _is_sound(model: MapModel, fit: BatchFit) -> bool:
    """Whether the ranges fit but for a few outliers."""
    network = model.network
    return not agreement_of(fit, network.sigmas_m, len(network.ranges_m) - model.size).is_denied
