"""The batch map from ranges alone: starts, the robust fit, a look for folds, covariance; its frame."""

from dataclasses import dataclass, replace

import numpy as np

from ccatp.beacons.cricket.flip_search import Fold, scaled, searched, unfold
from ccatp.beacons.cricket.map_fit import (
    MapFit,
    MapFitSettings,
    MapModel,
    MapState,
    fit_from_afar,
    fit_map,
    position_covariance,
)
from ccatp.beacons.cricket.map_start import FEW, map_starts
from ccatp.beacons.cricket.range_network import RangeNetwork
from ccatp.beacons.cricket.unfolding import Agreement, agreement_of
from ccatp.core import FloatArray
from ccatp.filters.metrics import RigidMotion, rigid_modes

_SURE = 2.0  # a map whose cost per degree of freedom is less needs no other start
_SAME = 1e-6  # relative difference of costs that are the same minimum's
_CORRECTIONS = 3  # times that the unfolding is repeated with ranges corrected by the offset found


@dataclass(frozen=True, slots=True)
class MoteMap:
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
    network: RangeNetwork,
    settings: MapFitSettings,
    *,
    with_offset: bool = False,
    with_scale: bool = False,
    start_m: FloatArray | None = None,
    mirrors: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...] = (),
    finds_sigma: bool = False,
) -> MoteMap:
    """The map that fits all ranges best.

    A fit goes down to the nearest minimum, and most of them are folded maps. So it begins with the map unfolded from
    more dimensions (``unfolded``), and its mirror image where bodies distinguish them; then motes that could stand on
    the other side are tried there (``unfold``). ``start_m``: one more place to begin, shape (n, d), nan where unknown.
    ``finds_sigma``: the sigmas are right up to a factor, which follows from the residuals (``scaled``).
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


def _all_fits(model: MapModel, start_m: FloatArray | None, settings: MapFitSettings) -> list[MapFit]:
    network = model.network
    fits = _fits(model, network, start_m, settings)
    best: MapFit | None = None
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
    fits: list[MapFit],
    settings: MapFitSettings,
    mirrors: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...],
) -> MoteMap:
    """The best of some fits, looked through for folds, with its covariance."""
    network = model.network
    best = min(fits, key=lambda fit: fit.cost)
    steps = sum(fit.iterations for fit in fits)
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
        fit=fit,
        covariance_m2=covariance,
        dof=dof,
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
    settings: MapFitSettings,
    at: MapState | None = None,
) -> list[MapFit]:
    fits: list[MapFit] = []
    offset_m, scale = (0.0, 0.0) if at is None else (at.offset_m, at.scale)
    for images in map_starts(network, start_m):
        ends = [fit_from_afar(model, model.state(image, offset_m, scale), settings) for image in images]
        before = min((fit.cost for fit in fits), default=float("inf"))
        found = min(ends, key=lambda fit: fit.cost)
        fits += ends
        is_repeated = network.count > FEW and abs(found.cost - before) <= _SAME * before < float("inf")
        if _is_sure(model, found) or is_repeated:
            break
        # Growing is quick for a few motes, and the shapes of bodies say more.
        may_be_grown = network.count <= FEW and not network.bodies and np.isfinite(settings.robust_scale)
        if len(fits) == len(images) and may_be_grown:
            # Wrong ranges would lead all starts by least squares astray, one after the other.
            found, is_settled = searched(model, found, settings)
            fits.append(found)
            if _is_sure(model, found) or (is_settled and _is_sound(model, found)):
                break
    return fits


def _is_sure(model: MapModel, fit: MapFit) -> bool:
    return fit.cost < _SURE * max(len(model.network.ranges_m) - model.size, 1)


def _is_sound(model: MapModel, fit: MapFit) -> bool:
    network = model.network
    return not agreement_of(fit, network.sigmas_m, len(network.ranges_m) - model.size).is_denied


def pinned_map(
    positions_m: FloatArray, covariance_m2: FloatArray, known_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The map moved so that a point and the direction to another are as known; in the plane.

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
    whole = np.flatnonzero(is_known.all(axis=1))
    part = np.flatnonzero(is_known.sum(axis=1) == 1)
    if positions_m.shape[1] != 2 or len(whole) != 1 or len(part) != 1:
        raise ValueError(
            f"{int(is_known.sum())} known coordinates, wanted both of one mote and one of another in the plane"
        )
    first, second = int(whole[0]), int(part[0])
    axis = int(np.flatnonzero(is_known[second])[0])
    motion = _onto(positions_m, known_m, first, second, axis)
    moved = motion.moved(positions_m)
    count = len(positions_m)
    rows = [2 * first, 2 * first + 1, 2 * second + axis]
    modes = rigid_modes(moved)
    K = np.zeros((3, 2 * count))
    K[np.arange(3), rows] = 1.0
    S = np.eye(2 * count) - modes @ np.linalg.solve(K @ modes, K)
    return moved, S @ motion.turned_map(covariance_m2) @ S.T


def plain_frame(positions_m: FloatArray) -> RigidMotion:
    """The motion to a frame of the map's own: the first mote its origin, the second on +x, the third at y > 0.

    ``positions_m``: shape (n, d), of motes that are not all on a line.
    """
    offsets = positions_m - positions_m[0]
    d = positions_m.shape[1]
    basis: list[FloatArray] = []
    for offset in offsets[1:]:
        rest = offset - sum((offset @ axis) * axis for axis in basis)
        length = float(np.linalg.norm(rest))
        if length > 1e-6 * float(np.linalg.norm(offset)):
            basis.append(rest / length)
        if len(basis) == d:
            break
    rotation = np.array(basis) if len(basis) == d else np.eye(d)
    return RigidMotion(rotation, -rotation @ positions_m[0])


def _onto(positions_m: FloatArray, known_m: FloatArray, first: int, second: int, axis: int) -> RigidMotion:
    way = positions_m[second] - positions_m[first]
    length, bearing = float(np.hypot(*way)), float(np.arctan2(way[1], way[0]))
    wanted = float(np.clip((known_m[second, axis] - known_m[first, axis]) / length, -1.0, 1.0))
    angle = float(np.arccos(wanted)) if axis == 0 else float(np.arcsin(wanted))
    other = -angle if axis == 0 else np.pi - angle
    # In the plane both solutions exist; the map is nearly in the frame already, or its anchors say which it is.
    turn = min((angle - bearing, other - bearing), key=lambda value: abs(np.angle(np.exp(1j * value))))
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s], [s, c]])
    return RigidMotion(rotation, known_m[first] - rotation @ positions_m[first])
