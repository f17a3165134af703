"""What one value of a configuration among beacons demands of another."""

from itertools import pairwise

from ccatp.beacons.config.models import CricketConfig, FuzzyConfig, RadioConfig
from ccatp.config.checks import Problems, check_choice, check_dashboard, check_top_speed, problem_of
from ccatp.config.messages import choice_hint

FUZZY_INPUTS = ("distance_m", "heading_error_rad")

_ANCHORS = 2  # A is the origin, B shows the second axis
_LEAST_NETWORK = 3  # motes of a stand that can trilaterate others in the plane


def check_radio_config(cfg: RadioConfig, *, simulates: bool = True) -> Problems:
    """Everything wrong with a configuration among beacons whose values are each in range.

    ``simulates`` says whether the field of motes is simulated; layout and places do not matter for measured ranges.
    """
    yield from check_top_speed(cfg.robot)
    yield from _check_fuzzy(cfg.control.fuzzy)
    yield from _check_follow(cfg)
    if simulates:
        yield from _check_layout(cfg.cricket)
        yield from _check_places(cfg.cricket)
    yield from _check_motes(cfg.cricket)
    yield from check_dashboard(cfg.dashboard)


def check_mission(cfg: RadioConfig) -> Problems:
    """What keeps a mission from its end, though maps and studies have a use for it."""
    layout, laps = cfg.cricket.layout, cfg.mission.laps
    if cfg.system == "cricket" and layout != "networks":
        what = f'= "{layout}" has no plan by which the motes of a robot map themselves; give "networks"'
        yield problem_of("cricket.layout", f"{what}, or map them with ccatp radio map")
    if cfg.system == "cricket" and cfg.follow.is_active:
        yield problem_of("follow.is_active", '= true needs radios; motes are not followed: give system = "follow"')
    if not cfg.follow.is_active and not cfg.workspace.loops and laps > 1:
        what = f"= false visits each waypoint once, but mission.laps = {laps}; give mission.laps = 1 or loops = true"
        yield problem_of("workspace.loops", what, "mission.laps")


def _check_fuzzy(fuzzy: FuzzyConfig) -> Problems:
    root = "control.fuzzy"
    for name, given in fuzzy.inputs.items():
        if name not in FUZZY_INPUTS:
            yield problem_of(f"{root}.inputs.{name}", f"is no input of the speed; {choice_hint(name, FUZZY_INPUTS)}")
        for term, corners in given.terms.items():
            if list(corners) != sorted(corners):
                what = f"= {list(corners)} must rise: left foot, left shoulder, right shoulder, right foot"
                yield problem_of(f"{root}.inputs.{name}.terms.{term}", what)
    for index, rule in enumerate(fuzzy.rules):
        key = f"{root}.rules.{index}"
        yield from check_choice(f"{key}.then", rule.then, fuzzy.outputs, "output")
        for name, term in rule.when.items():
            if name not in fuzzy.inputs:
                yield problem_of(f"{key}.when", f'names "{name}", no input; {choice_hint(name, fuzzy.inputs)}')
            else:
                yield from check_choice(f"{key}.when.{name}", term, fuzzy.inputs[name].terms, "term of it")


def _check_follow(cfg: RadioConfig) -> Problems:
    follow, avoidance = cfg.follow, cfg.avoidance
    if follow.is_active and follow.target in cfg.sim.beacons:
        what = f'= "{follow.target}" is also a static beacon of sim.beacons; give the radio that moves its own name'
        yield problem_of("follow.target", what)
    for key, value, limit, most in (
        ("follow.band_m", follow.band_m, "follow.safe_distance_m", follow.safe_distance_m),
        ("avoidance.stop_m", avoidance.stop_m, "avoidance.influence_m", avoidance.influence_m),
    ):
        if value >= most:
            yield problem_of(key, f"= {value:g} must be less than {limit} = {most:g}", limit)
    width_m, height_m = cfg.workspace.size_m
    for index, (x_m, y_m) in enumerate(cfg.workspace.waypoints_m):
        if not (0.0 <= x_m <= width_m and 0.0 <= y_m <= height_m):
            what = f"= [{x_m:g}, {y_m:g}] lies outside the room of {width_m:g} by {height_m:g} m"
            yield problem_of(f"workspace.waypoints_m.{index}", what, "workspace.size_m")


def _check_layout(cfg: CricketConfig) -> Problems:
    stands, anchors, stand = len(cfg.networks), len(cfg.anchors), len(cfg.stand_m)
    found = (
        ("motes", len(cfg.motes) < 2, "motes", f"has {len(cfg.motes)}; a map needs two"),
        ("networks", cfg.dimension != 2, "dimension", '= 3 needs layout = "motes" or "random"; stands lie in a plane'),
        ("networks", stands < 2, "networks", f"has {stands}; phase 1 goes from one network to the next"),
        ("networks", anchors != _ANCHORS, "anchors",
         f"has {anchors} motes, not {_ANCHORS}: the origin and the axis"),
        ("networks", stand < _LEAST_NETWORK, "stand_m", f"has {stand} motes; trilateration needs {_LEAST_NETWORK}"),
    )  # fmt: skip
    for layout, is_wrong, name, what in found:
        if is_wrong and cfg.layout == layout:
            yield problem_of(f"cricket.{name}", what)


def _check_places(cfg: CricketConfig) -> Problems:
    given: list[tuple[str, tuple[float, ...]]] = []
    motes = {"networks": cfg.networks, "motes": cfg.motes, "random": {}}[cfg.layout]
    if cfg.layout == "random":
        given += [("random.size_m", cfg.random.size_m)]
    elif cfg.layout == "networks":
        given += [(f"stand_m.{number}", place) for number, place in enumerate(cfg.stand_m)]
        given += [(f"anchors.{name}", place) for name, place in cfg.anchors.items()]
    for name, mote in motes.items():
        key = f"{cfg.layout}.{name}"
        given += [(f"{key}.place_m", mote.place_m), (f"{key}.facing", mote.facing)]
        if not any(mote.facing):
            yield problem_of(f"cricket.{key}.facing", "is no direction: all its parts are 0")
    for key, coordinates in given:
        if len(coordinates) != cfg.dimension:
            wanted = f"cricket.dimension = {cfg.dimension} asks for {cfg.dimension}"
            yield problem_of(f"cricket.{key}", f"has {len(coordinates)} coordinates, {wanted}")


def _check_motes(cfg: CricketConfig) -> Problems:
    angles, reaches = cfg.transducer.off_axis_rad, cfg.transducer.reach_m
    root = "cricket.transducer"
    if len(angles) != len(reaches):
        what = f"has {len(reaches)} values for {len(angles)} angles of off_axis_rad"
        yield problem_of(f"{root}.reach_m", what, f"{root}.off_axis_rad")
    if angles[0] != 0.0 or any(later <= before for before, later in pairwise(angles)):
        yield problem_of(f"{root}.off_axis_rad", f"= {list(angles)} must begin with 0 and rise")
