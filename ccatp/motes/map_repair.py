"""Pure. Maps anew, with all around them held, the places of a map where ranges contradict it."""

import numpy as np

from ccatp.motes.map_batch import BatchFit, BatchSettings, fit_map
from ccatp.motes.map_model import MapModel
from ccatp.motes.pair_means import PairMeans
from ccatp.motes.range_network import FloatArray, IntArray, RangeNetwork, components
from ccatp.motes.unfolding import unfolded
from ccatp.radio.rigid_alignment import best_motion

_SUSPECT = 4.0  # residual in sigmas that makes both ends of a range suspects
_LARGEST = 60  # motes of one place that is mapped anew
_ROUNDS = 3


def repaired(model: MapModel, fit: BatchFit, settings: BatchSettings) -> BatchFit:
    """A map whose contradictions were looked at one place at a time; bodies and known motes stay as they are.

    A few motes that are folded over together are a minimum of their own. Where ranges disagree with the map, the motes
    at their ends and all their partners are taken out and unfolded afresh between the motes that hold them.

    Args:
        model: network and unknowns.
        fit: where to begin.
        settings: of the fits.
    """
    network = model.network
    if network.bodies:
        return fit
    for _ in range(_ROUNDS):
        better = False
        for motes in _contradicted(network, fit):
            places = _mapped_anew(network, fit, motes, settings)
            if places is None:
                continue
            other = fit_map(model, model.state(places, fit.state.offset_m, fit.state.scale), settings)
            if other.cost < fit.cost * (1.0 - 1e-6):
                fit, better = other, True
        if not better:
            break
    return fit


def _contradicted(network: RangeNetwork, fit: BatchFit) -> list[IntArray]:
    """Suspects and their partners, each set that hangs together by itself."""
    bad = np.abs(fit.residuals_m) > _SUSPECT * network.sigmas_m
    if not bad.any():
        return []
    pairs = np.column_stack([network.first, network.second])
    suspects = np.unique(pairs[bad])
    near = np.unique(pairs[np.isin(pairs, suspects).any(axis=1)])
    inside = np.isin(pairs, near).all(axis=1)
    labels = components(network.count, pairs[inside])
    groups = [near[labels[near] == label] for label in np.unique(labels[near])]
    return [group for group in groups if len(group) <= _LARGEST]


def _mapped_anew(network: RangeNetwork, fit: BatchFit, motes: IntArray, settings: BatchSettings) -> FloatArray | None:
    """All places with some motes unfolded between their partners; None where too little holds them."""
    d = network.dimension
    pairs = np.column_stack([network.first, network.second])
    rows = np.flatnonzero(np.isin(pairs, motes).any(axis=1))
    members = np.unique(pairs[rows])
    ring = np.setdiff1d(members, motes)
    if len(ring) < d + 1:
        return None
    index = {int(mote): place for place, mote in enumerate(members)}
    known = np.where(np.isin(members, ring)[:, None], fit.state.positions_m[members], np.nan)
    part = RangeNetwork(
        names=tuple(network.names[mote] for mote in members),
        dimension=d,
        first=np.array([index[int(mote)] for mote in network.first[rows]], dtype=np.intp),
        second=np.array([index[int(mote)] for mote in network.second[rows]], dtype=np.intp),
        ranges_m=(network.ranges_m[rows] - fit.state.offset_m) / (1.0 + fit.state.scale),
        sigmas_m=network.sigmas_m[rows],
        bodies=(),
        known_m=known,
    )
    means = PairMeans(part)
    at = np.flatnonzero(np.isfinite(known[:, 0]))
    a, b = np.triu_indices(len(at), 1)
    held = np.linalg.norm(known[at[a]] - known[at[b]], axis=1)
    start = unfolded(
        len(members),
        np.concatenate([means.pairs, np.column_stack([at[a], at[b]])]),
        np.concatenate([means.ranges_m, held]),
        np.concatenate([means.sigmas_m, np.full(len(a), float(means.sigmas_m.min()))]),
        d,
    )
    start = best_motion(start[at], known[at], mirrors=True).moved(start)
    model = MapModel(part)
    found = fit_map(model, model.state(start), settings)
    places = fit.state.positions_m.copy()
    places[members] = found.state.positions_m
    return places
