"""The filters of this project, and thesis eq. 2.13 as it is printed, as contenders of a race."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ccatp.bench.problems import FilterProblem, models
from ccatp.core import FloatArray
from ccatp.filters import FILTERS

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
    F, H = (problem.F, problem.H) if problem.F is not None and problem.H is not None else models(problem)
    Q, R, readings = problem.Q, problem.variances, problem.readings
    ours = FILTERS[name](problem.mean, problem.covariance)

    def step(i: int) -> None:
        ours.predict(F, Q)
        ours.update(readings[i], H, R)

    return Contender(lambda: ours.reset(problem.mean, problem.covariance), step, lambda: (ours.mean, ours.covariance))


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
            motion, sight = models(problem)
            x, F = motion.at(x)
            expected, H = sight.at(x)
        P = F @ P @ F.T + Q
        W = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x = x + W @ (readings[i] - expected)
        P = (identity - W @ H) @ P

    return Contender(reset, step, lambda: (x, P))


def played_back(contender: Contender, steps: int) -> Contender:
    """A contender that does its ``steps`` now and only tells them later."""
    contender.reset()
    results, at = [], 0
    for i in range(steps):
        contender.step(i)
        results.append(contender.result())

    def step(i: int) -> None:
        nonlocal at
        at = i

    return Contender(lambda: None, step, lambda: results[at])
