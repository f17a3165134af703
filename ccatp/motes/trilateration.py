"""Pure. Phase 1 of self-mapping: two axes, the law of cosines, then mote after mote by trilateration."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ccatp.motes.pair_means import PairMeans
from ccatp.motes.range_network import FloatArray, MappingError, list_names
from ccatp.radio.multilateration import MultilaterationError, Solution, multilaterate

_APART = 10.0  # sigmas between two solutions that are not the same one
_ALIKE = 9.0  # difference of chi-squared up to which a mirror image may as well be the truth


class DegenerateStep(MappingError):
    """A step of phase 1 whose geometry does not determine a mote well enough."""


class MissingRange(MappingError):
    """A step of phase 1 lacks a range."""


class Step(NamedTuple):
    """How one mote was placed.

    Attributes:
        mote: its index.
        references: by whose places.
        dop: dilution of precision of the step, dimensionless.
        how: ``axes``, ``cosines``, ``seed`` or ``trilateration``.
    """

    mote: int
    references: tuple[int, ...]
    dop: float
    how: str


class Sketch:
    """Places found so far, with their joint covariance.

    Each place depends on the ranges of its step and on the places it is measured from, whose errors it inherits:
    dx = G (dr + U da), G = (H^T W H)^-1 H^T W, U da the errors of the references along the lines of sight.

    Args:
        names: of the motes, for messages.
        means: the ranges.
        dimension: d.
        max_dop: a step with a larger dilution of precision is refused.
    """

    def __init__(self, names: Sequence[str], means: PairMeans, dimension: int, max_dop: float) -> None:
        count = len(names)
        self.positions_m = np.full((count, dimension), np.nan)
        self.covariance_m2 = np.zeros((count * dimension, count * dimension))
        self._seen_m = np.full((count, dimension), np.nan)  # places at which derivatives are taken
        self.steps: list[Step] = []
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
        """Origin and second axis: A (0, 0), B (0, d_AB); in the plane alone.

        Raises:
            MissingRange: A and B have none.
        """
        range_m, sigma_m = self._range(origin, axis)
        self.positions_m[origin] = self._seen_m[origin] = 0.0
        self.positions_m[axis] = self._seen_m[axis] = (0.0, range_m)
        at = self.coordinates(axis).start + 1
        self.covariance_m2[at, at] = sigma_m**2
        self.steps += [Step(origin, (), 0.0, "axes"), Step(axis, (origin,), 1.0, "axes")]

    def add_by_cosines(self, mote: int, origin: int, axis: int) -> None:
        """A mote on the right of the axis from A to B, by the law of cosines.

        y = (d_A^2 + d_AB^2 - d_B^2) / (2 d_AB), x = sqrt(d_A^2 - y^2)

        Raises:
            MissingRange: a range to A or B is missing.
            DegenerateStep: the mote is on the axis, or nearly.
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
        self.steps.append(Step(mote, (origin, axis), dop, "cosines"))

    def add_seed(self, motes: Sequence[int], places_m: FloatArray, covariance_m2: FloatArray) -> None:
        """Motes that begin a map together, with their covariance, shapes (k, d) and (k d, k d)."""
        at = np.concatenate([np.arange(len(self.covariance_m2))[self.coordinates(mote)] for mote in motes])
        self.positions_m[list(motes)] = self._seen_m[list(motes)] = places_m
        self.covariance_m2[np.ix_(at, at)] = covariance_m2
        self.steps += [Step(mote, (), 0.0, "seed") for mote in motes]

    def add_by_ranges(self, mote: int, references: Sequence[int]) -> None:
        """A mote by trilateration from motes that have places, with the solver of the laser system.

        Raises:
            MissingRange: a range to a reference is missing.
            DegenerateStep: the references lie on a line with the mote, or nearly.
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
        self.steps.append(Step(mote, tuple(references), dop, "trilateration"))

    def _solve(self, mote: int, references: Sequence[int], ranges: Sequence[tuple[float, float]]) -> Solution:
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
            raise MissingRange(
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
    """Where to begin: the solution of the differences of squared ranges, on both sides of the references.

    The differences tell little of the height above references that are nearly flat; the mean of the squared ranges
    tells how much is missing.
    """
    centre = anchors.mean(axis=0)
    offsets = anchors - centre
    arms = (offsets**2).sum(axis=1)
    squares = ranges**2 - arms
    linear = np.linalg.lstsq(-2.0 * offsets, squares - squares.mean(), rcond=1e-6)[0]
    normal = np.linalg.svd(offsets)[2][-1]
    flat = linear - float(linear @ normal) * normal
    height = float(np.sqrt(max(float(np.mean(squares)) - float(flat @ flat), 1e-12)))
    return [centre + flat + height * normal, centre + flat - height * normal]
