"""Pure. Where the motes of a simulated field are, and where they look."""

from dataclasses import dataclass

import numpy as np

from ccatp.config.cricket_models import CricketConfig, MotePlaceConfig
from ccatp.samples import FloatArray


@dataclass(frozen=True, slots=True)
class TrueMotes:
    """The motes as they are.

    Attributes:
        names: anchors first, then stand by stand.
        positions_m: shape (n, d).
        facings: unit vectors, shape (n, d); zero where a mote is turned to whoever it talks to.
    """

    names: tuple[str, ...]
    positions_m: FloatArray
    facings: FloatArray


def true_motes(cfg: CricketConfig, rng: np.random.Generator) -> TrueMotes:
    """The motes of a configuration.

    Args:
        cfg: layout and its places.
        rng: draws the places of ``random``.
    """
    if cfg.layout == "networks":
        return _stands(cfg)
    if cfg.layout == "motes":
        places = np.array([mote.place_m for mote in cfg.motes.values()], dtype=np.float64)
        return TrueMotes(tuple(cfg.motes), places, np.array([_unit(mote) for mote in cfg.motes.values()]))
    size = np.array(cfg.random.size_m)
    places = rng.uniform(0.0, 1.0, (cfg.random.count, cfg.dimension)) * size
    names = tuple(f"M{number + 1}" for number in range(cfg.random.count))
    return TrueMotes(names, places, np.zeros_like(places))


def _stands(cfg: CricketConfig) -> TrueMotes:
    stand = np.array(cfg.stand_m, dtype=np.float64)
    places, facings = [np.array(list(cfg.anchors.values()), dtype=np.float64)], [np.zeros((len(cfg.anchors), 2))]
    names = list(cfg.anchors)
    for name, network in cfg.networks.items():
        x, y = _unit(network)
        places.append(np.array(network.place_m) + stand @ np.array([[x, y], [-y, x]]))
        facings.append(np.tile((x, y), (len(stand), 1)))
        names += [f"{name}-{mote + 1}" for mote in range(len(stand))]
    return TrueMotes(tuple(names), np.concatenate(places), np.concatenate(facings))


def _unit(mote: MotePlaceConfig) -> FloatArray:
    facing = np.array(mote.facing, dtype=np.float64)
    return np.asarray(facing / np.linalg.norm(facing))
