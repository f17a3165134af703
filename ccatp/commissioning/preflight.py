"""Checks before a mission: findings as a table, and the rules for the laser server and the robot at rest."""

from collections import Counter
from collections.abc import Iterable, Sequence
from enum import StrEnum
from functools import partial
from itertools import pairwise
from math import dist
from statistics import fmean
from typing import Any, NamedTuple

from ccatp.conditions import text_of
from ccatp.conditions.danger import SAMPLE_RATES, SENSOR_TOO_SLOW
from ccatp.config.models import Config
from ccatp.control.grip_model import GripModel
from ccatp.core import UNCHECKED, UNRELIABLE, Fix
from ccatp.links.multiline import Environment
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.surface import ConvergenceError
from ccatp.report.html import render
from ccatp.rest import WHEEL_STANDS_RAD_S
from ccatp.sensing.sample_times import possible_gravity
from ccatp.survey.checks import MirrorCheck
from ccatp.survey.composition import robot_problems
from ccatp.survey.forecast import clock, forecast_time
from ccatp.survey.planning.legs import PlanError
from ccatp.survey.planning.route import ORDERS, plan_survey


class CheckOutcome(StrEnum):
    """Result of a check."""

    PASS = "pass"  # noqa: S105 - no password
    WARN = "warn"  # a mission is possible; the operator should know
    FAIL = "fail"
    SKIP = "skip"  # the part to check is not available


class PreflightResult(NamedTuple):
    """Result of one check; the list of checks sets ``name``. ``todo`` is the advice, empty if there is none."""

    name: str
    outcome: CheckOutcome
    found: str
    todo: str = ""


passed = partial(PreflightResult, "", CheckOutcome.PASS)
warned = partial(PreflightResult, "", CheckOutcome.WARN)
failed = partial(PreflightResult, "", CheckOutcome.FAIL)


def skipped(names: Iterable[str], why: str) -> list[PreflightResult]:
    """Results of checks that could not run."""
    return [PreflightResult(name, CheckOutcome.SKIP, why) for name in names]


def named(**findings: PreflightResult) -> list[PreflightResult]:
    """Findings with the keywords as names; underscores become spaces."""
    return [finding._replace(name=name.replace("_", " ")) for name, finding in findings.items()]


def has_failed(findings: Iterable[PreflightResult]) -> bool:
    """Whether any check failed."""
    return any(finding.outcome is CheckOutcome.FAIL for finding in findings)


def lines(findings: Sequence[PreflightResult]) -> list[str]:
    """The table as plain text, with the number of results of each outcome."""
    counts = Counter(finding.outcome for finding in findings)
    summary = ", ".join(f"{counts[outcome]} {outcome}" for outcome in CheckOutcome if counts[outcome])
    width = max(len(finding.name) for finding in findings)
    values = {"findings": findings, "width": width, "has_failed": has_failed(findings), "summary": summary}
    return render("preflight.txt", **values).splitlines()


def as_json(findings: Sequence[PreflightResult]) -> dict[str, Any]:
    """For ``--json``."""
    return {"ready": not has_failed(findings), "checks": [finding._asdict() for finding in findings]}


def check_time(cfg: Config, mirror: Mirror) -> PreflightResult:
    """Whether the survey is expected to keep its time budget."""
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    try:
        forecast = forecast_time(cfg, mirror, plan_survey(cfg, mirror, points))
    except PlanError as error:
        return failed(str(error), "see ccatp plan")
    if not forecast.is_within:
        return warned(forecast.problem, forecast.advice)
    return passed(f"{forecast.expectation}; run.budget_s is {clock(forecast.budget_s)}")


LASER_NAMES = ("lasers", "air", "laser fix")
# Range of the air at a telescope, from sea level to 6000 m.
TEMPERATURE_C, PRESSURE_HPA, HUMIDITY_PCT = (-40.0, 50.0), (400.0, 1100.0), (0.0, 100.0)


def check_lasers(*, connected: bool, laser_ready: bool) -> PreflightResult:
    """Whether the lasers are connected and warm."""
    if not connected:
        return failed("the server has no laser", "switch the laser unit on and connect it to its server")
    if not laser_ready:
        return failed("not warm yet", "wait until the laser unit is ready")
    return passed("connected and warm")


def check_air(air: Environment) -> PreflightResult:
    """Whether the server's air values are plausible; it corrects lengths by them."""
    found = f"{air.temperature_c:.1f} degC, {air.pressure_hpa:.0f} hPa, {air.humidity_pct:.0f} %"
    limits = (air.temperature_c, TEMPERATURE_C), (air.pressure_hpa, PRESSURE_HPA), (air.humidity_pct, HUMIDITY_PCT)
    if not all(low <= value <= high for value, (low, high) in limits):
        todo = "check the weather station of the laser unit: lengths are corrected by it"
        return failed(f"{found}: not the air of any telescope", todo)
    return passed(found)


