"""Checks before a mission: findings as a table, and the rules for the laser server and the robot at rest."""

from collections.abc import Iterable, Sequence
from enum import StrEnum
from itertools import pairwise
from math import dist
from statistics import fmean
from typing import Any, NamedTuple

from ccatp.config.models import Config
from ccatp.core import Fix
from ccatp.links.multiline import Environment
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.surface import ConvergenceError
from ccatp.survey.composition import robot_problems
from ccatp.survey.reactions import MirrorCheck


class CheckOutcome(StrEnum):
    """How a check went."""

    PASS = "pass"  # noqa: S105 - no password
    WARN = "warn"  # a mission is possible; the operator should know
    FAIL = "fail"
    SKIP = "skip"  # what it would check is not there


class PreflightResult(NamedTuple):
    """One check; ``todo`` says what to do and is empty where all is well."""

    name: str
    outcome: CheckOutcome
    found: str
    todo: str = ""


def passed(name: str, found: str) -> PreflightResult:
    """All is well."""
    return PreflightResult(name, CheckOutcome.PASS, found)


def warned(name: str, found: str, todo: str) -> PreflightResult:
    """A mission is possible."""
    return PreflightResult(name, CheckOutcome.WARN, found, todo)


def failed(name: str, found: str, todo: str) -> PreflightResult:
    """No mission like that."""
    return PreflightResult(name, CheckOutcome.FAIL, found, todo)


def skipped(names: Iterable[str], why: str) -> list[PreflightResult]:
    """What could not be checked."""
    return [PreflightResult(name, CheckOutcome.SKIP, why) for name in names]


def has_failed(findings: Iterable[PreflightResult]) -> bool:
    """Whether one failed."""
    return any(finding.outcome is CheckOutcome.FAIL for finding in findings)


def lines(findings: Sequence[PreflightResult]) -> list[str]:
    """The table as plain text, and what it comes to."""
    width = max(len(finding.name) for finding in findings)
    text = []
    for finding in findings:
        text.append(f"{finding.outcome:<4}  {finding.name:<{width}}  {finding.found}")
        if finding.todo:
            text.append(f"{'':4}  {'':{width}}  -> {finding.todo}")
    counts = {outcome: sum(f.outcome is outcome for f in findings) for outcome in CheckOutcome}
    summary = ", ".join(f"{count} {outcome}" for outcome, count in counts.items() if count)
    return [*text, f"{'not ready' if has_failed(findings) else 'ready'}: {summary}"]


def as_json(findings: Sequence[PreflightResult]) -> dict[str, Any]:
    """For ``--json``."""
    return {"ready": not has_failed(findings), "checks": [finding._asdict() for finding in findings]}


LASER_NAMES = ("lasers", "air", "laser fix")
# Air as it can be at a telescope, from the sea to 6000 m.
TEMPERATURE_C, PRESSURE_HPA, HUMIDITY_PCT = (-40.0, 50.0), (400.0, 1100.0), (0.0, 100.0)


def check_lasers(*, connected: bool, laser_ready: bool) -> PreflightResult:
    """Are the lasers there, and warm?"""
    if not connected:
        return failed("lasers", "the server has no laser", "switch the laser unit on and connect it to its server")
    if not laser_ready:
        return failed("lasers", "not warm yet", "wait until the laser unit is ready")
    return passed("lasers", "connected and warm")


def check_air(air: Environment) -> PreflightResult:
    """Can the air be what the server takes it for? Lengths are corrected by it."""
    found = f"{air.temperature_c:.1f} degC, {air.pressure_hpa:.0f} hPa, {air.humidity_pct:.0f} %"
    limits = (air.temperature_c, TEMPERATURE_C), (air.pressure_hpa, PRESSURE_HPA), (air.humidity_pct, HUMIDITY_PCT)
    if not all(low <= value <= high for value, (low, high) in limits):
        todo = "check the weather station of the laser unit: lengths are corrected by it"
        return failed("air", f"{found}: not the air of any telescope", todo)
    return passed("air", found)


def check_fix(cfg: Config, mirror: Mirror, fix: Fix) -> PreflightResult:
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


