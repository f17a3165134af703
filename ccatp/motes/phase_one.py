"""Pure. A first map by trilateration: stand after stand as a plan says, or mote after mote as the ranges allow."""

from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from ccatp.motes.drawn_errors import DrawnErrors, draw_errors
from ccatp.motes.map_batch import BatchSettings, fit_map, position_covariance
from ccatp.motes.map_model import MapModel
from ccatp.motes.mote_plan import MotePlan
from ccatp.motes.pair_means import PairMeans
from ccatp.motes.range_network import FloatArray, MappingError, RangeNetwork, build_network
from ccatp.motes.tdoa import MoteRange
from ccatp.motes.trilateration import DegenerateStep, Sketch, Step
from ccatp.motes.unfolding import classical_scaling
from ccatp.radio.rigid_alignment import RigidMotion, best_motion

_FLAT = 4.0  # of range errors that may make a flat beginning look high
_CLIQUES = 4000  # first motes looked at; the best of them begins the map


class FirstMap(NamedTuple):
    """What phase 1 gives.

    Attributes:
        positions_m: nan for motes without a place, shape (n, d).
        covariance_m2: of all coordinates, zero for motes without a place, shape (n d, n d).
        bias_m: mean error of the places, as far as it is known, shape (n, d).
        steps: in their order.
        unplaced: motes that no step reached.
    """

    positions_m: FloatArray
    covariance_m2: FloatArray
    bias_m: FloatArray
    steps: tuple[Step, ...]
    unplaced: tuple[int, ...]


def map_by_plan(plan: MotePlan, network: RangeNetwork, max_dop: float, draws: int = 0) -> FirstMap:
    """Phase 1 of Patil et al., figure 8, in the field's frame.

    A is the origin, B on the second axis, the first stand follows by the law of cosines, every other one by
    trilateration from all motes of the stand before it.

    Args:
        plan: anchors, stands, the frame.
        network: ranges of ``plan.phase1_pairs``.
        max_dop: dilution of precision that no step may exceed.
        draws: of the errors, for bias and covariance; 0 for a covariance by derivatives, and no bias.

    Raises:
        MissingRange, DegenerateStep: a step that cannot be made; the message names its motes.
    """
    means = PairMeans(network)
    sketch = Sketch(plan.names, means, plan.dimension, max_dop)
    origin, axis = plan.anchors
    sketch.set_axes(origin, axis)
    for mote in plan.networks[0]:
        sketch.add_by_cosines(mote, origin, axis)
    for (stand, before), (_, after) in pairwise(zip(plan.bodies, plan.networks, strict=True)):
        shape = best_motion(stand.local_m, sketch.positions_m[list(before)]).moved(stand.local_m)
        sketch.linearise_at(before, shape)
        for mote in after:
            sketch.add_by_ranges(mote, before)
    up = plan.axes_m[1] / np.linalg.norm(plan.axes_m[1])
    field_from_map = np.column_stack([(up[1], -up[0]), up])
    errors = _errors(sketch, _shaped(plan, sketch.positions_m), means, draws)
    motion = RigidMotion(field_from_map, plan.axes_m[0])
    positions, covariance = motion.moved(sketch.positions_m), motion.turned_map(errors.covariance_m2)
    return FirstMap(positions, covariance, errors.bias_m @ field_from_map.T, tuple(sketch.steps), ())


def _shaped(plan: MotePlan, found_m: FloatArray) -> FloatArray:
    """Places with the stands as they are known to be."""
    places = found_m.copy()
    for stand in plan.bodies:
        motes = list(stand.motes)
        places[motes] = best_motion(stand.local_m, found_m[motes]).moved(stand.local_m)
    return places


def _errors(sketch: Sketch, places_m: FloatArray, means: PairMeans, draws: int) -> DrawnErrors:
    if draws == 0:
        return DrawnErrors(np.zeros_like(places_m), sketch.covariance_m2)
    # The same draws for every map: the same ranges give the same one.
    return draw_errors(places_m, sketch.steps, means, sketch.covariance_m2, np.random.default_rng(0), draws)


