"""What one value of a configuration demands of another, and values that look like another unit."""

import ipaddress
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from operator import mul
from pathlib import PurePath
from typing import Protocol

from pydantic import BaseModel

from ccatp.config.messages import ConfigProblem, Key, choice_hint, unit_hint
from ccatp.config.models import Config, DashboardConfig, MirrorConfig
from ccatp.config.onboard_models import OnboardConfig
from ccatp.config.robot_limits import TOP_SPEED_M_S

_LARGEST_LENGTH_M = 2.0  # no length outside the mirror's own files reaches it
_SMALLEST_PANEL_MM = 10.0
_WHOLE_FRAMES = 1e-6  # decimal fractions of a second are not exact
_LEAST_STANDSTILL_S = 0.2
_NEAREST_COLLIMATOR_MM = 100.0
_UNIT_LENGTH = 1e-3
_PITCH_AGREEMENT_MM = 0.1  # the fitted pitches of the telescope differ by up to 0.012 mm
_TCP_ENDPOINT = re.compile(r"tcp://[^\s/@;]+:(\d{1,5})")
_LARGEST_PORT = 65535
_CORNERS = {"front-left": (1, 1), "front-right": (1, -1), "rear-left": (-1, 1), "rear-right": (-1, -1)}
_STEPS_OF_TIMER = 5  # of the control loop, in the time of the external timer: one may be late

Problems = Iterator[ConfigProblem]


class DrivenWheels(Protocol):
    """The wheels of a robot, as in its section of a configuration."""

    @property
    def wheel_radius_m(self) -> float:
        """Radius of a wheel."""

    @property
    def max_wheel_rad_s(self) -> float:
        """Largest rate of a wheel."""


def check_config(cfg: Config) -> Problems:
    """Everything wrong with a survey's configuration whose values are each in range."""
    yield from _check_run(cfg)
    # Lengths and angles that have no limit of their own, but that cannot be meant.
    for name, value in cfg:
        if name != "mirror":
            yield from _unit_mistakes(value, (name,))
    yield from _unit_mistakes(cfg.mirror.frame, ("mirror", "frame"))
    yield from _unit_mistakes(cfg.mirror.base, ("mirror", "base"))
    yield from _check_wheels(cfg)
    yield from _check_world(cfg)
    yield from _check_network(cfg)
    yield from check_dashboard(cfg.dashboard)
    yield from _check_panels(cfg.mirror)
    yield from _check_gravity(cfg.mirror)
    yield from _check_collimators(cfg.mirror)


def is_file_name(name: str) -> bool:
    """Whether ``run.mirror`` or ``run.world`` is the path of a file instead of a name."""
    return name.endswith(".toml") or "/" in name


def problem_of(key: str, what: str, *related: str) -> ConfigProblem:
    """A problem of a dotted key, in which numbers are those of an array; ``related`` keys are dotted, too."""
    parts = tuple(int(part) if part.isdecimal() else part for part in key.split("."))
    return ConfigProblem(parts, what, tuple(tuple(other.split(".")) for other in related))


def check_choice(key: str, name: str, names: Iterable[str], kind: str) -> Problems:
    """A problem if a key names what is not among ``names``."""
    if name not in (names := list(names)):
        yield problem_of(key, f'= "{name}" is no {kind}; {choice_hint(name, names)}')


# -- surveys of mirrors -----------------------------------------------------------------------------------------------


def _check_run(cfg: Config) -> Problems:
    if cfg.run.panels > (there := cfg.mirror.panels.count):
        yield problem_of(
            "run.panels", f"= {cfg.run.panels}, but {cfg.mirror.name} has {there} panels; 0 takes all of them"
        )
    yield from check_choice("control.gains", cfg.control.gains, cfg.control.gain_sets, "set of gains")
    for section, named, found in ("mirror", cfg.run.mirror, cfg.mirror.name), ("world", cfg.run.world, cfg.world.name):
        if not is_file_name(named) and named != found:
            what = f'= "{found}", but run.{section} = "{PurePath(named)}"; name the same in both'
            yield problem_of(f"{section}.name", what, f"run.{section}")
    # Nothing is measured before the robot has stood still for long enough.
    settle_s, measuring_s = cfg.control.settle_time_s, cfg.etalon.measuring_time_s
    if settle_s + measuring_s < _LEAST_STANDSTILL_S:
        must = f"the robot must stand still for {_LEAST_STANDSTILL_S:g} s"
        what = f"= {measuring_s:g} is too short: with control.settle_time_s = {settle_s:g} {must}"
        yield problem_of("etalon.measuring_time_s", what, "control.settle_time_s")
    for name, light in cfg.align.light.items():
        if not any(light.direction_world):
            yield problem_of(f"align.light.{name}.direction_world", "= [0, 0, 0] is no direction")


