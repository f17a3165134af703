"""Maps that fit better, or as well, when motes are mirrored across what holds them; the robust minimum, its sigma."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from ccatp.beacons.cricket.map_fit import MapFit, MapFitSettings, MapModel, MapState, fit_from_afar, fit_map
from ccatp.beacons.cricket.map_start import grown_starts
from ccatp.beacons.cricket.range_network import RangeNetwork, components, graph_pairs
from ccatp.core import FloatArray
from ccatp.filters.metrics import best_motion

CLOSE = 9.0  # a mirror image that fits worse by less, in units of chi-squared, is as likely as not to be the truth
_ROUNDS = 10
_TRIALS = 400  # sets of motes looked at by whole fits; single motes are looked at by themselves
_CONTRADICTED = 2.0  # cost per degree of freedom of a map that is folded somewhere
_CLOSE_BY = 0.25  # of the median range: motes nearer than this to each other are a group
_LOCAL_STEPS = 12
_SKETCH_STEPS = 15  # of a fit from a mirror image, before it is known to lead anywhere
_HOPELESS = 20.0  # times the best cost: such a fit ends in a worse fold


class Fold(NamedTuple):
    """Motes whose mirror image fits almost as well."""

    motes: tuple[int, ...]
    cost_gap: float  # by how much the cost of the whole map would rise


class Unfolded(NamedTuple):
    """A map that no mirroring of those tried betters."""

    fit: MapFit
    turned: int
    doubtful: tuple[Fold, ...]


def unfold(
    model: MapModel, fit: MapFit, settings: MapFitSettings, mirrors: Sequence[tuple[Sequence[int], Sequence[int]]] = ()
) -> Unfolded:
    """Mirror motes one at a time, and sets of motes across the body or the pair that joins them to the rest.

    Ranges see a mote whose partners stand nearly in line almost equally well on both sides of it; a fit that began on
    the wrong side stays there. A change is kept where it lowers the cost; the search ends when none does.
    """
    turned, doubtful = 0, dict[tuple[int, ...], float]()
    for _ in range(_ROUNDS):
        fit, singles, near = _turn_singles(model, fit, settings)
        doubtful = near
        fit, sets, near_sets = _turn_sets(model, fit, settings, mirrors)
        doubtful |= near_sets
        turned += singles + sets
        if sets == 0 and singles == 0:
            break
    return Unfolded(fit, turned, tuple(Fold(motes, gap) for motes, gap in sorted(doubtful.items())))


def _turn_singles(
    model: MapModel, fit: MapFit, settings: MapFitSettings
) -> tuple[MapFit, int, dict[tuple[int, ...], float]]:
    network = model.network
    places = fit.state.positions_m.copy()
    turned, near = 0, dict[tuple[int, ...], float]()
    if network.count <= network.dimension + 1 and np.isnan(network.known_m).all():
        return fit, 0, near  # a triangle (tetrahedron) with one corner mirrored is all of it mirrored: the same map
    for mote in network.loose:
        rows = np.flatnonzero((network.first == mote) | (network.second == mote))
        if np.isfinite(network.known_m[mote]).any() or len(rows) < network.dimension:
            continue
        partners = np.where(network.first[rows] == mote, network.second[rows], network.first[rows])
        ranges = (network.ranges_m[rows] - fit.state.offset_m) / (1.0 + fit.state.scale)
        own = (places[partners], ranges, network.sigmas_m[rows], settings.robust_scale)
        now_m, now_cost = _settled_single(*own, places[mote])
        for image in _images(places[mote][None], places[partners]):
            other_m, other_cost = _settled_single(*own, image[0])
            if np.linalg.norm(other_m - now_m) < 3.0 * float(network.sigmas_m[rows].max()):
                continue
            gap = other_cost - now_cost
            if gap < 0.0:
                now_m, now_cost = other_m, other_cost
                places[mote] = other_m
                turned += 1
            elif gap < CLOSE:
                near[(mote,)] = gap
    if turned:
        better = fit_map(model, model.state(places, fit.state.offset_m, fit.state.scale), settings)
        if better.cost < fit.cost * (1.0 - 1e-9):
            return better, turned, near
    return fit, 0, near


def _settled_single(
    anchors: FloatArray, ranges: FloatArray, sigmas: FloatArray, robust_scale: float, place: FloatArray
) -> tuple[FloatArray, float]:
    # Place and cost of one mote while all others stay.

    def look(place: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        ways = place - anchors
        lengths = np.maximum(np.sqrt((ways**2).sum(axis=1)), 1e-9)
        scaled = (ranges - lengths) / sigmas
        if np.isfinite(robust_scale):
            ratio = (scaled / robust_scale) ** 2
            cost, weights = float(robust_scale**2 * np.log1p(ratio).sum()), 1.0 / (1.0 + ratio)
        else:
            cost, weights = float(scaled @ scaled), np.ones(len(scaled))
        J = ways / (lengths * sigmas)[:, None]
        return cost, J.T @ (weights * scaled), (J * weights[:, None]).T @ J + 1e-12 * np.eye(len(place))

    cost, gradient, normal = look(place)
    damping = 1e-3
    for _ in range(_LOCAL_STEPS):
        step = np.linalg.solve(normal + damping * np.trace(normal) * np.eye(len(place)), gradient)
        trial = place + step
        seen = look(trial)
        if seen[0] <= cost:
            place, (cost, gradient, normal), damping = trial, seen, damping * 0.2
            if float(np.abs(step).max()) < 1e-6:
                break
        else:
            damping *= 8.0
    return place, cost


def _turn_sets(
    model: MapModel, fit: MapFit, settings: MapFitSettings, mirrors: Sequence[tuple[Sequence[int], Sequence[int]]]
) -> tuple[MapFit, int, dict[tuple[int, ...], float]]:
    turned, near = 0, dict[tuple[int, ...], float]()
    for trial, (separator, motes) in enumerate(_sets(model, fit, mirrors)):
        if trial >= _TRIALS:
            break
        for image in _images(fit.state.positions_m[list(motes)], fit.state.positions_m[list(separator)]):
            places = fit.state.positions_m.copy()
            places[list(motes)] = image
            other = _tried(model, model.state(places, fit.state.offset_m, fit.state.scale), settings, fit.cost)
            gap = other.cost - fit.cost
            moved_m = _moved_m(model.network, other.state.positions_m, fit.state.positions_m)
            if gap < -1e-6 * max(1.0, fit.cost):
                fit, turned = other, turned + 1
            elif gap < CLOSE and moved_m > 3.0 * float(model.network.sigmas_m.max()):
                near[tuple(motes)] = gap
    return fit, turned, near


def _moved_m(network: RangeNetwork, one_m: FloatArray, other_m: FloatArray) -> float:
    if np.isnan(network.known_m).all():
        one_m = best_motion(one_m, other_m, mirrors=not network.bodies).moved(one_m)
    return float(np.linalg.norm(one_m - other_m, axis=1).max())


def _tried(model: MapModel, start: MapState, settings: MapFitSettings, best: float) -> MapFit:
    sketch = fit_from_afar(model, start, settings._replace(max_iterations=_SKETCH_STEPS))
    if sketch.is_at_rest or sketch.cost > _HOPELESS * (best + CLOSE):
        return sketch
    return fit_map(model, sketch.state, settings)


def _sets(
    model: MapModel, fit: MapFit, mirrors: Sequence[tuple[Sequence[int], Sequence[int]]]
) -> Iterator[tuple[Sequence[int], Sequence[int]]]:
    network = model.network
    yield from ((separator, motes) for separator, motes in mirrors if len(separator) >= network.dimension)
    pairs = graph_pairs(network)
    for group in _groups(model, fit):
        kept = ~np.isin(pairs, group).any(axis=1)
        labels = components(network.count, pairs[kept])
        labels[list(group)] = -1
        for label in np.unique(labels[labels >= 0]):
            side = np.flatnonzero(labels == label)
            if 2 * len(side) <= network.count:
                yield group, tuple(side.tolist())
                yield group, (*side.tolist(), *group)
        yield group, group


def _groups(model: MapModel, fit: MapFit) -> list[tuple[int, ...]]:
    # Seen from afar a few motes close together are one point: what is fixed to them turns about them almost freely.
    network = model.network
    groups = [body.motes for body in network.bodies]
    if fit.cost < _CONTRADICTED * max(len(network.ranges_m) - model.size, 1):
        return groups
    places = fit.state.positions_m
    ways = places[:, None] - places[None]
    near = np.sqrt((ways**2).sum(axis=2)) < _CLOSE_BY * float(np.median(network.ranges_m))
    labels = components(network.count, np.column_stack(np.nonzero(near)))
    close = [tuple(np.flatnonzero(labels == label).tolist()) for label in np.unique(labels)]
    return groups + [group for group in close if 1 < len(group) < network.count // 2 and group not in groups]


def _images(points: FloatArray, through: FloatArray) -> Iterator[FloatArray]:
    centre = through.mean(axis=0)
    axes = np.linalg.svd(through - centre)[2]
    for normal in axes[::-1][:2]:
        heights = (points - centre) @ normal
        yield points - 2.0 * heights[:, None] * normal


_WIDER = 8.0  # times the robust scale of the first steps from a grown map, whose places are off by several sigmas
_FIRST_STEPS = 30
_FOUND = 3  # times that the best minimum is found before the search ends
_SAME = 1e-6  # relative difference of costs that are the same minimum's
_MAP_SEARCH_ROUNDS = 15  # of fit and scale
_SETTLED = 0.01  # relative change of a scale that ends the rounds
_LEAST = 1e-9  # a factor of sigmas that is not nought where the ranges are exact


class ScaledFit(NamedTuple):
    """A robust fit and the sigmas that its residuals have."""

    factor: float  # of the sigmas of the network that was asked about
    model: MapModel  # of the network with the sigmas so multiplied
    fit: MapFit


def searched(model: MapModel, best: MapFit, settings: MapFitSettings) -> tuple[MapFit, bool]:
    """The fit of least robust cost that grown maps lead to, or the one given; whether several of them led there.

    Least squares is drawn towards wrong ranges, and a robust fit from there stays among them.
    """
    times = 0
    for fit in _grown_fits(model, best, settings):
        if fit.cost < best.cost * (1.0 - _SAME):
            best, times = fit, 0
        times += fit.cost <= best.cost * (1.0 + _SAME)
        if times >= _FOUND:
            return best, True
    return best, False


def scaled(model: MapModel, first: MapFit, settings: MapFitSettings) -> ScaledFit:
    """The map with the least scale of its residuals, each fitted robustly with sigmas of that scale.

    Residuals of a fit that wrong ranges have bent are all too large, those of a robust fit are not: the scale follows
    from the fit and the fit from the scale, in turn (S-estimate: Rousseeuw and Yohai 1984). Where it comes out larger
    than the sigmas were taken for, grown maps are tried too. ``model``: network with sigmas that are right up to a
    factor.
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


