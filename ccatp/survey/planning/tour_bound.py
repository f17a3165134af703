"""Lower bound of the time of a tour through the measurement points in any order, to judge orders by."""

from collections.abc import Sequence
from math import pi
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccatp.config.models import LimitsConfig
from ccatp.core import FloatArray, IntArray, PointId
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.search import STRAIGHT_RAD

# Least number of nearest places whose legs are distinguished: the eight around a point of the grid. All further legs of
# a place count as the two shortest of them.
_NEAR = 8
_NONE = -1  # index that stands for a far leg or no leg


class _Choices(NamedTuple):
    """The possible neighbours of each place in a tour: one choice per row, the choices of a place in sequence."""

    place: IntArray  # the place; 0 is base, shape (m,)
    near: IntArray  # its neighbours, ``_NONE`` for a far one or none, shape (m, 2)
    is_end: NDArray[np.bool_]  # the tour ends there, shape (m,)
    cost_s: FloatArray  # half of each leg, and the turn between them, shape (m,)


def tour_bound(mirror: Mirror, points: Sequence[PointId], limits: LimitsConfig, measuring_time_s: float) -> float:
    """Least time that any tour takes from base through all points, in any order, s.

    A tour drives straight from point to point, forward or in reverse, rests at each and turns in place; it may end
    anywhere. The rim is ignored. Stops in between are not counted: a tour with such stops is bounded by its legs alone.

    The bound: assign half of each leg to either of its ends. Then a tour costs the sum over its places of
    ``c_p(q, r) = (T_pq + T_pr)/2 + turn``, with q and r the neighbours of p; at base and at the last point, with one
    neighbour, of half a leg. Driving in reverse changes a heading by pi, so no turn is longer than pi/2. Let p pay a
    price ``l_pq`` for the leg to q, with ``l_qp = -l_pq``, and the last point pay a price m: along a tour the prices of
    the legs cancel, and one m is paid. So for *any* prices

        tour >= sum over p of min over (q, r) of [c_p(q, r) + l_pq + l_pr (+ m at an end)] - m,

    since no place of the tour costs less than its cheapest choice. The best prices are the dual values of the linear
    programme in which each place mixes its choices such that both ends of a leg agree about it. If the solver stops
    early, the bound is lower but still valid. Far legs have no price and no turn, which only lowers the bound.
    """
    if not points:
        return 0.0
    choices = _choices(mirror, points, limits)
    return _priced(choices) + len(points) * measuring_time_s


def _leg_times(surface: FloatArray, place: int, limits: LimitsConfig) -> FloatArray:
    """Times of the legs from a place to all, s; ``surface``: all places, m, shape (n, 3)."""
    lengths_m = np.linalg.norm(surface[place] - surface, axis=1)
    return _bang_bang_times(lengths_m, limits.v_max_m_s, limits.a_max_m_s2)


def _headings(mirror: Mirror, x: float, y: float, xy: FloatArray) -> FloatArray:
    """As ``heading_of_course``, from one place towards many, rad."""
    (ax, _, az), (bx, by, bz), _ = mirror.surface.axes(x, y)
    fx, fy = mirror.surface.gradient(x, y)
    dx, dy = xy[:, 0] - x, xy[:, 1] - y
    rise = fx * dx + fy * dy
    return np.asarray(np.arctan2(bx * dx + by * dy + bz * rise, ax * dx + az * rise), dtype=np.float64)


def _bang_bang_times(distances: FloatArray, v_max: float, a_max: float) -> FloatArray:
    short = distances * a_max < v_max * v_max
    return np.where(short, 2.0 * np.sqrt(distances / a_max), distances / v_max + v_max / a_max)


def _turn_times(angles_rad: FloatArray, limits: LimitsConfig) -> FloatArray:
    """Least times of turns between two legs, each driven forward or in reverse, s."""
    least = np.abs((angles_rad + pi / 2.0) % pi - pi / 2.0)
    times = _bang_bang_times(least, limits.omega_max_rad_s, limits.alpha_max_rad_s2)
    return np.where(least <= STRAIGHT_RAD, 0.0, times)


