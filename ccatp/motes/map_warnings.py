"""Pure. What is said about a map of measured ranges: doubts, contradictions, and what may be behind them."""

from collections.abc import Iterator, Mapping

import numpy as np
from scipy.special import chdtrc

from ccatp.motes.map_agreement import agreement_of
from ccatp.motes.map_batch import BatchSettings, fit_map
from ccatp.motes.map_model import MapModel
from ccatp.motes.mote_map import MoteMap, map_motes
from ccatp.motes.range_network import FloatArray, RangeNetwork, list_names

_TELLING = 12.0  # a drop of chi-squared that chance gives one offset in two thousand
_CHANCE = 1e-4  # that sound ranges of one pair of all disagree as much
_SCATTER = 1.5  # factor of the sigmas that is worth a word
_FOLDS = 5  # sets of motes that are named
_IN_SPACE = ", or the motes are not in a plane: --dimension 3 maps them in space"


def disagreeing(network: RangeNetwork) -> Iterator[str]:
    """A word on the pair whose own ranges contradict each other most, more than chance would have them."""
    pairs = np.sort(np.column_stack([network.first, network.second]), axis=1)
    found, place = np.unique(pairs, axis=0, return_inverse=True)
    place = place.ravel()
    weights = network.sigmas_m**-2.0
    means = np.bincount(place, weights * network.ranges_m) / np.bincount(place, weights)
    squares = np.bincount(place, weights * (network.ranges_m - means[place]) ** 2)
    chances = chdtrc(np.maximum(np.bincount(place) - 1, 1), squares)
    if not (bad := np.flatnonzero(chances < _CHANCE / len(found))).size:
        return
    worst = int(bad[np.argmax(squares[bad])])
    ranges = network.ranges_m[place == worst]
    more = f" and {bad.size - 1} more pairs" if bad.size > 1 else ""
    first, second = (network.names[mote] for mote in found[worst])
    yield (
        f"ranges between {first} and {second}{more} disagree among themselves: {ranges.min():.4g} to "
        f"{ranges.max():.4g} m with a sigma of {network.sigmas_m[place == worst].min():.3g} m"
    )


def doubts(found: MoteMap, network: RangeNetwork, factor: float) -> Iterator[str]:
    """Words on folds, contradictions, scatter and outliers of a batch map.

    Args:
        found: the map.
        network: its ranges.
        factor: of the sigmas, as the residuals told it.
    """
    for fold in found.folds[:_FOLDS]:
        motes = list_names([network.names[mote] for mote in fold.motes])
        yield f"{motes}: the mirror image fits almost as well (chi-squared {fold.cost_gap:.1f} more)"
    in_space = _IN_SPACE if network.dimension == 2 else ""
    agreement, count = found.agreement, len(network.ranges_m)
    if agreement.is_denied:
        yield (
            f"the map contradicts its ranges: {agreement.outliers} of {count} far off it, chi-squared "
            f"{agreement.factor:.1f} for each degree of freedom of the others; it is folded, or the sigmas are too "
            f"small{in_space}"
        )
    elif agreement.outliers:
        rows = agreement.outlying
        pairs = [f"{network.names[network.first[row]]} to {network.names[network.second[row]]}" for row in rows]
        yield f"{agreement.outliers} of {count} ranges contradict the others and count for little: {list_names(pairs)}"
    if factor > _SCATTER:
        yield (
            f"ranges scatter by {1e3 * found.sigma_m:.3g} mm, {factor:.1f} times what they were taken for: they are "
            f"worse{in_space}"
        )


def hidden_offset(found: MoteMap, network: RangeNetwork, settings: BatchSettings) -> Iterator[str]:
    """A word on an offset that the ranges show, where none is estimated; outliers have little say in it.

    Args:
        found: the map.
        network: its ranges, with the sigmas that they were found to have.
        settings: of the fits.
    """
    model = MapModel(network, with_offset=True)
    dof = len(network.ranges_m) - model.size
    if dof <= 0:
        return
    state = model.state(found.positions_m, 0.0, found.scale)
    without, shown = fit_map(MapModel(network), state, settings), fit_map(model, state, settings)
    cost, offset_m = shown.cost, shown.state.offset_m
    agreement = agreement_of(shown, network.sigmas_m, dof)
    if found.agreement.is_denied:
        # An offset may have bent the map too far to be seen from there.
        anew = map_motes(network, settings, with_offset=True)
        cost, offset_m, agreement = anew.cost, anew.offset_m, anew.agreement
    # Where the ranges deny the map even so, any unknown more betters it, and means nothing.
    if without.cost - cost > _TELLING and not agreement.is_denied:
        yield (
            f"all ranges look {1e3 * offset_m:.0f} mm long in common (chi-squared {without.cost:.0f}, "
            f"{cost:.0f} with an offset); --offset estimates it"
        )


def untold(name: str) -> str:
    """A word on an offset or a scale that was to be estimated and cannot be."""
    return f"no {name} can be told from these ranges: the map takes it up, and its own size is free; leave --{name} out"


def left_out_heights(
    option: str, places_m: Mapping[str, tuple[float, ...]], dimension: int, least_m: float
) -> Iterator[str]:
    """A word on third coordinates that a map in the plane has no use for, where they differ by more than so much."""
    heights_m = [place[2] for place in places_m.values() if len(place) > dimension]
    if heights_m and (spread_m := max(heights_m) - min(heights_m)) > least_m:
        yield (
            f"{option}: z_m, which differs by {spread_m:.3g} m, is left out of a map in 2 dimensions; --dimension 3 "
            "maps in space"
        )


def is_flat(error_m: float | None, places_m: FloatArray) -> bool:
    """Whether an error expected is larger than the map's least extent, root mean square.

    Args:
        error_m: expected, by derivatives at the map.
        places_m: shape (n, d); of n motes, n - 1 extents count.
    """
    extents_m = np.linalg.svd(places_m - places_m.mean(axis=0), compute_uv=False) / np.sqrt(len(places_m))
    extents_m = extents_m[: len(places_m) - 1]
    return error_m is not None and bool(extents_m.size) and error_m > float(extents_m[-1])


def flat(dimension: int) -> str:
    """A word on a map whose motes lie in fewer dimensions than it has."""
    return (
        f"the motes lie {'in a line' if dimension == 2 else 'in a plane'}, or nearly: the ranges do not tell how far "
        "each is off it"
    )