def residual_scale(model: MapModel, fit: MapFit) -> float:
    """Standard deviation of the residuals in sigmas, from their quantile (m + p + 1) / 2.

    Of m residuals p, the number of unknowns, may be nought by the fit alone: the median of the others (Rousseeuw 1984).
    """
    count, size = len(fit.residuals_m), min(model.size, len(fit.residuals_m) - 1)
    place = (count + size + 1) // 2
    quantile = float(np.sort(np.abs(fit.residuals_m) / model.network.sigmas_m)[place - 1])
    normal = float(ndtri(0.5 + 0.5 * (place - 0.5) / count)) * np.sqrt(1.0 - size / count)
    return quantile / float(normal)


def _settled(model: MapModel, fit: MapFit, settings: MapFitSettings) -> ScaledFit:
    factor, at = float("inf"), model
    for _ in range(_MAP_SEARCH_ROUNDS):
        before, factor = factor, max(residual_scale(model, fit), _LEAST)
        network = replace(model.network, sigmas_m=model.network.sigmas_m * factor)
        at = MapModel(network, with_offset=model.with_offset, with_scale=model.with_scale)
        fit = fit_map(at, fit.state, settings)
        if factor < 1.0 or abs(factor - before) <= _SETTLED * factor:
            break
    return ScaledFit(factor, at, fit)


def _grown_fits(model: MapModel, best: MapFit, settings: MapFitSettings) -> Iterator[MapFit]:
    offset_m, scale = best.state.offset_m, best.state.scale
    ranges_m = np.maximum((model.network.ranges_m - offset_m) / (1.0 + scale), 0.0)
    wide = settings._replace(robust_scale=_WIDER * settings.robust_scale, max_iterations=_FIRST_STEPS)
    for images in grown_starts(replace(model.network, ranges_m=ranges_m), settings.robust_scale):
        ends = []
        for image in images:
            near = fit_map(model, model.state(image, offset_m, scale), wide)
            ends.append(fit_map(model, near.state, settings))
        yield min(ends, key=lambda fit: fit.cost)
