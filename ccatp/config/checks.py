"""What one value of a configuration demands of another, and values that look like another unit."""

import ipaddress
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import PurePath

from pydantic import BaseModel

from ccatp.config.beacon_models import CricketConfig, FuzzyConfig, RadioConfig
from ccatp.config.messages import ConfigProblem, Key, choice_hint, slip_hint
from ccatp.config.models import (
    Config,
    DashboardConfig,
    LimitsConfig,
    MirrorConfig,
    ObservatoryConfig,
    PanelsConfig,
    RobotConfig,
    SimRobotConfig,
    WorldConfig,
)

FILTERS = ("kf", "ekf", "ukf")
ORDERS = ("thesis", "optimised", "calibration")
FUZZY_INPUTS = ("distance_m", "heading_error_rad")

MIN_COLLIMATORS = 4  # three unknowns and one length to spare, interface control document 2
_LARGEST_LENGTH_M = 2.0  # no length outside the mirror's own files reaches it
_LARGEST_ANGLE_RAD = 2.0 * math.pi
_SMALLEST_PANEL_MM = 10.0
_WHOLE_FRAMES = 1e-6  # decimal fractions of a second are not exact
_LEAST_STANDSTILL_S = 0.2
_NEAREST_COLLIMATOR_MM = 100.0
_PITCH_AGREEMENT_MM = 0.1  # the fitted pitches of the telescope differ by up to 0.012 mm
_TCP_ENDPOINT = re.compile(r"tcp://[^\s/@;]+:(\d{1,5})")
_LARGEST_PORT = 65535
_CORNERS = ((1, 1, "front-left"), (1, -1, "front-right"), (-1, 1, "rear-left"), (-1, -1, "rear-right"))
_ANCHORS = 2  # A is the origin, B shows the second axis
_LEAST_DRAWS = 200
_LEAST_NETWORK = 3  # motes of a stand that can trilaterate others in the plane

Problems = Iterator[ConfigProblem]


def check_config(cfg: Config) -> list[ConfigProblem]:
    """Everything wrong with a survey's configuration whose values are each in range."""
    return [
        *_check_run(cfg),
        *_check_units(cfg),
        *_check_wheels(cfg.robot, cfg.limits),
        *_check_edge_sensors(cfg.robot),
        *_check_world(cfg.world, cfg.sim.robot),
        *_check_light(cfg),
        *_check_observatory(cfg.observatory),
        *_check_dashboard(cfg.dashboard),
        *_check_stand_ins(cfg),
        *_check_standstill(cfg),
        *_check_panels(cfg.mirror.panels),
        *_check_base(cfg.mirror),
        *_check_collimators(cfg.mirror),
    ]


def check_radio_config(cfg: RadioConfig, *, simulates: bool = True) -> list[ConfigProblem]:
    """Everything wrong with a configuration among beacons whose values are each in range.

    ``simulates`` says whether the field of motes is simulated; layout and places do not matter for measured ranges.
    """
    motes = cfg.cricket
    return [
        *_check_fuzzy(cfg.control.fuzzy),
        *_check_follow(cfg),
        *_check_room(cfg),
        *([*_check_layout(motes), *_check_places(motes)] if simulates else []),
        *_check_motes(motes),
        *_check_dashboard(cfg.dashboard),
    ]


def is_file_name(name: str) -> bool:
    """Whether ``run.mirror`` or ``run.world`` is the path of a file instead of a name."""
    return name.endswith(".toml") or "/" in name


def _choice(key: Key, name: str, names: Iterable[str], kind: str) -> Problems:
    if name not in (names := list(names)):
        yield ConfigProblem(key, f'= "{name}" is no {kind}; {choice_hint(name, names)}')


# -- surveys of mirrors -----------------------------------------------------------------------------------------------


def _check_run(cfg: Config) -> Problems:
    yield from _choice(("run", "filter"), cfg.run.filter, FILTERS, "filter")
    yield from _choice(("run", "order"), cfg.run.order, ORDERS, "traversal order")
    if cfg.run.panels > (there := cfg.mirror.panels.count):
        what = f"= {cfg.run.panels}, but {cfg.mirror.name} has {there} panels; 0 takes all of them"
        yield ConfigProblem(("run", "panels"), what)
    yield from _choice(("control", "gains"), cfg.control.gains, cfg.control.gain_sets, "set of gains")
    for section, named, found in (
        ("mirror", cfg.run.mirror, cfg.mirror.name),
        ("world", cfg.run.world, cfg.world.name),
    ):
        if not is_file_name(named) and named != found:
            what = f'= "{found}", but run.{section} = "{PurePath(named)}"; name the same in both'
            yield ConfigProblem((section, "name"), what, (("run", section),))


