"""THE table of conditions: everything that slows, pauses, holds, returns or stops the robot, one row per condition.

The danger loop finds those of ``DANGER``: of several at once the gravest counts, of equally grave ones the first row.
Exceptions, for the verdict's cause only: a declared edge keeps it unless a hold or a fault is found, an emergency
unless a return or a fault is. A mission, its localizer or the main loop find those of ``SURVEY``. What a mission does
follows from a row's action; of several that apply at once the first in ``Action`` counts. ``docs/alarms.md`` is made of
these rows.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, StrEnum
from functools import cache, lru_cache, partial
from operator import itemgetter
from typing import Any, NamedTuple

from ccatp.core import Severity


class Motion(Enum):
    """What the robot may still do."""

    ANY = "anything"
    RETREAT = "away from it"
    RETURN = "home"
    NONE = "nothing"


class Clear(Enum):
    """What ends the reaction, once the condition itself is over."""

    AUTO = "by itself"
    AFTER_FIX = "after a fix"
    OPERATOR = "by an operator"


class Action(Enum):
    """What is done about a condition, in the order of precedence."""

    EARTHQUAKE = "wheels held, then home"
    FAULT = "fault: held until an operator resumes"
    LOCATE = "hold: wheels held, one fix at rest, then held until it is over"
    HOLD = "hold: wheels held, a fix, then on by itself"
    SLOW = "half the speed"
    RETURN = "home"
    WAIT = "hold: wheels held until no sensor hangs over"
    RETREAT = "back off"
    PAUSE = "pause: wheels held, goes on by itself"
    KEEP_AWAY = "no motion towards it"
    INFORM = "reported"


class Group(StrEnum):
    """The chapters of the list of alarms."""

    EDGES = "Edges"
    DATA = "Data that are missing or old"
    SENSORS = "Edge sensors and inertial unit"
    WHEELS = "Wheels and encoders"
    FANS = "Fans and battery"
    LINK = "Link and clock"
    SURVEY = "The survey"
    BEACONS = "Among beacons"
    STORAGE = "Storage"
    OBSERVATORY = "The observatory"


class Cause(StrEnum):
    """Why an edge is declared."""

    RIM = "rim ahead on the map"
    SEAM = "further off the panel than the seam is wide"
    NO_MAP = "off the panel where the map has no seam"
    SILENT_WHEELS = "off the panel while the wheels are not heard"


@dataclass(frozen=True, slots=True, eq=False)
class Condition:
    """One row.

    Attributes:
        message: the cause as it is shown; "{...}" for what varies.
        meaning: when it is met, and what that means; ``advice``: what an operator can do.
        severity: of the verdict; NONE where event code and permits say it.
        motion: what the robot may still do; ``clear``: what ends the reaction, once the condition is over.
        trusts_odometry: the pose is carried on by wheels and gyroscope meanwhile.
        limit: the key of the configuration after which it is of severity ``escalates_to``; empty: it does not escalate.
        full_fans: the fans give all they can meanwhile.
        retries: how often it may come again before it is a fault; ``None``: as the configuration says.
    """

    name: str
    message: str
    group: Group
    meaning: str
    advice: str
    action: Action
    severity: Severity
    motion: Motion
    clear: Clear
    trusts_odometry: bool = True
    limit: str = ""
    escalates_to: Severity = Severity.NONE
    full_fans: bool = False
    retries: int | None = None

    def found(self, signal: str, value: float, limit: float, **text: str) -> "MonitorFinding":
        """The condition is met: ``value`` against ``limit``, and what varies in the message."""
        cause = self.message.format(**text) if text else self.message
        return MonitorFinding(self, self.severity, cause, signal, value, limit)

    def text(self, **varies: object) -> str:
        """The cause as it is shown."""
        return self.message.format(**varies)


class MonitorFinding(NamedTuple):
    """A condition that is met; ``value`` is in the unit of ``limit``. Severity and cause grow while it lasts."""

    condition: Condition
    severity: Severity
    cause: str
    signal: str
    value: float
    limit: float


def _columns(action: Action, severity: Severity, motion: Motion, clear: Clear, **more: Any) -> Callable[..., Condition]:
    return partial(Condition, action=action, severity=severity, motion=motion, clear=clear, **more)


# What an action usually goes with; a row may say otherwise.
inform = _columns(Action.INFORM, Severity.INFORM, Motion.ANY, Clear.AUTO)
slow = _columns(Action.SLOW, Severity.SLOW, Motion.ANY, Clear.AUTO)
_paused = Action.PAUSE, Severity.PAUSE, Motion.NONE, Clear.AUTO
pause = _columns(*_paused, limit="health.pause_limit_s", escalates_to=Severity.HOLD)
wait = _columns(*_paused)
hold = _columns(
    *(Action.HOLD, Severity.HOLD, Motion.NONE, Clear.AFTER_FIX),
    trusts_odometry=False,
    limit="health.hold_limit_s",
    escalates_to=Severity.FAULT,
)
go_home = _columns(Action.RETURN, Severity.RETURN, Motion.RETURN, Clear.OPERATOR)
fault = _columns(Action.FAULT, Severity.FAULT, Motion.NONE, Clear.OPERATOR)
shaken = _columns(Action.EARTHQUAKE, Severity.NONE, Motion.NONE, Clear.OPERATOR)
edge = _columns(Action.RETREAT, Severity.NONE, Motion.RETREAT, Clear.AFTER_FIX)
near = _columns(Action.KEEP_AWAY, Severity.NONE, Motion.RETREAT, Clear.AUTO)
beacon_hold = _columns(
    *(Action.HOLD, Severity.HOLD, Motion.NONE, Clear.AUTO), limit="danger.hold_limit_s", escalates_to=Severity.FAULT
)

# fmt: off
# -- wheels and encoders ----------------------------------------------------------------------------------------------

ENCODER_BROKEN = hold(
    "encoder_broken", "the {side} encoder {what}", Group.WHEELS,
    "One encoder repeats itself, or gives no values, while the wheel must turn.",
    "Its cable. The robot is measured and goes on; again and again it is a fault.")
WHEEL_RUNS_AWAY = hold(
    "wheel_runs_away", "the {side} wheel runs away", Group.WHEELS,
    "It turns faster than commanded.", "Take the robot off: the servo fails.")
WHEELS_STAND = hold(
    "wheels_stand", "both wheels stand, or no encoder counts", Group.WHEELS,
    "They were commanded to turn. Motor supply, or both encoders.", "The robot's supply; its own log.", retries=1)
ENCODER_COUNTS_NOTHING = hold(
    "encoder_counts_nothing", "the {side} encoder counts nothing", Group.WHEELS,
    "The wheel turns by the gyroscope and not by its encoder.", "Its cable, its disc.", retries=1)
WHEEL_BLOCKED = hold(
    "wheel_blocked", "the {side} wheel is blocked", Group.WHEELS,
    "It was commanded to turn and stands still; the gyroscope agrees.", "Look for what is in its way.", retries=1)
WHEEL_CREEPS = hold(
    "wheel_creeps", "the {side} wheel turns while it is held", Group.WHEELS,
    "The robot creeps. Fans to their maximum; a fault if it goes on.", "Hold the robot; fans, brake, slope.",
    full_fans=True)
WHEEL_CREEPS_ON = fault(
    "wheel_creeps_on", "the {side} wheel turns while it is held", Group.WHEELS,
    "The robot has crept for a second. Fans to their maximum.", "Hold the robot; fans, brake, slope.", full_fans=True)
WHEEL_DOES_NOT_STOP = hold(
    "wheel_does_not_stop", "the {side} wheel turns though it shall stand", Group.WHEELS,
    "The servo does not come to rest.", "As for a wheel that runs away, if it comes again.")
YAW_DISAGREES = hold(
    "yaw_disagrees", "gyroscope and wheels disagree about the turn: a wheel slips, or the gyroscope is off",
    Group.SENSORS, "They disagree by more than slip and errors of scale explain. A fix comes first.",
    "Wheels or mirror oily? Otherwise the gyroscope.")

# -- fans -------------------------------------------------------------------------------------------------------------

FAN_TOO_LITTLE = fault(
    "fan_too_little", "the {side} fan gives too little", Group.FANS,
    "Not enough to carry with certainty. Held, fans at their maximum.",
    "Secure the robot by hand before anything else.", full_fans=True)
FAN_WEAK = go_home(
    "fan_weak", "the {side} fan gets weak", Group.FANS,
    "It gives less than commanded, and still enough to carry the robot. The robot goes home.",
    "Replace it; `ccatp run --resume` later.", full_fans=True)
FAN_REPORTED = fault(
    "fan_reported", "the robot reports a fault of its {side} fan", Group.FANS,
    "The robot's own word; taken as too little.", "Secure the robot.", full_fans=True)
FAN_REPORTED_ON_THE_FLAT = inform(
    "fan_reported_on_the_flat", "the robot reports a fault of its {side} fan", Group.FANS,
    "The same where the mirror does not overhang: the robot stands without fans.",
    "Replace it before the robot goes to an overhanging mirror.")

# -- link and clock ---------------------------------------------------------------------------------------------------

DRIVES_TOO_LATE = pause(
    "drives_too_late", "drives reach the wheels too late", Group.LINK,
    "Commands take so long that the robot is not steered any more: a pause.", "Network.")
DRIVES_LATE = slow(
    "drives_late", "drives reach the wheels late", Group.LINK,
    "Commands take long. Half the speed.", "Network.")
CLOCK_JUMPED = pause(
    "clock_jumped", "the robot's clock has jumped", Group.LINK,
    "Its times are off by more than `health.clock_jump_s`. The clock's offset is measured again.", "Nothing once.")
FRAMES_LOST = hold(
    "frames_lost", "frames were lost: nobody saw where the robot went", Group.DATA,
    "A gap in the frames while the robot moved. A fix comes first.", "Network, if it comes often.")
LINES_GARBLED = hold(
    "lines_garbled", "lines of the robot were no frames", Group.DATA,
    "Several lines in a short time could not be read.",
    "Network or firmware. `ccatp conformance` tells what the robot sends wrong.")

# -- edge sensors and inertial unit -----------------------------------------------------------------------------------

EDGE_SENSOR_CHATTERS = hold(
    "edge_sensor_chatters", "an edge sensor chatters", Group.SENSORS,
    "It changes many times a second where the map has no edge.", "Clean it; look at its cable.", trusts_odometry=True)
EDGE_SENSOR_FLASHES = pause(
    "edge_sensor_flashes", "an edge sensor went off though nothing moved", Group.SENSORS,
    "Light fell on it, or it fails.", "Nothing once. Stray light: cover the place.")
EDGE_SENSOR_STAYS_DARK = slow(
    "edge_sensor_stays_dark", "an edge sensor went off though nothing moved", Group.SENSORS,
    "It stays off for longer than a pause may last: the edge rule decides, at half the speed.",
    "Clean or replace it. Stray light: cover the place.")
IMU_LEFT_OUT = slow(
    "imu_left_out", "{what}: left out", Group.SENSORS,
    "Readings of the inertial unit are impossible (stuck, at their limit, a jump). It is left out: wheels alone, "
    "at half the speed.", "Accuracy suffers. Replace it if it does not come back.")
SAMPLES_TOO_FEW = slow(
    "samples_too_few", "a sensor gives too few samples", Group.SENSORS,
    "One sensor is slower than usual. The robot goes on at half its speed.", "The robot's own log.")

# -- battery ----------------------------------------------------------------------------------------------------------

BATTERY_LOW = go_home(
    "battery_low", "the battery has to last for the way home", Group.FANS,
    "The charge suffices for the way home with its reserve, and not for more. The robot goes home.",
    "Charge it; `ccatp run --resume` later.")
BATTERY_REPORTED = go_home(
    "battery_reported", "the robot reports a low battery", Group.FANS,
    "The robot's own word. It goes home.", "As above.")

# -- seams ------------------------------------------------------------------------------------------------------------

EDGE_SENSOR_BLIND = hold(
    "edge_sensor_blind", "an edge sensor sees no seams: blind", Group.SENSORS,
    "It would not see the rim either.", "Clean or replace it before `ccatp resume`.", trusts_odometry=True, retries=0)
SEAM_MISSED = slow(
    "seam_missed", "an edge sensor did not see a seam", Group.SENSORS,
    "It crossed a seam and said nothing. The robot goes on at half its speed.",
    "Clean it; the second seam that it misses holds the robot.")

# -- what the robot reports of itself ---------------------------------------------------------------------------------

ENCODER_REPORTED = hold(
    "encoder_reported", "the robot reports a fault of its {side} encoder", Group.WHEELS,
    "The robot's own word.", "The robot's own log.")
EDGE_REPORTED = hold(
    "edge_reported", "the robot reports a fault of its edge sensors", Group.WHEELS,
    "The robot's own word.", "The robot's own log.")
STALL_REPORTED = hold(
    "stall_reported", "the robot reports that a wheel is blocked", Group.WHEELS,
    "The robot's own word.", "Look for what is in its way.")
IMU_REPORTED = slow(
    "imu_reported", "the robot reports a fault of its inertial unit", Group.WHEELS,
    "The robot's own word. Half the speed.", "The robot's own log.")
UNKNOWN_REPORTED = inform(
    "unknown_reported", "the robot reports a fault that is not known here", Group.WHEELS,
    "A firmware newer than this program. Reported, and nothing else.", "The robot's manual.")

# -- data that are missing or old -------------------------------------------------------------------------------------

NO_FRAME = pause(
    "no_frame", "no sensors frame", Group.DATA,
    "Danger has no frame of the robot.", "Is the robot on, the network up? See the link's alarms below.")
NO_EDGE_SAMPLES = pause(
    "no_edge_samples", "no edge samples", Group.DATA,
    "Frames come, without edge sensors.", "The robot's sensor board; its own log.")
EDGE_STALE = pause(
    "edge_stale", "edge samples stale", Group.DATA,
    "Frames come, their edge samples are old.", "The robot's sensor board; its own log.")
ENCODERS_STALE = hold(
    "encoders_stale", "encoder samples stale", Group.DATA,
    "No encoder samples arrive. Held until a fix: it is unknown where the robot moved meanwhile.",
    "The robot's encoders; if it comes again and again, take the robot off.")
NO_ESTIMATE = pause(
    "no_estimate", "no estimate", Group.DATA,
    "Main has not reported where the robot is: at the start, or while main is restarted.", "Nothing, unless it lasts.")
ESTIMATE_STALE = pause(
    "estimate_stale", "estimate stale", Group.DATA,
    "Main is too slow or hangs.",
    "Is something else busy on this machine? The supervisor restarts a main that hangs after two seconds.")
ESTIMATE_NOT_FINITE = pause(
    "estimate_not_finite", "estimate not finite", Group.DATA,
    "Main's estimate is no number.", "Keep the run directory: this is a defect of ours.")

# -- edges and emergencies --------------------------------------------------------------------------------------------

LIFTED = hold(
    "lifted", "all edge sensors off: lifted or fallen", Group.EDGES,
    "All four edge sensors are off at once.",
    "Look at the robot before anything else. On an overhanging mirror the fans are at their maximum; do not cut "
    "their power. `ccatp resume` when it stands on the mirror again; it has itself measured first.",
    limit="health.lifted_limit_s", full_fans=True)
ALL_OFF = edge(
    "all_off", "lifted or fallen", Group.EDGES,
    "As above, in the first frame of it: code 1, nothing is permitted.", "As above.",
    action=Action.WAIT, motion=Motion.NONE)
EDGE_SENSOR_STAYS_OFF = hold(
    "edge_sensor_stays_off", "an edge sensor stays off though it was moved back and the others are on", Group.SENSORS,
    "The sensor and no edge, unless one fix, taken at once, shows a seam or the rim there: then it goes on by itself.",
    "Clean or replace it. `ccatp resume` goes on if it is on again.", action=Action.LOCATE, trusts_odometry=True)
RIM_AHEAD = edge(
    "rim_ahead", Cause.RIM, Group.EDGES,
    "A sensor hangs out where the map has the rim.",
    "Nothing. If it comes again there: is the robot's pose plausible, is the base where the configuration has it?")
BEYOND_SEAM = edge(
    "beyond_seam", Cause.SEAM, Group.EDGES,
    "A sensor has been off for longer than the gap that the map has there.",
    "Is a panel missing, or the gap wider than `mirror.panels.gap_mm`?")
NO_SEAM = edge(
    "no_seam", Cause.NO_MAP, Group.EDGES,
    "A sensor went off in the middle of a panel: a hole, a dark spot, or a pose that is wrong.",
    "Look at the place. A dirty sensor does this everywhere, a wrong pose near seams.")
OFF_WITHOUT_WHEELS = edge(
    "off_without_wheels", Cause.SILENT_WHEELS, Group.EDGES,
    "A sensor is off and it is unknown how far the robot moved meanwhile.",
    "See the encoder's alarm that comes with it.")
CENTRE_NEAR_RIM = edge(
    "centre_near_rim", "the robot's centre is close to the rim on the map", Group.EDGES,
    "By the pose alone the robot is about to drive over the rim; no sensor has said so yet.",
    "Is the pose plausible? If the robot is elsewhere: `ccatp stop`, carry it to base, remove `checkpoint`, "
    "`--resume`.")
EARTHQUAKE = shaken(
    "earthquake", "emergency: earthquake", Group.OBSERVATORY,
    "Held, fans at their maximum, until it is cleared; then home.",
    "Clear it when its cause is gone and the robot is at base or held.")
EMERGENCY = go_home(
    "emergency", "emergency: {kind}", Group.OBSERVATORY,
    "Fire, power, weather or an operator's emergency: the robot goes home at once.",
    "Clear it when its cause is gone and the robot is at base or held.", severity=Severity.NONE)

# -- among beacons ----------------------------------------------------------------------------------------------------

RADIO_SILENT = beacon_hold(
    "radio_silent", "no radio is heard", Group.BEACONS,
    "No reading of a beacon for `danger.radio_timeout_s`.", "The robot's radio; the beacons' supply.")
NO_FRESH_ESTIMATE = beacon_hold(
    "no_fresh_estimate", "no fresh estimate", Group.BEACONS,
    "Main has not reported where the robot is for `danger.estimate_timeout_s`.",
    "Is something else busy on this machine?")
POSITION_UNCERTAIN = beacon_hold(
    "position_uncertain", "the position is too uncertain", Group.BEACONS,
    "Its standard deviation is above `danger.position_sigma_m`. Over when it is below `danger.position_clear_m`.",
    "Nothing, unless it lasts: beacons that fail.")
OBSTACLE_AHEAD = near(
    "obstacle_ahead", "an obstacle ahead", Group.BEACONS,
    "Something is nearer than `danger.obstacle_m` on the course. Code 1.", "Nothing: it is evaded.")
TARGET_NEAR = near(
    "target_near", "the target is too near", Group.BEACONS,
    "The radio that is followed is nearer than `danger.target_m` by its level. Code 1.",
    "Nothing: the robot waits until it is farther away.")
OBSTACLE_BEHIND = near(
    "obstacle_behind", "an obstacle behind", Group.BEACONS,
    "Something is nearer than `danger.obstacle_m` behind the robot: no reverse. Code 1.", "Nothing.")

DANGER: tuple[Condition, ...] = tuple(row for row in list(globals().values()) if isinstance(row, Condition))
PRECEDENCE = {row: -number for number, row in enumerate(DANGER)}

# == what a mission, its localizer or the main loop finds =============================================================

BACK_OFFS = fault(
    "back_offs", "at the edge again after {count} back-offs: is an edge sensor dirty?", Group.EDGES,
    "The same point ends at an edge over and over.",
    "Clean the sensors, look at the place; `ccatp resume`, or abort.")
STUCK_AT_EDGE = hold(
    "stuck_at_edge", "stuck at the edge: no motion away from it is permitted, or none helps", Group.EDGES,
    "Sensors bar every way out.",
    "Look at the robot. It tries again by itself as soon as a sensor is back on.",
    action=Action.WAIT, clear=Clear.AUTO, trusts_odometry=True)

NO_FRAME_FOR = wait(
    "no_frame_for", "no sensors frame for {age_s:.2f} s", Group.DATA,
    "Main has no frame of the robot.", "As above.")
NO_VERDICT = wait(
    "no_verdict", "no fresh verdict from the danger loop", Group.DATA,
    "Danger is too slow, hangs, or is being restarted.", "As for a stale estimate.")
FRAME_LATE = wait(
    "frame_late", "a frame was served {lag_ms:.0f} ms late", Group.DATA,
    "This machine was too slow for one frame.",
    "Nothing once; often: other programs, or no real-time rights (`no real time` in `log.jsonl`).")

UNATTENDED_FAULT = go_home(
    "unattended_fault", "unattended fault: the battery ({charge:.0%}) lasts for little more than the way home",
    Group.FANS, "Held on an overhanging mirror without a reaction of an operator: it goes home by itself, once.",
    "Look after held robots; a fault is reported every minute.")
FANS_REFUSED = fault(
    "fans_refused", "fan command refused: {why}; set robot.fan_duty", Group.FANS,
    "The robot would fall with the configured duty of its fans.", "Correct the configuration; start again.")

LINK_LOST = wait(
    "link_lost", "robot link lost: {reason}", Group.LINK,
    "The connection ended. The robot holds its wheels by itself; it is looked for for `robot.reconnect_timeout_s`.",
    "Network, robot. After that time the run ends with status 5; `--resume` goes on.",
    clear=Clear.AFTER_FIX)
FRAMES_BACKWARD = hold(
    "frames_backward", "time stamps of the frames run backward", Group.LINK,
    "Five in a row. Held.", "The firmware's clock.", trusts_odometry=True, limit="health.retries")
SENSOR_BACKWARD = hold(
    "sensor_backward", "time stamps of the {sensor} run backward", Group.LINK,
    "The same of one sensor.", "The firmware's clock.", trusts_odometry=True, limit="health.retries")

LEG_OVERDUE = fault(
    "leg_overdue", "the leg to ({x_m:.3f}, {y_m:.3f}) m is overdue: is a wheel blocked or slipping?", Group.SURVEY,
    "It takes many times longer than it should.", "Look at the robot.")
NO_REST = fault(
    "no_rest", "the robot does not come to rest: {v_m_s:.4f} m/s, {omega_rad_s:.4f} rad/s", Group.SURVEY,
    "It stands at a point and still moves.", "Fans that shake, a slope that is slippery.")
NO_WAY_ON = fault(
    "no_way_on", "no way on: {why}", Group.SURVEY,
    "From where it stands no safe way leads to the next point.",
    "`ccatp abort`; if there is no way home either, carry it.")
NO_WAY_HOME = fault(
    "no_way_home", "no way home: {why}", Group.SURVEY,
    "From where it stands no safe way leads to base.", "Carry it to base.")
TIME_USED_UP = go_home(
    "time_used_up", "the time budget of {budget_s:g} s is used up", Group.SURVEY,
    "The way home would take what is left of it.", "Nothing; `ccatp run --resume` measures what is left.")
MEASUREMENTS_FAILED = fault(
    "measurements_failed", "{count} measurements in a row failed: {why}", Group.SURVEY,
    "The laser system does not see the puck; the reason stands behind the colon.",
    "Laser, line of sight, the puck's cleanliness; `ccatp resume`.")
NOT_FOUND = fault(
    "not_found", "the robot cannot be found again: {why}", Group.SURVEY,
    "Its pose is not to be trusted, and no fix tells where it is.", "Laser and line of sight; `ccatp resume`.")
FRAME_REFUSED = fault(
    "frame_refused", "the laser system sees the robot {distance_m:.2f} m from {place}: {why}", Group.SURVEY,
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
    "mission_too_long", "the mission takes longer than mission.time_limit_s = {limit_s:g}", Group.BEACONS,
    "The robot is held where it is.", "`ccatp abort` leads it home; or a longer time in the configuration.")

FIX_NOT_STORED = fault(
    "fix_not_stored", "the fix of {point} cannot be stored: {why}", Group.STORAGE,
    "The database refused or the disk is full.", "Make room; `ccatp resume` measures that point again.")
SKIP_NOT_STORED = fault(
    "skip_not_stored", "that {point} is skipped cannot be stored: {why}", Group.STORAGE,
    "The same of a point that was given up.", "Make room; `ccatp resume`.")
DISK_STALLS = fault(
    "disk_stalls", "the disk stalls: {point} is not stored after {time_s:g} s", Group.STORAGE,
    "The disk does not answer.", "The disk; `ccatp resume` when it is back.")

OPERATOR = go_home(
    "operator", "operator", Group.OBSERVATORY,
    "An operator called the robot home, or paused it: then it is held.",
    "`ccatp resume` after a pause; otherwise nothing, a new survey measures what is left.", severity=Severity.NONE)
# fmt: on

SURVEY = tuple(row for row in list(globals().values()) if isinstance(row, Condition) and row not in DANGER)


@cache
def _patterns() -> list[tuple[re.Pattern[str], Condition]]:
    found = []
    for row in (*DANGER, *SURVEY):
        fixed = re.split(r"{.*?}", row.message)
        # What lasts or comes again has its duration or count behind the message.
        pattern = ".*".join(map(re.escape, fixed)) + r"(,? (for|again after) .*|; .*)?"
        found.append((sum(map(len, fixed)), re.compile(pattern), row))
    # Of two that match, the row that says more is meant.
    return [(pattern, row) for _, pattern, row in sorted(found, key=itemgetter(0), reverse=True)]


@lru_cache(256)
def condition_of(cause: str) -> Condition | None:
    """The row of a cause as it is shown; ``None`` for what is no condition."""
    return next((row for pattern, row in _patterns() if pattern.fullmatch(cause)), None)
