"""The batch map from ranges alone: starts, the robust fit, a look for folds, the scale of the sigmas, covariance."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.special import ndtri

from ccatp.beacons.cricket.map_fit import (
    Agreement,
    MapFit,
    MapFitSettings,
    MapModel,
    MapState,
    agreement_of,
    fit_from_afar,
    fit_map,
    position_covariance,
)
from ccatp.beacons.cricket.map_start import FEW, grown_starts, map_starts
from ccatp.beacons.cricket.range_network import RangeNetwork, graph_pairs, sides
from ccatp.beacons.cricket.trilateration import trilaterate
from ccatp.core import FloatArray
from ccatp.filters.metrics import RigidMotion, best_motion, rigid_modes

_SURE = 2.0  # a map whose cost per degree of freedom is less needs no other start, and is folded nowhere
_SAME = 1e-6  # relative difference of costs that are the same minimum's
_CORRECTIONS = 3  # times that the unfolding is repeated with ranges corrected by the offset found
_FOUND = 3  # times that the best minimum is found before a search among grown maps ends

_VAGUE = 0.1  # of the ranges: where they scatter by more, whatever is mirrored fits about as well

Mirrors = Sequence[tuple[Sequence[int], Sequence[int]]]
Found = TypeVar("Found")


class Fold(NamedTuple):
    """Motes whose mirror image fits almost as well."""

    motes: tuple[int, ...]
    cost_gap: float  # by how much the cost of the whole map would rise


class MoteMap(NamedTuple):
    """A map of motes."""

    fit: MapFit
    covariance_m2: FloatArray  # of all coordinates, shape (n d, n d); of the aligned map where nothing pins the frame
    dof: int
    sigma_m: float  # median of the sigmas in the end
    iterations: int
    agreement: Agreement
    free: int  # directions that no range sees, the frame's included
    folds: tuple[Fold, ...]

    @property
    def positions_m(self) -> FloatArray:
        """Shape (n, d)."""
        return self.fit.state.positions_m

    @property
    def variance_factor(self) -> float:
        """Cost by degree of freedom: 1 where the sigmas are right."""
        return self.fit.cost / self.dof if self.dof > 0 else 1.0


def map_motes(
    network: RangeNetwork, settings: MapFitSettings, *, with_offset: bool = False, with_scale: bool = False,
    start_m: FloatArray | None = None, mirrors: Mirrors = (), finds_sigma: bool = False,
) -> MoteMap:  # fmt: skip
    """The map that fits all ranges best.

    A fit goes down to the nearest minimum, and most of them are folded maps. So it begins with the map unfolded from
    more dimensions (``unfolded``), and its mirror image where bodies distinguish them; then motes that could stand on
    the other side are tried there (``unfold``). ``start_m``: one more place to begin, shape (n, d), nan where unknown.
    ``finds_sigma``: the sigmas are right up to a factor, which follows from the residuals (``scaled``).
    """
    model = MapModel(network, with_offset=with_offset, with_scale=with_scale)
    plain = settings._replace(robust_scale=float("inf"))
    if finds_sigma:
        first = _least(_fits(model, start_m, plain))
        model, fit = scaled(model, first, settings)
        fits = [fit]
        if not _is_sure(model, fit) and not _is_sound(model, fit):
            fits += _fits(model, fit.state.positions_m, settings)
    else:
        fits = _fits(model, start_m, settings)
    best = _least(fits)
    folds: tuple[Fold, ...] = ()
    if float(np.median(model.network.sigmas_m)) < _VAGUE * float(np.median(network.ranges_m)):
        if not _is_sure(model, best) and np.isfinite(settings.robust_scale):
            best, is_settled = searched(model, best, settings)
            if not (is_settled and _is_sound(model, best)):
                # To a robust loss a folded map is a good one with a few outliers: first unfold by least squares.
                opened, _, _ = unfold(model, fit_map(model, best.state, plain), plain, mirrors)
                best = _least([best, fit_map(model, opened.state, settings)])
        best, _, folds = unfold(model, best, settings, mirrors)
    covariance, free = position_covariance(model, best)
    dof, sigmas = len(network.ranges_m) - (model.size - free), model.network.sigmas_m
    steps = sum(fit.iterations for fit in fits)
    agreement = agreement_of(best, sigmas, dof)
    return MoteMap(best, covariance, dof, float(np.median(sigmas)), steps, agreement, free, folds)


def _fits(model: MapModel, start_m: FloatArray | None, settings: MapFitSettings) -> list[MapFit]:
    fits = _started_fits(model, start_m, settings)
    for _ in range(_CORRECTIONS if model.with_offset or model.with_scale else 0):
        best = _least(fits)
        if _is_sure(model, best):
            break
        # An offset bends the map that the unfolding begins with: once more, with what is known of it by now.
        fits += _started_fits(model, None, settings, best.state)
        if _least(fits).cost >= best.cost * (1.0 - _SAME):
            break
    return fits


def _started_fits(
    model: MapModel, start_m: FloatArray | None, settings: MapFitSettings, at: MapState | None = None
) -> list[MapFit]:
    fits: list[MapFit] = []
    network = _corrected(model, at)
    offset_m, scale = (at.offset_m, at.scale) if at is not None else (0.0, 0.0)
    is_few = network.count <= FEW
    for images in map_starts(network, start_m):
        ends = [fit_from_afar(model, model.state(image, offset_m, scale), settings) for image in images]
        found, is_first = _least(ends), not fits
        is_repeated = not is_few and not is_first and abs(found.cost - _least(fits).cost) <= _SAME * _least(fits).cost
        fits += ends
        if _is_sure(model, found) or is_repeated:
            break
        # Growing is quick for a few motes, and the shapes of bodies say more.
        if is_first and is_few and not network.bodies and np.isfinite(settings.robust_scale):
            # Wrong ranges would lead all starts by least squares astray, one after the other.
            found, is_settled = searched(model, found, settings)
            fits.append(found)
            if _is_sure(model, found) or (is_settled and _is_sound(model, found)):
                break
    return fits


def _corrected(model: MapModel, at: MapState | None) -> RangeNetwork:
    """The network with its ranges freed of offset and scale."""
    if at is None:
        return model.network
    return replace(model.network, ranges_m=np.maximum((model.network.ranges_m - at.offset_m) / (1.0 + at.scale), 0.0))


def _least(fits: Sequence[MapFit]) -> MapFit:
    return min(fits, key=lambda fit: fit.cost)


def _is_sure(model: MapModel, fit: MapFit) -> bool:
    return fit.cost < _SURE * max(len(model.network.ranges_m) - model.size, 1)


def _is_sound(model: MapModel, fit: MapFit) -> bool:
    network = model.network
    return not agreement_of(fit, network.sigmas_m, len(network.ranges_m) - model.size).is_denied


# -- maps that wrong ranges do not bend -------------------------------------------------------------------------------

_WIDER = 8.0  # times the robust scale of the first steps from a grown map, whose places are off by several sigmas
_FIRST_STEPS = 30
_SCALE_ROUNDS = 15  # of fit and scale
_SETTLED = 0.01  # relative change of a scale that ends the rounds
_LEAST_FACTOR = 1e-9  # of sigmas, that is not nought where the ranges are exact


def searched(model: MapModel, best: MapFit, settings: MapFitSettings) -> tuple[MapFit, bool]:
    """The fit of least robust cost that grown maps lead to, or the one given; whether several of them led there.

    Least squares is drawn towards wrong ranges, and a robust fit from there stays among them.
    """
    return _found_again(best, _grown_fits(model, best, settings), lambda fit: fit.cost, _SAME)


def scaled(model: MapModel, first: MapFit, settings: MapFitSettings) -> tuple[MapModel, MapFit]:
    """The map with the least scale of its residuals, fitted robustly with the sigmas of that scale, which it has.

    Residuals of a fit that wrong ranges have bent are all too large, those of a robust fit are not: the scale follows
    from the fit and the fit from the scale, in turn (S-estimate: Rousseeuw and Yohai 1984). Where it comes out larger
    than the sigmas were taken for, grown maps are tried too. ``model``: network with sigmas that are right up to a
    factor.
    """
    best = _settled(model, first, settings)
    # Shapes of bodies hold a map together by themselves.
    if best[0] > 1.0 and not model.network.bodies and np.isfinite(settings.robust_scale):
        others = (_settled(model, fit, settings) for fit in _grown_fits(model, first, settings))
        best, _ = _found_again(best, others, lambda found: found[0], _SETTLED)
    return best[1:]


def _found_again(
    best: Found, others: Iterator[Found], cost: Callable[[Found], float], same: float
) -> tuple[Found, bool]:
    """The least of some maps, up to the one that finds it for the third time; whether one did."""
    times = 0
    for found in others:
        if cost(found) < cost(best) * (1.0 - same):
            best, times = found, 0
        times += cost(found) <= cost(best) * (1.0 + same)
        if times >= _FOUND:
            return best, True
    return best, False


def residual_scale(model: MapModel, fit: MapFit) -> float:
    """Standard deviation of the residuals in sigmas, from their quantile (m + p + 1) / 2.

    Of m residuals p, the number of unknowns, may be nought by the fit alone: the median of the others (Rousseeuw 1984).
    """
    count, size = len(fit.residuals_m), min(model.size, len(fit.residuals_m) - 1)
    place = (count + size + 1) // 2
    quantile = float(np.sort(np.abs(fit.residuals_m) / model.network.sigmas_m)[place - 1])
    normal = float(ndtri(0.5 + 0.5 * (place - 0.5) / count)) * np.sqrt(1.0 - size / count)
    return quantile / float(normal)


def _settled(model: MapModel, fit: MapFit, settings: MapFitSettings) -> tuple[float, MapModel, MapFit]:
    factor, at = float("inf"), model
    for _ in range(_SCALE_ROUNDS):
        before, factor = factor, max(residual_scale(model, fit), _LEAST_FACTOR)
        at = model.with_sigmas(factor)
        fit = fit_map(at, fit.state, settings)
        if factor < 1.0 or abs(factor - before) <= _SETTLED * factor:
            break
    return factor, at, fit


def _grown_fits(model: MapModel, best: MapFit, settings: MapFitSettings) -> Iterator[MapFit]:
    offset_m, scale = best.state.offset_m, best.state.scale
    wide = settings._replace(robust_scale=_WIDER * settings.robust_scale, max_iterations=_FIRST_STEPS)
    for images in grown_starts(_corrected(model, best.state), settings.robust_scale):
        near = [fit_map(model, model.state(image, offset_m, scale), wide) for image in images]
        yield _least([fit_map(model, fit.state, settings) for fit in near])


# -- folds ------------------------------------------------------------------------------------------------------------

_CLOSE = 9.0  # a mirror image that fits worse by less, in units of chi-squared, is as likely as not to be the truth
_ROUNDS = 10
_TRIALS = 400  # sets of motes looked at by whole fits; single motes are looked at by themselves
_CLOSE_BY = 0.25  # of the median range: motes nearer than this to each other are a group
_SINGLE_STEPS = 12
_SKETCH_STEPS = 15  # of a fit from a mirror image, before it is known to lead anywhere
_HOPELESS = 20.0  # times the best cost: such a fit ends in a worse fold

_Doubts = dict[tuple[int, ...], float]


def unfold(
    model: MapModel, fit: MapFit, settings: MapFitSettings, mirrors: Mirrors = ()
) -> tuple[MapFit, int, tuple[Fold, ...]]:
    """Mirror motes one at a time, and sets of motes across the body or the pair that joins them to the rest.

    Ranges see a mote whose partners stand nearly in line almost equally well on both sides of it; a fit that began on
    the wrong side stays there. A change is kept where it lowers the cost; the search ends when none does. Returns the
    fit, how many were turned, and those whose mirror image fits almost as well.
    """
    turned, near = 0, _Doubts()
    for _ in range(_ROUNDS):
        fit, singles, near = _turn_singles(model, fit, settings)
        fit, sets, near_sets = _turn_sets(model, fit, settings, mirrors)
        near |= near_sets
        turned += singles + sets
        if sets == 0 and singles == 0:
            break
    return fit, turned, tuple(Fold(motes, gap) for motes, gap in sorted(near.items()))


def _turn_singles(model: MapModel, fit: MapFit, settings: MapFitSettings) -> tuple[MapFit, int, _Doubts]:
    network, state = model.network, fit.state
    places, turned, near = state.positions_m.copy(), 0, _Doubts()
    if network.count <= network.dimension + 1 and np.isnan(network.known_m).all():
        return fit, 0, near  # a triangle (tetrahedron) with one corner mirrored is all of it mirrored: the same map
    for mote in network.loose:
        rows = np.flatnonzero((network.first == mote) | (network.second == mote))
        if np.isfinite(network.known_m[mote]).any() or len(rows) < network.dimension:
            continue
        anchors = places[network.first[rows] + network.second[rows] - mote]
        starts = np.concatenate([places[[mote]], *_mirrored(places[[mote]], anchors)])
        ranges, sigmas = (network.ranges_m[rows] - state.offset_m) / (1.0 + state.scale), network.sigmas_m[rows]
        ends, costs = trilaterate(starts, anchors, ranges, sigmas, settings.robust_scale, _SINGLE_STEPS)
        best = int(np.argmin(costs))
        is_other = np.linalg.norm(ends - ends[best], axis=1) >= 3.0 * float(sigmas.max())
        if is_other[0]:
            places[mote] = ends[best]
            turned += 1
        if (others := costs[is_other]).size and (gap := float(others.min() - costs[best])) < _CLOSE:
            near[(mote,)] = gap
    if turned:
        better = fit_map(model, model.state(places, state.offset_m, state.scale), settings)
        if better.cost < fit.cost * (1.0 - 1e-9):
            return better, turned, near
    return fit, 0, near


def _turn_sets(model: MapModel, fit: MapFit, settings: MapFitSettings, mirrors: Mirrors) -> tuple[MapFit, int, _Doubts]:
    network, turned, near = model.network, 0, _Doubts()
    sound = _SURE * max(len(network.ranges_m) - model.size, 1)
    for _, (separator, motes) in zip(range(_TRIALS), _sets(model, fit, mirrors), strict=False):
        before_m = fit.state.positions_m
        for image in _mirrored(before_m[list(motes)], before_m[list(separator)]):
            places = fit.state.positions_m.copy()
            places[list(motes)] = image
            start = model.state(places, fit.state.offset_m, fit.state.scale)
            other = fit_from_afar(model, start, settings._replace(max_iterations=_SKETCH_STEPS))
            # A map that its ranges deny is left for a better one alone: others like it are without number.
            if not other.is_at_rest and other.cost <= max(fit.cost, _HOPELESS * (min(fit.cost, sound) + _CLOSE)):
                other = fit_map(model, other.state, settings)
            gap = other.cost - fit.cost
            if gap < -1e-6 * max(1.0, fit.cost):
                fit, turned = other, turned + 1
            elif gap < _CLOSE and _moved_m(network, other, fit) > 3.0 * float(network.sigmas_m.max()):
                near[tuple(motes)] = gap
    return fit, turned, near


def _moved_m(network: RangeNetwork, one: MapFit, other: MapFit) -> float:
    places_m, other_m = one.state.positions_m, other.state.positions_m
    if np.isnan(network.known_m).all():
        places_m = best_motion(places_m, other_m, mirrors=not network.bodies).moved(places_m)
    return float(np.linalg.norm(places_m - other_m, axis=1).max())


def _sets(model: MapModel, fit: MapFit, mirrors: Mirrors) -> Iterator[tuple[Sequence[int], Sequence[int]]]:
    network = model.network
    yield from ((separator, motes) for separator, motes in mirrors if len(separator) >= network.dimension)
    pairs = graph_pairs(network)
    for group in _groups(model, fit):
        for side in sides(network.count, pairs, group):
            if 2 * len(side) <= network.count:
                yield group, side
                yield group, (*side, *group)
        yield group, group


def _groups(model: MapModel, fit: MapFit) -> list[tuple[int, ...]]:
    # Seen from afar a few motes close together are one point: what is fixed to them turns about them almost freely.
    network, places = model.network, fit.state.positions_m
    groups = [body.motes for body in network.bodies]
    if _is_sure(model, fit):
        return groups
    near = np.linalg.norm(places[:, None] - places[None], axis=2) < _CLOSE_BY * float(np.median(network.ranges_m))
    close = sides(network.count, np.argwhere(near), ())
    return groups + [group for group in close if 1 < len(group) < network.count // 2 and group not in groups]


def _mirrored(points: FloatArray, through: FloatArray) -> Iterator[FloatArray]:
    """Points mirrored across the least, then the next wide extent of others."""
    centre = through.mean(axis=0)
    for normal in np.linalg.svd(through - centre)[2][::-1][:2]:
        yield points - 2.0 * ((points - centre) @ normal)[:, None] * normal


# -- frames -----------------------------------------------------------------------------------------------------------


def pinned_map(
    positions_m: FloatArray, covariance_m2: FloatArray, known_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The map moved so that a point and one coordinate of another are as known; in the plane.

    The error of a map in a frame is its shape's error less the rigid motion that keeps what is known without error:
    C' = S C S^T, S = I - G (K G)^-1 K, G the rigid motions of the map, K the rows of the known coordinates
    (S-transform, Baarda 1973).

    Args:
        positions_m: shape (n, 2).
        covariance_m2: of the free map, shape (2 n, 2 n).
        known_m: both coordinates of one mote and one of another, nan elsewhere, shape (n, 2).

    Raises:
        ValueError: other coordinates are known than these.
    """
    is_known = np.isfinite(known_m)
    counts = is_known.sum(axis=1).tolist()
    if positions_m.shape[1] != 2 or sorted(filter(None, counts)) != [1, 2]:
        raise ValueError(
            f"{int(is_known.sum())} known coordinates, wanted both of one mote and one of another in the plane"
        )
    first, second = counts.index(2), counts.index(1)
    axis = int(np.flatnonzero(is_known[second])[0])
    way = positions_m[second] - positions_m[first]
    share = float(np.clip((known_m[second, axis] - known_m[first, axis]) / np.hypot(*way), -1.0, 1.0))
    # Angles of the way, from the known axis, after the turn; the map is nearly in the frame already.
    angles = np.array([np.arccos(share), -np.arccos(share)]) + axis * 0.5 * np.pi
    turns = np.angle(np.exp(1j * (angles - np.arctan2(way[1], way[0]))))
    turn = turns[np.argmin(np.abs(turns))]
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    motion = RigidMotion(rotation, known_m[first] - rotation @ positions_m[first])
    moved = motion.moved(positions_m)
    modes, rows = rigid_modes(moved), np.flatnonzero(is_known)
    S = np.eye(moved.size)
    S[:, rows] -= modes @ np.linalg.inv(modes[rows])
    return moved, S @ motion.turned_map(covariance_m2) @ S.T


def plain_frame(positions_m: FloatArray) -> RigidMotion:
    """The motion to a frame of the map's own: the first mote its origin, the second on +x, the third at y > 0.

    ``positions_m``: shape (n, d), of motes that are not all on a line.
    """
    offsets, d = positions_m - positions_m[0], positions_m.shape[1]
    basis = np.zeros((0, d))
    for offset in offsets[1:]:
        rest = offset - basis.T @ (basis @ offset)
        length = float(np.linalg.norm(rest))
        if len(basis) < d and length > 1e-6 * float(np.linalg.norm(offset)):
            basis = np.vstack([basis, rest / length])
    rotation = basis if len(basis) == d else np.eye(d)
    return RigidMotion(rotation, -rotation @ positions_m[0])