def check_fix(cfg: Config, mirror: Mirror, fix: Fix) -> PreflightResult:
    """Whether the puck is where it is on a robot at base."""
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
        return failed(found, "set the robot down at base; else frame or unit of the collimators is wrong")
    if abs(deviation_m) > cfg.etalon.max_surface_residual_m:
        return failed(found, "robot.puck_height_m or the collimators' positions are wrong")
    todo = "check beams, reflector and air data of the laser system; its points would be no measurements"
    if fix.metrology == UNRELIABLE:
        return warned(f"{found}; the lengths contradict each other: channels {_listed(fix.suspects)}", todo)
    if fix.left_out:
        return warned(f"{found}; not used: channels {_listed(fix.left_out)}", "check the beam of that channel")
    if fix.metrology == UNCHECKED:
        return warned(f"{found}; too few lengths to contradict each other", "clear the beams of the other channels")
    return passed(found)


def _listed(channels: Iterable[int]) -> str:
    return " ".join(map(str, channels))


EDGES = ("front left", "front right", "rear left", "rear right")
CLOCK_TOLERANCE = 0.01
BIAS_SIGMAS = 5.0


class RobotReport(NamedTuple):
    """Hello and frames of the robot in order, and the arrival time of each frame on this machine's monotonic clock."""

    cfg: Config
    mirror: Mirror
    hello: Hello
    frames: Sequence[Sensors]
    arrived_s: Sequence[float]

    @property
    def span_s(self) -> float:
        """Time from the first frame to the last one, robot's clock."""
        return self.frames[-1].t - self.frames[0].t


def _geometry(report: RobotReport) -> PreflightResult:
    if problems := robot_problems(report.cfg, report.mirror, report.hello):
        return failed("; ".join(problems), "measure the robot and correct [robot], or run.mirror")
    return passed(f"wheel radius {report.cfg.robot.wheel_radius_m:g} m, base {report.cfg.robot.wheel_base_m:g} m")


def _frames(report: RobotReport) -> PreflightResult:
    frames, nominal = report.frames, report.hello.frame_hz
    span_s = report.arrived_s[-1] - report.arrived_s[0]
    if span_s <= 0.0:
        return failed("a single frame", "check whether something between here and the robot holds frames back")
    rate, gap_s = (len(frames) - 1) / span_s, max(b - a for a, b in pairwise(report.arrived_s))
    missing = sum(b.seq - a.seq - 1 for a, b in pairwise(frames))
    found = f"{rate:.1f} a second of {nominal:g}, longest gap {1e3 * gap_s:.0f} ms, {missing} missing"
    if gap_s > report.cfg.robot.sensors_timeout_s or rate < 0.9 * nominal:
        return failed(found, "check the network between here and the robot, and at the load of both")
    if gap_s > report.cfg.robot.lag_limit_s or missing:
        return warned(found, "the robot will pause now and then; check the network and the load")
    return passed(found)


def _clock(report: RobotReport) -> PreflightResult:
    theirs_s, ours_s = report.span_s, report.arrived_s[-1] - report.arrived_s[0]
    ratio = theirs_s / ours_s if ours_s > 0.0 else 0.0
    found = f"runs at {ratio:.4f} of ours, {report.frames[-1].t:.0f} s since boot {report.hello.boot}"
    if report.hello.lockstep:
        return warned("simulated, in lockstep", "a real robot has a clock of its own")
    # Delays of the first and the last frame make a short measurement inaccurate.
    if abs(ratio - 1.0) > CLOCK_TOLERANCE + 0.05 / max(ours_s, 0.1):
        return failed(found, "boot the robot; if it stays so its clock is not in order")
    return passed(found)


def _faults(report: RobotReport) -> PreflightResult:
    if reported := sorted({fault for frame in report.frames for fault in frame.faults}):
        return failed(f"the robot reports {', '.join(reported)}", "correct it before anything moves")
    return passed("the robot reports none")


def _rate(kind: str, count: int, report: RobotReport) -> PreflightResult | None:
    """The problem of a sensor that is silent or slow; one sample may be missing at the end."""
    sensor, least_hz, _ = SAMPLE_RATES[kind]
    span_s = max(report.span_s, 1e-3)
    if not count:
        return failed(f"{sensor} deliver no samples", "check their cable and supply")
    if (count + 1) / span_s >= least_hz:
        return None
    varies = {"rate": f"{count / span_s:.0f}", "least": f"{least_hz:.0f}"}
    return failed(text_of(SENSOR_TOO_SLOW.cause(sensor=sensor, **varies)), SENSOR_TOO_SLOW.advice)


def _encoders(report: RobotReport) -> PreflightResult:
    todo = "check the encoders and their cables"
    for index, side in ((1, "right"), (2, "left")):
        rates = [rate for frame in report.frames for row in frame.enc if (rate := row[index]) is not None]
        if slow := _rate("enc", len(rates), report):
            return slow._replace(found=f"{side}: {slow.found}")
        if abs(fmean(rates)) > WHEEL_STANDS_RAD_S:
            return failed(f"{side} wheel turns at {fmean(rates):.3f} rad/s, and should stand", todo)
    return passed("both wheels stand")


