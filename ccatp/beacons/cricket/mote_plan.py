"""The plan of a self-mapping: the motes of a configuration, and which pairs of them are measured in phases 1 and 2."""

from dataclasses import dataclass
from itertools import combinations, pairwise, product

import numpy as np

from ccatp.beacons.config.models import CricketConfig
from ccatp.beacons.cricket.range_network import RigidBody
from ccatp.core import FloatArray

Pairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class MotePlan:
    """The motes of a configuration.

    ``bodies``: the stands, whose shapes are known, in the order of mapping. ``axes_m``: position of A and vector from A
    to B, shape (2, d); they transform the frame of the map to that of the field.
    """

    names: tuple[str, ...]
    dimension: int
    anchors: tuple[int, ...]
    bodies: tuple[RigidBody, ...]
    axes_m: FloatArray
    phase1_pairs: Pairs  # measured in phase 1
    phase2_pairs: Pairs  # measured in phase 2
    surveyed_m: FloatArray  # coordinates that phase 2 takes as known, nan elsewhere, shape (n, d)

    @property
    def heads(self) -> tuple[int, ...]:
        """The first mote of each stand, which phase 2 places."""
        return tuple(body.motes[0] for body in self.bodies)

    @property
    def mapped(self) -> tuple[int, ...]:
        """All motes but the anchors."""
        return tuple(mote for mote in range(len(self.names)) if mote not in self.anchors)


def network_plan(cfg: CricketConfig) -> MotePlan:
    """The plan of stands of motes (Patil et al., section 3): each stand is mapped by the one before it."""
    anchors, size = tuple(range(len(cfg.anchors))), len(cfg.stand_m)
    local_m = np.array(cfg.stand_m, dtype=np.float64)
    bodies = []
    for number, name in enumerate(cfg.networks):
        start = len(anchors) + size * number
        bodies.append(RigidBody(name, tuple(range(start, start + size)), local_m))
    heads = [body.motes[0] for body in bodies]
    places = np.array(list(cfg.anchors.values()), dtype=np.float64)
    # A to B, both to the first stand, then all motes of a stand to all of the next.
    phase1_pairs = [anchors, *product(anchors, bodies[0].motes)]
    for before, after in pairwise(bodies):
        phase1_pairs += product(before.motes, after.motes)
    surveyed_m = np.full((len(anchors) + size * len(bodies), cfg.dimension), np.nan)
    if cfg.phase2.frame == "surveyed":  # place of the first head and y of the second: the zeros of Patil et al. eq. 25
        origin, along = list(cfg.networks.values())[:2]
        surveyed_m[heads[0]] = origin.place_m
        surveyed_m[heads[1], 1] = along.place_m[1]
    return MotePlan(
        names=(*cfg.anchors, *(f"{name}-{mote + 1}" for name in cfg.networks for mote in range(size))),
        dimension=cfg.dimension,
        anchors=anchors,
        bodies=tuple(bodies),
        axes_m=np.array([places[0], places[1] - places[0]]),
        phase1_pairs=tuple((i, j) for i, j in phase1_pairs),
        phase2_pairs=tuple((heads[i], heads[j]) for i, j in head_pairs(len(heads), cfg.phase2.pairs)),
        surveyed_m=surveyed_m,
    )


def loose_plan(cfg: CricketConfig, names: tuple[str, ...]) -> MotePlan:
    """The plan of motes without stands: every pair in reach is measured and used."""
    count, d = len(names), cfg.dimension
    pairs = tuple(combinations(range(count), 2))
    nowhere = np.full((count, d), np.nan)
    return MotePlan(names, d, (), (), np.zeros((2, d)), pairs, pairs, nowhere)


def head_pairs(count: int, programme: str) -> list[tuple[int, int]]:
    """Pairs of stands that measure each other in phase 2.

    ``programme``: ``zigzag``: each with the next; ``adjacent``: also with the one after the next; ``all``: every pair.
    """
    if programme == "all":
        return list(combinations(range(count), 2))
    pairs = list(pairwise(range(count)))
    if programme == "adjacent":
        pairs += [(i, i + 2) for i in range(count - 2)]
    return pairs
