"""Phase 1 of self-mapping: a first map by trilateration in a planned order, and its errors by simulation."""

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ccatp.beacons.cricket.map_fit import robust_loss
from ccatp.beacons.cricket.mote_plan import MotePlan
from ccatp.beacons.cricket.range_network import MappingError, PairMeans, RangeNetwork, RigidBody
from ccatp.beacons.rigid_motion import RigidMotion
from ccatp.core import FloatArray
from ccatp.errors import listed

_APART = 10.0  # distance in sigmas above which two solutions are different
_ALIKE = 9.0  # difference of chi-squared below which the mirror image may be the true position
_NEAR = 20  # nearby maps at which errors are drawn
_DRAWN_STEPS = 15  # per drawn trilateration; it converges slowly because references are off by decimetres
_STEPS = 100
_REST_M = 1e-6
_DAMPING = 1e-6  # of the trace of the normal matrix, because the references of a draw may be in line


def trilaterate(
    starts_m: FloatArray, anchors_m: FloatArray, ranges_m: FloatArray, sigmas_m: FloatArray,
    robust_scale: float = float("inf"), steps: int = _STEPS,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Positions from ranges to anchors, and their costs: damped Gauss-Newton on b problems at once.

    Starts (b, d); anchors (b, k, d) and ranges (b, k), or (k, d) and (k,) if common to all problems; sigmas (k,).
    ``robust_scale``: see ``MapFitSettings``.
    """
    d = starts_m.shape[1]

    def look(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        ways = points[:, None] - anchors_m
        distances = np.maximum(np.sqrt((ways**2).sum(axis=2)), 1e-9)
        J = ways / (distances * sigmas_m)[:, :, None]
        residuals = (ranges_m - distances) / sigmas_m
        costs, weights = robust_loss(residuals, robust_scale)
        heavy = J * weights[:, :, None]
        return costs, np.einsum("nk,nkd->nd", residuals, heavy), np.einsum("nki,nkj->nij", heavy, J)

    points, damping = starts_m.copy(), np.full(len(starts_m), _DAMPING)
    costs, gradient, normal = look(points)
    for _ in range(steps):
        ridge = (damping * np.trace(normal, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(d)
        step = np.linalg.solve(normal + ridge, gradient[:, :, None])[:, :, 0]
        seen = look(points + step)
        better = seen[0] <= costs
        points[better] += step[better]
        costs, gradient[better], normal[better] = np.where(better, seen[0], costs), seen[1][better], seen[2][better]
        damping = np.where(better, np.maximum(0.2 * damping, _DAMPING), 10.0 * damping)
        if float(np.abs(step).max()) < _REST_M:
            break
    return points, costs


def sphere_crossings(anchors_m: FloatArray, ranges_m: FloatArray) -> FloatArray:
    """Both intersections of the spheres about anchors, one on each side of the plane through them, shape (2, ..., d).

    For more than d anchors, the points that fit the ranges best on average. ``anchors_m``: shape (..., k, d);
    ``ranges_m``: shape (..., k).
    """
    centre = anchors_m.mean(axis=-2, keepdims=True)
    offsets = anchors_m - centre
    squares = ranges_m**2 - (offsets**2).sum(axis=-1)
    mean = squares.mean(axis=-1, keepdims=True)
    linear = np.linalg.pinv(-2.0 * offsets, rcond=1e-6) @ (squares - mean)[..., None]
    normal = np.linalg.svd(offsets)[2][..., -1, :]
    flat = linear[..., 0] - (normal * linear[..., 0]).sum(axis=-1, keepdims=True) * normal
    height = np.sqrt(np.maximum(mean - (flat**2).sum(axis=-1, keepdims=True), 1e-12))
    foot = centre[..., 0, :] + flat
    return np.stack([foot + height * normal, foot - height * normal])


class DegenerateStep(MappingError):
    """A step of phase 1 whose geometry does not determine a mote well enough."""


class FirstMap(NamedTuple):
    """The result of phase 1."""

    positions_m: FloatArray  # shape (n, d)
    covariance_m2: FloatArray  # of all coordinates, zero without draws, shape (n d, n d)
    bias_m: FloatArray  # estimated mean error of the positions, zero without draws, shape (n, d)
    doubtful: tuple[int, ...] = ()  # motes whose mirror image fits almost as well


def map_by_plan(plan: MotePlan, network: RangeNetwork, max_dop: float, draws: int = 0, maps: int = _NEAR) -> FirstMap:
    """Phase 1 of Patil et al., figure 8, in the frame of the field.

    A is the origin and B lies on the second axis. The first stand follows by the law of cosines, to the right of the
    axis from A to B; each other one by trilateration from all motes of the stand before it. ``draws``, ``maps``: see
    ``_drawn_errors``. Raises MappingError: a range that a step needs is missing. Raises DegenerateStep: a mote is on
    the axis, or nearly in line with its references, or its mirror image fits as well.
    """
    means = PairMeans(network)
    found_m = _laid_out(plan, means, max_dop)
    shaped_m = found_m.copy()  # with the known shapes of the stands
    for stand in plan.bodies:
        shaped_m[list(stand.motes)] = stand.placed(found_m)
    bias_m, covariance_m2 = _drawn_errors(plan, means, shaped_m, draws, maps)
    up = plan.axes_m[1] / np.linalg.norm(plan.axes_m[1])
    motion = RigidMotion(np.column_stack([(up[1], -up[0]), up]), plan.axes_m[0])
    return FirstMap(motion.moved(found_m), motion.turned_map(covariance_m2), bias_m @ motion.rotation.T)


def _steps(plan: MotePlan) -> Iterator[tuple[int, list[int], RigidBody | None]]:
    """Each mote but A and B, with its references: A and B, or the motes of the stand before its own."""
    yield from ((mote, list(plan.anchors), None) for mote in plan.bodies[0].motes)
    for before, after in pairwise(plan.bodies):
        yield from ((mote, list(before.motes), before) for mote in after.motes)


def _laid_out(plan: MotePlan, means: PairMeans, max_dop: float) -> FloatArray:
    places_m, (origin, axis) = np.full((len(plan.names), plan.dimension), np.nan), plan.anchors
    places_m[origin], places_m[axis] = 0.0, (0.0, _ranges(plan, means, axis, [origin])[0][0])
    for mote, references, stand in _steps(plan):
        ranges, sigmas = _ranges(plan, means, mote, references)
        anchors_m, names = places_m[references], listed([plan.names[other] for other in references])
        if stand is None:
            (a, b), c = ranges, anchors_m[1, 1]
            places_m[mote] = _by_cosines(a, b, c)
            if not places_m[mote, 0] > 0.0:
                raise DegenerateStep(
                    f"{plan.names[mote]}: ranges of {a:.3f} and {b:.3f} m to {plan.names[origin]} and "
                    f"{plan.names[axis]}, {c:.3f} m apart, meet on their line or not at all; move the anchors off it"
                )
        else:
            found_m, costs = trilaterate(sphere_crossings(anchors_m, ranges), anchors_m, ranges, sigmas)
            apart_m = float(np.linalg.norm(found_m[1] - found_m[0]))
            if apart_m > _APART * float(sigmas.max()) and abs(costs[1] - costs[0]) < _ALIKE:
                raise DegenerateStep(
                    f"{plan.names[mote]} from {names}: the mirror image across them, {apart_m:.3g} m away, fits as "
                    "well; spread the motes it is measured from"
                )
            places_m[mote] = found_m[np.argmin(costs)]
        # Positions from a small stand have far larger errors than ranges. If a stand came out too wide, the next motes
        # would seem better determined than they are. So use its known shape.
        dop = _dilution(places_m[mote] - (anchors_m if stand is None else stand.placed(places_m)))
        if not dop <= max_dop:
            raise DegenerateStep(
                f"{plan.names[mote]} from {names}: dilution of precision {dop:.4g} exceeds {max_dop:.4g}; spread the "
                "motes it is measured from"
            )
    return places_m


def _dilution(lines: FloatArray) -> float:
    singular = np.linalg.svd(lines / np.linalg.norm(lines, axis=1)[:, None], compute_uv=False)
    return float(np.sqrt((singular**-2.0).sum())) if singular[-1] > 0.0 else float("inf")


def _ranges(plan: MotePlan, means: PairMeans, mote: int, references: list[int]) -> tuple[FloatArray, FloatArray]:
    ranges, sigmas = means.table_m[mote, references], means.sigma_table_m[mote, references]
    if (missing := np.flatnonzero(np.isnan(ranges))).size:
        name = plan.names[mote]
        raise MappingError(
            f"no range between {plan.names[references[missing[0]]]} and {name}: phase 1 cannot place {name}; move it "
            "into reach"
        )
    return ranges, sigmas


def _drawn_errors(
    plan: MotePlan, means: PairMeans, places_m: FloatArray, draws: int, maps: int
) -> tuple[FloatArray, FloatArray]:
    """Mean (n, d) and covariance (n d, n d) of the errors, by the parametric bootstrap (Efron 1979).

    Ranges with the expected errors are drawn at positions near the estimate, and the same steps are made from them.
    First derivatives are not enough: from a small stand errors grow to decimetres along an arc, and a linear
    approximation claims millimetres across it where the true error is centimetres. For the same reason the errors at
    the estimate differ from those at the true positions, so they are drawn again at ``maps`` drawn maps (iterated
    bootstrap: Hall 1986; 0: at the estimate alone). These maps are turned to both sides, so the covariance across the
    arcs is too large (NEES 0.8), and phase 2 is more cautious than with errors at the estimate alone
    (docs/measurements/cricket.md). ``places_m``: the estimate, shape (n, d). Zeros without draws.
    """
    count, d = places_m.shape
    if draws == 0:
        return np.zeros_like(places_m), np.zeros((count * d, count * d))
    rng = np.random.default_rng(0)  # fixed seed: the same ranges give the same result
    near = _drawn(plan, means, places_m, maps, rng) if maps else places_m[None]
    errors = np.concatenate([_drawn(plan, means, at_m, draws // len(near), rng) - at_m for at_m in near])
    errors = errors.reshape(len(errors), -1)
    return errors.mean(axis=0).reshape(count, d), np.atleast_2d(np.cov(errors.T))


def _drawn(plan: MotePlan, means: PairMeans, places_m: FloatArray, draws: int, rng: np.random.Generator) -> FloatArray:
    """Maps by the same steps from noisy ranges between positions (n, d), shape (draws, n, d)."""
    count, d = places_m.shape
    first, second = means.pairs.T
    true_m = np.linalg.norm(places_m[first] - places_m[second], axis=1)
    errors_of = rng.normal(0.0, 1.0, (len(true_m), draws))
    lengths = np.full((count, count, draws), np.nan)
    lengths[first, second] = true_m[:, None] + means.sigmas_m[:, None] * errors_of
    lengths[second, first] = lengths[first, second]
    drawn, (origin, axis) = np.broadcast_to(places_m, (draws, count, d)).copy(), plan.anchors
    drawn[:, axis, 1] = lengths[origin, axis]
    for mote, references, stand in _steps(plan):
        own = lengths[references, mote].T
        if stand is None:
            drawn[:, mote] = _by_cosines(own[:, 0], own[:, 1], drawn[:, axis, 1])
        else:
            starts, sigmas = np.broadcast_to(places_m[mote], (draws, d)), means.sigma_table_m[mote, references]
            drawn[:, mote] = trilaterate(starts, drawn[:, references], own, sigmas, steps=_DRAWN_STEPS)[0]
    return drawn


def _by_cosines(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    # y = (d_A^2 + d_AB^2 - d_B^2) / (2 d_AB), x = sqrt(d_A^2 - y^2); x is zero if the circles do not intersect.
    y = (a * a + c * c - b * b) / (2.0 * c)
    return np.stack([np.sqrt(np.maximum(a * a - y * y, 0.0)), y], axis=-1)
