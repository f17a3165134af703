"""Keys of a configuration among beacons that are set and do nothing in its mission."""

from collections.abc import Callable
from typing import NamedTuple

from ccatp.beacons.config.models import RadioConfig, RecordingsConfig
from ccatp.config.describe import differences, leaves
from ccatp.config.messages import format_value


class Unused(NamedTuple):
    """Keys without effect: ``keys`` are keys or sections, ``why`` ends the line that names one."""

    is_unused: Callable[[RadioConfig, bool], bool]  # of a configuration, and whether the robot is simulated
    keys: tuple[str, ...]
    why: str


def _are_radios_simulated(cfg: RadioConfig) -> bool:
    return bool(cfg.sim.beacons) or cfg.sim.target.motion != "none"


# In order of precedence: a key is named with the first row that has it.
UNUSED = (
    Unused(lambda *_: True, ("run.steps",), "in a mission; it is for studies"),
    Unused(
        lambda _, is_sim: not is_sim, ("observation", "listener.pulses_per_frame", "listener.mapping_rounds"),
        "on a real robot; it is for the simulated one",
    ),
    Unused(
        lambda cfg, _: cfg.system == "cricket",
        ("path_loss", "estimator", "scan.bearing_sigma_rad", "scan.loss_tolerance"),
        "with system = cricket; it is for radios",
    ),
    Unused(
        lambda cfg, is_sim: cfg.system == "cricket" and not (is_sim and _are_radios_simulated(cfg)), ("scan",),
        "with system = cricket; it is for radios",
    ),
    Unused(
        lambda cfg, _: not _are_radios_simulated(cfg), ("sim.radio", "observation"),
        "without radios: sim.beacons is empty, and sim.target.motion none",
    ),
    Unused(lambda cfg, _: cfg.system != "cricket", ("cricket", "listener"), "without motes; it is for cricket"),
    Unused(
        lambda cfg, _: cfg.system == "cricket",
        (
            "cricket.motes", "cricket.random", "cricket.batch.uses_shapes", "cricket.batch.uses_phase2",
            "cricket.batch.robust_scale", "cricket.batch.max_iterations",
        ),
        "in a mission; it is for ccatp radio map",
    ),
    Unused(
        lambda cfg, _: cfg.cricket.phase2.prior != "printed", ("cricket.phase2.printed_variance_m2",),
        "unless cricket.phase2.prior = printed",
    ),
    Unused(
        lambda cfg, _: cfg.cricket.transducer.is_omnidirectional, ("cricket.transducer.off_axis_rad",),
        "with cricket.transducer.is_omnidirectional = true",
    ),
    Unused(
        lambda cfg, _: not cfg.follow.is_active,
        (
            "follow.safe_distance_m", "follow.band_m", "follow.margin_sigmas", "follow.foresight_s",
            "follow.back_speed_m_s", "follow.retreat_s", "follow.lost_after_s", "mission.follow_s", "danger.target_m",
            "danger.target_window_s", "danger.target_level_sigma_db",
        ),
        "unless follow.is_active = true",
    ),
    Unused(
        lambda cfg, _: cfg.follow.is_active, ("workspace.waypoints_m", "workspace.loops", "mission.laps"),
        "with follow.is_active = true",
    ),
    Unused(
        lambda cfg, _: not cfg.avoidance.is_active,
        (
            "avoidance.stop_m", "avoidance.margin_m", "avoidance.memory_s", "avoidance.back_time_s",
            "avoidance.directions", "follow.retreat_s",
        ),
        "unless avoidance.is_active = true",
    ),
    Unused(
        lambda cfg, _: cfg.control.speed_mode != "fuzzy", ("control.fuzzy",), "unless control.speed_mode = fuzzy",
    ),
    Unused(lambda cfg, _: cfg.control.speed_mode != "pi", ("control.pi",), "unless control.speed_mode = pi"),
    Unused(
        lambda cfg, _: cfg.control.speed_mode != "constant", ("control.constant_speed_m_s",),
        "unless control.speed_mode = constant",
    ),
    Unused(
        lambda cfg, _: cfg.vehicle.kind == "ackermann",
        ("vehicle.turn_rate_max_rad_s", "odometry.turn_rate_sigma_rad_s", "sim.vehicle.turn_rate_sigma_rad_s"),
        "with vehicle.kind = ackermann",
    ),
    Unused(
        lambda cfg, _: cfg.vehicle.kind == "differential",
        ("vehicle.steer_max_rad", "odometry.steer_sigma_rad", "sim.vehicle.steer_sigma_rad"),
        "with vehicle.kind = differential",
    ),
    Unused(
        lambda cfg, _: cfg.estimator.shadowing == "none",
        ("path_loss.shadowing_sigma_db", "path_loss.shadowing_length_m", "estimator.shadowing_grid_m"),
        "with estimator.shadowing = none",
    ),
    Unused(
        lambda cfg, _: cfg.estimator.shadowing == "white", ("estimator.shadowing_grid_m",),
        "with estimator.shadowing = white",
    ),
    Unused(
        lambda cfg, _: cfg.sim.radio.scan == "drawn", ("sim.radio.beam_width_rad", "sim.radio.front_to_back_db"),
        "with sim.radio.scan = drawn",
    ),
    Unused(
        lambda cfg, _: cfg.sim.radio.scan == "reflector", ("sim.radio.bearing_sigma_rad",),
        "with sim.radio.scan = reflector",
    ),
    Unused(
        lambda cfg, _: cfg.sim.target.motion == "none",
        (
            "observation.target_every_steps", "sim.target.x_m", "sim.target.y_m", "sim.target.reference_dbm",
            "sim.target.speed_m_s", "sim.target.turn_sigma_rad_sqrt_s", "sim.target.waypoints_m",
        ),
        "with sim.target.motion = none",
    ),
    Unused(
        lambda cfg, _: cfg.sim.target.motion == "random", ("sim.target.waypoints_m",),
        "with sim.target.motion = random",
    ),
    Unused(
        lambda cfg, _: cfg.sim.target.motion == "waypoints", ("sim.target.turn_sigma_rad_sqrt_s",),
        "with sim.target.motion = waypoints",
    ),
)  # fmt: skip