def _unit_mistakes(value: object, key: Key) -> Problems:
    items: Iterable[tuple[str | int, object]] = ()
    if isinstance(value, BaseModel):
        items = value
    elif isinstance(value, dict):
        items = value.items()
    elif isinstance(value, tuple):
        items = enumerate(value)
    elif isinstance(value, float):
        name = next(part for part in reversed(key) if isinstance(part, str))
        largest = {"rad": 2.0 * math.pi, "m": _LARGEST_LENGTH_M}.get(name.rsplit("_", 1)[-1], math.inf)
        if abs(value) > largest:
            yield ConfigProblem(key, f"= {value:g} must be at most {largest:.4g}{unit_hint(key, value)}")
    for part, item in items:
        yield from _unit_mistakes(item, (*key, part))


def check_onboard_config(cfg: OnboardConfig) -> Problems:
    """Everything wrong with a configuration of the on-board program whose values are each in range."""
    link, robot, servo, edges, devices = cfg.link, cfg.robot, cfg.servo, cfg.edges, cfg.devices
    full_scale_v = devices.daq.full_scale_v
    low_v, high_v = (edges.threshold_v + side * edges.hysteresis_v for side in (-0.5, 0.5))
    supply_v = devices.motors.supply_v
    yield from check_top_speed(robot)
    yield from _check_corners(robot.edge_sensors_m)
    step_s, lasting_s = 1.0 / servo.loop_hz, _STEPS_OF_TIMER / servo.loop_hz
    for is_wrong, key, what, *related in (
        (link.frame_hz * link.ttl_s < 2.0, "link.ttl_s", "must last for two frames at least", "link.frame_hz"),
        (servo.loop_hz < link.frame_hz, "servo.loop_hz", "must not be below link.frame_hz", "link.frame_hz"),
        (lasting_s > devices.timer.timeout_s, "devices.timer.timeout_s",
         f"= {devices.timer.timeout_s:g} brakes a loop with steps of {step_s:g} s; allow {lasting_s:g} at least",
         "servo.loop_hz"),
        (servo.max_v > supply_v, "servo.max_v",
         f"= {servo.max_v:g} is more than devices.motors.supply_v = {supply_v:g}", "devices.motors.supply_v"),
        (servo.static_v >= servo.max_v, "servo.static_v", "must be below servo.max_v", "servo.max_v"),
        (low_v <= 0.0 or high_v >= full_scale_v, "edges.threshold_v",
         f"and its band must lie between 0 and devices.daq.full_scale_v = {full_scale_v:g}",
         "edges.hysteresis_v", "devices.daq.full_scale_v"),
        (devices.daq.battery_empty_v >= devices.daq.battery_full_v, "devices.daq.battery_empty_v",
         "must be below devices.daq.battery_full_v", "devices.daq.battery_full_v"),
    ):  # fmt: skip
        if is_wrong:
            yield problem_of(key, what, *related)


def _check_wheels(cfg: Config) -> Problems:
    """The wheels must give the motion that the limits allow; edge sensors have x to the front, y to the left."""
    robot, limits = cfg.robot, cfg.limits
    yield from check_top_speed(robot)
    formula, related = "max_wheel_rad_s * wheel_radius_m", ("robot.max_wheel_rad_s", "robot.wheel_radius_m")
    rim_m_s = robot.max_wheel_rad_s * robot.wheel_radius_m
    turning_rad_s = 2.0 * rim_m_s / robot.wheel_base_m
    for key, value, limit, of in (
        ("limits.v_max_m_s", limits.v_max_m_s, rim_m_s, f"robot.{formula}"),
        ("limits.omega_max_rad_s", limits.omega_max_rad_s, turning_rad_s, f"2 * {formula} / wheel_base_m"),
    ):
        if value > limit:
            what = f"= {value:g} is more than the wheels give: {of} = {limit:.4g}"
            yield problem_of(key, what, *related, "robot.wheel_base_m")
    yield from _check_corners(robot.edge_sensors_m)


