"""What one value of a radio configuration demands of another.

What one value of the motes' configuration demands of another.
"""

from collections.abc import Iterator
from itertools import pairwise

from ccatp.config.beacon_models import CricketConfig, FuzzyConfig, MotePlaceConfig, RadioConfig
from ccatp.config.checks import check_dashboard
from ccatp.config.messages import ConfigProblem, Key, choice_hint

ROOT: Key = ("cricket",)
ANCHORS = 2  # A is the origin, B shows the second axis
LEAST_DRAWS = 200
LEAST_NETWORK = 3  # motes of a stand that can trilaterate others in the plane


def check_cricket(cfg: CricketConfig, *, simulates: bool = True) -> list[ConfigProblem]:
    """Everything wrong with the motes of a configuration whose values are each in range.

    Args:
        cfg: the section ``cricket``.
        simulates: whether its field is simulated; of measured ranges, layout and places have no say.
    """
    field = [*_check_layout(cfg), *_check_places(cfg)] if simulates else []
    return [*field, *_check_transducer(cfg), *_check_draws(cfg)]


def _check_layout(cfg: CricketConfig) -> Iterator[ConfigProblem]:
    if cfg.layout == "networks":
        if cfg.dimension != 2:
            yield ConfigProblem((*ROOT, "dimension"), '= 3 needs layout = "motes" or "random"; stands lie in a plane')
        if len(cfg.networks) < 2:
            yield ConfigProblem(
                (*ROOT, "networks"), f"has {len(cfg.networks)}; phase 1 goes from one network to the next"
            )
        if len(cfg.anchors) != ANCHORS:
            yield ConfigProblem(
                (*ROOT, "anchors"), f"has {len(cfg.anchors)} motes, not {ANCHORS}: the origin and the axis"
            )
        if len(cfg.stand_m) < LEAST_NETWORK:
            yield ConfigProblem(
                (*ROOT, "stand_m"), f"has {len(cfg.stand_m)} motes; trilateration needs {LEAST_NETWORK}"
            )
    if cfg.layout == "motes" and len(cfg.motes) < 2:
        yield ConfigProblem((*ROOT, "motes"), f"has {len(cfg.motes)}; a map needs two")


def _check_draws(cfg: CricketConfig) -> Iterator[ConfigProblem]:
    if 0 < cfg.phase1.draws < LEAST_DRAWS:
        what = f"= {cfg.phase1.draws} tell no covariance of dozens of coordinates; 0, or {LEAST_DRAWS} at least"
        yield ConfigProblem((*ROOT, "phase1", "draws"), what)


def _check_places(cfg: CricketConfig) -> Iterator[ConfigProblem]:
    if cfg.layout == "random" and len(cfg.random.size_m) != cfg.dimension:
        yield ConfigProblem((*ROOT, "random", "size_m"), _not(cfg.dimension, len(cfg.random.size_m)))
    if cfg.layout == "networks":
        for number, place in enumerate(cfg.stand_m):
            if len(place) != cfg.dimension:
                yield ConfigProblem((*ROOT, "stand_m", number), _not(cfg.dimension, len(place)))
        for name, place in cfg.anchors.items():
            if len(place) != cfg.dimension:
                yield ConfigProblem((*ROOT, "anchors", name), _not(cfg.dimension, len(place)))
    shown = {"networks": cfg.networks, "motes": cfg.motes}.get(cfg.layout, {})
    for name, mote in shown.items():
        yield from _check_place(cfg, (*ROOT, cfg.layout, name), mote)


def _check_place(cfg: CricketConfig, key: Key, mote: MotePlaceConfig) -> Iterator[ConfigProblem]:
    for part, values in (("place_m", mote.place_m), ("facing", mote.facing)):
        if len(values) != cfg.dimension:
            yield ConfigProblem((*key, part), _not(cfg.dimension, len(values)))
    if not any(mote.facing):
        yield ConfigProblem((*key, "facing"), "is no direction: all its parts are 0")


