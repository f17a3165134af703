"""Pure. Places for a fit to begin with: unfolded, stitched from patches, trilaterated, drawn."""

from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from ccatp.motes.map_growth import grown
from ccatp.motes.map_patches import stitched
from ccatp.motes.pair_means import PairMeans
from ccatp.motes.phase_one import map_as_possible
from ccatp.motes.range_network import FloatArray, IntArray, MappingError, RangeNetwork
from ccatp.motes.unfolding import unfolded
from ccatp.radio.rigid_alignment import best_motion

_WHOLE = 130  # motes up to which the whole map is unfolded at once; beyond, it is stitched from patches
FEW = 60  # motes up to which unfolding from drawn places costs little
_DRAWS = 16
_FEW_DRAWS = 2  # where there are more, and each takes seconds
_MAX_DOP = 60.0  # of a trilateration that is but a start


def map_starts(network: RangeNetwork, given_m: FloatArray | None) -> Iterator[list[FloatArray]]:
    """Places to begin, the most promising first; each with its mirror image, where bodies tell them apart.

    Args:
        network: ranges, bodies, known places.
        given_m: what the caller has, shape (n, d), nan where nothing is known.
    """
    means = PairMeans(network)
    pairs, distances_m, sigmas_m = _with_bodies(network, means)
    count, d = network.count, network.dimension
    if count > _WHOLE and not network.bodies:
        yield _images(network, _filled(stitched(count, means, d), means))
    yield _images(network, unfolded(count, pairs, distances_m, sigmas_m, d))
    if given_m is not None:
        yield [_filled(given_m, means)]
    with suppress(MappingError):  # no triangle to begin with, or none that is good: the other starts need none
        yield _images(network, _filled(map_as_possible(network, _MAX_DOP).positions_m, means))
    if count <= FEW:
        for draw in range(_DRAWS):  # the same ranges give the same map
            yield _images(network, unfolded(count, pairs, distances_m, sigmas_m, d, rng=np.random.default_rng(draw)))


def grown_starts(network: RangeNetwork, robust_scale: float) -> Iterator[list[FloatArray]]:
    """Maps grown from drawn triangles, which a few wrong ranges do not bend; with their mirror images as before.

    Args:
        network: ranges, bodies, known places.
        robust_scale: of the Cauchy loss, in sigmas.
    """
    means = PairMeans(network)
    pairs, distances_m, sigmas_m = _with_bodies(network, means)
    for draw in range(_DRAWS if network.count <= FEW else _FEW_DRAWS):
        rng = np.random.default_rng(draw)
        places = grown(network.count, pairs, distances_m, sigmas_m, network.dimension, robust_scale, rng)
        if places is not None:
            yield _images(network, _filled(places, means))


def _images(network: RangeNetwork, places_m: FloatArray) -> list[FloatArray]:
    """Places in the frame of known motes, or with their mirror image."""
    known = np.isfinite(network.known_m).all(axis=1)
    if known.sum() > network.dimension:
        return [best_motion(places_m[known], network.known_m[known], mirrors=True).moved(places_m)]
    if not network.bodies and not np.isfinite(network.known_m).any():
        return [places_m]
    flip = np.ones(network.dimension)
    flip[0] = -1.0
    return [places_m, places_m * flip]


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
