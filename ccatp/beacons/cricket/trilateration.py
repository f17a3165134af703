"""Phase 1 of self-mapping: a first map by trilateration, by a plan or as the ranges allow, and its drawn errors."""

from collections.abc import Sequence
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from ccatp.beacons.cricket.map_fit import MapFitSettings, MapModel, fit_map, position_covariance
from ccatp.beacons.cricket.range_network import (
    MappingError,
    MoteRange,
    PairMeans,
    RangeNetwork,
    build_network,
    coordinates_of,
    list_names,
)
from ccatp.beacons.cricket.self_mapping import MotePlan
from ccatp.beacons.cricket.unfolding import classical_scaling
from ccatp.core import FloatArray
from ccatp.filters.metrics import RigidMotion, best_motion
from ccatp.mirror.multilateration import MultilaterationError, RangeSolution, multilaterate

_APART = 10.0  # sigmas between two solutions that are not the same one
_ALIKE = 9.0  # difference of chi-squared up to which a mirror image may as well be the truth


class DegenerateStep(MappingError):
    """A step of phase 1 whose geometry does not determine a mote well enough."""


class TrilaterationStep(NamedTuple):
    """How one mote was placed."""

    mote: int
    references: tuple[int, ...]
    dop: float
    how: str  # ``axes``, ``cosines``, ``seed`` or ``trilateration``


