"""Two contenders by turns on one clock."""

import gc
import time
from typing import NamedTuple

import numpy as np

from ccatp.bench.contenders import Contender
from ccatp.core import FloatArray


class Times(NamedTuple):
    """Wall times of single steps, microseconds, one row for each round: shape (rounds, steps)."""

    ours_us: FloatArray
    peer_us: FloatArray | None


class Difference(NamedTuple):
    """How far two results are apart at most.

    Attributes:
        absolute: of any entry of mean and covariance, in its own SI unit.
        sigmas: the same of the mean in sigmas and of the covariance as a correlation.
    """

    absolute: float
    sigmas: float


def race(ours: Contender, peer: Contender | None, steps: int, rounds: int) -> Times:
    """Time every step of both, ours and the peer's by turns, who begins by turns as well.

    So a machine that slows down for a while slows both. A round begins with a reset; one round before them warms up.

    Args:
        ours, peer: the contenders; without a peer ours runs alone.
        steps: of a round.
        rounds: that count.
    """
    both = [ours] if peer is None else [ours, peer]
    taken = np.zeros((len(both), rounds, steps))
    collecting = gc.isenabled()
    gc.disable()
    try:
        for turn in range(-1, rounds):
            for contender in both:
                contender.reset()
            for i in range(steps):
                for which in range(len(both)) if (turn + i) % 2 else reversed(range(len(both))):
                    step = both[which].step
                    start_ns = time.perf_counter_ns()
                    step(i)
                    spent_ns = time.perf_counter_ns() - start_ns
                    if turn >= 0:
                        taken[which, turn, i] = 1e-3 * spent_ns
            gc.collect(1)
    finally:
        if collecting:
            gc.enable()
    return Times(taken[0], None if peer is None else taken[1])


def largest_difference(ours: Contender, peer: Contender, steps: int) -> Difference:
    """Largest difference between the results of two contenders after each of ``steps`` steps."""
    ours.reset()
    peer.reset()
    absolute = sigmas = 0.0
    for i in range(steps):
        ours.step(i)
        peer.step(i)
        (x, P), (other_x, other_P) = ours.result(), peer.result()
        sigma = np.sqrt(np.diag(P))
        mean, spread = np.abs(x - other_x), np.abs(P - other_P)
        absolute = max(absolute, float(mean.max()), float(spread.max()))
        sigmas = max(sigmas, float((mean / sigma).max()), float((spread / np.outer(sigma, sigma)).max()))
    return Difference(absolute, sigmas)
