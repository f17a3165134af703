"""What the survey, the localizer and the main loop hold the robot for: rows as those of ``ccatp.safety.conditions``."""

import re

from ccatp.core import Severity
from ccatp.safety.conditions import DANGER, Clear, Condition, Group, fault, go_home, hold, pause

# fmt: off
BACK_OFFS = fault(
    "back_offs", "at the edge again after {count} back-offs: is an edge sensor dirty?", Group.EDGES,
    "The same point ends at an edge over and over.",
    "Clean the sensors, look at the place; `ccatp resume`, or abort.")
STUCK_AT_EDGE = hold(
    "stuck_at_edge", "stuck at the edge: no motion away from it is permitted, or none helps", Group.EDGES,
    "Sensors bar every way out.",
    "Look at the robot. It tries again by itself as soon as a sensor is back on.",
    clear=Clear.AUTO, trusts_odometry=True)

NO_FRAME_FOR = pause(
    "no_frame_for", "no sensors frame for {age_s} s", Group.DATA,
    "Main has no frame of the robot.", "As above.", limit="", escalates_to=Severity.NONE)
NO_VERDICT = pause(
    "no_verdict", "no fresh verdict from the danger loop", Group.DATA,
    "Danger is too slow, hangs, or is being restarted.", "As for a stale estimate.",
    limit="", escalates_to=Severity.NONE)
FRAME_LATE = pause(
    "frame_late", "a frame was served {lag_ms} ms late", Group.DATA,
    "This machine was too slow for one frame.",
    "Nothing once; often: other programs, or no real-time rights (`no real time` in `log.jsonl`).",
    limit="", escalates_to=Severity.NONE)

UNATTENDED_FAULT = go_home(
    "unattended_fault", "unattended fault: the battery ({charge}) lasts for little more than the way home", Group.FANS,
    "Held on an overhanging mirror without a reaction of an operator: it goes home by itself, once.",
    "Look after held robots; a fault is reported every minute.")
FANS_REFUSED = fault(
    "fans_refused", "fan command refused: {why}; set robot.fan_duty", Group.FANS,
    "The robot would fall with the configured duty of its fans.", "Correct the configuration; start again.")

LINK_LOST = pause(
    "link_lost", "robot link lost: {reason}", Group.LINK,
    "The connection ended. The robot holds its wheels by itself; it is looked for for `robot.reconnect_timeout_s`.",
    "Network, robot. After that time the run ends with status 5; `--resume` goes on.",
    clear=Clear.AFTER_FIX, limit="", escalates_to=Severity.NONE)
FRAMES_BACKWARD = hold(
    "frames_backward", "time stamps of the frames run backward", Group.LINK,
    "Five in a row. Held.", "The firmware's clock.", trusts_odometry=True, limit="health.retries")
SENSOR_BACKWARD = hold(
    "sensor_backward", "time stamps of the {sensor} run backward", Group.LINK,
    "The same of one sensor.", "The firmware's clock.", trusts_odometry=True, limit="health.retries")

LEG_OVERDUE = fault(
    "leg_overdue", "the leg to {place} is overdue: is a wheel blocked or slipping?", Group.SURVEY,
    "It takes many times longer than it should.", "Look at the robot.")
NO_REST = fault(
    "no_rest", "the robot does not come to rest: {speeds}", Group.SURVEY,
    "It stands at a point and still moves.", "Fans that shake, a slope that is slippery.")
NO_WAY_ON = fault(
    "no_way_on", "no way on: {why}", Group.SURVEY,
    "From where it stands no safe way leads to the next point.",
    "`ccatp abort`; if there is no way home either, carry it.")
NO_WAY_HOME = fault(
    "no_way_home", "no way home: {why}", Group.SURVEY,
    "From where it stands no safe way leads to base.", "Carry it to base.")
MEASUREMENTS_FAILED = fault(
    "measurements_failed", "{count} measurements in a row failed: {why}", Group.SURVEY,
    "The laser system does not see the puck; the reason stands behind the colon.",
    "Laser, line of sight, the puck's cleanliness; `ccatp resume`.")
NOT_FOUND = fault(
    "not_found", "the robot cannot be found again: {why}", Group.SURVEY,
    "Its pose is not to be trusted, and no fix tells where it is.", "Laser and line of sight; `ccatp resume`.")
FRAME_REFUSED = fault(
    "frame_refused", "the laser system sees the robot {distance_m} m from {place}: {why}", Group.SURVEY,
    "The first fix, or one in motion, lies where the robot cannot be: the laser system's frame is another one.",
    "Configured collimators, base and start of the robot.")
LENGTHS_REFUSED = fault(
    "lengths_refused", "the laser system's lengths do not lead to the robot's base: {why}", Group.SURVEY,
    "The lengths of the first fix give no position.", "Configured collimators and base.")
FILTER_DIVERGED = hold(
    "filter_diverged", "filter: {why}", Group.SURVEY,
    "The estimate is no Gaussian any more. The pose is frozen; a fix starts it again.",
    "Keep the run directory if it comes again.", limit="health.retries")

FRAMES_MISSED = fault(
    "frames_missed", "no frames while the robot moved: put it at its start and start a new mission", Group.BEACONS,
    "The robot booted, or the link was away while it may have moved; the map of the beacons is not kept.",
    "`ccatp stop`, put it at its start, start again.", trusts_odometry=False)
MISSION_TOO_LONG = fault(
    "mission_too_long", "the mission takes longer than mission.time_limit_s = {limit_s}", Group.BEACONS,
    "The robot is held where it is.", "`ccatp abort` leads it home; or a longer time in the configuration.")

FIX_NOT_STORED = fault(
    "fix_not_stored", "the fix of {point} cannot be stored: {why}", Group.STORAGE,
    "The database refused or the disk is full.", "Make room; `ccatp resume` measures that point again.")
SKIP_NOT_STORED = fault(
    "skip_not_stored", "that {point} is skipped cannot be stored: {why}", Group.STORAGE,
    "The same of a point that was given up.", "Make room; `ccatp resume`.")
DISK_STALLS = fault(
    "disk_stalls", "the disk stalls: {point} is not stored after {time_s} s", Group.STORAGE,
    "The disk does not answer.", "The disk; `ccatp resume` when it is back.")

OPERATOR = go_home(
    "operator", "operator", Group.OBSERVATORY,
    "An operator called the robot home.", "Nothing; a new survey measures what is left.")
# fmt: on

SURVEY: tuple[Condition, ...] = tuple(row for row in list(globals().values()) if isinstance(row, Condition))


def advice_for(cause: str) -> str:
    """What an operator can do about a cause as it is shown; empty where nothing is known."""
    for row in (*DANGER, *SURVEY):
        # What lasts or comes again has its duration or count behind the message.
        pattern = re.sub(r"\\\{\w+\\\}", ".*", re.escape(row.message)) + r"(, (for|again after) .*|; .*)?"
        if row.message and re.fullmatch(pattern, cause):
            return row.advice
    return ""