ROBOT_NAMES = (
    "robot geometry", "frames", "robot clock", "faults", "encoders", "inertial unit", "edge sensors", "gravity", "fans",
    "battery",
)  # fmt: skip
EDGES = ("front left", "front right", "rear left", "rear right")
# The rates that a robot must have: half of what the interface allows, which the danger rules still tolerate.
LEAST_HZ = {"imu": 20.0, "enc": 50.0, "edge": 200.0}
CLOCK_TOLERANCE = 0.01
STANDING_RAD_S = 0.02
BIAS_SIGMAS = 5.0


class RobotReport(NamedTuple):
    """What came from the robot: its hello, its frames in order, and when each arrived, by our monotonic clock."""

    hello: Hello
    frames: Sequence[Sensors]
    arrived_s: Sequence[float]


def check_robot(cfg: Config, mirror: Mirror, report: RobotReport) -> list[PreflightResult]:
    """All checks of a robot that stands at base."""
    problems = robot_problems(cfg, mirror, report.hello)
    geometry = passed(
        "robot geometry", f"wheel radius {cfg.robot.wheel_radius_m:g} m, base {cfg.robot.wheel_base_m:g} m"
    )
    if problems:
        todo = "measure the robot and correct [robot], or run.mirror"
        geometry = failed("robot geometry", "; ".join(problems), todo)
    return [
        geometry,
        _frames(cfg, report),
        _clock(report),
        _faults(report.frames),
        _encoders(report.frames),
        _inertial_unit(cfg, report.frames),
        _edge_sensors(report.frames),
        _gravity(mirror, report.frames),
        _fans(cfg, mirror, report),
        _battery(cfg, report.frames),
    ]


def _span_s(frames: Sequence[Sensors]) -> float:
    return frames[-1].t - frames[0].t


def _frames(cfg: Config, report: RobotReport) -> PreflightResult:
    frames, nominal = report.frames, report.hello.frame_hz
    span_s = report.arrived_s[-1] - report.arrived_s[0]
    if span_s <= 0.0:
        return failed(
            "frames", "a single frame", "check whether something between here and the robot holds frames back"
        )
    rate, gap_s = (len(frames) - 1) / span_s, max(b - a for a, b in pairwise(report.arrived_s))
    missing = sum(b.seq - a.seq - 1 for a, b in pairwise(frames))
    found = f"{rate:.1f} a second of {nominal:g}, longest gap {1e3 * gap_s:.0f} ms, {missing} missing"
    if gap_s > cfg.robot.sensors_timeout_s or rate < 0.9 * nominal:
        return failed("frames", found, "check the network between here and the robot, and at the load of both")
    if gap_s > cfg.robot.lag_limit_s or missing:
        return warned("frames", found, "the robot will pause now and then; check the network and the load")
    return passed("frames", found)


def _clock(report: RobotReport) -> PreflightResult:
    theirs_s, ours_s = _span_s(report.frames), report.arrived_s[-1] - report.arrived_s[0]
    ratio = theirs_s / ours_s if ours_s > 0.0 else 0.0
    found = f"runs at {ratio:.4f} of ours, {report.frames[-1].t:.0f} s since boot {report.hello.boot}"
    if report.hello.lockstep:
        return warned("robot clock", "simulated, in lockstep", "a real robot has a clock of its own")
    # What was under way at both ends blurs a short look.
    if abs(ratio - 1.0) > CLOCK_TOLERANCE + 0.05 / max(ours_s, 0.1):
        return failed("robot clock", found, "boot the robot; if it stays so its clock is not in order")
    return passed("robot clock", found)


def _faults(frames: Sequence[Sensors]) -> PreflightResult:
    reported = sorted({fault for frame in frames for fault in frame.faults})
    if reported:
        return failed("faults", f"the robot reports {', '.join(reported)}", "correct it before anything moves")
    return passed("faults", "the robot reports none")


def _too_slow(kind: str, count: int, frames: Sequence[Sensors]) -> str:
    rate = count / max(_span_s(frames), 1e-3)
    return "" if rate >= LEAST_HZ[kind] else f"{rate:.0f} samples a second, {LEAST_HZ[kind]:.0f} are needed"


