"""Pure. What one value of the motes' configuration demands of another."""

from collections.abc import Iterator
from itertools import pairwise

from ccatp.config.cricket_models import CricketConfig, MotePlaceConfig
from ccatp.config.messages import Fault
from ccatp.config.toml_text import Key

ROOT: Key = ("cricket",)
ANCHORS = 2  # A is the origin, B shows the second axis
LEAST_DRAWS = 200
LEAST_NETWORK = 3  # motes of a stand that can trilaterate others in the plane


def check_cricket(cfg: CricketConfig, *, simulates: bool = True) -> list[Fault]:
    """Everything wrong with the motes of a configuration whose values are each in range.

    Args:
        cfg: the section ``cricket``.
        simulates: whether its field is simulated; of measured ranges, layout and places have no say.
    """
    field = [*_check_layout(cfg), *_check_places(cfg)] if simulates else []
    return [*field, *_check_transducer(cfg), *_check_draws(cfg)]


def _check_layout(cfg: CricketConfig) -> Iterator[Fault]:
    if cfg.layout == "networks":
        if cfg.dimension != 2:
            yield Fault((*ROOT, "dimension"), '= 3 needs layout = "motes" or "random"; stands lie in a plane')
        if len(cfg.networks) < 2:
            yield Fault((*ROOT, "networks"), f"has {len(cfg.networks)}; phase 1 goes from one network to the next")
        if len(cfg.anchors) != ANCHORS:
            yield Fault((*ROOT, "anchors"), f"has {len(cfg.anchors)} motes, not {ANCHORS}: the origin and the axis")
        if len(cfg.stand_m) < LEAST_NETWORK:
            yield Fault((*ROOT, "stand_m"), f"has {len(cfg.stand_m)} motes; trilateration needs {LEAST_NETWORK}")
    if cfg.layout == "motes" and len(cfg.motes) < 2:
        yield Fault((*ROOT, "motes"), f"has {len(cfg.motes)}; a map needs two")


def _check_draws(cfg: CricketConfig) -> Iterator[Fault]:
    if 0 < cfg.phase1.draws < LEAST_DRAWS:
        what = f"= {cfg.phase1.draws} tell no covariance of dozens of coordinates; 0, or {LEAST_DRAWS} at least"
        yield Fault((*ROOT, "phase1", "draws"), what)


def _check_places(cfg: CricketConfig) -> Iterator[Fault]:
    if cfg.layout == "random" and len(cfg.random.size_m) != cfg.dimension:
        yield Fault((*ROOT, "random", "size_m"), _not(cfg.dimension, len(cfg.random.size_m)))
    if cfg.layout == "networks":
        for number, place in enumerate(cfg.stand_m):
            if len(place) != cfg.dimension:
                yield Fault((*ROOT, "stand_m", number), _not(cfg.dimension, len(place)))
        for name, place in cfg.anchors.items():
            if len(place) != cfg.dimension:
                yield Fault((*ROOT, "anchors", name), _not(cfg.dimension, len(place)))
    shown = {"networks": cfg.networks, "motes": cfg.motes}.get(cfg.layout, {})
    for name, mote in shown.items():
        yield from _check_place(cfg, (*ROOT, cfg.layout, name), mote)


def _check_place(cfg: CricketConfig, key: Key, mote: MotePlaceConfig) -> Iterator[Fault]:
    for part, values in (("place_m", mote.place_m), ("facing", mote.facing)):
        if len(values) != cfg.dimension:
            yield Fault((*key, part), _not(cfg.dimension, len(values)))
    if not any(mote.facing):
        yield Fault((*key, "facing"), "is no direction: all its parts are 0")


def _check_transducer(cfg: CricketConfig) -> Iterator[Fault]:
    angles, reaches = cfg.transducer.off_axis_rad, cfg.transducer.reach_m
    key = (*ROOT, "transducer")
    if len(angles) != len(reaches):
        what = f"has {len(reaches)} values for {len(angles)} angles of off_axis_rad"
        yield Fault((*key, "reach_m"), what, ((*key, "off_axis_rad"),))
    if angles[0] != 0.0 or any(later <= before for before, later in pairwise(angles)):
        yield Fault((*key, "off_axis_rad"), f"= {list(angles)} must begin with 0 and rise")


def _not(wanted: int, found: int) -> str:
    return f"has {found} coordinates, cricket.dimension = {wanted} asks for {wanted}"
