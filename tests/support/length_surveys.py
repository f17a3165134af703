"""Lengths of many surveys at once: networks drawn from their priors, the tests of the lengths without the robot."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ccatp.config.models import EtalonConfig
from ccatp.core import DeckPose, FloatArray
from ccatp.mirror.length_integrity import NetworkCalibration, chi_square, per_fix, standardised
from ccatp.mirror.length_watch import ChannelSums, NoiseSum, constant_limit
from ccatp.mirror.mirror import Mirror


class Alarms(NamedTuple):
    """First fix of an alarm of a single fix, a channel over the fixes, the noise, a constant error; (runs,)."""

    single: FloatArray
    channel: FloatArray
    noise: FloatArray
    constant: FloatArray


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
    network, sums, noise = NetworkCalibration(cfg, count), ChannelSums(cfg, count, (runs,)), NoiseSum(cfg, (runs,))
    error = rng.standard_normal((runs, len(network.mean))) * np.sqrt(np.diag(network.covariance))
    network.mean = np.zeros_like(error)
    first = [np.full(runs, np.inf) for _ in range(4)]
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
        is_constant = (np.abs(network.constant_errors()[0]) > constant_limit(cfg, count)).any(axis=1)
        found = (is_single, sums.add(w).any(axis=1), noise.add(np.where(is_single, dof, chi2), dof), is_constant)
        for known, now in zip(first, found, strict=True):
            known[now & np.isinf(known)] = number
    return Alarms(*first)
