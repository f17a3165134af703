"""Pure. What the MultiLine server says, against the configuration."""

from math import dist

from ccatp.checking.finding import Finding, failed, passed
from ccatp.config.models import Config
from ccatp.mirror.errors import ConvergenceError
from ccatp.mirror.mirror import Mirror
from ccatp.samples import Fix
from ccatp.wire.multiline import Environment

NAMES = ("lasers", "air", "laser fix")
# Air as it can be at a telescope, from the sea to 6000 m.
TEMPERATURE_C, PRESSURE_HPA, HUMIDITY_PCT = (-40.0, 50.0), (400.0, 1100.0), (0.0, 100.0)


def judge_lasers(*, connected: bool, laser_ready: bool) -> Finding:
    """Are the lasers there, and warm?"""
    if not connected:
        return failed("lasers", "the server has no laser", "switch the laser unit on and connect it to its server")
    if not laser_ready:
        return failed("lasers", "not warm yet", "wait until the laser unit is ready")
    return passed("lasers", "connected and warm")


def judge_air(air: Environment) -> Finding:
    """Can the air be what the server takes it for? Lengths are corrected by it."""
    found = f"{air.temperature_c:.1f} degC, {air.pressure_hpa:.0f} hPa, {air.humidity_pct:.0f} %"
    for value, (low, high) in (
        (air.temperature_c, TEMPERATURE_C),
        (air.pressure_hpa, PRESSURE_HPA),
        (air.humidity_pct, HUMIDITY_PCT),
    ):
        if not low <= value <= high:
            todo = "look at the weather station of the laser unit: lengths are corrected by it"
            return failed("air", f"{found}: not the air of any telescope", todo)
    return passed("air", found)


def judge_fix(cfg: Config, mirror: Mirror, fix: Fix) -> Finding:
    """Is the puck where a robot at base has it?"""
    expected = mirror.puck_world(mirror.base_pose, cfg.robot.puck_height_m)
    off_m = dist(fix.position_m, expected)
    try:
        *_, deviation_m = mirror.foot_of_puck(fix.position_m, cfg.robot.puck_height_m)
    except ConvergenceError:
        deviation_m = off_m
    found = (
        f"{len(fix.channels)} channels, residual {1e6 * fix.residual_rms_m:.1f} um, {1e3 * off_m:.1f} mm from base, "
        f"{1e3 * deviation_m:+.2f} mm off the surface"
    )
    if off_m > cfg.etalon.start_distance_m:
        return failed("laser fix", found, "set the robot down at base; else frame or unit of the collimators is wrong")
    if abs(deviation_m) > cfg.etalon.max_surface_residual_m:
        return failed("laser fix", found, "robot.puck_height_m or the collimators' positions are wrong")
    return passed("laser fix", found)
