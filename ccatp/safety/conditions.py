"""What the danger loop can find wrong: one row per condition, and what follows from it.

Of several at once the gravest counts, of equally grave ones the first row of ``DANGER``. Exceptions, for the verdict's
cause only: a declared edge keeps it unless a hold or a fault is found, an emergency unless a return or a fault is.
``docs/alarms.md`` is made of these rows and of those of ``ccatp.survey.conditions``.
"""

from dataclasses import dataclass
from enum import Enum, StrEnum
from functools import partial
from typing import NamedTuple

from ccatp.core import Severity
from ccatp.safety.edge_detector import Cause


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


@dataclass(frozen=True, slots=True, eq=False)
class Condition:
    """One row.

    Attributes:
        message: the cause as it is shown; "{...}" for what varies.
        severity: what is done; NONE where event code and permits say it.
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


class MonitorFinding(NamedTuple):
    """A condition that is met; ``value`` is in the unit of ``limit``. Severity and cause grow while it lasts."""

    condition: Condition
    severity: Severity
    cause: str
    signal: str
    value: float
    limit: float


# What a severity usually means; a row may say otherwise.
inform = partial(Condition, severity=Severity.INFORM, motion=Motion.ANY, clear=Clear.AUTO)
slow = partial(Condition, severity=Severity.SLOW, motion=Motion.ANY, clear=Clear.AUTO)
pause = partial(
    Condition,
    severity=Severity.PAUSE,
    motion=Motion.NONE,
    clear=Clear.AUTO,
    limit="health.pause_limit_s",
    escalates_to=Severity.HOLD,
)
hold = partial(
    Condition,
    severity=Severity.HOLD,
    motion=Motion.NONE,
    clear=Clear.AFTER_FIX,
    trusts_odometry=False,
    limit="health.hold_limit_s",
    escalates_to=Severity.FAULT,
)
go_home = partial(Condition, severity=Severity.RETURN, motion=Motion.RETURN, clear=Clear.OPERATOR)
fault = partial(Condition, severity=Severity.FAULT, motion=Motion.NONE, clear=Clear.OPERATOR)
edge = partial(Condition, severity=Severity.NONE, motion=Motion.RETREAT, clear=Clear.AFTER_FIX)
near = partial(Condition, severity=Severity.NONE, motion=Motion.RETREAT, clear=Clear.AUTO)
beacon_hold = partial(
    Condition,
    severity=Severity.HOLD,
    motion=Motion.NONE,
    clear=Clear.AUTO,
    limit="danger.hold_limit_s",
    escalates_to=Severity.FAULT,
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
    "As above, in the first frame of it: code 1, nothing is permitted.", "As above.", motion=Motion.NONE)
EDGE_SENSOR_STAYS_OFF = hold(
    "edge_sensor_stays_off", "an edge sensor stays off though it was moved back and the others are on", Group.SENSORS,
    "The sensor and no edge, unless one fix, taken at once, shows a seam or the rim there: then it goes on by itself.",
    "Clean or replace it. `ccatp resume` goes on if it is on again.", trusts_odometry=True)
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
EARTHQUAKE = edge(
    "earthquake", "emergency: earthquake", Group.OBSERVATORY,
    "Held, fans at their maximum, until it is cleared; then home.",
    "Clear it when its cause is gone and the robot is at base or held.", motion=Motion.NONE, clear=Clear.OPERATOR)
EMERGENCY = edge(
    "emergency", "emergency: {kind}", Group.OBSERVATORY,
    "Fire, power, weather or an operator's emergency: the robot goes home at once.",
    "Clear it when its cause is gone and the robot is at base or held.", motion=Motion.RETURN, clear=Clear.OPERATOR)

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

# fmt: on

DANGER: tuple[Condition, ...] = tuple(row for row in list(globals().values()) if isinstance(row, Condition))
PRECEDENCE = {row: -number for number, row in enumerate(DANGER)}