def _check_units(cfg: Config) -> Problems:
    """Lengths and angles that have no limit of their own, but that cannot be meant."""
    for name in type(cfg).model_fields:
        if name != "mirror":
            yield from _slips(getattr(cfg, name), (name,))
    yield from _slips(cfg.mirror.frame, ("mirror", "frame"))
    yield from _slips(cfg.mirror.base, ("mirror", "base"))


def _slips(value: object, key: Key) -> Problems:
    items: Iterable[tuple[str | int, object]] = ()
    if isinstance(value, BaseModel):
        items = value
    elif isinstance(value, dict):
        items = value.items()
    elif isinstance(value, tuple):
        items = enumerate(value)
    elif isinstance(value, float):
        name = next(part for part in reversed(key) if isinstance(part, str))
        largest = {"rad": _LARGEST_ANGLE_RAD, "m": _LARGEST_LENGTH_M}.get(name.rsplit("_", 1)[-1], math.inf)
        if abs(value) > largest:
            yield ConfigProblem(key, f"= {value:g} must be at most {largest:.4g}{slip_hint(key, value)}")
    for part, item in items:
        yield from _slips(item, (*key, part))


def _check_wheels(robot: RobotConfig, limits: LimitsConfig) -> Problems:
    """The wheels must be able to give the motion that the limits allow."""
    rim_m_s = robot.max_wheel_rad_s * robot.wheel_radius_m
    formula = "max_wheel_rad_s * wheel_radius_m"
    wheels: tuple[Key, ...] = (("robot", "max_wheel_rad_s"), ("robot", "wheel_radius_m"))
    if limits.v_max_m_s > rim_m_s:
        what = f"= {limits.v_max_m_s:g} is more than the wheels give: robot.{formula} = {rim_m_s:.4g}"
        yield ConfigProblem(("limits", "v_max_m_s"), what, wheels)
    turning_m_s = limits.omega_max_rad_s * robot.wheel_base_m / 2.0
    if turning_m_s > rim_m_s:
        most = 2.0 * rim_m_s / robot.wheel_base_m
        what = f"= {limits.omega_max_rad_s:g} is more than the wheels give: 2 * {formula} / wheel_base_m = {most:.4g}"
        yield ConfigProblem(("limits", "omega_max_rad_s"), what, (*wheels, ("robot", "wheel_base_m")))


def _check_edge_sensors(robot: RobotConfig) -> Problems:
    """Order front-left, front-right, rear-left, rear-right; x to the front, y to the left."""
    for index, ((x, y), (sign_x, sign_y, corner)) in enumerate(zip(robot.edge_sensors_m, _CORNERS, strict=True)):
        if x * sign_x <= 0.0 or y * sign_y <= 0.0:
            what = (
                f"= [{x:g}, {y:g}] is not {corner}, where x {'>' if sign_x > 0 else '<'} 0 "
                f"and y {'>' if sign_y > 0 else '<'} 0; the order is front-left, front-right, rear-left, rear-right"
            )
            yield ConfigProblem(("robot", "edge_sensors_m", index), what)


def _check_world(world: WorldConfig, sim: SimRobotConfig) -> Problems:
    """Slip has a range; a delay is a number of frames, and what it delays must not be too old when it arrives."""
    if world.slip_min > world.slip_max:
        what = f"= {world.slip_min:g} is more than slip_max = {world.slip_max:g}"
        yield ConfigProblem(("world", "slip_min"), what, (("world", "slip_max"),))
    frame_s = 1.0 / sim.frame_hz
    for name in ("sensors_delay_s", "commands_delay_s"):
        delay_s = getattr(world, name)
        frames = delay_s * sim.frame_hz
        if abs(frames - round(frames)) > _WHOLE_FRAMES:
            what = f"= {delay_s:g} must be a whole number of frames of {frame_s:g} s"
            yield ConfigProblem(("world", name), what, (("sim", "robot", "frame_hz"),))
        elif delay_s and delay_s + frame_s > sim.ttl_s * (1.0 + _WHOLE_FRAMES):
            what = f"= {delay_s:g} and a frame of {frame_s:g} s outlast sim.robot.ttl_s = {sim.ttl_s:g}"
            yield ConfigProblem(("world", name), what, (("sim", "robot", "ttl_s"), ("sim", "robot", "frame_hz")))


