"""The batch map from ranges alone: start positions, robust fit, search for folds, scale of the sigmas, covariance."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

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
from ccatp.beacons.cricket.map_start import filled, grown, images, unfolded, with_bodies
from ccatp.beacons.cricket.range_network import RangeNetwork, graph_pairs, sides
from ccatp.beacons.cricket.trilateration import trilaterate
from ccatp.beacons.rigid_motion import RigidMotion, best_motion, rigid_modes
from ccatp.core import FloatArray

_SURE = 2.0  # below this cost per degree of freedom a map has no fold and needs no other start
_SAME = 1e-6  # relative difference of costs up to which two fits are the same minimum
_FOUND = 3  # repeats of the best minimum that end the search
_FEW = 60  # largest number of motes for which unfolding from random positions is cheap
_DRAWS = 16
_MANY_DRAWS = 2  # with more motes, because each draw takes seconds

_VAGUE = 0.1  # sigma over range above which most mirror images fit about as well as the map

Mirrors = Sequence[tuple[Sequence[int], Sequence[int]]]


class Fold(NamedTuple):
    """Motes whose mirror image fits almost as well."""

    motes: tuple[int, ...]
    cost_gap: float  # by how much the cost of the whole map would rise


class MoteMap(NamedTuple):
    """A map of motes."""

    fit: MapFit
    covariance_m2: FloatArray  # of all coordinates, shape (n d, n d); of the aligned map if no coordinate is known
    dof: int
    sigma_m: float  # median of the final sigmas
    iterations: int
    agreement: Agreement
    free: int  # directions that no range determines, including those of the frame
    folds: tuple[Fold, ...]

    @property
    def positions_m(self) -> FloatArray:
        """Shape (n, d)."""
        return self.fit.state.positions_m

    @property
    def variance_factor(self) -> float:
        """Cost per degree of freedom: 1 if the sigmas are right."""
        return self.fit.cost / self.dof if self.dof > 0 else 1.0

    def doubtful(self, mirrors: Mirrors) -> tuple[int, ...]:
        """Motes that may be mirrored, because the graph allows it or because the mirror image fits almost as well."""
        found = {mote for fold in self.folds for mote in fold.motes}
        return tuple(sorted(found | {mote for _, motes in mirrors for mote in motes}))


def map_motes(
    network: RangeNetwork, settings: MapFitSettings, *, with_offset: bool = False, with_scale: bool = False,
    start_m: FloatArray | None = None, mirrors: Mirrors = (), finds_sigma: bool = False,
) -> MoteMap:  # fmt: skip
    """The map that fits all ranges best.

    A fit converges to the nearest minimum, and most minima are folded maps. So it starts from the map unfolded from
    more dimensions (``unfolded``), and from its mirror image if bodies distinguish the two. Then ``unfold`` tries motes
    on the other side. ``start_m``: an additional start, shape (n, d), nan where unknown. ``finds_sigma``: the sigmas
    are right up to a common factor, which the residuals determine (``scaled``).
    """
    search = _Search(MapModel(network, with_offset=with_offset, with_scale=with_scale), settings, finds_sigma)
    (_, model, best), is_found = search.best_of(start_m)
    folds: tuple[Fold, ...] = ()
    if float(np.median(model.network.sigmas_m)) < _VAGUE * float(np.median(network.ranges_m)):
        if not is_found and np.isfinite(settings.robust_scale):
            # A robust loss accepts a folded map as a good map with a few outliers. So first unfold by least squares.
            plain = settings._replace(robust_scale=float("inf"))
            opened, _, _ = unfold(model, fit_map(model, best.state, plain), plain, mirrors)
            best = min(best, fit_map(model, opened.state, settings), key=_cost)
        best, _, folds = unfold(model, best, settings, mirrors)
    covariance, free = position_covariance(model, best)
    dof, sigmas = len(network.ranges_m) - (model.size - free), model.network.sigmas_m
    agreement = agreement_of(best, sigmas, dof)
    return MoteMap(best, covariance, dof, float(np.median(sigmas)), search.iterations, agreement, free, folds)


def _cost(fit: MapFit) -> float:
    return fit.cost


def _is_sure(model: MapModel, fit: MapFit) -> bool:
    return fit.cost < _SURE * max(len(model.network.ranges_m) - model.size, 1)


def _is_sound(model: MapModel, fit: MapFit) -> bool:
    network = model.network
    return not agreement_of(fit, network.sigmas_m, len(network.ranges_m) - model.size).is_denied


# -- the search -------------------------------------------------------------------------------------------------------

_WIDER = 8.0  # factor of the robust scale in the first steps from a grown map, which is off by several sigmas
_FIRST_STEPS = 30
_SCALE_ROUNDS = 15  # alternations of fit and scale
_SETTLED = 0.01  # relative change of the scale that ends the alternation
_LEAST_FACTOR = 1e-9  # of the sigmas; exact ranges would give zero


class _Judged(NamedTuple):
    badness: float  # the cost, or the scale of the residuals if the sigmas are estimated
    model: MapModel
    fit: MapFit


class _Search:
    """Fits from several starts, until one is certain, or the best was found several times and agrees with its ranges.

    The best fit has the least cost. If the sigmas are estimated, it has the least scale of residuals, and is fitted
    with sigmas of that scale (``scaled``).
    """

    def __init__(self, model: MapModel, settings: MapFitSettings, finds_sigma: bool) -> None:
        self._model, self._settings, self._finds_sigma = model, settings, finds_sigma
        self._best: _Judged | None = None
        self.iterations = 0

    def best_of(self, start_m: FloatArray | None) -> tuple[_Judged, bool]:
        """The best fit, and whether it is certain or was found often enough. ``start_m``: see ``map_motes``."""
        same = _SETTLED if self._finds_sigma else _SAME
        enough = _FOUND if self._model.network.count <= _FEW else _FOUND - 1
        best, times = self._judge(self._unfolded_fit()), 0
        self._best = best
        for fit in () if self._is_sure(best) else self._other_fits(start_m):
            found = self._judge(fit)
            if found.badness < best.badness * (1.0 - same):
                self._best = best = found
                times = 0
            times += found.badness <= best.badness * (1.0 + same)
            if self._is_sure(best) or (times >= enough and _is_sound(best.model, best.fit)):
                return best, True
        return best, self._is_sure(best)

    def _other_fits(self, start_m: FloatArray | None) -> Iterator[MapFit]:
        network = self._model.network
        if self._model.with_offset or self._model.with_scale:
            # An offset in the ranges bends the unfolded start. So unfold again, with ranges corrected by the estimate.
            yield self._unfolded_fit()
        if start_m is not None:
            yield self._fit(filled(start_m, network))
        is_few = network.count <= _FEW
        if not network.bodies and np.isfinite(self._settings.robust_scale):
            yield from self._grown_fits(_DRAWS if is_few else _MANY_DRAWS)
        for draw in range(_DRAWS if is_few else 0):
            yield self._unfolded_fit(np.random.default_rng(draw))

    def _grown_fits(self, draws: int) -> Iterator[MapFit]:
        """Fits from grown maps: wrong ranges bend least squares, and a robust fit that starts from there stays bent."""
        robust_scale = self._settings.robust_scale
        wide = self._settings._replace(robust_scale=_WIDER * robust_scale, max_iterations=_FIRST_STEPS)
        for draw in range(draws):  # fixed seeds: the same ranges give the same map
            network = self._corrected()
            places = grown(network, robust_scale, np.random.default_rng(draw))
            if places is not None:
                near = [fit_map(self._model, start, wide) for start in self._states(filled(places, network))]
                yield self._least([fit_map(self._model, fit.state, self._settings) for fit in near])

    def _unfolded_fit(self, rng: np.random.Generator | None = None) -> MapFit:
        return self._fit(unfolded(with_bodies(self._corrected()), rng))

    def _fit(self, start_m: FloatArray) -> MapFit:
        # Sigmas that are still to be estimated may be far off, so they cannot yet identify outliers.
        how = self._settings._replace(robust_scale=float("inf")) if self._finds_sigma else self._settings
        return self._least([fit_from_afar(self._model, start, how) for start in self._states(start_m)])

    def _least(self, fits: list[MapFit]) -> MapFit:
        self.iterations += sum(fit.iterations for fit in fits)
        return min(fits, key=_cost)

    def _states(self, start_m: FloatArray) -> list[MapState]:
        offset_m, scale = (0.0, 0.0) if self._best is None else self._best.fit.state[1:]
        return [self._model.state(image, offset_m, scale) for image in images(self._model.network, start_m)]

    def _judge(self, fit: MapFit) -> _Judged:
        if self._finds_sigma:
            return _Judged(*scaled(self._model, fit, self._settings))
        return _Judged(fit.cost, self._model, fit)

    def _is_sure(self, found: _Judged) -> bool:
        return found.badness <= 1.0 if self._finds_sigma else _is_sure(found.model, found.fit)

    def _corrected(self) -> RangeNetwork:
        """The network with its ranges corrected by the estimated offset and scale."""
        network = self._model.network
        if self._best is None:
            return network
        _, offset_m, scale = self._best.fit.state
        return replace(network, ranges_m=np.maximum((network.ranges_m - offset_m) / (1.0 + scale), 0.0))


def scaled(model: MapModel, fit: MapFit, settings: MapFitSettings) -> tuple[float, MapModel, MapFit]:
    """The scale of a map's residuals in sigmas, the model with sigmas of that scale, and the map fitted with them.

    If wrong ranges bend a fit, all its residuals are too large; those of a robust fit are not, but it needs the scale.
    So scale and fit are computed in turn (S-estimate: Rousseeuw and Yohai 1984).
    """
    factor, at = float("inf"), model
    for _ in range(_SCALE_ROUNDS):
        before, factor = factor, max(residual_scale(model, fit), _LEAST_FACTOR)
        at = model.with_sigmas(factor)
        fit = fit_map(at, fit.state, settings)
        if factor < 1.0 or abs(factor - before) <= _SETTLED * factor:
            break
    return factor, at, fit


def residual_scale(model: MapModel, fit: MapFit) -> float:
    """Standard deviation of the residuals in sigmas, from their quantile (m + p + 1) / 2.

    With p unknowns, the fit alone can make p of m residuals zero. This is the median of the others (Rousseeuw 1984).
    """
    count, size = len(fit.residuals_m), min(model.size, len(fit.residuals_m) - 1)
    place = (count + size + 1) // 2
    quantile = float(np.sort(np.abs(fit.residuals_m) / model.network.sigmas_m)[place - 1])
    normal = float(ndtri(0.5 + 0.5 * (place - 0.5) / count)) * np.sqrt(1.0 - size / count)
    return quantile / float(normal)


# -- folds ------------------------------------------------------------------------------------------------------------

_CLOSE = 9.0  # increase of chi-squared below which a mirror image may be the true map
_ROUNDS = 10
_TRIALS = 400  # sets of motes that are tested by a fit of the whole map; single motes are tested alone
_CLOSE_BY = 0.25  # of the median range: motes nearer to each other form a group
_SINGLE_STEPS = 12
_SKETCH_STEPS = 15  # first steps of a fit from a mirror image; they decide whether it is continued
_HOPELESS = 20.0  # times the best cost: above it a fit ends in a worse fold

_Doubts = dict[tuple[int, ...], float]


def unfold(
    model: MapModel, fit: MapFit, settings: MapFitSettings, mirrors: Mirrors = ()
) -> tuple[MapFit, int, tuple[Fold, ...]]:
    """Mirror single motes, and sets of motes across the body or the pair that joins them to the rest.

    If the partners of a mote are nearly in line, its ranges fit almost equally well on both sides of that line, and a
    fit that started on the wrong side stays there. A change is kept if it lowers the cost; the search ends when none
    does. Returns the fit, the number of changes, and the sets whose mirror image fits almost as well.
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
        return fit, 0, near  # mirroring one corner of a triangle (tetrahedron) mirrors all of it: the same map
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
            # If the map contradicts its ranges, only a better map is of interest: similar bad maps are countless.
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
    # For distant motes, a few motes close together act as one point: a part tied to them can turn almost freely.
    network, places = model.network, fit.state.positions_m
    groups = [body.motes for body in network.bodies]
    if _is_sure(model, fit):
        return groups
    near = np.linalg.norm(places[:, None] - places[None], axis=2) < _CLOSE_BY * float(np.median(network.ranges_m))
    close = sides(network.count, np.argwhere(near), ())
    return groups + [group for group in close if 1 < len(group) < network.count // 2 and group not in groups]


def _mirrored(points: FloatArray, through: FloatArray) -> Iterator[FloatArray]:
    """Points mirrored across the axes of least, then second least extent of ``through``."""
    centre = through.mean(axis=0)
    for normal in np.linalg.svd(through - centre)[2][::-1][:2]:
        yield points - 2.0 * ((points - centre) @ normal)[:, None] * normal


# -- frames -----------------------------------------------------------------------------------------------------------


def pinned_map(
    positions_m: FloatArray, covariance_m2: FloatArray, known_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The planar map moved so that one mote and one coordinate of another have their known values.

    In the new frame the known coordinates have no error: C' = S C S^T, S = I - G (K G)^-1 K, with G the rigid motions
    of the map and K the rows of the known coordinates (S-transform, Baarda 1973).

    Positions (n, 2), covariance of the free map (2 n, 2 n); ``known_m``: both coordinates of one mote and one of
    another, nan elsewhere, shape (n, 2). Raises ValueError: other coordinates are known.
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
    # The two possible directions from the first to the second mote; take the smaller turn, since the map is nearly in
    # the frame already.
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
    """The motion to a frame with the first mote at the origin, the second on +x, and the third at y > 0.

    ``positions_m``: shape (n, d), not all on a line.
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