class Sketch:
    """Places found so far, with their joint covariance.

    Each place depends on the ranges of its step and on the places it is measured from, whose errors it inherits:
    dx = G (dr + U da), G = (H^T W H)^-1 H^T W, U da the errors of the references along the lines of sight.
    """

    def __init__(self, names: Sequence[str], means: PairMeans, dimension: int, max_dop: float) -> None:
        count = len(names)
        self.positions_m = np.full((count, dimension), np.nan)
        self.covariance_m2 = np.zeros((count * dimension, count * dimension))
        self._seen_m = np.full((count, dimension), np.nan)  # places at which derivatives are taken
        self.steps: list[TrilaterationStep] = []
        self._names, self._means, self._dimension, self._max_dop = names, means, dimension, max_dop

    def is_placed(self, mote: int) -> bool:
        """Whether a mote has a place."""
        return bool(np.isfinite(self.positions_m[mote, 0]))

    def coordinates(self, mote: int) -> slice:
        """Where a mote stands in the covariance."""
        return slice(mote * self._dimension, (mote + 1) * self._dimension)

    def linearise_at(self, motes: Sequence[int], places_m: FloatArray) -> None:
        """Take the derivatives of later steps at better places than those found, shape (k, d).

        The error of a place from a small stand is far larger than that of a range: on a stand whose motes came out
        wider apart than they are, the next ones look better determined than they are.
        """
        self._seen_m[list(motes)] = places_m

    def set_axes(self, origin: int, axis: int) -> None:
        """Origin and second axis: A (0, 0), B (0, d_AB); in the plane alone. Raises MappingError: A and B have none."""
        range_m, sigma_m = self._range(origin, axis)
        self.positions_m[origin] = self._seen_m[origin] = 0.0
        self.positions_m[axis] = self._seen_m[axis] = (0.0, range_m)
        at = self.coordinates(axis).start + 1
        self.covariance_m2[at, at] = sigma_m**2
        self.steps += [TrilaterationStep(origin, (), 0.0, "axes"), TrilaterationStep(axis, (origin,), 1.0, "axes")]

    def add_by_cosines(self, mote: int, origin: int, axis: int) -> None:
        """A mote on the right of the axis from A to B, by the law of cosines.

        y = (d_A^2 + d_AB^2 - d_B^2) / (2 d_AB), x = sqrt(d_A^2 - y^2)

        Raises MappingError: a range to A or B is missing. Raises DegenerateStep: the mote is on the axis, or nearly.
        """
        (a, sigma_a), (b, sigma_b), (c, _) = (
            self._range(origin, mote),
            self._range(axis, mote),
            self._range(origin, axis),
        )
        y = (a * a + c * c - b * b) / (2.0 * c)
        square = a * a - y * y
        if square <= 0.0:
            raise DegenerateStep(
                f"{self._names[mote]}: ranges of {a:.3f} and {b:.3f} m to {self._names[origin]} and "
                f"{self._names[axis]}, {c:.3f} m apart, meet on their line or not at all; move the anchors off it"
            )
        x = float(np.sqrt(square))
        dy = np.array([a / c, -b / c, (c * c + b * b - a * a) / (2.0 * c * c)])
        dx = (np.array([a, 0.0, 0.0]) - y * dy) / x
        jacobian = np.array([dx, dy])
        dop = float(np.sqrt((jacobian[:, :2] ** 2).sum()))
        self._check_dop(mote, (origin, axis), dop)
        own = jacobian[:, :2] * (sigma_a, sigma_b)
        # d_AB is B's own y: its error is B's and stays correlated with it.
        inherited = np.zeros((2, len(self.covariance_m2)))
        inherited[:, self.coordinates(axis).start + 1] = jacobian[:, 2]
        self._insert(mote, np.array([x, y]), own @ own.T, inherited)
        self.steps.append(TrilaterationStep(mote, (origin, axis), dop, "cosines"))

    def add_seed(self, motes: Sequence[int], places_m: FloatArray, covariance_m2: FloatArray) -> None:
        """Motes that begin a map together, with their covariance, shapes (k, d) and (k d, k d)."""
        at = np.concatenate([np.arange(len(self.covariance_m2))[self.coordinates(mote)] for mote in motes])
        self.positions_m[list(motes)] = self._seen_m[list(motes)] = places_m
        self.covariance_m2[np.ix_(at, at)] = covariance_m2
        self.steps += [TrilaterationStep(mote, (), 0.0, "seed") for mote in motes]

    def add_by_ranges(self, mote: int, references: Sequence[int]) -> None:
        """A mote by trilateration from motes that have places, with the solver of the laser system.

        Raises MappingError: a range to a reference is missing. Raises DegenerateStep: the references lie on a line with
        the mote, or nearly.
        """
        ranges = [self._range(reference, mote) for reference in references]
        solution = self._solve(mote, references, ranges)
        lines = solution.position_m - self._seen_m[list(references)]
        H = lines / np.linalg.norm(lines, axis=1)[:, None]
        singular = np.linalg.svd(H, compute_uv=False)
        dop = float(np.sqrt((singular**-2.0).sum())) if singular[-1] > 0.0 else float("inf")
        self._check_dop(mote, references, dop)
        weighted = H / np.array([sigma_m**2 for _, sigma_m in ranges])[:, None]
        G = np.linalg.solve(H.T @ weighted, weighted.T)
        along = np.zeros((len(references), len(self.covariance_m2)))
        for row, reference in enumerate(references):
            along[row, self.coordinates(reference)] = H[row]
        own = np.linalg.solve(H.T @ weighted, np.eye(self._dimension))
        self._insert(mote, solution.position_m, own, G @ along)
        self.steps.append(TrilaterationStep(mote, tuple(references), dop, "trilateration"))

    def _solve(self, mote: int, references: Sequence[int], ranges: Sequence[tuple[float, float]]) -> RangeSolution:
        anchors = self.positions_m[list(references)]
        values, sigmas = np.array(ranges).T
        found, refusal = [], ""
        for start in _starts(anchors, values):
            try:
                # A hundredth of a sigma is rest enough: errors of the references are larger.
                found.append(multilaterate(anchors, values, sigmas, start, tolerance_m=1e-2 * float(sigmas.min())))
            except MultilaterationError as error:
                refusal = str(error)
        if not found:
            raise DegenerateStep(f"{self._names[mote]} from {self._listed(references)}: {refusal}")
        best, *others = sorted(found, key=lambda solution: solution.chi_squared)
        for other in others:
            apart_m = float(np.linalg.norm(other.position_m - best.position_m))
            if apart_m > _APART * float(sigmas.max()) and other.chi_squared - best.chi_squared < _ALIKE:
                raise DegenerateStep(
                    f"{self._names[mote]} from {self._listed(references)}: the mirror image across them, "
                    f"{apart_m:.3g} m away, fits as well; spread the motes it is measured from"
                )
        return best

    def _insert(self, mote: int, place: FloatArray, own: FloatArray, inherited: FloatArray) -> None:
        """A place with its own covariance (d, d) and its derivatives by all coordinates before it (d, n d)."""
        at = self.coordinates(mote)
        cross = inherited @ self.covariance_m2
        self.covariance_m2[at, :] = cross
        self.covariance_m2[:, at] = cross.T
        self.covariance_m2[at, at] = own + cross @ inherited.T
        self.positions_m[mote] = self._seen_m[mote] = place

    def _range(self, first: int, second: int) -> tuple[float, float]:
        found = self._means.between(first, second)
        if found is None:
            raise MappingError(
                f"no range between {self._names[first]} and {self._names[second]}: phase 1 cannot place "
                f"{self._names[second]}; move it into reach"
            )
        return found

    def _check_dop(self, mote: int, references: Sequence[int], dop: float) -> None:
        if not dop <= self._max_dop:
            raise DegenerateStep(
                f"{self._names[mote]} from {self._listed(references)}: dilution of precision {dop:.4g} exceeds "
                f"{self._max_dop:.4g}; spread the motes it is measured from"
            )

    def _listed(self, motes: Sequence[int]) -> str:
        return list_names([self._names[mote] for mote in motes])