def _inertial_unit(report: RobotReport) -> PreflightResult:
    rows = [row for frame in report.frames for row in frame.imu]
    todo = "check the inertial unit and its cable"
    if slow := _rate("imu", len(rows), report):
        return slow
    repeated = longest = 0
    for before, after in pairwise(rows):
        repeated = repeated + 1 if before[1:] == after[1:] else 0
        longest = max(longest, repeated)
    if longest >= report.cfg.health.identical_samples:
        return failed(f"{longest + 1} readings in a row are the same: it is frozen", todo)
    rate = fmean(row[2] for row in rows)
    limit = BIAS_SIGMAS * report.cfg.localizer.full_state.gyroscope_bias_sigma_rad_s
    found = f"zero rate {rate:+.4f} rad/s, {report.cfg.localizer.gyroscope_bias_rad_s:+.4f} is configured"
    if abs(rate - report.cfg.localizer.gyroscope_bias_rad_s) > limit:
        return failed(found, "let it warm up and stand still; then ccatp calibrate")
    return passed(found)


def _edge_sensors(report: RobotReport) -> PreflightResult:
    rows = [row[1:] for frame in report.frames for row in frame.edge]
    if slow := _rate("edge", len(rows), report):
        return slow
    seen = dict(zip(EDGES, zip(*rows, strict=True), strict=True))
    if off := [name for name, values in seen.items() if not any(values)]:
        todo = "set the robot down at base, on a panel with all four; clean the sensors"
        return failed(f"{' and '.join(off)} see no panel", todo)
    if flickering := [name for name, values in seen.items() if not all(values)]:
        return failed(f"{' and '.join(flickering)} see the panel on and off", "clean the sensors")
    return passed("all four see the panel")


def _gravity(report: RobotReport) -> PreflightResult:
    check = MirrorCheck(report.mirror, is_heading_known=True)
    readings = ((frame.t, possible_gravity(frame.t, frame.gravity)) for frame in report.frames)
    is_known = any(check.update(t_s, gravity, report.mirror.base_pose) for t_s, gravity in readings)
    if check.contradiction:
        todo = "set the robot down at base with its heading; check run.mirror, and the axes of docs/protocols.md"
        return failed(check.contradiction, todo)
    if check.warning or not is_known:
        slow = _rate("gravity", sum(frame.gravity is not None for frame in report.frames), report)
        found = "too few readings" if slow is None else slow.found
        return warned(found, "make sure by eye that this is the right mirror")
    unseen = "".join(f"; it would look the same if {mistake}" for mistake in check.unseen)
    return passed(f"the slope is that of {report.mirror.name} at base{unseen}")


def _fans(report: RobotReport) -> PreflightResult:
    least, floor = min(min(frame.fans) for frame in report.frames), report.hello.robot.fan_floor
    found = f"at least {least:.2f} of duty, the floor is {floor:g}"
    if report.mirror.overhang and least < floor:
        return failed(found, "the robot would fall: keep a hand on it, and find out why the fans are weak")
    if report.mirror.overhang and min(report.cfg.robot.fan_duty) < floor:
        found = f"robot.fan_duty {min(report.cfg.robot.fan_duty):g} is below the robot's floor {floor:g}"
        return failed(found, "raise robot.fan_duty")
    grip = GripModel(report.cfg.robot).forecast(report.mirror)
    if not grip.is_held:
        return failed(grip.text, "raise the thrust, or correct mass, thrust and friction of [robot]")
    if grip.is_short:
        return warned(grip.text, "nothing; for full speed raise the thrust")
    return passed(found)


def _battery(report: RobotReport) -> PreflightResult:
    charge, health = report.frames[-1].soc, report.cfg.health
    lasts_s = max(charge - health.battery_reserve, 0.0) * health.battery_life_s
    found = f"{charge:.0%}, for {lasts_s / 60.0:.0f} min above the reserve of {health.battery_reserve:.0%}"
    if charge <= health.battery_reserve:
        return failed(found, "charge it")
    if lasts_s < report.cfg.run.budget_s:
        return warned(found, f"a survey may take {report.cfg.run.budget_s / 60.0:.0f} min: charge it")
    return passed(found)


ROBOT_CHECKS = {
    "robot geometry": _geometry, "frames": _frames, "robot clock": _clock, "faults": _faults, "encoders": _encoders,
    "inertial unit": _inertial_unit, "edge sensors": _edge_sensors, "gravity": _gravity, "fans": _fans,
    "battery": _battery,
}  # fmt: skip


def check_robot(report: RobotReport) -> list[PreflightResult]:
    """Run all checks of a robot that stands at base."""
    return [check(report)._replace(name=name) for name, check in ROBOT_CHECKS.items()]