def _check_light(cfg: Config) -> Problems:
    for name, light in cfg.align.light.items():
        if not any(light.direction_world):
            yield ConfigProblem(("align", "light", name, "direction_world"), "= [0, 0, 0] is no direction")


def _check_observatory(observatory: ObservatoryConfig) -> Problems:
    """TCP only with a key and a list of clients."""
    root = "observatory"
    if not observatory.endpoint:
        return
    matched = _TCP_ENDPOINT.fullmatch(observatory.endpoint)
    if matched is None or int(matched[1]) > _LARGEST_PORT:
        what = f'= "{observatory.endpoint}" must be tcp://ADDRESS:PORT, or empty for the unix socket alone'
        yield ConfigProblem((root, "endpoint"), what)
        return
    for name in ("key_file", "clients_file"):
        if not getattr(observatory, name):
            what = f'= "", but endpoint = "{observatory.endpoint}" wants keys and a list; see ccatp keys generate'
            yield ConfigProblem((root, name), what, ((root, "endpoint"),))


def _check_dashboard(dashboard: DashboardConfig) -> Problems:
    """Whoever reaches the page may stop the robot, unless there is a token."""
    if not (is_loopback(dashboard.host) or dashboard.token_file):
        what = f'= "{dashboard.host}" is beyond this machine; name a file with a token in dashboard.token_file'
        yield ConfigProblem(("dashboard", "host"), what, (("dashboard", "token_file"),))