def _starts(anchors: FloatArray, ranges: FloatArray) -> list[FloatArray]:
    centre = anchors.mean(axis=0)
    offsets = anchors - centre
    arms = (offsets**2).sum(axis=1)
    squares = ranges**2 - arms
    linear = np.linalg.lstsq(-2.0 * offsets, squares - squares.mean(), rcond=1e-6)[0]
    normal = np.linalg.svd(offsets)[2][-1]
    flat = linear - float(linear @ normal) * normal
    height = float(np.sqrt(max(float(np.mean(squares)) - float(flat @ flat), 1e-12)))
    return [centre + flat + height * normal, centre + flat - height * normal]


_STEPS = 15  # of each trilateration; references that are decimetres off make it go slowly
_REST_M = 1e-5
_DAMPING = 1e-6  # of the trace of the normal matrix: references of a draw may come to lie in line


def draw_errors(
    places_m: FloatArray,
    steps: Sequence[TrilaterationStep],
    means: PairMeans,
    seed_covariance_m2: FloatArray,
    rng: np.random.Generator,
    draws: int,
) -> tuple[FloatArray, FloatArray]:
    """Mean (n, d) and covariance (n d, n d) of the errors of a trilateration, by the parametric bootstrap (Efron 1979).

    At places close to those that were found, ranges with errors as they are expected are drawn, and the same steps made
    of them. Derivatives give the size of the errors as well, but not how they hang together: from a small stand errors
    grow to decimetres, and along so wide an arc no line is a tangent everywhere. What a line takes to be known within a
    millimetre is known within centimetres. ``places_m``: where the motes might be, nan for those without a place, shape
    (n, d); A at the origin, B on the second axis, where the steps begin with these two. ``seed_covariance_m2``: of the
    motes that began the map together, shape (n d, n d); those of axes need none.
    """
    count, d = places_m.shape
    drawn = np.broadcast_to(places_m, (draws, count, d)).copy()
    errors_of = rng.normal(0.0, 1.0, (len(means.pairs), draws))

    def ranges_of(first: int, second: int) -> FloatArray:
        row = means.row(first, second)
        true = float(np.linalg.norm(places_m[first] - places_m[second]))
        return np.asarray(true + float(means.sigmas_m[row]) * errors_of[row])

    seeds = [step.mote for step in steps if step.how == "seed"]
    if seeds:
        at = coordinates_of(seeds, d)
        errors = rng.multivariate_normal(np.zeros(at.size), seed_covariance_m2[np.ix_(at, at)], draws, method="eigh")
        drawn[:, seeds] += errors.reshape(draws, len(seeds), d)
    for step in steps:
        if step.how == "axes":
            drawn[:, step.mote] = 0.0
            if step.references:
                drawn[:, step.mote, 1] = ranges_of(step.references[0], step.mote)
        elif step.how == "cosines":
            origin, axis = step.references
            a, b, c = (ranges_of(*pair) for pair in ((origin, step.mote), (axis, step.mote), (origin, axis)))
            y = (a * a + c * c - b * b) / (2.0 * c)
            drawn[:, step.mote] = np.column_stack([np.sqrt(np.maximum(a * a - y * y, 0.0)), y])
        elif step.how == "trilateration":
            lengths = np.column_stack([ranges_of(reference, step.mote) for reference in step.references])
            sigmas = np.array([means.sigmas_m[means.row(reference, step.mote)] for reference in step.references])
            drawn[:, step.mote] = _trilaterated(drawn[:, list(step.references)], lengths, sigmas, places_m[step.mote])
    errors = np.nan_to_num(drawn - places_m)
    bias = errors.mean(axis=0)
    flat = (errors - bias).reshape(draws, -1)
    return bias, flat.T @ flat / (draws - 1)


def _trilaterated(anchors: FloatArray, lengths: FloatArray, sigmas: FloatArray, start: FloatArray) -> FloatArray:
    """Least squares on the lengths, damped Gauss-Newton of all draws at once.

    Args:
        anchors: places of the references, shape (draws, k, d).
        lengths: to them, shape (draws, k).
        sigmas: shape (k,).
        start: shape (d,).

    Returns:
        Shape (draws, d).
    """
    d = anchors.shape[2]
    points = np.broadcast_to(start, (len(anchors), d)).copy()
    damping = np.full(len(anchors), _DAMPING)
    cost, gradient, normal = _look(points, anchors, lengths, sigmas)
    for _ in range(_STEPS):
        ridge = (damping * np.trace(normal, axis1=1, axis2=2))[:, None, None] * np.eye(d)
        step = np.linalg.solve(normal + ridge, gradient[:, :, None])[:, :, 0]
        seen = _look(points + step, anchors, lengths, sigmas)
        better = seen[0] <= cost
        points[better] += step[better]
        cost, gradient[better], normal[better] = np.where(better, seen[0], cost), seen[1][better], seen[2][better]
        damping = np.where(better, np.maximum(0.2 * damping, _DAMPING), 10.0 * damping)
        if float(np.abs(step).max()) < _REST_M:
            break
    return points


