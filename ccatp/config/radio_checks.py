"""Pure. What one value of a radio configuration demands of another."""

from collections.abc import Iterator

from ccatp.config.checks import check_dashboard
from ccatp.config.cricket_checks import check_cricket
from ccatp.config.messages import Fault, choice_hint
from ccatp.config.radio_models import FuzzyConfig, RadioConfig

FUZZY_INPUTS = ("distance_m", "heading_error_rad")


def check_radio_config(cfg: RadioConfig, *, simulates: bool = True) -> list[Fault]:
    """Everything wrong with a configuration whose values are each in range.

    Args:
        cfg: the configuration.
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


def _check_fuzzy(fuzzy: FuzzyConfig) -> Iterator[Fault]:
    root = ("control", "fuzzy")
    for name in fuzzy.inputs:
        if name not in FUZZY_INPUTS:
            yield Fault((*root, "inputs", name), f"is no input of the speed; {choice_hint(name, FUZZY_INPUTS)}")
    for name, given in fuzzy.inputs.items():
        for term, corners in given.terms.items():
            if list(corners) != sorted(corners):
                what = f"= {list(corners)} must rise: left foot, left shoulder, right shoulder, right foot"
                yield Fault((*root, "inputs", name, "terms", term), what)
    for index, rule in enumerate(fuzzy.rules):
        key = (*root, "rules", index)
        if rule.then not in fuzzy.outputs:
            yield Fault((*key, "then"), f'= "{rule.then}" is no output; {choice_hint(rule.then, fuzzy.outputs)}')
        for name, term in rule.when.items():
            if name not in fuzzy.inputs:
                yield Fault((*key, "when"), f'names "{name}", no input; {choice_hint(name, fuzzy.inputs)}')
            elif term not in fuzzy.inputs[name].terms:
                hint = choice_hint(term, fuzzy.inputs[name].terms)
                yield Fault((*key, "when", name), f'= "{term}" is no term of it; {hint}')


def _check_follow(cfg: RadioConfig) -> Iterator[Fault]:
    if cfg.follow.is_active and cfg.follow.target in cfg.sim.beacons:
        what = f'= "{cfg.follow.target}" is also a static beacon of sim.beacons; give the radio that moves its own name'
        yield Fault(("follow", "target"), what)
    if cfg.follow.band_m >= cfg.follow.safe_distance_m:
        what = f"= {cfg.follow.band_m:g} must be less than follow.safe_distance_m = {cfg.follow.safe_distance_m:g}"
        yield Fault(("follow", "band_m"), what, (("follow", "safe_distance_m"),))


def _check_avoidance(cfg: RadioConfig) -> Iterator[Fault]:
    if cfg.avoidance.stop_m >= cfg.avoidance.influence_m:
        what = f"= {cfg.avoidance.stop_m:g} must be less than avoidance.influence_m = {cfg.avoidance.influence_m:g}"
        yield Fault(("avoidance", "stop_m"), what, (("avoidance", "influence_m"),))


def _check_room(cfg: RadioConfig) -> Iterator[Fault]:
    width_m, height_m = cfg.workspace.size_m
    for index, (x_m, y_m) in enumerate(cfg.workspace.waypoints_m):
        if not (0.0 <= x_m <= width_m and 0.0 <= y_m <= height_m):
            what = f"= [{x_m:g}, {y_m:g}] lies outside the room of {width_m:g} by {height_m:g} m"
            yield Fault(("workspace", "waypoints_m", index), what, (("workspace", "size_m"),))
