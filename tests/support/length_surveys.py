"""Lengths of many surveys at once: networks drawn from their priors, the tests of the lengths without the robot."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ccatp.config.models import EtalonConfig
from ccatp.core import DeckPose, FloatArray
from ccatp.mirror.length_integrity import NetworkCalibration, chi_square, per_fix, standardised
from ccatp.mirror.length_watch import WINDOW, ChannelSums, noise_limit
from ccatp.mirror.mirror import Mirror


class Alarms(NamedTuple):
    """Which runs had an alarm of a single fix, of a channel over the fixes, of the noise; and each first one's fix."""

    single: FloatArray
    channel: FloatArray
    noise: FloatArray


def places(mirror: Mirror, height_m: float) -> FloatArray:
    """The puck at every point of a mirror, in the order of the panels, (points, 3)."""
    found = []
    for panel in mirror.panels:
        for point in mirror.point_ids(panel):
            x, y = mirror.point_on_deck(point)
            found.append(mirror.puck_world(DeckPose(x, y, 0.0), height_m))
    return np.array(found)


def alarms(
    cfg: EtalonConfig,
    collimators_m: FloatArray,
    pucks_m: FloatArray,
    runs: int,
    rng: np.random.Generator,
    fault: Callable[[int, FloatArray], FloatArray] = lambda _, lengths: lengths,
) -> Alarms:
    """First fix of each kind of alarm in each run (infinite: none). ``fault``: number of the fix and lengths."""
    count = len(collimators_m)
    network, sums = NetworkCalibration(cfg, count), ChannelSums(cfg, count, (runs,))
    error = rng.standard_normal((runs, len(network.mean))) * np.sqrt(np.diag(network.covariance))
    network.mean = np.zeros_like(error)
    first = [np.full(runs, np.inf) for _ in range(3)]
    squares: list[FloatArray] = []
    rows = tuple(range(count))
    for number, puck in enumerate(pucks_m):
        offsets = puck - collimators_m
        distances = np.linalg.norm(offsets, axis=1)
        directions, sigmas = offsets / distances[:, None], cfg.length_sigma_m + cfg.length_sigma_per_m * distances
        lengths = rng.standard_normal((runs, count)) * sigmas + error @ network.design(rows, directions, distances).T
        lengths = fault(number, lengths)
        parity = network.parity(rows, directions, distances, sigmas)
        innovation = network.innovation(parity, lengths)
        chi2 = chi_square(parity, innovation)
        dof = innovation.shape[1]
        is_single = chi2 > chdtri(dof, per_fix(cfg))
        # A contradictory fix corrects nothing and enters no sum.
        good = ~is_single[:, None]
        w = standardised(parity, innovation)[0] * good
        network.correct(parity, innovation * good)
        squares.append(np.where(is_single, dof, chi2))
        window = squares[-WINDOW:]
        found = (is_single, sums.add(w).any(axis=1), sum(window) > noise_limit(cfg, dof * len(window)))
        for known, now in zip(first, found, strict=True):
            known[now & np.isinf(known)] = number
    return Alarms(*first)