def _choices(mirror: Mirror, points: Sequence[PointId], limits: LimitsConfig) -> _Choices:
    """All choices, place by place, because a table of all legs would take gigabytes for thousands of points."""
    base = mirror.base_pose
    xy = np.array([(base.x_m, base.y_m), *(mirror.point_on_deck(point) for point in points)])
    surface = np.array([mirror.surface_point(x, y) for x, y in xy.tolist()])
    parts = []
    for k, ((x, y), near) in enumerate(zip(xy.tolist(), _near(surface, limits), strict=True)):
        legs_s, headings = _leg_times(surface, k, limits), _headings(mirror, x, y, xy[near])
        near_s = legs_s[near]
        halves_s, far_s = near_s / 2.0, _least_far(legs_s, near, k) / 2.0
        one = np.r_[np.c_[near, np.full(len(near), _NONE)], [(_NONE, _NONE)]]  # with a single neighbour
        if k == 0:
            turns_s = np.where(near_s > 0.0, _turn_times(headings - base.heading_rad, limits), 0.0)
            joined, costs_s, ends = one, np.r_[halves_s + turns_s, far_s[0]], 0
        else:
            # A leg of no length has no direction.
            angles = np.where(near_s > 0.0, headings, np.nan)
            turns_s = np.nan_to_num(_turn_times(angles[:, None] - angles, limits), nan=0.0)
            first, second = np.triu_indices(len(near), 1)
            pairs_s = halves_s[first] + halves_s[second] + turns_s[first, second]
            joined, ends = np.r_[np.c_[near[first], near[second]], one, one], len(one)
            costs_s = np.r_[pairs_s, halves_s + far_s[0], far_s[0] + far_s[1], halves_s, far_s[0]]
        is_end = np.arange(len(costs_s)) >= len(costs_s) - ends
        parts.append((np.full(len(costs_s), k), joined, is_end, costs_s))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    possible = np.isfinite(columns[-1])
    return _Choices(*(column[possible] for column in columns))


def _near(surface: FloatArray, limits: LimitsConfig) -> list[IntArray]:
    """For each place the near places, ascending: those among its nearest, or with it among theirs."""
    near: list[set[int]] = [set() for _ in surface]
    for k in range(len(surface)):
        legs_s = _leg_times(surface, k, limits)
        legs_s[k] = np.inf
        for other in np.argsort(legs_s, kind="stable")[: min(_NEAR, len(surface) - 1)].tolist():
            near[k].add(other)
            near[other].add(k)
    return [np.array(sorted(others), dtype=np.int64) for others in near]


def _least_far(legs_s: FloatArray, near: IntArray, own: int) -> FloatArray:
    """The two shortest legs that are not near; infinite where there is none, s."""
    far_s = np.delete(legs_s, np.r_[near, own])
    return np.partition(np.r_[far_s, np.inf, np.inf], 1)[:2]


def _priced(choices: _Choices) -> float:
    """The sum of the cheapest choices at the best prices, s.

    Constraints: one choice per place; both ends of a leg choose it equally; the tour has one end (last row).
    """
    # A fifth of a second, and a run needs no bound.
    from scipy.optimize import linprog  # noqa: PLC0415
    from scipy.sparse import csr_array, vstack  # noqa: PLC0415

    places, m = int(choices.place[-1]) + 1, len(choices.cost_s)
    row, side = np.nonzero(choices.near != _NONE)
    own, other = choices.place[row], choices.near[row, side]
    legs, leg = np.unique(np.minimum(own, other) * places + np.maximum(own, other), return_inverse=True)
    ends = np.flatnonzero(choices.is_end)
    signs = np.r_[np.where(own < other, 1.0, -1.0), np.ones(len(ends))]
    where = np.r_[leg, np.full(len(ends), len(legs))], np.r_[row, ends]
    agreement = csr_array((signs, where), shape=(len(legs) + 1, m))
    one_each = csr_array((np.ones(m), (choices.place, np.arange(m))), shape=(places, m))
    constraints: Any = vstack((one_each, agreement))  # ``linprog`` accepts sparse arrays, against its type annotation
    solution = linprog(
        choices.cost_s,
        A_eq=constraints,
        b_eq=np.r_[np.ones(places), np.zeros(len(legs)), 1.0],
        method="highs-ipm",  # a tenth of the simplex method's time
    )
    prices = np.asarray(solution.eqlin.marginals, dtype=np.float64)[places:]
    at_prices = choices.cost_s - agreement.T @ prices
    first = np.flatnonzero(np.diff(choices.place, prepend=-1))
    return float(np.minimum.reduceat(at_prices, first).sum() + prices[-1])