def check_top_speed(robot: DrivenWheels) -> Problems:
    """The robot link refuses a robot that is too fast, and one with which no mission ends."""
    top_m_s = robot.max_wheel_rad_s * robot.wheel_radius_m
    low, high = TOP_SPEED_M_S
    if not low <= top_m_s <= high:
        what = f"= {robot.max_wheel_rad_s:g} is {top_m_s:.3g} m/s; the robot link allows {low:g} to {high:g}"
        yield problem_of("robot.max_wheel_rad_s", what, "robot.wheel_radius_m")


def _check_corners(edge_sensors_m: Sequence[tuple[float, float]]) -> Problems:
    for index, (corner, (sign_x, sign_y)) in enumerate(_CORNERS.items()):
        x, y = edge_sensors_m[index]
        if x * sign_x <= 0.0 or y * sign_y <= 0.0:
            where = f"x {'>' if sign_x > 0 else '<'} 0 and y {'>' if sign_y > 0 else '<'} 0"
            what = f"= [{x:g}, {y:g}] is not {corner}, where {where}; the order is {', '.join(_CORNERS)}"
            yield problem_of(f"robot.edge_sensors_m.{index}", what)


def _check_world(cfg: Config) -> Problems:
    """Slip has a range; a delay is a number of frames, and what it delays must not be too old when it arrives."""
    world, sim = cfg.world, cfg.sim.robot
    if world.slip_min > world.slip_max:
        what = f"= {world.slip_min:g} is more than slip_max = {world.slip_max:g}"
        yield problem_of("world.slip_min", what, "world.slip_max")
    frame_s = 1.0 / sim.frame_hz
    for name in ("sensors_delay_s", "commands_delay_s"):
        delay_s = getattr(world, name)
        frames = delay_s * sim.frame_hz
        if abs(frames - round(frames)) > _WHOLE_FRAMES:
            what = f"= {delay_s:g} must be a whole number of frames of {frame_s:g} s"
            yield problem_of(f"world.{name}", what, "sim.robot.frame_hz")
        elif delay_s and delay_s + frame_s > sim.ttl_s * (1.0 + _WHOLE_FRAMES):
            what = f"= {delay_s:g} and a frame of {frame_s:g} s outlast sim.robot.ttl_s = {sim.ttl_s:g}"
            yield problem_of(f"world.{name}", what, "sim.robot.ttl_s", "sim.robot.frame_hz")