def is_loopback(host: str) -> bool:
    """Whether an address is this machine's own; names other than localhost may be anything."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _check_stand_ins(cfg: Config) -> Problems:
    """Whoever reaches a stand-in may command it, unless there is a key."""
    if cfg.sim.open_to_network:
        return
    hint = "set sim.open_to_network if everyone there may command it"
    if not (is_loopback(cfg.sim.robot.host) or cfg.robot.key_file):
        what = f'= "{cfg.sim.robot.host}" is beyond this machine; name a key in robot.key_file, or {hint}'
        yield ConfigProblem(("sim", "robot", "host"), what)
    if not is_loopback(cfg.sim.etalon.host):
        what = f'= "{cfg.sim.etalon.host}" is beyond this machine, and its protocol has no keys; {hint}'
        yield ConfigProblem(("sim", "etalon", "host"), what)


def _check_standstill(cfg: Config) -> Problems:
    """Nothing is measured before the robot has stood still for long enough."""
    time_s = cfg.control.settle_time_s + cfg.etalon.measuring_time_s
    if time_s < _LEAST_STANDSTILL_S:
        what = (
            f"= {cfg.etalon.measuring_time_s:g} is too short: with control.settle_time_s = "
            f"{cfg.control.settle_time_s:g} the robot must stand still for {_LEAST_STANDSTILL_S:g} s"
        )
        yield ConfigProblem(("etalon", "measuring_time_s"), what, (("control", "settle_time_s"),))


def _check_panels(panels: PanelsConfig) -> Problems:
    root: Key = ("mirror", "panels")
    for name in ("size_x_mm", "size_y_mm", "pitch_x_mm", "pitch_y_mm"):
        value = getattr(panels, name)
        if value < _SMALLEST_PANEL_MM:
            yield ConfigProblem((*root, name), f"= {value:g} looks like metres: {value:g} m are {value * 1e3:g} mm")
            return
    rows: Key = (*root, "panels_per_row")
    total = sum(panels.panels_per_row)
    if total != panels.count:
        what = f"= {panels.count}, but panels_per_row adds up to {total}; correct one of them"
        yield ConfigProblem((*root, "count"), what, (rows,))
    for row, n in enumerate(panels.panels_per_row):
        if n > panels.cols or (panels.cols - n) % 2:
            what = f"= {n} panels cannot be centred on cols = {panels.cols}; both even or both odd, and not more"
            yield ConfigProblem((*rows, row), what, ((*root, "cols"),))
    for axis in "xy":
        size, pitch = getattr(panels, f"size_{axis}_mm"), getattr(panels, f"pitch_{axis}_mm")
        size_key: Key = (*root, f"size_{axis}_mm")
        if abs(pitch - size - panels.gap_mm) > _PITCH_AGREEMENT_MM:
            what = f"= {pitch:g} must be size + gap = {size + panels.gap_mm:g}"
            yield ConfigProblem((*root, f"pitch_{axis}_mm"), what, (size_key, (*root, "gap_mm")))
        low, middle, high = getattr(panels, f"points_{axis}_mm")
        if not -size / 2.0 < low < middle < high < size / 2.0:
            what = f"= [{low:g}, {middle:g}, {high:g}] must ascend within the panel, {-size / 2.0:g} to {size / 2.0:g}"
            yield ConfigProblem((*root, f"points_{axis}_mm"), what, (size_key,))


def _check_base(mirror: MirrorConfig) -> Problems:
    """The base must stand on a panel that exists."""
    base, panels, root = mirror.base, mirror.panels, ("mirror", "base")
    rows = len(panels.panels_per_row)
    if base.row > rows:
        yield ConfigProblem((*root, "row"), f"= {base.row}, but there are {rows} rows")
        return
    n = panels.panels_per_row[base.row - 1]
    first = (panels.cols - n) // 2 + 1
    if not first <= base.col < first + n:
        what = f"= {base.col}: no panel stands there, row {base.row} has columns {first} to {first + n - 1}"
        yield ConfigProblem((*root, "col"), what)
    for axis in "xy":
        value, half = getattr(base, f"{axis}_mm"), getattr(panels, f"size_{axis}_mm") / 2.0
        if abs(value) >= half:
            what = f"= {value:g} is off the panel, which reaches from {-half:g} to {half:g}"
            yield ConfigProblem((*root, f"{axis}_mm"), what)


def _check_collimators(mirror: MirrorConfig) -> Problems:
    channels, positions = mirror.collimators.channels, mirror.collimators.positions_world_mm
    root: Key = ("mirror", "collimators")
    if len(channels) < MIN_COLLIMATORS:
        yield ConfigProblem((*root, "channels"), f"has {len(channels)}; a position needs at least {MIN_COLLIMATORS}")
    if len(set(channels)) != len(channels):
        yield ConfigProblem((*root, "channels"), f"= {list(channels)} names a channel twice")
    if len(channels) != len(positions):
        what = f"has {len(positions)} positions for {len(channels)} channels"
        yield ConfigProblem((*root, "positions_world_mm"), what, ((*root, "channels"),))
    for index, position in enumerate(positions):
        if math.hypot(*position) < _NEAREST_COLLIMATOR_MM:
            what = f"= {list(position)} is {math.hypot(*position):.3g} mm from the world's origin; looks like metres"
            yield ConfigProblem((*root, "positions_world_mm", index), what)


# -- robots among radio beacons ---------------------------------------------------------------------------------------


def _check_fuzzy(fuzzy: FuzzyConfig) -> Problems:
    root = ("control", "fuzzy")
    for name, given in fuzzy.inputs.items():
        if name not in FUZZY_INPUTS:
            yield ConfigProblem((*root, "inputs", name), f"is no input of the speed; {choice_hint(name, FUZZY_INPUTS)}")
        for term, corners in given.terms.items():
            if list(corners) != sorted(corners):
                what = f"= {list(corners)} must rise: left foot, left shoulder, right shoulder, right foot"
                yield ConfigProblem((*root, "inputs", name, "terms", term), what)
    for index, rule in enumerate(fuzzy.rules):
        key = (*root, "rules", index)
        yield from _choice((*key, "then"), rule.then, fuzzy.outputs, "output")
        for name, term in rule.when.items():
            if name not in fuzzy.inputs:
                yield ConfigProblem((*key, "when"), f'names "{name}", no input; {choice_hint(name, fuzzy.inputs)}')
            else:
                yield from _choice((*key, "when", name), term, fuzzy.inputs[name].terms, "term of it")


def _check_follow(cfg: RadioConfig) -> Problems:
    follow, avoidance = cfg.follow, cfg.avoidance
    if follow.is_active and follow.target in cfg.sim.beacons:
        what = f'= "{follow.target}" is also a static beacon of sim.beacons; give the radio that moves its own name'
        yield ConfigProblem(("follow", "target"), what)
    if follow.band_m >= follow.safe_distance_m:
        what = f"= {follow.band_m:g} must be less than follow.safe_distance_m = {follow.safe_distance_m:g}"
        yield ConfigProblem(("follow", "band_m"), what, (("follow", "safe_distance_m"),))
    if avoidance.stop_m >= avoidance.influence_m:
        what = f"= {avoidance.stop_m:g} must be less than avoidance.influence_m = {avoidance.influence_m:g}"
        yield ConfigProblem(("avoidance", "stop_m"), what, (("avoidance", "influence_m"),))


def _check_room(cfg: RadioConfig) -> Problems:
    width_m, height_m = cfg.workspace.size_m
    for index, (x_m, y_m) in enumerate(cfg.workspace.waypoints_m):
        if not (0.0 <= x_m <= width_m and 0.0 <= y_m <= height_m):
            what = f"= [{x_m:g}, {y_m:g}] lies outside the room of {width_m:g} by {height_m:g} m"
            yield ConfigProblem(("workspace", "waypoints_m", index), what, (("workspace", "size_m"),))


def _check_layout(cfg: CricketConfig) -> Problems:
    if cfg.layout == "motes" and len(cfg.motes) < 2:
        yield ConfigProblem(("cricket", "motes"), f"has {len(cfg.motes)}; a map needs two")
    if cfg.layout != "networks":
        return
    found: tuple[tuple[bool, str, str], ...] = (
        (cfg.dimension != 2, "dimension", '= 3 needs layout = "motes" or "random"; stands lie in a plane'),
        (len(cfg.networks) < 2, "networks", f"has {len(cfg.networks)}; phase 1 goes from one network to the next"),
        (len(cfg.anchors) != _ANCHORS, "anchors",
         f"has {len(cfg.anchors)} motes, not {_ANCHORS}: the origin and the axis"),
        (len(cfg.stand_m) < _LEAST_NETWORK, "stand_m",
         f"has {len(cfg.stand_m)} motes; trilateration needs {_LEAST_NETWORK}"),
    )  # fmt: skip
    for is_wrong, name, what in found:
        if is_wrong:
            yield ConfigProblem(("cricket", name), what)


def _check_places(cfg: CricketConfig) -> Problems:
    def check(coordinates: Sequence[float], *key: str | int) -> Problems:
        if len(coordinates) != cfg.dimension:
            wanted = f"cricket.dimension = {cfg.dimension} asks for {cfg.dimension}"
            yield ConfigProblem(("cricket", *key), f"has {len(coordinates)} coordinates, {wanted}")

    if cfg.layout == "random":
        yield from check(cfg.random.size_m, "random", "size_m")
        return
    if cfg.layout == "networks":
        for number, place in enumerate(cfg.stand_m):
            yield from check(place, "stand_m", number)
        for name, place in cfg.anchors.items():
            yield from check(place, "anchors", name)
    for name, mote in (cfg.networks if cfg.layout == "networks" else cfg.motes).items():
        yield from check(mote.place_m, cfg.layout, name, "place_m")
        yield from check(mote.facing, cfg.layout, name, "facing")
        if not any(mote.facing):
            yield ConfigProblem(("cricket", cfg.layout, name, "facing"), "is no direction: all its parts are 0")


def _check_motes(cfg: CricketConfig) -> Problems:
    angles, reaches = cfg.transducer.off_axis_rad, cfg.transducer.reach_m
    key = ("cricket", "transducer")
    if len(angles) != len(reaches):
        what = f"has {len(reaches)} values for {len(angles)} angles of off_axis_rad"
        yield ConfigProblem((*key, "reach_m"), what, ((*key, "off_axis_rad"),))
    if angles[0] != 0.0 or any(later <= before for before, later in pairwise(angles)):
        yield ConfigProblem((*key, "off_axis_rad"), f"= {list(angles)} must begin with 0 and rise")
    if 0 < cfg.phase1.draws < _LEAST_DRAWS:
        what = f"= {cfg.phase1.draws} give no covariance of dozens of coordinates; 0, or {_LEAST_DRAWS} at least"
        yield ConfigProblem(("cricket", "phase1", "draws"), what)
