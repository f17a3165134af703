"""Pure. The robust minimum and the honest sigma, where a map contradicts its ranges."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from ccatp.motes.map_batch import BatchFit, BatchSettings, fit_map
from ccatp.motes.map_model import MapModel
from ccatp.motes.map_starts import grown_starts

_WIDER = 8.0  # times the robust scale of the first steps from a grown map, whose places are off by several sigmas
_FIRST_STEPS = 30
_FOUND = 3  # times that the best minimum is found before the search ends
_SAME = 1e-6  # relative difference of costs that are the same minimum's
_ROUNDS = 15  # of fit and scale
_SETTLED = 0.01  # relative change of a scale that ends the rounds
_LEAST = 1e-9  # a factor of sigmas that is not nought where the ranges are exact


class ScaledFit(NamedTuple):
    """A robust fit and the sigmas that its residuals have.

    Attributes:
        factor: of the sigmas of the network that was asked about.
        model: of the network with the sigmas so multiplied.
        fit: with these.
    """

    factor: float
    model: MapModel
    fit: BatchFit


def searched(model: MapModel, best: BatchFit, settings: BatchSettings) -> tuple[BatchFit, bool]:
    """The fit of least robust cost that grown maps lead to, or the one given; whether several of them led there.

    Least squares is drawn towards wrong ranges, and a robust fit from there stays among them.

    Args:
        model: network and unknowns.
        best: the best fit so far.
        settings: of the fits, with a finite robust scale.
    """
    times = 0
    for fit in _grown_fits(model, best, settings):
        if fit.cost < best.cost * (1.0 - _SAME):
            best, times = fit, 0
        times += fit.cost <= best.cost * (1.0 + _SAME)
        if times >= _FOUND:
            return best, True
    return best, False


def scaled(model: MapModel, first: BatchFit, settings: BatchSettings) -> ScaledFit:
    """The map with the least scale of its residuals, each fitted robustly with sigmas of that scale.

    Residuals of a fit that wrong ranges have bent are all too large, those of a robust fit are not: the scale follows
    from the fit and the fit from the scale, in turn (S-estimate: Rousseeuw and Yohai 1984). Where it comes out larger
    than the sigmas were taken for, grown maps are tried too.

    Args:
        model: network with sigmas that are right up to a factor.
        first: a fit.
        settings: of the fits.
    """
    best = _settled(model, first, settings)
    # Shapes of bodies hold a map together by themselves.
    if best.factor <= 1.0 or model.network.bodies or not np.isfinite(settings.robust_scale):
        return best
    times = 0
    for fit in _grown_fits(model, first, settings):
        found = _settled(model, fit, settings)
        if found.factor < best.factor * (1.0 - _SETTLED):
            best, times = found, 0
        times += found.factor <= best.factor * (1.0 + _SETTLED)
        if times >= _FOUND:
            break
    return best


def residual_scale(model: MapModel, fit: BatchFit) -> float:
    """Standard deviation of the residuals in sigmas, from their quantile (m + p + 1) / 2.

    Of m residuals p, the number of unknowns, may be nought by the fit alone: the median of the others (Rousseeuw 1984).
    """
    count, size = len(fit.residuals_m), min(model.size, len(fit.residuals_m) - 1)
    place = (count + size + 1) // 2
    quantile = float(np.sort(np.abs(fit.residuals_m) / model.network.sigmas_m)[place - 1])
    normal = float(ndtri(0.5 + 0.5 * (place - 0.5) / count)) * np.sqrt(1.0 - size / count)
    return quantile / float(normal)


def _settled(model: MapModel, fit: BatchFit, settings: BatchSettings) -> ScaledFit:
    """Fit and scale in turn until they agree; below the sigmas given, once."""
    factor, at = float("inf"), model
    for _ in range(_ROUNDS):
        before, factor = factor, max(residual_scale(model, fit), _LEAST)
        network = replace(model.network, sigmas_m=model.network.sigmas_m * factor)
        at = MapModel(network, with_offset=model.with_offset, with_scale=model.with_scale)
        fit = fit_map(at, fit.state, settings)
        if factor < 1.0 or abs(factor - before) <= _SETTLED * factor:
            break
    return ScaledFit(factor, at, fit)


def _grown_fits(model: MapModel, best: BatchFit, settings: BatchSettings) -> Iterator[BatchFit]:
    """Fits from grown maps, of ranges corrected by the offset and the scale found so far."""
    offset_m, scale = best.state.offset_m, best.state.scale
    ranges_m = np.maximum((model.network.ranges_m - offset_m) / (1.0 + scale), 0.0)
    wide = settings._replace(robust_scale=_WIDER * settings.robust_scale, max_iterations=_FIRST_STEPS)
    for images in grown_starts(replace(model.network, ranges_m=ranges_m), settings.robust_scale):
        ends = []
        for image in images:
            near = fit_map(model, model.state(image, offset_m, scale), wide)
            ends.append(fit_map(model, near.state, settings))
        yield min(ends, key=lambda fit: fit.cost)
