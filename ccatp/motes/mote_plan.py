"""Pure. What the operator knows before anything is measured: motes, stands, who maps whom, which pairs are asked."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ccatp.config.cricket_models import CricketConfig
from ccatp.motes.range_network import FloatArray, RigidBody

Pairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class MotePlan:
    """The motes of a configuration.

    Attributes:
        names: of all motes, anchors first.
        dimension: d.
        anchors: indices of A and B; empty where there are none.
        networks: indices of the motes of each stand, in the order of mapping; empty where there are none.
        bodies: the stands, whose shapes are known.
        axes_m: where A stands and the direction towards B, shape (2, d): what takes the map's frame to the field's.
        phase1_pairs: pairs that are measured in phase 1.
        phase2_pairs: pairs that phase 2 goes through.
        surveyed_m: coordinates that phase 2 takes as known, nan elsewhere, shape (n, d).
    """

    names: tuple[str, ...]
    dimension: int
    anchors: tuple[int, ...]
    networks: tuple[tuple[int, ...], ...]
    bodies: tuple[RigidBody, ...]
    axes_m: FloatArray
    phase1_pairs: Pairs
    phase2_pairs: Pairs
    surveyed_m: FloatArray

    @property
    def heads(self) -> tuple[int, ...]:
        """The first mote of each stand, which phase 2 places."""
        return tuple(network[0] for network in self.networks)

    @property
    def mapped(self) -> tuple[int, ...]:
        """The motes that the map is for: all but the anchors."""
        return tuple(mote for mote in range(len(self.names)) if mote not in self.anchors)


def network_plan(cfg: CricketConfig) -> MotePlan:
    """The plan of stands of motes (Patil et al., section 3): each stand is mapped by the one before it.

    Args:
        cfg: layout ``networks``.
    """
    size = len(cfg.stand_m)
    anchors = tuple(range(len(cfg.anchors)))
    networks = tuple(
        tuple(range(len(anchors) + size * number, len(anchors) + size * (number + 1)))
        for number in range(len(cfg.networks))
    )
    names = (*cfg.anchors, *(f"{name}-{mote + 1}" for name in cfg.networks for mote in range(size)))
    places = np.array(list(cfg.anchors.values()), dtype=np.float64)
    local_m = np.array(cfg.stand_m, dtype=np.float64)
    heads = [network[0] for network in networks]
    return MotePlan(
        names=names,
        dimension=cfg.dimension,
        anchors=anchors,
        networks=networks,
        bodies=tuple(RigidBody(name, motes, local_m) for name, motes in zip(cfg.networks, networks, strict=True)),
        axes_m=np.array([places[0], places[1] - places[0]]),
        phase1_pairs=_phase1_pairs(anchors, networks),
        phase2_pairs=tuple((heads[i], heads[j]) for i, j in head_pairs(len(heads), cfg.phase2.pairs)),
        surveyed_m=_surveyed(cfg, len(names), heads),
    )


def loose_plan(cfg: CricketConfig, names: tuple[str, ...]) -> MotePlan:
    """The plan of motes by themselves: every pair that is heard is measured and used.

    Args:
        cfg: layout ``motes`` or ``random``.
        names: of the motes.
    """
    count, d = len(names), cfg.dimension
    pairs = tuple((i, j) for i in range(count) for j in range(i + 1, count))
    nowhere = np.full((count, d), np.nan)
    return MotePlan(names, d, (), (), (), np.zeros((2, d)), pairs, pairs, nowhere)


def head_pairs(count: int, programme: str) -> list[tuple[int, int]]:
    """Pairs of stands that measure each other in phase 2.

    Args:
        count: of stands.
        programme: ``zigzag``: each with the next; ``adjacent``: and with the one after it; ``all``.
    """
    if programme == "all":
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    pairs = list(pairwise(range(count)))
    if programme == "adjacent":
        pairs += [(i, i + 2) for i in range(count - 2)]
    return pairs


def _phase1_pairs(anchors: tuple[int, ...], networks: tuple[tuple[int, ...], ...]) -> Pairs:
    """A to B, both to the first network, then all of a network to all of the next."""
    first, second = anchors
    pairs = [(first, second)]
    pairs += [(anchor, mote) for anchor in anchors for mote in networks[0]]
    for before, after in pairwise(networks):
        pairs += [(old, new) for old in before for new in after]
    return tuple(pairs)


def _surveyed(cfg: CricketConfig, count: int, heads: list[int]) -> FloatArray:
    """Place of the first head and y of the second, as the zeros of Patil et al. eq. 25 say."""
    known = np.full((count, cfg.dimension), np.nan)
    if cfg.phase2.frame == "surveyed":
        first, second = list(cfg.networks.values())[:2]
        known[heads[0]] = first.place_m
        known[heads[1], 1] = second.place_m[1]
    return known