def is_loopback(host: str) -> bool:
    """Whether an address is this machine's own; names other than localhost may be anything."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _check_network(cfg: Config) -> Problems:
    """The observatory only with a key and a list of clients; whoever reaches a stand-in without a key commands it."""
    endpoint = cfg.observatory.endpoint
    matched = _TCP_ENDPOINT.fullmatch(endpoint)
    if endpoint and (matched is None or int(matched[1]) > _LARGEST_PORT):
        what = f'= "{endpoint}" must be tcp://ADDRESS:PORT, or empty for the unix socket alone'
        yield problem_of("observatory.endpoint", what)
    elif endpoint:
        for name in ("key_file", "clients_file"):
            if not getattr(cfg.observatory, name):
                what = f'= "", but endpoint = "{endpoint}" wants keys and a list; see ccatp keys generate'
                yield problem_of(f"observatory.{name}", what, "observatory.endpoint")
    if cfg.sim.open_to_network:
        return
    hint = "set sim.open_to_network if everyone there may command it"
    if not (cfg.robot.key_file or is_loopback(host := cfg.sim.robot.host)):
        what = f'= "{host}" is beyond this machine; name a key in robot.key_file, or {hint}'
        yield problem_of("sim.robot.host", what)
    if not is_loopback(host := cfg.sim.etalon.host):
        yield problem_of("sim.etalon.host", f'= "{host}" is beyond this machine, and its protocol has no keys; {hint}')


def check_dashboard(dashboard: DashboardConfig) -> Problems:
    """Whoever reaches the page may stop the robot, unless there is a token."""
    if not (is_loopback(dashboard.host) or dashboard.token_file):
        what = f'= "{dashboard.host}" is beyond this machine; name a file with a token in dashboard.token_file'
        yield problem_of("dashboard.host", what, "dashboard.token_file")


def _check_panels(mirror: MirrorConfig) -> Problems:
    """Panels that fit each other, and a base that stands on one of them."""
    panels, base, root = mirror.panels, mirror.base, "mirror.panels"
    for name in ("size_x_mm", "size_y_mm", "pitch_x_mm", "pitch_y_mm"):
        value = getattr(panels, name)
        if value < _SMALLEST_PANEL_MM:
            yield problem_of(f"{root}.{name}", f"= {value:g} looks like metres: {value:g} m are {value * 1e3:g} mm")
            return
    total, rows = sum(panels.panels_per_row), len(panels.panels_per_row)
    if total != panels.count:
        what = f"= {panels.count}, but panels_per_row adds up to {total}; correct one of them"
        yield problem_of(f"{root}.count", what, f"{root}.panels_per_row")
    for row, n in enumerate(panels.panels_per_row):
        if n > panels.cols or (panels.cols - n) % 2:
            what = f"= {n} panels cannot be centred on cols = {panels.cols}; both even or both odd, and not more"
            yield problem_of(f"{root}.panels_per_row.{row}", what, f"{root}.cols")
    if base.row > rows:
        yield problem_of("mirror.base.row", f"= {base.row}, but there are {rows} rows")
    else:
        n = panels.panels_per_row[base.row - 1]
        first = (panels.cols - n) // 2 + 1
        if not first <= base.col < first + n:
            what = f"= {base.col}: no panel stands there, row {base.row} has columns {first} to {first + n - 1}"
            yield problem_of("mirror.base.col", what)
    for axis in "xy":
        size, pitch = getattr(panels, f"size_{axis}_mm"), getattr(panels, f"pitch_{axis}_mm")
        half = size / 2.0
        if abs(pitch - size - panels.gap_mm) > _PITCH_AGREEMENT_MM:
            what = f"= {pitch:g} must be size + gap = {size + panels.gap_mm:g}"
            yield problem_of(f"{root}.pitch_{axis}_mm", what, f"{root}.size_{axis}_mm", f"{root}.gap_mm")
        low, middle, high = getattr(panels, f"points_{axis}_mm")
        if not -half < low < middle < high < half:
            what = f"= [{low:g}, {middle:g}, {high:g}] must ascend within the panel, {-half:g} to {half:g}"
            yield problem_of(f"{root}.points_{axis}_mm", what, f"{root}.size_{axis}_mm")
        value = getattr(base, f"{axis}_mm")
        if abs(value) >= half:
            what = f"= {value:g} is off the panel, which reaches from {-half:g} to {half:g}"
            yield problem_of(f"mirror.base.{axis}_mm", what)


def _check_gravity(mirror: MirrorConfig) -> Problems:
    """A unit vector; on an overhanging mirror things fall off the side on which the robot drives."""
    frame, key = mirror.frame, "mirror.frame.gravity_world"
    gravity, angle_rad = frame.gravity_world, frame.rotation_about_x_rad
    normal = 0.0, -math.sin(angle_rad), math.cos(angle_rad)  # the mirror frame's z in the world
    falls_off = frame.reflecting_side_sign * sum(map(mul, normal, gravity))
    if abs(math.hypot(*gravity) - 1.0) > _UNIT_LENGTH:
        yield problem_of(key, f"= {list(gravity)} must be of length 1")
    elif (falls_off > 0.0) is not mirror.overhang:
        what = f"= {list(gravity)} contradicts overhang = {str(mirror.overhang).lower()}; give the direction of fall"
        yield problem_of(key, what, "mirror.overhang", "mirror.frame.reflecting_side_sign")


def _check_collimators(mirror: MirrorConfig) -> Problems:
    channels, positions = mirror.collimators.channels, mirror.collimators.positions_world_mm
    root = "mirror.collimators"
    if len(set(channels)) != len(channels):
        yield problem_of(f"{root}.channels", f"= {list(channels)} names a channel twice")
    if len(channels) != len(positions):
        what = f"has {len(positions)} positions for {len(channels)} channels"
        yield problem_of(f"{root}.positions_world_mm", what, f"{root}.channels")
    for index, position in enumerate(positions):
        if (distance_mm := math.hypot(*position)) < _NEAREST_COLLIMATOR_MM:
            what = f"= {list(position)} is {distance_mm:.3g} mm from the world's origin; looks like metres"
            yield problem_of(f"{root}.positions_world_mm.{index}", what)