def _look(
    points: FloatArray, anchors: FloatArray, lengths: FloatArray, sigmas: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    ways = points[:, None] - anchors
    distances = np.maximum(np.sqrt((ways**2).sum(axis=2)), 1e-9)
    J = ways / (distances * sigmas)[:, :, None]
    residuals = (lengths - distances) / sigmas
    return ((residuals**2).sum(axis=1), np.einsum("nk,nkd->nd", residuals, J), np.einsum("nki,nkj->nij", J, J))


_FLAT = 4.0  # of range errors that may make a flat beginning look high
_CLIQUES = 4000  # first motes looked at; the best of them begins the map


class FirstMap(NamedTuple):
    """What phase 1 gives."""

    positions_m: FloatArray  # nan for motes without a place, shape (n, d)
    covariance_m2: FloatArray  # of all coordinates, zero for motes without a place, shape (n d, n d)
    bias_m: FloatArray  # mean error of the places, as far as it is known, shape (n, d)
    steps: tuple[TrilaterationStep, ...]
    unplaced: tuple[int, ...]


def map_by_plan(plan: MotePlan, network: RangeNetwork, max_dop: float, draws: int = 0) -> FirstMap:
    """Phase 1 of Patil et al., figure 8, in the field's frame.

    A is the origin, B on the second axis, the first stand follows by the law of cosines, every other one by
    trilateration from all motes of the stand before it. Bias and covariance of the errors are drawn; without draws the
    covariance is by derivatives. Raises MappingError: a step that cannot be made; the message names its motes.
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
    shaped = sketch.positions_m.copy()  # with the stands as they are known to be
    for stand in plan.bodies:
        motes = list(stand.motes)
        shaped[motes] = best_motion(stand.local_m, sketch.positions_m[motes]).moved(stand.local_m)
    bias, covariance = _errors(sketch, shaped, means, draws)
    motion = RigidMotion(field_from_map, plan.axes_m[0])
    positions, covariance = motion.moved(sketch.positions_m), motion.turned_map(covariance)
    return FirstMap(positions, covariance, bias @ field_from_map.T, tuple(sketch.steps), ())


def _errors(sketch: Sketch, places_m: FloatArray, means: PairMeans, draws: int) -> tuple[FloatArray, FloatArray]:
    if draws == 0:
        return np.zeros_like(places_m), sketch.covariance_m2
    # The same draws for every map: the same ranges give the same one.
    return draw_errors(places_m, sketch.steps, means, sketch.covariance_m2, np.random.default_rng(0), draws)


def map_as_possible(network: RangeNetwork, max_dop: float, draws: int = 0) -> FirstMap:
    """A trilateration without a plan: a good triangle (tetrahedron) of motes begins, whoever has most ranges follows.

    Motes that cannot be placed well enough, from d + 1 others at least, are left out. Raises DegenerateStep: there is
    no triangle (tetrahedron) to begin with.
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
    bias, covariance = _errors(sketch, sketch.positions_m, means, draws)
    return FirstMap(sketch.positions_m, covariance, bias, tuple(sketch.steps), unplaced)


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
    sides = [means.row(a, b) for a, b in combinations(best, 2)]
    if best_height_m**2 < _FLAT * longest_m * max(means.sigmas_m[sides].tolist()):
        raise DegenerateStep(
            f"{', '.join(names)}: the best motes to begin with lie {'in a line' if d == 2 else 'in a plane'}, or "
            "nearly: trilateration has no beginning"
        )
    at = zip(combinations(range(d + 1), 2), sides, strict=True)
    rows = [MoteRange(names[a], names[b], *means.values(row)) for (a, b), row in at]
    model = MapModel(build_network(rows, d, names))
    start = classical_scaling(_distances(means, best), d)
    fit = fit_map(model, model.state(start), MapFitSettings())
    covariance, _ = position_covariance(model, fit)
    sketch.add_seed(best, fit.state.positions_m, covariance)


def _height(means: PairMeans, motes: tuple[int, ...]) -> float:
    # Least width of a simplex, m: its smallest extent along a principal axis.
    points = classical_scaling(_distances(means, motes), len(motes) - 1)
    return float(np.linalg.svd(points, compute_uv=False)[-1])


def _distances(means: PairMeans, motes: tuple[int, ...]) -> FloatArray:
    matrix = np.zeros((len(motes), len(motes)))
    for a, b in combinations(range(len(motes)), 2):
        matrix[a, b] = matrix[b, a] = means.ranges_m[means.row(motes[a], motes[b])]
    return matrix
