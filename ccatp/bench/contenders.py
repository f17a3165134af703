"""Pure. The filters of this project, and thesis eq. 2.13 as it is printed, as contenders of a race."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ccatp.bench.problems import FilterProblem, pose_models
from ccatp.filters import FILTERS, Filter
from ccatp.filters.base import FloatArray

Result = tuple[FloatArray, FloatArray]
"""Mean (n,) and covariance (n, n)."""


class Contender(NamedTuple):
    """Something that is timed.

    Attributes:
        reset: begin anew; not timed.
        step: work on reading number i; timed.
        result: what it has come to.
    """

    reset: Callable[[], None]
    step: Callable[[int], object]
    result: Callable[[], Result]


def our_filter(name: str, problem: FilterProblem) -> Contender:
    """A filter of ``FILTERS``, given linear models as arrays and nonlinear ones as they are."""
    F, H = _models(problem)
    Q, R, readings = problem.Q, problem.variances, problem.readings
    ours: list[Filter] = [FILTERS[name](problem.mean, problem.covariance)]

    def reset() -> None:
        ours[0] = FILTERS[name](problem.mean, problem.covariance)

    def step(i: int) -> None:
        ours[0].predict(F, Q)  # type: ignore[arg-type] # an array or a model, as the filter takes them
        ours[0].update(readings[i], H, R)  # type: ignore[arg-type] # the same

    return Contender(reset, step, lambda: (ours[0].mean, ours[0].covariance))


def printed_filter(problem: FilterProblem) -> Contender:
    """Thesis eq. 2.13 with its inverse and its (I - W H) P in bare numpy, without a check; linearised where need be."""
    Q, R, readings = problem.Q, np.diag(problem.variances), problem.readings
    x, P = problem.mean, problem.covariance
    identity = np.eye(x.size)

    def reset() -> None:
        nonlocal x, P
        x, P = problem.mean, problem.covariance

    def step(i: int) -> None:
        nonlocal x, P
        if problem.F is not None and problem.H is not None:
            F, H = problem.F, problem.H
            x = F @ x
            expected = H @ x
        else:
            motion, sight = pose_models(problem)
            x, F = motion.at(x)
            expected, H = sight.at(x)
        P = F @ P @ F.T + Q
        W = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x = x + W @ (readings[i] - expected)
        P = (identity - W @ H) @ P

    return Contender(reset, step, lambda: (x, P))


def _models(problem: FilterProblem) -> tuple[object, object]:
    if problem.F is not None:
        return problem.F, problem.H
    return problem.motion, problem.sight
