"""Fields of motes for tests: places, ranges between them."""

from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ccatp.beacons.cricket.range_network import MoteRange, RangeNetwork, RigidBody, build_network

FloatArray = NDArray[np.float64]
Pairs = list[tuple[int, int]]

SIGMA_M = 0.02 / 3.0
HEADS = np.array([[0.0, 1.0], [5.0, 1.0], [0.0, 4.5], [5.0, 4.5], [0.0, 8.0], [5.0, 8.0]])
STAND = np.array([[0.0, 0.0], [0.4330127, 0.25], [0.4330127, -0.25]])
STANDS = np.concatenate([head + STAND * (1.0 if head[0] == 0.0 else -1.0) for head in HEADS])
FORTY_FIVE: list[tuple[int, int]] = [(3 * k + a, 3 * k + 3 + b) for k in range(5) for a in range(3) for b in range(3)]
ZIGZAG: Pairs = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]
ADJACENT: Pairs = [*ZIGZAG, (0, 2), (1, 3), (2, 4), (3, 5)]
ALL: Pairs = list(combinations(range(6), 2))


def names(count: int) -> tuple[str, ...]:
    """M0, M1, ..."""
    return tuple(f"M{number}" for number in range(count))


def network_of(
    places: FloatArray,
    pairs: Iterable[tuple[int, int]],
    rng: np.random.Generator | None = None,
    *,
    sigma_m: float = SIGMA_M,
    bodies: Sequence[RigidBody] = (),
    known_m: FloatArray | None = None,
    offset_m: float = 0.0,
    scale: float = 1.0,
) -> RangeNetwork:
    """Ranges of pairs, exact without a generator."""
    rows = []
    for i, j in pairs:
        true_m = float(np.linalg.norm(places[i] - places[j]))
        noise_m = 0.0 if rng is None else float(rng.normal(0.0, sigma_m))
        rows.append(MoteRange(f"M{i}", f"M{j}", scale * true_m + offset_m + noise_m, sigma_m))
    return build_network(rows, places.shape[1], names(len(places)), bodies, known_m)


def near_pairs(places: FloatArray, reach_m: float) -> list[tuple[int, int]]:
    """Pairs nearer than a reach."""
    return [(i, j) for i, j in combinations(range(len(places)), 2) if np.linalg.norm(places[i] - places[j]) < reach_m]