def map_as_possible(network: RangeNetwork, max_dop: float, draws: int = 0) -> FirstMap:
    """A trilateration without a plan: a good triangle (tetrahedron) of motes begins, whoever has most ranges follows.

    Motes that cannot be placed well enough, from d + 1 others at least, are left out.

    Args:
        network: the ranges.
        max_dop: dilution of precision that no step may exceed.
        draws: as of ``map_by_plan``.

    Raises:
        DegenerateStep: there is no triangle (tetrahedron) to begin with.
    """
    means = PairMeans(network)
    sketch = Sketch(network.names, means, network.dimension, max_dop)
    _seed(network, means, sketch)
    refused: set[int] = set()
    while True:
        reach = {
            mote: [partner for partner in means.partners(mote) if sketch.is_placed(partner)]
            for mote in range(network.count)
            if mote not in refused and not sketch.is_placed(mote)
        }
        ready = [mote for mote, references in reach.items() if len(references) > network.dimension]
        if not ready:
            break
        mote = max(ready, key=lambda candidate: len(reach[candidate]))
        try:
            sketch.add_by_ranges(mote, reach[mote])
            refused.clear()  # what was refused for want of references may have one more now
        except DegenerateStep:
            refused.add(mote)
    unplaced = tuple(mote for mote in range(network.count) if not sketch.is_placed(mote))
    errors = _errors(sketch, sketch.positions_m, means, draws)
    return FirstMap(sketch.positions_m, errors.covariance_m2, errors.bias_m, tuple(sketch.steps), unplaced)


def _seed(network: RangeNetwork, means: PairMeans, sketch: Sketch) -> None:
    d = network.dimension
    best, best_height_m, seen = None, 0.0, 0
    for i, j in means.pairs.tolist():
        common = sorted(set(means.partners(i)) & set(means.partners(j)))
        for rest in combinations([mote for mote in common if mote > j], d - 1):
            if not means.are_all_linked(rest):
                continue
            seen += 1
            height_m = _height(means, (i, j, *rest))
            if height_m > best_height_m:
                best, best_height_m = (i, j, *rest), height_m
        if seen > _CLIQUES:
            break
    if best is None:
        shape = "triangle" if d == 2 else "tetrahedron"
        raise DegenerateStep(f"no {shape} of motes with ranges between all of them: trilateration has no beginning")
    names = [network.names[mote] for mote in best]
    longest_m = float(_distances(means, best).max())
    # A simplex that is flat looks as high as this by the errors of its ranges alone.
    if best_height_m**2 < _FLAT * longest_m * max(sigma for _, sigma in _sides(means, best)):
        raise DegenerateStep(
            f"{', '.join(names)}: the best motes to begin with lie {'in a line' if d == 2 else 'in a plane'}, or "
            "nearly: trilateration has no beginning"
        )
    rows = [MoteRange(names[a], names[b], *_between(means, best[a], best[b])) for a, b in combinations(range(d + 1), 2)]
    model = MapModel(build_network(rows, d, names))
    start = classical_scaling(_distances(means, best), d)
    fit = fit_map(model, model.state(start), BatchSettings())
    covariance, _ = position_covariance(model, fit)
    sketch.add_seed(best, fit.state.positions_m, covariance)


def _height(means: PairMeans, motes: tuple[int, ...]) -> float:
    """Least width of a simplex, m: its smallest extent along a principal axis."""
    points = classical_scaling(_distances(means, motes), len(motes) - 1)
    return float(np.linalg.svd(points, compute_uv=False)[-1])


def _sides(means: PairMeans, motes: tuple[int, ...]) -> list[tuple[float, float]]:
    """Range and sigma of every two of some motes."""
    return [_between(means, a, b) for a, b in combinations(motes, 2)]


def _distances(means: PairMeans, motes: tuple[int, ...]) -> FloatArray:
    matrix = np.zeros((len(motes), len(motes)))
    for a, b in combinations(range(len(motes)), 2):
        matrix[a, b] = matrix[b, a] = _between(means, motes[a], motes[b])[0]
    return matrix


def _between(means: PairMeans, first: int, second: int) -> tuple[float, float]:
    found = means.between(first, second)
    if found is None:
        raise MappingError(f"no range between motes {first} and {second}")
    return found