def _encoders(frames: Sequence[Sensors]) -> PreflightResult:
    todo = "check the encoders and their cables"
    for index, side in ((1, "right"), (2, "left")):
        rates = [rate for frame in frames for row in frame.enc if (rate := row[index]) is not None]
        if slow := _too_slow("enc", len(rates), frames):
            return failed("encoders", f"{side}: {slow}", todo)
        if abs(fmean(rates)) > STANDING_RAD_S:
            return failed("encoders", f"{side} wheel turns at {fmean(rates):.3f} rad/s, and should stand", todo)
    return passed("encoders", "both wheels stand")


def _inertial_unit(cfg: Config, frames: Sequence[Sensors]) -> PreflightResult:
    rows = [row for frame in frames for row in frame.imu]
    todo = "check the inertial unit and its cable"
    if slow := _too_slow("imu", len(rows), frames):
        return failed("inertial unit", slow, todo)
    repeated = longest = 0
    for before, after in pairwise(rows):
        repeated = repeated + 1 if before[1:] == after[1:] else 0
        longest = max(longest, repeated)
    if longest >= cfg.health.identical_samples:
        return failed("inertial unit", f"{longest + 1} readings in a row are the same: it is frozen", todo)
    rate = fmean(row[2] for row in rows)
    limit = BIAS_SIGMAS * cfg.localizer.full_state.gyroscope_bias_sigma_rad_s
    found = f"zero rate {rate:+.4f} rad/s, {cfg.localizer.gyroscope_bias_rad_s:+.4f} is configured"
    if abs(rate - cfg.localizer.gyroscope_bias_rad_s) > limit:
        return failed("inertial unit", found, "let it warm up and stand still; then ccatp calibrate")
    return passed("inertial unit", found)


def _edge_sensors(frames: Sequence[Sensors]) -> PreflightResult:
    rows = [row[1:] for frame in frames for row in frame.edge]
    if slow := _too_slow("edge", len(rows), frames):
        return failed("edge sensors", slow, "check the edge sensors and their cable")
    seen = dict(zip(EDGES, zip(*rows, strict=True), strict=True))
    if off := [name for name, values in seen.items() if not any(values)]:
        todo = "set the robot down at base, on a panel with all four; clean the sensors"
        return failed("edge sensors", f"{' and '.join(off)} see no panel", todo)
    if flickering := [name for name, values in seen.items() if not all(values)]:
        return failed("edge sensors", f"{' and '.join(flickering)} see the panel on and off", "clean the sensors")
    return passed("edge sensors", "all four see the panel")


def _gravity(mirror: Mirror, frames: Sequence[Sensors]) -> PreflightResult:
    check = MirrorCheck(mirror)
    is_known = any(check.update(frame.t, frame.gravity, mirror.base_pose) for frame in frames)
    if check.contradiction:
        return failed(
            "gravity", check.contradiction, "set run.mirror to where the robot stands, or set it down at base"
        )
    if check.warning or not is_known:
        found = check.warning or "too few readings"
        return warned("gravity", found, "make sure by eye that this is the right mirror")
    return passed("gravity", f"the slope is that of {mirror.name} at base")


def _fans(cfg: Config, mirror: Mirror, report: RobotReport) -> PreflightResult:
    least, floor = min(min(frame.fans) for frame in report.frames), report.hello.robot.fan_floor
    found = f"at least {least:.2f} of duty, the floor is {floor:g}"
    if mirror.overhang and least < floor:
        return failed("fans", found, "the robot would fall: keep a hand on it, and find out why the fans are weak")
    if mirror.overhang and min(cfg.robot.fan_duty) < floor:
        found = f"robot.fan_duty {min(cfg.robot.fan_duty):g} is below the robot's floor {floor:g}"
        return failed("fans", found, "raise robot.fan_duty")
    return passed("fans", found)


def _battery(cfg: Config, frames: Sequence[Sensors]) -> PreflightResult:
    charge, health = frames[-1].soc, cfg.health
    lasts_s = max(charge - health.battery_reserve, 0.0) * health.battery_life_s
    found = f"{charge:.0%}, for {lasts_s / 60.0:.0f} min above the reserve of {health.battery_reserve:.0%}"
    if charge <= health.battery_reserve:
        return failed("battery", found, "charge it")
    if lasts_s < cfg.run.budget_s:
        return warned("battery", found, f"a survey may take {cfg.run.budget_s / 60.0:.0f} min: charge it")
    return passed("battery", found)