FORMATS = ("plaza", "mrclam", "labyrinth", "csv")
# Of a recorded run: keys that an estimator does not use, with FORMAT for the section of the recording.
UNUSED_BY = {
    "ekf-slam": (
        "FORMAT.priors.turn_per_m", "FORMAT.priors.bearing_offset_rad", "FORMAT.priors.beacon_offset_m",
        "FORMAT.priors.core", "FORMAT.priors.beacon_height_m2", "FORMAT.priors.antenna_ahead_m",
        "FORMAT.priors.antenna_left_m", "FORMAT.radio.freedom", "fixed_lag",
    ),
    "smoother": ("FORMAT.priors.core", "fixed_lag"),
    "fixed-lag": (),
}  # fmt: skip


def recording_keys_without_effect(
    cfg: RecordingsConfig, shipped: RecordingsConfig, kind: str, estimator: str, *, moves: bool = False
) -> list[str]:
    """A line for each key that differs from the shipped ones and does nothing with an estimator on a recorded run.

    ``kind``: section of the recording's format. ``moves``: whether a beacon of it moves.
    """
    others = tuple(name for name in FORMATS if name != kind)
    unused = [key.replace("FORMAT", kind) for key in UNUSED_BY[estimator]]
    before, found = dict(leaves(shipped.model_dump(mode="json"))), []
    for key, value in leaves(cfg.model_dump(mode="json")):
        if value == before[key]:
            continue
        if key.startswith(tuple(f"{name}." for name in others)):
            why = f"the settings of this recording are those of {kind}"
            found.append(f"{key} = {format_value(value)} has no effect: {why}")
        elif key == "filter.beacon_walk_m_sqrt_s" and not moves:
            found.append(f"{key} = {format_value(value)} has no effect without --moving")
        elif any(key == one or key.startswith(f"{one}.") for one in unused):
            found.append(f"{key} = {format_value(value)} has no effect with --filter {estimator}")
    return found


def keys_without_effect(cfg: RadioConfig, is_sim: bool) -> list[str]:
    """A line for each key that differs from the shipped configuration of its system and does nothing in the mission."""
    rows = [row for row in UNUSED if row.is_unused(cfg, is_sim)]
    found = []
    for key, _, value in differences(cfg):
        row = next((row for row in rows if any(key == one or key.startswith(f"{one}.") for one in row.keys)), None)
        if row is not None and value is not None:
            found.append(f"{key} = {format_value(value)} has no effect {row.why}")
    return found