def _check_transducer(cfg: CricketConfig) -> Iterator[ConfigProblem]:
    angles, reaches = cfg.transducer.off_axis_rad, cfg.transducer.reach_m
    key = (*ROOT, "transducer")
    if len(angles) != len(reaches):
        what = f"has {len(reaches)} values for {len(angles)} angles of off_axis_rad"
        yield ConfigProblem((*key, "reach_m"), what, ((*key, "off_axis_rad"),))
    if angles[0] != 0.0 or any(later <= before for before, later in pairwise(angles)):
        yield ConfigProblem((*key, "off_axis_rad"), f"= {list(angles)} must begin with 0 and rise")


def _not(wanted: int, found: int) -> str:
    return f"has {found} coordinates, cricket.dimension = {wanted} asks for {wanted}"


FUZZY_INPUTS = ("distance_m", "heading_error_rad")


def check_radio_config(cfg: RadioConfig, *, simulates: bool = True) -> list[ConfigProblem]:
    """Everything wrong with a configuration whose values are each in range.

    Args:
        simulates: whether the field of motes is simulated, or its ranges were measured.
    """
    return [
        *_check_fuzzy(cfg.control.fuzzy),
        *_check_follow(cfg),
        *_check_avoidance(cfg),
        *_check_room(cfg),
        *check_cricket(cfg.cricket, simulates=simulates),
        *check_dashboard(cfg.dashboard),
    ]


def _check_fuzzy(fuzzy: FuzzyConfig) -> Iterator[ConfigProblem]:
    root = ("control", "fuzzy")
    for name in fuzzy.inputs:
        if name not in FUZZY_INPUTS:
            yield ConfigProblem((*root, "inputs", name), f"is no input of the speed; {choice_hint(name, FUZZY_INPUTS)}")
    for name, given in fuzzy.inputs.items():
        for term, corners in given.terms.items():
            if list(corners) != sorted(corners):
                what = f"= {list(corners)} must rise: left foot, left shoulder, right shoulder, right foot"
                yield ConfigProblem((*root, "inputs", name, "terms", term), what)
    for index, rule in enumerate(fuzzy.rules):
        key = (*root, "rules", index)
        if rule.then not in fuzzy.outputs:
            yield ConfigProblem(
                (*key, "then"), f'= "{rule.then}" is no output; {choice_hint(rule.then, fuzzy.outputs)}'
            )
        for name, term in rule.when.items():
            if name not in fuzzy.inputs:
                yield ConfigProblem((*key, "when"), f'names "{name}", no input; {choice_hint(name, fuzzy.inputs)}')
            elif term not in fuzzy.inputs[name].terms:
                hint = choice_hint(term, fuzzy.inputs[name].terms)
                yield ConfigProblem((*key, "when", name), f'= "{term}" is no term of it; {hint}')


def _check_follow(cfg: RadioConfig) -> Iterator[ConfigProblem]:
    if cfg.follow.is_active and cfg.follow.target in cfg.sim.beacons:
        what = f'= "{cfg.follow.target}" is also a static beacon of sim.beacons; give the radio that moves its own name'
        yield ConfigProblem(("follow", "target"), what)
    if cfg.follow.band_m >= cfg.follow.safe_distance_m:
        what = f"= {cfg.follow.band_m:g} must be less than follow.safe_distance_m = {cfg.follow.safe_distance_m:g}"
        yield ConfigProblem(("follow", "band_m"), what, (("follow", "safe_distance_m"),))


def _check_avoidance(cfg: RadioConfig) -> Iterator[ConfigProblem]:
    if cfg.avoidance.stop_m >= cfg.avoidance.influence_m:
        what = f"= {cfg.avoidance.stop_m:g} must be less than avoidance.influence_m = {cfg.avoidance.influence_m:g}"
        yield ConfigProblem(("avoidance", "stop_m"), what, (("avoidance", "influence_m"),))


def _check_room(cfg: RadioConfig) -> Iterator[ConfigProblem]:
    width_m, height_m = cfg.workspace.size_m
    for index, (x_m, y_m) in enumerate(cfg.workspace.waypoints_m):
        if not (0.0 <= x_m <= width_m and 0.0 <= y_m <= height_m):
            what = f"= [{x_m:g}, {y_m:g}] lies outside the room of {width_m:g} by {height_m:g} m"
            yield ConfigProblem(("workspace", "waypoints_m", index), what, (("workspace", "size_m"),))
